//! The checked topology written back: every default spelled out, in the shape of the file. It is
//! what a run's manifest keeps and what two hosts compare.

use std::collections::BTreeMap;
use std::time::Duration;

use hil_core::message::{FNV_OFFSET, fnv1a};
use hil_core::options::{Options, Setting, Shape, Slot};
use serde::Serialize;
use toml::{Table, Value};

use super::model::{Channel, Process, Program, Topology};
use super::tables::{ChannelTable, ProcessTable};
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

    fn resolved_with(&self, has_places: bool) -> Table {
        let mut table = Table::new();
        put(&mut table, "version", 1);
        put(&mut table, "name", self.name.as_str());
        let mut run = written(&mut self.run.clone());
        if !has_places {
            run.remove("record");
        }
        put(&mut table, "run", run);
        if let Some(case) = &self.case {
            let mut case_table = Table::new();
            put(&mut case_table, "name", case.name.as_str());
            put(&mut case_table, "parameters", case.parameters.clone());
            put(&mut table, "case", case_table);
        }
        let hosts = self.hosts.iter();
        let hosts = hosts.map(|host| (host.name.clone(), written(&mut host.clone())));
        put_named(&mut table, "hosts", hosts);
        let processes = self.processes.iter();
        let processes = processes.map(|process| (process.name.clone(), process.resolved()));
        put_named(&mut table, "processes", processes);
        // What is only recorded has nothing to set, and a file that says otherwise is refused.
        let channels = self.channels.iter();
        let channels = channels.filter(|channel| !channel.is_recorded_only());
        let channels =
            channels.map(|channel| (channel.name.clone(), written(&mut channel.table())));
        put_named(&mut table, "channels", channels);
        let links = self.links.iter();
        let links = links.map(|link| (link.name.clone(), link.resolved()));
        put_named(&mut table, "links", links);
        let flows = self.flows.iter();
        let flows = flows.map(|flow| (flow.name.clone(), written(&mut flow.clone())));
        put_named(&mut table, "flows", flows);
        if self.security.hops.is_some() {
            let mut security = written(&mut self.security.clone());
            if !has_places {
                security.remove("key");
            }
            put(&mut table, "security", security);
        }
        table
    }

    /// 64-bit FNV-1a of [`Topology::to_toml`] but for the places of the key file and of the run's folder, which are each
    /// host's own: equal on two hosts that mean the same run.
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
}

/// The resolved form, as in [`Topology::resolved`].
impl Serialize for Topology {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.resolved().serialize(serializer)
    }
}

impl Process {
    fn resolved(&self) -> Table {
        let (run, env) = match &self.program {
            Program::Command {
                command,
                environment,
                ..
            } => (Some(command.clone()), environment.clone()),
            _ => (None, BTreeMap::default()),
        };
        let egm = match &self.program {
            Program::Egm { adapter, .. } => Some(adapter.clone()),
            _ => None,
        };
        written(&mut ProcessTable {
            host: Some(self.host.clone()),
            role: self.role().map(str::to_owned),
            run,
            env,
            inside: self.inside(),
            egm,
            execution: self.execution.clone(),
            restarts: self.restarts,
        })
    }
}

impl Channel {
    fn table(&self) -> ChannelTable {
        let foreign = self.is_foreign.then_some(self);
        ChannelTable {
            depth: Some(self.depth),
            link: self.link.clone(),
            message: foreign.map(|channel| channel.message.clone()),
            from: foreign.map(|channel| channel.from.clone()),
            to: foreign.and_then(|channel| channel.to.clone()),
            demand: self.demand.clone(),
        }
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

/// Every option of a table.
fn written(options: &mut dyn Options) -> Table {
    let mut table = Table::new();
    write(options, &mut table);
    table
}

/// Adds every option that has a meaning to `table`. A value that stands in place of a table is written
/// where it says all that the table does.
pub(super) fn write(options: &mut dyn Options, table: &mut Table) {
    let fields = options.fields().into_iter();
    for field in fields.filter(|field| field.condition.is_none_or(|condition| condition.is_met)) {
        let key = field.key;
        match field.slot {
            Slot::Value(value, shape) => {
                if let Some(setting) = value.get() {
                    put(table, key, plain(&setting, &shape));
                }
            }
            Slot::Table(mut slot) => {
                if let Some(short) = slot.shorthand()
                    && let Some(setting) = short.value.get()
                {
                    put(table, short.key, plain(&setting, &short.shape));
                    continue;
                }
                let chosen = slot
                    .templates()
                    .and_then(|one| Some((one.key, one.chosen?)));
                let Some(options) = slot.options() else {
                    continue;
                };
                let mut below = written(options);
                if let Some((key, name)) = chosen {
                    put(&mut below, key, name);
                }
                put(table, key, below);
            }
            Slot::Part(part) => write(part, table),
            // The file as a whole is not written from its declaration: what it lacks is filled in.
            Slot::Tables(..) | Slot::Rows(_) | Slot::Free => {}
        }
    }
}

/// A value as TOML has it.
pub(super) fn plain(setting: &Setting, shape: &Shape) -> Value {
    match (setting, shape) {
        (Setting::Number(seconds), Shape::Time(_)) => {
            Value::String(format_duration(Duration::from_secs_f64(*seconds)))
        }
        (Setting::List(items), Shape::List(each) | Shape::OneOrMore(each)) => {
            Value::Array(items.iter().map(|item| plain(item, each)).collect())
        }
        (Setting::Boolean(value), _) => Value::from(*value),
        (Setting::Integer(value), _) => Value::from(*value),
        (Setting::Number(value), _) => Value::from(*value),
        (Setting::Time(value), _) => Value::String(format_duration(*value)),
        (Setting::Text(text), _) => Value::from(text.as_str()),
        (Setting::List(items), _) => {
            Value::Array(items.iter().map(|item| plain(item, shape)).collect())
        }
        (Setting::Texts(texts), _) => {
            let texts = texts.iter();
            Value::Table(
                texts
                    .map(|(name, text)| (name.clone(), text.as_str().into()))
                    .collect(),
            )
        }
    }
}
