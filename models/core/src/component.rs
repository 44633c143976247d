//! A component: one role of a robot's loop as a state machine. It neither waits nor sends; it is
//! handed messages and the time, and gives its own messages to its output ports.
//!
//! ```
//! use core::time::Duration;
//! use hil_core::component::Component;
//!
//! hil_core::message! {
//!     pub struct Position = "example.Position.v1" { pub position_m: f64 }
//!     pub struct Speed = "example.Speed.v1" { pub speed_mps: f64 }
//! }
//!
//! // Drives to the origin: its state is where the cart is.
//! let controller = Component::of(0.0)
//!     .input("cart/position", |position_m, _now, heard: &Position| *position_m = heard.position_m)
//!     .publish("cart/speed", Duration::from_millis(10), |position_m, _now, _tick| Speed {
//!         speed_mps: -5.0 * *position_m,
//!     })
//!     .into_role();
//! assert_eq!(controller.outputs()[0].name, "cart/speed");
//! ```

use core::fmt::{self, Debug};
use core::time::Duration;

use crate::message::{Message, MessageType};
use crate::time::{Instant, PeriodicTimer, Tick};

/// Messages an output port takes in one call of its component: a few for each of dozens of robots.
pub const OUTPUT_CAPACITY: usize = 256;
/// Memory of an output port, unless two messages take more.
const OUTPUT_BYTES: usize = 1 << 20;

/// An output port: a field of its component. It takes up to [`Output::CAPACITY`] messages in one call,
/// which leave when the call has ended; it drops and counts what is beyond.
#[derive(Debug)]
pub struct Output<M> {
    messages: Vec<M>,
    dropped_count: u64,
}

impl<M> Default for Output<M> {
    fn default() -> Self {
        Self {
            messages: Vec::new(),
            dropped_count: 0,
        }
    }
}

impl<M> Output<M> {
    /// Messages that one takes in one call: [`OUTPUT_CAPACITY`], fewer of large ones, at least two.
    pub const CAPACITY: usize = {
        let size = if size_of::<M>() == 0 {
            1
        } else {
            size_of::<M>()
        };
        match OUTPUT_BYTES / size {
            0..2 => 2,
            2..OUTPUT_CAPACITY => OUTPUT_BYTES / size,
            _ => OUTPUT_CAPACITY,
        }
    };

    /// Gives a message; a full port drops and counts it.
    pub fn send(&mut self, message: M) {
        if self.messages.len() < Self::CAPACITY {
            self.messages.push(message);
        } else {
            self.dropped_count += 1;
        }
    }

    /// Takes the messages out, oldest first.
    pub fn drain(&mut self) -> impl Iterator<Item = M> + '_ {
        self.messages.drain(..)
    }

    /// Messages refused because the port was full, since its role last took them out.
    pub fn dropped_count(&self) -> u64 {
        self.dropped_count
    }
}

/// A port of a role: joined by its name to the channel of that name, if that carries its messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Port {
    /// Name, also of the channel.
    pub name: &'static str,
    /// What passes.
    pub message: MessageType,
}

/// Hands the bytes of a message to a state; false when they are no message of the port.
type Take<S> = Box<dyn Fn(&mut S, Instant, &[u8]) -> bool>;
/// Called each period.
type Call<S> = Box<dyn Fn(&mut S, Instant, Tick, Emit<'_>)>;
/// Finds an output port in its state, by the port's number.
type Find<S> = (
    usize,
    Box<dyn for<'a> Fn(&'a mut S) -> &'a mut dyn AnyOutput>,
);

/// What a user writes: a controller, a robot model, a source of motion. It is a state `S`, functions for the
/// messages of its input ports and for its periods, and its output ports. One body of code runs in virtual
/// and in real time.
pub struct Component<S> {
    state: S,
    inputs: Vec<Port>,
    takes: Vec<Take<S>>,
    outputs: Vec<Port>,
    finds: Vec<Find<S>>,
    periods: Vec<Period<S>>,
    start: Option<fn(&mut S, Instant)>,
    timer: Option<Timer<S>>,
    dropped_count: u64,
}

struct Period<S> {
    timer: PeriodicTimer,
    call: Call<S>,
}

