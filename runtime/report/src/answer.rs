//! The answer of a run: did the network hurt the robot, is the measurement valid, how large is the sample. It is
//! drawn from a summary once, as data; every output says it in the same words, which are beside it.

use core::fmt;

use hil_account::flow::DeadlineMetrics;
use hil_account::{ChannelAccount, MessageFate, Standing};
use hil_core::case_study::{Occasions, Severity};
use hil_core::interval::{Interval, Spread, TooSmall};
use hil_platform::text::grouped;
use hil_platform::words::{counted, named};
use hil_stats::statistics::CONFIDENCE;
use serde::{Deserialize, Serialize};

use super::assessment::{
    Assessment, HELD_MAX_NS, NetworkVerdict, SKIPPED_TICK_RATIO_MAX, uncounted,
    uncounted_start_count,
};
use super::clock_summary::ClockSection;
use super::score_event::ExplainedEvent;
use super::summary::{LinkKind, RunSummary};
use hil_present::Tone;
use hil_present::units::{JOINT, duration_s, percent, upper_bound};

/// A rate of fewer occasions is not told, and no harm in fewer is no answer.
pub const OCCASIONS_MIN: u64 = 10;
/// A network event within seconds before explains nothing where more moments than this share have one.
pub(crate) const CHANCE_MAX: f64 = 0.5;
/// Messages that the network lost in a row and that make an outage; fewer are single losses, which a lossy link always has.
const OUTAGE_LOST_MIN: u64 = 3;
/// Channels, processes or hosts that are named where many have the same fault.
const NAMED_COUNT: usize = 3;

/// A way in which the robot can be hurt, and how often it was; see [`hil_core::case_study::Harm`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HarmCount {
    /// What happened to it.
    pub what: String,
    /// How often; `None` when the run did not allow to count it.
    pub count: Option<u64>,
    /// Of these, those that limits of the robot itself made.
    pub own_count: u64,
    /// What could have hurt it.
    pub occasions: Option<OccasionCount>,
    /// 95 % interval of its share of them, or why there is none.
    #[serde(default)]
    pub interval: Option<Spread>,
    /// What it is, for a reader who does not know the term; empty where that is plain.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
}

/// What could have hurt the robot; see [`Occasions`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OccasionCount {
    /// What they are.
    pub what: String,
    /// How many there were.
    pub count: u64,
}

impl From<&hil_core::case_study::Harm> for HarmCount {
    fn from(harm: &hil_core::case_study::Harm) -> Self {
        Self {
            what: harm.what.to_owned(),
            count: harm.count,
            own_count: harm.own_count,
            occasions: harm.occasions.map(|Occasions { what, count }| {
                let what = what.to_owned();
                OccasionCount { what, count }
            }),
            interval: harm.interval,
            note: harm.note.to_owned(),
        }
    }
}

impl From<&DeadlineMetrics> for HarmCount {
    fn from(deadline: &DeadlineMetrics) -> Self {
        Self {
            what: format!("{} late or missing", deadline.name),
            count: Some(deadline.hurt_count),
            own_count: 0,
            occasions: Some(OccasionCount {
                what: format!("requests of {}", deadline.name),
                count: deadline.request_count - deadline.unknown_count,
            }),
            interval: deadline.hurt_share,
            note: String::new(),
        }
    }
}

impl HarmCount {
    /// Those that the robot's own limits did not make.
    fn beyond_own_count(&self) -> u64 {
        self.count.unwrap_or(0).saturating_sub(self.own_count)
    }

    /// How many of how many, with the share where there are enough.
    pub fn words(&self) -> String {
        let Some(count) = self.count else {
            return "unavailable: the run did not allow to count them".to_owned();
        };
        let mut text = grouped(count);
        if let Some(occasions) = &self.occasions {
            text = format!("{text} of {} {}", grouped(occasions.count), occasions.what);
            if occasions.count >= OCCASIONS_MIN && count <= occasions.count {
                let share = percent(count as f64 / occasions.count as f64);
                let interval = match self.interval {
                    None => String::new(),
                    // How those come together that did not happen is unknown whatever the sample.
                    Some(Spread::Unknown(_)) if count == 0 => String::new(),
                    // Too few, however independent: their number stands before it.
                    Some(Spread::Unknown(why)) if why.effective >= occasions.count => {
                        format!(" [an interval takes {}]", grouped(why.needed))
                    }
                    Some(Spread::Unknown(why)) => format!(" [{why}]"),
                    Some(Spread::Known(Interval { low, high, .. })) => {
                        format!(" [{}, {}]", percent(low), percent(high))
                    }
                };
                text = format!("{text}: {share}{interval}");
            }
        }
        if self.own_count > 0 {
            let own = grouped(self.own_count);
            text = format!("{text}; {own} by limits of the robot");
        }
        text
    }
}

