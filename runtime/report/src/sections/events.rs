//! What happened to the robot with the messages and the network before it, and what happened on the network.

use core::cmp::Reverse;

use hil_account::MessageFate;
use hil_account::network::NetworkEventKind;
use hil_core::case_study::Severity;
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::{duration_s, percent, seconds};
use hil_present::{Block, Event, EventList, Section, Tone, UNAVAILABLE};

use crate::answer::{CHANCE_MAX, Evidence};
use crate::network::{NetworkReport, PrecedingNetwork, TimedEvent};
use crate::score_event::{ExplainedEvent, ExplainedMessage, ScoreEvents};
use crate::summary::RunSummary;

/// Events of the robot that are listed; all of them are in the summary.
const EVENTS_MAX: usize = 200;
/// Messages and events of the network that are listed beside each.
const MESSAGES_SHOWN_COUNT: usize = 6;
const NETWORK_SHOWN_COUNT: usize = 3;
/// Events of the network that are listed: under independent losses there are hundreds alike.
const NETWORK_EVENTS_MAX: usize = 40;

/// What is said of a robot to which nothing happened.
const NOTHING_GRAVE: &str = "no incident and no hazard";

/// The head of what happened to the robot; whether there is more to say of its events, of which `count` are to be listed.
pub(crate) fn robot_head(summary: &RunSummary, title: &str, count: u64) -> (Section, bool) {
    let mut section = Section::new("robot", title, "");
    if summary.run.case.is_empty() {
        return (section, false);
    }
    if let Some(words) = summary.no_score_words() {
        section.note(Tone::Caution, words);
        return (section, false);
    }
    section.aside = severity_counts(&summary.score_events);
    if count == 0 {
        section.note(Tone::Plain, NOTHING_GRAVE);
    }
    (section, count > 0)
}

/// What happened to the robot, the gravest events where there are too many, in order of time.
pub(super) fn robot(summary: &RunSummary) -> Section {
    let title = "What happened to the robot, and the network before it";
    let all = &summary.score_events;
    let (mut section, has_events) = robot_head(summary, title, all.total_count());
    if !has_events {
        return section;
    }
    if all.clocks_differ {
        let text = "Clocks are not aligned: each time counts from the start of the run on the \
                    host named with it, and times of different hosts do not compare.";
        section.note(Tone::Caution, text);
    }
    if let Some(words) = dropped_words(all) {
        section.note(Tone::Caution, words);
    }
    let mut note = String::new();
    let kept = all.events.len();
    if kept > EVENTS_MAX {
        let total = grouped(all.total_count());
        let those = if all.dropped_count == 0 {
            "all".to_owned()
        } else {
            grouped(kept as u64)
        };
        note = format!(
            "the {EVENTS_MAX} gravest of {total}; {those} are in events.log and summary.json"
        );
    }
    let events = gravest(&all.events, EVENTS_MAX).into_iter();
    let events = events.map(|one| event(one, all.clocks_differ)).collect();
    section
        .blocks
        .push(Block::Events(EventList { events, note }));
    section
}

/// The `count` gravest events, the earlier ones first among equals, in the order of the score.
pub(crate) fn gravest(events: &[ExplainedEvent], count: usize) -> Vec<&ExplainedEvent> {
    let mut order: Vec<usize> = (0..events.len()).collect();
    order.sort_by_key(|index| Reverse(events[*index].severity));
    order.truncate(count);
    order.sort_unstable();
    order.into_iter().map(|index| &events[index]).collect()
}

/// How many of the events are in no list, where the score had no room for all.
fn dropped_words(all: &ScoreEvents) -> Option<String> {
    (all.dropped_count > 0).then(|| {
        format!(
            "{} of {} events found no room in the score and are counted only",
            grouped(all.dropped_count),
            grouped(all.total_count())
        )
    })
}

/// How many there are of each severity, listed or not.
fn severity_counts(all: &ScoreEvents) -> String {
    format!(
        "{} (must not happen), {} (nearly one), {}",
        counted(all.count_of(Severity::Incident), "incident"),
        counted(all.count_of(Severity::Hazard), "hazard"),
        counted(all.count_of(Severity::Notice), "notice"),
    )
}

/// Incidents and hazards.
pub(crate) fn grave_count(all: &ScoreEvents) -> u64 {
    all.count_of(Severity::Incident) + all.count_of(Severity::Hazard)
}

/// How grave an event is.
pub(crate) const fn severity_tone(severity: Severity) -> Tone {
    match severity {
        Severity::Incident => Tone::Bad,
        Severity::Hazard => Tone::Caution,
        Severity::Notice => Tone::Plain,
    }
}