/// A timer that a state keeps itself.
#[derive(Debug)]
pub struct Timer<S> {
    /// When it is due next; `None` for never.
    pub next: fn(&S) -> Option<Instant>,
    /// Called when it or a period is due, before what is called periodically; does nothing where nothing of
    /// its own is due.
    pub tick: fn(&mut S, Instant),
    /// Its points in time that passed without a call.
    pub skipped: fn(&S) -> u64,
}

impl<S: Debug + 'static> Component<S> {
    /// One that has this state and no port yet.
    pub const fn of(state: S) -> Self {
        Self {
            state,
            inputs: Vec::new(),
            takes: Vec::new(),
            outputs: Vec::new(),
            finds: Vec::new(),
            periods: Vec::new(),
            start: None,
            timer: None,
            dropped_count: 0,
        }
    }

    /// Messages of the channel `name` go to `take`, in order of arrival. Waiting messages of several
    /// ports are taken port by port, in the order of declaration.
    ///
    /// # Panics
    /// When there is an input of this name already.
    #[must_use]
    pub fn input<M: Message>(
        mut self,
        name: &'static str,
        take: impl Fn(&mut S, Instant, &M) + 'static,
    ) -> Self {
        declare::<M>(&mut self.inputs, name);
        self.takes.push(Box::new(move |state, now, payload| {
            // In place, or as a copy where the bytes are not aligned.
            if let Ok(message) = bytemuck::try_from_bytes(payload) {
                take(state, now, message);
            } else if let Ok(message) = bytemuck::try_pod_read_unaligned(payload) {
                take(state, now, &message);
            } else {
                return false;
            }
            true
        }));
        self
    }

    /// Messages of the port that `find` returns go to the channel `name`.
    ///
    /// # Panics
    /// When there is an output of this name already.
    #[must_use]
    pub fn output<M: Message>(
        mut self,
        name: &'static str,
        find: fn(&mut S) -> &mut Output<M>,
    ) -> Self {
        let port = declare::<M>(&mut self.outputs, name);
        self.finds.push((port, Box::new(move |state| find(state))));
        self
    }

    /// Calls `call` on the grid `start + n * period`, the first time at the start. A late call stands
    /// for the newest grid point that is due, and says how many it passed over.
    ///
    /// # Panics
    /// When `period` is zero.
    #[must_use]
    pub fn every(
        mut self,
        period: Duration,
        call: impl Fn(&mut S, Instant, Tick) + 'static,
    ) -> Self {
        self.periods.push(Period {
            timer: PeriodicTimer::new(period),
            call: Box::new(move |state, now, tick, _emit| call(state, now, tick)),
        });
        self
    }

    /// Publishes on the channel `name` what `make` returns, on the grid of [`Component::every`].
    ///
    /// # Panics
    /// When there is an output of this name already, or `period` is zero.
    #[must_use]
    pub fn publish<M: Message>(
        mut self,
        name: &'static str,
        period: Duration,
        make: impl Fn(&mut S, Instant, Tick) -> M + 'static,
    ) -> Self {
        let port = declare::<M>(&mut self.outputs, name);
        self.periods.push(Period {
            timer: PeriodicTimer::new(period),
            call: Box::new(move |state, now, tick, emit| {
                emit(port, bytemuck::bytes_of(&make(state, now, tick)));
            }),
        });
        self
    }

    /// Calls `start` once before the first message and tick; periods begin at its time too.
    ///
    /// # Panics
    /// When there is a start already.
    #[must_use]
    pub fn start(mut self, start: fn(&mut S, Instant)) -> Self {
        assert!(self.start.is_none(), "a component declares its start twice");
        self.start = Some(start);
        self
    }

    /// Calls the timer when it is due, beside the periods.
    ///
    /// # Panics
    /// When there is a timer already.
    #[must_use]
    pub fn timer(mut self, timer: Timer<S>) -> Self {
        assert!(self.timer.is_none(), "a component declares its timer twice");
        self.timer = Some(timer);
        self
    }

    /// Hides the types of state and messages, with room in the output ports.
    pub fn into_role(mut self) -> Box<dyn Role> {
        for (_, find) in &self.finds {
            find(&mut self.state).reserve();
        }
        Box::new(self)
    }
}

