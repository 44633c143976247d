//! Which message of its channel is offered to a replay, over all starts of its producer and however many
//! pieces it comes in; and which tick of its producer it belongs to. The producer's clock is not the
//! trace's, so its grid is followed like that of a trace: by the same rules over the first messages, and
//! message by message from then on.

use crate::replay_ticks::{EARLY_RATIO, sort_out, whole};
use hil_core::link_model::MessageNumber;

/// Messages that the grid is sought in anew with each of them: the first of a run is the coldest, and
/// later by itself than any after it.
const WARM_UP_COUNT: usize = 16;
/// Periods after which it is not sought any more: by then two clocks may be apart by a part of one.
const WARM_UP_PERIODS: f64 = 256.0;
/// Share of an offer's distance from the grid that moves the grid, and that changes its period: a
/// quarter of the square of the first, so that it settles without swinging.
const PHASE_GAIN: f64 = 1.0 / 128.0;
const PERIOD_GAIN: f64 = PHASE_GAIN * PHASE_GAIN / 4.0;

/// The grid of the messages that a replay is offered. Counting periods from the first would be a tick off
/// after 5000 at 100 parts per million.
#[derive(Debug, Clone, Copy)]
pub(super) struct OfferGrid {
    /// Where the newest tick's message is expected.
    expected_ns: f64,
    period_ns: f64,
    tick: u64,
    /// The latest tick given away: what went out too far ahead stays there, and the grid is none the
    /// worse for it.
    newest: u64,
    warm_up: Option<WarmUp>,
}

impl OfferGrid {
    /// The first message, which belongs to `tick`, of a producer with about the period `period_ns`.
    pub(super) const fn new(at_ns: i64, tick: u64, period_ns: f64) -> Self {
        Self {
            expected_ns: at_ns as f64,
            period_ns,
            tick,
            newest: tick,
            warm_up: Some(WarmUp::new(at_ns, tick)),
        }
    }

    /// The same of a producer that was started anew, which begins another grid: its first message has
    /// the tick of its instant on the old one, after that of the last.
    pub(super) fn restarted(mut self, at_ns: i64) -> Self {
        let last = self.newest;
        let tick = self.tick(at_ns).max(last.saturating_add(1));
        Self::new(at_ns, tick, self.period_ns)
    }

    /// The tick of the last message.
    pub(super) const fn newest(&self) -> u64 {
        self.newest
    }

    /// The tick of the next message, never before that of the last.
    pub(super) fn tick(&mut self, at_ns: i64) -> u64 {
        let found = self.warm_up.as_mut();
        if let Some(found) = found.and_then(|warm_up| warm_up.found(at_ns, self.period_ns)) {
            self.expected_ns = found.expected_ns;
            self.tick = found.tick;
        } else {
            self.warm_up = None;
            let distance = (at_ns as f64 - self.expected_ns) / self.period_ns;
            let steps = distance.round().max(0.0);
            let error = (distance - steps).max(-0.5);
            self.expected_ns += (steps + PHASE_GAIN * error) * self.period_ns;
            self.period_ns *= 1.0 + PERIOD_GAIN * error;
            self.tick += u64::try_from(whole(steps)).unwrap_or(0);
        }
        self.newest = self.newest.max(self.tick);
        self.newest
    }
}

/// The first messages of a producer.
#[derive(Debug, Clone, Copy)]
struct WarmUp {
    first_ns: i64,
    first_tick: u64,
    /// Instants since the first, in periods.
    places: [f64; WARM_UP_COUNT],
    count: usize,
}

/// What the first messages say of the newest.
struct Found {
    expected_ns: f64,
    tick: u64,
}

impl WarmUp {
    const fn new(first_ns: i64, first_tick: u64) -> Self {
        Self {
            first_ns,
            first_tick,
            places: [0.0; WARM_UP_COUNT],
            count: 1,
        }
    }

    /// With one more at `at_ns`; `None` when they are too many, or it is too far off.
    fn found(&mut self, at_ns: i64, period_ns: f64) -> Option<Found> {
        let place = at_ns.saturating_sub(self.first_ns) as f64 / period_ns;
        if self.count == WARM_UP_COUNT || place > WARM_UP_PERIODS {
            return None;
        }
        self.places[self.count] = place;
        self.count += 1;
        let places = &self.places[..self.count];
        // A producer's timer wakes it late or not at all: of the grids through one of the messages that
        // is the one on which the least lateness explains them all.
        let (mut best, mut least) = (None, f64::INFINITY);
        for edge in places {
            let (ticks, lateness) = ticks_on(places, edge - edge.floor());
            if lateness < least {
                (best, least) = (Some((ticks, *edge)), lateness);
            }
        }
        let (ticks, edge) = best?;
        let newest = ticks[self.count - 1];
        let phase = edge - edge.floor();
        Some(Found {
            expected_ns: self.first_ns as f64 + (phase + newest as f64) * period_ns,
            tick: self.first_tick + u64::try_from(newest - ticks[0]).ok()?,
        })
    }
}

