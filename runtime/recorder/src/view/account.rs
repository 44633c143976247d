//! The account of one channel while its run goes on: how often, how long, how many lost. It says
//! less than the account of a finished run: what is not known yet is no loss.

use std::collections::{BTreeMap, VecDeque};

use hil_rundir::live_run::Stage;
use hil_stats::histogram::LatencySummary;
use hil_watch::Record;
use serde_json::{Value, json};

use super::facts::ChannelFacts;
use super::{Body, LiveRecord, seconds};
use crate::net::{MessageId, MessageLatency, Noted};

/// A message that has not arrived so long after it was handed over counts as lost.
const LOST_AFTER_NS: i64 = 1_000_000_000;
/// A message that arrives all the same within this time is taken back from the lost.
const REMEMBERED_NS: i64 = 30_000_000_000;
/// Messages under way, and lost ones remembered, at most; beyond, the oldest are forgotten.
const UNDER_WAY_MAX: usize = 50_000;
/// Periods of silence after which a link is called silent, and the least time.
const SILENT_PERIODS: i64 = 5;
const SILENT_NS: i64 = 500_000_000;
/// Messages after which their period is known.
const RHYTHM_COUNT: u64 = 32;
/// Numbers listed of one loss event.
const LISTED_MAX: usize = 64;
/// Single messages shown each time that messages are settled, ten times a second.
const SHOWN_MAX: usize = 5;

/// One channel.
#[derive(Debug, Default)]
pub(crate) struct Account {
    way: Way,
    is_by_message: bool,
    under_way: BTreeMap<MessageId, Joined>,
    lost: BTreeMap<MessageId, i64>,
    /// Per start of the producer, the highest number that arrived.
    newest: BTreeMap<u32, u64>,
    /// Lost since they were last told, with their publication.
    untold: Vec<(u64, Option<i64>)>,
    /// Complete messages to show.
    shown: Vec<MessageLatency>,
    counts: Counts,
    rate: Recent,
    window_lost: Recent,
    lengths: [Samples; LENGTHS],
    left_ns: Option<i64>,
    arrived_ns: Option<i64>,
    period_ns: i64,
}

/// Of a stage that has no record here, nothing is known.
#[derive(Debug, Default)]
struct Counts {
    published: Option<u64>,
    sent: Option<u64>,
    received: Option<u64>,
    taken: Option<u64>,
    lost: u64,
    forgotten: u64,
}

impl Counts {
    /// Records of a stage are written by a process of its own and may be read before those of the
    /// stage before: what was received or taken was published.
    fn published(&self) -> Option<u64> {
        let later = self.received.max(self.taken).unwrap_or(0);
        self.published.map(|count| count.max(later))
    }
}

fn count(of: &mut Option<u64>) {
    *of = Some(of.unwrap_or(0) + 1);
}

impl Account {
    /// The account of `channel`; `has_one_clock` says that stamps of both ends compare.
    pub(crate) fn new(channel: &ChannelFacts, has_one_clock: bool) -> Self {
        let way = Way {
            has_link: channel.link.is_some(),
            has_one_clock,
        };
        Self {
            way,
            is_by_message: channel.is_by_message,
            ..Self::default()
        }
    }

    /// Stamps of both ends compare from now on.
    pub(crate) const fn compare_clocks(&mut self) {
        self.way.has_one_clock = true;
    }

    /// Takes a record of the channel.
    pub(crate) fn take(&mut self, record: &LiveRecord) {
        let at_ns = record.at_ns;
        let Body::Record(record) = &record.body else {
            if self.is_by_message {
                count(&mut self.counts.published);
                self.rate.add(at_ns, 1);
            }
            return;
        };
        let Some(noted) = Noted::of(record) else {
            return;
        };
        match noted.stage {
            Stage::Published => {
                count(&mut self.counts.published);
                self.rate.add(at_ns, 1);
            }
            Stage::Taken => count(&mut self.counts.taken),
            Stage::Sent => {
                count(&mut self.counts.sent);
                self.left_ns = Some(at_ns);
            }
            Stage::Received => self.arrive(noted.message, at_ns),
        }
        self.update(noted.message, at_ns, record);
    }

