//! What each command of the command line does, and the exit code it ends with.

mod case_work;
mod doctor_work;
mod join_work;
mod live_work;
mod record_work;
mod report_work;

use core::fmt::Display;
use std::collections::BTreeMap;
use std::io::{self, ErrorKind, IsTerminal};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};
use std::{env, fs, thread};

use clap::CommandFactory as _;
use hil_core::case_study::ParameterError;
use hil_core::layout::Field;
use hil_teleoperation::swing::swing_bvh;

use crate::arguments::{Cli, Command, RunArgs};
use crate::cases;
use hil_doctor::{Effect, Obstacle, Plan, Trouble, obstacles};
use hil_engine::process::again::Beside;
use hil_engine::process::host::{self, HostsError};
use hil_engine::process::own_program::{self, OwnProgramError};
use hil_engine::process::worker;
use hil_engine::security::{KeyFileError, PreSharedKey};
use hil_engine::supervisor::{
    self, ClaimError, Claims, DomainsError, HostTooSmall, PeerError, RunError, RunOptions,
    Shortfall,
};
use hil_nic::nic_clock::guard;
use hil_platform::console::{CommandEnd, Console};
use hil_platform::open_files;
use hil_platform::own_process;
use hil_platform::progress::Progress;
use hil_platform::signals::{EXIT_INTERRUPTED, Signals};
use hil_report::analysis::{self, AnalysisError, Concluded};
use hil_report::terminal;
use hil_report::{compare, trace};
use hil_rundir::file_fault::is_of_full_disk;
use hil_rundir::pipe::FailureKind;
use hil_rundir::run_result::{Outcome, RunResult};
use hil_topology::emulation_room::check_emulation;
use hil_topology::registry::Registry;
use hil_topology::{
    HOST_VARIABLE, HostChoice, MachineIdentity, Topology, TopologyErrors, documents, trace_source,
    which_host,
};
use hil_watch::link;

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
    if let Err(error) = own_process::begin() {
        Console::new(false).error(&format!("cannot begin: {error}"));
        return ExitCode::from(exit::INTERNAL);
    }
    let mut cli: Cli = match documents::command_line() {
        Ok(cli) => cli,
        Err(help) => {
            let mut console = Console::new(false);
            console.result(&help);
            return ExitCode::from(console.exit_code(exit::RAN));
        }
    };
    let mut console = Console::new(cli.run.quiet);
    // A run has files open for each channel, and so has whoever watches one. Where the kernel refuses,
    // the limit stays, which a run compares with what it needs.
    let _is_raised = open_files::raise_limit().is_ok();
    let outcome = match cli.command {
        None => run_topology(&mut cli.run, registry, &mut console),
        Some(command) => run_command(command, registry, &mut console),
    };
    let code = outcome.unwrap_or_else(|refusal| {
        if let Some(text) = refusal.text {
            console.error(&text);
        }
        refusal.code
    });
    ExitCode::from(console.exit_code(code))
}

/// What stops a command.
pub(crate) struct Refusal {
    code: u8,
    /// Why; `None` when it has been said.
    text: Option<String>,
}

impl Refusal {
    fn new(code: u8, why: impl Display) -> Self {
        Self {
            code,
            text: Some(why.to_string()),
        }
    }
}

/// It was asked for what cannot be.
fn usage(why: impl Display) -> Refusal {
    Refusal::new(exit::USAGE, why)
}

/// It was tried and did not come about.
fn failed(why: impl Display) -> Refusal {
    Refusal::new(exit::FAILED, why)
}

fn code_of(end: CommandEnd) -> u8 {
    match end {
        CommandEnd::Done => exit::RAN,
        CommandEnd::Failed => exit::FAILED,
        CommandEnd::Refused => exit::USAGE,
        CommandEnd::Interrupted => interrupted(),
    }
}

