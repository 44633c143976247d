//! The clock path of two hosts held against their data path: both are causally true of the same
//! two clocks, so what they allow together is used, and if they exclude each other nothing is.

use hil_clock::{ClockMap, ClockMetrics, ClockSettings, Exchange, Localised, Requester};
use hil_core::time::{Instant, RemoteInstant};
use hil_present::units::duration;

use super::clocks;
use super::records::RunRecords;
use crate::clock_summary::{ClockPathEnd, ClockPathSummary, ClockRung, HostPairClock};
use hil_rundir::run_result::RunResult;
use hil_topology::{ClockPath, Host, clock_process_name};

/// A clock path that was silent for longer in a run is warned of: gateways on the data path exchange
/// clocks ten times a second, so by then it is the worse source.
const SILENCE_NS: u64 = 1_000_000_000;

/// The exchanges over the clock path of two hosts, for instants of the first on the clock of the
/// second.
pub(super) fn exchanges(records: &RunRecords<'_>, from: &str, to: &str) -> Vec<Exchange> {
    let Some(path) = records.topology.clock_path_between(from, to) else {
        return Vec::new();
    };
    let requester = if path.from.name == to {
        Requester::Local
    } else {
        Requester::Remote
    };
    let name = path.name();
    let round_trips = records.round_trips(&name);
    let found = round_trips.filter_map(|one| Exchange::of(one, requester));
    found.collect()
}

/// Says in `pair` what came over its clock path, and takes back its alignment if that and the data
/// path exclude each other.
pub(super) fn compare(pair: &mut HostPairClock, records: &RunRecords<'_>) {
    let result = records.result;
    let (from, to) = (pair.from.as_str(), pair.to.as_str());
    let Some(path) = records.topology.clock_path_between(from, to) else {
        return;
    };
    let over_path = exchanges(records, from, to);
    let over_data = clocks::exchanges(records, from, to);
    let [path_map, data_map] =
        [&over_path, &over_data].map(|some| ClockMap::new(some, ClockSettings::default()));
    let figures = |map: &ClockMap| -> Option<ClockMetrics> {
        let figures = map.metrics();
        (figures.exchange_count > 0).then(|| figures.clone())
    };
    // Of the host that asks, whichever of the two is converted from.
    let name = path.name();
    let asked = records.round_trips(&name).map(|one| one.t1_ns);
    let asked: Vec<i64> = asked.collect();
    let summary = ClockPathSummary {
        name,
        ends: [(path.from, path.asking), (path.to, path.answering)]
            .map(|(host, address)| end(host, &address.ip().to_string())),
        state: state(&path, result),
        exchanges: figures(&path_map),
        data_path: figures(&data_map),
        longest_gap_ns: result
            .spans
            .get(&path.from.name)
            .and_then(|(start, end)| longest_gap_ns(asked, *start, *end)),
    };
    if !summary.has_exchanges() && pair.rung == ClockRung::Exchanges {
        let words = "; the clock path gave none, so these are the data path's alone";
        pair.basis.push_str(words);
    }
    pair.clock_path = Some(summary);
    if pair.rung == ClockRung::OneClock {
        return;
    }
    let instants = over_path.iter().chain(&over_data).map(Exchange::remote_ns);
    if let Some(why) = contradiction(&path_map, &data_map, instants) {
        pair.rung = ClockRung::None;
        "clock path and data path contradict each other".clone_into(&mut pair.basis);
        pair.contradiction = Some(why);
    }
}

fn end(host: &Host, address: &str) -> ClockPathEnd {
    ClockPathEnd {
        host: host.name.clone(),
        address: address.to_owned(),
        interface: host.clock_interface.clone(),
    }
}

/// How the end that asks stood to the other, or how its process ended.
fn state(path: &ClockPath<'_>, result: &RunResult) -> String {
    let name = clock_process_name(path, &path.from.name);
    let mut processes = result.processes.iter();
    let Some(process) = processes.find(|one| one.name == name) else {
        return format!("nothing is known of process {name}");
    };
    let directions = process.report.iter().flat_map(|report| &report.directions);
    let mut states = directions.map(|direction| direction.peer_state.clone());
    let told = states.next();
    told.unwrap_or_else(|| format!("process {name} {}", process.end))
}

/// The longest time between the run's start, the exchanges begun in it, and its end; `None` without
/// any.
fn longest_gap_ns(mut asked_ns: Vec<i64>, start: Instant, end: Instant) -> Option<u64> {
    let (start_ns, end_ns) = (start.as_ns(), end.as_ns());
    if asked_ns.is_empty() {
        return None;
    }
    asked_ns.retain(|at_ns| (start_ns..=end_ns).contains(at_ns));
    asked_ns.extend([start_ns, end_ns]);
    asked_ns.sort_unstable();
    let gaps = asked_ns
        .windows(2)
        .map(|pair| pair[1].saturating_sub(pair[0]).unsigned_abs());
    gaps.max()
}

