//! Relates the clocks of a run's hosts: by the clock they share, by the reference they follow, or
//! by the exchanges of their gateways. The estimating is done in `hil_clock`.

use std::collections::{BTreeMap, BTreeSet};

use hil_account::ChannelPath;
use hil_clock::{ClockMap, ClockMetrics, ClockSettings, Exchange, Requester};
use hil_core::time::{Alignment, Instant, RemoteInstant};
use hil_present::units::{duration, unsigned_duration};

use super::clock_path;
use super::records::RunRecords;
use crate::clock_summary::{ClockRung, ClockSection, DisciplinedOffset, HostPairClock};
use hil_platform::clock_discipline::{self, HostDiscipline};
use hil_topology::{Channel, Topology};

/// How instants get from any host of the run to any other.
#[derive(Debug, Default)]
pub(crate) struct HostClocks {
    has_one_clock: bool,
    relations: BTreeMap<(String, String), Relation>,
    /// For the summary.
    pub(super) section: ClockSection,
}

#[derive(Debug)]
enum Relation {
    Constant(Option<Alignment>),
    Mapped(Box<ClockMap>),
}

impl HostClocks {
    /// Of the hosts of a run, from what their gateways and supervisors recorded.
    pub(super) fn of(records: &RunRecords<'_>) -> Self {
        let (topology, result) = (records.topology, records.result);
        let mut clocks = Self {
            has_one_clock: result.has_one_clock,
            relations: BTreeMap::new(),
            section: ClockSection {
                has_one_clock: result.has_one_clock,
                hosts: result.disciplines.clone(),
                pairs: Vec::new(),
            },
        };
        let mut pairs = BTreeSet::new();
        for channel in topology.channels() {
            if let Some((from, to)) = hosts_of(topology, channel) {
                pairs.insert(if from <= to { (from, to) } else { (to, from) });
            }
        }
        for (one, other) in pairs {
            clocks.relate(records, one, other);
        }
        clocks
    }

    /// The way of a channel that a link carries between two hosts.
    pub(crate) fn path(&self, from: &str, to: &str) -> ChannelPath<'_> {
        if self.has_one_clock || from == to {
            let alignment = Some(Alignment::SAME_CLOCK);
            return ChannelPath::Gateway { alignment };
        }
        match self.relations.get(&(from.to_owned(), to.to_owned())) {
            Some(Relation::Mapped(map)) => ChannelPath::Mapped { map },
            Some(Relation::Constant(alignment)) => ChannelPath::Gateway {
                alignment: *alignment,
            },
            None => ChannelPath::Gateway { alignment: None },
        }
    }

    /// What a reader must know of pairs whose one-way figures are missing or invalid.
    pub(super) fn warnings(&self) -> impl Iterator<Item = String> {
        self.section.pairs.iter().filter_map(|pair| {
            let (from, to) = (&pair.from, &pair.to);
            if let Some(why) = &pair.contradiction {
                return Some(format!(
                    "one-way delays between {from} and {to} are invalid and left out: {why}"
                ));
            }
            (pair.rung == ClockRung::None).then(|| {
                format!(
                    "clocks of {from} and {to} not aligned ({}): no figure crosses from one host \
                     to the other; segments on one host and round trips are given",
                    pair.basis
                )
            })
        })
    }

    /// The earliest of several hosts' instants, on the clock of `host`; `None` unless all of them
    /// convert. Gateways may begin to exchange clocks long after the run began, so instants before
    /// the exchanges convert, too. Its error shifts all times since the start alike.
    pub(super) fn earliest_on<'a>(
        &self,
        host: &str,
        instants: impl Iterator<Item = (&'a String, Instant)>,
    ) -> Option<Instant> {
        let mut earliest: Option<Instant> = None;
        for (from, instant) in instants {
            let remote = RemoteInstant::from_ns(instant.as_ns());
            let (here, _) = self.path(from, host).localise_beyond(remote)?;
            earliest = Some(earliest.map_or(here, |known| known.min(here)));
        }
        earliest
    }

    /// True when instants of every two hosts of the run compare, be it within a bound.
    pub(super) fn are_aligned<'a>(&self, hosts: impl Iterator<Item = &'a String>) -> bool {
        let hosts: Vec<&String> = hosts.collect();
        let mut pairs = hosts
            .iter()
            .flat_map(|from| hosts.iter().map(move |to| (from, to)));
        pairs.all(|(from, to)| self.path(from, to).is_aligned())
    }

    /// Hosts that exchanges relate, each map from the first of two to the second.
    #[cfg(test)]
    pub(super) fn mapped(maps: Vec<((String, String), ClockMap)>) -> Self {
        let relations = maps.into_iter();
        let relations = relations.map(|(hosts, map)| (hosts, Relation::Mapped(Box::new(map))));
        Self {
            relations: relations.collect(),
            ..Self::default()
        }
    }

    fn relate(&mut self, records: &RunRecords<'_>, from: String, to: String) {
        let map = |from: &str, to: &str| {
            let mut exchanges = exchanges(records, from, to);
            exchanges.extend(clock_path::exchanges(records, from, to));
            ClockMap::new(&exchanges, ClockSettings::default())
        };
        let (there, back) = (map(&from, &to), map(&to, &from));
        let disciplined = disciplined(records, &from, &to);
        let mut pair = HostPairClock {
            from: from.clone(),
            to: to.clone(),
            rung: ClockRung::None,
            basis: String::new(),
            exchanges: (there.metrics().exchange_count > 0).then(|| there.metrics().clone()),
            disciplined: disciplined.as_ref().ok().copied(),
            contradiction: None,
            clock_path: None,
        };
        choose(&mut pair, self.has_one_clock, &there, disciplined);
        clock_path::compare(&mut pair, records);
        let (forwards, backwards) = match (pair.rung, pair.disciplined) {
            (ClockRung::Exchanges, _) => (
                Relation::Mapped(Box::new(there)),
                Relation::Mapped(Box::new(back)),
            ),
            (ClockRung::Disciplined, Some(offset)) => {
                let constant = |offset_ns| {
                    let bound_ns = offset.bound_ns;
                    Relation::Constant(Some(Alignment {
                        offset_ns,
                        bound_ns,
                    }))
                };
                (constant(offset.offset_ns), constant(-offset.offset_ns))
            }
            _ => (Relation::Constant(None), Relation::Constant(None)),
        };
        self.relations.insert((from.clone(), to.clone()), forwards);
        self.relations.insert((to, from), backwards);
        self.section.pairs.push(pair);
    }
}

