//! `manifest.json`: what a run folder says of its run before it begins, for programs that know no
//! case study. It describes; who runs what is decided elsewhere.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::SystemTime;
use std::{fs, io};

use hil_core::layout::{Field, FieldKind, RESERVED};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::run_folder::{RunFolder, utc_text};
use hil_platform::host_facts::HostFacts;
use hil_platform::plain_file;
use hil_topology::{KnownCases, Topology, TopologyErrors};

/// Version of the layout of `manifest.json`. Within one, fields are only added.
pub const MANIFEST_VERSION: u32 = 1;

/// What a supervisor knows of the run that it is about to begin.
#[derive(Debug)]
pub struct ManifestContent<'a> {
    /// What is run.
    pub topology: &'a Topology,
    /// The file that it was read from.
    pub topology_file: &'a Path,
    /// Names of the hosts that run here.
    pub hosts: &'a [String],
    /// The command line.
    pub command_line: &'a [String],
    /// The fields of the channels whose messages are known, by channel.
    pub layouts: &'a BTreeMap<String, &'static [Field]>,
    /// What the machine is.
    pub facts: &'a HostFacts,
    /// Real-time minus monotonic clock, nanoseconds; `None` when it cannot be read.
    pub realtime_minus_monotonic_ns: Option<i64>,
}

/// Writes the manifest of a run into its folder.
///
/// # Errors
/// When the file cannot be written.
pub fn write(content: &ManifestContent<'_>, folder: &RunFolder) -> io::Result<()> {
    let topology = content.topology;
    let manifest = json!({
        "schema_version": MANIFEST_VERSION,
        "program": { "name": "hil-runtime", "version": env!("CARGO_PKG_VERSION") },
        "command_line": content.command_line,
        "created": utc_text(SystemTime::now()),
        "hosts_here": content.hosts,
        "topology_file": content.topology_file.display().to_string(),
        "topology_hash": topology_hash(topology),
        "topology": topology.resolved(),
        "seed": topology.run().seed,
        "host_facts": content.facts,
        "channels": describe_channels(topology, content.layouts),
        "realtime_minus_monotonic_ns": content.realtime_minus_monotonic_ns,
    });
    let text = serde_json::to_string_pretty(&manifest).map_err(io::Error::other)?;
    fs::write(folder.manifest(), text)
}

/// What the file says; a key that an earlier version did not write is empty.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Manifest {
    /// [`MANIFEST_VERSION`] of the writer.
    pub schema_version: u32,
    /// What wrote it.
    pub program: Program,
    /// The command line.
    #[serde(default)]
    pub command_line: Vec<String>,
    /// When the run was set up, as people write it.
    #[serde(default)]
    pub created: String,
    /// Hosts of the topology that ran on the machine that wrote this.
    #[serde(default)]
    pub hosts_here: Vec<String>,
    /// The file that the topology was read from, as the command line names it.
    #[serde(default)]
    pub topology_file: String,
    /// Hash of the topology.
    #[serde(default)]
    pub topology_hash: String,
    /// The topology with every default spelled out.
    #[serde(default)]
    pub topology: Value,
    /// Seed of every random stream.
    #[serde(default)]
    pub seed: u64,
    /// What the machine is.
    #[serde(default)]
    pub host_facts: Value,
    /// The channels.
    #[serde(default)]
    pub channels: Vec<ChannelDescription>,
    /// Real-time minus monotonic clock of the machine that wrote this, before the run,
    /// nanoseconds; `None` when it was not read.
    #[serde(default)]
    pub realtime_minus_monotonic_ns: Option<i64>,
}

/// A topology that a manifest does not give back.
#[derive(Debug, thiserror::Error)]
pub enum ManifestTopologyError {
    /// It is no table of TOML.
    #[error("its topology cannot be read: {0}")]
    Table(String),
    /// It is no topology that this program can run.
    #[error("its topology cannot be read: {0}")]
    Topology(#[from] TopologyErrors),
    /// It is one, but not the one that ran.
    #[error("its topology has hash {found}, and {wanted} ran")]
    Hash {
        /// Of the topology that was read.
        found: String,
        /// Of the one that ran.
        wanted: String,
    },
}

impl Manifest {
    /// That of the run in `folder`.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn read(folder: &RunFolder) -> io::Result<Self> {
        let text = plain_file::read_to_string(&folder.manifest())?;
        serde_json::from_str(&text).map_err(io::Error::other)
    }

    /// The topology that ran, with the cases that the program knows.
    ///
    /// # Errors
    /// When the program does not read it as the one that ran.
    pub fn read_topology(&self, known: &KnownCases) -> Result<Topology, ManifestTopologyError> {
        let topology = self.parse(&self.topology, known)?;
        let found = topology_hash(&topology);
        if found != self.topology_hash {
            let wanted = self.topology_hash.clone();
            return Err(ManifestTopologyError::Hash { found, wanted });
        }
        Ok(topology)
    }

