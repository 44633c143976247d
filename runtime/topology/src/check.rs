//! What the tables say about each other: hosts and processes. Channels and links follow in
//! `check_channels`. Nothing is read here; the result is the checked topology.

use super::adapter::EgmAdapter;
use super::check_adapter::{check_adapter, check_adapters, is_dispensable};
use super::clock_path::{self, ClockEntry};
use super::errors::{Fault, Faults, Place};
use super::file::{CaseEntry, File, HostEntry, ProcessEntry};
use super::known::{KnownCase, KnownCases, ParameterFault};
use super::model::{Case, Host, OnExit, Process, Program, Topology};
use super::reader::At;
use super::tree::{Node, Table, Value, join, to_plain_table};
use super::{check_channels, limits};

/// Name of the host of a file without `[hosts]`.
const IMPLICIT_HOST: &str = "local";

/// What a file must say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Needs {
    /// Where every role runs.
    Processes,
    /// The case; a file without any process is complete.
    Case,
}

/// Checks `file`; the result is meaningless if `faults` is not empty afterwards.
pub(super) fn check(file: File<'_>, known: &KnownCases, needs: Needs, faults: &Faults) -> Topology {
    let runs_nothing = file.processes.is_empty() && needs == Needs::Case;
    let case_entry = file.case.as_ref();
    let known_case = case_entry.and_then(|entry| find_case(entry, known, faults));
    let case = match (case_entry, known_case) {
        (Some(entry), Some(known)) => check_case(entry, known, file.run.seed, faults),
        _ => None,
    };
    let (hosts, clock_entries) = check_hosts(file.hosts, faults);
    let roles = Roles {
        known: known_case,
        has_case: case_entry.is_some(),
    };
    if file.processes.is_empty() && !runs_nothing {
        let hint = "a topology has at least one [processes.<name>]";
        faults.add(
            "processes",
            Some(file.place),
            Fault::Missing(hint.to_owned()),
        );
    }
    let processes = check_processes(&file.processes, &hosts, &roles, faults);
    let written = case_entry.and_then(|entry| entry.parameters);
    check_adapters(&file.processes, &processes, case.as_ref(), written, faults);
    if let (Some(entry), Some(known), false) = (case_entry, known_case, runs_nothing) {
        check_every_role_is_played(known, &processes, entry.place, faults);
    }
    let mut topology = Topology {
        name: file.name,
        run: file.run,
        case,
        hosts,
        processes,
        channels: Vec::new(),
        links: Vec::new(),
        security: file.security,
    };
    // Without the case, its channels would look like foreign ones.
    if known_case.is_some() || case_entry.is_none() {
        let tables = check_channels::Tables {
            channels: &file.channels,
            processes: &file.processes,
        };
        check_channels::check(&mut topology, known_case, tables, file.links, faults);
    }
    clock_path::check(&topology, &clock_entries, faults);
    topology
}

fn find_case<'k>(
    entry: &CaseEntry<'_>,
    known: &'k KnownCases,
    faults: &Faults,
) -> Option<&'k KnownCase> {
    let allowed = || known.names().map(str::to_owned).collect::<Vec<_>>();
    let Some(name) = &entry.name else {
        let fault = Fault::Missing(format!("one of {}", super::suggest::listed(&allowed())));
        faults.add("case.name", Some(entry.place), fault);
        return None;
    };
    let case = known.get(&name.value);
    if case.is_none() {
        let fault = Fault::UnknownWord {
            value: name.value.clone(),
            expected: "a case study of this program",
            allowed: allowed(),
        };
        faults.add("case.name", Some(name.place), fault);
    }
    case
}

