//! What the instants of a text count from: a start of their own, or the epoch of some clock. A text does not say it, so
//! an instant is judged by its size.

/// What one stands for in a column of instants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Unit {
    name: &'static str,
    per_s: i64,
}

pub(crate) const MILLISECONDS: Unit = Unit {
    name: "ms",
    per_s: 1_000,
};
pub(crate) const NANOSECONDS: Unit = Unit {
    name: "ns",
    per_s: 1_000_000_000,
};
const COARSER: [Unit; 3] = [
    Unit {
        name: "s",
        per_s: 1,
    },
    MILLISECONDS,
    Unit {
        name: "us",
        per_s: 1_000_000,
    },
];

/// Seconds since 1970 of the years 2008 to 2039.
const TODAY_S: core::ops::Range<i64> = 1_200_000_000..2_200_000_000;
/// Since the start of a run or of a computer it is less: three years.
const SINCE_START_S: i64 = 100_000_000;

impl Unit {
    /// True for a time of today since 1970, where it began `later_s` after the epoch in question.
    fn is_of_today(self, at: i64, later_s: i64) -> bool {
        let [from, to] = [TODAY_S.start, TODAY_S.end]
            .map(|s| (i128::from(s) + i128::from(later_s)) * i128::from(self.per_s));
        (from..to).contains(&i128::from(at))
    }

    /// True for what may be a time since the start of a run or of a computer.
    pub(crate) const fn is_since_start(self, at: i64) -> bool {
        at.unsigned_abs() < (SINCE_START_S * self.per_s).unsigned_abs()
    }
}

/// Instants that cannot be what their column holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct EpochFault {
    /// Which instant, from 0.
    pub(crate) index: usize,
    /// What is wrong with it.
    pub(crate) what: String,
    /// True when the instants could still be meant as they are.
    pub(crate) is_doubt: bool,
}

/// From which instant ascending `instants` of `unit` count: 0 where they count from a start, the first where they
/// count from 1970.
pub(crate) fn origin(
    instants: impl Iterator<Item = i64> + Clone,
    unit: Unit,
) -> Result<i64, EpochFault> {
    let Some((first, last)) = instants.clone().next().zip(instants.clone().last()) else {
        return Ok(0);
    };
    let moment = |at: i64| (unit.is_since_start(at), unit.is_of_today(at, 0));
    let mut others = instants.clone().enumerate();
    if let Some((index, at)) = others.find(|(_, at)| moment(*at) != moment(first)) {
        return Err(EpochFault {
            index,
            what: format!(
                "the instant {at}{} does not count from the same moment as the first one, {first}",
                epoch_words(at, unit)
            ),
            is_doubt: false,
        });
    }
    if unit.is_of_today(first, 0) {
        return Ok(first);
    }
    if !unit.is_since_start(first) {
        let what = format!(
            "the instant {first}{}: expected are {} since 1970 or since a start",
            epoch_words(first, unit),
            unit.name
        );
        return Err(EpochFault {
            index: 0,
            what,
            is_doubt: false,
        });
    }
    // A zero may stand for a first instant that is missing.
    let mut dated = instants.enumerate().skip_while(|(_, at)| *at == 0);
    let Some((index, start)) = dated
        .next()
        .filter(|(index, _)| *index == 0 || dated.next().is_some())
    else {
        return Ok(0);
    };
    let coarser = COARSER.into_iter().filter(|one| one.per_s < unit.per_s);
    let mut meant = coarser.filter(|one| one.is_of_today(start, 0) && one.is_of_today(last, 0));
    meant.next().map_or(Ok(0), |meant| {
        let factor = unit.per_s / meant.per_s;
        Err(EpochFault {
            index,
            what: format!(
                "the instant {start} is an epoch time in {}, expected {}: multiply by {factor}",
                meant.name, unit.name
            ),
            is_doubt: true,
        })
    })
}

