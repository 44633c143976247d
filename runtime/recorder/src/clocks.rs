//! From the monotonic clock on which a host stamped to the times of a recording. It aligns no two
//! hosts: each goes by its own real-time clock, or by its monotonic one where no relation is known.

use std::collections::{BTreeMap, BTreeSet};

use hil_core::record::UNAVAILABLE;
use hil_rundir::manifest::Manifest;
use hil_watch::Record;

use crate::facts::Words;
use crate::net;
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
    pub(crate) const fn words(self) -> &'static str {
        match self {
            Self::Gateways => "real time, by what the gateways noted beside the messages",
            Self::Manifest => "real time, by a read of both clocks before the run",
            Self::OtherHost => "real time, by another host that reads the same clock",
            Self::Arrival => "real time of arrival on the recording host: its own clock is another",
            Self::None => "monotonic clock, not real time: no relation was noted",
        }
    }
}

/// One host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct HostClock {
    /// Real-time minus monotonic clock, nanoseconds; one value for the whole run, so that the
    /// differences of times stay those of the monotonic clock.
    pub(crate) offset_ns: i64,
    /// Where it comes from.
    pub(crate) basis: Basis,
    /// Lowest and highest that was noted.
    pub(crate) noted_ns: Option<(i64, i64)>,
}

/// The clocks of a run.
#[derive(Debug, Default)]
pub(crate) struct Clocks {
    hosts: BTreeMap<String, HostClock>,
    channel_hosts: BTreeMap<String, String>,
    /// True when every host reads one clock; `None` when nobody said.
    pub(crate) has_one_clock: Option<bool>,
}

/// Stands for the host of a channel that no manifest tells of.
pub(crate) const UNKNOWN_HOST: &str = "(unknown host)";

/// The recording's time of an instant on a clock with this offset; `None` before that clock's origin.
pub(crate) fn at(offset_ns: i64, monotonic_ns: i64) -> Option<u64> {
    if monotonic_ns == UNAVAILABLE {
        return None;
    }
    u64::try_from(monotonic_ns.checked_add(offset_ns)?).ok()
}

/// What a recording says of all clocks.
pub(crate) fn words(has_one_clock: Option<bool>) -> Words {
    let log_time = "instant of publication on the clock of the producer's host, plus offset_ns of \
                    that host; hosts are not aligned with each other";
    let one_clock = has_one_clock.map_or("unknown".to_owned(), |is_one| is_one.to_string());
    Words::from([
        ("log_time".to_owned(), log_time.to_owned()),
        ("has_one_clock".to_owned(), one_clock),
    ])
}

/// What a recording says of the clock of `host`.
pub(crate) fn host_words(host: &str, basis: Basis, offset_ns: Option<i64>, words: &mut Words) {
    words.insert(format!("{host}/basis"), basis.words().to_owned());
    if let Some(offset_ns) = offset_ns {
        words.insert(format!("{host}/offset_ns"), offset_ns.to_string());
    }
}

impl Clocks {
    /// What the run noted of them.
    pub(crate) fn of(run: &Run) -> Self {
        let mut clocks = Self::default();
        let manifest = run.manifest.as_ref();
        let described = manifest.map_or(&[][..], |manifest| &manifest.channels);
        for channel in described {
            if let Some(host) = &channel.from_host {
                let (name, host) = (channel.name.clone(), host.clone());
                clocks.channel_hosts.insert(name, host);
            }
        }
        let noted = noted_offsets(run);
        let mut names: Vec<String> = clocks.channel_hosts.values().cloned().collect();
        names.extend(noted.keys().cloned());
        names.push(UNKNOWN_HOST.to_owned());
        names.sort();
        names.dedup();
        let section = run.summary.as_ref().and_then(|one| one.clocks.as_ref());
        clocks.has_one_clock = section
            .map(|section| section.has_one_clock)
            .or(is_one_machine(manifest).then_some(true));
        for name in names {
            let clock = clocks.host_clock(run, &name, &noted);
            clocks.hosts.insert(name, clock);
        }
        clocks
    }

