//! The guaranteed interval of the offset over one stretch without a noticed step, and the search
//! for steps. Only causality and the drift allowance are used here.

use core::ops::RangeInclusive;

use super::exchange::{Constraint, Edge};
use super::{BEYOND_NS_MAX, ClockSettings};

/// The tightest bounds among some exchanges, each the best for the instants on one side of it.
#[derive(Debug, Clone, Copy)]
struct Best {
    low: Edge,
    high: Edge,
}

impl Best {
    const fn of(one: &Constraint) -> Self {
        Self {
            low: one.low,
            high: one.high,
        }
    }

    /// Takes over whichever bound says more at `at_ns`.
    fn add(&mut self, one: &Constraint, at_ns: i64, settings: &ClockSettings) {
        if one.low.lower_at(at_ns, settings) >= self.low.lower_at(at_ns, settings) {
            self.low = one.low;
        }
        if one.high.upper_at(at_ns, settings) <= self.high.upper_at(at_ns, settings) {
            self.high = one.high;
        }
    }

    /// True when no offset that drifts within the allowance meets both.
    fn contradicts(&self, one: &Constraint, settings: &ClockSettings) -> bool {
        one.low.offset_ns > self.high.upper_at(one.low.at_ns, settings)
            || one.high.offset_ns < self.low.lower_at(one.high.at_ns, settings)
    }

    fn interval_at(&self, at_ns: i64, settings: &ClockSettings) -> (i64, i64) {
        (
            self.low.lower_at(at_ns, settings),
            self.high.upper_at(at_ns, settings),
        )
    }
}

/// What exchanges before and after an instant say of the offset there.
#[derive(Debug, Clone)]
pub(super) struct Band {
    /// By when an exchange was over, with the best of all up to it.
    past: Vec<(i64, Best)>,
    /// By when an exchange began, with the best of all from it on.
    future: Vec<(i64, Best)>,
}

impl Band {
    /// Of exchanges that no step separates.
    pub(super) fn new(constraints: &[Constraint], settings: &ClockSettings) -> Self {
        let gather = |mut ordered: Vec<(i64, &Constraint)>, is_forward: bool| {
            ordered.sort_by_key(|(at_ns, _)| *at_ns);
            if !is_forward {
                ordered.reverse();
            }
            let mut best: Option<Best> = None;
            let mut steps = Vec::with_capacity(ordered.len());
            for (at_ns, one) in ordered {
                match &mut best {
                    Some(best) => best.add(one, at_ns, settings),
                    None => best = Some(Best::of(one)),
                }
                steps.extend(best.map(|best| (at_ns, best)));
            }
            if !is_forward {
                steps.reverse();
            }
            steps
        };
        let by = |key: fn(&Constraint) -> i64| constraints.iter().map(move |c| (key(c), c));
        Self {
            past: gather(by(|one| one.last_ns).collect(), true),
            future: gather(by(|one| one.first_ns).collect(), false),
        }
    }

    /// The instant nearest to `at_ns` that some exchange covers; `None` without any.
    pub(super) fn nearest_ns(&self, at_ns: i64) -> Option<i64> {
        let (begun_ns, over_ns) = (self.future.first()?.0, self.past.last()?.0);
        Some(at_ns.clamp(begun_ns, over_ns.max(begun_ns)))
    }

    /// Smallest and largest offset at `at_ns`: the hull of what exchanges that were over by then
    /// and exchanges that had not begun allow. At the ends there is one of the two only. `None` more
    /// than [`BEYOND_NS_MAX`] outside all exchanges, and when one of the two contradicts itself.
    pub(super) fn interval_at(&self, at_ns: i64, settings: &ClockSettings) -> Option<(i64, i64)> {
        let (begun_ns, over_ns) = (self.future.first()?.0, self.past.last()?.0);
        let is_near = (begun_ns.saturating_sub(BEYOND_NS_MAX)
            ..=over_ns.saturating_add(BEYOND_NS_MAX))
            .contains(&at_ns);
        if !is_near {
            return None;
        }
        let past = self.past.partition_point(|(last_ns, _)| *last_ns <= at_ns);
        let past = past.checked_sub(1).map(|index| self.past[index].1);
        let future = self
            .future
            .partition_point(|(first_ns, _)| *first_ns < at_ns);
        let future = self.future.get(future).map(|(_, best)| *best);
        let [past, future] =
            [past, future].map(|best| best.map(|best| best.interval_at(at_ns, settings)));
        let hull = match (past, future) {
            (Some(past), Some(future)) => (past.0.min(future.0), past.1.max(future.1)),
            (one, other) => one.or(other)?,
        };
        // The search for steps compares in order of time; stamps that no clock gives, with
        // exchanges that overlap wildly, can still leave nothing that fits all.
        let mut sides = [past, future].into_iter().flatten();
        sides
            .all(|(low_ns, high_ns)| low_ns <= high_ns)
            .then_some(hull)
    }
}

/// A stretch of exchanges that one drifting offset explains.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Stretch {
    pub(super) constraints: Vec<Constraint>,
    /// From the end of the step before, on the other host's clock.
    pub(super) from_ns: i64,
    /// To the beginning of the step after.
    pub(super) until_ns: i64,
}

/// What no drifting offset explains as a whole, cut into what one does.
#[derive(Debug, Default)]
pub(super) struct Cut {
    pub(super) stretches: Vec<Stretch>,
    /// Indices of exchanges that contradict each other, with all between them.
    pub(super) contradictions: Vec<RangeInclusive<usize>>,
}

/// Cuts exchanges, in order of time, wherever no drifting offset explains both sides.
///
/// A contradiction between an earlier and a later exchange proves a step between the beginning of
/// the last exchange that contradicts what follows and the end of the first that contradicts what
/// went before. Whatever was under way then is not used.
pub(super) fn cut(constraints: &[Constraint], settings: &ClockSettings) -> Cut {
    let mut cut = Cut::default();
    let found = &mut cut.stretches;
    let (mut start, mut from_ns) = (0, i64::MIN);
    while start < constraints.len() {
        let Some(after) = contradiction(constraints[start..].iter().enumerate(), settings) else {
            found.push(stretch(&constraints[start..], from_ns, i64::MAX));
            break;
        };
        let after = start + after;
        let until = constraints[start..=after].iter().enumerate().rev();
        let before = contradiction(until, settings).map_or(start, |index| start + index);
        cut.contradictions.push(before..=after);
        let zone = (constraints[before].first_ns, constraints[after].last_ns);
        found.push(stretch(&constraints[start..before], from_ns, zone.0));
        from_ns = zone.1;
        let later = &constraints[after + 1..];
        let under_way = later.iter().take_while(|one| one.first_ns < from_ns);
        start = after + 1 + under_way.count();
    }
    found.retain(|one| !one.constraints.is_empty());
    cut
}

/// Those of `constraints` that lie wholly in the span.
fn stretch(constraints: &[Constraint], from_ns: i64, until_ns: i64) -> Stretch {
    let inside = constraints
        .iter()
        .filter(|one| one.first_ns >= from_ns && one.last_ns <= until_ns);
    Stretch {
        constraints: inside.copied().collect(),
        from_ns,
        until_ns,
    }
}

fn contradiction<'a>(
    constraints: impl Iterator<Item = (usize, &'a Constraint)>,
    settings: &ClockSettings,
) -> Option<usize> {
    let mut best: Option<Best> = None;
    for (index, one) in constraints {
        match &mut best {
            Some(best) if best.contradicts(one, settings) => return Some(index),
            Some(best) => best.add(one, one.middle().at_ns, settings),
            None => best = Some(Best::of(one)),
        }
    }
    None
}
