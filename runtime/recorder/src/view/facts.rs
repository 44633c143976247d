//! What is known of a run before its first record: channels, links, hosts, the case. Taken from the
//! manifest; what only the case knows, its roles, from the shipped cases.

use std::time::Duration;

use hil_fleet::Fleet;
use hil_rundir::manifest::{ChannelDescription, Manifest};
use hil_shuttle::Shuttle;
use hil_teleoperation::Teleoperation;
use hil_topology::registry::Registry;
use serde::Serialize;
use serde_json::Value;

use crate::clocks::Clocks;

/// A run, as far as it is known beforehand.
#[derive(Debug, Default)]
pub(crate) struct RunFacts {
    /// Name of its folder.
    pub(crate) name: String,
    /// Its case.
    pub(crate) case: Option<String>,
    /// `[case.parameters]`, every default spelled out.
    pub(crate) parameters: Value,
    /// As planned.
    pub(crate) duration: Option<Duration>,
    /// Hosts of the topology on this machine.
    pub(crate) hosts_here: Vec<String>,
    /// All of them.
    pub(crate) hosts: Vec<String>,
    /// Hash of the topology.
    pub(crate) topology_hash: Option<String>,
    /// The seed.
    pub(crate) seed: Option<u64>,
    /// The channels.
    pub(crate) channels: Vec<ChannelFacts>,
    /// The links.
    pub(crate) links: Vec<LinkFacts>,
    /// Stamps of all hosts compare.
    pub(crate) has_one_clock: bool,
}

/// A channel, as `/live/run` lists it.
#[derive(Debug, Default, Clone, Serialize)]
pub(crate) struct ChannelFacts {
    /// Name.
    pub(crate) name: String,
    /// Its message, where the manifest names it.
    pub(crate) message: Option<String>,
    /// Size of its messages, bytes.
    pub(crate) size_bytes: Option<usize>,
    /// Process that publishes.
    pub(crate) from: Option<String>,
    /// The one that takes.
    pub(crate) to: Option<String>,
    /// Host of the first.
    pub(crate) from_host: Option<String>,
    /// Host of the second.
    pub(crate) to_host: Option<String>,
    /// How it travels.
    pub(crate) via: String,
    /// The link that it crosses.
    pub(crate) link: Option<String>,
    /// What the manifest says of it.
    #[serde(skip)]
    pub(crate) described: Option<ChannelDescription>,
    /// No producer's record tells when its messages were published; the messages themselves do.
    #[serde(skip)]
    pub(crate) is_by_message: bool,
    /// From the monotonic clocks of the two hosts to the recording's axis, nanoseconds.
    #[serde(skip)]
    pub(crate) offsets_ns: [i64; 2],
}

/// A link.
#[derive(Debug, Default, Clone)]
pub(crate) struct LinkFacts {
    /// Name.
    pub(crate) name: String,
    /// `udp`, `tcp`, `emulated`, `shared-memory`.
    pub(crate) via: String,
    /// Hosts at its ends.
    pub(crate) between: [Option<String>; 2],
}

impl RunFacts {
    /// What `manifest` says of the run called `name`; `recorded` are the channels with records.
    pub(crate) fn new(
        name: &str,
        manifest: Option<&Manifest>,
        recorded: &[String],
        clocks: &Clocks,
    ) -> Self {
        let mut facts = manifest.map(Self::described).unwrap_or_default();
        name.clone_into(&mut facts.name);
        facts.has_one_clock = clocks.has_one_clock == Some(true);
        for name in recorded {
            if facts.channel(name).is_none() {
                facts.channels.push(ChannelFacts {
                    name: name.clone(),
                    via: "unknown".to_owned(),
                    ..ChannelFacts::default()
                });
            }
        }
        for channel in &mut facts.channels {
            let from = channel.from_host.as_deref();
            let to = channel.to_host.as_deref().or(from);
            channel.offsets_ns = [from, to].map(|host| clocks.offset_ns(host));
        }
        facts
    }

    fn described(manifest: &Manifest) -> Self {
        let topology = &manifest.topology;
        let case = &topology["case"];
        let links = names(&topology["links"]).map(|name| {
            let link = &topology["links"][&name];
            LinkFacts {
                via: text(&link["via"]).unwrap_or_default(),
                between: [0, 1].map(|end| text(&link["between"][end])),
                name,
            }
        });
        let channels = manifest.channels.iter();
        let channels = channels.map(|one| {
            let own = &topology["channels"][&one.name];
            let crosses = one.to_host.is_some() && one.to_host != one.from_host;
            let link = own["link"].as_str().filter(|_| crosses);
            let via = match (&one.to_host, link) {
                (None, _) => "record",
                (_, Some(link)) => topology["links"][link]["via"].as_str().unwrap_or("unknown"),
                _ => "shared-memory",
            };
            let [from, to] = ends(&one.name, topology);
            ChannelFacts {
                name: one.name.clone(),
                message: Some(one.message.clone()),
                size_bytes: Some(one.size_bytes),
                from,
                to,
                from_host: one.from_host.clone(),
                to_host: one.to_host.clone(),
                described: Some(one.clone()),
                via: via.to_owned(),
                link: link.map(str::to_owned),
                is_by_message: one.to_host.is_none(),
                offsets_ns: [0; 2],
            }
        });
        let duration = topology["run"]["duration"].as_str();
        Self {
            case: text(&case["name"]),
            parameters: case["parameters"].clone(),
            duration: duration.and_then(hil_topology::read_duration),
            hosts_here: manifest.hosts_here.clone(),
            hosts: names(&topology["hosts"]).collect(),
            topology_hash: Some(manifest.topology_hash.clone()),
            seed: Some(manifest.seed),
            channels: channels.collect(),
            links: links.collect(),
            ..Self::default()
        }
    }

    /// The channel called `name`, with its place.
    pub(crate) fn channel(&self, name: &str) -> Option<(usize, &ChannelFacts)> {
        let mut channels = self.channels.iter().enumerate();
        channels.find(|(_, channel)| channel.name == name)
    }
}

/// Processes at the ends of a channel: as the file says, or those with the case's roles.
fn ends(channel: &str, topology: &Value) -> [Option<String>; 2] {
    let own = &topology["channels"][channel];
    if own["from"].is_string() {
        return [text(&own["from"]), text(&own["to"])];
    }
    let mut registry = Registry::default();
    registry.add::<Fleet>();
    registry.add::<Teleoperation>();
    registry.add::<Shuttle>();
    let case = topology["case"]["name"].as_str();
    let case = case.and_then(|name| registry.find(name));
    let spec = case.and_then(|case| case.channels.iter().find(|one| one.name == channel));
    let with_role = |role: &str| {
        let mut processes = names(&topology["processes"]);
        processes.find(|name| topology["processes"][name]["role"] == role)
    };
    let ends = spec.map(|spec| [with_role(spec.from), spec.to.and_then(with_role)]);
    ends.unwrap_or_default()
}

fn text(value: &Value) -> Option<String> {
    value.as_str().map(str::to_owned)
}

/// Keys of a table, in order.
fn names(table: &Value) -> impl Iterator<Item = String> {
    table
        .as_object()
        .into_iter()
        .flatten()
        .map(|(key, _)| key.clone())
}
