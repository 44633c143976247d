//! What each command of the command line does, and the exit code it ends with.

mod case_work;
mod doctor_work;
mod live_work;
mod report_work;

use std::collections::BTreeMap;
use std::env;
use std::fs;
use std::io::{self, ErrorKind, IsTerminal};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{CommandFactory as _, Parser};
use hil_core::case_study::ParameterError;
use hil_core::layout::Field;
use hil_teleoperation::swing::swing_bvh;

use crate::arguments::{Cli, Command, RunArgs};
use crate::cases;
use hil_engine::process::{own_program, worker};
use hil_engine::security::cli::KeyCommand;
use hil_engine::security::{KeyFileError, PreSharedKey};
use hil_engine::supervisor;
use hil_engine::supervisor::{PeerError, RunError, RunOptions};
use hil_nic::card_clock::guard;
use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_platform::signals::{EXIT_INTERRUPTED, Signals};
use hil_probe;
use hil_report::analysis;
use hil_report::analysis::{AnalysisError, Concluded};
use hil_report::compare;
use hil_report::compare::cli::CompareArgs;
use hil_report::terminal;
use hil_report::terminal::Style;
use hil_report::trace;
use hil_rundir::run_result::{Outcome, RunResult};
use hil_topology;
use hil_topology::documents;
use hil_topology::emulation_room::check_emulation;
use hil_topology::registry::Registry;
use hil_topology::trace_source;
use hil_topology::{HOST_VARIABLE, HostChoice, MachineIdentity, Topology, which_host};
use hil_watch::link;
use hil_watch::link::cli::LinkCommand;

/// Exit codes, as `--help` lists them (after `sysexits.h`, which systemd knows).
mod exit {
    pub(crate) const RAN: u8 = 0;
    pub(crate) const FAILED: u8 = 1;
    pub(crate) const USAGE: u8 = 2;
    pub(crate) const PEER_ABSENT: u8 = 69;
    pub(crate) const INTERNAL: u8 = 70;
    pub(crate) const TRY_AGAIN: u8 = 75;
    pub(crate) const FORBIDDEN: u8 = 77;
    pub(crate) const HOST_UNFIT: u8 = 78;
}

/// Does what the command line says.
pub(crate) fn run(registry: &Registry) -> ExitCode {
    let cli = Cli::parse();
    let mut console = Console::new(cli.run.quiet);
    let code = match cli.command {
        None => run_topology(&cli.run, registry, &mut console),
        Some(command) => run_command(command, registry, &mut console),
    };
    ExitCode::from(code)
}

fn run_command(command: Command, registry: &Registry, console: &mut Console) -> u8 {
    match command {
        Command::Worker { launch } => code_of(worker::run(&launch, registry), console),
        Command::Become {
            supervisor,
            program,
        } => code_of(own_program::become_program(supervisor, &program), console),
        Command::CardGuard(args) => code_of(guard::run(&args), console),
        Command::Simulate {
            topology,
            overrides,
            output,
        } => case_work::simulate(&topology, &overrides, output.as_deref(), registry, console),
        Command::Tables {
            topology,
            mut overrides,
            sections,
            batch,
        } => {
            overrides
                .extend(sections.map(|count| format!("case.parameters.tables.sections={count}")));
            case_work::tables(&topology, &overrides, &batch, registry)
        }
        Command::Calibrate(args) => case_work::calibrate(args, registry),
        Command::Replay(args) => case_work::replay(&args.run, args.json, registry, console),
        Command::Report(args) => report_work::report(&args, registry, console),
        Command::Compare(args) => compare(&args, console),
        Command::Trace { command } => match trace::work::work(command, columns(), console) {
            trace::work::End::Done => exit::RAN,
            trace::work::End::Failed => exit::FAILED,
            trace::work::End::Refused => exit::USAGE,
        },
        Command::Link { command } => change_link(&command, console),
        Command::Doctor(args) => doctor_work::doctor(&args, registry, console),
        Command::Channel(args) => live_work::channel(args, registry, console),
        Command::Top(args) => live_work::top(&args, registry, console),
        Command::Probe(args) => hil_probe::run(&args, console),
        Command::Documents { folder } => write_documents(&folder, console),
        Command::Sweep => sweep(),
        Command::Key { command } => key(&command, console),
        Command::Cases => {
            console.result(&cases::list(registry));
            exit::RAN
        }
        Command::Motion {
            output,
            period,
            amplitude,
            rate,
        } => write_motion(
            output.as_deref(),
            swing_bvh(period, amplitude, rate),
            console,
        ),
    }
}

