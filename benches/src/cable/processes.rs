//! The processes below one, and what they have used, from `/proc`.

use std::fs;

use nix::unistd::Pid;

/// `root` and what it has started that still runs, parents before children.
pub(super) fn family(root: Pid) -> Vec<Pid> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let numbers = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    let parents: Vec<(Pid, Pid)> = numbers
        .filter_map(|number| Some((Pid::from_raw(number), parent(number)?)))
        .collect();
    let mut family = vec![root];
    let mut next = 0;
    while let Some(&one) = family.get(next) {
        let children = parents.iter().filter(|(_, parent)| *parent == one);
        family.extend(children.map(|(child, _)| *child));
        next += 1;
    }
    family
}

fn parent(process: i32) -> Option<Pid> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The second field is a name and may hold anything.
    let (_, after_name) = stat.rsplit_once(')')?;
    let parent = after_name.split_whitespace().nth(1)?.parse().ok()?;
    Some(Pid::from_raw(parent))
}

/// Processor time that the threads of `processes` have used so far, nanoseconds.
pub(super) fn processor_ns(processes: &[Pid]) -> u64 {
    let tasks = processes.iter().flat_map(|process| {
        let tasks = fs::read_dir(format!("/proc/{process}/task"));
        tasks.into_iter().flatten().flatten()
    });
    let used = tasks.filter_map(|task| {
        let text = fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    });
    used.sum()
}

#[cfg(test)]
mod tests {
    use std::process::Command;
    use std::time::{Duration, Instant};

    use hil_tests::child::ChildGuard;

    use super::*;

    #[test]
    fn a_child_is_of_the_family_and_costs_processor_time() {
        let own = Pid::this();
        let mut command = Command::new("sh");
        let child = ChildGuard::spawn(command.args(["-c", "while :; do :; done"])).unwrap();
        assert_eq!(family(own)[0], own);
        assert!(family(own).contains(&child.pid()));
        assert_eq!(family(child.pid()), [child.pid()]);
        let deadline = Instant::now() + Duration::from_secs(20);
        while processor_ns(&[child.pid()]) == 0 && Instant::now() < deadline {
            std::thread::yield_now();
        }
        assert!(processor_ns(&[child.pid()]) > 0);
    }
}
