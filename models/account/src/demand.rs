//! What the consumer of a channel asks of the network in the terms of 3GPP, and whether its messages met it. The terms are
//! those of TS 22.261, clause 3.1 (communication service availability, survival time, end-to-end latency, reliability), which
//! TS 22.104 uses with the transfer interval and the mean time between failures.
//!
//! A message is in time when it stands before the consumer within `latency_max` of its publication. The service is down when
//! no message has come in time by `latency_max` and `survival_time` after the publication of one that did not (TS 22.261,
//! clause 3.1, note on communication service availability), until a later one comes in time. It is asked for while messages
//! are published: of a pause of more than two intervals only the first interval counts, and the clock of the service, on which
//! down time is counted, stands still for the rest.

use core::time::Duration;
use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::history::MessageHistory;
use super::network::{Crossing, Metric};
use super::stage::MessageFate;
use super::{AccountContext, PathProcess, RunSpan};
use hil_core::interval::Spread;
use hil_core::options;
use hil_core::record::stamp;
use hil_core::time::{RemoteInstant, duration_ns};
use hil_stats::dependence::Batches;
use hil_stats::statistics::{CONFIDENCE, PoissonSum};

options! {
    /// What the consumer of a channel asks of the network, in the terms of 3GPP TS 22.104. The report says whether it was met; a
    /// channel that stays on its host is not judged.
    pub struct Demand {
        /// Maximum end-to-end latency, from publication to the moment when the message stands before the consumer.
        latency_max: Duration, in Duration::from_micros(1)..=Duration::from_secs(10);
        /// Survival time: how long the consumer works without a message that was due.
        survival_time: Duration, in Duration::ZERO..=Duration::from_mins(1);
        /// Transfer interval: the time from one message to the next. In a pause of more than two of them the service is not asked
        /// for.
        interval: Duration, in Duration::from_micros(1)..=Duration::from_mins(1);
        /// Communication service availability: share of the time asked for in which the service must be up.
        availability: f64, in 0.0..=0.999_999_999;
    }
}

hil_core::labelled! {
    /// Whether a demand was met, by the 95 % interval of the availability.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum DemandVerdict, label {
        /// It was, also with every message of unknown fate lost.
        Met = "met",
        /// It was not.
        Missed = "missed",
        /// The run is too short to tell.
        SampleTooSmall = "sample too small",
        /// It was if messages of unknown fate came in time.
        UnknownMessages = "unknown messages decide",
        /// There are no figures of the service.
        NotJudged = "not judged",
    }
}

/// A demand, and the figures that it is judged by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DemandMetrics {
    /// Maximum end-to-end latency.
    pub latency_max_ns: i64,
    /// Survival time.
    pub survival_time_ns: i64,
    /// Transfer interval.
    pub interval_ns: i64,
    /// Communication service availability that is asked for.
    pub availability_min: f64,
    /// Whether it was met.
    pub verdict: DemandVerdict,
    /// The service as it was.
    pub service: Metric<ServiceMetrics>,
}

/// How a channel served its consumer, by the limits of a demand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServiceMetrics {
    /// Messages that came in time for certain.
    pub in_time_count: u64,
    /// Messages that came later for certain.
    pub late_count: u64,
    /// Messages that never came.
    pub lost_count: u64,
    /// Of these, lost by a host or a process of this program, not by the network for certain.
    pub lost_by_host_count: u64,
    /// Messages of which that is unknown: their fate, or within the clocks' bound of the limit, or under way at the end.
    pub unknown_count: u64,
    /// Share in time of those of which it is known: reliability of TS 22.261, clause 3.1.
    pub reliability: f64,
    /// 95 % interval of it, or why there is none.
    pub reliability_interval: Spread,
    /// Time in which the service was asked for, nanoseconds.
    pub asked_ns: i64,
    /// Time of the run in which its producer published nothing, nanoseconds.
    pub idle_ns: i64,
    /// Times that the service went down: the survival time was exceeded.
    pub failure_count: u64,
    /// How long it was down together, nanoseconds. Messages of unknown fate count as in time here.
    pub down_ns: i64,
    /// The same where they count as lost.
    pub down_ns_max: i64,
    /// The longest time that it was down.
    pub longest: Option<DownTime>,
    /// Communication service availability: share of the time asked for in which it was up.
    pub availability: f64,
    /// Lower end of its 95 % interval, messages of unknown fate counted as lost. Failures are taken as independent, their
    /// lengths as known (Fay and Feuer 1997).
    pub availability_low: f64,
    /// Upper end of it, these counted as in time.
    pub availability_high: f64,
    /// The lower end where a run as long has no failure, and one would cost an interval: no more can be shown.
    pub availability_shown_max: f64,
    /// Mean time up to a failure, nanoseconds: communication service reliability; `None` without a failure.
    pub time_between_failures_ns: Option<i64>,
}

