//! The network of a run as a summary keeps it: figures of each channel, what happened, both on the
//! time of the run beside what the robot did. Figures are computed elsewhere.

use hil_account::network::{NetworkEventKind, NetworkMetrics};
use hil_stats::correlation::PairCorrelation;
use serde::{Deserialize, Serialize};

use hil_platform::text::grouped;
use hil_platform::words::plural;
use hil_present::units::{JOINT, duration_s, seconds};

/// How long before an event of the score the network is looked at, seconds. The longest effect
/// that is known of: a session that an outage ended takes that long to come back.
pub const PRECEDING_S: f64 = 5.0;

/// Everything a run has to say about its network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkReport {
    /// Channels that crossed a network or the model of one, each one direction.
    pub channels: Vec<ChannelNetwork>,
    /// What happened on them, in order of time; of too much the outages and then what lasted longest.
    pub events: Vec<TimedEvent>,
    /// Events that found no room.
    pub events_dropped_count: u64,
    /// How long before an event of the score is looked at, seconds.
    pub foregoing_s: f64,
    /// Share of all moments of the run that have a network event in that time before them: what
    /// chance alone would put before an event of the score.
    pub foregoing_chance_ratio: f64,
    /// True when hosts read different clocks: times count from each host's own start of the run,
    /// and the hosts start within a message of their supervisors of each other.
    pub clocks_differ: bool,
    /// How far instants of two hosts, or of a host and the score, may lie off each other on this axis
    /// where the clocks are aligned, seconds; 0 on one clock, and `None` where `clocks_differ`.
    #[serde(default)]
    pub clock_bound_s: Option<f64>,
    /// Network and robot on one axis.
    pub timeline: Timeline,
    /// Whether the robot's errors follow the network's troubles.
    pub correlation: Correlation,
}

/// One channel, which is one direction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelNetwork {
    /// Its name.
    pub channel: String,
    /// Host of the producer.
    pub from_host: String,
    /// Host of the consumer.
    pub to_host: String,
    /// Its figures.
    pub figures: NetworkMetrics,
}

/// Something that happened on a channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimedEvent {
    /// The channel; of a process that was down, the first of its channels.
    pub channel: String,
    /// When it began, seconds after the start of the run.
    pub from_s: f64,
    /// When it was over; `None` when it was not before the end of the run.
    pub until_s: Option<f64>,
    /// What it was, with its numbers.
    #[serde(flatten)]
    pub kind: NetworkEventKind,
}

impl TimedEvent {
    /// How long it lasted, seconds; without end when it was not over before the end of the run.
    pub(crate) fn length_s(&self) -> f64 {
        self.until_s
            .map_or(f64::INFINITY, |until_s| until_s - self.from_s)
    }

    /// At most `count_max` of `events`, in order of time. Independent losses alone may make too many: then
    /// the longest stay, outages first.
    pub(crate) fn kept(mut events: Vec<Self>, count_max: usize) -> Vec<Self> {
        if events.len() > count_max {
            events.sort_by(|a, b| {
                let is_outage = b.is_outage().cmp(&a.is_outage());
                is_outage.then(b.length_s().total_cmp(&a.length_s()))
            });
            events.truncate(count_max);
            events.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
        }
        events
    }

    /// True when nothing got through: an outage, or a process that was down.
    pub(crate) const fn is_outage(&self) -> bool {
        matches!(
            self.kind,
            NetworkEventKind::Outage { .. } | NetworkEventKind::ProcessDown { .. }
        )
    }

    /// False for what a process or a clock of ours did.
    pub(crate) const fn is_by_network(&self) -> bool {
        !matches!(
            self.kind,
            NetworkEventKind::ProcessDown { .. } | NetworkEventKind::ClockStep { .. }
        )
    }

    /// How long before `at_s` it was over, seconds; 0 when it was under way, `None` when it cannot have
    /// been within [`PRECEDING_S`] before, as two hosts' times are known to `clock_bound_s` of each other.
    pub(crate) fn over_for_s(&self, at_s: f64, clock_bound_s: f64) -> Option<f64> {
        if self.from_s > at_s + clock_bound_s {
            return None;
        }
        let over_s = self
            .until_s
            .map_or(0.0, |until_s| (at_s - until_s).max(0.0));
        (over_s <= PRECEDING_S + clock_bound_s).then_some(over_s)
    }

