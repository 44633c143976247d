//! A user's own program as a process of the run: found before the run begins, and bound to its
//! supervisor, so that it cannot outlive it.

use std::collections::BTreeSet;
use std::fs::File;
use std::net::IpAddr;
use std::os::fd::AsFd as _;
use std::os::unix::process::{CommandExt, parent_id};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use std::{env, io};

use hil_cable::{Inside, Refusal};
use hil_platform::open_files;
use hil_platform::realtime::{self, SchedulingPolicy};
use hil_topology::{
    Execution, Link, Process, Program, Topology, Wait, clock_process_name, gateway_name,
    witness_name,
};
use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::Signal;
use nix::unistd::{AccessFlags, access, dup2_stdin};
use serde::{Deserialize, Serialize};

use crate::security::KeyFileError;

/// Why the own program could not be started.
#[derive(Debug, thiserror::Error)]
pub enum OwnProgramError {
    /// Its supervisor is gone.
    #[error("the supervisor ended before {0} began")]
    Orphaned(String),
    /// Its end cannot be bound to the supervisor's.
    #[error("cannot bind {program} to its supervisor: {source}")]
    Bind {
        /// The program.
        program: String,
        /// What the kernel answered.
        source: io::Error,
    },
    /// Its descriptors cannot be as the supervisor found them.
    #[error("cannot restore the descriptors of {program}: {source}")]
    Descriptors {
        /// The program.
        program: String,
        /// What the kernel answered.
        source: io::Error,
    },
    /// It cannot have a network namespace of its own.
    #[error(transparent)]
    Cable(#[from] Refusal),
    /// The key of a host cannot be put where it looks for it.
    #[error(transparent)]
    Key(#[from] KeyFileError),
    /// The kernel does not give it what its process is to have.
    #[error("cannot give {program} what its process is to have: {refusal}")]
    Realtime {
        /// The program.
        program: String,
        /// What was refused, why, and the cure.
        refusal: String,
    },
    /// The program cannot be executed.
    #[error("cannot execute {program}: {source}")]
    Execute {
        /// The program.
        program: String,
        /// What the kernel answered.
        source: io::Error,
    },
}

/// What the kernel is asked for a program: a refusal ends it, as nobody else would tell.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProgramRealtime {
    /// The cores it may use; any where there are none.
    pub cpus: Vec<usize>,
    /// Of all its threads, and of all that it starts.
    pub policy: SchedulingPolicy,
    /// How late the kernel may wake it; as inherited, where there is none.
    pub timer_slack: Option<Duration>,
}

/// Replaces this process by `program`, which the kernel will kill when the supervisor ends. With an address
/// `inside` it has a network namespace of its own, and the process at the other end of standard input, which
/// carries its frames, says when it begins. Returns only when it fails. The program inherits nothing that the supervisor has open, and may open
/// as many files as `open_files` says: what the supervisor was started with, where it raised that.
///
/// # Errors
/// When the supervisor is gone or the program cannot be executed.
pub fn become_program(
    supervisor: u32,
    open_files: Option<u64>,
    inside: Option<IpAddr>,
    realtime: Option<&str>,
    program: &[String],
) -> Result<(), OwnProgramError> {
    let name = program.first().cloned().unwrap_or_default();
    bind_to(supervisor, &name, Signal::SIGKILL)?;
    let restored =
        open_files::withhold().and_then(|()| open_files.map_or(Ok(()), open_files::set_limit));
    restored.map_err(|source| OwnProgramError::Descriptors {
        program: name.clone(),
        source,
    })?;
    if let Some(address) = inside {
        take_cable(Inside { address }, &name)?;
        // A change of identity may have unbound it.
        bind_to(supervisor, &name, Signal::SIGKILL)?;
    }
    if let Some(text) = realtime {
        claim(text).map_err(|refusal| OwnProgramError::Realtime {
            program: name.clone(),
            refusal,
        })?;
    }
    let source = Command::new(&name).args(&program[1..]).exec();
    Err(OwnProgramError::Execute {
        program: name,
        source,
    })
}

/// Asks the kernel for what `text` says; else what it refused.
fn claim(text: &str) -> Result<(), String> {
    let asked: ProgramRealtime = serde_json::from_str(text).map_err(|error| error.to_string())?;
    let grant = realtime::apply_to_program(asked.policy, asked.timer_slack, &asked.cpus);
    let refusals: Vec<String> = grant.refusals().map(ToString::to_string).collect();
    if refusals.is_empty() {
        Ok(())
    } else {
        Err(refusals.join("; "))
    }
}

/// Lets the kernel send this process a signal when the one that started it ends.
pub(super) fn bind_to(
    supervisor: u32,
    program: &str,
    signal: Signal,
) -> Result<(), OwnProgramError> {
    set_pdeathsig(signal).map_err(|errno| OwnProgramError::Bind {
        program: program.to_owned(),
        source: errno.into(),
    })?;
    // It may have ended before the line above.
    if parent_id() != supervisor {
        return Err(OwnProgramError::Orphaned(program.to_owned()));
    }
    Ok(())
}

/// Enters namespaces of the program's own, gives the cable's end away and waits for the start.
fn take_cable(inside: Inside, program: &str) -> Result<(), OwnProgramError> {
    let orphaned = |_gone: io::Error| OwnProgramError::Orphaned(program.to_owned());
    let input = io::stdin();
    match hil_cable::enter(&inside) {
        Ok(end) => hil_cable::hand_over(input.as_fd(), &end).map_err(orphaned)?,
        Err(refusal) => {
            hil_cable::refuse(input.as_fd(), &refusal).map_err(orphaned)?;
            return Err(refusal.into());
        }
    }
    if !hil_cable::await_go(input.as_fd()).map_err(orphaned)? {
        return Err(OwnProgramError::Orphaned(program.to_owned()));
    }
    let nothing = File::open("/dev/null").and_then(|nothing| Ok(dup2_stdin(nothing)?));
    nothing.map_err(|source| OwnProgramError::Descriptors {
        program: program.to_owned(),
        source,
    })
}

/// Programs of the user's that a run would start and cannot, or not as its topology says.
#[derive(Debug, thiserror::Error)]
#[error("{}", lines(.0))]
pub struct ProgramsUnfit(
    /// Keys of processes, and what is wrong with each.
    pub Vec<(String, String)>,
);

impl ProgramsUnfit {
    fn unless_none(found: impl Iterator<Item = (String, String)>) -> Result<(), Self> {
        let found: Vec<_> = found.collect();
        if found.is_empty() {
            Ok(())
        } else {
            Err(Self(found))
        }
    }
}

fn lines(missing: &[(String, String)]) -> String {
    let lines = missing.iter().map(|(key, why)| format!("{key}: {why}"));
    lines.collect::<Vec<_>>().join("\n")
}

/// Looks for the own programs of `topology` that would run on `hosts`, which are this machine, before a
/// run begins: by this process's search path and from its working folder. Names are looked at on every host.
///
/// # Errors
/// Names the key of each process whose program is not there, and the program; each key that a program
/// cannot be given; and what [`check_names`] refuses.
pub fn find_all(topology: &Topology, hosts: &[String]) -> Result<(), ProgramsUnfit> {
    let here = topology.processes().iter();
    let here = here.filter(|process| hosts.contains(&process.host));
    let faults = here.flat_map(|process| faults(process, carrier(topology, process)));
    ProgramsUnfit::unless_none(faults.chain(taken_names(topology)))
}

/// Refuses processes of any host that are called as one of the run's own: a gateway, an end of a clock path, or what records
/// for programs of the user's. A run would not start; the folder of an older one is read all the same.
///
/// # Errors
/// Names the key of each.
pub fn check_names(topology: &Topology) -> Result<(), ProgramsUnfit> {
    ProgramsUnfit::unless_none(taken_names(topology))
}

fn taken_names(topology: &Topology) -> impl Iterator<Item = (String, String)> {
    let between = |link: &Link| link.between.clone().into_iter().flatten();
    let gateways = topology
        .links()
        .iter()
        .flat_map(|link| between(link).map(|host| gateway_name(&link.name, &host)));
    let clocks = topology
        .clock_paths()
        .flat_map(|path| [path.from, path.to].map(|host| clock_process_name(&path, &host.name)));
    let processes = topology.processes().iter();
    let observed = processes.clone().filter(|one| one.is_witnessed());
    let witnesses = observed.map(|one| witness_name(&one.host));
    let own: BTreeSet<String> = gateways.chain(clocks).chain(witnesses).collect();
    let why = "is the name of a process of the run itself: choose another";
    let taken = processes.filter(move |process| own.contains(&process.name));
    taken.map(move |process| (format!("processes.{}", process.name), why.to_owned()))
}

/// The link whose gateway carries the frames of `process`; `None` where they stay on its host, or it has none.
fn carrier<'a>(topology: &'a Topology, process: &Process) -> Option<&'a str> {
    process.inside()?;
    let mut crossings = topology.crossings();
    let crossing = crossings.find(|crossing| crossing.channel.from == process.name)?;
    Some(&crossing.link.name)
}