fn event(event: &ExplainedEvent, clocks_differ: bool) -> Event {
    let at = event.at_s.map_or_else(|| UNAVAILABLE.to_owned(), seconds);
    let what = if clocks_differ {
        format!("{} (clock of {})", event.what, event.clock)
    } else {
        event.what.clone()
    };
    let mut beside: Vec<String> = event.outages.iter().map(|one| one.words.clone()).collect();
    beside.extend(
        event
            .network
            .iter()
            .flat_map(|network| before(event, network)),
    );
    let messages = event.messages.iter().take(MESSAGES_SHOWN_COUNT);
    beside.extend(messages.map(message));
    let hidden = event.messages.len().saturating_sub(MESSAGES_SHOWN_COUNT) as u64;
    let more = hidden.saturating_add(event.messages_dropped_count);
    if more > 0 {
        beside.push(format!("and {} more messages", grouped(more)));
    }
    Event {
        at,
        severity: event.severity_word(),
        tone: severity_tone(event.severity),
        what,
        beside,
    }
}

/// What the network went through before `event`, unless an outage of it says so already.
fn before(event: &ExplainedEvent, network: &PrecedingNetwork) -> Vec<String> {
    if network.events.is_empty() {
        return vec![network.nothing_words()];
    }
    let rest = event.network_beside();
    let shown = rest.iter().take(NETWORK_SHOWN_COUNT);
    let mut words: Vec<String> = shown.map(|one| one.words.clone()).collect();
    let hidden = rest.len().saturating_sub(NETWORK_SHOWN_COUNT) as u64 + network.more_count;
    if hidden > 0 {
        let window = duration_s(network.foregoing_s);
        let hidden = grouped(hidden);
        words.push(format!(
            "and {hidden} more on the network in the {window} before"
        ));
    }
    words
}

/// Which message, when it was published, and its fate.
fn message(message: &ExplainedMessage) -> String {
    let at = message.published_at_s.map(seconds);
    let at = at.map_or_else(String::new, |at| format!(" at {at}"));
    let number = grouped(message.sequence);
    format!("{} {number}{at}: {}", message.channel, message.words)
}

/// The network event that has most to do with `event`. Where most moments of the run have one before them, losses as
/// losses all over the run make them are none: in their place stands what the channel lost then and in the whole run.
pub(crate) fn cause(event: &ExplainedEvent, report: Option<&NetworkReport>) -> String {
    // What the network did stands before what a process or a host did; with the messages that it lost in a row.
    let of = |is_meant: fn(bool) -> bool| {
        let mut outages = event.outages.iter();
        let outage = outages.find(|one| is_meant(one.lost_by_network_count > 0));
        let beside = event.network_beside().into_iter();
        let mut beside = beside.filter(|one| is_meant(one.event.is_by_network()));
        let mut lost = event.messages.iter().filter(|one| {
            let fate = one.fate.filter(|fate| fate.is_loss());
            fate.is_some_and(|fate| is_meant(fate.is_loss_by_network()))
        });
        outage
            .map(|one| (one.words.clone(), one.lost_by_network_count))
            .or_else(|| {
                let one = beside.next()?;
                let count = match one.event.kind {
                    NetworkEventKind::Outage { lost_count, .. } => lost_count,
                    NetworkEventKind::LossBurst { .. } => 1,
                    _ => 0,
                };
                Some((one.words.clone(), count))
            })
            .or_else(|| {
                let lost = lost.next()?;
                let number = grouped(lost.sequence);
                let is_by_network = lost.fate.is_some_and(MessageFate::is_loss_by_network);
                let words = format!("{} {number}: {}", lost.channel, lost.words);
                Some((words, u64::from(is_by_network)))
            })
    };
    let found = of(|is_network| is_network).or_else(|| of(|_| true));
    let usual = report.and_then(|report| UsualLosses::of(event, report));
    match (found, usual) {
        (None, Some(usual)) => usual.words,
        (Some((_, count)), Some(usual)) if usual.make(count) => usual.words,
        (Some((words, _)), _) => words,
        (None, None) => event.network.as_ref().map_or_else(
            || "nothing is known of the network".to_owned(),
            PrecedingNetwork::nothing_words,
        ),
    }
}

/// What a channel loses all over a run.
struct UsualLosses {
    /// Of the whole run.
    ratio: f64,
    /// Messages before the event.
    sent_count: u64,
    /// What it lost before the event, and in the whole run.
    words: String,
}

