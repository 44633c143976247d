//! Whether two points of captures read one clock: only then is the time between their stamps a
//! one-way delay. A probe exchanges no clocks, so it must be told, or say that it does not know.

use hil_capture::join::JoinSettings;
use hil_capture::observe::Point;
use serde::Serialize;

use hil_report::clock_summary::{ClockRung, HostPairClock};
use hil_report::summary::RunSummary;

/// Share of delays below zero that contradicts one clock.
const CONTRADICTING_SHARE: f64 = 0.001;

/// On what the time between the stamps of two points rests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum PointClocks {
    /// Both stand in one file, and both have the host's stamps or both an ET2000's: one clock.
    OneFile,
    /// The user says that it is one.
    DeclaredOne,
    /// The user says that it is one, and datagrams arrive before they left.
    Contradicted,
    /// Two files, of which nothing is said.
    Unknown,
}

impl PointClocks {
    /// `is_apart` says that one file holds them and was put together from several.
    pub(super) fn of(
        first: &Point,
        second: &Point,
        is_apart: bool,
        settings: &JoinSettings,
    ) -> Self {
        let is_same_kind = first.esl_port.is_some() == second.esl_port.is_some();
        if first.file_index == second.file_index && is_same_kind && !is_apart {
            Self::OneFile
        } else if settings.is_one_clock {
            Self::DeclaredOne
        } else {
            Self::Unknown
        }
    }

    /// How far two clocks may lead a delay astray, nanoseconds; `None` where it is unknown.
    pub(super) const fn bound_ns(self) -> Option<u64> {
        match self {
            Self::OneFile | Self::DeclaredOne => Some(0),
            Self::Contradicted | Self::Unknown => None,
        }
    }

    /// What is left of it beside the delays that follow from it, where stamps are whole units of up to
    /// `unit_ns`: a stamp cut off at its unit takes less than one from a delay. Delays below that
    /// contradict one clock if they are all, or at least two and [`CONTRADICTING_SHARE`] of all: a single
    /// datagram may have been matched with another one that looks like it.
    pub(super) fn beside(self, delays_ns: impl Iterator<Item = i64>, unit_ns: i64) -> Self {
        let (mut count, mut below_count) = (0_usize, 0_usize);
        for delay_ns in delays_ns {
            count += 1;
            below_count += usize::from(delay_ns < -unit_ns);
        }
        let is_enough = below_count > 1 && below_count as f64 >= CONTRADICTING_SHARE * count as f64;
        let is_contradicted = is_enough || (count > 0 && below_count == count);
        match self {
            Self::DeclaredOne if is_contradicted => Self::Contradicted,
            found => found,
        }
    }

    /// For a line of its own.
    pub(super) const fn words(self) -> &'static str {
        match self {
            Self::OneFile => "one: both points stand in one file",
            Self::DeclaredOne => "one, as --one-clock says",
            Self::Contradicted => {
                "not one, though --one-clock says so: datagrams arrive before they leave; a delay \
                 holds the difference of two, of unknown size"
            }
            Self::Unknown => {
                "not known to be one: a delay holds the difference of two, of unknown size, and \
                 variation and jitter its drift (--one-clock says that it is one)"
            }
        }
    }
}

/// Whether the stamps at both ends of the wire are of one clock. The differences between probe and
/// gateways are of one host each, whatever the clocks do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum WireClocks {
    One,
    /// The wire's times hold the difference of two clocks.
    Two,
    /// The run says nothing of its clocks.
    Unknown,
}

impl WireClocks {
    pub(super) fn of(summary: Option<&RunSummary>) -> Self {
        let Some(clocks) = summary.and_then(|summary| summary.clocks.as_ref()) else {
            return Self::Unknown;
        };
        let is_one = |pair: &HostPairClock| pair.rung == ClockRung::OneClock;
        if clocks.pairs.iter().all(is_one) {
            Self::One
        } else {
            Self::Two
        }
    }

    pub(super) fn words(self) -> &'static str {
        match self {
            Self::One => "the hosts share one clock",
            Self::Two => {
                "the hosts have two clocks, whose difference is in both wire times; how far they \
                 are apart holds all the same"
            }
            Self::Unknown => "whether the hosts share a clock is unknown; the wire times need it",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn said(is_one_clock: bool) -> JoinSettings {
        JoinSettings {
            window_ns: 1,
            is_one_clock,
        }
    }

    #[test]
    fn two_files_have_one_clock_only_by_word() {
        let point = |file_index| Point {
            file_index,
            ..Point::default()
        };
        let of = |second, is_one| PointClocks::of(&point(0), &point(second), false, &said(is_one));
        assert_eq!(of(0, false), PointClocks::OneFile);
        assert_eq!(of(1, false), PointClocks::Unknown);
        assert_eq!(of(1, true), PointClocks::DeclaredOne);
        let of_device = Point {
            esl_port: Some(1),
            ..point(0)
        };
        let mixed = PointClocks::of(&point(0), &of_device, false, &said(false));
        assert_eq!(mixed, PointClocks::Unknown);
        assert_eq!(of(1, false).bound_ns(), None);
        assert_eq!(of(1, true).bound_ns(), Some(0));
    }

    #[test]
    fn datagrams_that_arrive_before_they_leave_contradict_one_clock() {
        let merged =
            |is_one| PointClocks::of(&Point::default(), &Point::default(), true, &said(is_one));
        assert_eq!(merged(false), PointClocks::Unknown);
        assert_eq!(merged(true), PointClocks::DeclaredOne);
        let beside =
            |delays_ns: &[i64], unit_ns| merged(true).beside(delays_ns.iter().copied(), unit_ns);
        let early = [-5_000_000; 10];
        assert_eq!(beside(&early, 1), PointClocks::Contradicted);
        assert_eq!(beside(&early[..1], 1), PointClocks::Contradicted);
        assert_eq!(beside(&early, 1).bound_ns(), None);
        assert_eq!(beside(&[], 1), PointClocks::DeclaredOne);
        // 0.4 us, the second stamp in whole microseconds.
        let cut: Vec<i64> = (0..1000).map(|n| (n + 400) / 1000 * 1000 - n).collect();
        assert_eq!(cut.iter().min(), Some(&-599));
        assert_eq!(beside(&cut, 1000), PointClocks::DeclaredOne);
        assert_eq!(beside(&cut, 1), PointClocks::Contradicted);
        // Datagrams that were matched with others.
        let mut delays = vec![400_000; 10_000];
        delays[7] = -30_000_000;
        assert_eq!(beside(&delays[..10], 1), PointClocks::DeclaredOne);
        delays[9] = -30_000_000;
        assert_eq!(beside(&delays, 1), PointClocks::DeclaredOne);
        assert_eq!(beside(&delays[..2000], 1), PointClocks::Contradicted);
    }
}
