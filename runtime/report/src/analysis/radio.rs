//! From the records of radios to what a report says of them: summaries, events of the association,
//! and a table of the samples.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use hil_account::radio::RadioMetrics;
use hil_core::record::UNAVAILABLE;
use hil_core::time::Instant;

use super::axis::RunAxis;
use super::records::RunRecords;
use crate::radio::{ChannelRadio, RadioHopSummary, RadioReport, Spread, StationSummary};
use crate::summary::{CounterGroup, Fact, RadioChange, RunEvent, RunEventKind, RunSummary};
use hil_rundir::radio_record::{
    NO_CODE, NO_RATE, NO_SIGNAL, RadioRecord, RateRecord, SAMPLE, command,
};

/// Puts everything about radios into the summary; `acknowledgements` are by channel.
pub(super) fn add(
    summary: &mut RunSummary,
    records: &RunRecords<'_>,
    axis: &RunAxis<'_>,
    mut acknowledgements: BTreeMap<String, RadioMetrics>,
) {
    let (topology, result) = (records.topology, records.result);
    let mut report = RadioReport::default();
    for channel in topology.channels() {
        if topology.crossing(channel).is_some() {
            report.channels.push(ChannelRadio {
                channel: channel.name.clone(),
                acknowledgements: acknowledgements.remove(&channel.name),
            });
        }
    }
    for (name, samples) in &records.radios {
        // The name is the process and the interface.
        let (process, interface) = name.rsplit_once('/').unwrap_or((name, ""));
        let host = result.processes.iter().find(|one| one.name == process);
        let host = host.map_or_else(String::new, |one| one.host.clone());
        let place_s = |at_ns| axis.shown_s(&host, Instant::from_ns(at_ns));
        let is_in_run = result.spans.contains_key(&host);
        let mut hop = summarise(samples);
        (hop.process, hop.interface) = (process.to_owned(), interface.to_owned());
        hop.host.clone_from(&host);
        if is_in_run {
            add_events(&mut summary.events, &hop, samples, place_s);
        } else {
            summary.warnings.extend(left_out(&hop));
        }
        match write_series(&result.folder.series(), &hop, samples, place_s) {
            Ok(file) => {
                let what = "samples of the radio; columns in its first line".to_owned();
                summary.run.files.push(Fact::new(file.clone(), what));
                hop.series_file = file;
            }
            Err(error) => summary.warnings.push(format!(
                "{name}: the radio's samples are not written: {error}"
            )),
        }
        report.hops.push(hop);
    }
    // Those of unknown time come last.
    let key = |event: &RunEvent| event.at_s.unwrap_or(f64::INFINITY);
    summary.events.sort_by(|a, b| key(a).total_cmp(&key(b)));
    add_mark_warnings(summary);
    summary.radio = report;
}

/// Marks that did not survive the way: the access category at the far end is not the one meant.
fn add_mark_warnings(summary: &mut RunSummary) {
    for direction in &summary.directions {
        let changed = direction.count(CounterGroup::Socket, "mark_changed_count");
        if let Some(changed) = changed.filter(|count| *count > 0) {
            summary.warnings.push(format!(
                "{}: {changed} datagrams arrived with another code point than they should: \
                 something on the way changes marks, or the other host sets another dscp",
                direction.label()
            ));
        }
    }
}

fn summarise(samples: &[RadioRecord]) -> RadioHopSummary {
    let mut by_station: BTreeMap<[u8; 6], Vec<&RadioRecord>> = BTreeMap::new();
    for sample in samples.iter().filter(|one| one.event == SAMPLE) {
        by_station.entry(sample.mac).or_default().push(sample);
    }
    let stations = by_station
        .iter()
        .map(|(mac, samples)| station(*mac, samples));
    let is_change = |one: &&RadioRecord| change_of(one).is_some();
    RadioHopSummary {
        process: String::new(),
        host: String::new(),
        interface: String::new(),
        stations: stations.collect(),
        event_count: samples.iter().filter(is_change).count() as u64,
        series_file: String::new(),
    }
}