/// A time in which the service was down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DownTime {
    /// Start, nanoseconds after the start of the run, or on the producer's clock when that is unknown.
    pub start_ns: i64,
    /// Length on the clock of the service, nanoseconds.
    pub length_ns: i64,
    /// True when it lasted to the end of the run.
    pub is_open: bool,
}

/// The fate of a message between the interfaces of the service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transfer {
    /// It stood before the consumer.
    Received {
        /// After so many nanoseconds.
        delay_ns: i64,
        /// Largest error of that from the alignment of two clocks.
        bound_ns: u64,
    },
    /// The network, or possibly a host, lost it.
    Lost,
    /// A host or a process of this program lost it.
    LostByHost,
    /// Nobody can say.
    Unknown,
    /// It was under way at the end of the run.
    InFlight,
}

impl Transfer {
    /// Of a message over gateways. What a producer or a consumer lost as it was killed says nothing of the service.
    fn of(message: &MessageHistory, context: &AccountContext<'_>) -> Self {
        let forwarded = message.arrived().and_then(|one| stamp(one.forwarded_ns));
        let forwarded = forwarded.or_else(|| stamp(message.taken?.forwarded_ns));
        if let Some(forwarded_ns) = forwarded {
            let published_ns = message.published_ns();
            let published =
                published_ns.and_then(|ns| context.path.localise(RemoteInstant::from_ns(ns)));
            return published.map_or(Self::Unknown, |(published, bound_ns)| Self::Received {
                delay_ns: forwarded_ns.saturating_sub(published.as_ns()),
                bound_ns,
            });
        }
        let interruption = message
            .interruption_index
            .and_then(|index| context.interruptions.get(index));
        let is_of_end = interruption
            .is_some_and(|one| matches!(one.place, PathProcess::Producer | PathProcess::Consumer));
        match message.fate {
            MessageFate::InFlight => Self::InFlight,
            _ if is_of_end => Self::Unknown,
            fate => match fate.crossing() {
                Crossing::Arrived | Crossing::Unknown => Self::Unknown,
                Crossing::LostByNetwork | Crossing::Unreachable | Crossing::Doubtful => Self::Lost,
                Crossing::LostByHost => Self::LostByHost,
            },
        }
    }
}

/// Why a channel has no figures of a service.
const STAYS: &str = "the channel stays on its host: no communication service carries it";
const OTHER_INTERVAL: &str = "most messages were published more than two intervals after the one before: interval is another";
const UNALIGNED: &str =
    "the clocks of the two hosts are not aligned: no latency can be held against latency_max";

/// Judges the messages of one channel, in the order of their publication.
#[derive(Debug, Clone)]
pub struct DemandFold {
    demand: Demand,
    run: Option<RunSpan>,
    refused: Option<&'static str>,
    latency_max_ns: i64,
    interval_ns: i64,
    /// The newest publication whose time is known.
    last_ns: Option<i64>,
    /// True when messages without a time came after it.
    has_unplaced: bool,
    /// The service's clock: time asked for up to the newest publication.
    asked_ns: i64,
    idle_ns: i64,
    /// From one publication to the next, and of these the pauses.
    step_count: u64,
    pause_count: u64,
    in_time_count: u64,
    late_count: u64,
    lost_count: u64,
    lost_by_host_count: u64,
    unknown_count: u64,
    /// Place and length of the messages in a row that were not in time, among those of which it is known.
    missed: Vec<(u64, u64)>,
    /// Down times with messages of unknown fate taken as in time, and as lost.
    at_best: DownTimes,
    at_worst: DownTimes,
}

