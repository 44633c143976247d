//! What a process is told: its role, its parameters and its channels. Nothing in it says whether
//! a channel's other end is in the same host or behind a gateway, so the card of a process is the
//! same in `local.toml` and `split.toml`.

use serde::{Deserialize, Serialize};

use super::model::{Channel, Process, Topology};

/// What a process is told.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoleSpec {
    /// Its key in the file.
    pub process: String,
    /// Name of the case; `None` for a program outside any case.
    pub case: Option<String>,
    /// Role it plays in the case.
    pub role: Option<String>,
    /// Seed of the run.
    pub seed: u64,
    /// Channels it reads; those of its role in the order of the case.
    pub inputs: Vec<RoleChannel>,
    /// Channels it writes; those of its role in the order of the case.
    pub outputs: Vec<RoleChannel>,
    /// Every parameter of the case; empty without a role.
    pub parameters: toml::Table,
}

/// One channel of a role.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoleChannel {
    /// Name, also of the shared-memory service.
    pub name: String,
    /// Name and version of its messages.
    pub message_name: String,
    /// Size of one message.
    pub message_size_bytes: usize,
    /// Alignment of a message in shared memory.
    pub message_alignment_bytes: usize,
    /// Messages its queue holds; 0 when there is none.
    pub depth: usize,
    /// True for an output that is in no shared memory: its messages only go to the run's record.
    pub is_recorded_only: bool,
}

impl RoleChannel {
    fn of(channel: &Channel) -> Self {
        Self {
            name: channel.name.clone(),
            message_name: channel.message.name.clone(),
            message_size_bytes: channel.message.size_bytes,
            message_alignment_bytes: channel.message.alignment_bytes,
            depth: channel.depth,
            is_recorded_only: channel.is_recorded_only(),
        }
    }
}

impl Topology {
    /// The card of the process called `name`; `None` if there is no such process.
    pub fn role_spec(&self, name: &str) -> Option<RoleSpec> {
        let process = self.process(name)?;
        let role = process.role();
        let case = self.case.as_ref().filter(|_| role.is_some());
        let ends = |is_end: fn(&Channel, &Process) -> bool| {
            let channels = self.channels.iter();
            let channels = channels.filter(|channel| is_end(channel, process));
            channels.map(RoleChannel::of).collect()
        };
        Some(RoleSpec {
            process: process.name.clone(),
            case: case.map(|case| case.name.clone()),
            role: role.map(str::to_owned),
            seed: self.run.seed,
            inputs: ends(|channel, process| channel.to.as_ref() == Some(&process.name)),
            outputs: ends(|channel, process| channel.from == process.name),
            parameters: case.map(|case| case.parameters.clone()).unwrap_or_default(),
        })
    }
}