/// Did the network hurt the robot?
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Hurt {
    /// It did.
    Yes,
    /// It did not.
    No,
    /// The run cannot tell.
    NotResolvable {
        /// Why not.
        because: Unresolved,
    },
    /// The run put no network, or no robot with a score, to the test.
    NotTested {
        /// Why not.
        because: Untested,
    },
}

/// Why a run cannot tell.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "reason", rename_all = "snake_case")]
pub enum Unresolved {
    /// The measurement is not valid.
    InvalidMeasurement,
    /// Nothing tells whether the hosts kept up.
    HostUnknown,
    /// Nothing happened, and too little could have.
    SampleTooSmall {
        /// What could have hurt the robot.
        what: String,
        /// How often.
        count: u64,
        /// How often it takes.
        needed: u64,
    },
    /// What could have hurt the robot was not counted.
    NotCounted,
    /// Records of what the robot did are missing.
    ScoreIncomplete,
    /// The robot was hurt, and no event of the network preceded it.
    NoNetworkEventBefore,
    /// The robot was hurt, and times of hosts do not compare.
    ClocksDiffer,
    /// Of a comparison: chance alone makes such a difference.
    WithinChance,
    /// Of a comparison: the difference has no interval.
    NoInterval {
        /// Of what.
        what: String,
        /// Why not.
        why: TooSmall,
    },
    /// Of a comparison: no repetition differs from another of its side, so that nothing tells how runs scatter.
    NoScatter {
        /// In what.
        what: String,
    },
}

hil_core::labelled! {
    /// Why a run tests nothing.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(tag = "reason", rename_all = "snake_case")]
    pub enum Untested, label {
        /// It failed.
        RunFailed = "the run failed",
        /// No channel crossed a network or a model of one.
        NoNetwork = "no channel went over a network",
        /// No foreign program answered.
        NoForeignProgram = "no foreign program answered",
        /// The robot has no score that counts what hurts it.
        NoScore = "no score counts what hurts this robot",
    }
}

hil_core::labelled! {
    /// What was put to the test.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Subject, label {
        /// A network.
        Network = "the network",
        /// An emulated link.
        EmulatedLink = "the emulated link",
        /// A link model in virtual time.
        LinkModel = "the link model",
        /// The network of a foreign program.
        ForeignNetwork = "the foreign program or its network",
    }
}

hil_core::labelled! {
    /// What the network may have hurt.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Object, label {
        /// The robot of a case.
        Robot = "the robot",
        /// Programs of the user's, of which nothing is known but their messages or frames.
        Programs = "the programs",
    }
}

impl Object {
    /// Of a run: one without a case has no robot.
    pub(crate) const fn of(summary: &RunSummary) -> Self {
        if summary.run.case.is_empty() {
            Self::Programs
        } else {
            Self::Robot
        }
    }
}

/// Whether times of two hosts compare.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum Clocks {
    /// No figure needs two.
    NotNeeded,
    /// All hosts read one.
    One,
    /// They are aligned.
    Aligned {
        /// Half of the widest guaranteed bound of an instant, seconds.
        bound_s: f64,
    },
    /// They are not: one-way delays are unavailable.
    Unaligned,
}

/// Whether the measurement is valid.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Measurement {
    /// Host and link were kept up with, and no record is missing; `None` where nothing was measured, or nothing
    /// tells.
    pub is_valid: Option<bool>,
    /// Whether times of two hosts compare.
    pub clocks: Clocks,
    /// Starts of processes that left no counters: what these lost or skipped is unknown.
    pub uncounted_start_count: u64,
    /// The processes concerned.
    pub uncounted_process_count: u64,
}

