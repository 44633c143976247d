//! Does to a run what was drawn, and undoes it.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};
use std::{fs, thread};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::episode::Stage;
use super::forger::{self, Forgery};
use super::plan::{Injection, Kind};
use crate::binary::{hil_recorder_binary, hil_runtime_binary};
use crate::child::{self, ChildGuard};
use crate::lab::INTERFACE;

/// A command beside the run takes a fraction of this.
const COMMAND_LIMIT: Duration = Duration::from_secs(20);
/// The shortest that IPv4 allows is 68; the run's datagrams are longer than this.
const SHORT_MTU: &str = "100";

/// What is to be undone, and when.
#[derive(Debug)]
pub struct Undo {
    /// When.
    pub at: Instant,
    what: Remedy,
}

#[derive(Debug)]
enum Remedy {
    Continue(Pid, String),
    PlugIn(usize),
    LengthenMtu(usize),
    EmptyDisk(usize),
    EndRecorder(Box<ChildGuard>),
}

/// What the injections of an episode leave running.
#[derive(Debug, Default)]
pub struct Effects {
    undos: Vec<Undo>,
    /// What could not be done, for whoever reads the output.
    pub notes: Vec<String>,
}

impl Effects {
    /// Undoes what is due at `now`.
    pub fn undo_due(&mut self, stage: &Stage, now: Instant) {
        let (due, later) = core::mem::take(&mut self.undos)
            .into_iter()
            .partition(|undo| undo.at <= now);
        self.undos = later;
        let due: Vec<Undo> = due;
        for undo in due {
            undo.what.apply(stage);
        }
    }

    /// Undoes everything at once.
    pub fn undo_all(&mut self, stage: &Stage) {
        for undo in self.undos.drain(..) {
            undo.what.apply(stage);
        }
    }

    /// When the next undoing is due.
    pub fn next(&self) -> Option<Instant> {
        self.undos.iter().map(|undo| undo.at).min()
    }

    fn later(&mut self, injection: &Injection, what: Remedy) {
        let at = Instant::now() + injection.length;
        self.undos.push(Undo { at, what });
    }

    /// Does `injection`. Traffic runs in `scope` beside the episode.
    pub fn inject<'scope>(
        &mut self,
        stage: &'scope Stage,
        injection: &Injection,
        scope: &'scope thread::Scope<'scope, '_>,
    ) {
        let host = injection.host;
        match injection.kind {
            Kind::KillComponent | Kind::KillGateway | Kind::KillAtStart => {
                self.signal(stage, injection, Signal::SIGKILL);
            }
            Kind::PauseComponent | Kind::PauseGateway => {
                if let Some((process, word)) = self.signal(stage, injection, Signal::SIGSTOP) {
                    self.later(injection, Remedy::Continue(process, word));
                }
            }
            Kind::KillSupervisor => self.signal_supervisor(stage, host, Signal::SIGKILL),
            Kind::Interrupt => self.signal_supervisor(stage, host, Signal::SIGINT),
            Kind::PauseSupervisor | Kind::HangSupervisor => {
                self.signal_supervisor(stage, host, Signal::SIGSTOP);
                let process = stage.supervisor(host);
                let word = stage.record().to_string_lossy().into_owned();
                self.later(injection, Remedy::Continue(process, word));
            }
            Kind::KillRecorder => self.start_recorder(stage, injection),
            Kind::CutCable => {
                stage.lab().host(host).set_link(INTERFACE, "down");
                self.later(injection, Remedy::PlugIn(host));
            }
            Kind::ShrinkMtu => {
                set_mtu(stage, host, SHORT_MTU);
                self.later(injection, Remedy::LengthenMtu(host));
            }
            Kind::FillDisk => {
                fill(&stage.record_of(host));
                self.later(injection, Remedy::EmptyDisk(host));
            }
            Kind::StepCondition => self.step_condition(stage, injection),
            Kind::Flood | Kind::Forge | Kind::Copy | Kind::Damage => {
                let injection = *injection;
                scope.spawn(move || traffic(stage, &injection));
            }
        }
    }

    /// Signals the process that the injection is about; gives it with a word of its command line.
    fn signal(
        &mut self,
        stage: &Stage,
        injection: &Injection,
        signal: Signal,
    ) -> Option<(Pid, String)> {
        let host = injection.host;
        let is_gateway = match injection.kind {
            Kind::KillGateway | Kind::PauseGateway => true,
            Kind::KillAtStart => injection.seed & 1 == 0,
            _ => false,
        };
        let name = if is_gateway {
            ["gateway-hop-control-pc", "gateway-hop-robot-pc"][host]
        } else {
            ["controller", "robot"][host]
        };
        let word = format!("/launch/{name}.");
        let process = stage.process(host, &word);
        // A process that is about to be started again is not there to be hit.
        let sent = process.map(|process| kill(process, signal));
        if sent != Some(Ok(())) {
            self.notes.push(format!("{signal} found no {name}"));
            return None;
        }
        process.map(|process| (process, word))
    }

    fn signal_supervisor(&mut self, stage: &Stage, host: usize, signal: Signal) {
        if kill(stage.supervisor(host), signal).is_err() {
            self.notes.push(format!("{signal} found no supervisor"));
        }
    }

    fn start_recorder(&mut self, stage: &Stage, injection: &Injection) {
        let host = injection.host;
        let mut command = stage.lab().host(host).command(hil_recorder_binary());
        command.arg("record").arg(stage.folder_inside(host));
        command.arg("--output");
        command.arg(
            stage
                .record()
                .join(format!("looked-on-{}.mcap", injection.seed)),
        );
        match ChildGuard::spawn(&mut command) {
            Ok(recorder) => self.later(injection, Remedy::EndRecorder(Box::new(recorder))),
            Err(error) => self.notes.push(error.to_string()),
        }
    }

    fn step_condition(&mut self, stage: &Stage, injection: &Injection) {
        let condition: &[&str] = match injection.seed % 3 {
            0 => &["--delay", "20ms", "--loss", "0.2"],
            1 => &["--cut"],
            _ => &["--delay", "1ms"],
        };
        let host = injection.host;
        let mut command = stage.lab().host(host).command(hil_runtime_binary());
        let way = ["hop.backward", "hop.forward"][host];
        command.args(["link", "set", way]).args(condition);
        command.arg(stage.folder_inside(host));
        if let Err(reason) = child::run(&mut command, COMMAND_LIMIT) {
            self.notes.push(reason);
        }
    }
}

