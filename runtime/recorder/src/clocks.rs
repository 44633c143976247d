//! From the monotonic clock on which a host stamped to the times of a recording: of a run's folder, which
//! tells how each clock stood, and of a run that still goes. It aligns no two hosts: each goes by its own
//! real-time clock, or by its monotonic one where no relation is known.

use std::collections::{BTreeMap, BTreeSet};

use hil_core::message::Envelope;
use hil_core::record::UNAVAILABLE;
use hil_rundir::manifest::Manifest;
use hil_watch::{Feed, Record};

use crate::facts::{Words, table};
use crate::net::{self, MessageLatency};
use crate::run::Run;

hil_core::labelled! {
    /// Where a host's relation to real time comes from.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub(crate) enum Basis, words {
        /// Its gateways noted it beside the messages.
        Gateways = "real time, by what the gateways noted beside the messages",
        /// Its supervisor read both clocks before the run.
        Manifest = "real time, by a read of both clocks before the run",
        /// That of another host, which reads the same clock.
        OtherHost = "real time, by another host that reads the same clock",
        /// Its clock is another one: its messages have the times at which they arrived here.
        Arrival = "real time of arrival on the recording host: its own clock is another",
        /// Nothing is known: times are those of its monotonic clock.
        None = "monotonic clock, not real time: no relation was noted",
    }
}

/// Stands for the host of a channel that no manifest tells of; elsewhere its name is empty.
const UNKNOWN_HOST: &str = "(unknown host)";

/// The recording's time of an instant on a clock with this offset; `None` before that clock's origin.
fn at(offset_ns: i64, monotonic_ns: i64) -> Option<u64> {
    if monotonic_ns == UNAVAILABLE {
        return None;
    }
    u64::try_from(monotonic_ns.checked_add(offset_ns)?).ok()
}

/// True when every host of `run` reads one clock; `None` when its folder does not tell.
pub(crate) fn has_one_clock(run: &Run) -> Option<bool> {
    let section = run.summary.as_ref().and_then(|one| one.clocks.as_ref());
    let is_one_machine = run.manifest.as_ref().is_some_and(is_one_machine);
    section
        .map(|section| section.has_one_clock)
        .or(is_one_machine.then_some(true))
}

/// True when every host with a channel ran on the machine that wrote the manifest, or there is only
/// one: what a killed run still tells.
fn is_one_machine(manifest: &Manifest) -> bool {
    let channels = manifest.channels.iter();
    let hosts: BTreeSet<&String> = channels
        .flat_map(|one| one.from_host.iter().chain(&one.to_host))
        .collect();
    let is_here = |host: &&String| manifest.hosts_here.contains(*host);
    hosts.len() == 1 || (!hosts.is_empty() && hosts.iter().all(is_here))
}

/// How the times of a host become those of the recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct HostClock {
    basis: Basis,
    /// Real-time minus monotonic clock, nanoseconds; one value for the whole run, so that the
    /// differences of times stay those of the monotonic clock. Of [`Basis::Arrival`] that of the
    /// recording's machine.
    offset_ns: i64,
}

/// The offsets that the gateways of one host noted, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(clippy::struct_field_names, reason = "each in its unit")]
struct Noted {
    first_ns: i64,
    lowest_ns: i64,
    highest_ns: i64,
}

/// The clocks of a run's hosts.
#[derive(Debug, Default)]
pub(crate) struct Clocks {
    /// Real-time minus monotonic clock of the machine that wrote the manifest.
    own_offset_ns: Option<i64>,
    hosts_here: Vec<String>,
    /// Once chosen, a host's offset stays.
    hosts: BTreeMap<String, HostClock>,
    noted: BTreeMap<String, Noted>,
    /// The run still goes: what is not known yet is decided when it is first asked for.
    is_live: bool,
    /// True when every host reads one clock; `None` when unknown.
    pub(crate) has_one_clock: Option<bool>,
}

