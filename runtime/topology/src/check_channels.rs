//! What channels and links say about processes and hosts: which process ends a channel, which
//! link carries it, and which ports links take. See `check`.

use hil_core::case_study::ChannelSpec;

use super::check_adapter::is_played_by_adapter;
use super::errors::{Fault, Faults, Place};
use super::file::{ChannelEntry, ProcessEntry};
use super::file_links::{LinkEntry, crossing_words};
use super::known::KnownCase;
use super::model::{Channel, Host, LinkPorts, MessageLayout, Process, Program, Topology};
use super::model_links::{Link, Via};
use super::reader::At;
use super::tree::join;

/// The tables that say where a channel goes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tables<'a> {
    pub channels: &'a [ChannelEntry],
    pub processes: &'a [ProcessEntry],
}

/// Fills in channels and links.
pub(super) fn check(
    topology: &mut Topology,
    case: Option<&KnownCase>,
    tables: Tables<'_>,
    links: Vec<LinkEntry>,
    faults: &Faults,
) {
    let entries = tables.channels;
    let mut channels = case.map_or(Vec::new(), |case| {
        case_channels(case, &topology.processes, entries, faults)
    });
    let of_case: Vec<_> = case.map_or(Vec::new(), |case| {
        case.channels.iter().map(|spec| spec.name).collect()
    });
    for entry in entries {
        if !of_case.contains(&entry.name.as_str()) {
            channels.extend(foreign_channel(entry, topology, &of_case, faults));
        }
    }
    for (index, channel) in channels.iter_mut().enumerate() {
        channel.channel_id = u16::try_from(index).unwrap_or(u16::MAX);
    }
    let mut routes = Routes {
        topology,
        links: &links,
        tables,
        between: vec![None; links.len()],
        faults,
    };
    for channel in &mut channels {
        routes.assign(channel);
    }
    let mut between = core::mem::take(&mut routes.between);
    routes.check_named_hosts();
    check_port_ranges(topology, &links, &between, faults);
    topology.channels = channels;
    topology.links = links
        .into_iter()
        .zip(&mut between)
        .map(|(entry, between)| Link {
            name: entry.name,
            // A missing `via` is a fault already, so this link is never seen.
            via: entry.via.unwrap_or(Via::SharedMemory),
            between: entry
                .between
                .map(|hosts| hosts.map(|host| host.value))
                .or_else(|| between.take()),
        })
        .collect();
}

/// The channels of the case, with what the file says about them.
fn case_channels(
    case: &KnownCase,
    processes: &[Process],
    entries: &[ChannelEntry],
    faults: &Faults,
) -> Vec<Channel> {
    let mut channels = Vec::new();
    for spec in case.channels {
        let entry = entries.iter().find(|entry| entry.name == spec.name);
        if let Some(entry) = entry {
            check_case_entry(case, spec, entry, faults);
        }
        let player = |role| {
            processes
                .iter()
                .find(|process| process.role() == Some(role))
        };
        // An unplayed role is a fault already, or nobody misses it.
        let (from, to) = (player(spec.from), spec.to.and_then(player));
        // A foreign program leaves nothing in our record.
        let is_recorded_here = spec.is_recorded_only() && !from.is_some_and(is_played_by_adapter);
        let Some(from) = from.filter(|_| to.is_some() || is_recorded_here) else {
            refuse_unplayed(spec, entry, faults);
            continue;
        };
        channels.push(Channel {
            channel_id: 0,
            name: spec.name.to_owned(),
            message: MessageLayout {
                name: spec.message.name.to_owned(),
                size_bytes: spec.message.size_bytes,
                alignment_bytes: spec.message.alignment_bytes,
            },
            from: from.name.clone(),
            to: to.map(|to| to.name.clone()),
            depth: match (spec.is_recorded_only(), entry) {
                (true, _) => 0,
                (false, Some(entry)) => entry.depth,
                (false, None) => ChannelEntry::default_depth(),
            },
            link: entry.and_then(ChannelEntry::link_name),
            is_carried: false,
            is_foreign: false,
        });
    }
    channels
}

/// A setting of a channel that is not there would be ignored in silence.
fn refuse_unplayed(spec: &ChannelSpec, entry: Option<&ChannelEntry>, faults: &Faults) {
    let Some(entry) = entry.filter(|_| faults.is_empty()) else {
        return;
    };
    let fault = format!(
        "has nothing to set: no process of this file plays role `{}`, so the channel is not there",
        spec.from
    );
    faults.add(
        entry.path.clone(),
        Some(entry.place),
        Fault::Inconsistent(fault),
    );
}

