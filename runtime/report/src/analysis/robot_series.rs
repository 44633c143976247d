//! What the robot did over a run, in equal bins: the events of its score and its errors, to be held against
//! what the network did in the same bins.

use hil_core::case_study::{ErrorSeries, Severity};
use hil_core::time::Instant;

use crate::score_event::ScoreEvents;

/// What the robot did, on the run's axis.
#[derive(Debug)]
pub(crate) struct RobotSeries {
    label: String,
    unit: &'static str,
    /// Its samples are of errors, of which none is no value; not of events, of which none is none.
    is_error: bool,
    /// Seconds after the start of the run, and magnitude; in order of time.
    samples: Vec<(f64, f64)>,
}

impl RobotSeries {
    /// A case's error; `place_s` puts instants of its samples' clock on the run's axis. Samples without a
    /// place there are left out.
    pub(crate) fn of(errors: ErrorSeries, place_s: impl Fn(Instant) -> Option<f64>) -> Self {
        let samples = errors.samples.into_iter();
        Self {
            label: errors.label.to_owned(),
            unit: errors.unit,
            is_error: true,
            samples: samples
                .filter_map(|(at, value)| Some((place_s(at)?, value)))
                .collect(),
        }
    }

    /// The events of a score that matter: one for each.
    pub(super) fn of_events(all: &ScoreEvents) -> Self {
        let is_grave = |severity| severity > Severity::Notice;
        let listed = all.events.iter();
        let listed = listed.filter_map(|event| Some((event.severity, event.at_s?)));
        let timed: Vec<_> = listed.chain(all.dropped_at_s.iter().copied()).collect();
        let has_grave = [Severity::Incident, Severity::Hazard]
            .iter()
            .any(|one| all.count_of(*one) > 0);
        let chosen = timed
            .into_iter()
            .filter(|(severity, _)| !has_grave || is_grave(*severity));
        let mut samples: Vec<_> = chosen.map(|(_, at_s)| (at_s, 1.0)).collect();
        samples.sort_by(|a, b| a.0.total_cmp(&b.0));
        let label = if has_grave {
            "incidents and hazards"
        } else {
            "events of the score"
        };
        Self {
            label: label.to_owned(),
            unit: "1",
            is_error: false,
            samples,
        }
    }

    /// The words of a report.
    pub(super) fn label(&self) -> &str {
        &self.label
    }

    /// False for errors of which no sample has a place.
    pub(super) const fn is_known(&self) -> bool {
        !self.is_error || !self.samples.is_empty()
    }

    /// `1` for a number, else the unit.
    pub(super) const fn unit(&self) -> &'static str {
        self.unit
    }

    /// Per bin: how many, or the largest, which holds until there is another.
    pub(super) fn binned(&self, width_s: f64, count: usize, is_count: bool) -> Vec<f64> {
        let mut bins = vec![None; count];
        for (at_s, value) in &self.samples {
            let Some(bin) = index_of(at_s / width_s).and_then(|index| bins.get_mut(index)) else {
                continue;
            };
            let known: f64 = bin.unwrap_or(0.0);
            *bin = Some(if is_count {
                known + value
            } else {
                known.max(*value)
            });
        }
        if is_count {
            return bins.into_iter().map(Option::unwrap_or_default).collect();
        }
        without_holes(bins)
    }
}

/// The bin of a place in bins; `None` before the first.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the value is checked to lie in 0..2^32"
)]
pub(super) fn index_of(bin: f64) -> Option<usize> {
    (0.0..4_294_967_296.0)
        .contains(&bin)
        .then_some(bin as usize)
}

/// What is unknown where nothing arrived goes on as it was, and before the first that is known as that.
/// A series of which nothing is known is 0 throughout, so that it is constant and in no pair.
pub(super) fn without_holes(values: Vec<Option<f64>>) -> Vec<f64> {
    let mut held = values.iter().flatten().copied().next().unwrap_or(0.0);
    let fill = |value: Option<f64>| {
        held = value.unwrap_or(held);
        held
    };
    values.into_iter().map(fill).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_unknown_is_held_and_never_begins_at_zero() {
        let filled = without_holes(vec![None, Some(2.0), None, Some(0.5), None]);
        assert_eq!(
            filled.map_bits(),
            [2.0, 2.0, 2.0, 0.5, 0.5].to_vec().map_bits()
        );
        assert_eq!(
            without_holes(vec![None; 2]).map_bits(),
            vec![0.0; 2].map_bits()
        );
        let at = |seconds: i64, value: f64| (Instant::from_ns(seconds * 1_000_000_000), value);
        let errors = ErrorSeries {
            name: "error_rad",
            label: "error",
            unit: "m",
            clock_of: "shuttle/status",
            samples: vec![at(1, 0.25), at(3, 0.75), at(3, 0.5)],
        };
        let bins = RobotSeries::of(errors, |at| Some(at.seconds_since(Instant::ZERO)))
            .binned(1.0, 5, false);
        let expected = vec![0.25, 0.25, 0.25, 0.75, 0.75];
        assert_eq!(bins.map_bits(), expected.map_bits());
    }

    #[test]
    fn errors_without_a_sample_are_unknown_and_events_without_one_are_none() {
        let errors = |samples| ErrorSeries {
            name: "error_rad",
            label: "error",
            unit: "m",
            clock_of: "shuttle/status",
            samples,
        };
        let sample = (Instant::ZERO, 0.5);
        let known = |samples| RobotSeries::of(errors(samples), |_| Some(0.0)).is_known();
        assert!(known(vec![sample]) && !known(Vec::new()));
        assert!(!RobotSeries::of(errors(vec![sample]), |_| None).is_known());
        assert!(RobotSeries::of_events(&ScoreEvents::default()).is_known());
    }

    #[test]
    fn events_that_are_not_listed_are_in_the_series() {
        let dropped = [
            (Severity::Hazard, Some(3.5)),
            (Severity::Notice, Some(1.5)),
            (Severity::Incident, Some(3.7)),
            (Severity::Hazard, None),
            (Severity::Hazard, Some(0.5)),
        ];
        let all = ScoreEvents::default().without(dropped.into_iter());
        let series = RobotSeries::of_events(&all);
        assert_eq!(series.label(), "incidents and hazards");
        let bins = series.binned(1.0, 5, true);
        assert_eq!(bins.map_bits(), vec![1.0, 0.0, 0.0, 2.0, 0.0].map_bits());
        assert_eq!(all.dropped_count, 5);
        assert_eq!(all.count_of(Severity::Hazard), 3);
    }

    /// Floats compare exactly here: nothing was computed of them.
    trait Bits {
        fn map_bits(&self) -> Vec<u64>;
    }

    impl Bits for Vec<f64> {
        fn map_bits(&self) -> Vec<u64> {
            self.iter().map(|value| value.to_bits()).collect()
        }
    }
}
