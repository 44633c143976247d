//! One run in virtual time, bare: the real controller of the right arm, the commands of a whole run
//! and a channel between them, cycle by cycle. It records nothing but what the tables need; a
//! test holds it against the simulation of the whole case.

use std::collections::VecDeque;

use crate::experiment::trajectory::{Trajectory, requested};
use crate::score::loops::{Evidence, Loops, LossCause, Pause, PauseAfter, Span};
use hil_arm::egm::controller::Controller;
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EgmStartParameters, EndCause, SessionState};
use hil_arm::egm::parameters::ControllerSettings;
use hil_arm::yumi::arm::Arm;
use hil_core::link_model::{Fate, LinkModel, PerfectLink};
use hil_core::random::RandomStream;
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
    /// Lost loops by [`LossCause::kind`].
    pub(crate) lost_counts: [u64; LossCause::KIND_COUNT],
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
    let cycle_ns = duration_ns(setup.settings.cycle);
    let end_ns = trajectory.end.as_ns();
    let stride = (SAMPLE_NS / cycle_ns).max(1);
    let look = (end_ns / cycle_ns / LOOK_COUNT).max(1);
    let mut run = Run::new(trajectory, setup, seed);
    let capacity = usize::try_from(end_ns / cycle_ns / stride + 1).unwrap_or(0);
    let mut moved: Vec<Sample> = Vec::with_capacity(capacity);
    let tool = Arm::right();
    let mut cycle = 1;
    while cycle * cycle_ns <= end_ns {
        let at_ns = cycle * cycle_ns;
        run.cycle(Instant::from_ns(at_ns));
        if cycle % stride == 0 {
            moved.push((at_ns, tool.tool(run.arm.measured_rad()).translation.y));
        }
        if cycle % look == 0 && !watch(at_ns as f64 / end_ns as f64) {
            return None;
        }
        cycle += 1;
    }
    run.happened.finish(end_ns);
    let loops = trajectory
        .counter
        .count_peaks(&trajectory.sent_peaks_ns, &moved)
        .expect("a trajectory is as long as its loops");
    Some(run.happened.tally(trajectory, &loops, end_ns))
}

/// A run under way.
#[derive(Debug)]
struct Run<'a> {
    trajectory: &'a Trajectory,
    setup: &'a Setup,
    arm: Controller,
    forward: Box<dyn LinkModel>,
    backward: Box<dyn LinkModel>,
    next_send_ns: i64,
    /// When feedback arrives that is still to be answered.
    answers: VecDeque<Instant>,
    /// Commands under way: arrival, and when they were sent.
    in_flight: VecDeque<(Instant, Instant)>,
    idle_since: Option<Instant>,
    happened: Happened,
}

impl<'a> Run<'a> {
    /// The robot's first cycle is done, and guided motion is asked for.
    fn new(trajectory: &'a Trajectory, setup: &'a Setup, seed: u64) -> Self {
        Self {
            arm: requested(&setup.settings),
            forward: link(setup.channel, seed, Way::Forward),
            backward: link(setup.channel, seed, Way::Backward),
            next_send_ns: trajectory.begin_ns(),
            answers: VecDeque::with_capacity(4096),
            in_flight: VecDeque::with_capacity(4096),
            idle_since: None,
            happened: Happened {
                pause_began: Some((0, PauseAfter::Start)),
                ..Happened::default()
            },
            trajectory,
            setup,
        }
    }

    fn cycle(&mut self, at: Instant) {
        match self.setup.sending {
            Sending::Frame => self.send_every(self.trajectory.frame_ns, at),
            Sending::Free(period_ns) => self.send_every(period_ns, at),
            Sending::Coupled => self.answer(at),
        }
        while let Some((arrived, sent)) = self.in_flight.front().copied() {
            if arrived >= at {
                break;
            }
            self.in_flight.pop_front();
            if let Some(command) = self.trajectory.at(sent) {
                // A refusal is the arm's answer; no client listens.
                let _refused = self.arm.receive(arrived, command).is_err();
            }
        }
        let happened = &mut self.happened;
        self.arm.cycle(at, &mut |event| happened.note(&event));
        happened.note_throttle(at.as_ns(), self.arm.is_throttled());
        if self.setup.sending == Sending::Coupled
            && let Fate::Delivered(heard) = self.backward.offer(at, MESSAGE_BYTES)
        {
            self.answers.push_back(heard);
        }
        self.trigger(at);
    }

