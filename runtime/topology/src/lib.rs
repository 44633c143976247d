//! The topology file: hosts, processes, channels and links in TOML, read, checked, and written
//! back. It starts nothing and opens no socket.
//!
//! Each table declares its keys once, with type, default, range and meaning: those that stay as they
//! are in `model`, `links`, `adapter`, `security` and `trace_source`, the others in `tables`. Reading
//! goes in steps: [`load`] joins the `extends` chain and the overrides into one tree whose every key
//! remembers its place (`layers`, `tree`); it is read as the declarations say (`reader`); then the tables
//! are checked against each other (`check`) and become a [`Topology`]. Whatever is wrong is collected
//! with file, line and column into [`TopologyErrors`]. The resolved text (`resolved`), the JSON schema and
//! the reference page (`schema`) are made from the declarations too.
//!
//! A program registers its case studies in [`KnownCases`]; [`which_host`] says which host of the
//! topology this machine is; [`RoleSpec`] is all that a process is told.
#![forbid(unsafe_code)]

mod adapter;
mod check;
mod check_adapter;
mod check_channels;
mod check_frames;
mod checks;
mod clock_path;
pub mod documents;
pub mod emulation;
pub mod emulation_room;
mod errors;
mod flows;
mod host;
mod known;
mod layers;
mod links;
mod model;
mod names;
mod ports;
mod reader;
mod recording;
pub mod registry;
mod resolved;
mod role_spec;
mod schema;
mod security;
mod suggest;
mod tables;
pub mod trace_source;
mod tree;
mod units;

use std::path::Path;

pub use adapter::{AdapterKind, AdapterSend, EgmAdapter, SendClock};
pub use check_adapter::{command_channel, feedback_channel};
pub use clock_path::{ClockEnd, ClockPath, describe_end};
pub use errors::{Fault, Location, TopologyError, TopologyErrors};
pub use host::{HOST_VARIABLE, HostChoice, HostError, MachineIdentity, which_host};
pub use known::{KnownCase, KnownCases, ParameterCheck, ReadParameters, check_parameters_with};
pub use links::{Emulation, Gateway, Hop, Link, SocketOptions, Timestamps, Via, transport};
pub use model::{
    AtExit, Case, Channel, Crossing, Execution, Host, LinkPorts, MessageLayout, OnExit, Process,
    Program, Restarts, Run, Scheduling, SchedulingClass, Topology, Wait,
};
pub use names::{CHANNEL_NAME_BYTES_MAX, clock_process_name, gateway_name, witness_name};
pub use ports::{WantedPort, collide, control_key};
pub use recording::{Recording, RecordingRow};
pub use role_spec::{RoleChannel, RoleSpec};
pub use security::{Hops, Security};

pub use units::duration_within;

use check::Needs;
use errors::Place;
use layers::Layers;

/// A duration as topology files write it, such as `40 s`; `None` when it is none.
pub fn read_duration(text: &str) -> Option<std::time::Duration> {
    units::parse_duration(text).ok()
}

/// Reads the topology file at `path` and all it extends, lays the `overrides` (each
/// `key.path=value`) over it, and checks the result against the cases the program knows.
///
/// # Errors
/// Everything that is wrong, each with file, line, column and key.
pub fn load(
    path: &Path,
    overrides: &[String],
    known: &KnownCases,
) -> Result<Topology, TopologyErrors> {
    read_and_check(path, None, overrides, known, Needs::Processes)
}

/// Like [`load`], for whoever wants the case alone: the file need not say where its roles run.
///
/// # Errors
/// As [`load`].
pub fn load_case(
    path: &Path,
    overrides: &[String],
    known: &KnownCases,
) -> Result<Topology, TopologyErrors> {
    read_and_check(path, None, overrides, known, Needs::Case)
}

/// Like [`load_case`], without any file: the case called `name` as it is by default, with the
/// `overrides` laid over it.
///
/// # Errors
/// As [`load`].
pub fn case_by_name(
    name: &str,
    overrides: &[String],
    known: &KnownCases,
) -> Result<Topology, TopologyErrors> {
    let text = format!("version = 1\nname = \"{name}\"\ncase.name = \"{name}\"\n");
    read_and_check(Path::new(name), Some(text), overrides, known, Needs::Case)
}

/// Like [`load`], but from a text; `name` stands in error messages, and what the text extends is
/// looked for beside it.
///
/// # Errors
/// As [`load`].
///
/// ```
/// use hil_shuttle::Shuttle;
/// use hil_topology::{KnownCases, parse};
///
/// let text = r#"
/// version = 1
/// name = "shuttle"
/// case.name = "shuttle"
/// processes.controller.role = "controller"
/// processes.robot.role = "robot"
/// "#;
/// let known = KnownCases::new().with::<Shuttle>();
/// let topology = parse("shuttle.toml", text, &[], &known).unwrap();
/// assert_eq!(topology.channels().len(), 2);
///
/// let wrong = parse("shuttle.toml", text, &["run.duratoin=4 s".to_owned()], &known);
/// assert!(wrong.unwrap_err().to_string().contains("did you mean `duration`?"));
/// ```
pub fn parse(
    name: &str,
    text: &str,
    overrides: &[String],
    known: &KnownCases,
) -> Result<Topology, TopologyErrors> {
    let text = Some(text.to_owned());
    read_and_check(Path::new(name), text, overrides, known, Needs::Processes)
}

/// What is wrong with values that a topology of `path` and `overrides` has and that only their use
/// could show: each key, and why it cannot be used, with the place where the files say it.
pub fn unusable(
    path: &Path,
    overrides: &[String],
    found: impl IntoIterator<Item = (String, String)>,
) -> TopologyErrors {
    let mut layers = Layers::default();
    let mut table = layers.read(path, None).unwrap_or_default();
    for text in overrides {
        layers.lay_override(&mut table, text);
    }
    for (key, why) in found {
        let place = tree::place_of(&table, &key);
        layers.faults.add(key, place, Fault::Unusable(why));
    }
    layers.faults.into_errors(layers.sources)
}

fn read_and_check(
    path: &Path,
    text: Option<String>,
    overrides: &[String],
    known: &KnownCases,
    needs: Needs,
) -> Result<Topology, TopologyErrors> {
    let mut layers = Layers::default();
    let Some(mut table) = layers.read(path, text) else {
        return Err(layers.faults.into_errors(layers.sources));
    };
    for text in overrides {
        layers.lay_override(&mut table, text);
    }
    // The first source is the file that was asked for; what is missing is missing there.
    let top = Place {
        source_index: 0,
        start: 0,
        end: 0,
    };
    let topology = {
        let mut file = tables::File::TEMPLATE;
        reader::read(&mut file, "", &table, top, &layers.faults);
        let checks = checks::Checks {
            tree: &table,
            faults: &layers.faults,
            top,
        };
        check::check(file, known, needs, &checks)
    };
    let topology = topology.with_traces_beside(path).with_key_beside(path);
    if layers.faults.is_empty() {
        Ok(topology)
    } else {
        Err(layers.faults.into_errors(layers.sources))
    }
}

#[cfg(test)]
mod tests;