/// What is wrong with a process whose frames the gateway of link `carrier` carries, by its keys.
fn faults(process: &Process, carrier: Option<&str>) -> Vec<(String, String)> {
    let Program::Command { command, .. } = &process.program else {
        return Vec::new();
    };
    let key = |key| format!("processes.{}.{key}", process.name);
    let program = &command[0];
    let mut faults = Vec::new();
    if let Err(error) = find(program) {
        faults.push((key("run"), format!("cannot start {program}: {error}")));
    }
    if process.is_witnessed() && process.execution.lock_memory {
        let why = "a lock ends where a program is executed: it must lock its memory itself";
        faults.push((key("lock_memory"), why.to_owned()));
    }
    if process.is_witnessed() && process.execution.wait != Wait::Block {
        let why = "how a program of the user's waits is its own business";
        faults.push((key("wait"), why.to_owned()));
    }
    if let Some(link) = carrier
        && process.execution != Execution::default()
    {
        let why = format!(
            "the gateway carries its frames: say of it, at `links.{link}.gateway`, how it is scheduled and waits"
        );
        faults.push((format!("processes.{}", process.name), why));
    }
    faults
}

/// Where `program` is, as the shell would find it.
fn find(program: &str) -> io::Result<PathBuf> {
    let is_executable = |path: &Path| path.is_file() && access(path, AccessFlags::X_OK).is_ok();
    let not_found = |place: String| {
        let text = format!("no executable file of that name {place}");
        io::Error::new(io::ErrorKind::NotFound, text)
    };
    if program.contains('/') {
        let path = env::current_dir()?.join(program);
        return if is_executable(&path) {
            Ok(path)
        } else {
            Err(not_found(format!("at {}", path.display())))
        };
    }
    let search_path = env::var_os("PATH").unwrap_or_default();
    let found = env::split_paths(&search_path).map(|folder| folder.join(program));
    found
        .into_iter()
        .find(|path| is_executable(path))
        .ok_or_else(|| not_found(format!("in {}", search_path.to_string_lossy())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_found_like_the_shell_does_and_a_missing_one_is_not() {
        assert!(find("sh").is_ok());
        assert!(find("/bin/sh").is_ok());
        assert!(find("hil-no-such-program").is_err());
        assert!(find("/proc/self/status").is_err());
    }

    #[test]
    fn what_the_kernel_refuses_a_program_is_told_with_the_cure() {
        let asked = ProgramRealtime {
            cpus: vec![1_023],
            policy: SchedulingPolicy::Other,
            timer_slack: None,
        };
        let refusal = claim(&serde_json::to_string(&asked).unwrap()).unwrap_err();
        assert!(refusal.contains("cpu 1023 refused"), "{refusal}");
        assert!(refusal.contains("choose one of them"), "{refusal}");
    }

    #[test]
    fn what_a_program_cannot_be_given_is_named_with_its_key() {
        let process = Process {
            name: "a".to_owned(),
            host: "pc".to_owned(),
            program: Program::Command {
                command: vec!["sh".to_owned()],
                role: None,
                environment: std::collections::BTreeMap::new(),
                inside: None,
            },
            execution: Execution {
                lock_memory: true,
                wait: Wait::Spin,
                ..Execution::default()
            },
            restarts: hil_topology::Restarts::default(),
        };
        let keys: Vec<String> = faults(&process, None)
            .into_iter()
            .map(|one| one.0)
            .collect();
        assert_eq!(keys, ["processes.a.lock_memory", "processes.a.wait"]);
        // Of a program with a cable, which is no witness's.
        let Program::Command {
            command,
            role,
            environment,
            ..
        } = process.program.clone()
        else {
            unreachable!("made as one above");
        };
        let process = Process {
            program: Program::Command {
                command,
                role,
                environment,
                inside: "10.0.0.1".parse().ok(),
            },
            ..process
        };
        assert_eq!(faults(&process, None), []);
        let found = faults(&process, Some("hop"));
        assert_eq!((found.len(), found[0].0.as_str()), (1, "processes.a"));
        assert!(found[0].1.contains("`links.hop.gateway`"), "{found:?}");
    }

    #[test]
    fn the_name_of_a_process_of_the_run_itself_is_no_programs() {
        let known = hil_topology::registry::Registry::default();
        let message = "message = { name = 'x.v1', size_bytes = 8 }";
        for (name, rest) in [
            ("witness-local", "processes.a.run = ['sh']\n[channels.c]\n"),
            (
                "gateway-hop-p",
                "hosts = { p = {}, q = {} }\nprocesses.gateway-hop-p.host = 'p'\n\
                 processes.a = { run = ['sh'], host = 'q' }\n\
                 links.hop = { via = 'emulated', between = ['p', 'q'], port = 7000 }\n\
                 [channels.c]\nlink = 'hop'\n",
            ),
        ] {
            let text = format!(
                "version = 1\nname = 'own'\nprocesses.{name}.run = ['sh']\n{rest}{message}\nfrom = 'a'\nto = '{name}'\n"
            );
            let topology = hil_topology::parse("own.toml", &text, &[], known.known()).unwrap();
            let hosts = topology.hosts().iter().map(|one| one.name.clone());
            let hosts: Vec<String> = hosts.collect();
            for refusal in [find_all(&topology, &hosts), check_names(&topology)] {
                let refusal = refusal.unwrap_err();
                let keys: Vec<&str> = refusal.0.iter().map(|one| one.0.as_str()).collect();
                assert_eq!(keys, [format!("processes.{name}")]);
            }
        }
    }

    #[test]
    fn an_orphan_does_not_start() {
        let error = become_program(u32::MAX, None, None, None, &["true".to_owned()]).unwrap_err();
        assert!(matches!(error, OwnProgramError::Orphaned(_)));
    }
}