fn declare<M: Message>(ports: &mut Vec<Port>, name: &'static str) -> usize {
    let is_new = ports.iter().all(|port| port.name != name);
    assert!(is_new, "a component declares its port {name} twice");
    let message = MessageType::of::<M>();
    ports.push(Port { name, message });
    ports.len() - 1
}

impl<S: Debug> Debug for Component<S> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut all = formatter.debug_struct("Component");
        all.field("state", &self.state)
            .field("inputs", &self.inputs)
            .field("outputs", &self.outputs);
        all.finish_non_exhaustive()
    }
}

/// An output port whose message type is no longer known.
trait AnyOutput {
    fn reserve(&mut self);
    /// Gives all messages to `emit` as those of `port`; returns how many were dropped before.
    fn flush(&mut self, port: usize, emit: Emit<'_>) -> u64;
}

impl<M: Message> AnyOutput for Output<M> {
    fn reserve(&mut self) {
        self.messages.reserve_exact(Self::CAPACITY);
    }

    fn flush(&mut self, port: usize, emit: Emit<'_>) -> u64 {
        for message in &self.messages {
            emit(port, bytemuck::bytes_of(message));
        }
        self.messages.clear();
        core::mem::take(&mut self.dropped_count)
    }
}

/// Receives one outgoing payload: output port and bytes.
pub type Emit<'a> = &'a mut dyn FnMut(usize, &[u8]);

/// A component whose message types are known only at run time: what a process runs and what the
/// simulation drives. Made by [`Component::into_role`].
pub trait Role: Debug {
    /// The input ports.
    fn inputs(&self) -> &[Port];

    /// The output ports.
    fn outputs(&self) -> &[Port];

    /// See [`Component::start`]; what it gives stays in its ports until [`Role::flush`].
    fn start(&mut self, now: Instant);