fn write_documents(folder: &Path, console: &mut Console) -> u8 {
    let written = documents::write(Cli::command(), folder)
        .and_then(|_paths| documents::write_schema(&hil_topology::schema(), folder))
        .and_then(|_path| documents::write_robot(folder));
    code_of(written.map(drop), console)
}

fn sweep() -> u8 {
    supervisor::sweep();
    exit::RAN
}

fn compare(args: &CompareArgs, console: &mut Console) -> u8 {
    match compare::work::work(args, console) {
        compare::work::End::Passed => exit::RAN,
        compare::work::End::Failed => exit::FAILED,
        compare::work::End::Refused => exit::USAGE,
    }
}

fn key(command: &KeyCommand, console: &mut Console) -> u8 {
    match command.work() {
        Ok(text) => {
            console.result(&text);
            exit::RAN
        }
        Err(error) => {
            console.error(&error.to_string());
            exit::USAGE
        }
    }
}

fn change_link(command: &LinkCommand, console: &mut Console) -> u8 {
    match link::work::work(command, console) {
        link::work::End::Done => exit::RAN,
        link::work::End::Failed => exit::FAILED,
        link::work::End::Refused => exit::USAGE,
    }
}

fn code_of<E: core::fmt::Display>(outcome: Result<(), E>, console: &mut Console) -> u8 {
    match outcome {
        Ok(()) => exit::RAN,
        Err(error) => {
            console.error(&error.to_string());
            exit::FAILED
        }
    }
}

/// Takes over the signals that end programs, or says why it cannot.
fn signals(console: &mut Console) -> Result<Signals, u8> {
    Signals::install().map_err(|error| {
        console.error(&format!("cannot handle signals: {error}"));
        exit::INTERNAL
    })
}

fn load(
    path: &Path,
    overrides: &[String],
    registry: &Registry,
    console: &mut Console,
) -> Option<Topology> {
    match hil_topology::load(path, overrides, registry.known()) {
        Ok(topology) => Some(topology),
        Err(errors) => {
            console.faults(&errors.render(io::stderr().is_terminal()));
            None
        }
    }
}