fn station(mac: [u8; 6], samples: &[&RadioRecord]) -> StationSummary {
    let known = |pick: fn(&RadioRecord) -> i64| {
        let all = samples.iter().map(move |one| pick(one));
        all.filter(|value| *value != UNAVAILABLE)
    };
    // The counters of a station start anew with each association.
    let grown = |pick: fn(&RadioRecord) -> i64| {
        let mut all = known(pick);
        let mut last = all.next()?;
        let mut sum = 0;
        for value in all {
            sum += if value >= last { value - last } else { value };
            last = value;
        }
        u64::try_from(sum).ok()
    };
    let rates = |pick: fn(&RadioRecord) -> RateRecord| {
        let all = samples.iter().map(|one| pick(one).kbps);
        let known = all.filter(|kbps| *kbps != NO_RATE);
        Spread::of(known.map(|kbps| f64::from(kbps) * 1e-3).collect())
    };
    let signals = samples.iter().map(|one| one.signal_dbm);
    let signals = signals.filter(|dbm| *dbm != NO_SIGNAL).map(f64::from);
    let last = samples.last();
    StationSummary {
        mac: mac_text(mac),
        sample_count: samples.len() as u64,
        signal_dbm: Spread::of(signals.collect()),
        transmit_mbps: rates(|one| one.transmit),
        receive_mbps: rates(|one| one.receive),
        transmit_modulation: last.and_then(|one| one.transmit.modulation()),
        receive_modulation: last.and_then(|one| one.receive.modulation()),
        tx_packet_count: grown(|one| one.tx_packets),
        tx_retry_count: grown(|one| one.tx_retries),
        tx_failed_count: grown(|one| one.tx_failed),
        beacon_loss_count: grown(|one| one.beacon_losses),
        inactive_ms_max: known(|one| one.inactive_ms)
            .max()
            .and_then(|ms| u64::try_from(ms).ok()),
        connected_s: known(|one| one.connected_s)
            .next_back()
            .and_then(|s| u64::try_from(s).ok()),
    }
}

/// What an event of the association is called; `None` for samples and what concerns nobody.
fn change_of(record: &RadioRecord) -> Option<RadioChange> {
    Some(match record.event {
        command::CONNECT => RadioChange::Associated,
        command::ROAM => RadioChange::Roamed,
        command::DISCONNECT => RadioChange::Disconnected,
        command::DEL_STATION => RadioChange::StationLeft,
        command::NOTIFY_CQM => RadioChange::QualityChanged,
        _ => return None,
    })
}

/// What to say of events that have no place on the run's axis; nothing when there are none.
fn left_out(hop: &RadioHopSummary) -> Option<String> {
    let (process, interface, host) = (&hop.process, &hop.interface, &hop.host);
    (hop.event_count > 0).then(|| {
        format!(
            "{process}: {} events of the association of {interface} are left out: when the run \
             began on host {host:?} is unavailable",
            hop.event_count
        )
    })
}

fn add_events(
    events: &mut Vec<RunEvent>,
    hop: &RadioHopSummary,
    samples: &[RadioRecord],
    place_s: impl Fn(i64) -> Option<f64>,
) {
    for record in samples {
        let Some(change) = change_of(record) else {
            continue;
        };
        events.push(RunEvent {
            at_s: place_s(record.at_ns),
            process: hop.process.clone(),
            kind: RunEventKind::Radio {
                interface: hop.interface.clone(),
                change,
                station: (record.mac != [0; 6]).then(|| mac_text(record.mac)),
                code: (record.code != NO_CODE).then_some(record.code),
            },
            absence: None,
        });
    }
}