    fn arrive(&mut self, message: MessageId, at_ns: i64) {
        let MessageId { epoch, sequence } = message;
        count(&mut self.counts.received);
        if self.counts.published.is_none() {
            self.rate.add(at_ns, 1);
        }
        if let Some(before_ns) = self.arrived_ns {
            let gap_ns = at_ns.saturating_sub(before_ns).clamp(0, SILENT_NS);
            self.period_ns += (gap_ns - self.period_ns) / 8;
        }
        self.arrived_ns = Some(at_ns);
        if self.lost.remove(&message).is_some() {
            self.counts.lost = self.counts.lost.saturating_sub(1);
            self.untold.retain(|(number, _)| *number != sequence);
        }
        let known = self.newest.entry(epoch).or_insert(sequence);
        let newest = *known;
        *known = newest.max(sequence);
        // Where nobody here saw them leave, the numbers passed over are all that tells of them.
        if self.counts.sent.is_none() {
            let from = newest.saturating_add(1).max(sequence.saturating_sub(1000));
            for sequence in from..sequence {
                let key = MessageId { epoch, sequence };
                self.under_way
                    .entry(key)
                    .or_insert_with(|| Joined::new(key, at_ns));
            }
        }
    }

    fn update(&mut self, message: MessageId, at_ns: i64, record: &Record) {
        let joined = self.under_way.entry(message);
        let joined = joined.or_insert_with(|| Joined::new(message, at_ns));
        let before = joined.lengths_ns(self.way);
        joined.note(record);
        let now = joined.lengths_ns(self.way);
        joined.stamps.delay_ns = now[WHOLE];
        for (samples, (before, now)) in self.lengths.iter_mut().zip(before.iter().zip(now)) {
            if let Some(length_ns) = now.filter(|_| before.is_none()) {
                samples.add(at_ns, length_ns);
            }
        }
        if self.under_way.len() > UNDER_WAY_MAX {
            self.under_way.pop_first();
            self.counts.forgotten += 1;
        }
    }

    /// Decides about messages that have been under way for long enough.
    pub(crate) fn settle(&mut self, now_ns: i64) {
        let due_ns = now_ns - LOST_AFTER_NS;
        let is_old = |_: &MessageId, joined: &mut Joined| joined.first_ns <= due_ns;
        let old: Vec<_> = self.under_way.extract_if(.., is_old).collect();
        for (key, joined) in old {
            if self.is_lost(key, &joined) {
                self.counts.lost += 1;
                self.window_lost.add(now_ns, 1);
                self.lost.insert(key, now_ns);
                self.untold.push((key.sequence, joined.stamps.published_ns));
            }
            if self.shown.len() < SHOWN_MAX {
                self.shown.push(joined.stamps);
            }
        }
        self.lost.retain(|_, at_ns| now_ns - *at_ns < REMEMBERED_NS);
        while self.lost.len() > UNDER_WAY_MAX {
            self.lost.pop_first();
        }
    }

    fn is_lost(&self, key: MessageId, joined: &Joined) -> bool {
        if !self.way.has_link || joined.has_arrived() || self.counts.received.is_none() {
            return false;
        }
        let newest = self.newest.get(&key.epoch);
        joined.has_left()
            || newest.is_some_and(|newest| *newest > key.sequence && self.counts.sent.is_none())
    }

    /// Stamps of some messages whose way is over, since the last call.
    pub(crate) fn take_shown(&mut self) -> Vec<MessageLatency> {
        core::mem::take(&mut self.shown)
    }

    /// What was found lost since the last call, as `/live/losses` has it; `origin_ns` is the run's
    /// beginning on the producer's clock, where that is known, `at_s` now.
    pub(crate) fn take_losses(
        &mut self,
        name: &str,
        at_s: f64,
        origin_ns: Option<i64>,
    ) -> Option<Value> {
        let mut lost = core::mem::take(&mut self.untold);
        if lost.is_empty() {
            return None;
        }
        lost.sort_unstable();
        let first_ns = lost.iter().filter_map(|(_, published)| *published).min();
        let ends = first_ns.zip(origin_ns);
        let first_at_s = ends.map(|(ns, origin_ns)| seconds(ns.saturating_sub(origin_ns)));
        let sequences = lost.iter().map(|(number, _)| *number).take(LISTED_MAX);
        Some(json!({
            "at_s": at_s, "channel": name, "sequences": sequences.collect::<Vec<_>>(),
            "count": lost.len(), "first_at_s": first_at_s,
        }))
    }

