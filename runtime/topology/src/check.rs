//! What the tables say about each other: hosts and processes. Channels and links follow in
//! `check_channels`. Nothing is read here; the result is the checked topology.

use hil_core::case_study::ParameterError;
use hil_core::options::Options;

use super::check_adapter::{check_adapter, check_adapters, is_dispensable};
use super::check_channels;
use super::check_frames;
use super::checks::Checks;
use super::clock_path;
use super::errors::Fault;
use super::flows::{self, Flow};
use super::known::{KnownCase, KnownCases};
use super::model::{Case, Host, OnExit, Process, Program, Topology};
use super::reader;
use super::tables::{CaseTable, File, ProcessTable};
use super::tree::{self, Table, Value, join};

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

/// Checks `file`; the result is meaningless if anything is refused.
pub(super) fn check(file: File, known: &KnownCases, needs: Needs, checks: &Checks<'_>) -> Topology {
    if file.extends.is_some() {
        // Layers take it out of files, so it can only come from an override.
        checks.refuse_because("extends", "is read from files only, not from an override");
    }
    let runs_nothing = file.processes.0.is_empty() && needs == Needs::Case;
    let known_case = file.case.as_ref();
    let known_case = known_case.and_then(|case| find_case(case, known, checks));
    let case = known_case.and_then(|known| check_case(known, file.run.seed, checks));
    let hosts = check_hosts(file.hosts.0.into_iter(), checks);
    let roles = Roles {
        known: known_case,
        has_case: file.case.is_some(),
        checked: case.as_ref(),
    };
    if file.processes.0.is_empty() && !runs_nothing {
        let hint = "a topology has at least one [processes.<name>]";
        checks.refuse_at("processes".to_owned(), "", Fault::Missing(hint.to_owned()));
    }
    let processes = check_processes(file.processes.0.into_iter(), &hosts, &roles, checks);
    check_adapters(&processes, case.as_ref(), checks);
    if let (Some(known), false) = (known_case, runs_nothing) {
        check_every_role_is_played(known, &processes, checks);
    }
    let mut topology = Topology {
        name: file.name,
        run: file.run,
        case,
        hosts,
        processes,
        channels: Vec::new(),
        links: Vec::new(),
        flows: (file.flows.0.into_iter())
            .map(|(name, flow)| Flow { name, ..flow })
            .collect(),
        security: file.security.resolve(),
    };
    let links = check_channels::routes(&file.links.0, checks);
    // Without the case, its channels would look like foreign ones.
    if known_case.is_some() || file.case.is_none() {
        check_channels::check(&mut topology, known_case, &file.channels.0, links, checks);
        check_frames::check(&topology, checks);
        flows::check(&topology, checks);
    }
    clock_path::check(&topology, checks);
    topology
}

fn find_case<'k>(
    case: &CaseTable,
    known: &'k KnownCases,
    checks: &Checks<'_>,
) -> Option<&'k KnownCase> {
    let allowed = || known.names().map(str::to_owned).collect::<Vec<_>>();
    let Some(name) = &case.name else {
        let hint = format!("one of {}", super::suggest::listed(&allowed()));
        checks.refuse("case.name", Fault::Missing(hint));
        return None;
    };
    let found = known.get(name);
    if found.is_none() {
        let fault = Fault::UnknownWord {
            value: name.clone(),
            expected: "a case study of this program",
            allowed: allowed(),
        };
        checks.refuse("case.name", fault);
    }
    found
}

fn check_case(known: &KnownCase, seed: u64, checks: &Checks<'_>) -> Option<Case> {
    let path = "case.parameters";
    let (empty, node) = (Table::new(), tree::find(checks.tree, path));
    let table = match node.map(|node| &node.value) {
        Some(Value::Table(table)) => table,
        _ => &empty,
    };
    let place = node.map_or(checks.top, |node| node.key_place);
    let mut read =
        |options: &mut dyn Options| reader::read(options, path, table, place, checks.faults);
    let checked = (known.check_parameters)(&mut read, seed);
    let refuse = |error: ParameterError| {
        // A key may end in an index, as in `bays[2]`, which needs no quotes.
        let below = |path: String, step: &str| match step.split_once('[') {
            Some((key, index)) => format!("{}[{index}", join(&path, key)),
            None => join(&path, step),
        };
        let key = error.key.split('.').fold(path.to_owned(), below);
        // A parameter left at its default has no line: then the fault is at that of its table.
        checks.refuse(key, Fault::Parameter(error.problem));
    };
    Some(Case {
        name: known.name.to_owned(),
        parameters: checked.map_err(refuse).ok()??,
    })
}