/// Where two maps of the same clocks exclude each other by the most, in words: one of the two sets
/// of exchanges is not what it is taken for.
fn contradiction(
    path: &ClockMap,
    data: &ClockMap,
    instants: impl Iterator<Item = i64>,
) -> Option<String> {
    let apart = instants.filter_map(|at_ns| {
        let remote = RemoteInstant::from_ns(at_ns);
        let by_path = path.localise(remote)?;
        let by_data = data.localise(remote)?;
        let beyond = |one: &Localised, other: &Localised| one.earliest.ns_since(other.latest);
        let gap_ns = beyond(&by_path, &by_data).max(beyond(&by_data, &by_path));
        (gap_ns > 0).then_some((gap_ns, by_path, by_data))
    });
    let (gap_ns, by_path, by_data) = apart.max_by_key(|(gap_ns, ..)| *gap_ns)?;
    let bound = |one: &Localised| duration(one.latest.ns_since(one.earliest) / 2);
    Some(format!(
        "the exchanges over the clock path prove an offset (within ±{}) that is at least {} beyond what \
         those over the data path prove (within ±{}) of the same instant",
        bound(&by_path),
        duration(gap_ns),
        bound(&by_data)
    ))
}

/// What a reader must know of a clock path that did not give what it is for.
pub(super) fn warning(pair: &HostPairClock) -> Option<String> {
    let path = pair.clock_path.as_ref()?;
    let instead = match pair.rung {
        // Nothing hangs on it then.
        ClockRung::OneClock => return None,
        ClockRung::Disciplined => "follows from their system clocks",
        ClockRung::Exchanges | ClockRung::None => "comes over the data path",
    };
    let what = path.describe();
    let (from, to) = (&pair.from, &pair.to);
    if !path.has_exchanges() {
        return Some(format!(
            "{what} gave no exchange ({}): what relates the clocks of {from} and {to} {instead}",
            path.state
        ));
    }
    let gap_ns = path.longest_gap_ns.filter(|gap_ns| *gap_ns > SILENCE_NS)?;
    let silence_s = gap_ns as f64 * 1e-9;
    Some(format!(
        "{what} was without an exchange for {silence_s:.1} s of the run: there the clocks of {from} \
         and {to} are related by the data path and by what came before and after"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::record::RoundTripRecord;

    const SECOND_NS: i64 = 1_000_000_000;

    /// Exchanges over a second, one each `period_ns`, on a path that takes `there_ns` and `back_ns`;
    /// the clock converted to is ahead by `offset_ns`.
    fn map(period_ns: i64, there_ns: i64, back_ns: i64, offset_ns: i64) -> ClockMap {
        let exchange = |index: i64| {
            let sent_ns = index * period_ns;
            let arrived_ns = sent_ns + there_ns + offset_ns;
            let record = RoundTripRecord {
                sequence: index.unsigned_abs(),
                t1_ns: sent_ns,
                t2_ns: arrived_ns,
                t3_ns: arrived_ns,
                t4_ns: arrived_ns + back_ns - offset_ns,
                session: 1,
                sources: [1; 4],
            };
            Exchange::of(&record, Requester::Remote)
        };
        let exchanges: Vec<Exchange> = (0..=SECOND_NS / period_ns).filter_map(exchange).collect();
        ClockMap::new(&exchanges, ClockSettings::default())
    }

    fn instants() -> impl Iterator<Item = i64> {
        (0..=10).map(|tenth| tenth * SECOND_NS / 10)
    }

    #[test]
    fn a_wide_lopsided_path_and_a_narrow_one_agree_on_the_same_clocks() {
        let path = map(10_000_000, 8_000, 12_000, 7 * SECOND_NS);
        for ways in [(9_000_000, 1_000), (1_000, 9_000_000), (5_000, 5_000)] {
            let data = map(100_000_000, ways.0, ways.1, 7 * SECOND_NS);
            assert_eq!(contradiction(&path, &data, instants()), None, "{ways:?}");
        }
        let nothing = ClockMap::new(&[], ClockSettings::default());
        assert_eq!(contradiction(&path, &nothing, instants()), None);
    }

    #[test]
    fn two_paths_to_different_clocks_exclude_each_other_whichever_is_ahead() {
        let path = map(10_000_000, 8_000, 12_000, 7 * SECOND_NS);
        for apart_ns in [-400_000, 400_000] {
            let data = map(100_000_000, 100_000, 100_000, 7 * SECOND_NS + apart_ns);
            let why = contradiction(&path, &data, instants()).unwrap();
            assert!(
                why.contains("over the clock path prove an offset (within"),
                "{why}"
            );
            let why = contradiction(&data, &path, instants());
            assert!(why.is_some());
        }
        // A difference that the wide path leaves room for proves nothing.
        let data = map(100_000_000, 300_000, 300_000, 7 * SECOND_NS + 200_000);
        assert_eq!(contradiction(&path, &data, instants()), None);
    }

    #[test]
    fn the_longest_silence_counts_from_the_start_to_the_end_of_the_run() {
        let [start, end] = [1_000, 2_000].map(Instant::from_ns);
        let gap = |asked: &[i64]| longest_gap_ns(asked.to_vec(), start, end);
        assert_eq!(gap(&[]), None);
        assert_eq!(gap(&[1_100, 1_400, 1_900]), Some(500));
        assert_eq!(gap(&[1_900, 1_400]), Some(500));
        assert_eq!(gap(&[900, 1_700]), Some(700));
        assert_eq!(gap(&[900, 2_500]), Some(1_000), "none within the run");
    }
}