/// How much the answer rests on.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sample {
    /// Length of the run, seconds.
    pub duration_s: f64,
    /// Channels that crossed a network or a model of one, else all.
    pub channel_count: u64,
    /// Messages published on them.
    pub message_count: u64,
    /// What could have hurt the robot, of the harm with the fewest; `None` where harms have none, and messages stand in.
    pub occasions: Option<OccasionCount>,
}

/// The answer of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Answer {
    /// Did the network hurt the robot?
    #[serde(flatten)]
    pub hurt: Hurt,
    /// What was put to the test.
    pub subject: Subject,
    /// What it may have hurt.
    pub object: Object,
    /// Is the measurement valid?
    pub measurement: Measurement,
    /// How large is the sample?
    pub sample: Sample,
    /// Limits of the robot itself did harm, as its harms tell.
    #[serde(skip)]
    pub has_own_harm: bool,
}

impl Answer {
    /// Draws the answer.
    pub fn of(summary: &RunSummary, assessment: &Assessment) -> Self {
        let accounts = accounts_tested(summary);
        Self {
            hurt: hurt(summary, &assessment.network),
            subject: subject(summary, &assessment.network),
            object: Object::of(summary),
            has_own_harm: summary.harms.iter().any(|one| one.own_count > 0),
            measurement: Measurement {
                is_valid: is_valid(&assessment.network),
                clocks: clocks(summary),
                uncounted_start_count: uncounted_start_count(summary),
                uncounted_process_count: uncounted(summary).count() as u64,
            },
            sample: Sample {
                duration_s: summary.run.duration_s,
                channel_count: accounts.len() as u64,
                message_count: published_count(&accounts),
                occasions: fewest_occasions(&summary.harms).cloned(),
            },
        }
    }

    /// What is asked.
    pub fn question(&self) -> String {
        format!("Did {} hurt {}?", self.subject, self.object)
    }

    /// Why no more can be said, or in how many occasions nothing happened.
    pub(crate) fn reason(&self) -> Option<String> {
        if self.hurt != Hurt::No {
            return self.hurt.reason(self.object);
        }
        let of = if self.has_own_harm {
            "no harm but by limits of the robot"
        } else {
            "no harm"
        };
        Some(match &self.sample.occasions {
            Some(OccasionCount { what, count }) => format!("{of} in {} {what}", grouped(*count)),
            None => format!("{of} in {}", counted(self.sample.message_count, "message")),
        })
    }

    /// The answer to it.
    pub fn words(&self) -> String {
        joined(self.hurt.word(), self.reason())
    }

    /// Up to what a NO excludes harm, in words; `None` of another answer.
    pub(crate) fn no_means(&self) -> Option<String> {
        (self.hurt == Hurt::No).then(|| match &self.sample.occasions {
            Some(OccasionCount { what, count }) => none_means(what, *count),
            None => none_means("messages", self.sample.message_count),
        })
    }

    /// The same as a sentence of its own.
    pub fn sentence(&self) -> String {
        let (subject, object) = (self.subject, self.object);
        match &self.hurt {
            Hurt::Yes => format!("YES, {subject} hurt {object}"),
            Hurt::No => format!("NO, {subject} did not hurt {object}"),
            Hurt::NotResolvable { .. } | Hurt::NotTested { .. } => self.words(),
        }
    }

    /// Green only for an unhurt robot and a measurement that is valid in all its parts.
    pub(crate) const fn tone(&self) -> Tone {
        let Measurement {
            is_valid,
            clocks,
            uncounted_start_count,
            ..
        } = self.measurement;
        let is_whole = uncounted_start_count == 0 && !matches!(clocks, Clocks::Unaligned);
        match (&self.hurt, is_valid) {
            (Hurt::Yes, _) => Tone::Bad,
            (Hurt::No, Some(true)) if is_whole => Tone::Good,
            (Hurt::No | Hurt::NotResolvable { .. } | Hurt::NotTested { .. }, _) => Tone::Caution,
        }
    }

