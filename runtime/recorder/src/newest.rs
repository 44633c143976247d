//! The newest time of many, on the word of two: one damaged time in a record must not make all that
//! comes after it look late.

/// Times further ahead than this need another one beside them.
const JUMP_NS: i64 = 5_000_000_000;

/// The newest of some times, nanoseconds on any one clock.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Newest {
    known_ns: Option<i64>,
    /// A time far ahead that nothing stands beside yet.
    doubtful_ns: Option<i64>,
}

impl Newest {
    /// Takes a time.
    pub(crate) fn take(&mut self, at_ns: i64) {
        let is_near = |other_ns: i64| at_ns.saturating_sub(other_ns) <= JUMP_NS;
        if let Some(known_ns) = self.known_ns.filter(|known_ns| is_near(*known_ns)) {
            self.known_ns = Some(known_ns.max(at_ns));
            return;
        }
        let beside = self
            .doubtful_ns
            .filter(|other_ns| is_near(*other_ns) && other_ns.saturating_sub(at_ns) <= JUMP_NS);
        if let Some(other_ns) = beside {
            self.known_ns = Some(other_ns.max(at_ns));
        }
        self.doubtful_ns = beside.is_none().then_some(at_ns);
    }

    /// The newest so far; `None` before two times stood beside each other.
    pub(crate) const fn get(&self) -> Option<i64> {
        self.known_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn check(times: &[i64], expected: Option<i64>) {
        let mut newest = Newest::default();
        for at_ns in times {
            newest.take(*at_ns);
        }
        assert_eq!(newest.get(), expected, "{times:?}");
    }

    #[test]
    fn one_damaged_time_moves_nothing_and_a_true_leap_does() {
        check(&[], None);
        check(&[S], None);
        check(&[S, 2 * S], Some(2 * S));
        check(&[2 * S, S], Some(2 * S));
        check(&[S, 2 * S, i64::MAX, 3 * S], Some(3 * S));
        check(&[i64::MAX, S, 2 * S], Some(2 * S));
        check(&[S, 2 * S, i64::MIN, 3 * S], Some(3 * S));
        // A silence, and what comes after it.
        check(&[S, 2 * S, 60 * S], Some(2 * S));
        check(&[S, 2 * S, 60 * S, 61 * S], Some(61 * S));
        check(&[S, 2 * S, i64::MAX, 60 * S, 61 * S, 62 * S], Some(62 * S));
    }
}