fn run_command(
    command: Command,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let done = |()| exit::RAN;
    match command {
        Command::Worker { launch } => worker::run(&launch, registry).map(done).map_err(failed),
        Command::Become {
            supervisor,
            open_files,
            inside,
            realtime,
            program,
        } => own_program::become_program(
            supervisor,
            open_files,
            inside,
            realtime.as_deref(),
            &program,
        )
        .map(done)
        .map_err(failed),
        Command::BecomeHost { starter, arguments } => {
            host::become_host(starter, &arguments)
                .map(done)
                .map_err(|error| match error {
                    // Its starter was told, and says so.
                    OwnProgramError::Cable(_) => Refusal {
                        code: exit::FAILED,
                        text: None,
                    },
                    other => failed(other),
                })
        }
        Command::CardGuard(args) => guard::run(&args).map(done).map_err(failed),
        Command::Join(args) => join_work::join(&args, registry, console),
        Command::Simulate {
            topology,
            overrides,
            output,
            full,
        } => case_work::simulate(
            &topology,
            &overrides,
            case_work::SimulatedShown {
                output: output.as_deref(),
                is_full: full,
            },
            registry,
            console,
        ),
        Command::Tables {
            topology,
            record,
            host,
            mut overrides,
            sections,
            runs,
            batch,
        } => {
            overrides
                .extend(sections.map(|count| format!("case.parameters.tables.sections={count}")));
            match record {
                None => {
                    let path = topology.unwrap_or_default();
                    case_work::tables(&path, &overrides, &runs, &batch, registry, console)
                }
                Some(file) => record_work::record(
                    &file,
                    host.as_deref(),
                    record_work::TablesWanted {
                        overrides,
                        runs,
                        batch,
                    },
                    registry,
                    console,
                ),
            }
        }
        Command::Calibrate(args) => case_work::calibrate(args, registry, console),
        Command::Replay(args) => case_work::replay(&args.run, args.json, registry, console),
        Command::Report(args) => report_work::report(&args, registry, console),
        Command::Compare(args) => Ok(code_of(compare::work::work(&args, columns(), console))),
        Command::Trace { command } => Ok(code_of(trace::work::work(command, columns(), console))),
        Command::Link { command } => Ok(code_of(link::work::work(&command, console))),
        Command::Doctor(args) => doctor_work::doctor(&args, registry, console),
        Command::Channel(args) => live_work::channel(args, registry, console),
        Command::Top(args) => live_work::top(&args, registry, console),
        Command::Probe(args) => Ok(hil_probe::run(&args, columns(), console)),
        Command::Documents { folder } => documents::write(Cli::command(), &folder)
            .and_then(|_paths| documents::write_keys(&folder))
            .and_then(|()| documents::write_robot(&folder))
            .map(|_path| exit::RAN)
            .map_err(failed),
        Command::Sweep => {
            supervisor::sweep();
            Ok(exit::RAN)
        }
        Command::Key { command } => {
            console.result(&command.work().map_err(usage)?);
            Ok(exit::RAN)
        }
        Command::Cases => {
            console.result(&cases::list(registry));
            Ok(exit::RAN)
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

/// Takes over the signals that end programs, or says why it cannot.
fn signals() -> Result<Signals, Refusal> {
    Signals::install().map_err(|error| {
        let text = format!("cannot handle signals: {error}");
        Refusal::new(exit::INTERNAL, text)
    })
}

fn load(
    path: &Path,
    overrides: &[String],
    registry: &Registry,
    console: &mut Console,
) -> Result<Topology, Refusal> {
    loaded(
        hil_topology::load(path, overrides, registry.known()),
        console,
    )
}

/// What a file says, or all its faults said.
fn loaded<T>(found: Result<T, TopologyErrors>, console: &mut Console) -> Result<T, Refusal> {
    found.map_err(|errors| {
        console.faults(&errors.render(io::stderr().is_terminal()));
        Refusal {
            code: exit::USAGE,
            text: None,
        }
    })
}

fn run_topology(
    args: &mut RunArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    if args.probe.is_some() && args.on_one_pc_as.is_none() && !args.on_one_pc {
        return Err(usage(
            "--probe is for --on-one-pc; on a PC of its own a host's wire is captured with `hil-runtime probe`",
        ));
    }
    if let Some(host) = args.on_one_pc_as.take() {
        args.host = Some(host);
        args.domain_root = Some(host::DOMAIN_ROOT.into());
        args.overrides
            .push(format!("security.key='{}'", host::KEY_FILE));
    }
    let Some(path) = &args.topology else {
        let hint = "no topology given; try --topology deploy/topologies/local.toml or --help";
        return Err(usage(hint));
    };
    let topology = if args.check {
        let topology = hil_topology::load_case(path, &args.overrides, registry.known());
        loaded(topology, console)?
    } else {
        load(path, &args.overrides, registry, console)?
    };
    if args.check && topology.processes().is_empty() {
        return show_study(path, &topology, args, registry, console);
    }
    let command_line = host::as_typed(env::args());
    if args.on_one_pc {
        host::check(&topology).map_err(|error| not_on_one_pc(path, error))?;
    }
    if args.on_one_pc && !args.check {
        return on_one_pc(path, &topology, console);
    }
    carry_out(path, args, &topology, command_line, registry, console)
}

/// How long a probe may take to begin, and to write what it has.
const PROBE_BEGINS_WITHIN: Duration = Duration::from_secs(5);
const PROBE_ENDS_WITHIN: Duration = Duration::from_secs(10);
const PROBE_PERIOD: Duration = Duration::from_millis(10);

/// A passive probe at the interfaces of `host`, one of those on one PC, that captures to a file in `folder`.
fn start_probe(topology: &Topology, folder: &Path, host: &str) -> Result<Beside, Refusal> {
    let output = folder.join(format!("{host}.pcapng"));
    let cannot = |error: io::Error| failed(format!("{}: {error}", output.display()));
    fs::create_dir_all(folder).map_err(cannot)?;
    if output.exists() {
        let output = output.display();
        return Err(usage(format!(
            "{output}: exists; give --probe another folder"
        )));
    }
    let mut arguments = ["probe", "--quiet", "--output"].map(str::to_owned).to_vec();
    arguments.push(output.display().to_string());
    let interfaces = host::interfaces(topology, host).map_err(failed)?;
    arguments.extend((interfaces.into_iter()).flat_map(|one| ["--interface".to_owned(), one]));
    let mut probe = host::start_probe(&arguments).map_err(cannot)?;
    // Its file has a head once it captures.
    let deadline = Instant::now() + PROBE_BEGINS_WITHIN;
    while fs::metadata(&output).map_or(0, |file| file.len()) == 0 {
        if probe.is_over() || Instant::now() >= deadline {
            let code = probe.end(Duration::ZERO).filter(|code| *code != 0);
            let code = code.and_then(|code| u8::try_from(code).ok());
            let text = format!("the probe of {host} does not capture, so that nothing is run");
            return Err(Refusal::new(code.unwrap_or(exit::FAILED), text));
        }
        thread::sleep(PROBE_PERIOD);
    }
    Ok(probe)
}

/// Runs all hosts of `topology` here, each under a supervisor of its own.
fn on_one_pc(path: &Path, topology: &Topology, console: &mut Console) -> Result<u8, Refusal> {
    host::run_all(topology, console).map_err(|error| not_on_one_pc(path, error))
}

fn not_on_one_pc(path: &Path, error: HostsError) -> Refusal {
    match error {
        HostsError::WithoutAddress
        | HostsError::OneInterface { .. }
        | HostsError::SameInterface(_) => usage(format!("{}: {error}", path.display())),
        other => Refusal::new(exit::HOST_UNFIT, other),
    }
}

/// Runs `topology`, or checks whether it could, and prints its report; `command_line` repeats the run.
fn carry_out(
    path: &Path,
    args: &RunArgs,
    topology: &Topology,
    command_line: Vec<String>,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    check_traces(path, &args.overrides, topology, console)?;
    // Told before what may only be missing now.
    check_file(path, args, topology)?;
    own_program::check_names(topology)
        .map_err(|taken| unusable(path, &args.overrides, taken.0, exit::USAGE, console))?;
    tell_undecided(topology, registry, console);
    // A file is checked anywhere, also where none of its hosts is.
    if args.check && args.host.is_none() {
        return Ok(show_check(path, topology, None, registry, console));
    }
    let hosts = hosts_here(topology, args.host.as_deref()).map_err(usage)?;
    let (key, claims) = check_here(path, args, topology, &hosts, console)?;
    if args.check {
        return Ok(show_check(path, topology, key, registry, console));
    }
    let signals = signals()?;
    let options = RunOptions {
        hosts,
        domain_root: args.domain_root.clone(),
        topology_file: path.to_path_buf(),
        revision: REVISION,
        command_line,
        layouts: layouts(topology, registry),
    };
    let folder = args.probe.as_deref().zip(options.hosts.first());
    let probe = folder.map(|(folder, host)| start_probe(topology, folder, host));
    let probe = probe.transpose()?;
    console.serve();
    let result = supervisor::run(topology, &options, claims, &signals, console);
    // Before the other host's interface goes with its last process.
    let probed = probe.map(|probe| probe.end(PROBE_ENDS_WITHIN));
    let result = result.map_err(|error| Refusal::new(exit_code_of_error(&error), error))?;
    let has_no_capture = probed.is_some_and(|code| code != Some(0));
    if has_no_capture {
        console.warn("the probe's capture is not whole");
    }
    let code = match exit_code(&result.outcome) {
        exit::RAN if result.has_gaps() || has_no_capture => exit::FAILED,
        code => code,
    };
    let concluded = Progress::begin().during(console, "drawing up the account", |_| {
        let written = result.write().map_err(AnalysisError::from);
        let analysed = written.and_then(|()| analysis::analyse(&result.folder, registry));
        // What the folder cannot give back, because its disk is full, is still in memory.
        analysed.or_else(|error| {
            let concluded =
                analysis::conclude(topology, &result, registry, path, &options.command_line)?;
            Ok::<_, AnalysisError>(Concluded {
                unwritten: concluded.unwritten.or(Some(error)),
                ..concluded
            })
        })
    });
    let Concluded { summary, unwritten } = concluded.map_err(|error| {
        let text = format!("the run is over but its report failed: {error}");
        Refusal::new(exit::INTERNAL, text)
    })?;
    console.result(&terminal::page(&summary, args.full, columns()));
    if code != exit::RAN {
        console.error(&complaint(&result));
    }
    if let Some(error) = unwritten {
        console.error(&format!("{error}; the report is only what is printed here"));
        return Ok(code.max(exit::FAILED));
    }
    Ok(code)
}

/// Warns of what the case's setup leaves open.
fn tell_undecided(topology: &Topology, registry: &Registry, console: &mut Console) {
    if let Ok(Some((_, case))) = registry.make_case(topology)
        && let Some(words) = case.undecided()
    {
        console.warn(&words);
    }
}

/// Refuses a file whose traces cannot be replayed.
fn check_traces(
    path: &Path,
    overrides: &[String],
    topology: &Topology,
    console: &mut Console,
) -> Result<(), Refusal> {
    trace_source::check(topology).map_err(|faulty| {
        let faulty = faulty.into_iter();
        let faulty = faulty.map(|error| (error.key, error.source.to_string()));
        unusable(path, overrides, faulty, exit::USAGE, console)
    })
}

/// Says what of the file cannot be used, each key where it stands.
fn unusable(
    path: &Path,
    overrides: &[String],
    found: impl IntoIterator<Item = (String, String)>,
    code: u8,
    console: &mut Console,
) -> Refusal {
    // What `join` makes of its arguments is in no file.
    if path.is_file() {
        let errors = hil_topology::unusable(path, overrides, found);
        console.faults(&errors.render(io::stderr().is_terminal()));
    } else {
        for (key, why) in found {
            console.error(&format!("{key}: {why}"));
        }
    }
    Refusal { code, text: None }
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

/// What a file without processes comes to: no run can be what it says, and other commands take it.
fn show_study(
    path: &Path,
    topology: &Topology,
    args: &RunArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    // What links hosts, or is asked for one, was meant for a run: its fault is that nothing runs.
    if !topology.links().is_empty() || args.host.is_some() {
        load(path, &args.overrides, registry, console)?;
    }
    console.result(&format!(
        "# {}: the file is valid; it names no processes, so it is for `simulate`, `tables` and\n\
         # `calibrate`; it comes to\n\n{}{}",
        path.display(),
        topology.to_toml(),
        undecided(topology, registry)
    ));
    Ok(exit::RAN)
}

/// What the check of the case leaves open, as a comment.
fn undecided(topology: &Topology, registry: &Registry) -> String {
    // A case that cannot be made has been refused before.
    let made = registry.make_case(topology).ok().flatten();
    let left_open = made.and_then(|(_, case)| case.undecided());
    left_open.map_or_else(String::new, |text| format!("\n# {text}\n"))
}

/// Refuses a file of which no run can be what it says, on whatever hosts.
fn check_file(path: &Path, args: &RunArgs, topology: &Topology) -> Result<(), Refusal> {
    check_emulation(topology).map_err(|error| {
        usage(format!(
            "{}: the file is valid and can be simulated, but no gateway can keep its emulated \
             link: {error}",
            path.display()
        ))
    })?;
    // On one PC the hops have a key of their own.
    match topology.unsaid_security().filter(|_| !args.on_one_pc) {
        Some(text) => Err(usage(format!("{}: {text}", path.display()))),
        None => Ok(()),
    }
}

/// The revision that this program was built from, as `build.rs` found it.
const REVISION: Option<&str> = option_env!("HIL_GIT_REVISION");

/// The processes of a run whose supervisor was killed notice at once, and end.
const PORTS_FREED_WITHIN: Duration = Duration::from_secs(1);
const PORTS_FREED_PERIOD: Duration = Duration::from_millis(20);

/// What is in the way of a run, also a moment later where it is a port: no other run claims it, and one that
/// was killed may be about to free it. A check does not wait.
fn lasting_obstacles(plan: &Plan, is_check: bool) -> Vec<Obstacle> {
    let deadline = Instant::now() + PORTS_FREED_WITHIN;
    loop {
        let found = obstacles(plan);
        let is_taken = |one: &Obstacle| matches!(one.trouble, Trouble::Taken { .. });
        if is_check || !found.iter().any(is_taken) || Instant::now() >= deadline {
            return found;
        }
        thread::sleep(PORTS_FREED_PERIOD);
    }
}

/// Refuses what cannot run on these hosts, which are this machine, and warns of what it would run without;
/// gives the key that it would hold in a run with others, and what the run has for itself from here on. A
/// check claims nothing, and also refuses what a run would wait for.
fn check_here(
    path: &Path,
    args: &RunArgs,
    topology: &Topology,
    hosts: &[String],
    console: &mut Console,
) -> Result<(Option<(PathBuf, PreSharedKey)>, Claims), Refusal> {
    own_program::find_all(topology, hosts)
        .map_err(|missing| unusable(path, &args.overrides, missing.0, exit::USAGE, console))?;
    let key = key_here(topology, hosts);
    let key = key.map_err(|error| Refusal::new(exit::FORBIDDEN, error))?;
    // A run looks once it has removed what dead ones left.
    if args.check
        && let Err(HostTooSmall(shortfalls)) = supervisor::check_host(topology, hosts)
    {
        // The unit of the service lifts the limit on locked memory, which a shell nearly always has.
        let is_of_shell = |one: &Shortfall| matches!(one, Shortfall::LockedMemory { .. });
        let (of_shell, of_host) = shortfalls.into_iter().partition::<Vec<_>, _>(is_of_shell);
        for shortfall in of_shell {
            console.warn(&format!("started from here, {shortfall}"));
        }
        if !of_host.is_empty() {
            return Err(Refusal::new(exit::HOST_UNFIT, HostTooSmall(of_host)));
        }
    }
    // Before ports are tried: another run may be about to bind them.
    let claims = if args.check {
        Claims::look(topology, hosts).map(|()| Claims::default())
    } else {
        Claims::take(topology, hosts)
    };
    let claims = claims.map_err(|error| match error {
        ClaimError::Taken(taken) => {
            unusable(path, &args.overrides, taken, exit::TRY_AGAIN, console)
        }
        ClaimError::Io(ref source) => {
            let code = match FailureKind::of(source) {
                FailureKind::HostTooSmall => exit::HOST_UNFIT,
                FailureKind::NotThereYet | FailureKind::Fault | FailureKind::ProgramEnded => {
                    exit::INTERNAL
                }
            };
            Refusal::new(code, error)
        }
    })?;
    let (mut refused, mut told) = (Vec::new(), Vec::new());
    for obstacle in lasting_obstacles(&Plan::of(topology, hosts), args.check) {
        let is_refused = match obstacle.effect {
            Effect::Prevents => true,
            Effect::HoldsUp => args.check,
            Effect::DoneWithout => false,
        };
        let list = if is_refused { &mut refused } else { &mut told };
        list.push((obstacle.key, obstacle.trouble.to_string()));
    }
    for (key, words) in told {
        console.warn(&format!("{key}: {words}"));
    }
    if refused.is_empty() {
        Ok((key, claims))
    } else {
        Err(unusable(
            path,
            &args.overrides,
            refused,
            exit::TRY_AGAIN,
            console,
        ))
    }
}

/// What the file comes to; with the key of this machine, also which it is.
fn show_check(
    path: &Path,
    topology: &Topology,
    key: Option<(PathBuf, PreSharedKey)>,
    registry: &Registry,
    console: &mut Console,
) -> u8 {
    // As comments, so that what is printed is a topology as a whole.
    let clock_paths = topology.clock_paths().map(|clock| {
        let (asking, answering) = (clock.asking.port(), clock.answering.port());
        let words = clock.describe();
        format!("\n# {words}, UDP ports {asking} and {answering}\n")
    });
    let key = key.map(|(file, key)| {
        let (file, fingerprint) = (file.display(), key.fingerprint());
        format!("\n# {file}: the key {fingerprint}, which the other hosts must have as well\n")
    });
    console.result(&format!(
        "# {}: the file is valid; it comes to\n\n{}{}{}{}",
        path.display(),
        topology.to_toml(),
        undecided(topology, registry),
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
        RunError::Peer(PeerError::Absent { .. }) | RunError::SecretMissing(_) => exit::PEER_ABSENT,
        RunError::Folder { source, .. } if source.kind() == ErrorKind::PermissionDenied => {
            exit::FORBIDDEN
        }
        RunError::Key(_) => exit::FORBIDDEN,
        RunError::Peer(PeerError::Listen { source, .. } | PeerError::Own { source, .. })
            if is_passing(source) =>
        {
            exit::TRY_AGAIN
        }
        RunError::HostTooSmall(_) => exit::HOST_UNFIT,
        RunError::Domains(error) if error.is_of_path() => exit::USAGE,
        RunError::Domains(error) if error.is_of_others() => exit::FORBIDDEN,
        RunError::Domains(DomainsError::Taken { .. }) => exit::TRY_AGAIN,
        RunError::Folder { source, .. } if is_of_full_disk(source) => exit::FAILED,
        RunError::Folder { .. }
        | RunError::Programs(_)
        | RunError::SecurityUnsaid(_)
        | RunError::Emulation(_)
        | RunError::Peer(
            PeerError::Mismatch { .. } | PeerError::Listen { .. } | PeerError::Own { .. },
        ) => exit::USAGE,
        RunError::Peer(PeerError::Interrupted { .. }) => interrupted(),
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
        Outcome::Failed(failure) => match failure.kind {
            FailureKind::Fault | FailureKind::ProgramEnded => exit::FAILED,
            FailureKind::NotThereYet => exit::TRY_AGAIN,
            FailureKind::HostTooSmall => exit::HOST_UNFIT,
        },
        Outcome::Unwritable { .. } | Outcome::PeerFailed { .. } | Outcome::EndedByPeer(_) => {
            exit::FAILED
        }
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
) -> Result<u8, Refusal> {
    let text = text.map_err(usage)?;
    match output {
        None => {
            console.result(&text);
        }
        Some(path) => {
            let written = fs::write(path, text);
            written.map_err(|error| failed(format!("{}: {error}", path.display())))?;
            console.say(&format!("wrote {}", path.display()));
        }
    }
    Ok(exit::RAN)
}