    /// Whether the measurement is valid, in words.
    pub(crate) fn measurement_words(&self, network: &NetworkVerdict) -> (Tone, String) {
        let clocks = match self.measurement.clocks {
            Clocks::NotNeeded => String::new(),
            Clocks::One => "; all hosts read one clock".to_owned(),
            Clocks::Aligned { bound_s } => {
                format!(
                    "; clocks of the hosts agree within ±{}",
                    duration_s(bound_s)
                )
            }
            Clocks::Unaligned => {
                "; one-way delays and the order of events are unavailable: the hosts' clocks are not aligned"
                    .to_owned()
            }
        };
        let uncounted = self.measurement.uncounted_words();
        match invalid_words(network) {
            Some(why) => (Tone::Bad, format!("NOT VALID: {why}")),
            None if self.measurement.is_valid.is_none() => {
                let uncounted = uncounted.filter(|_| *network == NetworkVerdict::HostUnknown);
                let uncounted = uncounted.map_or_else(String::new, |words| format!("; {words}"));
                (
                    Tone::Plain,
                    format!("{}{uncounted}", unmeasured_words(network)),
                )
            }
            None => match (uncounted, self.measurement.clocks) {
                (Some(words), _) => (
                    Tone::Caution,
                    format!("valid as far as known: {words}{clocks}"),
                ),
                (None, Clocks::Unaligned) => {
                    (Tone::Caution, format!("valid in part: {KEPT_UP}{clocks}"))
                }
                (None, _) => (Tone::Plain, format!("valid: {KEPT_UP}{clocks}")),
            },
        }
    }

    /// How large the sample is, `over` which transports, in words.
    pub(crate) fn sample_words(&self, over: &str) -> String {
        let Sample {
            duration_s: length_s,
            channel_count,
            message_count,
            occasions,
        } = &self.sample;
        let length = format!("in {length_s:.1}{JOINT}s{over}");
        match occasions {
            Some(OccasionCount { what, count }) if *count < OCCASIONS_MIN => {
                format!("{count} {what} {length}, too few for a rate, which takes {OCCASIONS_MIN}")
            }
            Some(OccasionCount { what, count }) => format!("{} {what} {length}", grouped(*count)),
            None => {
                let messages = counted(*message_count, "message");
                let channels = counted(*channel_count, "channel");
                format!("{messages} on {channels} {length}")
            }
        }
    }
}

/// What it means that no harm was seen in `count` occasions. Of how many harms come together nothing is known, so an event
/// of them is counted as one, of Poisson's law; the interval has one end (Garwood 1936).
pub(crate) fn none_means(what: &str, count: u64) -> String {
    let most = upper_bound(-1e3 * (1.0 - CONFIDENCE).ln() / count.max(1) as f64);
    let percent = 100.0 * CONFIDENCE;
    format!(
        "none in {} {what}: a rate of up to {most} per 1,000 remains possible ({percent:.0}{JOINT}%)",
        grouped(count)
    )
}

/// A word, and why it is that.
fn joined(word: &str, reason: Option<String>) -> String {
    match reason {
        Some(reason) => format!("{word}: {reason}"),
        None => word.to_owned(),
    }
}

impl Hurt {
    /// The answer in a word or two.
    pub(crate) const fn word(&self) -> &'static str {
        match self {
            Self::Yes => "YES",
            Self::No => "NO",
            Self::NotResolvable { .. } => "CANNOT TELL",
            Self::NotTested { .. } => "NOT TESTED",
        }
    }

    /// Why no more can be said of an object of this kind.
    fn reason(&self, object: Object) -> Option<String> {
        match self {
            Self::Yes | Self::No => None,
            Self::NotResolvable { because } => Some(because.to_string()),
            Self::NotTested {
                because: Untested::NoScore,
            } if object == Object::Programs => Some(
                "no criterion of harm is set; a deadline in [flows.NAME] of the topology is one"
                    .to_owned(),
            ),
            Self::NotTested { because } => Some(because.label().to_owned()),
        }
    }

    /// The answer for an object of this kind.
    pub(crate) fn words(&self, object: Object) -> String {
        joined(self.word(), self.reason(object))
    }
}

