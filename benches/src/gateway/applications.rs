//! Application to application as in a run: every application and every gateway direction has a
//! thread of its own and waits in its own way. The near application is the calling thread.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle, Thread};
use std::time::Duration;

use hil_core::endpoint::InputPort;
use hil_core::message::Envelope;
use hil_core::time::Instant;
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::domain_address::DomainAddress;
use hil_platform::wait::{Pause, WaitMode, WaitStrategy};

use super::hosts::{Joint, Loose, Plan, Ports, SetupError, greet};
use super::parties::{Party, Usage, claim};
use super::turns::{IDLE, STOP, Turns};

/// Threads that take part in one round trip: two applications, four gateway directions.
pub const PARTY_COUNT: usize = 6;
/// Round trips at the start of a slice that do not count: hybrid waiting learns the period.
const WARM_UP: u64 = 20;
const PATIENCE: Duration = Duration::from_millis(100);

/// An application that waits as the product's components do.
struct Application {
    ports: Ports,
    wait: WaitStrategy,
    payload: Vec<u8>,
    /// From the gateway's publication to here, one entry per message.
    woken_after_ns: Vec<u64>,
}

impl Application {
    fn send(&mut self) {
        let now = MonotonicClock::now();
        // A failure shows as a message that does not come.
        self.ports.output.publish(now, &self.payload).ok();
    }

    /// Takes a waiting message, or else waits once.
    fn receive(&mut self) -> Option<u64> {
        let Self {
            ports,
            wait,
            payload,
            woken_after_ns,
        } = self;
        let mut take = |envelope: &Envelope, bytes: &[u8]| {
            let taken = MonotonicClock::now();
            wait.on_arrival(taken);
            payload.copy_from_slice(bytes);
            let waited = taken.ns_since(Instant::from_ns(envelope.forwarded_ns));
            if let Ok(waited) = u64::try_from(waited)
                && woken_after_ns.len() < woken_after_ns.capacity()
            {
                woken_after_ns.push(waited);
            }
        };
        if ports.input.receive(Instant::ZERO, &mut take).ok()? {
            return payload.first_chunk().map(|head| u64::from_le_bytes(*head));
        }
        match (wait.pause(MonotonicClock::now(), None), &mut ports.waiter) {
            (Pause::Sleep(until), Some(waiter)) => {
                waiter.wait_until(Some(until)).ok()?;
            }
            _ => wait.spin(),
        }
        None
    }
}

/// The threads of one case, asleep while it is not their turn.
#[derive(Debug)]
pub struct PartyGroup {
    plan: Plan,
    case: usize,
    turns: Arc<Turns>,
    near: NearApplication,
    threads: Vec<Thread>,
    handles: Vec<JoinHandle<()>>,
    parties: Vec<(Party, Usage)>,
    active: Arc<AtomicUsize>,
    far_woken: Arc<Mutex<Vec<u64>>>,
    count: u64,
    round_trips: u64,
}

struct NearApplication(Application);

impl core::fmt::Debug for NearApplication {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_tuple("NearApplication").finish_non_exhaustive()
    }
}

/// What the thread of one party needs.
struct Berth {
    name: &'static str,
    cpu: usize,
    case: usize,
    turns: Arc<Turns>,
    active: Arc<AtomicUsize>,
    ready: Sender<Result<Party, String>>,
}

impl Berth {
    /// Works whenever it is the case's turn; `work` does one bounded piece.
    fn live(&self, mut work: impl FnMut()) {
        loop {
            match self.turns.now() {
                STOP => return,
                case if case == self.case => {
                    self.active.fetch_add(1, Ordering::AcqRel);
                    while self.turns.now() == self.case {
                        work();
                    }
                    self.active.fetch_sub(1, Ordering::AcqRel);
                }
                _ => thread::park(),
            }
        }
    }
}

impl PartyGroup {
    /// Starts the threads of `joints` and waits until the gateways have greeted each other. With
    /// fewer than [`PARTY_COUNT`] processors each host has one.
    ///
    /// # Errors
    /// When a channel or thread cannot be had.
    pub fn start(
        joints: [Joint; 2],
        case: usize,
        turns: &Arc<Turns>,
        cpu_count: usize,
    ) -> Result<Self, SetupError> {
        let plan = joints[0].plan;
        let near = Opening::of(&joints[0]).open()?;
        let (ready, answers) = channel();
        let active = Arc::new(AtomicUsize::new(0));
        let far_woken = Arc::default();
        let remaining = Arc::new(AtomicUsize::new(2));
        let cpu = |host: usize, own: usize| if cpu_count < PARTY_COUNT { host } else { own };
        let berth = |name, cpu| Berth {
            name,
            cpu,
            case,
            turns: Arc::clone(turns),
            active: Arc::clone(&active),
            ready: ready.clone(),
        };
        let mut handles = vec![far_application(
            berth("far application", cpu(1, 1)),
            &joints[1],
            Arc::clone(&far_woken),
        )];
        let names = [
            ["near egress", "near ingress"],
            ["far egress", "far ingress"],
        ];
        for ((host, joint), names) in joints.into_iter().enumerate().zip(names) {
            for ((slot, loose), name) in joint.split().into_iter().enumerate().zip(names) {
                let own = berth(name, cpu(host, 2 + 2 * host + slot));
                handles.push(gateway(own, loose, Arc::clone(&remaining)));
            }
        }
        drop(ready);
        let mut parties = vec![(Party::myself("near application"), Usage::default())];
        for answer in answers.iter().take(handles.len()) {
            parties.push((answer?, Usage::default()));
        }
        Ok(Self {
            plan,
            case,
            turns: Arc::clone(turns),
            near: NearApplication(near),
            threads: handles
                .iter()
                .map(|handle| handle.thread().clone())
                .collect(),
            handles,
            parties,
            active,
            far_woken,
            count: 0,
            round_trips: 0,
        })
    }

