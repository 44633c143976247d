//! One run in virtual time, bare: the real controller of the right arm, the commands of a whole run
//! and a channel between them. It records nothing but what the tables need; a test holds it
//! against the simulation of the whole case.

use core::time::Duration;

use crate::experiment::trajectory::{Trajectory, requested};
use crate::score::loops::{Evidence, Loops, LostByKind, PauseAfter};
use hil_arm::egm::controller::Controller;
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EgmStartParameters, EndCause, SessionState};
use hil_arm::egm::parameters::ControllerSettings;
use hil_arm::yumi::arm::Arm;
use hil_core::link_model::{LinkModel, PerfectLink};
use hil_core::random::RandomStream;
use hil_core::simulation::{Due, Medium, Model, Network, Observe, Simulation};
use hil_core::study::Watch;
use hil_core::time::{Instant, duration_ns};
use hil_link::outages::{OutageLink, Outages};
use hil_link::spec::{LinkPlace, LinkSpec, Way};
use hil_link::wifi::{WifiLink, WifiPreset};
use hil_stats::series::Sample;

/// What lies between controller and robot, both ways.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Channel {
    /// Nothing.
    Perfect,
    /// Independent losses of this ratio.
    Loss(f64),
    /// Outages of both ways together.
    Outages(Outages),
    /// The Wi-Fi 6 model, both ways in the same fades and outages.
    Wifi(WifiPreset),
}

/// When commands are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sending {
    /// One per frame.
    Frame,
    /// One per feedback that arrives.
    Coupled,
    /// Every so many nanoseconds.
    Free(i64),
}

/// All that sets one run apart from another, but for its seed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Setup {
    pub(crate) settings: ControllerSettings,
    pub(crate) channel: Channel,
    pub(crate) sending: Sending,
    /// How long an idle arm waits for the next request.
    pub(crate) trigger_after_ns: i64,
}

/// What a run came to.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Tally {
    pub(crate) sent_count: u64,
    pub(crate) executed_count: u64,
    pub(crate) extra_count: u64,
    pub(crate) lost_counts: LostByKind,
    /// Which loops were lost.
    pub(crate) lost: Vec<usize>,
    pub(crate) trip_count: u64,
    pub(crate) hours: f64,
    /// Share of the time held while a session ran.
    pub(crate) hold_ratio: f64,
}

impl Tally {
    /// The motion loss rate.
    pub(crate) fn loss_ratio(&self) -> f64 {
        let sent = self.sent_count as f64;
        (sent - self.executed_count as f64) / sent
    }

    /// Loops missing from the executed ones.
    pub(crate) fn missing_count(&self) -> u64 {
        self.sent_count.saturating_sub(self.executed_count)
    }
}

/// Between two measurements of the tool.
const SAMPLE_NS: i64 = 16_000_000;
/// Looks at how far a run has come.
const LOOK_COUNT: i64 = 64;

/// Runs `setup` with the channel that `seed` makes; `None` when `watch` said stop.
pub(crate) fn drive(
    trajectory: &Trajectory,
    setup: &Setup,
    seed: u64,
    watch: Watch<'_>,
) -> Option<Tally> {
    let end_ns = trajectory.end.as_ns();
    let network = Links {
        forward: link(setup.channel, seed, Way::Forward),
        backward: link(setup.channel, seed, Way::Backward),
    };
    let mut simulation = Simulation::of(Run::new(trajectory, setup), network);
    for look in 0..LOOK_COUNT {
        if !watch(look as f64 / LOOK_COUNT as f64) {
            return None;
        }
        // A cycle at the very end belongs to the run.
        let until_ns = end_ns / LOOK_COUNT * (look + 1) + end_ns % LOOK_COUNT + 1;
        simulation.run_until(Instant::from_ns(until_ns), &mut ());
    }
    Some(simulation.into_model().tally(end_ns))
}

/// A run under way: the arm, and who commands it.
#[derive(Debug)]
struct Run<'a> {
    trajectory: &'a Trajectory,
    setup: &'a Setup,
    arm: Controller,
    next_cycle: Instant,
    /// When the next command is sent on a grid; `None` when feedback is answered.
    next_send: Option<Instant>,
    send_period: Duration,
    idle_since: Option<Instant>,
    happened: Happened,
    /// Where the tool is, now and then.
    moved: Vec<Sample>,
    tool: Arm,
}

/// What passes between controller and arm.
#[derive(Debug, Clone, Copy)]
enum Message {
    /// The command of the trajectory at this instant, when it was sent.
    Command(Instant),
    Feedback,
}