/// Takes the highest rung that holds, and holds it against the exchanges.
fn choose(
    pair: &mut HostPairClock,
    has_one_clock: bool,
    map: &ClockMap,
    disciplined: Result<DisciplinedOffset, String>,
) {
    if has_one_clock {
        pair.rung = ClockRung::OneClock;
        "same boot, same time namespace: stamps compare as they are".clone_into(&mut pair.basis);
        return;
    }
    let figures = map.metrics();
    if let Some(found) = figures.drift_contradiction {
        pair.contradiction = Some(format!(
            "the exchanges show that the clocks run {:+.0} ppm apart, more than the {:.0} ppm for \
             which the bound holds: it is withdrawn, and one-way delay is not resolved",
            found.rate_ppm, found.limit_ppm
        ));
        "the exchanges contradict the drift limit of their bound".clone_into(&mut pair.basis);
        return;
    }
    match disciplined {
        Ok(offset) => {
            pair.contradiction = contradiction(offset, figures);
            // A daemon's word is used where it says more than causality does.
            let exchanged_ns = figures.bound.map(|bound| bound.median_ns);
            if pair.contradiction.is_some() {
                pair.rung = ClockRung::None;
                "the rungs contradict each other".clone_into(&mut pair.basis);
            } else if exchanged_ns.is_none_or(|bound_ns| offset.bound_ns < bound_ns) {
                pair.rung = ClockRung::Disciplined;
                "narrower than the exchanges, which agree with it".clone_into(&mut pair.basis);
            } else {
                pair.rung = ClockRung::Exchanges;
                pair.basis = format!(
                    "narrower than the disciplined system clocks (±{}), which agree with it",
                    unsigned_duration(offset.bound_ns)
                );
            }
        }
        Err(why) if figures.offset.is_some() => {
            pair.rung = ClockRung::Exchanges;
            pair.basis = format!("system clocks give no bound: {why}");
        }
        Err(why) => {
            pair.basis = format!("no clock exchange took place, and {why}");
        }
    }
}

