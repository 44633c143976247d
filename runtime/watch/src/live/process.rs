//! What the kernel says of a running process: processor time, processors it may use, how it is
//! scheduled. It reads `/proc` and changes nothing.

use std::collections::BTreeSet;
use std::fs;

/// One look at a process.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct ProcessLook {
    /// Processor time of its living threads, nanoseconds.
    pub(crate) cpu_ns: Option<u64>,
    /// Processors its threads may run on, as the kernel lists them.
    pub(crate) cpus: Option<String>,
    /// Policy and priority of the thread that goes first.
    pub(crate) scheduling: Option<String>,
}

/// Looks at process `pid`; everything is `None` when it is gone.
pub(crate) fn look(pid: u32) -> ProcessLook {
    let folder = format!("/proc/{pid}/task");
    let Ok(entries) = fs::read_dir(folder) else {
        return ProcessLook::default();
    };
    let mut found = ProcessLook::default();
    let (mut cpus, mut highest) = (BTreeSet::new(), None);
    for entry in entries.flatten() {
        let read = |name: &str| fs::read_to_string(entry.path().join(name)).ok();
        if let Some(cpu_ns) = read("schedstat").and_then(|text| cpu_ns(&text)) {
            *found.cpu_ns.get_or_insert(0) += cpu_ns;
        }
        cpus.extend(read("status").and_then(|text| allowed(&text)));
        highest = highest.max(read("stat").and_then(|text| scheduling(&text)));
    }
    found.cpus = narrowest(cpus);
    found.scheduling = highest.map(|(priority, policy)| match policy {
        1 => format!("fifo {priority}"),
        2 => format!("rr {priority}"),
        3 => "batch".to_owned(),
        5 => "idle".to_owned(),
        6 => "deadline".to_owned(),
        _ => "other".to_owned(),
    });
    found
}

/// First number of `schedstat`: time on a processor, nanoseconds.
fn cpu_ns(schedstat: &str) -> Option<u64> {
    schedstat.split_whitespace().next()?.parse().ok()
}

fn allowed(status: &str) -> Option<String> {
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?;
    Some(line.trim().to_owned())
}

/// Priority (field 40 of `stat`) and policy (field 41); names before the last bracket may hold
/// anything.
fn scheduling(stat: &str) -> Option<(u32, u32)> {
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace().skip(37);
    let priority = fields.next()?.parse().ok()?;
    Some((priority, fields.next()?.parse().ok()?))
}

/// Where the threads that were given a place may run; where all may, if none was.
fn narrowest(lists: BTreeSet<String>) -> Option<String> {
    let is_wide = |list: &&String| list.contains(['-', ',']);
    let pinned: Vec<&str> = lists
        .iter()
        .filter(|list| !is_wide(list))
        .map(String::as_str)
        .collect();
    if pinned.is_empty() {
        return lists.into_iter().next();
    }
    Some(pinned.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_process_is_seen_and_a_missing_one_is_not() {
        let seen = look(std::process::id());
        assert!(seen.cpus.is_some() && seen.scheduling.is_some());
        assert_eq!(look(u32::MAX), ProcessLook::default());
    }

    #[test]
    fn fields_are_those_of_the_kernels_manual() {
        let fields: Vec<String> = (3..=52).map(|number| number.to_string()).collect();
        let stat = format!("7 (a) b) {}", fields.join(" "));
        assert_eq!(scheduling(&stat), Some((40, 41)));
        assert_eq!(cpu_ns("123 4 5\n"), Some(123));
        assert_eq!(
            allowed("Name:\tx\nCpus_allowed_list:\t0-3\n"),
            Some("0-3".to_owned())
        );
    }

    #[test]
    fn a_pinned_thread_says_more_than_one_that_may_run_anywhere() {
        let of = |lists: &[&str]| narrowest(lists.iter().map(|&one| one.to_owned()).collect());
        assert_eq!(of(&["0-3", "2", "1"]), Some("1,2".to_owned()));
        assert_eq!(of(&["0-3"]), Some("0-3".to_owned()));
        assert_eq!(of(&[]), None);
    }
}