    /// The channel's entry in `/live/channels`.
    pub(crate) fn metrics(&mut self, name: &str, now_ns: i64) -> Value {
        let named = self.way.segments().iter().zip(&mut self.lengths);
        let segments: Vec<Value> = named
            .map(|(name, samples)| samples.metrics(name, now_ns))
            .collect();
        let whole = &mut self.lengths[WHOLE];
        let one_way = whole.is_available;
        let one_way = one_way.then(|| whole.metrics("published-taken", now_ns));
        let can_tell = self.way.has_link && self.counts.received.is_some();
        let window_lost = self.window_lost.count(now_ns);
        let arrived_ns = self.arrived_ns.filter(|_| self.way.has_link);
        let counts = &self.counts;
        // What no process here has to do with has no rate here.
        let seen = [counts.published(), counts.received, counts.taken];
        let is_seen = seen.iter().any(Option::is_some);
        let rate_hz = self.rate.count(now_ns) as f64 * 1e9 / WINDOW_NS as f64;
        let rate_hz = is_seen.then_some(rate_hz);
        json!({
            "name": name,
            "rate_hz": rate_hz,
            "published_count": counts.published(),
            "received_count": counts.received,
            "taken_count": counts.taken,
            "lost_count": can_tell.then_some(counts.lost),
            "window_lost_count": can_tell.then_some(window_lost),
            "segments": segments,
            "one_way": one_way,
            "clock_bound_us": self.way.has_one_clock.then_some(0.0),
            "link_state": self.link_state(now_ns),
            "silent_s": arrived_ns.map(|ns| seconds((now_ns - ns).max(0))),
        })
    }

    fn link_state(&self, now_ns: i64) -> &'static str {
        let Some(arrived_ns) = self.arrived_ns.filter(|_| self.way.has_link) else {
            let waits = self.left_ns.is_some() && self.counts.received.is_some();
            return if waits { "silent" } else { "none" };
        };
        let patience_ns = (SILENT_PERIODS * self.period_ns).max(SILENT_NS);
        // A channel on which nobody spoke is not silent because of its link. Where nobody here knows
        // whether anybody did, only one that had a rhythm can be said to have lost it.
        let has_rhythm = self.counts.received >= Some(RHYTHM_COUNT);
        let was_offered = self
            .left_ns
            .map_or(has_rhythm, |left_ns| left_ns > arrived_ns + patience_ns / 2);
        if now_ns - arrived_ns > patience_ns && was_offered {
            "silent"
        } else {
            "up"
        }
    }
}

/// The segments of a channel over a link, in order.
const LINK_SEGMENTS: [&str; 7] = [
    "published-taken by gateway",
    "taken by gateway-handed",
    "handed-TX stamp",
    "TX stamp-RX stamp",
    "RX stamp-received",
    "received-forwarded",
    "forwarded-taken",
];

/// The only segment of a channel that stays in shared memory.
const LOCAL_SEGMENTS: [&str; 1] = ["published-taken"];

/// What decides which lengths a channel's stamps give.
#[derive(Debug, Clone, Copy, Default)]
struct Way {
    /// It crosses a link.
    has_link: bool,
    /// Stamps of both ends compare.
    has_one_clock: bool,
}

impl Way {
    /// The names of its segments.
    const fn segments(self) -> &'static [&'static str] {
        if self.has_link {
            &LINK_SEGMENTS
        } else {
            &LOCAL_SEGMENTS
        }
    }
}

/// One message on its way.
#[derive(Debug, Clone, Default)]
struct Joined {
    /// Its stamps.
    stamps: MessageLatency,
    /// When the first of its records was known.
    first_ns: i64,
    is_refused: bool,
    has_ingress: bool,
}

/// Lengths of a message's way: its segments, as many as there can be, and the whole.
const LENGTHS: usize = LINK_SEGMENTS.len() + 1;
/// Which of them is the whole way, published to taken.
const WHOLE: usize = LINK_SEGMENTS.len();

impl Joined {
    /// A message first heard of at `at_ns`.
    fn new(message: MessageId, at_ns: i64) -> Self {
        Self {
            stamps: MessageLatency::new(message),
            first_ns: at_ns,
            ..Self::default()
        }
    }

    /// Takes a record of it; of its arrivals only the first.
    fn note(&mut self, record: &Record) {
        self.stamps.note(record);
        match record {
            Record::Egress(one) => {
                self.is_refused = one.is_refused();
            }
            Record::Ingress(_) => self.has_ingress = true,
            _ => {}
        }
    }

    /// True when it reached the other gateway, or its consumer said so.
    fn has_arrived(&self) -> bool {
        self.has_ingress || self.stamps.taken_ns.is_some()
    }

    /// True when it was handed to the link, or the kernel refused it there.
    fn has_left(&self) -> bool {
        self.is_refused || self.stamps.handed_ns.is_some()
    }