    /// In words, without its time.
    pub fn words(&self) -> String {
        let length = match self.until_s {
            Some(until_s) => format!(" for {}", duration_s(until_s - self.from_s)),
            None => " to the end".to_owned(),
        };
        let channel = &self.channel;
        match &self.kind {
            NetworkEventKind::Outage {
                lost_count,
                unreachable_count,
            } => {
                let lost = counted(*lost_count, "message");
                let cause = match unreachable_count {
                    0 => String::new(),
                    count if count == lost_count => ": network unreachable".to_owned(),
                    count => format!(", {} of them: network unreachable", grouped(*count)),
                };
                format!("outage{length} on {channel}, {lost} lost{cause}")
            }
            NetworkEventKind::LossBurst {
                lost_count,
                of_count,
            } => {
                let (lost, of) = (grouped(*lost_count), counted(*of_count, "message"));
                format!("burst of losses{length} on {channel}, {lost} of {of} lost")
            }
            NetworkEventKind::Delay {
                late_count,
                delay_max_ns,
                limit_ns,
                bound_ns,
            } => {
                let [max, limit] = [delay_max_ns, limit_ns].map(|ns| duration_s(*ns as f64 * 1e-9));
                let late = counted(*late_count, "message");
                let bound = within(*bound_ns, *delay_max_ns);
                format!("late on {channel}, {late} by up to {max}{bound} (limit {limit})")
            }
            NetworkEventKind::Reordering {
                reordered_count,
                extent_max,
            } => {
                let count = counted(*reordered_count, "message");
                let places = counted(*extent_max, "place");
                format!("reordering on {channel}, {count} by up to {places}")
            }
            NetworkEventKind::ProcessDown { process, cause, .. } => {
                format!("{process} was down{length} ({cause})")
            }
            NetworkEventKind::ClockStep { step_ns } => {
                let step = duration_s(*step_ns as f64 * 1e-9);
                format!("a real-time clock beside {channel} was set by {step}")
            }
        }
    }
}

/// How far a one-way figure may be off by the clocks' alignment; nothing on one clock.
pub(crate) fn within(bound_ns: u64, figure_ns: i64) -> String {
    if bound_ns == 0 {
        return String::new();
    }
    let wide = if i128::from(bound_ns) > i128::from(figure_ns) {
        " (wider than the figure)"
    } else {
        ""
    };
    format!(" ±{}{wide}", duration_s(bound_ns as f64 * 1e-9))
}

fn counted(count: u64, what: &str) -> String {
    format!("{}{JOINT}{}", grouped(count), plural(count, what))
}

/// What the network went through before one event of the score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecedingNetwork {
    /// How long before the event was looked at, seconds.
    pub foregoing_s: f64,
    /// Network events of that time on any channel, nearest first.
    pub events: Vec<PrecedingEvent>,
    /// Further ones.
    pub more_count: u64,
    /// Messages lost by the network in that time on all channels, those of the events included.
    pub lost_count: u64,
    /// Channels that lost some of these, the one with the largest share first.
    #[serde(default)]
    pub losses: Vec<PrecedingLoss>,
}

/// What the network lost of a channel before an event of the score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecedingLoss {
    /// The channel.
    pub channel: String,
    /// Messages lost by the network.
    pub lost_count: u64,
    /// Messages handed to it.
    pub sent_count: u64,
}

impl PrecedingLoss {
    /// The share lost.
    pub(crate) fn ratio(&self) -> f64 {
        self.lost_count as f64 / self.sent_count.max(1) as f64
    }
}

/// A network event that came before an event of the score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecedingEvent {
    /// It.
    #[serde(flatten)]
    pub event: TimedEvent,
    /// How long before the event it was over, seconds; 0 when it was under way.
    pub over_for_s: f64,
    /// All of it in words.
    pub words: String,
}

impl PrecedingEvent {
    /// `event`, which was over for `over_for_s` at `at_s`.
    pub fn of(event: &TimedEvent, at_s: f64, over_for_s: f64) -> Self {
        let when = if event.until_s.is_none_or(|until_s| until_s >= at_s) {
            // Within the clocks' bound it may seem to have begun after.
            let for_s = (at_s - event.from_s).max(0.0);
            format!("under way for {}", duration_s(for_s))
        } else {
            format!("{} before", duration_s(over_for_s))
        };
        let (words, from) = (event.words(), seconds(event.from_s));
        Self {
            event: event.clone(),
            over_for_s,
            words: format!("{when}: {words}, from {from}"),
        }
    }
}

impl PrecedingNetwork {
    /// What is said when nothing happened, which is a finding too.
    pub(crate) fn nothing_words(&self) -> String {
        let window = duration_s(self.foregoing_s);
        let lost = match self.lost_count {
            0 => "no message lost".to_owned(),
            count => format!("only single losses, {}", counted(count, "message")),
        };
        format!("nothing of note on any channel in the {window} before ({lost})")
    }
}