/// The clock that would have shown `at`, if it is none of ours.
fn epoch_words(at: i64, unit: Unit) -> &'static str {
    const HUNDRED_NS: Unit = Unit {
        name: "100 ns",
        per_s: 10_000_000,
    };
    const FROM_1601_S: i64 = 11_644_473_600;
    const FROM_YEAR_1_S: i64 = 62_135_596_800;
    const FROM_1900_S: i64 = 2_208_988_800;
    if unit.is_of_today(at, 0) {
        " (since 1970)"
    } else if HUNDRED_NS.is_of_today(at, FROM_1601_S) {
        " (a FILETIME: 100 ns since 1601)"
    } else if HUNDRED_NS.is_of_today(at, FROM_YEAR_1_S) {
        " (ticks of 100 ns since year 1)"
    } else if unit.is_of_today(at, FROM_1900_S) {
        " (since 1900)"
    } else if unit.is_since_start(at) {
        ""
    } else {
        " (since 1970 none of the years 2008 to 2039, and more than three years since a start)"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(instants: &[i64], unit: Unit) -> Result<i64, EpochFault> {
        origin(instants.iter().copied(), unit)
    }

    #[test]
    fn instants_since_1970_count_from_the_first_and_those_since_a_start_from_zero() {
        let of = |instants: &[i64]| judged(instants, NANOSECONDS);
        assert_eq!(of(&[]), Ok(0));
        // The 14th of November 2023, 22:13:20 UTC.
        let now = 1_700_000_000_000_000_000;
        assert_eq!(of(&[now, now + 5]), Ok(now));
        for since_start in [
            &[0, 5][..],
            &[-50, 7],
            // A computer that is up for an hour, for a month, for three years.
            &[3_600_000_000_000, 3_600_000_000_000],
            &[2_592_000_000_000_000],
            &[99_000_000_000_000_000],
            // From 20 to 40 minutes: in milliseconds the years 2008 to 2046.
            &[1_200_000_000_000, 2_400_000_000_000],
            // One instant behind a zero.
            &[0, 1_500_000_000],
        ] {
            assert_eq!(of(since_start), Ok(0), "{since_start:?}");
        }
        let ms = 1_700_000_000_000;
        assert_eq!(judged(&[ms, ms + 7], MILLISECONDS), Ok(ms));
    }

    #[test]
    fn another_unit_or_epoch_is_named_with_its_place_however_slow_the_measurement() {
        let now_s = 1_700_000_000;
        for (instants, unit, index, name) in [
            (
                vec![now_s, now_s + 60],
                NANOSECONDS,
                0,
                "in s, expected ns: multiply by 1000000000",
            ),
            (
                vec![now_s * 1_000, now_s * 1_000 + 86_400_000],
                NANOSECONDS,
                0,
                "in ms,",
            ),
            (vec![now_s * 1_000_000], NANOSECONDS, 0, "in us,"),
            (
                vec![0, 0, now_s * 1_000, now_s * 1_000 + 1],
                NANOSECONDS,
                2,
                "in ms,",
            ),
            (vec![now_s, now_s + 1], MILLISECONDS, 0, "in s, expected ms"),
            // The same moment as `now_s` on other clocks.
            (vec![133_444_736_000_000_000], NANOSECONDS, 0, "FILETIME"),
            (
                vec![638_355_968_000_000_000],
                NANOSECONDS,
                0,
                "since year 1",
            ),
            (
                vec![3_908_988_800_000_000_000],
                NANOSECONDS,
                0,
                "since 1900",
            ),
            (
                vec![500_000_000_000_000_000],
                NANOSECONDS,
                0,
                "none of the years",
            ),
            (
                vec![0, now_s * 1_000_000_000],
                NANOSECONDS,
                1,
                "(since 1970) does not count from the same moment as the first one, 0",
            ),
            (
                vec![5, 6, 133_444_736_000_000_000],
                NANOSECONDS,
                2,
                "FILETIME",
            ),
            (
                vec![now_s * 1_000_000_000, i64::MAX],
                NANOSECONDS,
                1,
                "none of the years",
            ),
        ] {
            let fault = judged(&instants, unit).unwrap_err();
            assert!(fault.what.contains(name), "{}", fault.what);
            assert_eq!(fault.index, index, "{instants:?}");
        }
    }
}
