//! The checked topology written back: every default spelled out, in the shape of the file. It is
//! what a run's manifest keeps and what two hosts compare.

use core::time::Duration;

use hil_core::message::{FNV_OFFSET, fnv1a};
use serde::Serialize;
use toml::{Table, Value};

use super::file_impairments::{resolved_part, resolved_spec};
use super::file_trace::resolved_trace;
use super::model::{Channel, Execution, Host, OnExit, Process, Program, Scheduling, Topology};
use super::model_links::{Gateway, Hop, Link, Via};
use super::units::format_duration;

impl Topology {
    /// A file of the same topology that extends nothing and leaves nothing out.
    ///
    /// # Panics
    /// Never: a checked topology can be written.
    pub fn to_toml(&self) -> String {
        toml::to_string(&self.resolved()).expect("tables with string keys can be written as TOML")
    }

    /// The same as a tree, for a manifest of any format.
    pub fn resolved(&self) -> Table {
        self.resolved_with(true)
    }

    fn resolved_with(&self, key_path: bool) -> Table {
        let mut table = Table::new();
        put(&mut table, "version", super::limits::VERSION.default);
        put(&mut table, "name", self.name.as_str());
        put(&mut table, "run", self.resolved_run());
        if let Some(case) = &self.case {
            let mut case_table = Table::new();
            put(&mut case_table, "name", case.name.as_str());
            put(&mut case_table, "parameters", case.parameters.clone());
            put(&mut table, "case", case_table);
        }
        let hosts = self
            .hosts
            .iter()
            .map(|host| (host.name.clone(), resolved_host(host)));
        put_named(&mut table, "hosts", hosts);
        let processes = self.processes.iter();
        let processes = processes.map(|process| (process.name.clone(), resolved_process(process)));
        put_named(&mut table, "processes", processes);
        // What is only recorded has nothing to set, and a file that says otherwise is refused.
        let channels = self.channels.iter();
        let channels = channels.filter(|channel| !channel.is_recorded_only());
        let channels = channels.map(|channel| (channel.name.clone(), resolved_channel(channel)));
        put_named(&mut table, "channels", channels);
        let links = self
            .links
            .iter()
            .map(|link| (link.name.clone(), resolved_link(link)));
        put_named(&mut table, "links", links);
        if let Some(security) = self.security.resolved(key_path) {
            put(&mut table, "security", security);
        }
        table
    }

    /// 64-bit FNV-1a of [`Topology::to_toml`] but for the place of the key file: equal on two hosts that
    /// mean the same run.
    ///
    /// It guards against two versions of a file, not against an adversary.
    ///
    /// # Panics
    /// Never: tables with string keys can be written as TOML.
    pub fn hash(&self) -> u64 {
        let text = toml::to_string(&self.resolved_with(false));
        let text = text.expect("tables with string keys can be written as TOML");
        fnv1a(FNV_OFFSET, text.as_bytes())
    }

    fn resolved_run(&self) -> Table {
        let run = &self.run;
        let mut table = Table::new();
        put(&mut table, "duration", duration(run.duration));
        put(&mut table, "seed", integer(run.seed));
        put(&mut table, "record", run.record_folder.as_str());
        put(&mut table, "start_timeout", duration(run.start_timeout));
        put(&mut table, "peer_timeout", duration(run.peer_timeout));
        table
    }
}

/// The resolved form, as in [`Topology::resolved`].
impl Serialize for Topology {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.resolved().serialize(serializer)
    }
}

pub(super) fn put(table: &mut Table, key: &str, value: impl Into<Value>) {
    table.insert(key.to_owned(), value.into());
}

fn put_named(table: &mut Table, key: &str, tables: impl Iterator<Item = (String, Table)>) {
    let named: Table = tables
        .map(|(name, table)| (name, Value::Table(table)))
        .collect();
    put(table, key, named);
}

pub(super) fn duration(duration: Duration) -> Value {
    Value::String(format_duration(duration))
}

/// Every integer of a checked topology came from a TOML integer.
pub(super) fn integer(value: impl TryInto<i64>) -> Value {
    let value = value.try_into().ok();
    Value::Integer(value.expect("limits keep every number within 64 bits"))
}

fn resolved_host(host: &Host) -> Table {
    let mut table = Table::new();
    if let Some(address) = host.address {
        put(&mut table, "address", address.to_string());
        put(&mut table, "control_port", integer(host.control_port));
    }
    if let Some(interface) = &host.interface {
        put(&mut table, "interface", interface.as_str());
    }
    if let Some(clock) = &host.clock {
        put(&mut table, "clock_address", clock.address.to_string());
        put(&mut table, "clock_port", integer(clock.port));
        if let Some(interface) = &clock.interface {
            put(&mut table, "clock_interface", interface.as_str());
        }
    }
    table
}

