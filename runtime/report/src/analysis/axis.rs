//! The axis of a run's report: seconds after its start. Where the hosts' clocks are aligned, every
//! time is brought to one host's clock before the start is taken from it: two clocks drift apart by
//! milliseconds in minutes, so a start alone, converted once, would not do.

use std::cell::RefCell;
use std::collections::BTreeMap;

use hil_core::time::{Instant, RemoteInstant};

use super::clocks::HostClocks;

/// When the run began and ended, by host, each on the clock of that host.
pub(super) type Spans = BTreeMap<String, (Instant, Instant)>;

/// Puts instants of any host on the run's axis, and remembers how far off they may be.
#[derive(Debug)]
pub(super) struct RunAxis<'a> {
    clocks: &'a HostClocks,
    spans: &'a Spans,
    /// The host whose clock counts, and when the run began there; the start is `None` when that of some
    /// host does not convert.
    counting: Option<(String, Option<Instant>)>,
    /// The largest error of a conversion, by who read the clock.
    bounds_ns: RefCell<BTreeMap<String, u64>>,
}

/// How far the score's own stamps may be off, which were brought to one clock before.
const SCORE: &str = "score";

impl<'a> RunAxis<'a> {
    /// Of a run whose hosts began and ended at `spans`. Times are counted on the clock of `preferred`, if it
    /// was in the run, so that what is most looked at needs no conversion.
    pub(super) fn of(clocks: &'a HostClocks, spans: &'a Spans, preferred: Option<&str>) -> Self {
        let preferred = preferred.and_then(|host| spans.get_key_value(host));
        let here = preferred.or_else(|| spans.first_key_value());
        let here = here.filter(|_| clocks.are_aligned(spans.keys()));
        let counting = here.map(|(host, _)| {
            let starts = spans.iter().map(|(host, span)| (host, span.0));
            (host.clone(), clocks.earliest_on(host, starts))
        });
        Self {
            clocks,
            spans,
            counting,
            bounds_ns: RefCell::default(),
        }
    }

    /// True when each host counts from its own start, because the clocks are not aligned.
    pub(super) const fn is_split(&self) -> bool {
        self.counting.is_none()
    }

    /// An instant of `host` in nanoseconds after the start of the run, with the largest error of its
    /// conversion. Wherever it lies outside the exchanges it converts, widened by the drift allowance.
    /// `None` in a noticed step of a clock, and when the start is unknown.
    pub(super) fn at(&self, host: &str, ns: i64) -> Option<(i64, u64)> {
        let Some((here, start)) = &self.counting else {
            let (start, _) = self.spans.get(host)?;
            return Some((ns.saturating_sub(start.as_ns()), 0));
        };
        let remote = RemoteInstant::from_ns(ns);
        let (at, bound_ns) = self.clocks.path(host, here).localise_beyond(remote)?;
        Some((at.ns_since((*start)?), bound_ns))
    }

    /// As [`Self::at`], for a time that the report compares with others: its error counts.
    pub(super) fn place_ns(&self, host: &str, ns: i64) -> Option<i64> {
        let (at_ns, bound_ns) = self.at(host, ns)?;
        self.note(host, bound_ns);
        Some(at_ns)
    }

    /// As [`Self::place_ns`], in seconds.
    pub(super) fn place_s(&self, host: &str, at: Instant) -> Option<f64> {
        Some(self.place_ns(host, at.as_ns())? as f64 * 1e-9)
    }

    /// An instant in seconds after the start of the run, to be read and not to be compared: the
    /// supervisors speak of what lies long before the exchanges, which no bound of a figure should carry.
    pub(super) fn shown_s(&self, host: &str, at: Instant) -> Option<f64> {
        let (at_ns, _) = self.at(host, at.as_ns())?;
        Some(at_ns as f64 * 1e-9)
    }

    /// Notes that stamps of the score were off by up to `bound_ns` before they came here.
    pub(super) fn note_score(&self, bound_ns: u64) {
        self.note(SCORE, bound_ns);
    }

    /// How far two times of different hosts, or of a host and the score, may be off against each other,
    /// nanoseconds: each errs by its own conversion, so it is the sum of the two largest errors. The
    /// start is one number for all times and drops out. 0 on one clock; `None` without an alignment.
    pub(super) fn bound_ns(&self) -> Option<u64> {
        if self.is_split() {
            return None;
        }
        let mut bounds_ns: Vec<u64> = self.bounds_ns.borrow().values().copied().collect();
        bounds_ns.sort_unstable();
        let largest_ns = bounds_ns.iter().rev().take(2).copied();
        Some(largest_ns.fold(0, u64::saturating_add))
    }