impl DemandFold {
    /// Of a channel over gateways on one clock, in a run on it.
    pub fn new(demand: &Demand, run: Option<RunSpan>) -> Self {
        let [latency_max_ns, survival_ns, interval_ns] =
            [demand.latency_max, demand.survival_time, demand.interval].map(duration_ns);
        let down = DownTimes {
            allowed_ns: latency_max_ns.saturating_add(survival_ns),
            ..DownTimes::default()
        };
        Self {
            demand: demand.clone(),
            run,
            refused: None,
            latency_max_ns,
            interval_ns,
            last_ns: None,
            has_unplaced: false,
            asked_ns: 0,
            idle_ns: 0,
            step_count: 0,
            pause_count: 0,
            in_time_count: 0,
            late_count: 0,
            lost_count: 0,
            lost_by_host_count: 0,
            unknown_count: 0,
            missed: Vec::new(),
            at_best: down.clone(),
            at_worst: down,
        }
    }

    /// Of a channel as its account knows it.
    pub fn of_channel(demand: &Demand, context: &AccountContext<'_>) -> Self {
        let refused = if context.path.is_gateway() {
            (!context.path.is_aligned()).then_some(UNALIGNED)
        } else {
            Some(STAYS)
        };
        Self {
            refused,
            ..Self::new(demand, context.producer_run)
        }
    }

    /// Adds a message; they come in the order in which they settle.
    pub fn add(&mut self, message: &MessageHistory, context: &AccountContext<'_>) {
        let transfer = Transfer::of(message, context);
        self.offer(message.published_ns(), message.count, transfer);
    }

    /// `count` messages in a row were published, at `published_ns` on the producer's clock where that is known.
    pub fn offer(&mut self, published_ns: Option<i64>, count: u64, transfer: Transfer) {
        let end_ns = self.run.map_or(i64::MAX, |run| run.end.as_ns());
        let transfer = match (published_ns, transfer) {
            (Some(at_ns), Transfer::Received { delay_ns, .. })
                if at_ns.saturating_add(delay_ns) > end_ns =>
            {
                Transfer::InFlight
            }
            (_, transfer) => transfer,
        };
        // Whatever comes of it, it was not in time where the run outlasted its time.
        let is_over =
            |at_ns: i64| self.run.is_some() && at_ns.saturating_add(self.latency_max_ns) <= end_ns;
        let transfer = match transfer {
            Transfer::InFlight if published_ns.is_some_and(is_over) => Transfer::Received {
                delay_ns: i64::MAX,
                bound_ns: 0,
            },
            transfer => transfer,
        };
        let delay_ns = self.note(count, transfer);
        match published_ns {
            Some(at_ns) => self.advance(at_ns),
            None => self.has_unplaced = true,
        }
        let (Some(last_ns), Some(delay_ns)) = (self.last_ns, delay_ns) else {
            return;
        };
        // One without a time was due an interval after the last that has one.
        let later_ns = if self.has_unplaced {
            self.interval_ns
        } else {
            0
        };
        let at = Moment {
            at_ns: last_ns.saturating_add(later_ns),
            asked_ns: self.asked_ns.saturating_add(later_ns),
        };
        self.at_best.add(at, delay_ns.at_best);
        self.at_worst.add(at, delay_ns.at_worst);
    }

    /// Counts messages; gives when they came in time, or `None` for what the run ended before.
    fn note(&mut self, count: u64, transfer: Transfer) -> Option<InTime> {
        let limit_ns = self.latency_max_ns;
        let (number, in_time) = match transfer {
            Transfer::Received { delay_ns, bound_ns } => {
                let first_ns = delay_ns.saturating_sub_unsigned(bound_ns);
                if delay_ns.saturating_add_unsigned(bound_ns) <= limit_ns {
                    (&mut self.in_time_count, InTime::both(Some(delay_ns)))
                } else if first_ns > limit_ns {
                    (&mut self.late_count, InTime::both(None))
                } else {
                    let at_best = Some(delay_ns.min(limit_ns));
                    let at_worst = None;
                    (&mut self.unknown_count, InTime { at_best, at_worst })
                }
            }
            Transfer::Lost => (&mut self.lost_count, InTime::both(None)),
            Transfer::LostByHost => {
                self.lost_by_host_count = self.lost_by_host_count.saturating_add(count);
                (&mut self.lost_count, InTime::both(None))
            }
            Transfer::Unknown => {
                let (at_best, at_worst) = (Some(0), None);
                (&mut self.unknown_count, InTime { at_best, at_worst })
            }
            Transfer::InFlight => {
                self.unknown_count = self.unknown_count.saturating_add(count);
                return None;
            }
        };
        *number = number.saturating_add(count);
        if in_time.at_best.is_none() {
            let place = self.known_count().saturating_sub(count);
            match self.missed.last_mut() {
                Some((first, length)) if first.saturating_add(*length) == place => {
                    *length = length.saturating_add(count);
                }
                _ => self.missed.push((place, count)),
            }
        }
        Some(in_time)
    }