/// What comes first of several things at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Rank {
    Cycle,
    Send,
    Arrival,
}

/// Both ways between controller and arm.
#[derive(Debug)]
struct Links {
    forward: Box<dyn LinkModel>,
    backward: Box<dyn LinkModel>,
}

impl Network<Message> for Links {
    fn offer(
        &mut self,
        now: Instant,
        message: &Message,
        mut deliver: impl FnMut(Instant, Message),
    ) {
        let link = match message {
            Message::Command(_) => &mut self.forward,
            Message::Feedback => &mut self.backward,
        };
        for at in link.offer(now, MESSAGE_BYTES).arrivals() {
            deliver(at, *message);
        }
    }
}

impl<'a> Run<'a> {
    /// The robot's first cycle is done, and guided motion is asked for.
    fn new(trajectory: &'a Trajectory, setup: &'a Setup) -> Self {
        let send_period_ns = match setup.sending {
            Sending::Frame => Some(trajectory.frame_ns),
            Sending::Free(period_ns) => Some(period_ns),
            Sending::Coupled => None,
        };
        let begin = Instant::from_ns(trajectory.begin_ns());
        Self {
            arm: requested(&setup.settings),
            next_cycle: Instant::ZERO + setup.settings.cycle,
            next_send: send_period_ns.map(|_| begin),
            send_period: Duration::from_nanos(send_period_ns.unwrap_or(0).unsigned_abs()),
            idle_since: None,
            happened: Happened {
                evidence: Evidence {
                    pause_began: Some((0, PauseAfter::Start)),
                    ..Evidence::default()
                },
                ..Happened::default()
            },
            moved: Vec::new(),
            tool: Arm::right(),
            trajectory,
            setup,
        }
    }

    /// The motion client's part: an arm that went idle is asked to start again.
    fn trigger(&mut self, at: Instant) {
        if self.arm.state() != SessionState::Idle {
            self.idle_since = None;
            return;
        }
        let since = *self.idle_since.get_or_insert(at);
        // Before its first session the arm is asked for already.
        if at.ns_since(since) >= self.setup.trigger_after_ns {
            let asked = self.arm.start_guided_motion(&EgmStartParameters::KEEP);
            self.idle_since = asked.err().map(|_| at);
        }
    }

    fn tally(mut self, end_ns: i64) -> Tally {
        self.happened.finish(end_ns);
        let trajectory = self.trajectory;
        let loops = trajectory
            .counter
            .count_peaks(&trajectory.sent_peaks_ns, &self.moved)
            .expect("a trajectory is as long as its loops");
        self.happened.tally(trajectory, &loops, end_ns)
    }
}

impl Model for Run<'_> {
    type Message = Message;
    type Record = ();
    type Network = Links;
    type Rank = Rank;

    fn rank(_message: &Message) -> Rank {
        Rank::Arrival
    }

    fn start<O: Observe<Self>>(&mut self, _medium: &mut Medium<'_, Self, O>) {}

    fn next(&self) -> Option<Due<Rank>> {
        let cycle = Due {
            at: self.next_cycle,
            rank: Rank::Cycle,
        };
        let rank = Rank::Send;
        let send = self.next_send.map(|at| Due { at, rank });
        Some(send.map_or(cycle, |send| cycle.min(send)))
    }

    fn advance<O: Observe<Self>>(&mut self, rank: Rank, medium: &mut Medium<'_, Self, O>) {
        let now = medium.now;
        if rank == Rank::Send {
            medium.send(&Message::Command(now));
            self.next_send = Some(now + self.send_period);
            return;
        }
        let happened = &mut self.happened;
        self.arm.cycle(now, &mut |event| happened.note(&event));
        happened.note_throttle(now.as_ns(), self.arm.is_throttled());
        if self.setup.sending == Sending::Coupled {
            medium.send(&Message::Feedback);
        }
        self.trigger(now);
        self.next_cycle = now + self.setup.settings.cycle;
        let cycle_ns = duration_ns(self.setup.settings.cycle);
        let stride = (SAMPLE_NS / cycle_ns).max(1);
        if now.as_ns() / cycle_ns % stride == 0 {
            let tool = self.tool.tool(self.arm.measured_rad());
            self.moved.push((now.as_ns(), tool.translation.y));
        }
    }

    fn receive<O: Observe<Self>>(&mut self, message: Message, medium: &mut Medium<'_, Self, O>) {
        match message {
            Message::Command(sent) => {
                if let Some(command) = self.trajectory.at(sent) {
                    // A refusal is the arm's answer; no client listens.
                    let _refused = self.arm.receive(medium.now, command).is_err();
                }
            }
            Message::Feedback => medium.send(&Message::Command(medium.now)),
        }
    }
}

