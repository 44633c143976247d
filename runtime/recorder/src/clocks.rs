//! From the monotonic clock on which a host stamped to the times of a recording: of a run's folder, which
//! tells how each clock stood, and of a run that still goes. It aligns no two hosts: each goes by its own
//! real-time clock, or by its monotonic one where no relation is known.

use std::collections::{BTreeMap, BTreeSet};

use hil_core::message::Envelope;
use hil_core::record::UNAVAILABLE;
use hil_rundir::manifest::Manifest;
use hil_watch::{Feed, Record};

use crate::facts::Words;
use crate::net::{self, MessageLatency};
use crate::run::Run;

/// Where a host's relation to real time comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Basis {
    /// Its gateways noted it beside the messages.
    Gateways,
    /// Its supervisor read both clocks before the run.
    Manifest,
    /// That of another host, which reads the same clock.
    OtherHost,
    /// Its clock is another one: its messages have the times at which they arrived here.
    Arrival,
    /// Nothing is known: times are those of its monotonic clock.
    None,
}

impl Basis {
    /// What a recording says of it.
    const fn words(self) -> &'static str {
        match self {
            Self::Gateways => "real time, by what the gateways noted beside the messages",
            Self::Manifest => "real time, by a read of both clocks before the run",
            Self::OtherHost => "real time, by another host that reads the same clock",
            Self::Arrival => "real time of arrival on the recording host: its own clock is another",
            Self::None => "monotonic clock, not real time: no relation was noted",
        }
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

/// What a recording says of all clocks.
fn words(has_one_clock: Option<bool>) -> Words {
    let log_time = "instant of publication on the clock of the producer's host, plus offset_ns of \
                    that host; hosts are not aligned with each other";
    let one_clock = has_one_clock.map_or("unknown".to_owned(), |is_one| is_one.to_string());
    Words::from([
        ("log_time".to_owned(), log_time.to_owned()),
        ("has_one_clock".to_owned(), one_clock),
    ])
}

/// What a recording says of the clock of `host`.
fn host_words(host: &str, basis: Basis, offset_ns: Option<i64>, words: &mut Words) {
    let host = if host.is_empty() { UNKNOWN_HOST } else { host };
    words.insert(format!("{host}/basis"), basis.words().to_owned());
    if let Some(offset_ns) = offset_ns {
        words.insert(format!("{host}/offset_ns"), offset_ns.to_string());
    }
}

/// True when every host of `run` reads one clock; `None` when its folder does not tell.
pub(crate) fn has_one_clock(run: &Run) -> Option<bool> {
    let section = run.summary.as_ref().and_then(|one| one.clocks.as_ref());
    let is_one_machine = run.manifest.as_ref().is_some_and(is_one_machine);
    section
        .map(|section| section.has_one_clock)
        .or(is_one_machine.then_some(true))
}

/// One host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct HostClock {
    /// Real-time minus monotonic clock, nanoseconds; one value for the whole run, so that the
    /// differences of times stay those of the monotonic clock.
    offset_ns: i64,
    basis: Basis,
    /// What its gateways noted.
    noted: Option<Noted>,
}

/// The offsets that the gateways of one host noted, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(clippy::struct_field_names, reason = "each in its unit")]
struct Noted {
    first_ns: i64,
    lowest_ns: i64,
    highest_ns: i64,
}

/// The clocks of a run's folder.
#[derive(Debug, Default)]
pub(crate) struct Clocks {
    hosts: BTreeMap<String, HostClock>,
    /// True when every host reads one clock; `None` when unknown.
    pub(crate) has_one_clock: Option<bool>,
}

