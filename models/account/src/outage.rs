//! Outages: the times in which a channel delivered nothing of what was published. It finds them
//! in the records of messages, whatever lost these, sorts them by length, and says which of them
//! went before something that happened. What caused an event is not decided here.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::history::MessageHistory;
use super::stage::{MessageFate, Side};
use hil_core::record::stamp;
use hil_core::time::{Instant, duration_ns};

/// How long after its end an outage may still show in what a robot does: a session that it ended
/// takes seconds to come back.
pub const OUTAGE_EFFECT_MAX: Duration = Duration::from_secs(5);

/// Where the classes of [`OutageMetrics::classes`] border on each other, milliseconds.
const BORDERS_MS: [i64; 6] = [20, 100, 500, 1_000, 2_000, 5_000];

/// One outage: messages lost in a row, up to the next one that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outage {
    /// Messages lost in it. One that was replaced by a newer one before it was sent, or whose
    /// fate is unknown, says nothing about the way: it neither counts nor ends an outage.
    pub lost_count: u64,
    /// Of these, lost by the network for certain, see [`MessageFate::is_loss_by_network`].
    pub lost_by_network_count: u64,
    /// Sequence number of the first of them.
    pub first_sequence: u64,
    /// When the first of them was published, on the producer's clock, nanoseconds; `None` when
    /// no record of any of them is at hand.
    pub from_ns: Option<i64>,
    /// When the next message that arrived was published, on the producer's clock; `None` when
    /// none did.
    pub until_ns: Option<i64>,
    /// When the consumer would have taken the first of them, on the consumer's clock: as fast as
    /// the last message it took before, or else the next one after; no alignment of clocks is
    /// needed for that. `None` when it took neither, or its records are not at hand.
    pub silent_from_ns: Option<i64>,
    /// When the consumer took its next message; `None` when it never did.
    pub silent_until_ns: Option<i64>,
    /// Index of the interruption that cost the first of the messages, when it was lost in one.
    pub interruption_index: Option<usize>,
}

impl Outage {
    /// From the first lost publication to the next one that arrived, or to `end` when none did,
    /// nanoseconds; both on the producer's clock.
    pub fn length_ns(&self, end: Option<Instant>) -> Option<i64> {
        let until_ns = self.until_ns.or_else(|| end.map(Instant::as_ns))?;
        Some(until_ns.saturating_sub(self.from_ns?).max(0))
    }

    /// Beginning and end as one side's clock has them.
    const fn span_ns(&self, side: Side) -> (Option<i64>, Option<i64>) {
        match side {
            Side::Producer => (self.from_ns, self.until_ns),
            Side::Consumer => (self.silent_from_ns, self.silent_until_ns),
        }
    }
}

/// Finds outages in messages that are told in the order of their sequence numbers.
#[derive(Debug, Default)]
pub struct OutageFinder {
    found: Vec<Outage>,
    is_open: bool,
    /// From here on, the consumer has taken nothing since.
    silent_index: usize,
    last_taken: Option<TakenAt>,
}

/// One message that was taken, on both clocks.
#[derive(Debug, Clone, Copy)]
struct TakenAt {
    published_ns: i64,
    taken_ns: i64,
}

impl TakenAt {
    /// When a message published at `published_ns` would have been taken, had it been as fast.
    const fn would_take_ns(self, published_ns: i64) -> i64 {
        let later_ns = published_ns.saturating_sub(self.published_ns);
        self.taken_ns.saturating_add(later_ns)
    }
}

impl OutageFinder {
    /// `count` messages from `sequence` on were lost, by the network for certain or not; the first was
    /// published at `published_ns`, where that is known.
    pub fn lost(
        &mut self,
        sequence: u64,
        count: u64,
        published_ns: Option<i64>,
        is_by_network: bool,
    ) {
        if !self.is_open {
            self.is_open = true;
            self.found.push(Outage {
                lost_count: 0,
                lost_by_network_count: 0,
                first_sequence: sequence,
                from_ns: None,
                until_ns: None,
                silent_from_ns: None,
                silent_until_ns: None,
                interruption_index: None,
            });
        }
        let last_taken = self.last_taken;
        if let Some(outage) = self.found.last_mut() {
            outage.lost_count = outage.lost_count.saturating_add(count);
            if is_by_network {
                outage.lost_by_network_count = outage.lost_by_network_count.saturating_add(count);
            }
            outage.from_ns = outage.from_ns.or(published_ns);
            let would_take_ns = || Some(last_taken?.would_take_ns(outage.from_ns?));
            outage.silent_from_ns = outage.silent_from_ns.or_else(would_take_ns);
        }
    }