/// The tick of each of `places` on the grid of period 1 at `phase`, and how late they are together.
fn ticks_on(places: &[f64], phase: f64) -> ([i64; WARM_UP_COUNT], f64) {
    let mut ticks = [0; WARM_UP_COUNT];
    for (tick, place) in ticks.iter_mut().zip(places) {
        *tick = whole((place - phase + EARLY_RATIO).floor());
    }
    sort_out(&mut ticks[..places.len()]);
    let late = |(place, tick): (&f64, &i64)| (place - phase - *tick as f64).max(0.0);
    let lateness = places.iter().zip(&ticks).map(late).sum();
    (ticks, lateness)
}

/// Messages offered lately whose pieces and copies are known again.
const RECENT_COUNT: usize = 64;

/// Numbers messages over all starts of their producer, and remembers what the last ones met.
#[derive(Debug)]
pub(super) struct Offered<T> {
    /// The current start and the one before, each with the number of its first message.
    starts: [Option<(u32, u64)>; 2],
    /// One past the highest number.
    next: u64,
    /// The last message of each number modulo their count.
    recent: [Option<(u64, T)>; RECENT_COUNT],
}

impl<T: Copy> Offered<T> {
    pub(super) const fn new() -> Self {
        Self {
            starts: [None; 2],
            next: 0,
            recent: [None; RECENT_COUNT],
        }
    }

    /// The message after the last.
    pub(super) fn following(&self) -> MessageNumber {
        let (start, first) = self.starts[0].unwrap_or((0, 0));
        MessageNumber {
            start,
            sequence: self.next.saturating_sub(first),
            published: None,
        }
    }

    /// The number of `message` over all starts, from 0; true with it when a start began that is not the
    /// first. A start's first message has the number after the highest one offered before.
    pub(super) fn number(&mut self, message: MessageNumber) -> (u64, bool) {
        let is_of = |known: &&(u32, u64)| known.0 == message.start;
        // A straggler of the start before is no new start.
        let known = self.starts.iter().flatten().find(is_of);
        let (first, is_restarted) = match (known, self.starts[0]) {
            (Some(&(_, first)), _) => (first, false),
            (None, None) => (0, false),
            (None, Some(_)) => (self.next, true),
        };
        if known.is_none() {
            self.starts = [Some((message.start, first)), self.starts[0]];
        }
        let number = first.saturating_add(message.sequence);
        self.next = self.next.max(number.saturating_add(1));
        (number, is_restarted)
    }

    /// What the message of this `number` met when a piece or copy of it was offered before.
    pub(super) fn met(&self, number: u64) -> Option<T> {
        let (known, met) = self.recent[place(number)]?;
        (known == number).then_some(met)
    }

    /// Remembers it.
    pub(super) fn keep(&mut self, number: u64, met: T) {
        self.recent[place(number)] = Some((number, met));
    }
}