impl fmt::Display for Unresolved {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::InvalidMeasurement => formatter.write_str("the measurement is not valid"),
            Self::HostUnknown => formatter.write_str("nothing tells whether the hosts kept up"),
            Self::SampleTooSmall {
                what,
                count,
                needed,
            } => write!(
                formatter,
                "the sample is too small for a NO ({what}: {count}, needed: {needed})"
            ),
            Self::ScoreIncomplete => {
                formatter.write_str("records of what the robot did are missing")
            }
            Self::NotCounted => formatter.write_str("what hurts the robot could not be counted"),
            Self::NoNetworkEventBefore => {
                formatter.write_str("no network event that explains the harm came before it")
            }
            Self::WithinChance => formatter.write_str("what difference there is, chance alone may make"),
            Self::NoInterval { what, why } => {
                write!(formatter, "the difference of {what} has {why}")
            }
            Self::NoScatter { what } => write!(
                formatter,
                "no run differs from another of its side in {what}, and nothing tells how runs scatter"
            ),
            Self::ClocksDiffer => formatter.write_str(
                "the hosts' clocks are not aligned, which leaves open whether a network event came before the harm",
            ),
        }
    }
}

/// Accounts of the channels that crossed a network or a model of one; of all where none did.
fn accounts_tested(summary: &RunSummary) -> Vec<&ChannelAccount> {
    let has_crossed = summary.channels.iter().any(|one| one.link.is_crossing());
    let channels = summary.channels.iter();
    let channels = channels.filter(|one| one.link.is_crossing() || !has_crossed);
    channels.filter_map(|one| one.account.as_ref()).collect()
}

fn published_count(accounts: &[&ChannelAccount]) -> u64 {
    accounts.iter().map(|one| one.published_count).sum()
}

/// Messages that were put to the test.
pub(crate) fn tested_count(summary: &RunSummary) -> u64 {
    published_count(&accounts_tested(summary))
}

/// What there is to say before any harm is looked at; `None` where harms decide.
pub(crate) fn precondition(summary: &RunSummary, network: &NetworkVerdict) -> Option<Hurt> {
    let not_tested = |because| Some(Hurt::NotTested { because });
    let not_resolvable = |because| Some(Hurt::NotResolvable { because });
    match network {
        NetworkVerdict::RunFailed => return not_tested(Untested::RunFailed),
        NetworkVerdict::NoNetwork => return not_tested(Untested::NoNetwork),
        NetworkVerdict::NoForeignProgram => return not_tested(Untested::NoForeignProgram),
        NetworkVerdict::VirtualTime
            if !summary.channels.iter().any(|one| one.link.is_crossing()) =>
        {
            return not_tested(Untested::NoNetwork);
        }
        _ => {}
    }
    if summary.harms.is_empty() {
        not_tested(Untested::NoScore)
    } else if is_valid(network) == Some(false) {
        not_resolvable(Unresolved::InvalidMeasurement)
    } else if *network == NetworkVerdict::HostUnknown {
        not_resolvable(Unresolved::HostUnknown)
    } else if is_score_incomplete(summary) {
        not_resolvable(Unresolved::ScoreIncomplete)
    } else {
        None
    }
}

fn hurt(summary: &RunSummary, network: &NetworkVerdict) -> Hurt {
    let not_resolvable = |because| Hurt::NotResolvable { because };
    if let Some(found) = precondition(summary, network) {
        return found;
    }
    // Whose time it took is known of each request.
    if summary.deadlines.iter().any(|one| one.hurt_count > 0) {
        return Hurt::Yes;
    }
    let harms = summary.harms.iter();
    if harms.map(HarmCount::beyond_own_count).sum::<u64>() > 0 {
        let all = &summary.score_events;
        if all.clocks_differ {
            return not_resolvable(Unresolved::ClocksDiffer);
        }
        let evidence = Evidence::of(summary);
        let mut grave = all
            .events
            .iter()
            .filter(|one| one.severity > Severity::Notice);
        if grave.any(|event| evidence.explains(event)) {
            return Hurt::Yes;
        }
        return not_resolvable(Unresolved::NoNetworkEventBefore);
    }
    if summary.harms.iter().any(|one| one.count.is_none()) {
        return not_resolvable(Unresolved::NotCounted);
    }
    too_few_occasions(&summary.harms, tested_count(summary), OCCASIONS_MIN)
        .map_or(Hurt::No, not_resolvable)
}

/// The harm with the fewest occasions is the least tested: an absence of harm rests on these.
fn fewest_occasions<'a>(
    harms: impl IntoIterator<Item = &'a HarmCount>,
) -> Option<&'a OccasionCount> {
    let occasions = harms.into_iter().filter_map(|harm| harm.occasions.as_ref());
    occasions.min_by_key(|one| one.count)
}