    /// Everything sent on a grid before `at`.
    fn send_every(&mut self, period_ns: i64, at: Instant) {
        while self.next_send_ns < at.as_ns() {
            self.send(Instant::from_ns(self.next_send_ns));
            self.next_send_ns += period_ns;
        }
    }

    /// Answers to all feedback that arrived before `at`.
    fn answer(&mut self, at: Instant) {
        while let Some(heard) = self.answers.front().copied().filter(|heard| *heard < at) {
            self.answers.pop_front();
            self.send(heard);
        }
    }

    fn send(&mut self, now: Instant) {
        if let Fate::Delivered(arrived) = self.forward.offer(now, MESSAGE_BYTES) {
            self.in_flight.push_back((arrived, now));
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
            let link = LinkSpec::fixed(core::time::Duration::ZERO, ratio);
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
    hold_began_ns: Option<i64>,
    throttle_began_ns: Option<i64>,
    pause_began: Option<(i64, PauseAfter)>,
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
        match event.kind {
            RUNNING => {
                self.end_pause(event.at_ns);
                self.running_began_ns = Some(event.at_ns);
            }
            ENDED => {
                self.end_hold(event.at_ns);
                self.trip_count += 1;
                self.end_running(event.at_ns);
                let cause = EndCause::from_number(event.cause);
                self.pause_began = Some((event.at_ns, PauseAfter::Session(cause)));
            }
            HOLD_BEGAN => self.hold_began_ns = Some(event.at_ns),
            HOLD_ENDED => self.end_hold(event.at_ns),
            _ => {}
        }
    }

    #[inline]
    fn note_throttle(&mut self, at_ns: i64, is_throttled: bool) {
        if is_throttled {
            self.throttle_began_ns.get_or_insert(at_ns);
        } else {
            let throttled = &mut self.evidence.throttled;
            throttled.extend(Span::ended(&mut self.throttle_began_ns, at_ns));
        }
    }

    fn end_hold(&mut self, end_ns: i64) {
        let holds = &mut self.evidence.holds;
        holds.extend(Span::ended(&mut self.hold_began_ns, end_ns));
    }

    fn end_pause(&mut self, end_ns: i64) {
        if let Some((begin_ns, after)) = self.pause_began.take() {
            let span = Span { begin_ns, end_ns };
            self.evidence.pauses.push(Pause { span, after });
        }
    }

    fn end_running(&mut self, end_ns: i64) {
        if let Some(begin_ns) = self.running_began_ns.take() {
            self.running_ns += end_ns - begin_ns;
        }
    }

    fn finish(&mut self, end_ns: i64) {
        self.note_throttle(end_ns, false);
        self.end_hold(end_ns);
        self.end_pause(end_ns);
        self.end_running(end_ns);
    }

    fn tally(&self, trajectory: &Trajectory, loops: &Loops, end_ns: i64) -> Tally {
        let mut lost_counts = [0; LossCause::KIND_COUNT];
        for lost in &loops.lost {
            let cause = self
                .evidence
                .cause_of(lost.due_ns, trajectory.counter.period_ns);
            lost_counts[cause.kind()] += 1;
        }
        let holds = self.evidence.holds.iter();
        let held_ns: i64 = holds.map(|hold| hold.end_ns - hold.begin_ns).sum();
        Tally {
            sent_count: loops.sent_count() as u64,
            executed_count: loops.executed_count as u64,
            extra_count: loops.extra_count as u64,
            lost_counts,
            lost: loops.lost.iter().map(|lost| lost.index).collect(),
            trip_count: self.trip_count,
            hours: end_ns as f64 / 3.6e12,
            hold_ratio: held_ns as f64 / self.running_ns.max(1) as f64,
        }
    }
}