impl Clocks {
    /// What a run's folder tells of them.
    pub(crate) fn of_run(run: &Run) -> Self {
        let manifest = run.manifest.as_ref();
        let mut clocks = Self {
            own_offset_ns: manifest.and_then(|one| one.realtime_minus_monotonic_ns),
            hosts_here: manifest.map_or_else(Vec::new, |one| one.hosts_here.clone()),
            has_one_clock: has_one_clock(run),
            ..Self::default()
        };
        for file in &run.files {
            if let Some(described) = run.described(&file.header.channel) {
                let hosts = [&described.from_host, &described.to_host];
                for record in net::records(file) {
                    clocks.note(hosts.map(|host| host.as_deref()), &record);
                }
            }
        }
        // Hosts that read one clock share one offset, or their times would differ by how well each
        // of them read it.
        let first = clocks.noted.values().next().map(|one| one.first_ns);
        let shared = first.or(clocks.own_offset_ns).filter(|_| clocks.compares());
        let described = manifest.map_or(&[][..], |manifest| &manifest.channels);
        let producers = described.iter().filter_map(|one| one.from_host.clone());
        let names: BTreeSet<String> = producers.chain(clocks.noted.keys().cloned()).collect();
        for name in names.into_iter().chain([String::new()]) {
            let from_manifest = clocks.own_offset_ns;
            let from_manifest = from_manifest.filter(|_| clocks.hosts_here.contains(&name));
            let (own_ns, basis) = match (clocks.noted.get(&name), from_manifest, shared) {
                (Some(noted), ..) => (noted.first_ns, Basis::Gateways),
                (None, Some(offset_ns), _) => (offset_ns, Basis::Manifest),
                (None, None, Some(shared)) => (shared, Basis::OtherHost),
                (None, None, None) => (0, Basis::None),
            };
            let offset_ns = shared.unwrap_or(own_ns);
            clocks.hosts.insert(name, HostClock { basis, offset_ns });
        }
        clocks
    }

    /// What the announcement and the manifest of a run that goes say.
    pub(crate) fn of_feed(feed: &Feed) -> Self {
        let mut clocks = Self {
            own_offset_ns: feed.manifest().realtime_minus_monotonic_ns,
            hosts_here: feed.manifest().hosts_here.clone(),
            has_one_clock: feed.has_one_clock(),
            is_live: true,
            ..Self::default()
        };
        for channel in feed.channels() {
            let host = channel.description.from_host.as_deref().unwrap_or_default();
            // Where the offset of a clock is not known yet, the first message decides.
            if clocks.has_one_clock.is_some() || clocks.is_here(host) {
                clocks.clock(host);
            }
        }
        clocks
    }

    fn is_here(&self, host: &str) -> bool {
        host.is_empty() || self.hosts_here.iter().any(|here| here == host)
    }

    /// True when stamps of both ends of a link compare.
    pub(crate) fn compares(&self) -> bool {
        self.has_one_clock == Some(true)
    }

    /// What a gateway read beside a message of a channel between `hosts`.
    pub(crate) fn note(&mut self, [from, to]: [Option<&str>; 2], record: &Record) {
        let (host, offset_ns) = match record {
            Record::Egress(one) => (from, one.realtime_offset_ns),
            Record::Ingress(one) => (to, one.realtime_offset_ns),
            _ => return,
        };
        let Some(host) = host.filter(|_| offset_ns != UNAVAILABLE) else {
            return;
        };
        if let Some(one) = self.noted.get_mut(host) {
            one.lowest_ns = one.lowest_ns.min(offset_ns);
            one.highest_ns = one.highest_ns.max(offset_ns);
            return;
        }
        let first = Noted {
            first_ns: offset_ns,
            lowest_ns: offset_ns,
            highest_ns: offset_ns,
        };
        self.noted.insert(host.to_owned(), first);
    }

    /// `None` of a host that a folder does not name.
    fn clock(&mut self, host: &str) -> Option<HostClock> {
        if let Some(clock) = self.hosts.get(host) {
            return Some(*clock);
        }
        let basis = match (self.own_offset_ns, self.is_here(host)) {
            _ if !self.is_live => return None,
            (None, is_here) if is_here || self.compares() => Basis::None,
            (Some(_), true) => Basis::Manifest,
            (Some(_), false) if self.compares() => Basis::OtherHost,
            _ => Basis::Arrival,
        };
        let offset_ns = self.own_offset_ns.unwrap_or(0);
        let clock = HostClock { basis, offset_ns };
        self.hosts.insert(host.to_owned(), clock);
        Some(clock)
    }

    /// The recording's time of an instant on the clock of `host`; `None` before that clock's origin, and
    /// when nothing is known of the clock.
    pub(crate) fn time_ns(&mut self, host: &str, monotonic_ns: i64) -> Option<u64> {
        let clock = self.clock(host)?;
        match clock.basis {
            Basis::Arrival => at(self.noted.get(host)?.first_ns, monotonic_ns),
            _ => at(clock.offset_ns, monotonic_ns),
        }
    }