/// A command or a feedback of one arm with our datagram's header; only the radio looks at it.
const MESSAGE_BYTES: usize = 100;

/// One direction; outages of both directions come from one stream.
fn link(channel: Channel, seed: u64, way: Way) -> Box<dyn LinkModel> {
    let direction = match way {
        Way::Forward => "commands",
        Way::Backward => "feedback",
    };
    match channel {
        Channel::Perfect => Box::new(PerfectLink),
        Channel::Loss(ratio) => {
            let link = LinkSpec::fixed(Duration::ZERO, ratio);
            link.build(&LinkPlace::alone(seed, direction))
                .expect("conditions name ratios")
        }
        Channel::Outages(outages) => {
            let stream = RandomStream::new(seed, OUTAGE_STREAM);
            let link = OutageLink::new(outages, stream, Instant::ZERO);
            Box::new(link.expect("outages are checked before they are driven"))
        }
        Channel::Wifi(preset) => {
            let (own, shared) = (
                RandomStream::new(seed, direction),
                RandomStream::new(seed, RADIO_STREAM),
            );
            let link = WifiLink::new(&preset.spec(), way, own, shared);
            Box::new(link.expect("presets are sound"))
        }
    }
}

/// Name of the stream of outages.
pub(crate) const OUTAGE_STREAM: &str = "outages";
/// Name of the stream of what both ways of a radio meet.
const RADIO_STREAM: &str = "radio";

/// What the arm told.
#[derive(Debug, Default)]
struct Happened {
    evidence: Evidence,
    trip_count: u64,
    running_began_ns: Option<i64>,
    running_ns: i64,
}

impl Happened {
    #[inline]
    fn note(&mut self, event: &EgmEvent) {
        const RUNNING: u32 = EgmEventKind::Running as u32;
        const ENDED: u32 = EgmEventKind::Ended as u32;
        const HOLD_BEGAN: u32 = EgmEventKind::HoldBegan as u32;
        const HOLD_ENDED: u32 = EgmEventKind::HoldEnded as u32;
        let evidence = &mut self.evidence;
        match event.kind {
            RUNNING => {
                evidence.end_pause(event.at_ns);
                self.running_began_ns = Some(event.at_ns);
            }
            ENDED => {
                evidence.end_hold(event.at_ns);
                let cause = EndCause::from_number(event.cause);
                evidence.pause_began = Some((event.at_ns, PauseAfter::Session(cause)));
                self.trip_count += 1;
                self.end_running(event.at_ns);
            }
            HOLD_BEGAN => evidence.hold_began_ns = Some(event.at_ns),
            HOLD_ENDED => evidence.end_hold(event.at_ns),
            _ => {}
        }
    }

    #[inline]
    fn note_throttle(&mut self, at_ns: i64, is_throttled: bool) {
        if is_throttled {
            self.evidence.throttle_began_ns.get_or_insert(at_ns);
        } else {
            self.evidence.end_throttle(at_ns);
        }
    }

    fn end_running(&mut self, end_ns: i64) {
        if let Some(begin_ns) = self.running_began_ns.take() {
            self.running_ns += end_ns - begin_ns;
        }
    }

    fn finish(&mut self, end_ns: i64) {
        self.evidence.end_throttle(end_ns);
        self.evidence.end_hold(end_ns);
        self.evidence.end_pause(end_ns);
        self.end_running(end_ns);
    }

    fn tally(&self, trajectory: &Trajectory, loops: &Loops, end_ns: i64) -> Tally {
        let holds = self.evidence.holds.iter();
        let held_ns: i64 = holds.map(|hold| hold.end_ns - hold.begin_ns).sum();
        Tally {
            sent_count: loops.sent_count() as u64,
            executed_count: loops.executed_count as u64,
            extra_count: loops.extra_count as u64,
            lost_counts: (self.evidence).lost_by_kind(loops, trajectory.counter.period_ns),
            lost: loops.lost.iter().map(|lost| lost.index).collect(),
            trip_count: self.trip_count,
            hours: end_ns as f64 / 3.6e12,
            hold_ratio: held_ns as f64 / self.running_ns.max(1) as f64,
        }
    }
}