impl UsualLosses {
    /// Those of the channel that `event` concerns most, in a run most of whose moments have a network event before them.
    fn of(event: &ExplainedEvent, report: &NetworkReport) -> Option<Self> {
        let network = event.network.as_ref()?;
        if report.foregoing_chance_ratio <= CHANCE_MAX {
            return None;
        }
        let missing = event.messages.iter().filter(|one| {
            let fate = one.fate;
            fate.is_some_and(MessageFate::is_loss_by_network)
        });
        let outages = event.outages.iter();
        let outages = outages.filter(|one| one.lost_by_network_count > 0);
        let named = missing.map(|one| &one.channel);
        let mut named = named.chain(outages.map(|one| &one.channel));
        let mut losses = network.losses.iter();
        let loss = match named.next() {
            Some(channel) => losses.find(|one| one.channel == *channel)?,
            None => losses.next()?,
        };
        let mut channels = report.channels.iter();
        let channel = channels.find(|one| one.channel == loss.channel)?;
        let ratio = channel.figures.loss.measured()?.ratio;
        let [share, whole] = [loss.ratio(), ratio].map(percent);
        let window = duration_s(network.foregoing_s);
        Some(Self {
            ratio,
            sent_count: loss.sent_count,
            words: format!(
                "losses all along: {} lost {share} in the {window} before, {whole} in the whole run",
                loss.channel
            ),
        })
    }

    /// Whether independent losses of the same share make a row of `count` in the same time.
    fn make(&self, count: u64) -> bool {
        let expected = self.sent_count as f64 * (1.0 - self.ratio) * self.ratio.powf(count as f64);
        count > 0 && expected >= 1.0
    }
}

/// Incidents, then hazards, each in order of time.
pub(crate) fn gravest_first(events: &[ExplainedEvent]) -> Vec<&ExplainedEvent> {
    let grave = events.iter().filter(|one| one.severity > Severity::Notice);
    let mut grave: Vec<&ExplainedEvent> = grave.collect();
    grave.sort_by_key(|one| Reverse(one.severity));
    grave
}

/// The gravest event that the network explains with its time, and what the network did before it.
pub(crate) fn gravest_harm(summary: &RunSummary) -> Option<(String, String)> {
    let evidence = Evidence::of(summary);
    let mut gravest = gravest_first(&summary.score_events.events).into_iter();
    let event = gravest.find(|event| evidence.explains(event))?;
    let at = event.at_s.map(|at_s| format!("at {}: ", seconds(at_s)));
    let cause = cause(event, summary.network.as_ref());
    Some((at.unwrap_or_default() + &event.what, cause))
}

/// What happened on the network, the longest events.
pub(super) fn network(report: &NetworkReport) -> Section {
    let mut section = Section::new("network-events", "What happened on the network", "");
    section.is_folded = true;
    let chosen = longest(&report.events);
    let shown = chosen.len() as u64;
    let total = report.events.len() as u64 + report.events_dropped_count;
    if total == 0 {
        return section;
    }
    let listed = chosen.into_iter().map(|event| Event {
        at: seconds(event.from_s),
        severity: "network",
        tone: Tone::Plain,
        what: event.words(),
        beside: Vec::new(),
    });
    let chance = percent(report.foregoing_chance_ratio);
    let window = duration_s(report.foregoing_s);
    let mut note = format!(
        "{chance} of all moments of the run have such an event in the {window} before them: so much would \
         stand before an event of the score by chance."
    );
    if total > shown {
        let (shown, total) = (grouped(shown), grouped(total));
        note.push_str(&[" The ", &shown, " longest of ", &total, " events"].concat());
        note.push_str(&[": ", &kinds(&report.events), ". All are in summary.json"].concat());
        if report.events_dropped_count > 0 {
            let dropped = grouped(report.events_dropped_count);
            note.push_str(&[", but for ", &dropped, " that found no room"].concat());
        }
        note.push('.');
    }
    let events = listed.collect();
    section
        .blocks
        .push(Block::Events(EventList { events, note }));
    section
}

/// The longest events, in order of time; what lasts to the end is the longest.
fn longest(events: &[TimedEvent]) -> Vec<&TimedEvent> {
    let mut chosen: Vec<&TimedEvent> = events.iter().collect();
    if chosen.len() > NETWORK_EVENTS_MAX {
        chosen.sort_by(|a, b| b.length_s().total_cmp(&a.length_s()));
        chosen.truncate(NETWORK_EVENTS_MAX);
        chosen.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
    }
    chosen
}

/// How many there are of each kind.
fn kinds(events: &[TimedEvent]) -> String {
    let words = [
        "outage",
        "burst of losses",
        "delay",
        "reordering",
        "process down",
        "clock step",
    ];
    let mut counts = [0_u64; 6];
    for event in events {
        let index = match event.kind {
            NetworkEventKind::Outage { .. } => 0,
            NetworkEventKind::LossBurst { .. } => 1,
            NetworkEventKind::Delay { .. } => 2,
            NetworkEventKind::Reordering { .. } => 3,
            NetworkEventKind::ProcessDown { .. } => 4,
            NetworkEventKind::ClockStep { .. } => 5,
        };
        counts[index] += 1;
    }
    let of = words.iter().zip(counts).filter(|(_, count)| *count > 0);
    let of = of.map(|(word, count)| format!("{word} {}", grouped(count)));
    of.collect::<Vec<_>>().join(", ")
}