    /// The topology that ran, but for what `change` makes of it.
    ///
    /// # Errors
    /// When the program does not read it.
    pub fn read_changed_topology(
        &self,
        change: impl FnOnce(&mut Value),
        known: &KnownCases,
    ) -> Result<Topology, ManifestTopologyError> {
        let mut topology = self.topology.clone();
        change(&mut topology);
        self.parse(&topology, known)
    }

    fn parse(
        &self,
        topology: &Value,
        known: &KnownCases,
    ) -> Result<Topology, ManifestTopologyError> {
        let table = toml::Table::deserialize(topology)
            .map_err(|error| ManifestTopologyError::Table(error.to_string()))?;
        let text = toml::to_string(&table)
            .map_err(|error| ManifestTopologyError::Table(error.to_string()))?;
        Ok(hil_topology::parse(&self.topology_file, &text, &[], known)?)
    }
}

/// The hash of `topology` as a manifest writes it.
fn topology_hash(topology: &Topology) -> String {
    format!("{:016x}", topology.hash())
}

/// Name and version of a program.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Program {
    /// Name.
    pub name: String,
    /// Version.
    pub version: String,
}

/// A channel and how its messages lie in memory.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChannelDescription {
    /// Its name.
    pub name: String,
    /// Name and version of the message, e.g. `hil.EgmCommand.v1`.
    pub message: String,
    /// Size of one message.
    pub size_bytes: usize,
    /// Its fields in order, without gap; empty when nobody stated them.
    pub fields: Vec<FieldDescription>,
    /// Host of the producer.
    pub from_host: Option<String>,
    /// Host of the consumer; `None` when the messages only go to the record.
    pub to_host: Option<String>,
}

/// One field of a message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldDescription {
    /// Name, which ends in the unit.
    pub name: String,
    /// Of what kind its elements are.
    pub kind: KindDescription,
    /// Number of elements; `None` for what is no array.
    pub count: Option<usize>,
    /// Of its first byte, from the start of the structure.
    pub offset_bytes: usize,
}

/// Of what kind the elements of a field are, as a file keeps it.
pub type KindDescription = FieldKind<String, Vec<FieldDescription>>;

impl FieldDescription {
    /// True for filler that means nothing.
    pub fn is_reserved(&self) -> bool {
        self.name == RESERVED
    }
}

impl From<&Field> for FieldDescription {
    fn from(field: &Field) -> Self {
        Self {
            name: field.name.to_owned(),
            kind: field
                .kind
                .kept(|name, fields| ((*name).to_owned(), describe_fields(fields))),
            count: field.count,
            offset_bytes: field.offset_bytes,
        }
    }
}

/// The layout of a message in owned words.
pub fn describe_fields(fields: &[Field]) -> Vec<FieldDescription> {
    fields.iter().map(FieldDescription::from).collect()
}

/// Every channel of `topology`; `layouts` are the fields of those that are known, by name.
fn describe_channels(
    topology: &Topology,
    layouts: &BTreeMap<String, &'static [Field]>,
) -> Vec<ChannelDescription> {
    let host_of = |process: &str| Some(topology.process(process)?.host.clone());
    let channels = topology.channels().iter();
    let described = channels.map(|channel| ChannelDescription {
        name: channel.name.clone(),
        message: channel.message.name.clone(),
        size_bytes: channel.message.size_bytes,
        // A foreign channel may bear any name; nobody stated what its messages hold.
        fields: (!channel.is_foreign)
            .then(|| layouts.get(&channel.name))
            .flatten()
            .map(|fields| describe_fields(fields))
            .unwrap_or_default(),
        from_host: host_of(&channel.from),
        to_host: channel.to.as_deref().and_then(host_of),
    });
    described.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_arm::egm::messages::EgmFeedback;
    use hil_core::message::Message;

    #[test]
    fn a_layout_survives_the_trip_through_json() {
        let fields = describe_fields(EgmFeedback::FIELDS);
        let text = serde_json::to_string(&fields).unwrap();
        let back: Vec<FieldDescription> = serde_json::from_str(&text).unwrap();
        assert_eq!(back, fields);
        let tool = back.iter().find(|field| field.name == "tool").unwrap();
        let KindDescription::Record { name, fields } = &tool.kind else {
            panic!("a structure");
        };
        assert_eq!((name.as_str(), fields[1].count), ("Pose", Some(4)));
    }

    #[test]
    fn a_manifest_of_before_the_channels_is_read() {
        let text = r#"{"schema_version": 1, "program": {"name": "hil-runtime", "version": "0"}}"#;
        let manifest: Manifest = serde_json::from_str(text).unwrap();
        assert!(manifest.channels.is_empty() && manifest.realtime_minus_monotonic_ns.is_none());
    }
}