    const fn known_count(&self) -> u64 {
        self.in_time_count
            .saturating_add(self.late_count)
            .saturating_add(self.lost_count)
    }

    /// Advances the service's clock to `at_ns`.
    fn advance(&mut self, at_ns: i64) {
        let since_ns = self.last_ns.or_else(|| Some(self.run?.start.as_ns()));
        let length_ns = since_ns.map_or(0, |since_ns| at_ns.saturating_sub(since_ns).max(0));
        let is_pause = length_ns > self.interval_ns.saturating_mul(2) && !self.has_unplaced;
        if self.last_ns.is_some() {
            self.step_count = self.step_count.saturating_add(1);
            self.pause_count = self.pause_count.saturating_add(u64::from(is_pause));
        }
        let asked_ns = match self.last_ns {
            None => 0,
            Some(_) if is_pause => self.interval_ns,
            Some(_) => length_ns,
        };
        self.asked_ns = self.asked_ns.saturating_add(asked_ns);
        self.idle_ns = self.idle_ns.saturating_add(length_ns - asked_ns);
        self.last_ns = Some(self.last_ns.map_or(at_ns, |last_ns| last_ns.max(at_ns)));
        self.has_unplaced = false;
    }

    /// The figures of all messages.
    pub fn finish(mut self) -> DemandMetrics {
        if let Some(reason) = self.refused {
            return DemandMetrics::unjudged(&self.demand, reason);
        }
        if let (Some(_), Some(run)) = (self.last_ns, self.run) {
            self.advance(run.end.as_ns());
        }
        let known_count = self.known_count();
        let reason = if self.pause_count > self.step_count / 2 {
            Some(OTHER_INTERVAL)
        } else if known_count == 0 && self.unknown_count == 0 {
            Some("no message was published")
        } else if known_count == 0 {
            Some("of no message is it known whether it came in time")
        } else {
            (self.asked_ns == 0)
                .then_some("no two messages tell how long the service was asked for")
        };
        if let Some(reason) = reason {
            return DemandMetrics::unjudged(&self.demand, reason);
        }
        let (asked_ns, start_ns) = (self.asked_ns, self.run.map_or(0, |run| run.start.as_ns()));
        let [best, worst] = [self.at_best, self.at_worst].map(|one| one.finish(asked_ns));
        // A failure ends with a message: one interval is the least that one costs.
        let share_down = |down_ns: f64| (down_ns / asked_ns as f64).min(1.0);
        let interval = |sum: PoissonSum| {
            let ends = sum.interval(self.interval_ns as f64, CONFIDENCE);
            ends.map(share_down)
        };
        let [low, high] = interval(best.sum);
        let [_, high_at_worst] = interval(worst.sum);
        let [_, shown_min] = interval(PoissonSum::default());
        let allowed = 1.0 - self.demand.availability;
        let verdict = if low > allowed {
            DemandVerdict::Missed
        } else if high_at_worst <= allowed {
            DemandVerdict::Met
        } else if high <= allowed {
            DemandVerdict::UnknownMessages
        } else {
            DemandVerdict::SampleTooSmall
        };
        let failure_count = best.sum.count;
        let in_time = Batches::of_runs(known_count, self.missed).share_interval();
        let up_ns = asked_ns.saturating_sub(best.total_ns);
        let service = ServiceMetrics {
            in_time_count: self.in_time_count,
            late_count: self.late_count,
            lost_count: self.lost_count,
            lost_by_host_count: self.lost_by_host_count,
            unknown_count: self.unknown_count,
            reliability: self.in_time_count as f64 / known_count as f64,
            reliability_interval: complement(in_time),
            asked_ns,
            idle_ns: self.idle_ns,
            failure_count,
            down_ns: best.total_ns,
            down_ns_max: worst.total_ns,
            longest: best.longest.map(|one| DownTime {
                start_ns: one.start_ns.saturating_sub(start_ns),
                ..one
            }),
            availability: 1.0 - share_down(best.total_ns as f64),
            availability_low: 1.0 - high_at_worst,
            availability_high: 1.0 - low,
            availability_shown_max: 1.0 - shown_min,
            time_between_failures_ns: i64::try_from(failure_count)
                .ok()
                .and_then(|count| up_ns.checked_div(count)),
        };
        DemandMetrics {
            verdict,
            service: Metric::Measured(service),
            ..DemandMetrics::unjudged(&self.demand, "")
        }
    }
}

