//! What channels and links say about processes and hosts: which process ends a channel, which
//! link carries it, and which ports links take. See `check`.

use std::collections::BTreeMap;

use hil_core::case_study::ChannelSpec;

use super::check_adapter::is_played_by_adapter;
use super::checks::Checks;
use super::errors::Fault;
use super::known::KnownCase;
use super::links::{Link, LinkTable, Via, crossing_words};
use super::model::{Channel, Host, LinkPorts, MessageLayout, Process, Program, Topology};
use super::tables::ChannelTable;
use super::tree::join;

/// Messages that the queue of a channel holds where the file does not say.
const DEPTH: usize = 16;
/// The same of frames: a window of TCP.
const DEPTH_OF_FRAMES: usize = 1024;

/// The links by name, each checked by itself.
pub(super) fn routes<'a>(
    links: &'a BTreeMap<String, LinkTable>,
    checks: &Checks<'_>,
) -> Vec<Route<'a>> {
    let route = |(name, table): (&'a String, &'a LinkTable)| Route {
        name,
        via: table.via(&join("links", name), checks),
        named: table.hosts(),
        used: None,
    };
    links.iter().map(route).collect()
}

/// Fills in channels and links.
pub(super) fn check(
    topology: &mut Topology,
    case: Option<&KnownCase>,
    tables: &BTreeMap<String, ChannelTable>,
    links: Vec<Route<'_>>,
    checks: &Checks<'_>,
) {
    let mut channels = case.map_or(Vec::new(), |case| {
        case_channels(case, &topology.processes, tables, checks)
    });
    let of_case: Vec<_> = case.map_or(Vec::new(), |case| {
        case.channels.iter().map(|spec| spec.name).collect()
    });
    for (name, table) in tables {
        if !of_case.contains(&name.as_str()) {
            channels.extend(foreign_channel(name, table, topology, &of_case, checks));
        }
    }
    for (index, channel) in channels.iter_mut().enumerate() {
        channel.channel_id = u16::try_from(index).unwrap_or(u16::MAX);
    }
    let mut routes = Routes {
        topology,
        links,
        checks,
    };
    for channel in &mut channels {
        routes.assign(channel);
    }
    routes.check_named_hosts();
    routes.check_port_ranges();
    let links = core::mem::take(&mut routes.links);
    topology.channels = channels;
    topology.links = links.into_iter().map(Route::into_link).collect();
}

/// The channels of the case, with what the file says about them.
fn case_channels(
    case: &KnownCase,
    processes: &[Process],
    tables: &BTreeMap<String, ChannelTable>,
    checks: &Checks<'_>,
) -> Vec<Channel> {
    let mut channels = Vec::new();
    for spec in case.channels {
        let table = tables.get(spec.name);
        if let Some(table) = table {
            check_case_table(case, spec, table, checks);
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
            if table.is_some() && checks.is_clean() {
                // A setting of a channel that is not there would be ignored in silence.
                let fault = format!(
                    "has nothing to set: no process of this file plays role `{}`, so the channel is \
                     not there",
                    spec.from
                );
                checks.refuse_because(join("channels", spec.name), fault);
            }
            continue;
        };
        let depth = table.and_then(|table| table.depth).unwrap_or(DEPTH);
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
            depth: if spec.is_recorded_only() { 0 } else { depth },
            link: table.and_then(|table| table.link.clone()),
            is_carried: false,
            is_foreign: false,
            demand: table.and_then(|table| table.demand.clone()),
        });
    }
    channels
}