fn check_case(
    entry: &CaseEntry<'_>,
    known: &KnownCase,
    seed: u64,
    faults: &Faults,
) -> Option<Case> {
    let empty = Table::new();
    let table = entry.parameters.unwrap_or(&empty);
    match (known.check_parameters)(&to_plain_table(table), seed) {
        Ok(parameters) => Some(Case {
            name: known.name.to_owned(),
            parameters,
        }),
        Err(found) => {
            for fault in found {
                add_parameter_fault(fault, table, entry.place, faults);
            }
            None
        }
    }
}

/// Finds the line of a parameter; a parameter left at its default has none, then the case's. A
/// key may end in an index, as in `bays[2]`.
fn add_parameter_fault(fault: ParameterFault, table: &Table, place: Place, faults: &Faults) {
    let mut path = "case.parameters".to_owned();
    let mut below = Some(table);
    let mut deepest: Option<&Node> = None;
    for step in &fault.key {
        let (key, index) = split_index(step);
        path = join(&path, key);
        let node = below.and_then(|table| table.get(key));
        let item = match (node.map(|node| &node.value), index) {
            (Some(Value::Array(items)), Some(index)) => items.get(index),
            _ => None,
        };
        if let Some(index) = index {
            path = format!("{path}[{index}]");
        }
        let Some(node) = item.or(node) else {
            break;
        };
        deepest = Some(node);
        below = match &node.value {
            Value::Table(table) => Some(table),
            _ => None,
        };
    }
    let place = deepest.map_or(place, |node| {
        if fault.is_unknown_key {
            node.key_place
        } else {
            node.place
        }
    });
    let fault = if fault.is_unknown_key {
        Fault::UnknownKey {
            allowed: fault.valid_keys,
        }
    } else {
        Fault::Parameter(fault.message)
    };
    faults.add(path, Some(place), fault);
}

/// `bays[2]` as `bays` and 2.
fn split_index(step: &str) -> (&str, Option<usize>) {
    let parts = step.strip_suffix(']').and_then(|rest| rest.split_once('['));
    let found = parts.and_then(|(key, index)| Some((key, index.parse().ok()?)));
    found.map_or((step, None), |(key, index)| (key, Some(index)))
}

/// The hosts, and where the clock address of each stands.
fn check_hosts(entries: Vec<HostEntry>, faults: &Faults) -> (Vec<Host>, Vec<Option<ClockEntry>>) {
    if entries.is_empty() {
        let host = Host {
            name: IMPLICIT_HOST.to_owned(),
            address: None,
            interface: None,
            control_port: u16::try_from(limits::HOST_CONTROL_PORT.default)
                .expect("a default port is within 1..=65535"),
            clock: None,
        };
        return (vec![host], vec![None]);
    }
    let with_address = entries.iter().find(|entry| entry.host.address.is_some());
    let with_address = with_address.map(|entry| entry.host.name.clone());
    for (index, entry) in entries.iter().enumerate() {
        let host = &entry.host;
        let key = join(&entry.path, "address");
        if let (None, Some(other)) = (host.address, &with_address) {
            let hint = format!("host `{other}` has one, so every host needs one");
            faults.add(key, Some(entry.place), Fault::Missing(hint));
            continue;
        }
        let same = |earlier: &&HostEntry| {
            host.control_address().is_some()
                && earlier.host.control_address() == host.control_address()
        };
        if let Some(earlier) = entries[..index].iter().find(same) {
            let other = &earlier.host.name;
            let fault = format!("and control_port are those of host `{other}` already");
            faults.add(key, Some(entry.place), Fault::Inconsistent(fault));
        }
    }
    let hosts = entries.into_iter().map(|entry| (entry.host, entry.clock));
    hosts.unzip()
}

/// What a process may say as its role.
struct Roles<'k> {
    known: Option<&'k KnownCase>,
    has_case: bool,
}

