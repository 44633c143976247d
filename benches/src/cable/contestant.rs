//! What is compared: the same two programs on two hosts, with nothing, a relay or the product between them; and
//! in two networks of one host with the emulator rattan between them.

use std::fmt::Write as _;
use std::net::Ipv4Addr;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use hil_platform::wait::WaitMode;
use hil_tests::child::ChildGuard;
use hil_tests::lab::{ADDRESSES, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::Trial;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;

use super::processes::{family, processor_ns};
use super::program::{ControlListener, Program};
use crate::gateway::hosts::SetupError;
use crate::on_cpu;

/// The contestants; the third and the fourth are the product. The last one takes part only where it is installed.
pub const NAMES: [&str; 5] = ["direct", "relay", "plain", "sealed", "rattan"];
/// The programs on the hosts themselves.
pub const DIRECT: usize = 0;
/// See [`super::relay`].
pub const RELAY: usize = 1;
/// One process between two networks of one host, without a cell: nothing is emulated, and nothing goes between hosts.
pub const RATTAN: usize = 4;

/// Addresses of the programs inside.
const INSIDE: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 99, 0, 1), Ipv4Addr::new(10, 99, 0, 2)];
/// Where rattan has the program on its right.
const RATTAN_RIGHT: Ipv4Addr = Ipv4Addr::new(10, 2, 1, 1);
const RELAY_PORT: u16 = 7_300;
/// Of the two runs of the product, which are on the hosts at the same time: of supervisors and links.
const RUN_PORTS: [[u16; 2]; 2] = [[7_399, 7_400], [7_389, 7_380]];
const LIMIT: Duration = Duration::from_mins(1);

/// Two programs and what carries their frames. The programs end first, and with them the rest.
#[derive(Debug)]
pub struct Contestant {
    /// The program that asks.
    pub near: Program,
    /// The program that answers.
    pub far: Program,
    hosts: Vec<ChildGuard>,
}

/// What contestants are started with.
#[derive(Debug)]
pub struct Start<'a> {
    /// The hosts.
    pub lab: &'a Lab,
    /// For sockets and records.
    pub folder: &'a RunFolder,
    /// The bench, which is programs and relays as well.
    pub executable: &'a str,
    /// The processor of each host, if it is to have one.
    pub pins: [Option<usize>; 2],
    /// How the carriers wait.
    pub wait: WaitMode,
    /// Longer than a contestant is needed.
    pub span: Duration,
    /// Where rattan is, if it takes part.
    pub rattan: Option<&'a str>,
}

