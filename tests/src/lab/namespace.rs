//! Named network namespaces through `ip netns`: made, joined, removed, and swept when the process
//! named in them is gone. Every name carries its owner, so no other program's namespace is touched.

use std::fs;
use std::process::{self, Command};
use std::sync::atomic::{AtomicUsize, Ordering};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::SETUP_LIMIT;
use crate::child;
use crate::machine_lock::machine_lock;

const NAMESPACE_FOLDER: &str = "/run/netns";
const PREFIX: &str = "hil-lab";

/// Two names nobody else uses: prefix, owner's process identifier and start time, lab, host.
///
/// The start time tells a living owner from a later process with the same identifier.
pub(super) fn fresh_names() -> [String; 2] {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    let index = NEXT.fetch_add(1, Ordering::Relaxed);
    let owner = process::id();
    let started = start_time(owner).unwrap_or(0);
    [0, 1].map(|host| format!("{PREFIX}-{owner}-{started}-{index}-{host}"))
}

/// Runs `ip` with these arguments, bounded in time.
pub(super) fn ip(arguments: &[&str]) -> Result<(), String> {
    child::run(Command::new("ip").args(arguments), SETUP_LIMIT).map(drop)
}

pub(super) fn add(name: &str) -> Result<(), String> {
    // The first namespace of a machine makes the folder a shared mount; two at once may stack it.
    let _held = machine_lock("namespaces");
    ip(&["netns", "add", name])
}

/// Lays a cable between the two namespaces: a veth pair with `interface` at both ends.
pub(super) fn join(names: &[String; 2], interface: &str) -> Result<(), String> {
    let [first, second] = names;
    ip(&[
        "link", "add", interface, "netns", first, "type", "veth", "peer", "name", interface,
        "netns", second,
    ])
}

/// Kills what runs in a namespace of ours and removes it. Used on drop and on stale ones, so it
/// reports nothing: what is left is swept by the next lab.
pub(super) fn remove(name: &str) {
    for _attempt in 0..3 {
        let processes = processes_in(name);
        if processes.is_empty() {
            break;
        }
        for process in processes {
            // Fails only if it ended in between.
            kill(process, Signal::SIGKILL).ok();
        }
    }
    drop(ip(&["netns", "delete", name]));
}

fn processes_in(name: &str) -> Vec<Pid> {
    let listed = child::run(
        Command::new("ip").args(["netns", "pids", name]),
        SETUP_LIMIT,
    );
    let Ok(listed) = listed else {
        return Vec::new();
    };
    let own = Pid::this();
    let numbers = listed
        .stdout
        .lines()
        .filter_map(|line| line.trim().parse().ok());
    numbers
        .map(Pid::from_raw)
        .filter(|process| *process != own && is_alive(*process))
        .collect()
}

/// A killed process stays listed until its parent reaps it.
fn is_alive(process: Pid) -> bool {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    let state = stat
        .rsplit_once(')')
        .and_then(|(_, rest)| rest.trim_start().chars().next());
    !matches!(state, None | Some('Z' | 'X'))
}

/// Removes the labs whose owner is gone.
pub(super) fn sweep_stale() {
    let Ok(entries) = fs::read_dir(NAMESPACE_FOLDER) else {
        return;
    };
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if is_stale(&name) {
            remove(&name);
        }
    }
}

/// A name of ours whose owner no longer runs. A name of another form is nobody we know.
fn is_stale(name: &str) -> bool {
    let Some(rest) = name
        .strip_prefix(PREFIX)
        .and_then(|rest| rest.strip_prefix('-'))
    else {
        return false;
    };
    let numbers: Vec<u64> = rest
        .split('-')
        .filter_map(|part| part.parse().ok())
        .collect();
    let [owner, started, _lab, _host] = numbers[..] else {
        return false;
    };
    u32::try_from(owner).is_ok_and(|owner| start_time(owner) != Some(started))
}

/// When a process started, in clock ticks since boot (`proc(5)`, `stat`, field 22).
fn start_time(process: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The second field is the program's name in brackets and may hold anything, brackets included.
    let (_, after_name) = stat.rsplit_once(')')?;
    after_name.split_whitespace().nth(22 - 3)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_labs_of_dead_owners_are_stale() {
        let [mine, _] = fresh_names();
        assert!(!is_stale(&mine));
        let (owner, started) = (process::id(), start_time(process::id()).unwrap());
        for (name, expected) in [
            // The identifier came round: same number, another start.
            (format!("{PREFIX}-{owner}-{}-0-0", started + 1), true),
            (format!("{PREFIX}-4194305-5-0-0"), true),
            (format!("{PREFIX}-{owner}"), false),
            ("hil-lab-notes".to_owned(), false),
            ("production".to_owned(), false),
        ] {
            assert_eq!(is_stale(&name), expected, "{name}");
        }
    }

    #[test]
    fn names_do_not_repeat() {
        let (first, second) = (fresh_names(), fresh_names());
        assert_ne!(first[0], first[1]);
        assert_ne!(first, second);
    }
}