/// Why the system clocks and the exchanges cannot both be right: what the former claim holds for the
/// whole run, so it must be possible in each stretch between steps.
fn contradiction(claimed: DisciplinedOffset, exchanges: &ClockMetrics) -> Option<String> {
    let lowest_ns = claimed.offset_ns.saturating_sub_unsigned(claimed.bound_ns);
    let highest_ns = claimed.offset_ns.saturating_add_unsigned(claimed.bound_ns);
    let stretches = &exchanges.stretch_offsets;
    let mut apart = stretches
        .iter()
        .filter(|one| highest_ns < one.lowest_ns || lowest_ns > one.highest_ns);
    let first = apart.next()?;
    let gap_ns = (first.lowest_ns.saturating_sub(highest_ns))
        .max(lowest_ns.saturating_sub(first.highest_ns));
    let place = match stretches.len() {
        1 => String::new(),
        count => format!(
            " in {} of the {count} stretches between steps of a clock",
            1 + apart.count()
        ),
    };
    let width_ns = first.highest_ns.saturating_sub(first.lowest_ns);
    Some(format!(
        "the offset that the system clocks claim (within ±{}) is at least {} beyond what the exchanges \
         prove (within ±{}){place}",
        unsigned_duration(claimed.bound_ns),
        duration(gap_ns),
        duration(width_ns / 2)
    ))
}

/// Both hosts' system clocks follow one reference, so their real-time clocks are equal within both
/// bounds, and their monotonic clocks differ as much as their own offsets do.
fn disciplined(
    records: &RunRecords<'_>,
    from: &str,
    to: &str,
) -> Result<DisciplinedOffset, String> {
    let of = |host: &str| -> Result<&HostDiscipline, String> {
        let told = records.result.disciplines.get(host);
        told.ok_or_else(|| format!("{host} told nothing of its system clock"))
    };
    let bound_ns = clock_discipline::common_bound_ns(from, of(from)?, to, of(to)?)?;
    let realtime = |host: &str| {
        let offset_ns = records.realtime_offset_ns(host);
        offset_ns.ok_or_else(|| format!("{host} recorded no system clock, or stepped it"))
    };
    // monotonic_to = realtime − offset_to, and realtime = monotonic_from + offset_from.
    Ok(DisciplinedOffset {
        offset_ns: realtime(from)?.saturating_sub(realtime(to)?),
        bound_ns,
    })
}

/// The exchanges of all links between two hosts, for instants of the first on the clock of the second.
pub(super) fn exchanges(records: &RunRecords<'_>, from: &str, to: &str) -> Vec<Exchange> {
    let mut flows: BTreeMap<String, Requester> = BTreeMap::new();
    for crossing in records.topology.crossings() {
        // The sending gateway asks.
        let ends = (
            crossing.from_host.name.as_str(),
            crossing.to_host.name.as_str(),
        );
        if ends == (to, from) {
            flows.insert(crossing.flow_name(), Requester::Local);
        } else if ends == (from, to) {
            flows.insert(crossing.flow_name(), Requester::Remote);
        }
    }
    let mut found = Vec::new();
    for (flow, requester) in flows {
        let round_trips = records.round_trips(&flow);
        found.extend(round_trips.filter_map(|one| Exchange::of(one, requester)));
    }
    found
}