/// Nothing happened in the fewest occasions of a harm, and they are fewer than the `needed` to tell. Harms without occasions
/// are tested by the `message_count` messages that crossed.
pub(crate) fn too_few_occasions<'a>(
    harms: impl IntoIterator<Item = &'a HarmCount>,
    message_count: u64,
    needed: u64,
) -> Option<Unresolved> {
    let (what, count) = match fewest_occasions(harms) {
        Some(OccasionCount { what, count }) => (what.as_str(), *count),
        None => ("messages", message_count),
    };
    (count < needed).then(|| Unresolved::SampleTooSmall {
        what: what.to_owned(),
        count,
        needed,
    })
}

/// What counts as a network's doing before an event of the robot.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evidence {
    /// Share of all moments of the run that have a network event in the seconds before them.
    chance: f64,
    clocks_differ: bool,
}

impl Evidence {
    /// Of a run.
    pub(crate) fn of(summary: &RunSummary) -> Self {
        let network = summary.network.as_ref();
        Self {
            chance: network.map_or(0.0, |report| report.foregoing_chance_ratio),
            clocks_differ: summary.score_events.clocks_differ,
        }
    }

    /// Whether the network lost a message that the event names, or an outage of the channels concerned was under
    /// way or just over, or another network event came before that does not come before most moments anyway.
    /// What a process or a clock of ours did is no network's doing.
    pub(crate) fn explains(self, event: &ExplainedEvent) -> bool {
        if self.clocks_differ {
            return false;
        }
        let mut messages = event.messages.iter();
        let is_lost = messages.any(|one| one.fate.is_some_and(MessageFate::is_loss_by_network));
        let has_outage = event.outages.iter().any(|outage| {
            let is_before = matches!(outage.standing, Standing::UnderWay | Standing::OverFor(_));
            is_before && outage.lost_by_network_count >= OUTAGE_LOST_MIN
        });
        let mut network = event.network.iter().flat_map(|network| &network.events);
        let has_event = network.any(|one| one.event.is_by_network());
        is_lost || has_outage || (self.chance <= CHANCE_MAX && has_event)
    }
}

/// Records of what the robot did are missing, so that what is not in them may have happened.
pub(crate) fn is_score_incomplete(summary: &RunSummary) -> bool {
    summary.channels.iter().any(|channel| {
        let recorded = channel.link == LinkKind::RecordOnly;
        recorded
            && channel.recorded.is_none_or(|found| {
                let all = found.message_count + found.missing_count;
                found.missing_count as f64 > SKIPPED_TICK_RATIO_MAX * all as f64
            })
    })
}

fn subject(summary: &RunSummary, network: &NetworkVerdict) -> Subject {
    let mut links = summary.channels.iter().map(|one| one.link);
    match network {
        NetworkVerdict::VirtualTime => Subject::LinkModel,
        NetworkVerdict::ForeignProgram | NetworkVerdict::NoForeignProgram => {
            Subject::ForeignNetwork
        }
        _ if links.any(|link| link == LinkKind::Emulated) => Subject::EmulatedLink,
        _ => Subject::Network,
    }
}

/// What there is in place of a measurement.
const fn unmeasured_words(network: &NetworkVerdict) -> &'static str {
    match network {
        NetworkVerdict::VirtualTime => {
            "none: a simulation, whose answer is of its link models and of no real network"
        }
        NetworkVerdict::RunFailed => "none: the run failed",
        NetworkVerdict::HostUnknown => "unknown: nothing that ran tells whether the hosts kept up",
        _ => "none: nothing went over a network",
    }
}

/// What makes a measurement valid.
const KEPT_UP: &str = "hosts and links kept up";

/// With what a reader may not know.
pub(crate) fn with_note(words: String, note: &str) -> String {
    match note {
        "" => words,
        note => format!("{words} ({note})"),
    }
}

impl Measurement {
    /// What the judgement cannot rest on; `None` where everything was counted.
    fn uncounted_words(&self) -> Option<String> {
        let count = self.uncounted_process_count;
        (count > 0).then(|| {
            let processes = counted(count, "killed or restarted process");
            format!("what {processes} dropped or skipped is unknown")
        })
    }
}