impl Remedy {
    fn apply(self, stage: &Stage) {
        match self {
            Self::Continue(process, word) => {
                // Only if it is still the process that was stopped.
                if command_line(process).contains(&word) {
                    kill(process, Signal::SIGCONT).ok();
                }
            }
            Self::PlugIn(host) => stage.lab().host(host).set_link(INTERFACE, "up"),
            Self::LengthenMtu(host) => set_mtu(stage, host, "1500"),
            Self::EmptyDisk(host) => drop(fs::remove_file(stage.record_of(host).join("filler"))),
            Self::EndRecorder(recorder) => {
                kill(recorder.pid(), Signal::SIGKILL).ok();
            }
        }
    }
}

/// What `/proc` says of a process.
pub fn command_line(process: Pid) -> String {
    let line = fs::read(format!("/proc/{process}/cmdline")).unwrap_or_default();
    String::from_utf8_lossy(&line).into_owned()
}

fn set_mtu(stage: &Stage, host: usize, mtu: &str) {
    let mut command = Command::new("ip");
    command.args(["-n", stage.lab().host(host).namespace()]);
    command.args(["link", "set", INTERFACE, "mtu", mtu]);
    let set = child::run(&mut command, COMMAND_LIMIT);
    assert!(set.is_ok(), "{set:?}");
}

/// Writes until there is no room.
fn fill(folder: &Path) {
    use std::io::Write;
    if let Ok(mut file) = fs::File::create(folder.join("filler")) {
        while file.write_all(&[1; 4096]).is_ok() {}
        // The last bytes as well.
        while file.write_all(&[1]).is_ok() {}
    }
}

fn traffic(stage: &Stage, injection: &Injection) {
    let (to, from) = (injection.host, 1 - injection.host);
    let (from, to) = (stage.lab().host(from), stage.lab().host(to));
    let (length, seed) = (injection.length, injection.seed);
    let sent = match injection.kind {
        Kind::Flood => forger::flood(from, to, false, length, seed),
        Kind::Forge => forger::flood(from, to, true, length, seed),
        Kind::Copy => forger::copy(from, to, Forgery::Copy, length, seed),
        _ => forger::copy(from, to, Forgery::Damage, length, seed),
    };
    assert!(sent.is_ok(), "no traffic: {sent:?}");
}