    fn note(&self, reader: &str, bound_ns: u64) {
        let mut by_reader = self.bounds_ns.borrow_mut();
        if let Some(largest_ns) = by_reader.get_mut(reader) {
            *largest_ns = bound_ns.max(*largest_ns);
        } else {
            by_reader.insert(reader.to_owned(), bound_ns);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_clock::{ClockMap, ClockSettings, Exchange, Requester};
    use hil_core::record::RoundTripRecord;

    const SECOND: i64 = 1_000_000_000;

    /// A host whose clock shows `origin_ns` as the run begins and runs `ppm` fast from then on.
    #[derive(Clone, Copy)]
    struct Host {
        name: &'static str,
        origin_ns: i64,
        ppm: i64,
    }

    impl Host {
        /// What its clock shows `true_ns` after the run began.
        fn shown(self, true_ns: i64) -> i64 {
            self.origin_ns + true_ns + true_ns / 1_000_000 * self.ppm
        }
    }

    /// Exchanges every 100 ms for ten minutes, that `local` asks for; 100 us either way.
    fn map(local: Host, remote: Host) -> ClockMap {
        let exchange = |index: i64| {
            let sent_ns = index * SECOND / 10;
            let record = RoundTripRecord {
                sequence: 1,
                t1_ns: local.shown(sent_ns),
                t2_ns: remote.shown(sent_ns + 100_000),
                t3_ns: remote.shown(sent_ns + 105_000),
                t4_ns: local.shown(sent_ns + 205_000),
                session: 1,
                sources: [0; 4],
            };
            Exchange::of(&record, Requester::Local).unwrap()
        };
        let exchanges: Vec<Exchange> = (0..6_000).map(exchange).collect();
        ClockMap::new(&exchanges, ClockSettings::default())
    }

    const fn host(name: &'static str, origin_ns: i64, ppm: i64) -> Host {
        Host {
            name,
            origin_ns,
            ppm,
        }
    }

    const HOSTS: [Host; 3] = [
        host("a", 0, 50),
        host("b", 1_000 * SECOND, -50),
        host("c", 77 * SECOND, 20),
    ];

    /// All hosts related to each other but for `without`.
    fn clocks(without: &[(&str, &str)]) -> HostClocks {
        let mut maps = Vec::new();
        for remote in HOSTS {
            for local in HOSTS {
                let (from, to) = (remote.name, local.name);
                if from != to && !without.contains(&(from, to)) && !without.contains(&(to, from)) {
                    maps.push(((from.to_owned(), to.to_owned()), map(local, remote)));
                }
            }
        }
        HostClocks::mapped(maps)
    }

    fn spans() -> Spans {
        let span = |host: Host| {
            let at = |true_ns| Instant::from_ns(host.shown(true_ns));
            (host.name.to_owned(), (at(0), at(600 * SECOND)))
        };
        HOSTS.into_iter().map(span).collect()
    }

    #[test]
    fn one_instant_of_two_clocks_that_drift_apart_has_one_time_within_the_bound() {
        let (clocks, spans) = (clocks(&[]), spans());
        let axis = RunAxis::of(&clocks, &spans, Some("b"));
        for true_s in [0, 1, 60, 300, 599] {
            let true_ns = true_s * SECOND;
            let times = HOSTS.map(|host| axis.place_ns(host.name, host.shown(true_ns)).unwrap());
            let bound_ns = axis.bound_ns().unwrap();
            for at_ns in times {
                // Ten minutes at 100 ppm are 60 ms; a round trip is 0.2 ms.
                let error_ns = at_ns.abs_diff(times[1]);
                assert!(error_ns <= bound_ns, "{true_s} s: {times:?}, {bound_ns}");
            }
            assert!((200_000..1_000_000).contains(&bound_ns), "{bound_ns}");
        }
        // What only the starts of the hosts' clocks say is out of that bound.
        let since_own_start_ns =
            HOSTS.map(|host| host.shown(599 * SECOND) - spans[host.name].0.as_ns());
        let apart_ns = since_own_start_ns[0].abs_diff(since_own_start_ns[1]);
        assert!(apart_ns > 10 * axis.bound_ns().unwrap(), "{apart_ns}");
    }

    #[test]
    fn the_bound_is_that_of_both_conversions_and_of_the_score() {
        let (clocks, spans) = (clocks(&[]), spans());
        let axis = RunAxis::of(&clocks, &spans, Some("b"));
        let error_ns = |host: Host| {
            let ns = host.shown(300 * SECOND);
            assert!(axis.place_ns(host.name, ns).is_some());
            axis.at(host.name, ns).unwrap().1
        };
        let [a_ns, b_ns, c_ns] = HOSTS.map(error_ns);
        assert_eq!(b_ns, 0, "it is the clock that counts");
        assert_eq!(axis.bound_ns(), Some(a_ns + c_ns));
        axis.note_score(SECOND as u64);
        let largest_ns = a_ns.max(c_ns);
        assert_eq!(axis.bound_ns(), Some(largest_ns + SECOND as u64));
    }

    #[test]
    fn partly_aligned_hosts_count_from_their_own_starts_and_have_no_bound() {
        let (clocks, spans) = (clocks(&[("a", "c")]), spans());
        let axis = RunAxis::of(&clocks, &spans, Some("b"));
        let at_ns = axis.place_ns("a", HOSTS[0].shown(60 * SECOND));
        assert_eq!(at_ns, Some(60 * SECOND + 3_000_000));
        assert!(axis.is_split());
        assert_eq!(axis.bound_ns(), None);
        assert_eq!(axis.place_ns("d", 0), None, "it was not in the run");
    }
}