fn place(number: u64) -> usize {
    usize::try_from(number % RECENT_COUNT as u64).expect("below the count")
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    /// Messages after which one late first message is told from late others.
    const SETTLED: usize = 8;

    fn ns(ns: f64) -> i64 {
        whole(ns.round())
    }

    /// The ticks given to messages at `places`, in periods; the first has tick 0.
    fn given(places: &[f64]) -> Vec<u64> {
        let at = |place: f64| ns(5e9 + place * 1e6);
        let mut grid = OfferGrid::new(at(places[0]), 0, 1e6);
        let next = places[1..].iter().map(|place| grid.tick(at(*place)));
        [0].into_iter().chain(next).collect()
    }

    #[test]
    fn offers_of_another_clock_are_followed() {
        for ppm in [-100.0, 0.0, 100.0] {
            let mut random = RandomStream::new(5, "offers");
            let mut grid = OfferGrid::new(77, 0, 1e6);
            let period_ns = 1e6 * (1.0 + ppm * 1e-6);
            for tick in 1..1_000_000_u64 {
                let late = if random.chance(0.1) { 0.4 } else { 0.02 } * random.uniform();
                if random.chance(0.05) || tick % 100_000 > 99_000 {
                    continue;
                }
                let at_ns = 77 + ns((tick as f64 + late) * period_ns);
                assert_eq!(grid.tick(at_ns), tick, "{ppm} ppm");
            }
        }
    }

    #[test]
    fn a_late_first_message_moves_none_after_it() {
        for late in [0.0, 0.3, 0.5, 0.6, 0.75, 0.9, 0.99] {
            let mut random = RandomStream::new(7, "late first");
            let mut places = vec![late];
            // Punctual ones first, then some as late as a loaded host makes them.
            places.extend((1..10_000).map(|tick| {
                let spread = if tick % 10 == 9 { 0.4 } else { 0.003 };
                f64::from(tick) + spread * random.uniform()
            }));
            let expected: Vec<u64> = (0..10_000).collect();
            assert_eq!(given(&places), expected, "late by {late}");
        }
    }

    #[test]
    fn a_late_first_message_before_ticks_without_one_is_soon_found_out() {
        for late in [0.1, 0.4, 0.6, 0.75, 0.85] {
            for missed in 1..20_u64 {
                let ticks = || [0].into_iter().chain(missed + 1..3_000);
                let of = |tick: u64| tick as f64 + if tick == 0 { late } else { 0.0 };
                let places: Vec<f64> = ticks().map(of).collect();
                let expected: Vec<u64> = ticks().collect();
                let given = given(&places);
                let from = if late < 0.5 { 0 } else { SETTLED };
                assert_eq!(given[from..], expected[from..], "{late}, {missed}");
            }
        }
    }

    #[test]
    fn a_late_message_among_the_first_moves_none_after_it() {
        for which in 1..WARM_UP_COUNT {
            for late in [0.3, 0.6, 0.9, 1.4] {
                let of = |tick: usize| tick as f64 + if tick == which { late } else { 0.0 };
                let mut places: Vec<f64> = (0..3_000).map(of).collect();
                places.sort_by(f64::total_cmp);
                let given = given(&places);
                let wrong: Vec<_> = (0..3_000).filter(|n| given[*n] != *n as u64).collect();
                assert!(
                    wrong.iter().all(|n| (which..=which + 1).contains(n)),
                    "{which} late by {late}: {wrong:?}"
                );
            }
        }
    }

    #[test]
    fn a_first_message_more_punctual_than_all_others_has_the_tick_before_theirs() {
        for lateness in [0.02, 0.1] {
            let of = |tick: u32| f64::from(tick) + if tick > 0 { lateness } else { 0.0 };
            let places: Vec<f64> = (0..3_000).map(of).collect();
            let expected: Vec<u64> = (0..3_000).collect();
            assert_eq!(given(&places), expected);
        }
    }

    #[test]
    fn messages_that_come_at_once_have_a_tick_each_and_a_long_gap_is_no_error() {
        // The first three were found waiting.
        assert_eq!(given(&[2.3, 2.3, 2.31, 3.0, 4.0]), [0, 1, 2, 3, 4]);
        let far = [0.0, 1.0, 2.0, 1_000.0, 1_001.0, 5_000.4, 5_001.0];
        assert_eq!(given(&far), [0, 1, 2, 1_000, 1_001, 5_000, 5_001]);
    }

    #[test]
    fn messages_are_numbered_over_all_starts() {
        let mut offered = Offered::<()>::new();
        let mut number = |start, sequence| {
            offered.number(MessageNumber {
                start,
                sequence,
                published: None,
            })
        };
        assert_eq!(number(9, 3), (3, false));
        assert_eq!(number(9, 5), (5, false));
        // The new start's first message was lost before the link.
        assert_eq!(number(2, 1), (7, true));
        assert_eq!(number(9, 4), (4, false), "a straggler");
        assert_eq!(number(2, 2), (8, false));
        assert_eq!(number(3, 0), (9, true));
        let following = offered.following();
        assert_eq!((following.start, following.sequence), (3, 1));
    }

    #[test]
    fn a_producer_started_anew_begins_another_grid() {
        let at = |place: f64| ns(place * 1e6);
        let mut grid = OfferGrid::new(0, 0, 1e6);
        for tick in 1..100_u32 {
            assert_eq!(grid.tick(at(f64::from(tick))), u64::from(tick));
        }
        // Half a period off the old one, where each error would round either way.
        let mut grid = grid.restarted(at(250.49));
        for tick in 251..2_000_u32 {
            let late = if tick % 2 == 0 { 0.0 } else { 0.3 };
            let found = grid.tick(at(f64::from(tick) + 0.49 + late));
            assert_eq!(found, u64::from(tick), "the first had 250");
        }
        let mut soon = OfferGrid::new(0, 7, 1e6).restarted(at(0.2));
        assert_eq!(soon.tick(at(1.2)), 9, "a tick of its own");
    }
}