    fn host_clock(&self, run: &Run, host: &str, noted: &BTreeMap<String, Noted>) -> HostClock {
        let manifest = run.manifest.as_ref();
        let from_manifest = manifest.and_then(|one| one.realtime_minus_monotonic_ns);
        let hosts_here = manifest.map_or(&[][..], |one| &one.hosts_here);
        let is_here = hosts_here.iter().any(|here| here == host);
        let known = |offset_ns, basis, noted_ns| HostClock {
            offset_ns,
            basis,
            noted_ns,
        };
        // Hosts that read one clock share one offset, or their times would differ by how well each
        // of them read it.
        let first = noted.values().next().map(|one| one.first_ns);
        let shared = first.or(from_manifest);
        let shared = shared.filter(|_| self.has_one_clock == Some(true));
        if let Some(own) = noted.get(host) {
            let offset_ns = shared.unwrap_or(own.first_ns);
            return known(offset_ns, Basis::Gateways, Some(own.ends_ns));
        }
        if let Some(offset_ns) = from_manifest.filter(|_| is_here) {
            return known(shared.unwrap_or(offset_ns), Basis::Manifest, None);
        }
        if let Some(offset_ns) = shared {
            return known(offset_ns, Basis::OtherHost, None);
        }
        known(0, Basis::None, None)
    }

    /// The host whose producer publishes on `channel`.
    pub(crate) fn host_of(&self, channel: &str) -> &str {
        let host = self.channel_hosts.get(channel);
        host.map_or(UNKNOWN_HOST, String::as_str)
    }

    /// The recording's time of an instant on the clock of the producer of `channel`; `None` before
    /// that clock's origin.
    pub(crate) fn time_ns(&self, channel: &str, monotonic_ns: i64) -> Option<u64> {
        let offset_ns = self.hosts.get(self.host_of(channel))?.offset_ns;
        at(offset_ns, monotonic_ns)
    }

    /// The same of an instant on the clock of `host`.
    pub(crate) fn host_time_ns(&self, host: &str, monotonic_ns: i64) -> Option<u64> {
        at(self.hosts.get(host)?.offset_ns, monotonic_ns)
    }

    /// From the monotonic clock of `host` to the recording's times, nanoseconds; 0 where no relation
    /// is known.
    pub(crate) fn offset_ns(&self, host: Option<&str>) -> i64 {
        let clock = self.hosts.get(host.unwrap_or(UNKNOWN_HOST));
        clock.map_or(0, |clock| clock.offset_ns)
    }

    /// Every host with its clock, those that stamped nothing left out.
    pub(crate) fn hosts(&self) -> impl Iterator<Item = (&str, &HostClock)> {
        let is_used = |name: &str| name != UNKNOWN_HOST || self.channel_hosts.is_empty();
        let hosts = self
            .hosts
            .iter()
            .map(|(name, clock)| (name.as_str(), clock));
        hosts.filter(move |(name, _)| is_used(name))
    }
}

/// True when every host with a channel ran on the machine that wrote the manifest, or there is only
/// one: what a killed run still tells.
fn is_one_machine(manifest: Option<&Manifest>) -> bool {
    let Some(manifest) = manifest else {
        return false;
    };
    let channels = manifest.channels.iter();
    let hosts: BTreeSet<&String> = channels
        .flat_map(|one| one.from_host.iter().chain(&one.to_host))
        .collect();
    let is_here = |host: &&String| manifest.hosts_here.contains(*host);
    hosts.len() == 1 || (!hosts.is_empty() && hosts.iter().all(is_here))
}

/// The offsets that the gateways of one host noted.
#[derive(Debug, Clone, Copy)]
struct Noted {
    first_ns: i64,
    ends_ns: (i64, i64),
}

/// By host; a host that no manifest names is left out.
fn noted_offsets(run: &Run) -> BTreeMap<String, Noted> {
    let mut noted: BTreeMap<String, Noted> = BTreeMap::new();
    for file in &run.files {
        let described = run.described(&file.header.channel);
        for record in net::records(file) {
            let (host, offset_ns) = match record {
                Record::Egress(one) => {
                    let host = described.and_then(|one| one.from_host.as_ref());
                    (host, one.realtime_offset_ns)
                }
                Record::Ingress(one) => {
                    let host = described.and_then(|one| one.to_host.as_ref());
                    (host, one.realtime_offset_ns)
                }
                _ => break,
            };
            let Some(host) = host.filter(|_| offset_ns != UNAVAILABLE) else {
                continue;
            };
            let one = noted.entry(host.clone()).or_insert(Noted {
                first_ns: offset_ns,
                ends_ns: (offset_ns, offset_ns),
            });
            one.ends_ns.0 = one.ends_ns.0.min(offset_ns);
            one.ends_ns.1 = one.ends_ns.1.max(offset_ns);
        }
    }
    noted
}