/// What the file may say of a channel that the case declares.
fn check_case_table(
    case: &KnownCase,
    spec: &ChannelSpec,
    table: &ChannelTable,
    checks: &Checks<'_>,
) {
    let path = join("channels", spec.name);
    let is_stated = [
        ("message", table.message.is_some()),
        ("from", table.from.is_some()),
        ("to", table.to.is_some()),
    ];
    for (key, _) in is_stated.into_iter().filter(|(_, is_stated)| *is_stated) {
        let fault = format!("is given by case `{}` for this channel", case.name);
        checks.refuse_because(join(&path, key), fault);
    }
    if !spec.is_recorded_only() {
        return;
    }
    let why = "the messages of this channel only go to the run's record, on the host of their \
               producer";
    if let Some(link) = &table.link {
        checks.refuse_because(join(&path, "link"), format!("is `{link}`, but {why}"));
    } else {
        checks.refuse_because(path, format!("has nothing to set: {why}"));
    }
}

/// A channel between the user's own programs.
fn foreign_channel(
    name: &str,
    table: &ChannelTable,
    topology: &Topology,
    of_case: &[&str],
    checks: &Checks<'_>,
) -> Option<Channel> {
    let path = join("channels", name);
    let is_declared = table.message.is_some() || table.from.is_some() || table.to.is_some();
    if !is_declared && !of_case.is_empty() {
        // Far more often a slip in a name than a foreign channel without any of its keys.
        let fault = Fault::UnknownWord {
            value: name.to_owned(),
            expected: "a channel of the case; a foreign one states message, from and to",
            allowed: of_case.iter().map(|&name| name.to_owned()).collect(),
        };
        checks.refuse(path, fault);
        return None;
    }
    let frames = frames_between(table, topology);
    if frames.is_none() && table.message.is_none() {
        let hint = "a foreign channel states { name, size_bytes, alignment_bytes }";
        checks.refuse(join(&path, "message"), Fault::Missing(hint.to_owned()));
    }
    let from = check_end(join(&path, "from"), table.from.as_ref(), topology, checks);
    let to = check_end(join(&path, "to"), table.to.as_ref(), topology, checks);
    let (from, to) = (from?, to?);
    if from == to {
        checks.refuse_because(
            join(&path, "to"),
            format!("is process `{to}`, as is `from`"),
        );
    }
    let default_depth = if frames.is_some() {
        DEPTH_OF_FRAMES
    } else {
        DEPTH
    };
    if let (Some(frames), Some(given)) = (&frames, &table.message)
        && frames != given
    {
        let fault = format!(
            "is `{}`, but both ends have `inside`: leave it out",
            given.name
        );
        checks.refuse_because(join(&path, "message"), fault);
    }
    Some(Channel {
        channel_id: 0,
        name: name.to_owned(),
        message: frames.or_else(|| table.message.clone())?,
        from,
        to: Some(to),
        depth: table.depth.unwrap_or(default_depth),
        link: table.link.clone(),
        is_carried: false,
        is_foreign: true,
        demand: table.demand.clone(),
    })
}

/// The messages of a channel that both ends put Ethernet frames on; `None` of any other.
fn frames_between(table: &ChannelTable, topology: &Topology) -> Option<MessageLayout> {
    let ends = [&table.from, &table.to];
    let is_inside = |end: &Option<String>| {
        let process = topology.process(end.as_ref()?)?;
        process.inside()
    };
    let are_inside = ends.into_iter().all(|end| is_inside(end).is_some());
    are_inside.then(MessageLayout::of_frames)
}

fn check_end(
    path: String,
    end: Option<&String>,
    topology: &Topology,
    checks: &Checks<'_>,
) -> Option<String> {
    let own = |process: &&Process| matches!(process.program, Program::Command { .. });
    let names = || {
        let own = topology.processes.iter().filter(own);
        own.map(|process| process.name.clone()).collect::<Vec<_>>()
    };
    let Some(end) = end else {
        let hint = "a foreign channel states from and to which process it goes".to_owned();
        checks.refuse(path, Fault::Missing(hint));
        return None;
    };
    let fault = match topology.process(end) {
        Some(process) if own(&process) => return Some(end.clone()),
        Some(_) => Fault::Inconsistent(format!(
            "is process `{end}`, a built-in role, which has the channels of its case only"
        )),
        None => Fault::UnknownWord {
            value: end.clone(),
            expected: "a process of this file with `run`",
            allowed: names(),
        },
    };
    checks.refuse(path, fault);
    None
}