impl Start<'_> {
    /// Runs this file once more on a host, with these words.
    fn again(&self, index: usize, words: &[String]) -> Result<ChildGuard, SetupError> {
        let mut command = self.lab.host(index).command(self.executable);
        command.args(words);
        Ok(on_cpu(self.pins[index], || {
            ChildGuard::spawn(&mut command)
        })??)
    }

    /// The contestant of [`NAMES`] with this index, once an echo has come through it.
    ///
    /// # Errors
    /// When a part of it does not start, or no echo comes in time.
    ///
    /// # Panics
    /// When the product cannot be started.
    pub fn contestant(&self, index: usize) -> Result<Contestant, SetupError> {
        let at = |end: &str| self.folder.join(format!("{}-{end}.socket", NAMES[index]));
        let controls = [
            ControlListener::open(&at("near"))?,
            ControlListener::open(&at("far"))?,
        ];
        let peer = match index {
            DIRECT => ADDRESSES[1],
            RATTAN => RATTAN_RIGHT,
            _ => INSIDE[1],
        };
        let words = |control: &ControlListener, kind: &str| {
            let path = control.path().display().to_string();
            vec![
                self.executable.to_owned(),
                kind.to_owned(),
                path,
                peer.to_string(),
            ]
        };
        let programs = [words(&controls[0], "--ping"), words(&controls[1], "--echo")];
        let mut hosts = match index {
            DIRECT => vec![
                self.again(0, &programs[0][1..])?,
                self.again(1, &programs[1][1..])?,
            ],
            RELAY => vec![self.relay(0, &programs[0])?, self.relay(1, &programs[1])?],
            RATTAN => vec![self.rattan(&programs)?],
            _ => self.product(NAMES[index], &programs)?,
        };
        let [near, far] = controls
            .each_ref()
            .map(|control| await_program(control, &mut hosts));
        let mut contestant = Contestant {
            near: near?,
            far: far?,
            hosts,
        };
        let deadline = Instant::now() + LIMIT;
        let turn = Duration::from_millis(20);
        while contestant
            .near
            .ping(64, turn, Duration::ZERO)?
            .half_ns
            .is_empty()
        {
            if Instant::now() > deadline {
                return Err(format!("{}: no echo within {LIMIT:?}", NAMES[index]).into());
            }
        }
        Ok(contestant)
    }

    fn relay(&self, index: usize, program: &[String]) -> Result<ChildGuard, SetupError> {
        let end = |index: usize| format!("{}:{RELAY_PORT}", ADDRESSES[index]);
        let wait = if self.wait == WaitMode::Spin {
            "spin"
        } else {
            "block"
        };
        let words = [
            "--relay",
            &end(index),
            &end(1 - index),
            &INSIDE[index].to_string(),
            wait,
        ];
        self.again(index, &[&words.map(str::to_owned)[..], program].concat())
    }

    /// One thread moves the frames, on the processor that the kernel chooses.
    fn rattan(&self, programs: &[Vec<String>; 2]) -> Result<ChildGuard, SetupError> {
        let [left, right] = [0, 1].map(|index| {
            let pin = self.pins[index].map(|cpu| {
                ["taskset", "-c"]
                    .map(str::to_owned)
                    .into_iter()
                    .chain([cpu.to_string()])
            });
            let words = pin
                .into_iter()
                .flatten()
                .chain(programs[index].iter().cloned());
            json!(words.collect::<Vec<_>>())
        });
        let file = self.folder.write(
            "rattan.toml",
            &format!(
                "[env]\nmode = \"Isolated\"\n[links]\nleft = \"right\"\nright = \"left\"\n\
                 [resource]\ncpu = [0]\n[commands]\nleft = {left}\nright = {right}\n"
            ),
        );
        let program = self.rattan.ok_or("rattan is not here")?;
        let mut command = Command::new(program);
        command
            .args(["run", "-c"])
            .arg(file)
            .env("RUST_LOG", "error");
        Ok(ChildGuard::spawn(&mut command)?)
    }

    fn product(
        &self,
        name: &str,
        programs: &[Vec<String>; 2],
    ) -> Result<Vec<ChildGuard>, SetupError> {
        let is_plain = name == "plain";
        let [control_port, link_port] = RUN_PORTS[usize::from(is_plain)];
        let [near, far] = programs.each_ref().map(|program| json!(program));
        let wait = json!(self.wait);
        let span_s = self.span.as_secs();
        let ([a, b], [inside_a, inside_b]) = (ADDRESSES, INSIDE);
        let mut text = format!(
            r#"version = 1
name = "{name}"
[run]
duration = "{span_s} s"
peer_timeout = "1 h"
[hosts]
near-pc = {{ address = "{a}", control_port = {control_port} }}
far-pc = {{ address = "{b}", control_port = {control_port} }}
[processes]
near = {{ host = "near-pc", run = {near}, inside = "{inside_a}" }}
far = {{ host = "far-pc", run = {far}, inside = "{inside_b}" }}
[channels]
out = {{ from = "near", to = "far", link = "hop" }}
back = {{ from = "far", to = "near", link = "hop" }}
[links.hop]
via = "udp"
port = {link_port}
gateway.wait = {wait}
[security]
"#
        );
        if is_plain {
            writeln!(text, "hops = \"plain\"")?;
        }
        let topology = self.folder.write(format!("{name}.toml"), &text);
        let trial = Trial::of(&topology, &self.folder.join(name));
        let start =
            |index: usize| on_cpu(self.pins[index], || trial.start_on(self.lab.host(index)));
        Ok(vec![start(0)?, start(1)?])
    }
}

fn await_program(
    control: &ControlListener,
    hosts: &mut [ChildGuard],
) -> Result<Program, SetupError> {
    let deadline = Instant::now() + LIMIT;
    loop {
        if let Some(program) = control.answer()? {
            return Ok(program);
        }
        let mut ended = hosts
            .iter_mut()
            .filter_map(|host| (!host.is_running()).then_some(host));
        let name = control.path().display();
        if let Some(host) = ended.next() {
            let finished = host.wait_within(LIMIT)?;
            let said = finished.stderr.trim();
            return Err(format!("{name}: {}: {said}", finished.status).into());
        }
        if Instant::now() > deadline {
            return Err(format!("{name}: nobody within {LIMIT:?}").into());
        }
        thread::sleep(Duration::from_millis(5));
    }
}

impl Contestant {
    /// All processes, the programs included.
    fn processes(&self) -> Vec<Pid> {
        self.hosts
            .iter()
            .flat_map(|host| family(host.pid()))
            .collect()
    }

    /// Processor time of what carries the frames, nanoseconds.
    pub fn carrier_ns(&self) -> u64 {
        let mut carriers = self.processes();
        carriers.retain(|process| ![self.near.pid, self.far.pid].contains(process));
        processor_ns(&carriers)
    }

    /// Stops all of its processes, or has them go on.
    pub fn signal(&self, signal: Signal) {
        let mut processes = self.processes();
        if signal == Signal::SIGCONT {
            // Children before those who look after them.
            processes.reverse();
        }
        for process in processes {
            // Fails only if it ended in between.
            let _gone = kill(process, signal).is_err();
        }
    }

    /// Ends it, as the end of its programs does.
    ///
    /// # Errors
    /// When a part of it failed, or goes on.
    pub fn end(self) -> Result<(), SetupError> {
        drop((self.near, self.far));
        for mut host in self.hosts {
            let finished = host.wait_within(LIMIT)?;
            if !finished.status.success() {
                let said = finished.stderr.trim().to_owned();
                return Err(format!("{}: {said}", finished.status).into());
            }
        }
        Ok(())
    }
}