fn run_topology(args: &RunArgs, registry: &Registry, console: &mut Console) -> u8 {
    let Some(path) = &args.topology else {
        console.error("no topology given; try --topology deploy/topologies/local.toml or --help");
        return exit::USAGE;
    };
    let Some(topology) = load(path, &args.overrides, registry, console) else {
        return exit::USAGE;
    };
    if let Err(error) = trace_source::check(&topology) {
        console.error(&error.to_string());
        return exit::USAGE;
    }
    // A file is checked anywhere, also where none of its hosts is.
    if args.check && args.host.is_none() {
        return show_check(path, &topology, None, console);
    }
    let hosts = match hosts_here(&topology, args.host.as_deref()) {
        Ok(hosts) => hosts,
        Err(text) => {
            console.error(&text);
            return exit::USAGE;
        }
    };
    if args.check {
        return show_check(path, &topology, Some(&hosts), console);
    }
    let signals = match signals(console) {
        Ok(signals) => signals,
        Err(code) => return code,
    };
    let options = RunOptions {
        hosts,
        domain_root: args.domain_root.clone(),
        topology_file: path.clone(),
        command_line: env::args().collect(),
        layouts: layouts(&topology, registry),
    };
    console.serve();
    match supervisor::run(&topology, &options, &signals, console) {
        Ok(result) => {
            let is_incomplete = result.has_gaps();
            let code = match exit_code(&result.outcome) {
                exit::RAN if is_incomplete => exit::FAILED,
                code => code,
            };
            let origin = (path.as_path(), options.command_line.as_slice());
            let concluded = Progress::begin().during(console, "drawing up the account", |_| {
                let written = result.write().map_err(AnalysisError::from);
                let analysed = written.and_then(|()| analysis::analyse(&result.folder, registry));
                // What the folder cannot give back, because its disk is full, is still in memory.
                analysed.or_else(|error| {
                    let concluded = analysis::conclude(&topology, &result, registry, origin)?;
                    Ok::<_, AnalysisError>(Concluded {
                        unwritten: concluded.unwritten.or(Some(error)),
                        ..concluded
                    })
                })
            });
            match concluded {
                Ok(Concluded { summary, unwritten }) => {
                    console.result(&terminal::render(&summary, columns(), Style::Coloured));
                    if code != exit::RAN {
                        console.error(&complaint(&result));
                    }
                    let Some(error) = unwritten else { return code };
                    console.error(&format!("{error}; the report is only what is printed here"));
                    code.max(exit::FAILED)
                }
                Err(error) => {
                    console.error(&format!("the run is over but its report failed: {error}"));
                    exit::INTERNAL
                }
            }
        }
        Err(error) => {
            console.error(&error.to_string());
            exit_code_of_error(&error)
        }
    }
}

/// The fields of the messages of the topology's case, by channel.
fn layouts(topology: &Topology, registry: &Registry) -> BTreeMap<String, &'static [Field]> {
    let entry = topology.case().and_then(|case| registry.find(&case.name));
    let channels = entry.into_iter().flat_map(|entry| entry.channels);
    channels
        .map(|channel| (channel.name.to_owned(), channel.message.fields))
        .collect()
}

/// The key that these hosts, which are this machine, would hold in a run with others.
///
/// # Errors
/// When its file cannot be used here.
fn key_here(
    topology: &Topology,
    hosts: &[String],
) -> Result<Option<(PathBuf, PreSharedKey)>, KeyFileError> {
    let has_others = topology.has_hosts_beside(hosts.len());
    let file = topology.security().key_file().filter(|_| has_others);
    file.map(|path| PreSharedKey::read(&path).map(|key| (path, key)))
        .transpose()
}

/// What the file comes to, or why no run of it can be what it says; with `hosts`, which are this
/// machine, also which key is here.
fn show_check(
    path: &Path,
    topology: &Topology,
    hosts: Option<&[String]>,
    console: &mut Console,
) -> u8 {
    if let Err(error) = check_emulation(topology) {
        console.error(&format!(
            "{}: the file is valid and can be simulated, but no gateway can keep its emulated \
             link: {error}",
            path.display()
        ));
        return exit::USAGE;
    }
    if let Some(text) = topology.unsaid_security() {
        console.error(&format!("{}: {text}", path.display()));
        return exit::USAGE;
    }
    // As comments, so that what is printed is a topology as a whole.
    let clock_paths = topology.clock_paths().map(|clock| {
        let (asking, answering) = (clock.asking.port(), clock.answering.port());
        let words = clock.describe();
        format!("\n# {words}, UDP ports {asking} and {answering}\n")
    });
    let key = match hosts.map_or(Ok(None), |hosts| key_here(topology, hosts)) {
        Ok(key) => key,
        Err(error) => {
            console.error(&error.to_string());
            return exit::FORBIDDEN;
        }
    };
    let key = key.map(|(file, key)| {
        let (file, fingerprint) = (file.display(), key.fingerprint());
        format!("\n# {file}: the key {fingerprint}, which the other hosts must have as well\n")
    });
    console.result(&format!(
        "# {}: the file is valid; it comes to\n\n{}{}{}",
        path.display(),
        topology.to_toml(),
        clock_paths.collect::<Vec<_>>().concat(),
        key.unwrap_or_default()
    ));
    exit::RAN
}