/// A link on its way to being checked.
#[derive(Debug)]
pub(super) struct Route<'a> {
    name: &'a String,
    /// `None` when `via` is missing or faulty.
    via: Option<Via>,
    /// As the file has them.
    named: Option<[&'a String; 2]>,
    /// Its hosts in alphabetical order, from the first channel that uses it.
    used: Option<[String; 2]>,
}

impl Route<'_> {
    fn into_link(self) -> Link {
        Link {
            name: self.name.clone(),
            // A missing `via` is a fault already, so this link is never seen.
            via: self.via.unwrap_or(Via::SharedMemory),
            between: self
                .named
                .map(|hosts| hosts.map(String::clone))
                .or(self.used),
        }
    }
}

/// Which link carries which channel.
struct Routes<'t, 'l> {
    topology: &'t Topology,
    links: Vec<Route<'l>>,
    checks: &'t Checks<'t>,
}

impl Routes<'_, '_> {
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
        let given = link.named.map(|between| {
            let mut given = between.map(String::clone);
            given.sort_unstable();
            given
        });
        let between = given.or_else(|| link.used.clone());
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
        self.links[index].used = Some(hosts);
        channel.is_carried = true;
    }

    /// The link the channel names, if any; `Err` when there is none of that name.
    fn link_index(&self, channel: &Channel) -> Result<Option<usize>, ()> {
        let Some(name) = &channel.link else {
            return Ok(None);
        };
        let index = self.links.iter().position(|link| link.name == name);
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
        let table = join("channels", &channel.name);
        let key = join(&table, "link");
        let consumer = join("processes", channel.to.as_deref().unwrap_or_default());
        if self.checks.has(&table) {
            self.checks.refuse(key, fault);
        } else {
            self.checks.refuse_at(key, &join(&consumer, "host"), fault);
        }
    }

    /// `between` names hosts of the file.
    fn check_named_hosts(&self) {
        let hosts = || self.topology.hosts.iter().map(|host| host.name.clone());
        for link in &self.links {
            for (index, host) in link.named.iter().flatten().enumerate() {
                if self.topology.host(host).is_none() {
                    let fault = Fault::UnknownWord {
                        value: (*host).clone(),
                        expected: "a host of this file",
                        allowed: hosts().collect(),
                    };
                    let key = join(&join("links", link.name), "between");
                    let item = format!("{key}[{index}]");
                    self.checks.refuse_at(key, &item, fault);
                }
            }
        }
    }

    /// Ports of different links must differ even between different hosts: on one PC they meet.
    fn check_port_ranges(&self) {
        let mut taken: Vec<(&str, core::ops::Range<u32>)> = Vec::new();
        for link in &self.links {
            let hop = link.via.as_ref().and_then(Via::hop);
            // A link that carries nothing takes no ports.
            let Some((hop, hosts)) = hop.zip(link.used.as_ref()) else {
                continue;
            };
            let [one, other] = hosts.each_ref().map(|name| {
                let host = self.topology.host(name);
                host.map(Host::gateway_address)
            });
            let count = LinkPorts::count(one == other);
            let base = hop.port;
            let range = u32::from(base)..u32::from(base) + u32::from(count);
            let last = range.end - 1;
            let refuse = |fault: String| {
                let key = join(&join("links", link.name), "port");
                self.checks.refuse_because(key, fault);
            };
            if last > u32::from(u16::MAX) {
                refuse(format!(
                    "{base} leaves no ports below 65536: a link takes {count}"
                ));
            }
            let overlaps = |(_, other): &&(&str, core::ops::Range<u32>)| {
                range.start < other.end && other.start < range.end
            };
            if let Some((other, _)) = taken.iter().find(overlaps) {
                refuse(format!(
                    "{base} to {last} overlaps with the ports of link `{other}`"
                ));
            }
            taken.push((link.name, range));
        }
    }
}