impl Clocks {
    /// What the run noted of them.
    pub(crate) fn of(run: &Run) -> Self {
        let manifest = run.manifest.as_ref();
        let from_manifest = manifest.and_then(|one| one.realtime_minus_monotonic_ns);
        let hosts_here = manifest.map_or(&[][..], |one| &one.hosts_here);
        let described = manifest.map_or(&[][..], |manifest| &manifest.channels);
        let noted = noted_offsets(run);
        let has_one_clock = has_one_clock(run);
        // Hosts that read one clock share one offset, or their times would differ by how well each
        // of them read it.
        let first = noted.values().next().map(|one| one.first_ns);
        let shared = first.or(from_manifest);
        let shared = shared.filter(|_| has_one_clock == Some(true));
        let producers = described.iter().filter_map(|one| one.from_host.as_ref());
        let unknown = String::new();
        let names = producers.chain(noted.keys()).chain([&unknown]);
        let clock = |name: &String| {
            let noted = noted.get(name).copied();
            let from_manifest = from_manifest.filter(|_| hosts_here.contains(name));
            let (own, basis) = match (noted, from_manifest, shared) {
                (Some(noted), ..) => (noted.first_ns, Basis::Gateways),
                (None, Some(offset_ns), _) => (offset_ns, Basis::Manifest),
                (None, None, Some(shared)) => (shared, Basis::OtherHost),
                (None, None, None) => (0, Basis::None),
            };
            HostClock {
                offset_ns: shared.unwrap_or(own),
                basis,
                noted,
            }
        };
        Self {
            hosts: names.map(|name| (name.clone(), clock(name))).collect(),
            has_one_clock,
        }
    }

    /// The recording's time of an instant on the clock of `host`; `None` before that clock's origin.
    pub(crate) fn time_ns(&self, host: &str, monotonic_ns: i64) -> Option<u64> {
        at(self.hosts.get(host)?.offset_ns, monotonic_ns)
    }

    /// From the monotonic clock of `host` to the recording's times, nanoseconds; 0 where no relation
    /// is known.
    pub(crate) fn offset_ns(&self, host: Option<&str>) -> i64 {
        let clock = self.hosts.get(host.unwrap_or_default());
        clock.map_or(0, |clock| clock.offset_ns)
    }