/// Why a run does not end with exit code 0, for those who do not read its report.
fn complaint(result: &RunResult) -> String {
    let is_incomplete = result.has_gaps() && exit_code(&result.outcome) == exit::RAN;
    if is_incomplete {
        "the report is incomplete; see its warnings".to_owned()
    } else {
        result.outcome.text()
    }
}

/// For a run that did not come about.
fn exit_code_of_error(error: &RunError) -> u8 {
    match error {
        RunError::Peer(PeerError::Absent { .. } | PeerError::Connection { .. })
        | RunError::SecretMissing(_) => exit::PEER_ABSENT,
        RunError::Folder { source, .. } if source.kind() == ErrorKind::PermissionDenied => {
            exit::FORBIDDEN
        }
        RunError::Peer(PeerError::Key { .. }) | RunError::Key(_) => exit::FORBIDDEN,
        RunError::Peer(PeerError::Listen { source, .. } | PeerError::Own { source, .. })
            if is_passing(source) =>
        {
            exit::TRY_AGAIN
        }
        RunError::Folder { .. }
        | RunError::SecurityUnsaid(_)
        | RunError::Emulation(_)
        | RunError::Peer(
            PeerError::Mismatch { .. } | PeerError::Listen { .. } | PeerError::Own { .. },
        ) => exit::USAGE,
        RunError::Peer(PeerError::Interrupted { .. }) => interrupted(),
        RunError::Start(_) => exit::FAILED,
        RunError::Domains(_) | RunError::Identity(_) | RunError::Random(_) => exit::INTERNAL,
    }
}

/// An address may be given to an interface later, as when a host starts; a port becomes free.
fn is_passing(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::AddrNotAvailable | ErrorKind::AddrInUse
    )
}

fn interrupted() -> u8 {
    u8::try_from(EXIT_INTERRUPTED).unwrap_or(exit::INTERNAL)
}

fn exit_code(outcome: &Outcome) -> u8 {
    match outcome {
        Outcome::Completed | Outcome::EndedEarly(_) => exit::RAN,
        Outcome::Interrupted(_) => interrupted(),
        Outcome::Failed(_) | Outcome::EndedByPeer(_) => exit::FAILED,
        Outcome::PeerLost(_) => exit::PEER_ABSENT,
    }
}

fn hosts_here(topology: &Topology, requested: Option<&str>) -> Result<Vec<String>, String> {
    let machine = MachineIdentity::gather().map_err(|errno| {
        format!(
            "cannot read this machine's name and addresses: {}",
            errno.desc()
        )
    })?;
    let environment = env::var(HOST_VARIABLE).ok();
    match which_host(topology, requested, environment.as_deref(), &machine) {
        Ok(HostChoice::One(name)) => Ok(vec![name]),
        Ok(HostChoice::All) => Ok(topology
            .hosts()
            .iter()
            .map(|host| host.name.clone())
            .collect()),
        Err(error) => Err(error.to_string()),
    }
}

/// Columns of the terminal; where there is none, a page's.
fn columns() -> usize {
    columns_or(100)
}

/// Columns of the terminal, or of what is written where there is none.
fn columns_or(otherwise: usize) -> usize {
    let said = env::var("COLUMNS").ok();
    said.and_then(|text| text.parse().ok()).unwrap_or(otherwise)
}

fn write_motion(
    output: Option<&Path>,
    text: Result<String, ParameterError>,
    console: &mut Console,
) -> u8 {
    let text = match text {
        Ok(text) => text,
        Err(error) => {
            console.error(&error.to_string());
            return exit::USAGE;
        }
    };
    let Some(path) = output else {
        console.result(&text);
        return exit::RAN;
    };
    match fs::write(path, text) {
        Ok(()) => {
            console.say(&format!("wrote {}", path.display()));
            exit::RAN
        }
        Err(error) => {
            console.error(&format!("{}: {error}", path.display()));
            exit::FAILED
        }
    }
}