/// The interval of the other outcome's share.
fn complement(spread: Spread) -> Spread {
    match spread {
        Spread::Known(one) => Spread::Known(hil_core::interval::Interval::new(
            1.0 - one.high,
            1.0 - one.low,
            one.method,
        )),
        Spread::Unknown(why) => Spread::Unknown(why),
    }
}

impl DemandMetrics {
    /// A demand without figures of the service, and why.
    fn unjudged(demand: &Demand, reason: &str) -> Self {
        let [latency_max_ns, survival_time_ns, interval_ns] =
            [demand.latency_max, demand.survival_time, demand.interval].map(duration_ns);
        Self {
            latency_max_ns,
            survival_time_ns,
            interval_ns,
            availability_min: demand.availability,
            verdict: DemandVerdict::NotJudged,
            service: Metric::unavailable(reason),
        }
    }

    /// Of a channel in the shared memory of one host.
    pub fn on_one_host(demand: &Demand) -> Self {
        Self::unjudged(demand, STAYS)
    }
}

/// When a message came in time, nanoseconds after its publication; `None` when it did not.
#[derive(Debug, Clone, Copy)]
struct InTime {
    at_best: Option<i64>,
    at_worst: Option<i64>,
}

impl InTime {
    const fn both(delay_ns: Option<i64>) -> Self {
        Self {
            at_best: delay_ns,
            at_worst: delay_ns,
        }
    }
}

/// A moment on the producer's clock and on that of the service.
#[derive(Debug, Clone, Copy)]
struct Moment {
    at_ns: i64,
    asked_ns: i64,
}

/// The times that the service was down.
#[derive(Debug, Clone, Default)]
struct DownTimes {
    /// Latency and survival time.
    allowed_ns: i64,
    /// When it is down unless a message comes in time.
    due: Option<Moment>,
    /// When it was down, each with the first message in time after, which one published later may yet overtake. The ends rise.
    ended: VecDeque<(Moment, i64)>,
    total_ns: i64,
    sum: PoissonSum,
    longest: Option<DownTime>,
}

impl DownTimes {
    /// A message was published then, and came in time after `delay_ns`, if it did.
    fn add(&mut self, published: Moment, delay_ns: Option<i64>) {
        self.settle(published.asked_ns);
        let Some(delay_ns) = delay_ns else {
            self.due.get_or_insert(Moment {
                at_ns: published.at_ns.saturating_add(self.allowed_ns),
                asked_ns: published.asked_ns.saturating_add(self.allowed_ns),
            });
            return;
        };
        let came_ns = published.asked_ns.saturating_add(delay_ns.max(0));
        for (_, end_ns) in &mut self.ended {
            *end_ns = (*end_ns).min(came_ns);
        }
        self.ended.extend(self.due.take().map(|due| (due, came_ns)));
    }

    /// Takes those for what they are that no message published at `now_ns` or later ends sooner.
    fn settle(&mut self, now_ns: i64) {
        while let Some((from, end_ns)) = self.ended.pop_front_if(|(_, end_ns)| *end_ns <= now_ns) {
            self.note(from, end_ns, false);
        }
    }

    fn note(&mut self, from: Moment, end_ns: i64, is_open: bool) {
        let length_ns = end_ns.saturating_sub(from.asked_ns);
        if length_ns <= 0 {
            return;
        }
        self.total_ns = self.total_ns.saturating_add(length_ns);
        self.sum.push(length_ns as f64);
        if self.longest.is_none_or(|known| known.length_ns < length_ns) {
            self.longest = Some(DownTime {
                start_ns: from.at_ns,
                length_ns,
                is_open,
            });
        }
    }

    /// All of them; the service was asked for up to `end_ns` on its clock.
    fn finish(mut self, end_ns: i64) -> Self {
        for (_, came_ns) in &mut self.ended {
            *came_ns = (*came_ns).min(end_ns);
        }
        self.settle(end_ns);
        if let Some(due) = self.due.take() {
            self.note(due, end_ns, true);
        }
        self
    }
}

#[cfg(test)]
#[path = "demand_tests.rs"]
mod tests;
