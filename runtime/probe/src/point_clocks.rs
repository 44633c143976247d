//! Whether two points of captures read one clock: only then is the time between their stamps a
//! one-way delay. A probe exchanges no clocks, so it must be told, or say that it does not know.

use hil_capture::observe::Point;
use serde::Serialize;

use hil_stats::histogram::Distribution;

use hil_report::clock_summary::{ClockRung, HostPairClock};
use hil_report::summary::RunSummary;

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
    pub(super) fn of(first: &Point, second: &Point, is_declared_one: bool) -> Self {
        let is_same_kind = first.esl_port.is_some() == second.esl_port.is_some();
        if first.file_index == second.file_index && is_same_kind {
            Self::OneFile
        } else if is_declared_one {
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

    /// What is left of it beside the delays that follow from it.
    pub(super) fn beside(self, delay: &Distribution) -> Self {
        let is_contradicted = delay.measured().is_some_and(|delay| delay.min_ns < 0);
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

    #[test]
    fn two_files_have_one_clock_only_by_word() {
        let point = |file_index| Point {
            file_index,
            ..Point::default()
        };
        let of = |second, is_one| PointClocks::of(&point(0), &point(second), is_one);
        assert_eq!(of(0, false), PointClocks::OneFile);
        assert_eq!(of(1, false), PointClocks::Unknown);
        assert_eq!(of(1, true), PointClocks::DeclaredOne);
        let of_device = Point {
            esl_port: Some(1),
            ..point(0)
        };
        let mixed = PointClocks::of(&point(0), &of_device, false);
        assert_eq!(mixed, PointClocks::Unknown);
        assert_eq!(of(1, false).bound_ns(), None);
        assert_eq!(of(1, true).bound_ns(), Some(0));
        let delays = |from_ns| Distribution::of_samples(&[from_ns, 2_000_000], "");
        assert_eq!(of(1, true).beside(&delays(0)), PointClocks::DeclaredOne);
        let contradicted = of(1, true).beside(&delays(-1));
        assert_eq!(contradicted, PointClocks::Contradicted);
        assert_eq!(contradicted.bound_ns(), None);
    }
}