/// Network and robot over time, in equal steps from the start of the run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Timeline {
    /// Length of a step, seconds.
    pub step_s: f64,
    /// Rows; all are equally long.
    pub rows: Vec<TimelineRow>,
}

impl Timeline {
    /// False of a run of programs alone.
    pub(crate) fn has_robot(&self) -> bool {
        let mut rows = self.rows.iter();
        rows.any(|row| matches!(row.subject, TimelineSubject::Robot { .. }))
    }

    /// What it shows.
    pub(crate) fn title(&self) -> &'static str {
        if self.has_robot() {
            "Network and robot over time"
        } else {
            "Network over time"
        }
    }
}

hil_core::labelled! {
    /// What is bad about a network, as one number over time.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum NetworkQuantity, label {
        /// The share of messages that were lost.
        Loss = "loss",
        /// The largest delay, seconds.
        Delay = "delay",
        /// The longest time without an arrival, seconds.
        Silence = "silence",
    }
}

impl NetworkQuantity {
    /// `1` for a share, else the SI unit.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Loss => "1",
            Self::Delay | Self::Silence => "s",
        }
    }
}

/// What a quantity over time is of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "of", rename_all = "snake_case")]
pub enum TimelineSubject {
    /// A channel over a network.
    Channel {
        /// Its name.
        channel: String,
        /// Which quantity.
        quantity: NetworkQuantity,
    },
    /// The robot.
    Robot {
        /// Its error, or the events of its score, in words.
        label: String,
    },
}

impl TimelineSubject {
    /// True for `quantity` of `channel`.
    pub(crate) fn is_of(&self, channel: &str, quantity: NetworkQuantity) -> bool {
        matches!(self, Self::Channel { channel: name, quantity: found }
            if name == channel && *found == quantity)
    }
}

/// One quantity over time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimelineRow {
    /// What it is of.
    #[serde(flatten)]
    pub subject: TimelineSubject,
    /// `1` for a share or a number, else the unit.
    pub unit: String,
    /// The largest value of each step; `None` where there was none.
    pub values: Vec<Option<f64>>,
    /// Largest error of any value from the alignment of two hosts' clocks, in the same unit, 0 on one
    /// clock; `None` for what needs no second clock, and without values.
    #[serde(default)]
    pub bound: Option<f64>,
}

/// Whether the robot's errors follow the network's troubles; correlation is not cause.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Correlation {
    /// All pairs, tested together.
    Tested(CorrelationTests),
    /// No test.
    Unavailable {
        /// Why.
        reason: String,
    },
}

/// Tests of all pairs of a network's and a robot's series.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CorrelationTests {
    /// Width of a bin: lags are multiples of it, seconds.
    pub bin_s: f64,
    /// Lags searched: the robot first by so much, seconds.
    pub lead_max_s: f64,
    /// The robot later by so much, seconds.
    pub lag_max_s: f64,
    /// Shifts of the robot's series that p-values rest on.
    pub shift_count: u64,
    /// The pairs.
    pub pairs: Vec<TestedPair>,
    /// Series that are the same all the time, so that nothing can follow them.
    pub constant: Vec<String>,
    /// Series that leave their usual value too few times for a test.
    pub seldom: Vec<SeldomSeries>,
}

/// A series that leaves its usual value a few times.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeldomSeries {
    /// What it is.
    pub series: String,
    /// How many times.
    pub spell_count: u64,
}

/// One pair.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TestedPair {
    /// The channel.
    pub channel: String,
    /// What of the network.
    pub network: NetworkQuantity,
    /// What of the robot.
    pub robot: String,
    /// Lag of the highest coefficient, seconds; above zero when the robot comes later.
    pub lag_s: f64,
    /// Coefficient and p-values.
    #[serde(flatten)]
    pub correlation: PairCorrelation,
}

/// Above this a correlation is no more than chance may give.
pub(crate) const P_MAX: f64 = 0.05;

impl CorrelationTests {
    /// Those that chance among all pairs does not explain, the strongest first.
    pub(crate) fn significant(&self) -> Vec<&TestedPair> {
        let pairs = self.pairs.iter();
        let mut found: Vec<_> = pairs
            .filter(|pair| pair.correlation.p_family <= P_MAX)
            .collect();
        found.sort_by(|a, b| {
            b.correlation
                .coefficient
                .total_cmp(&a.correlation.coefficient)
        });
        found
    }
}