    /// A message that was published at `published_ns` got through; at `taken_ns` the consumer
    /// took it, if it did.
    pub fn arrived(&mut self, published_ns: Option<i64>, taken_ns: Option<i64>) {
        if core::mem::take(&mut self.is_open)
            && let Some(outage) = self.found.last_mut()
        {
            outage.until_ns = published_ns;
        }
        let (Some(published_ns), Some(taken_ns)) = (published_ns, taken_ns) else {
            return;
        };
        let taken = TakenAt {
            published_ns,
            taken_ns,
        };
        for outage in &mut self.found[self.silent_index..] {
            outage.silent_until_ns = Some(taken_ns);
            let would_take_ns = || Some(taken.would_take_ns(outage.from_ns?));
            outage.silent_from_ns = outage.silent_from_ns.or_else(would_take_ns);
        }
        self.silent_index = self.found.len();
        self.last_taken = Some(taken);
    }

    /// The outages, in order.
    pub fn finish(self) -> Vec<Outage> {
        self.found
    }

    /// Adds a message; they come in the order in which they settle.
    pub fn add(&mut self, message: &MessageHistory) {
        let published_ns = message.published_ns();
        match message.fate {
            MessageFate::Taken | MessageFate::SupersededAtConsumer => {
                let taken_ns = message.taken.and_then(|record| stamp(record.taken_ns));
                self.arrived(published_ns, taken_ns);
            }
            // What its consumer made of it is unknown, but it got through.
            MessageFate::UnknownPeerRecordsUnavailable if message.arrived().is_some() => {
                self.arrived(published_ns, None);
            }
            fate if fate.is_loss() => {
                let is_first = !self.is_open;
                let is_by_network = fate.is_loss_by_network();
                self.lost(
                    message.key.sequence,
                    message.count,
                    published_ns,
                    is_by_network,
                );
                if let Some(outage) = self.found.last_mut().filter(|_| is_first) {
                    outage.interruption_index = message.interruption_index;
                }
            }
            _ => {}
        }
    }
}

/// The outages of a channel in figures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutageMetrics {
    /// How many.
    pub outage_count: u64,
    /// Messages lost in all of them.
    pub lost_count: u64,
    /// Their lengths added up, nanoseconds.
    pub total_ns: i64,
    /// How many of each length, from the shortest class to the longest.
    pub classes: Vec<OutageClass>,
    /// Those whose length is unknown: no record tells when they began, or when the run ended.
    pub unknown_length_count: u64,
    /// The longest.
    pub longest: Option<LongestOutage>,
}

/// Outages of about one length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutageClass {
    /// Shortest length that belongs here, nanoseconds.
    pub from_ns: i64,
    /// Shortest length that does not belong here any more; `None` for the last class.
    pub until_ns: Option<i64>,
    /// Outages.
    pub outage_count: u64,
    /// Messages lost in them.
    pub lost_count: u64,
}

/// The longest outage of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LongestOutage {
    /// Publication of its first lost message, nanoseconds after the start of the run in a report; on the
    /// producer's clock where they are drawn up, and when that start is unknown.
    pub start_ns: i64,
    /// Length, nanoseconds.
    pub length_ns: i64,
    /// Messages lost in it.
    pub lost_count: u64,
    /// Sequence number of the first of them.
    pub first_sequence: u64,
    /// True when it lasted to the end of the run.
    pub is_open: bool,
}

impl OutageMetrics {
    /// The figures of `outages`; `end` of the run is on the producer's clock.
    pub fn of(outages: &[Outage], end: Option<Instant>) -> Self {
        let mut figures = Self {
            outage_count: outages.len() as u64,
            lost_count: 0,
            total_ns: 0,
            classes: empty_classes(),
            unknown_length_count: 0,
            longest: None,
        };
        for outage in outages {
            figures.lost_count = figures.lost_count.saturating_add(outage.lost_count);
            let known = outage.from_ns.zip(outage.length_ns(end));
            let Some((from_ns, length_ns)) = known else {
                figures.unknown_length_count += 1;
                continue;
            };
            figures.total_ns = figures.total_ns.saturating_add(length_ns);
            let mut classes = figures.classes.iter_mut().rev();
            if let Some(class) = classes.find(|class| class.from_ns <= length_ns) {
                class.outage_count += 1;
                class.lost_count = class.lost_count.saturating_add(outage.lost_count);
            }
            let is_longest = figures.longest.is_none_or(|one| one.length_ns < length_ns);
            if is_longest {
                figures.longest = Some(LongestOutage {
                    start_ns: from_ns,
                    length_ns,
                    lost_count: outage.lost_count,
                    first_sequence: outage.first_sequence,
                    is_open: outage.until_ns.is_none(),
                });
            }
        }
        figures
    }
}