    /// What a recording says of them; of the unknown host only where there is no other.
    pub(crate) fn words(&self) -> Words {
        let mut words = words(self.has_one_clock);
        let hosts = self.hosts.iter();
        for (host, clock) in hosts.filter(|(name, _)| !name.is_empty() || self.hosts.len() == 1) {
            host_words(host, clock.basis, Some(clock.offset_ns), &mut words);
            if let Some(noted) = clock.noted {
                let (lowest, highest) = (noted.lowest_ns, noted.highest_ns);
                words.insert(format!("{host}/offset_lowest_ns"), lowest.to_string());
                words.insert(format!("{host}/offset_highest_ns"), highest.to_string());
            }
        }
        words
    }
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

/// By host; a host that no manifest names is left out.
fn noted_offsets(run: &Run) -> BTreeMap<String, Noted> {
    let mut noted: BTreeMap<String, Noted> = BTreeMap::new();
    for file in &run.files {
        let Some(described) = run.described(&file.header.channel) else {
            continue;
        };
        for record in net::records(file) {
            let (host, offset_ns) = match record {
                Record::Egress(one) => (&described.from_host, one.realtime_offset_ns),
                Record::Ingress(one) => (&described.to_host, one.realtime_offset_ns),
                _ => break,
            };
            let Some(host) = host.as_ref().filter(|_| offset_ns != UNAVAILABLE) else {
                continue;
            };
            let one = noted.entry(host.clone()).or_insert(Noted {
                first_ns: offset_ns,
                lowest_ns: offset_ns,
                highest_ns: offset_ns,
            });
            one.lowest_ns = one.lowest_ns.min(offset_ns);
            one.highest_ns = one.highest_ns.max(offset_ns);
        }
    }
    noted
}

/// The clocks of a run that goes. Once chosen, a host's offset stays, so that the differences of its times
/// are those of its clock.
#[derive(Debug, Default)]
pub(crate) struct LiveClocks {
    /// Real-time minus monotonic clock of this machine.
    own_offset_ns: Option<i64>,
    hosts_here: Vec<String>,
    chosen: BTreeMap<String, Basis>,
    /// Of hosts whose clock is another one, by what their gateways noted; known at the end.
    noted_ns: BTreeMap<String, i64>,
    /// How the clocks stand, as far as it is known by now.
    pub(crate) has_one_clock: Option<bool>,
}

impl LiveClocks {
    /// What the run's announcement and manifest say.
    pub(crate) fn of(feed: &Feed) -> Self {
        let mut clocks = Self {
            own_offset_ns: feed.manifest().realtime_minus_monotonic_ns,
            hosts_here: feed.manifest().hosts_here.clone(),
            has_one_clock: feed.has_one_clock(),
            ..Self::default()
        };
        for channel in feed.channels() {
            let host = channel.description.from_host.as_deref().unwrap_or_default();
            // Where the offset of a clock is not known yet, the first message decides.
            if clocks.has_one_clock.is_some() || clocks.is_here(host) {
                clocks.basis(host);
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

    /// What a gateway of `host` read.
    pub(crate) fn note(&mut self, host: &str, offset_ns: i64) {
        if offset_ns != UNAVAILABLE && !self.noted_ns.contains_key(host) {
            self.noted_ns.insert(host.to_owned(), offset_ns);
        }
    }

    fn basis(&mut self, host: &str) -> Basis {
        if let Some(basis) = self.chosen.get(host) {
            return *basis;
        }
        let is_here = self.is_here(host);
        let basis = match (self.own_offset_ns, is_here) {
            (None, _) if is_here || self.compares() => Basis::None,
            (Some(_), true) => Basis::Manifest,
            (Some(_), false) if self.compares() => Basis::OtherHost,
            _ => Basis::Arrival,
        };
        self.chosen.insert(host.to_owned(), basis);
        basis
    }

    fn own(&self, monotonic_ns: i64) -> Option<u64> {
        at(self.own_offset_ns.unwrap_or(0), monotonic_ns)
    }

    /// The time of an instant on the clock of `host`; `None` when that clock is another one and
    /// its offset was not recorded.
    pub(crate) fn time_ns(&mut self, host: &str, monotonic_ns: i64) -> Option<u64> {
        match self.basis(host) {
            Basis::Arrival => at(*self.noted_ns.get(host)?, monotonic_ns),
            _ => self.own(monotonic_ns),
        }
    }

    /// The time of a message whose producer runs on `host`.
    pub(crate) fn message_ns(&mut self, host: &str, envelope: &Envelope) -> Option<u64> {
        if self.basis(host) == Basis::Arrival && envelope.is_forwarded() {
            return self.own(envelope.forwarded_ns);
        }
        self.time_ns(host, envelope.published_ns)
    }

    /// The time of the stamps of a message whose producer runs on `host`.
    pub(crate) fn latency_ns(&mut self, host: &str, one: &MessageLatency) -> Option<u64> {
        if self.basis(host) == Basis::Arrival
            && let Some(arrived_ns) = one.forwarded_ns.or(one.received_ns)
        {
            return self.own(arrived_ns);
        }
        self.time_ns(host, one.published_ns?)
    }

    /// What a recording says of them.
    pub(crate) fn words(&self) -> Words {
        let mut words = words(self.has_one_clock);
        for (host, basis) in &self.chosen {
            let offset_ns = match basis {
                Basis::Arrival => self.noted_ns.get(host).copied(),
                _ => Some(self.own_offset_ns.unwrap_or(0)),
            };
            host_words(host, *basis, offset_ns, &mut words);
        }
        words
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clocks(has_one_clock: Option<bool>) -> LiveClocks {
        LiveClocks {
            own_offset_ns: Some(1000),
            hosts_here: vec!["here".to_owned()],
            has_one_clock,
            ..LiveClocks::default()
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

    #[test]
    fn another_clock_is_not_read_as_ones_own() {
        let mut one = clocks(Some(true));
        assert_eq!(one.message_ns("here", &envelope(false)), Some(1005));
        assert_eq!(one.message_ns("there", &envelope(true)), Some(1005));
        let mut two = clocks(Some(false));
        assert_eq!(two.message_ns("there", &envelope(true)), Some(1070));
        assert_eq!(two.message_ns("there", &envelope(false)), None);
        two.note("there", 9);
        two.note("there", 99);
        assert_eq!(two.message_ns("there", &envelope(false)), Some(14));
        // What comes to be known later moves no time that was chosen.
        two.has_one_clock = Some(true);
        assert_eq!(two.message_ns("there", &envelope(true)), Some(1070));
        assert_eq!(two.words()["there/offset_ns"], "9");
    }
}