    /// The time of something published on `host` that arrived here at `arrived_ns`, where that is known.
    fn arrival_ns(
        &mut self,
        host: &str,
        published_ns: i64,
        arrived_ns: Option<i64>,
    ) -> Option<u64> {
        let clock = self.clock(host)?;
        match arrived_ns.filter(|_| clock.basis == Basis::Arrival) {
            Some(arrived_ns) => at(clock.offset_ns, arrived_ns),
            None => self.time_ns(host, published_ns),
        }
    }

    /// The time of a message whose producer runs on `host`.
    pub(crate) fn message_ns(&mut self, host: &str, envelope: &Envelope) -> Option<u64> {
        let arrived_ns = envelope.is_forwarded().then_some(envelope.forwarded_ns);
        self.arrival_ns(host, envelope.published_ns, arrived_ns)
    }

    /// The time of the stamps of a message whose producer runs on `host`.
    pub(crate) fn latency_ns(&mut self, host: &str, one: &MessageLatency) -> Option<u64> {
        let published_ns = one.published_ns.unwrap_or(UNAVAILABLE);
        self.arrival_ns(host, published_ns, one.forwarded_ns.or(one.received_ns))
    }

    /// From the monotonic clock of `host` to the recording's times, nanoseconds; 0 where no relation
    /// is known.
    pub(crate) fn offset_ns(&self, host: Option<&str>) -> i64 {
        let clock = self.hosts.get(host.unwrap_or_default());
        clock.map_or(0, |clock| clock.offset_ns)
    }

    /// What a recording says of them; of the unknown host only where there is no other.
    pub(crate) fn words(&self) -> Words {
        let log_time = "instant of publication on the clock of the producer's host, plus \
                        offset_ns of that host; hosts are not aligned with each other";
        let one_clock = match self.has_one_clock {
            None => "unknown",
            Some(true) => "true",
            Some(false) => "false",
        };
        let mut words = table(&[("log_time", &log_time), ("has_one_clock", &one_clock)]);
        let hosts = self.hosts.iter();
        for (name, clock) in hosts.filter(|(name, _)| !name.is_empty() || self.hosts.len() == 1) {
            let host = if name.is_empty() { UNKNOWN_HOST } else { name };
            words.insert(format!("{host}/basis"), clock.basis.words().to_owned());
            let noted = self.noted.get(name);
            let offset_ns = match clock.basis {
                Basis::Arrival => noted.map(|noted| noted.first_ns),
                _ => Some(clock.offset_ns),
            };
            let figures = [
                ("offset_ns", offset_ns),
                ("offset_lowest_ns", noted.map(|noted| noted.lowest_ns)),
                ("offset_highest_ns", noted.map(|noted| noted.highest_ns)),
            ];
            for (key, ns) in figures {
                words.extend(ns.map(|ns| (format!("{host}/{key}"), ns.to_string())));
            }
        }
        words
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use hil_core::record::IngressRecord;

    fn clocks(has_one_clock: Option<bool>) -> Clocks {
        Clocks {
            own_offset_ns: Some(1000),
            hosts_here: vec!["here".to_owned()],
            is_live: true,
            has_one_clock,
            ..Clocks::default()
        }
    }

    fn envelope(is_forwarded: bool) -> Envelope {
        Envelope {
            published_ns: 5,
            forwarded_ns: 70,
            flags: if is_forwarded { Envelope::FORWARDED } else { 0 },
            ..Envelope::default()
        }
    }

    fn note(clocks: &mut Clocks, offset_ns: i64) {
        let record = Record::Ingress(IngressRecord {
            realtime_offset_ns: offset_ns,
            ..IngressRecord::zeroed()
        });
        clocks.note([None, Some("there")], &record);
    }

    #[test]
    fn another_clock_is_not_read_as_ones_own() {
        let mut one = clocks(Some(true));
        assert_eq!(one.message_ns("here", &envelope(false)), Some(1005));
        assert_eq!(one.message_ns("there", &envelope(true)), Some(1005));
        let mut two = clocks(Some(false));
        assert_eq!(two.message_ns("there", &envelope(true)), Some(1070));
        assert_eq!(two.message_ns("there", &envelope(false)), None);
        note(&mut two, 9);
        note(&mut two, 99);
        assert_eq!(two.message_ns("there", &envelope(false)), Some(14));
        // What comes to be known later moves no time that was chosen.
        two.has_one_clock = Some(true);
        assert_eq!(two.message_ns("there", &envelope(true)), Some(1070));
        assert_eq!(two.words()["there/offset_ns"], "9");
    }
}