/// What the file may say of a channel that the case declares.
fn check_case_entry(case: &KnownCase, spec: &ChannelSpec, entry: &ChannelEntry, faults: &Faults) {
    let places = [
        (
            "message",
            entry.message.as_ref().map(|message| message.place),
        ),
        ("from", entry.from.as_ref().map(|from| from.place)),
        ("to", entry.to.as_ref().map(|to| to.place)),
    ];
    for (key, place) in places {
        if place.is_some() {
            let fault = format!("is given by case `{}` for this channel", case.name);
            faults.add(join(&entry.path, key), place, Fault::Inconsistent(fault));
        }
    }
    if !spec.is_recorded_only() {
        return;
    }
    let why = "the messages of this channel only go to the run's record, on the host of their \
               producer";
    if let Some(link) = &entry.link {
        let fault = Fault::Inconsistent(format!("is `{}`, but {why}", link.value));
        faults.add(join(&entry.path, "link"), Some(link.place), fault);
    } else {
        let fault = Fault::Inconsistent(format!("has nothing to set: {why}"));
        faults.add(entry.path.clone(), Some(entry.place), fault);
    }
}

/// A channel between the user's own programs.
fn foreign_channel(
    entry: &ChannelEntry,
    topology: &Topology,
    of_case: &[&str],
    faults: &Faults,
) -> Option<Channel> {
    let is_declared = entry.message.is_some() || entry.from.is_some() || entry.to.is_some();
    if !is_declared && !of_case.is_empty() {
        // Far more often a slip in a name than a foreign channel without any of its keys.
        let fault = Fault::UnknownWord {
            value: entry.name.clone(),
            expected: "a channel of the case; a foreign one states message, from and to",
            allowed: of_case.iter().map(|&name| name.to_owned()).collect(),
        };
        faults.add(entry.path.clone(), Some(entry.place), fault);
        return None;
    }
    if entry.message.is_none() {
        let hint = "a foreign channel states { name, size_bytes, alignment_bytes }";
        let key = join(&entry.path, "message");
        faults.add(key, Some(entry.place), Fault::Missing(hint.to_owned()));
    }
    let from = check_end(entry, "from", entry.from.as_ref(), topology, faults);
    let to = check_end(entry, "to", entry.to.as_ref(), topology, faults);
    let (from, to) = (from?, to?);
    if from == to {
        let fault = Fault::Inconsistent(format!("is process `{to}`, as is `from`"));
        let place = entry.to.as_ref().map(|end| end.place);
        faults.add(join(&entry.path, "to"), place, fault);
    }
    Some(Channel {
        channel_id: 0,
        name: entry.name.clone(),
        message: entry.message.as_ref()?.value.clone(),
        from,
        to: Some(to),
        depth: entry.depth,
        link: entry.link_name(),
        is_carried: false,
        is_foreign: true,
    })
}

fn check_end(
    entry: &ChannelEntry,
    key: &str,
    end: Option<&At<String>>,
    topology: &Topology,
    faults: &Faults,
) -> Option<String> {
    let path = join(&entry.path, key);
    let own = |process: &&Process| matches!(process.program, Program::Command { .. });
    let names = || {
        let own = topology.processes.iter().filter(own);
        own.map(|process| process.name.clone()).collect::<Vec<_>>()
    };
    let Some(end) = end else {
        let hint = "a foreign channel states from and to which process it goes".to_owned();
        faults.add(path, Some(entry.place), Fault::Missing(hint));
        return None;
    };
    let fault = match topology.process(&end.value) {
        Some(process) if own(&process) => return Some(end.value.clone()),
        Some(_) => Fault::Inconsistent(format!(
            "is process `{}`, a built-in role, which has the channels of its case only",
            end.value
        )),
        None => Fault::UnknownWord {
            value: end.value.clone(),
            expected: "a process of this file with `run`",
            allowed: names(),
        },
    };
    faults.add(path, Some(end.place), fault);
    None
}

/// Which link carries which channel.
struct Routes<'a> {
    topology: &'a Topology,
    links: &'a [LinkEntry],
    tables: Tables<'a>,
    /// Hosts of each link, in alphabetical order, from the first channel that uses it.
    between: Vec<Option<[String; 2]>>,
    faults: &'a Faults,
}