/// Both ends of a channel that a link carries between two hosts.
fn hosts_of(topology: &Topology, channel: &Channel) -> Option<(String, String)> {
    let crossing = topology.crossing(channel)?;
    let (from, to) = (&crossing.from_host.name, &crossing.to_host.name);
    (from != to).then(|| (from.clone(), to.clone()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::record::RoundTripRecord;

    /// Exchanges every 10 ms for 4 s from `from_s` on of `here`; the other clock is `ahead_ns`
    /// ahead by then, and the way takes 100 us in either direction.
    fn exchanges(from_s: i64, ahead_ns: impl Fn(i64) -> i64) -> Vec<Exchange> {
        let exchange = |index: i64| {
            let sent_ns = from_s * 1_000_000_000 + index * 10_000_000;
            let arrived_ns = sent_ns + 100_000 + ahead_ns(index);
            let record = RoundTripRecord {
                sequence: 1,
                t1_ns: sent_ns,
                t2_ns: arrived_ns,
                t3_ns: arrived_ns + 5_000,
                t4_ns: sent_ns + 205_000,
                session: 1,
                sources: [0; 4],
            };
            Exchange::of(&record, Requester::Local).unwrap()
        };
        (0..400).map(exchange).collect()
    }

    fn chosen(map: &ClockMap, claimed: DisciplinedOffset) -> HostPairClock {
        let mut pair = HostPairClock {
            from: "control-pc".to_owned(),
            to: "robot-pc".to_owned(),
            rung: ClockRung::None,
            basis: String::new(),
            exchanges: None,
            disciplined: None,
            contradiction: None,
            clock_path: None,
        };
        choose(&mut pair, false, map, Ok(claimed));
        pair
    }

    #[test]
    fn a_claim_that_any_stretch_between_steps_disproves_is_contradicted() {
        // The other clock gains 20 ms in mid-run, which the claim knows nothing of.
        let step = |index: i64| if index < 200 { 0 } else { 20_000_000 };
        let map = ClockMap::new(&exchanges(0, step), ClockSettings::default());
        assert_eq!(map.metrics().stretch_offsets.len(), 2);
        for offset_ns in [0, -20_000_000] {
            let bound_ns = 50_000;
            let pair = chosen(
                &map,
                DisciplinedOffset {
                    offset_ns,
                    bound_ns,
                },
            );
            assert_eq!(pair.rung, ClockRung::None, "{pair:?}");
            let why = pair.contradiction.unwrap();
            assert!(why.contains("in 1 of the 2 stretches"), "{why}");
        }
        // One that is wide enough for both holds, and says less than the exchanges.
        let wide = DisciplinedOffset {
            offset_ns: -10_000_000,
            bound_ns: 11_000_000,
        };
        let pair = chosen(&map, wide);
        assert_eq!(
            (pair.rung, pair.contradiction),
            (ClockRung::Exchanges, None)
        );
    }

    #[test]
    fn clocks_that_run_apart_beyond_the_limit_have_no_bound_and_the_reason() {
        let map = ClockMap::new(
            &exchanges(0, |index| index * 10_000),
            ClockSettings::default(),
        );
        let claimed = DisciplinedOffset {
            offset_ns: 0,
            bound_ns: 1_000,
        };
        let pair = chosen(&map, claimed);
        assert_eq!(pair.rung, ClockRung::None, "{pair:?}");
        let why = pair.contradiction.unwrap();
        assert!(
            why.contains("200 ppm") && why.contains("not resolved"),
            "{why}"
        );
    }

    #[test]
    fn a_claim_is_taken_where_it_is_narrower_than_the_exchanges() {
        let map = ClockMap::new(&exchanges(0, |_| 0), ClockSettings::default());
        let claimed = |offset_ns| DisciplinedOffset {
            offset_ns,
            bound_ns: 2_000,
        };
        let pair = chosen(&map, claimed(0));
        assert_eq!(
            (pair.rung, pair.contradiction),
            (ClockRung::Disciplined, None)
        );
        let why = chosen(&map, claimed(500_000)).contradiction.unwrap();
        assert!(!why.contains("stretches"), "{why}");
    }

    #[test]
    fn a_run_that_began_long_before_the_exchanges_has_one_beginning() {
        let ahead_ns = 100_000_000_000;
        let mut maps = Vec::new();
        let [here, there] = ["control-pc", "robot-pc"].map(str::to_owned);
        for (from, to, ahead_ns) in [(&there, &here, ahead_ns), (&here, &there, -ahead_ns)] {
            let from_s = if ahead_ns > 0 { 5 } else { 105 };
            let map = ClockMap::new(&exchanges(from_s, |_| ahead_ns), ClockSettings::default());
            maps.push(((from.clone(), to.clone()), map));
        }
        let clocks = HostClocks::mapped(maps);
        // Three seconds before the first exchange, the other host 2 ms later.
        let start = Instant::from_ns(2_000_000_000);
        let later = Instant::from_ns(start.as_ns() + ahead_ns + 2_000_000);
        let remote = RemoteInstant::from_ns(start.as_ns());
        assert_eq!(clocks.path(&here, &there).localise(remote), None);
        let spans = [(&here, start), (&there, later)];
        for (host, expected_ns) in [(&here, 2_000_000_000), (&there, 102_000_000_000)] {
            let found = clocks.earliest_on(host, spans.into_iter()).unwrap();
            assert!(found.as_ns().abs_diff(expected_ns) < 1_000, "{found:?}");
        }
        let alone = clocks.earliest_on("third", spans.into_iter());
        assert_eq!(alone, None, "no clock of it is known");
    }
}