fn empty_classes() -> Vec<OutageClass> {
    let borders_ns = BORDERS_MS.map(|border_ms| border_ms * 1_000_000);
    let begins = core::iter::once(0).chain(borders_ns);
    let ends = borders_ns.into_iter().map(Some).chain([None]);
    let class = |(from_ns, until_ns)| OutageClass {
        from_ns,
        until_ns,
        outage_count: 0,
        lost_count: 0,
    };
    begins.zip(ends).map(class).collect()
}

/// What a channel went through when something happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Preceding {
    /// The outage that has most to do with it.
    pub outage: Outage,
    /// How the two stand to each other in time.
    pub standing: Standing,
    /// Other outages of the channel about then.
    pub other_count: u64,
}

/// How an outage stands to an event in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Standing {
    /// It was under way.
    UnderWay,
    /// It was over, since so many nanoseconds.
    OverFor(i64),
    /// It began only then, although the event names a message that was lost in it: an event may
    /// be told of its beginning.
    BegunLater,
    /// Their clocks do not compare.
    Unknown,
}

/// An event, as an outage may be held against it.
#[derive(Debug, Clone, Copy)]
pub struct EventTime<'a> {
    /// When it happened, on the clock of a host on this side of the channel; `None` when there is
    /// no such time.
    pub at: Option<(Instant, Side)>,
    /// When messages of the channel that it names and that were lost were published, on the
    /// producer's clock.
    pub lost_published_ns: &'a [i64],
}

/// Of `outages`, the one that has most to do with what happened: one in which a named message was
/// lost; else one that was under way, or over for at most [`OUTAGE_EFFECT_MAX`]. Among several it
/// is the one that had lasted longest by then, for what came after an event cannot have led to
/// it.
pub fn preceding(outages: &[Outage], event: &EventTime<'_>) -> Option<Preceding> {
    let mut candidate_count = 0_u64;
    let mut best: Option<((bool, i64), Preceding)> = None;
    let named = event.lost_published_ns;
    let first_ns = named.iter().min().copied();
    let last_ns = named.iter().max().copied();
    for outage in outages {
        // Of many outages, few are near the named messages.
        let is_far =
            outage.until_ns < first_ns && outage.until_ns.is_some() || outage.from_ns > last_ns;
        let names_one = !is_far && named.iter().any(|ns| outage.contains(*ns));
        let timely = event.at.and_then(|(at, side)| outage.standing(at, side));
        let (standing, passed_ns) = match timely {
            Some(timely) => timely,
            None if names_one => outage.standing_anyway(event.at),
            None => continue,
        };
        candidate_count += 1;
        let rank = (names_one, passed_ns);
        if best.is_none_or(|(highest, _)| highest < rank) {
            let preceding = Preceding {
                outage: *outage,
                standing,
                other_count: 0,
            };
            best = Some((rank, preceding));
        }
    }
    let (_, found) = best?;
    Some(Preceding {
        other_count: candidate_count - 1,
        ..found
    })
}

impl Outage {
    /// True for a message that was published in it, at `published_ns` on the producer's clock.
    pub fn contains(&self, published_ns: i64) -> bool {
        let is_before_end = self.until_ns.is_none_or(|until_ns| published_ns < until_ns);
        self.from_ns.is_some_and(|from_ns| from_ns <= published_ns) && is_before_end
    }

    /// How it stands to an event that it may have led to, and how long it had lasted by then,
    /// nanoseconds.
    fn standing(&self, at: Instant, side: Side) -> Option<(Standing, i64)> {
        let at_ns = at.as_ns();
        let (from_ns, until_ns) = self.span_ns(side);
        let (from_ns, until_ns) = (from_ns?, until_ns.unwrap_or(i64::MAX));
        let over_ns = at_ns.saturating_sub(until_ns);
        if from_ns > at_ns || over_ns > duration_ns(OUTAGE_EFFECT_MAX) {
            return None;
        }
        let passed_ns = until_ns.min(at_ns).saturating_sub(from_ns);
        let standing = if over_ns < 0 {
            Standing::UnderWay
        } else {
            Standing::OverFor(over_ns)
        };
        Some((standing, passed_ns))
    }

    /// The same for an event that it has to do with at any rate.
    fn standing_anyway(&self, at: Option<(Instant, Side)>) -> (Standing, i64) {
        let Some((at, side)) = at else {
            let length_ns = self.length_ns(None);
            return (Standing::Unknown, length_ns.unwrap_or(i64::MAX));
        };
        match self.span_ns(side) {
            (None, _) => (Standing::Unknown, 0),
            (Some(from_ns), _) if from_ns > at.as_ns() => (Standing::BegunLater, 0),
            (_, until_ns) => {
                let over_ns = at.as_ns().saturating_sub(until_ns.unwrap_or(at.as_ns()));
                (Standing::OverFor(over_ns), 0)
            }
        }
    }
}

#[cfg(test)]
#[path = "outage_tests.rs"]
mod tests;