/// Writes the samples as a table; gives its name below the run's folder.
fn write_series(
    folder: &Path,
    hop: &RadioHopSummary,
    samples: &[RadioRecord],
    place_s: impl Fn(i64) -> Option<f64>,
) -> std::io::Result<String> {
    let mut text = String::from(
        "at_s,mac,signal_dbm,signal_average_dbm,tx_mbps,tx_modulation,rx_mbps,rx_modulation,\
         tx_packets,tx_retries,tx_failed,rx_packets,beacon_losses,inactive_ms,connected_s\n",
    );
    let number = |value: i64| {
        let known = (value != UNAVAILABLE).then(|| value.to_string());
        known.unwrap_or_default()
    };
    let signal = |dbm: i32| {
        let known = (dbm != NO_SIGNAL).then(|| dbm.to_string());
        known.unwrap_or_default()
    };
    let rate = |rate: &RateRecord| {
        let mbps = (rate.kbps != NO_RATE).then(|| f64::from(rate.kbps) * 1e-3);
        let mbps = mbps.map_or_else(String::new, |mbps| format!("{mbps:.1}"));
        let modulation = rate.modulation().unwrap_or_default().replace(',', "");
        format!("{mbps},{modulation}")
    };
    for one in samples.iter().filter(|one| one.event == SAMPLE) {
        let at_s = place_s(one.at_ns).map(|at_s| format!("{at_s:.6}"));
        let at_s = at_s.unwrap_or_default();
        writeln!(
            text,
            "{at_s},{},{},{},{},{},{},{},{},{},{},{},{}",
            mac_text(one.mac),
            signal(one.signal_dbm),
            signal(one.signal_average_dbm),
            rate(&one.transmit),
            rate(&one.receive),
            number(one.tx_packets),
            number(one.tx_retries),
            number(one.tx_failed),
            number(one.rx_packets),
            number(one.beacon_losses),
            number(one.inactive_ms),
            number(one.connected_s),
        )
        .map_err(std::io::Error::other)?;
    }
    fs::create_dir_all(folder)?;
    let name = format!("radio-{}-{}.csv", hop.process, hop.interface);
    fs::write(folder.join(&name), text)?;
    Ok(format!("series/{name}"))
}

fn mac_text(mac: [u8; 6]) -> String {
    mac.map(|byte| format!("{byte:02x}")).join(":")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(at_ns: i64, signal_dbm: i8, tx_retries: u32) -> RadioRecord {
        RadioRecord {
            mac: [2, 0, 0, 0, 0, 1],
            signal_dbm: signal_dbm.into(),
            tx_retries: tx_retries.into(),
            ..RadioRecord::nothing(at_ns)
        }
    }

    #[test]
    fn counters_that_start_anew_are_added_up() {
        let samples = [sample(0, -40, 7), sample(1, -60, 10), sample(2, -50, 4)];
        let hop = summarise(&samples);
        let station = &hop.stations[0];
        assert_eq!(station.mac, "02:00:00:00:00:01");
        assert_eq!(station.tx_retry_count, Some(7));
        assert_eq!(station.tx_failed_count, None, "the driver does not say");
        let signal = station.signal_dbm.unwrap();
        let spread = [signal.min, signal.median, signal.max].map(|dbm| dbm.to_string());
        assert_eq!(spread, ["-60", "-50", "-40"]);
        assert_eq!(station.transmit_modulation, None);
    }

    #[test]
    fn a_disconnection_becomes_an_event_with_its_reason() {
        let samples = [RadioRecord {
            event: command::DISCONNECT,
            code: 3,
            ..RadioRecord::nothing(1_500_000_000)
        }];
        let mut hop = summarise(&samples);
        assert_eq!((hop.event_count, hop.stations.len()), (1, 0));
        (hop.process, hop.interface) = ("gateway".to_owned(), "wlan0".to_owned());
        let mut events = Vec::new();
        add_events(&mut events, &hop, &samples, |ns| Some(ns as f64 * 1e-9));
        assert_eq!(events[0].what(), "gateway: wlan0 disconnected");
        assert_eq!(events[0].cause().as_deref(), Some("802.11 code 3"));
        assert!((events[0].at_s.unwrap() - 1.5).abs() < 1e-9);
    }

    #[test]
    fn events_without_a_start_are_left_out_and_said_to_be() {
        let mut hop = summarise(&[RadioRecord {
            event: command::ROAM,
            ..RadioRecord::nothing(5)
        }]);
        (hop.process, hop.interface) = ("gateway".to_owned(), "wlan0".to_owned());
        let warning = left_out(&hop).unwrap();
        assert!(warning.contains("1 events of the association of wlan0 are left out"));
        assert!(warning.contains("unavailable"), "{warning}");
        assert_eq!(left_out(&summarise(&[sample(0, -40, 7)])), None);
    }
}