    /// Takes out what the output ports hold.
    fn flush(&mut self, emit: Emit<'_>);

    /// Hands over a message that came in through the input port `port`. False when `payload` is not a
    /// message of the port, or there is no such port; the component does not see it then.
    fn message(&mut self, now: Instant, port: usize, payload: &[u8], emit: Emit<'_>) -> bool;

    /// Calls what is due, see [`Role::next_tick`].
    fn tick(&mut self, now: Instant, emit: Emit<'_>);

    /// When the role next wants [`Role::tick`]; `None` if only messages drive it.
    fn next_tick(&self) -> Option<Instant>;

    /// Grid points of periods and timers that passed without a tick.
    fn skipped_ticks(&self) -> u64;

    /// Messages refused by full output ports.
    fn outbox_dropped(&self) -> u64;
}

impl dyn Role + '_ {
    /// [`Role::message`] by the port's name, for who drives a role without channels.
    ///
    /// # Panics
    /// When the role has no such port, or one of another type.
    pub fn hear<M: Message>(&mut self, now: Instant, port: &str, message: &M, emit: Emit<'_>) {
        let index = index_of(self.inputs(), port);
        let (expected, found) = (self.inputs()[index].message, MessageType::of::<M>());
        assert!(expected == found, "{port} takes {expected}, not {found}");
        self.message(now, index, bytemuck::bytes_of(message), emit);
    }

    /// The number by which the output port called `name` emits.
    ///
    /// # Panics
    /// When the role has no such port.
    pub fn output(&self, name: &str) -> usize {
        index_of(self.outputs(), name)
    }
}

fn index_of(ports: &[Port], name: &str) -> usize {
    let index = ports.iter().position(|port| port.name == name);
    index.unwrap_or_else(|| panic!("no port is called {name}"))
}

impl<S: Debug + 'static> Role for Component<S> {
    fn inputs(&self) -> &[Port] {
        &self.inputs
    }

    fn outputs(&self) -> &[Port] {
        &self.outputs
    }

    fn flush(&mut self, emit: Emit<'_>) {
        for (port, find) in &self.finds {
            self.dropped_count += find(&mut self.state).flush(*port, emit);
        }
    }

    fn start(&mut self, now: Instant) {
        if let Some(start) = self.start {
            start(&mut self.state, now);
        }
        for period in &mut self.periods {
            period.timer.start(now);
        }
    }

    fn message(&mut self, now: Instant, port: usize, payload: &[u8], emit: Emit<'_>) -> bool {
        let take = self.takes.get(port);
        let is_taken = take.is_some_and(|take| take(&mut self.state, now, payload));
        self.flush(emit);
        is_taken
    }

    fn tick(&mut self, now: Instant, emit: Emit<'_>) {
        if let Some(timer) = &self.timer {
            (timer.tick)(&mut self.state, now);
        }
        for Period { timer, call } in &mut self.periods {
            if let Some(tick) = timer.poll(now) {
                call(&mut self.state, now, tick, emit);
            }
        }
        self.flush(emit);
    }

    fn next_tick(&self) -> Option<Instant> {
        let periods = self.periods.iter();
        let ticks = periods.filter_map(|period| period.timer.next());
        let own = self
            .timer
            .as_ref()
            .and_then(|timer| (timer.next)(&self.state));
        ticks.chain(own).min()
    }

    fn skipped_ticks(&self) -> u64 {
        let periods = self.periods.iter();
        let skipped = periods.map(|period| period.timer.skipped_total());
        let own = self
            .timer
            .as_ref()
            .map_or(0, |timer| (timer.skipped)(&self.state));
        skipped.sum::<u64>() + own
    }

    fn outbox_dropped(&self) -> u64 {
        self.dropped_count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    crate::message! {
        struct Small = "test.Small.v1" { value: u32, spare: [u32; 3] }
        struct Large = "test.Large.v1" { value: [f64; 3] }
    }

    fn small_of(value: u32) -> Small {
        Small {
            value,
            spare: [0; 3],
        }
    }

    /// Hears both messages, repeats the number of each call, and floods one port.
    #[derive(Debug, Default)]
    struct Both {
        small: Output<Small>,
        large: Output<Large>,
    }

    impl Both {
        fn role() -> Box<dyn Role> {
            Component::of(Self::default())
                .input("a/small", Self::on_small)
                .input("a/large", Self::on_large)
                .output("b/small", |own| &mut own.small)
                .output("b/large", |own| &mut own.large)
                .every(Duration::from_nanos(10), Self::on_short)
                .every(Duration::from_nanos(25), Self::on_long)
                .into_role()
        }

        fn on_small(&mut self, _: Instant, message: &Small) {
            self.small.send(*message);
        }

        fn on_large(&mut self, _: Instant, message: &Large) {
            for _ in 0..OUTPUT_CAPACITY + 3 {
                self.large.send(*message);
            }
        }

        fn on_short(&mut self, _: Instant, _: Tick) {
            self.small.send(small_of(10));
        }

        fn on_long(&mut self, _: Instant, tick: Tick) {
            let value = u32::try_from(tick.index).unwrap();
            self.small.send(small_of(value));
        }
    }

    fn emitted(call: impl FnOnce(Emit<'_>)) -> Vec<(usize, Vec<u8>)> {
        let mut all = Vec::new();
        call(&mut |port, bytes: &[u8]| all.push((port, bytes.to_vec())));
        all
    }

    #[test]
    fn a_message_goes_to_the_method_of_its_port_and_a_wrong_size_to_none() {
        let mut role = Both::role();
        let small = small_of(7);
        let bytes = bytemuck::bytes_of(&small);
        let said = emitted(|emit| assert!(role.message(Instant::ZERO, 0, bytes, emit)));
        assert_eq!(said, [(0, bytes.to_vec())]);
        for (port, payload) in [(1, bytes), (2, bytes), (0, &[0; 24][..])] {
            let said = emitted(|emit| assert!(!role.message(Instant::ZERO, port, payload, emit)));
            assert!(said.is_empty());
        }
        let said = emitted(|emit| role.hear(Instant::ZERO, "a/small", &small, emit));
        assert_eq!(said.len(), 1);
    }

    #[test]
    fn a_full_port_drops_and_counts() {
        let mut role = Both::role();
        let large = Large { value: [1.0; 3] };
        for calls in 1..3 {
            let said = emitted(|emit| role.hear(Instant::ZERO, "a/large", &large, emit));
            assert_eq!(said.len(), OUTPUT_CAPACITY);
            assert!(said.iter().all(|one| one.0 == 1));
            assert_eq!(role.outbox_dropped(), calls * 3);
        }
    }

    #[test]
    fn a_port_of_large_messages_has_room_for_fewer() {
        assert_eq!(Output::<[u8; 64]>::CAPACITY, 256);
        assert_eq!(Output::<[u8; 100_000]>::CAPACITY, 10);
        assert_eq!(Output::<[u8; 4 << 20]>::CAPACITY, 2);
    }

    /// Says hello when it starts.
    #[derive(Debug, Default)]
    struct Greeter {
        said: Output<Small>,
    }

    #[test]
    fn what_a_component_sends_when_it_starts_leaves_at_once() {
        let mut role = Component::of(Greeter::default())
            .output("b/small", |own| &mut own.said)
            .start(|own, _| own.said.send(small_of(1)))
            .into_role();
        role.start(Instant::ZERO);
        assert_eq!(emitted(|emit| role.flush(emit)).len(), 1);
        assert!(emitted(|emit| role.flush(emit)).is_empty());
    }

    #[test]
    fn a_period_publishes_without_a_port_of_the_state() {
        let mut role = Component::of(7)
            .input("a/small", |own, _, heard: &Small| *own += heard.value)
            .publish("b/large", Duration::from_nanos(10), |own, _, tick| Large {
                value: [f64::from(*own), tick.index as f64, 0.0],
            })
            .into_role();
        role.start(Instant::ZERO);
        let small = small_of(3);
        let said = emitted(|emit| role.hear(Instant::ZERO, "a/small", &small, emit));
        assert!(said.is_empty());
        let said = emitted(|emit| role.tick(Instant::from_ns(20), emit));
        let large = Large {
            value: [10.0, 2.0, 0.0],
        };
        assert_eq!(said, [(0, bytemuck::bytes_of(&large).to_vec())]);
        assert_eq!(role.skipped_ticks(), 2);
    }

    #[test]
    fn a_port_of_a_role_never_grows() {
        let mut port = Output::default();
        port.reserve();
        let room = port.messages.capacity();
        for _ in 0..2 {
            for value in 0..2 * OUTPUT_CAPACITY {
                port.send(small_of(u32::try_from(value).unwrap()));
            }
            let dropped_count = port.flush(0, &mut |_, _| {});
            assert_eq!(dropped_count, OUTPUT_CAPACITY as u64);
            assert_eq!(port.messages.capacity(), room);
        }
    }

    #[test]
    fn periods_are_called_on_their_grids_from_the_start_and_skipped_points_counted() {
        let mut role = Both::role();
        assert_eq!(role.next_tick(), None);
        role.start(Instant::from_ns(100));
        assert_eq!(role.next_tick(), Some(Instant::from_ns(100)));
        assert_eq!(
            emitted(|emit| role.tick(Instant::from_ns(100), emit)).len(),
            2
        );
        assert_eq!(role.next_tick(), Some(Instant::from_ns(110)));
        let said = emitted(|emit| role.tick(Instant::from_ns(152), emit));
        let small = |value| (0, bytemuck::bytes_of(&small_of(value)).to_vec());
        assert_eq!(said, [small(10), small(2)]);
        assert_eq!(role.skipped_ticks(), 4 + 1);
        assert_eq!(role.next_tick(), Some(Instant::from_ns(160)));
    }

    #[test]
    #[should_panic(expected = "declares its port a/small twice")]
    fn a_port_of_one_side_is_declared_once() {
        let _refused = Component::of(Both::default())
            .input("a/small", Both::on_small)
            .output("a/small", |own| &mut own.small)
            .input("a/small", Both::on_small);
    }

    #[test]
    #[should_panic(expected = "declares its start twice")]
    fn a_start_is_declared_once() {
        let _refused = Component::of(0.0).start(|_, _| {}).start(|_, _| {});
    }

    #[test]
    #[should_panic(expected = "declares its timer twice")]
    fn a_timer_is_declared_once() {
        let timer = || Timer {
            next: |_| None,
            tick: |_, _| {},
            skipped: |_| 0,
        };
        let _refused = Component::of(0.0).timer(timer()).timer(timer());
    }
}