/// The hosts by name.
fn check_hosts(tables: impl Iterator<Item = (String, Host)>, checks: &Checks<'_>) -> Vec<Host> {
    let named = |(name, host)| Host { name, ..host };
    let hosts: Vec<Host> = tables.map(named).collect();
    if hosts.is_empty() {
        let name = IMPLICIT_HOST.to_owned();
        return vec![named((name, Host::TEMPLATE))];
    }
    let with_address = hosts.iter().find(|host| host.address.is_some());
    for (index, host) in hosts.iter().enumerate() {
        let key = join(&join("hosts", &host.name), "address");
        if let (None, Some(other)) = (host.address, with_address) {
            let hint = format!("host `{}` has one, so every host needs one", other.name);
            checks.refuse(key, Fault::Missing(hint));
            continue;
        }
        let same = |earlier: &&Host| {
            host.control_address().is_some() && earlier.control_address() == host.control_address()
        };
        if let Some(earlier) = hosts[..index].iter().find(same) {
            let other = &earlier.name;
            checks.refuse_because(
                key,
                format!("and control_port are those of host `{other}` already"),
            );
        }
    }
    hosts
}

/// What a process may say as its role.
struct Roles<'k> {
    known: Option<&'k KnownCase>,
    has_case: bool,
    /// The case, unless its parameters were refused.
    checked: Option<&'k Case>,
}

fn check_processes(
    tables: impl Iterator<Item = (String, ProcessTable)>,
    hosts: &[Host],
    roles: &Roles<'_>,
    checks: &Checks<'_>,
) -> Vec<Process> {
    let mut processes: Vec<Process> = Vec::new();
    for (name, table) in tables {
        let path = join("processes", &name);
        let role = check_role(&table, &path, roles, &processes, checks);
        let adapter = table.egm.zip(roles.known).zip(role.as_ref());
        let adapter = adapter.and_then(|((adapter, case), role)| {
            check_adapter(adapter, &join(&path, "egm"), role, case, checks)
        });
        let program = match (table.run, role, adapter) {
            (Some(command), role, _) => Program::Command {
                role,
                command,
                environment: table.env,
                inside: table.inside,
            },
            (None, Some(role), Some(adapter)) => Program::Egm { role, adapter },
            (None, role, _) => Program::BuiltIn {
                role: role.unwrap_or_default(),
            },
        };
        processes.push(Process {
            name,
            host: check_host(table.host, &path, hosts, checks),
            program,
            execution: table.execution,
            restarts: table.restarts,
        });
    }
    processes
}

fn check_role(
    table: &ProcessTable,
    path: &str,
    roles: &Roles<'_>,
    earlier: &[Process],
    checks: &Checks<'_>,
) -> Option<String> {
    let role = table.role.as_ref()?;
    let refuse = |fault| checks.refuse(join(path, "role"), fault);
    let Some(case) = roles.known else {
        if !roles.has_case {
            let fault = format!("`{role}` needs a [case] that has this role");
            refuse(Fault::Inconsistent(fault));
        }
        return None;
    };
    if !case.roles.contains(&role.as_str()) {
        refuse(Fault::UnknownWord {
            value: role.clone(),
            expected: "a role of the case",
            allowed: case.roles.iter().map(|&role| role.to_owned()).collect(),
        });
        return None;
    }
    // An adapter knows nothing of the world that it could be wrong about.
    let has_memory = table.egm.is_none();
    let may_restart = roles
        .checked
        .is_none_or(|checked| (case.may_restart)(&checked.parameters, role));
    if !may_restart && has_memory && table.restarts.on_exit() != OnExit::EndRun {
        let problem = format!(
            "`{role}` of case {} with these parameters, started anew, would be wrong about the \
             world; use \"end-run\"",
            case.name
        );
        checks.refuse_because(join(path, "on_exit"), problem);
    }
    let same = |process: &&Process| process.role() == Some(role);
    if let Some(other) = earlier.iter().find(same) {
        let fault = format!("`{role}` is played by process `{}` already", other.name);
        refuse(Fault::Inconsistent(fault));
    }
    Some(role.clone())
}

fn check_host(host: Option<String>, path: &str, hosts: &[Host], checks: &Checks<'_>) -> String {
    let names = || hosts.iter().map(|host| host.name.clone());
    let key = join(path, "host");
    let Some(host) = host else {
        if let [only] = hosts {
            return only.name.clone();
        }
        let hint = format!(
            "one of {}",
            super::suggest::listed(&names().collect::<Vec<_>>())
        );
        checks.refuse(key, Fault::Missing(hint));
        return String::new();
    };
    if !hosts.iter().any(|known| known.name == host) {
        let fault = Fault::UnknownWord {
            value: host.clone(),
            expected: "a host of this file",
            allowed: names().collect(),
        };
        checks.refuse(key, fault);
    }
    host
}

fn check_every_role_is_played(case: &KnownCase, processes: &[Process], checks: &Checks<'_>) {
    for role in case.roles {
        let is_played = |process: &Process| process.role() == Some(role);
        // A role that a faulty process meant to play is not missing.
        if !processes.iter().any(is_played)
            && checks.is_clean()
            && !is_dispensable(role, case, processes)
        {
            let hint = format!("no process plays role `{role}` of case `{}`", case.name);
            checks.refuse_at("processes".to_owned(), "case", Fault::Missing(hint));
        }
    }
}