impl TestedPair {
    /// The pair in words, of `count` pairs and `shift_count` shifts.
    pub fn words(&self, count: usize, shift_count: u64) -> String {
        let (robot, network, channel) = (&self.robot, &self.network, &self.channel);
        let by = duration_s(self.lag_s.abs());
        let how = match self.correlation.lag_bins {
            1.. => format!("follows the {network} on {channel} by {by}"),
            0 => format!("goes with the {network} on {channel} in the same bin"),
            _ => format!("precedes the {network} on {channel} by {by}"),
        };
        let PairCorrelation {
            coefficient,
            p_value,
            p_family,
            ..
        } = self.correlation;
        let shifts = grouped(shift_count);
        format!(
            "{robot} {how}: r{JOINT}={JOINT}{coefficient:.2}, p{JOINT}={JOINT}{p_value:.3} of \
             {shifts} shifts, {p_family:.3} in view of all {count} pairs"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_too_many_events_the_outages_and_the_longest_stay() {
        let burst = |from_s: f64, length_s: f64| TimedEvent {
            kind: NetworkEventKind::LossBurst {
                lost_count: 2,
                of_count: 9,
            },
            ..outage(from_s, Some(from_s + length_s))
        };
        let mut events: Vec<_> = (0..10).map(|at| burst(f64::from(at), 0.125)).collect();
        events.push(burst(50.0, 0.25));
        events.push(outage(60.0, Some(60.01)));
        events.push(outage(61.0, None));
        assert_eq!(TimedEvent::kept(events.clone(), 13), events);
        let kept = TimedEvent::kept(events, 4);
        let at: Vec<f64> = kept.iter().map(|one| one.from_s).collect();
        assert_eq!(at, [0.0, 50.0, 60.0, 61.0]);
    }

    fn outage(from_s: f64, until_s: Option<f64>) -> TimedEvent {
        TimedEvent {
            channel: "shuttle/command".to_owned(),
            from_s,
            until_s,
            kind: NetworkEventKind::Outage {
                lost_count: 80,
                unreachable_count: 0,
            },
        }
    }

    #[test]
    fn an_event_counts_while_under_way_and_five_seconds_after() {
        let over = |at_s| outage(3.0, Some(3.8)).over_for_s(at_s, 0.0);
        assert_eq!(over(2.9), None);
        assert_eq!(over(3.5), Some(0.0));
        assert!((over(4.8).unwrap() - 1.0).abs() < 1e-9);
        assert_eq!(over(8.9), None);
        assert_eq!(outage(3.0, None).over_for_s(60.0, 0.0), Some(0.0));
        // Clocks known to 200 ms leave room for what seems too late or too long ago.
        let over = |at_s| outage(3.0, Some(3.8)).over_for_s(at_s, 0.2);
        assert_eq!(over(2.9), Some(0.0));
        assert_eq!(over(2.7), None);
        assert!((over(8.9).unwrap() - 5.1).abs() < 1e-9);
        assert_eq!(over(9.1), None);
    }

    #[test]
    fn each_foregoing_event_says_when_it_was() {
        let words = |from_s, until_s, at_s| {
            let event = outage(from_s, until_s);
            let over_for_s = event.over_for_s(at_s, 0.0).unwrap();
            PrecedingEvent::of(&event, at_s, over_for_s)
                .words
                .replace(JOINT, " ")
        };
        assert_eq!(
            words(3.0, Some(3.8), 4.3),
            "500 ms before: outage for 800 ms on shuttle/command, 80 messages lost, from 3.000 s"
        );
        assert_eq!(
            words(3.0, None, 4.0),
            "under way for 1.00 s: outage to the end on shuttle/command, 80 messages lost, from \
             3.000 s"
        );
    }

    #[test]
    fn a_timed_event_keeps_its_numbers_in_json() {
        let event = outage(3.0, Some(3.8));
        let text = serde_json::to_string(&event).unwrap();
        assert!(
            text.contains("\"kind\":\"outage\",\"lost_count\":80"),
            "{text}"
        );
        assert_eq!(serde_json::from_str::<TimedEvent>(&text).unwrap(), event);
    }

    #[test]
    fn a_pair_says_who_follows_whom_and_never_why() {
        let pair = |lag_bins: i64| TestedPair {
            channel: "shuttle/command".to_owned(),
            network: NetworkQuantity::Silence,
            robot: "joint error".to_owned(),
            lag_s: lag_bins as f64 * 0.1,
            correlation: PairCorrelation {
                coefficient: 0.62,
                lag_bins,
                p_value: 0.002,
                p_family: 0.004,
            },
        };
        let words = |lag_bins| pair(lag_bins).words(12, 499).replace(JOINT, " ");
        assert_eq!(
            words(11),
            "joint error follows the silence on shuttle/command by 1.10 s: r = 0.62, p = 0.002 of \
             499 shifts, 0.004 in view of all 12 pairs"
        );
        assert!(
            words(-4).starts_with("joint error precedes the silence on shuttle/command by 400 ms")
        );
        assert!(words(0).contains("goes with the silence"));
    }
}