    /// The lengths whose two ends are known: those of [`Way::segments`], then the whole way.
    fn lengths_ns(&self, way: Way) -> [Option<i64>; LENGTHS] {
        let one = &self.stamps;
        let whole = span(one.published_ns, one.taken_ns);
        if !way.has_link {
            let mut lengths = [None; LENGTHS];
            (lengths[0], lengths[WHOLE]) = (whole, whole);
            return lengths;
        }
        let tx_ns = minus(one.tx_realtime_ns, one.sender_realtime_offset_ns);
        let rx_ns = minus(one.rx_realtime_ns, one.receiver_realtime_offset_ns);
        let wire = span(one.tx_realtime_ns, one.rx_realtime_ns);
        [
            span(one.published_ns, one.gateway_taken_ns),
            span(one.gateway_taken_ns, one.handed_ns),
            span(one.handed_ns, tx_ns),
            wire.filter(|_| way.has_one_clock),
            span(rx_ns, one.received_ns),
            span(one.received_ns, one.forwarded_ns),
            span(one.forwarded_ns, one.taken_ns),
            whole.filter(|_| way.has_one_clock),
        ]
    }
}

fn minus(ns: Option<i64>, offset_ns: Option<i64>) -> Option<i64> {
    ns.zip(offset_ns)
        .and_then(|(ns, offset)| ns.checked_sub(offset))
}

fn span(from_ns: Option<i64>, to_ns: Option<i64>) -> Option<i64> {
    minus(to_ns, from_ns)
}

/// How far back figures look, nanoseconds.
const WINDOW_NS: i64 = 1_000_000_000;

/// Values kept at most; beyond, the oldest go, and figures are of the newest.
const SAMPLES_MAX: usize = 4096;

/// Records are read some time after they were written; a window that ends now would lack the newest.
/// It ends with the newest that is known, but no longer ago than this, nanoseconds.
const READ_LATE_NS: i64 = 250_000_000;

/// Instants kept apart at most; of a faster channel several count as one.
const INSTANTS_MAX: usize = 8192;

/// How many things happened within the window.
#[derive(Debug, Default)]
struct Recent {
    instants: VecDeque<(i64, u64)>,
}

impl Recent {
    /// `count` things happened at `at_ns`.
    fn add(&mut self, at_ns: i64, count: u64) {
        let is_full = self.instants.len() >= INSTANTS_MAX;
        match self.instants.back_mut() {
            // What comes out of order counts with the newest: it was learned then.
            Some((last, sum)) if is_full || *last >= at_ns => *sum += count,
            _ => self.instants.push_back((at_ns, count)),
        }
    }

    /// How many happened in the window before `now_ns`.
    fn count(&mut self, now_ns: i64) -> u64 {
        let newest_ns = self.instants.back().map_or(now_ns, |(at, _)| *at);
        let end_ns = newest_ns.clamp(now_ns - READ_LATE_NS, now_ns.max(newest_ns));
        let begin_ns = end_ns - WINDOW_NS;
        while self.instants.front().is_some_and(|(at, _)| *at <= begin_ns) {
            self.instants.pop_front();
        }
        self.instants.iter().map(|(_, count)| count).sum()
    }
}

/// Durations measured within the window.
#[derive(Debug, Default)]
struct Samples {
    values: VecDeque<(i64, i64)>,
    /// True once there was one: whether this host has the two stages at all.
    is_available: bool,
}

impl Samples {
    /// `value_ns` was learned at `at_ns`.
    fn add(&mut self, at_ns: i64, value_ns: i64) {
        self.is_available = true;
        if self.values.len() == SAMPLES_MAX {
            self.values.pop_front();
        }
        self.values.push_back((at_ns, value_ns));
    }

    /// `p50_us`, `p99_us`, `max_us`, `count` and `is_available` of the window before `now_ns`, as `name`.
    fn metrics(&mut self, name: &str, now_ns: i64) -> Value {
        let oldest_ns = now_ns - WINDOW_NS;
        while self.values.front().is_some_and(|(at, _)| *at <= oldest_ns) {
            self.values.pop_front();
        }
        let values: Vec<i64> = self.values.iter().map(|(_, value)| *value).collect();
        let summary = LatencySummary::of_samples(&values);
        let of =
            |figure: fn(&LatencySummary) -> i64| summary.as_ref().map(figure).map(microseconds);
        json!({
            "name": name,
            "p50_us": of(|one| one.p50_ns), "p99_us": of(|one| one.p99_ns),
            "max_us": of(|one| one.max_ns),
            "count": values.len(), "is_available": self.is_available,
        })
    }
}

/// To a tenth, as far as any stamp means something.
fn microseconds(ns: i64) -> f64 {
    (ns as f64 / 100.0).round() / 10.0
}

#[cfg(test)]
#[path = "account_tests.rs"]
mod tests;
