//! How a recorder stands against its run: every thread of it gives way, those too that it starts
//! later, and none is left behind when it may give way no longer.

use std::collections::BTreeSet;
use std::fs;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::ChildGuard;
use hil_tests::mcap_file::info;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use nix::sched::{CpuSet, sched_getaffinity, sched_setaffinity};
use nix::sys::signal::Signal;
use nix::unistd::Pid;

const LIMIT: Duration = Duration::from_mins(2);
/// As the kernel numbers them.
const OTHER: u32 = 0;
const BATCH: u32 = 3;
const IDLE: u32 = 5;
/// Threads that want the recorder's processor.
const BUSY_COUNT: usize = 4;

/// The threads of a process, with their policies, field 41 of `stat`.
fn threads(process: &ChildGuard) -> Vec<(Pid, u32)> {
    let folder = format!("/proc/{}/task", process.pid());
    let entries = fs::read_dir(folder).unwrap();
    let policies = entries.filter_map(|entry| {
        let path = entry.ok()?.path();
        // One that has ended meanwhile is none.
        let text = fs::read_to_string(path.join("stat")).ok()?;
        let (_, after_name) = text.rsplit_once(')')?;
        let policy = after_name.split_whitespace().nth(38)?.parse().ok()?;
        let number = path.file_name()?.to_str()?.parse().ok()?;
        Some((Pid::from_raw(number), policy))
    });
    policies.collect()
}

/// But for the one thread, or two of a server that records, that watch over the others.
fn policies(process: &ChildGuard) -> BTreeSet<u32> {
    let all: Vec<u32> = threads(process)
        .into_iter()
        .map(|(_, policy)| policy)
        .collect();
    let watchers = all.iter().filter(|policy| **policy == BATCH).count();
    assert!(watchers <= 2, "{all:?}");
    let others = all.into_iter().filter(|policy| *policy != BATCH);
    others.collect()
}

/// A run that goes on for as long as anybody looks, and its name.
fn start(folder: &RunFolder, label: &str) -> (ChildGuard, String) {
    let name = format!("{label}-{}", std::process::id());
    let trial = Trial::shipped("shuttle-local.toml", folder.path())
        .set(&format!("name=\"{name}\""))
        .set("run.duration=\"300 s\"");
    let run = trial.start_here();
    let _files = trial.folder("", LIMIT);
    (run, name)
}

fn end(run: &mut ChildGuard) {
    run.signal(Signal::SIGINT).unwrap();
    run.wait_within(LIMIT).unwrap();
}

/// Ends the busy threads also when what they are there for fails.
struct End<'a>(&'a AtomicBool);

impl Drop for End<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Runs `what` while other threads keep the processor `cpu` busy.
fn with_busy(cpu: usize, what: impl FnOnce()) {
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        for _ in 0..BUSY_COUNT {
            scope.spawn(|| {
                pin(Pid::from_raw(0), cpu);
                while !is_over.load(Ordering::Relaxed) {
                    core::hint::spin_loop();
                }
            });
        }
        let _end = End(&is_over);
        what();
    });
}

fn pin(thread: Pid, cpu: usize) {
    let mut one = CpuSet::new();
    one.set(cpu).unwrap();
    // A thread that has ended needs none.
    let _is_pinned = sched_setaffinity(thread, &one).is_ok();
}

fn first_cpu() -> usize {
    let all = sched_getaffinity(Pid::from_raw(0)).unwrap();
    let mut numbers = 0..CpuSet::count();
    numbers.find(|cpu| all.is_set(*cpu).unwrap()).unwrap()
}

#[test]
fn every_thread_of_a_recorder_gives_way_and_none_is_left_behind_when_it_is_raised() {
    let folder = RunFolder::new("priority");
    let output = RunFolder::new("priority-files");
    let (mut run, name) = start(&folder, "priority");
    let mut command = Command::new(hil_recorder_binary());
    command.args(["record", &name, "--wait", "--split-time", "1s", "-o"]);
    let mut recorder = ChildGuard::spawn(command.arg(output.join("part.mcap"))).unwrap();
    let part = |number: usize| output.join(format!("part_{number:04}.mcap"));
    // Each file has a thread of its own.
    wait_until(LIMIT, "the second file", || part(2).exists());
    let before = policies(&recorder);
    if before == BTreeSet::from([IDLE]) {
        let cpu = first_cpu();
        with_busy(cpu, || {
            wait_until(LIMIT, "a recorder that is kept waiting", || {
                for (thread, _) in threads(&recorder) {
                    pin(thread, cpu);
                }
                policies(&recorder) == BTreeSet::from([OTHER])
            });
        });
        let done = (1..10_000).find(|number| !part(*number).exists()).unwrap();
        wait_until(LIMIT, "a file that was begun later", || {
            part(done + 1).exists()
        });
    }
    assert_eq!(policies(&recorder), BTreeSet::from([OTHER]));
    recorder.signal(Signal::SIGINT).unwrap();
    let finished = recorder.wait_within(LIMIT).unwrap();
    println!("{}", finished.stderr);
    assert_eq!(finished.status.code(), Some(130), "{}", finished.stderr);
    end(&mut run);
    let last = (1..10_000)
        .take_while(|number| part(*number).exists())
        .last();
    let said = info(&part(last.unwrap()));
    let said = said["metadata"]["hil.recording"]["priority"]
        .as_str()
        .unwrap();
    println!("{said}");
    // On a busy host it may have been kept waiting before anybody looked.
    if before == BTreeSet::from([IDLE]) || said.starts_with("SCHED_IDLE") {
        assert!(
            said.starts_with("SCHED_IDLE until it had no processor time for "),
            "{said}"
        );
        assert!(finished.stderr.contains("gave way to all else until"));
    } else {
        // Without the right to come back it does not begin, and says so.
        assert!(said.starts_with("SCHED_OTHER; EPERM"), "{said}");
        assert!(finished.stderr.contains("does not give way"));
    }
}

#[test]
fn a_server_gives_way_as_a_whole_unless_told_otherwise() {
    let folder = RunFolder::new("serve-priority");
    let (mut run, name) = start(&folder, "serve-priority");
    let file = folder.join("served.mcap");
    let serve = |more: &[&str]| {
        let mut command = Command::new(hil_recorder_binary());
        command.args(["serve", &name, "--wait", "--port", "0", "--http-port", "0"]);
        let mut server = ChildGuard::spawn(command.args(more)).unwrap();
        server.wait_for_output("viewers ws://", LIMIT).unwrap();
        if more.contains(&"--record") {
            let partial = folder.join("served.mcap.partial");
            wait_until(LIMIT, "its file", || partial.is_file());
        }
        let found = policies(&server);
        server.signal(Signal::SIGINT).unwrap();
        let finished = server.wait_within(LIMIT).unwrap();
        (found, finished.stderr)
    };
    let (normal, _) = serve(&["--priority", "normal"]);
    assert_eq!(normal, BTreeSet::from([OTHER]));
    let (found, said) = serve(&["--record", file.to_str().unwrap(), "--no-scene"]);
    if said.contains("does not give way") {
        assert_eq!(found, BTreeSet::from([OTHER]), "{said}");
    } else if !said.contains("until others left it") {
        assert_eq!(found, BTreeSet::from([IDLE]), "{said}");
    }
    end(&mut run);
    let said = info(&file)["metadata"]["hil.recording"]["priority"].to_string();
    assert!(said.contains("SCHED_"), "{said}");
}