fn resolved_process(process: &Process) -> Table {
    let mut table = Table::new();
    put(&mut table, "host", process.host.as_str());
    if let Some(role) = process.role() {
        put(&mut table, "role", role);
    }
    if let Program::Command {
        command,
        environment,
        ..
    } = &process.program
    {
        put(&mut table, "run", command.clone());
        let variables = environment.iter();
        let variables: Table = variables
            .map(|(name, value)| (name.clone(), Value::String(value.clone())))
            .collect();
        put(&mut table, "env", variables);
    }
    if let Program::Egm { adapter, .. } = &process.program {
        put(&mut table, "egm", adapter.resolved());
    }
    put_execution(&mut table, &process.execution);
    put_on_exit(&mut table, process.on_exit);
    table
}

fn put_execution(table: &mut Table, execution: &Execution) {
    let cpus: Vec<Value> = execution.cpus.iter().map(|&cpu| integer(cpu)).collect();
    put(table, "cpu", cpus);
    match execution.scheduling {
        Scheduling::Other => put(table, "scheduling", "other"),
        Scheduling::Fifo { priority } => {
            put(table, "scheduling", "fifo");
            put(table, "priority", integer(priority));
        }
    }
    put(table, "lock_memory", execution.locks_memory);
    put(table, "timer_slack", duration(execution.timer_slack));
    put(table, "wait", execution.wait.word());
}

fn put_on_exit(table: &mut Table, on_exit: OnExit) {
    match on_exit {
        OnExit::EndRun => put(table, "on_exit", "end-run"),
        OnExit::Restart { limit } => {
            put(table, "on_exit", "restart");
            put(table, "restart_limit", integer(limit));
        }
    }
}

fn resolved_channel(channel: &Channel) -> Table {
    let mut table = Table::new();
    put(&mut table, "depth", integer(channel.depth));
    if let Some(link) = &channel.link {
        put(&mut table, "link", link.as_str());
    }
    if channel.is_foreign {
        let mut message = Table::new();
        put(&mut message, "name", channel.message.name.as_str());
        put(
            &mut message,
            "size_bytes",
            integer(channel.message.size_bytes),
        );
        put(
            &mut message,
            "alignment_bytes",
            integer(channel.message.alignment_bytes),
        );
        put(&mut table, "message", message);
        put(&mut table, "from", channel.from.as_str());
        if let Some(to) = &channel.to {
            put(&mut table, "to", to.as_str());
        }
    }
    table
}

fn resolved_link(link: &Link) -> Table {
    let mut table = Table::new();
    if let Some(between) = &link.between {
        put(&mut table, "between", between.to_vec());
    }
    put(&mut table, "via", link.via.word());
    match &link.via {
        Via::SharedMemory => {}
        Via::Network(hop) => put_hop(&mut table, hop),
        Via::Emulated(hop, emulation) => {
            put_hop(&mut table, hop);
            let (forward, backward) = (emulation.forward.clone(), emulation.backward.clone());
            // A radio has outages of its own, and the link then has none beside them.
            match forward.wifi {
                Some(mut wifi) => put(&mut table, "wifi", resolved_part(&mut wifi)),
                None => put(
                    &mut table,
                    "outages",
                    resolved_part(&mut { forward.outages }),
                ),
            }
            put(&mut table, "forward", resolved_spec(forward));
            put(&mut table, "backward", resolved_spec(backward));
            if let Some(trace) = &emulation.trace {
                put(&mut table, "trace", resolved_trace(trace));
            }
        }
    }
    table
}

fn put_hop(table: &mut Table, hop: &Hop) {
    put(table, "port", integer(hop.port));
    for (key, value) in &hop.options {
        put(table, key, *value);
    }
    put(table, "dscp", integer(hop.dscp));
    if let Some(priority) = hop.socket_priority {
        put(table, "socket_priority", integer(priority));
    }
    put(table, "send_buffer_bytes", integer(hop.send_buffer_bytes));
    put(
        table,
        "receive_buffer_bytes",
        integer(hop.receive_buffer_bytes),
    );
    put(table, "timestamps", hop.timestamps.word());
    put(table, "path_mtu_bytes", integer(hop.path_mtu_bytes));
    put(table, "gateway", resolved_gateway(&hop.gateway));
}

fn resolved_gateway(gateway: &Gateway) -> Table {
    let mut table = Table::new();
    put_execution(&mut table, &gateway.execution);
    put_on_exit(&mut table, gateway.on_exit);
    table
}