fn check_processes(
    entries: &[ProcessEntry],
    hosts: &[Host],
    roles: &Roles<'_>,
    faults: &Faults,
) -> Vec<Process> {
    let mut processes: Vec<Process> = Vec::new();
    for entry in entries {
        let role = entry
            .role
            .as_ref()
            .and_then(|role| check_role(entry, role, roles, &processes, faults));
        let adapter = entry.egm.as_ref().zip(roles.known).zip(role.as_ref());
        let adapter =
            adapter.and_then(|((adapter, case), role)| check_adapter(adapter, role, case, faults));
        processes.push(Process {
            name: entry.name.clone(),
            host: check_host(entry, hosts, faults),
            program: program(entry, role, adapter),
            execution: entry.execution.clone(),
            on_exit: entry.on_exit,
        });
    }
    processes
}

fn program(entry: &ProcessEntry, role: Option<String>, adapter: Option<EgmAdapter>) -> Program {
    match (&entry.command, role, adapter) {
        (Some(command), role, _) => Program::Command {
            role,
            command: command.clone(),
            environment: entry.environment.clone(),
        },
        (None, Some(role), Some(adapter)) => Program::Egm { role, adapter },
        (None, role, _) => Program::BuiltIn {
            role: role.unwrap_or_default(),
        },
    }
}

fn check_role(
    entry: &ProcessEntry,
    role: &At<String>,
    roles: &Roles<'_>,
    earlier: &[Process],
    faults: &Faults,
) -> Option<String> {
    let add = |fault| faults.add(join(&entry.path, "role"), Some(role.place), fault);
    let Some(case) = roles.known else {
        if !roles.has_case {
            add(Fault::Inconsistent(format!(
                "`{}` needs a [case] that has this role",
                role.value
            )));
        }
        return None;
    };
    if !case.roles.contains(&role.value.as_str()) {
        add(Fault::UnknownWord {
            value: role.value.clone(),
            expected: "a role of the case",
            allowed: case.roles.iter().map(|&role| role.to_owned()).collect(),
        });
        return None;
    }
    // An adapter knows nothing of the world that it could be wrong about.
    let has_memory = entry.egm.is_none();
    if !case.may_restart && has_memory && entry.on_exit != OnExit::EndRun {
        let problem = format!(
            "a role of case {} started anew would be wrong about the world; use \"end-run\"",
            case.name
        );
        let key = join(&entry.path, "on_exit");
        faults.add(key, Some(role.place), Fault::Inconsistent(problem));
    }
    let same = |process: &&Process| process.role() == Some(&role.value);
    if let Some(other) = earlier.iter().find(same) {
        let (role, other) = (&role.value, &other.name);
        add(Fault::Inconsistent(format!(
            "`{role}` is played by process `{other}` already"
        )));
    }
    Some(role.value.clone())
}

fn check_host(entry: &ProcessEntry, hosts: &[Host], faults: &Faults) -> String {
    let names = || {
        hosts
            .iter()
            .map(|host| host.name.clone())
            .collect::<Vec<_>>()
    };
    let key = join(&entry.path, "host");
    let Some(host) = &entry.host else {
        if let [only] = hosts {
            return only.name.clone();
        }
        let hint = format!("one of {}", super::suggest::listed(&names()));
        faults.add(key, Some(entry.place), Fault::Missing(hint));
        return String::new();
    };
    if !hosts.iter().any(|known| known.name == host.value) {
        let fault = Fault::UnknownWord {
            value: host.value.clone(),
            expected: "a host of this file",
            allowed: names(),
        };
        faults.add(key, Some(host.place), fault);
    }
    host.value.clone()
}

fn check_every_role_is_played(
    case: &KnownCase,
    processes: &[Process],
    place: Place,
    faults: &Faults,
) {
    for role in case.roles {
        let is_played = |process: &Process| process.role() == Some(role);
        // A role that a faulty process meant to play is not missing.
        if !processes.iter().any(is_played)
            && faults.is_empty()
            && !is_dispensable(role, case, processes)
        {
            let hint = format!("no process plays role `{role}` of case `{}`", case.name);
            faults.add("processes", Some(place), Fault::Missing(hint));
        }
    }
}