/// Why a measurement is not valid, in words.
fn invalid_words(network: &NetworkVerdict) -> Option<String> {
    let repeat = "repeat on an idle host or at a lower rate";
    Some(match network {
        NetworkVerdict::EmulationNotKept { channels } => {
            let channels = named(channels, NAMED_COUNT);
            format!("the host could not keep the emulated link of {channels}; {repeat}")
        }
        NetworkVerdict::HostOverran { processes } => {
            let skipped: u64 = processes.iter().map(|one| one.skipped_tick_count).sum();
            let due: u64 = processes.iter().map(|one| one.due_tick_count).sum();
            let names: Vec<&str> = processes.iter().map(|one| one.process.as_str()).collect();
            let names = named(&names, NAMED_COUNT);
            let share = percent(skipped as f64 / due.max(1) as f64);
            let ticks = format!("{} of {} ticks", grouped(skipped), grouped(due));
            let most = percent(SKIPPED_TICK_RATIO_MAX);
            format!(
                "the host overran: {ticks} were skipped ({share}, the limit is {most}) by {names}; {repeat}"
            )
        }
        NetworkVerdict::ReceiverLate { channels, loss } => {
            let flows = named(channels, NAMED_COUNT);
            format!(
                "receiving gateways were late: no room in the receive buffer of {flows} for {}; what was lost so, \
                 or perhaps so, is no loss of the network; {repeat}",
                loss.words("datagrams")
            )
        }
        NetworkVerdict::GatewayLate { channels, loss } => {
            let channels = named(channels, NAMED_COUNT);
            format!(
                "gateways were late: {} of {channels} were replaced by newer ones or waited on their host for more \
                 than {}, which is in the delays; {repeat}",
                loss.words("messages"),
                duration_s(HELD_MAX_NS as f64 * 1e-9)
            )
        }
        NetworkVerdict::FramesLost { channels, loss } => {
            let channels = named(channels, NAMED_COUNT);
            format!(
                "processes, queues or inlets of a host lost {} of {channels}, of which the network might have lost \
                 some: its loss is known to +{} only; {repeat}",
                loss.words("frames"),
                loss.share()
            )
        }
        NetworkVerdict::TicksUnknown => "a component left no count of its ticks".to_owned(),
        NetworkVerdict::RecordsMissing { hosts } => {
            let hosts = named(hosts, NAMED_COUNT);
            format!("records are missing on {hosts}")
        }
        NetworkVerdict::RunFailed
        | NetworkVerdict::VirtualTime
        | NetworkVerdict::NoNetwork
        | NetworkVerdict::NoForeignProgram
        | NetworkVerdict::HostUnknown
        | NetworkVerdict::ForeignProgram
        | NetworkVerdict::EmulatedLink
        | NetworkVerdict::NetworkResult => return None,
    })
}

/// `None` where nothing was measured, or nothing tells.
pub(crate) const fn is_valid(network: &NetworkVerdict) -> Option<bool> {
    match network {
        NetworkVerdict::RunFailed
        | NetworkVerdict::VirtualTime
        | NetworkVerdict::NoNetwork
        | NetworkVerdict::NoForeignProgram
        | NetworkVerdict::HostUnknown => None,
        NetworkVerdict::ForeignProgram
        | NetworkVerdict::EmulatedLink
        | NetworkVerdict::NetworkResult => Some(true),
        NetworkVerdict::EmulationNotKept { .. }
        | NetworkVerdict::HostOverran { .. }
        | NetworkVerdict::ReceiverLate { .. }
        | NetworkVerdict::GatewayLate { .. }
        | NetworkVerdict::FramesLost { .. }
        | NetworkVerdict::TicksUnknown
        | NetworkVerdict::RecordsMissing { .. } => Some(false),
    }
}

fn clocks(summary: &RunSummary) -> Clocks {
    let Some(report) = summary.network.as_ref() else {
        return Clocks::NotNeeded;
    };
    let section = summary.clocks.as_ref();
    if section.is_some_and(|ClockSection { has_one_clock, .. }| *has_one_clock) {
        return Clocks::One;
    }
    match report.clock_bound_s {
        _ if report.clocks_differ => Clocks::Unaligned,
        Some(bound_s) if bound_s > 0.0 => Clocks::Aligned { bound_s },
        Some(_) => Clocks::One,
        None => Clocks::Unaligned,
    }
}