    /// The plan it runs.
    pub const fn plan(&self) -> Plan {
        self.plan
    }

    /// Round trips for `slice`, one after the other or one every `period`.
    pub fn round(&mut self, slice: Duration, period: Option<Duration>) -> Vec<u64> {
        self.turns.give(self.case, &self.threads);
        let mut samples = Vec::with_capacity(1 << 16);
        let mut due = MonotonicClock::now();
        for _ in 0..WARM_UP {
            due = wait_for_tick(due, period);
            self.round_trip();
        }
        let before: Vec<_> = self.parties.iter().map(|(party, _)| party.used()).collect();
        let end = MonotonicClock::now() + slice;
        while MonotonicClock::now() < end {
            due = wait_for_tick(due, period);
            let sent = MonotonicClock::now();
            if self.round_trip() {
                let elapsed = MonotonicClock::now().ns_since(sent);
                samples.push(u64::try_from(elapsed).unwrap_or(0));
            }
            self.round_trips += 1;
        }
        for ((party, usage), before) in self.parties.iter_mut().zip(before) {
            usage.add(before, party.used());
        }
        self.turns.give(IDLE, &[]);
        while self.active.load(Ordering::Acquire) > 0 {
            thread::sleep(Duration::from_millis(1));
        }
        samples
    }

    fn round_trip(&mut self) -> bool {
        let near = &mut self.near.0;
        self.count += 1;
        near.payload[..8].copy_from_slice(&self.count.to_le_bytes());
        near.send();
        let give_up = MonotonicClock::now() + PATIENCE;
        loop {
            match near.receive() {
                Some(count) if count == self.count => return true,
                _ if MonotonicClock::now() > give_up => return false,
                _ => {}
            }
        }
    }

    /// Each party with what it used, and round trips done meanwhile.
    pub fn usage(&self) -> (&[(Party, Usage)], u64) {
        (&self.parties, self.round_trips)
    }

    /// Ends the threads; gives, for both ends, how long after the gateway's publication the
    /// application had each message.
    pub fn finish(self) -> [Vec<u64>; 2] {
        self.turns.give(STOP, &self.threads);
        for handle in self.handles {
            // A panic has printed itself.
            handle.join().ok();
        }
        let mut far = self
            .far_woken
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        [self.near.0.woken_after_ns, core::mem::take(&mut *far)]
    }
}

fn wait_for_tick(due: Instant, period: Option<Duration>) -> Instant {
    let Some(period) = period else { return due };
    while MonotonicClock::sleep_until(due) == Wake::Interrupted {}
    // A tick that was overslept by much is skipped, not made up for.
    (due + period).max(MonotonicClock::now())
}

fn far_application(berth: Berth, joint: &Joint, woken: Arc<Mutex<Vec<u64>>>) -> JoinHandle<()> {
    let opening = Opening::of(joint);
    thread::spawn(move || {
        claim(berth.cpu);
        match opening.open() {
            Ok(mut application) => {
                berth.ready.send(Ok(Party::myself(berth.name))).ok();
                berth.live(|| {
                    if application.receive().is_some() {
                        application.send();
                    }
                });
                let mut woken = woken.lock().unwrap_or_else(PoisonError::into_inner);
                *woken = application.woken_after_ns;
            }
            Err(error) => drop(berth.ready.send(Err(error.to_string()))),
        }
    })
}

/// What an application is opened from, in its own thread: ports cannot travel.
struct Opening {
    address: DomainAddress,
    plan: Plan,
    host: usize,
}

impl Opening {
    fn of(joint: &Joint) -> Self {
        Self {
            address: joint.address.clone(),
            plan: joint.plan,
            host: joint.host,
        }
    }

    fn open(&self) -> Result<Application, SetupError> {
        let sleeps = self.plan.wait != WaitMode::Spin;
        Ok(Application {
            ports: Ports::open(&self.address, &self.plan, self.host, sleeps)?,
            wait: WaitStrategy::new(self.plan.wait, None),
            payload: vec![0; self.plan.size_bytes],
            woken_after_ns: Vec::with_capacity(1 << 20),
        })
    }
}

fn gateway(berth: Berth, loose: Loose, remaining: Arc<AtomicUsize>) -> JoinHandle<()> {
    thread::spawn(move || {
        claim(berth.cpu);
        let connected = loose.connect().and_then(|(launch, mut direction)| {
            greet(&mut [(&launch, &mut direction)], &remaining)?;
            Ok(direction)
        });
        match connected {
            Ok(mut direction) => {
                berth.ready.send(Ok(Party::myself(berth.name))).ok();
                // What the direction's own thread does, but for as long as it is our turn.
                berth.live(|| {
                    if matches!(direction.step(), Ok(false)) {
                        direction.rest().ok();
                    }
                });
            }
            Err(error) => drop(berth.ready.send(Err(error.to_string()))),
        }
    })
}