impl Routes<'_> {
    /// Checks the link of `channel` against the hosts of its ends.
    fn assign(&mut self, channel: &mut Channel) {
        let host_of = |name: &str| self.topology.process(name).map(|process| &process.host);
        // A link given to a channel without consumer is a fault already.
        let to = channel.to.as_deref().and_then(host_of);
        let (Some(from), Some(to)) = (host_of(&channel.from), to) else {
            return;
        };
        let known = |name: &str| self.topology.host(name).is_some();
        if !known(from) || !known(to) {
            return;
        }
        let Ok(index) = self.link_index(channel) else {
            return;
        };
        let via = index.map(|index| &self.links[index].via);
        let has_gateway = match via {
            None => false,
            Some(None) => return,
            Some(Some(via)) => !matches!(via, Via::SharedMemory),
        };
        if from == to {
            if has_gateway {
                let link = channel.link.as_deref().unwrap_or_default();
                self.refuse(channel, Fault::Inconsistent(format!(
                    "is `{link}`, but both ends of the channel are on host `{from}`: it needs no \
                     link, or one via \"shared-memory\""
                )));
            }
            return;
        }
        let Some(index) = index.filter(|_| has_gateway) else {
            self.refuse_unlinked(channel, [from, to]);
            return;
        };
        let hosts = if from < to { [from, to] } else { [to, from] };
        self.carry(channel, index, hosts.map(String::clone));
    }

    fn carry(&mut self, channel: &mut Channel, index: usize, hosts: [String; 2]) {
        let link = &self.links[index];
        let given = link.between.as_ref().map(|between| {
            let mut given = between.clone().map(|host| host.value);
            given.sort_unstable();
            given
        });
        let between = given.or_else(|| self.between[index].clone());
        if let Some([first, second]) = between.filter(|between| *between != hosts) {
            let [from, to] = &hosts;
            let fault = Fault::Inconsistent(format!(
                "is `{}`, which joins `{first}` and `{second}`, but the channel is between \
                 `{from}` and `{to}`",
                link.name
            ));
            self.refuse(channel, fault);
            return;
        }
        self.between[index] = Some(hosts);
        channel.is_carried = true;
    }

    /// The link the channel names, if any; `Err` when there is none of that name.
    fn link_index(&self, channel: &Channel) -> Result<Option<usize>, ()> {
        let Some(name) = &channel.link else {
            return Ok(None);
        };
        let index = self.links.iter().position(|link| link.name == *name);
        if index.is_none() {
            let fault = Fault::UnknownWord {
                value: name.clone(),
                expected: "a link of this file",
                allowed: self.links.iter().map(|link| link.name.clone()).collect(),
            };
            self.refuse(channel, fault);
        }
        index.map(Some).ok_or(())
    }

    fn refuse_unlinked(&self, channel: &Channel, [from, to]: [&String; 2]) {
        let consumer = channel.to.as_deref().unwrap_or_default();
        let ends = format!(
            "`{}` on host `{from}` and `{consumer}` on host `{to}`",
            channel.from
        );
        let words = crossing_words(|_| true);
        let hint = format!("the channel joins {ends}: name a link via {words}");
        let fault = match &channel.link {
            None => Fault::Missing(hint),
            Some(link) => {
                Fault::Inconsistent(format!("is `{link}` via \"shared-memory\", but {hint}"))
            }
        };
        self.refuse(channel, fault);
    }

    /// Points at the channel's own table or, without one, at what puts its consumer elsewhere.
    fn refuse(&self, channel: &Channel, fault: Fault) {
        let key = join(&join("channels", &channel.name), "link");
        let mut entries = self.tables.channels.iter();
        let entry = entries.find(|entry| entry.name == channel.name);
        let place = entry.map(|entry| place_of(entry.link.as_ref(), entry.place));
        let consumer = || {
            let mut processes = self.tables.processes.iter();
            let consumer = processes.find(|process| Some(&process.name) == channel.to.as_ref())?;
            Some(place_of(consumer.host.as_ref(), consumer.place))
        };
        self.faults.add(key, place.or_else(consumer), fault);
    }

    /// `between` names hosts of the file.
    fn check_named_hosts(&self) {
        let hosts = || self.topology.hosts.iter().map(|host| host.name.clone());
        for link in self.links {
            for host in link.between.iter().flatten() {
                if self.topology.host(&host.value).is_none() {
                    let fault = Fault::UnknownWord {
                        value: host.value.clone(),
                        expected: "a host of this file",
                        allowed: hosts().collect(),
                    };
                    let key = join(&link.path, "between");
                    self.faults.add(key, Some(host.place), fault);
                }
            }
        }
    }
}

fn place_of(value: Option<&At<String>>, table: Place) -> Place {
    value.map_or(table, |value| value.place)
}

/// Ports of different links must differ even between different hosts: on one PC they meet.
fn check_port_ranges(
    topology: &Topology,
    links: &[LinkEntry],
    between: &[Option<[String; 2]>],
    faults: &Faults,
) {
    let mut taken: Vec<(&str, core::ops::Range<u32>)> = Vec::new();
    for (link, hosts) in links.iter().zip(between) {
        let hop = link.via.as_ref().and_then(Via::hop);
        // A link that carries nothing takes no ports.
        let Some((hop, hosts)) = hop.zip(hosts.as_ref()) else {
            continue;
        };
        let [one, other] = hosts.each_ref().map(|name| {
            let host = topology.host(name);
            host.map(Host::gateway_address)
        });
        let count = LinkPorts::count(one == other);
        let range = u32::from(hop.port)..u32::from(hop.port) + u32::from(count);
        let last = range.end - 1;
        let add = |fault: String| {
            let key = join(&link.path, "port");
            faults.add(key, Some(link.place), Fault::Inconsistent(fault));
        };
        if last > u32::from(u16::MAX) {
            let port = hop.port;
            add(format!(
                "{port} leaves no ports below 65536: a link takes {count}"
            ));
        }
        let overlaps = |(_, other): &&(&str, core::ops::Range<u32>)| {
            range.start < other.end && other.start < range.end
        };
        if let Some((other, _)) = taken.iter().find(overlaps) {
            let base = hop.port;
            add(format!(
                "{base} to {last} overlaps with the ports of link `{other}`"
            ));
        }
        taken.push((&link.name, range));
    }
}
