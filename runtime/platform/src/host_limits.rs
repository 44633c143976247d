//! What the kernel lets the processes of a run have at a time: threads and memory, by whichever bound is
//! narrowest. What it does not tell is left out: it is no bound that could be named.

use core::fmt;
use std::path::{Path, PathBuf};

use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit};
use nix::unistd::Uid;

use crate::host_facts::{CAP_IPC_LOCK, CAP_SYS_ADMIN, CAP_SYS_RESOURCE, Fact, HostFiles};

/// What bounds something.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Bound {
    /// `RLIMIT_NPROC` of the user.
    UserThreads,
    /// `pids.max` of a control group, at this folder.
    GroupThreads(PathBuf),
    /// `kernel.threads-max`.
    KernelThreads,
    /// `kernel.pid_max`.
    KernelIds,
    /// The memory of the machine.
    Memory,
    /// The memory of a control group, at this folder.
    GroupMemory(PathBuf),
    /// `RLIMIT_MEMLOCK`.
    LockedMemory,
}

impl Bound {
    /// How to widen it.
    pub fn cure(&self) -> String {
        match self {
            Self::UserThreads => {
                "ulimit -u, or LimitNPROC= in the unit, or end other programs of this user"
                    .to_owned()
            }
            Self::GroupThreads(_) => {
                "TasksMax= in the unit (--pids-limit for a container)".to_owned()
            }
            Self::KernelThreads => "sysctl -w kernel.threads-max=N".to_owned(),
            Self::KernelIds => "sysctl -w kernel.pid_max=N".to_owned(),
            Self::Memory => "end what takes the memory, or add some".to_owned(),
            Self::GroupMemory(_) => "MemoryMax= in the unit (--memory for a container)".to_owned(),
            Self::LockedMemory => {
                "LimitMEMLOCK=infinity in the unit, or memlock in /etc/security/limits.d".to_owned()
            }
        }
    }
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UserThreads => f.write_str("RLIMIT_NPROC"),
            Self::GroupThreads(folder) => write!(f, "pids.max in {}", folder.display()),
            Self::KernelThreads => f.write_str("kernel.threads-max"),
            Self::KernelIds => f.write_str("kernel.pid_max"),
            Self::Memory => f.write_str("the memory of this host"),
            Self::GroupMemory(folder) => write!(f, "the memory limit in {}", folder.display()),
            Self::LockedMemory => f.write_str("RLIMIT_MEMLOCK"),
        }
    }
}

/// What is left below a bound.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Headroom {
    /// The bound.
    pub bound: Bound,
    /// Threads, or bytes.
    pub left: u64,
}

/// How many threads this user may start from here, by each bound that is told.
pub fn thread_headroom(files: &HostFiles) -> Vec<Headroom> {
    let mut found = Vec::new();
    let mut add = |bound, max: Option<u64>, used: Option<u64>| {
        if let (Some(max), Some(used)) = (max, used) {
            let left = max.saturating_sub(used);
            found.push(Headroom { bound, left });
        }
    };
    if !is_exempt_from_user_threads(files)
        && let Ok((soft, _)) = getrlimit(Resource::RLIMIT_NPROC)
    {
        let max = (soft != RLIM_INFINITY).then_some(soft);
        let used = max.and_then(|_| user_threads(files, Uid::current()));
        add(Bound::UserThreads, max, used);
    }
    for folder in group_folders(files, "pids") {
        let number = |name| number_in(files, &folder, name);
        add(
            Bound::GroupThreads(folder.clone()),
            number("pids.max"),
            number("pids.current"),
        );
    }
    let all = threads_of_all(files);
    let kernel = |path| known(files.read_number(path)).and_then(|value| u64::try_from(value).ok());
    add(
        Bound::KernelThreads,
        kernel("/proc/sys/kernel/threads-max"),
        all,
    );
    add(Bound::KernelIds, kernel("/proc/sys/kernel/pid_max"), all);
    found
}

/// How many bytes of memory are to be had, by each bound that is told.
pub fn memory_headroom(files: &HostFiles) -> Vec<Headroom> {
    let mut found = Vec::new();
    let available = known(files.read_field("/proc/meminfo", "MemAvailable"));
    if let Some(left) = available.as_deref().and_then(kibibytes) {
        found.push(Headroom {
            bound: Bound::Memory,
            left,
        });
    }
    for folder in group_folders(files, "memory") {
        let number = |name| number_in(files, &folder, name);
        let (max, used) = (
            number("memory.max").or_else(|| number("memory.limit_in_bytes")),
            number("memory.current").or_else(|| number("memory.usage_in_bytes")),
        );
        // What the group holds of files on disks is given up when it is short.
        let held = known(files.read(&joined(&folder, "memory.stat")));
        let held = held.as_deref().and_then(|text| {
            let of = |name: &str| {
                text.lines()
                    .find_map(|line| line.strip_prefix(name)?.trim().parse().ok())
            };
            of("total_inactive_file ").or_else(|| of("inactive_file "))
        });
        if let (Some(max), Some(used)) = (max, used) {
            let used = used.saturating_sub(held.unwrap_or(0));
            found.push(Headroom {
                bound: Bound::GroupMemory(folder.clone()),
                left: max.saturating_sub(used),
            });
        }
    }
    found
}

/// How many bytes a process of this user may lock; `None` where there is no bound.
pub fn locked_memory_bound(files: &HostFiles) -> Option<Headroom> {
    if files.holds_capability(CAP_IPC_LOCK) != Fact::Available(false) {
        return None;
    }
    let (soft, _) = getrlimit(Resource::RLIMIT_MEMLOCK).ok()?;
    (soft != RLIM_INFINITY).then_some(Headroom {
        bound: Bound::LockedMemory,
        left: soft,
    })
}

/// The kernel lets root, and whoever has either of two capabilities, start as many as there is room for.
fn is_exempt_from_user_threads(files: &HostFiles) -> bool {
    let holds = |capability| files.holds_capability(capability) == Fact::Available(true);
    Uid::current().is_root() || holds(CAP_SYS_RESOURCE) || holds(CAP_SYS_ADMIN)
}

fn known<T>(fact: Fact<T>) -> Option<T> {
    match fact {
        Fact::Available(value) => Some(value),
        Fact::Unavailable(_) => None,
    }
}

/// Bytes of `16 kB`.
fn kibibytes(text: &str) -> Option<u64> {
    let number = text.strip_suffix("kB")?.trim();
    number.parse::<u64>().ok()?.checked_mul(1024)
}

/// Threads that a user has, as the kernel counts them against its limit.
fn user_threads(files: &HostFiles, user: Uid) -> Option<u64> {
    let processes = known(files.list("/proc"))?;
    let is_number = |name: &&String| name.bytes().all(|byte| byte.is_ascii_digit());
    let own = processes.iter().filter(is_number).filter_map(|process| {
        let status = known(files.read(&format!("/proc/{process}/status")))?;
        let field = |name: &str| status.lines().find_map(|line| line.strip_prefix(name));
        let real: u32 = field("Uid:")?.split_whitespace().next()?.parse().ok()?;
        let threads: u64 = field("Threads:")?.trim().parse().ok()?;
        (real == user.as_raw()).then_some(threads)
    });
    Some(own.sum())
}

/// `0.00 0.01 0.05 1/345 6789`: the second number of the fourth word.
fn threads_of_all(files: &HostFiles) -> Option<u64> {
    let text = known(files.read("/proc/loadavg"))?;
    text.split_whitespace()
        .nth(3)?
        .split_once('/')?
        .1
        .parse()
        .ok()
}

/// The folders of the control groups that this process is in for `controller`, the narrowest first, as
/// far as they are seen from here.
fn group_folders(files: &HostFiles, controller: &str) -> Vec<PathBuf> {
    let Some(text) = known(files.read("/proc/self/cgroup")) else {
        return Vec::new();
    };
    let mut folders = Vec::new();
    for line in text.lines() {
        // `4:memory:/a/b`, or `0::/a/b` of the second version.
        let mut parts = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (parts.next(), parts.next()) else {
            continue;
        };
        let root = if controllers.is_empty() {
            PathBuf::from("/sys/fs/cgroup")
        } else if controllers.split(',').any(|one| one == controller) {
            Path::new("/sys/fs/cgroup").join(controller)
        } else {
            continue;
        };
        let below = Path::new(path.trim_start_matches('/'));
        folders.extend(below.ancestors().map(|part| root.join(part)));
    }
    folders
}

fn joined(folder: &Path, name: &str) -> String {
    folder.join(name).display().to_string()
}

/// The number in a file of a group; `None` for `max` and where there is none.
fn number_in(files: &HostFiles, folder: &Path, name: &str) -> Option<u64> {
    known(files.read(&joined(folder, name)))?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    fn group(name: &str) -> PathBuf {
        Path::new("/sys/fs/cgroup").join(name)
    }

    #[test]
    fn the_bounds_of_a_unit_and_of_the_groups_above_it_are_all_told() {
        let host = FakeHost::with(&[
            ("/proc/self/cgroup", "0::/system.slice/hil.service\n"),
            ("/sys/fs/cgroup/system.slice/hil.service/pids.max", "100"),
            ("/sys/fs/cgroup/system.slice/hil.service/pids.current", "30"),
            ("/sys/fs/cgroup/system.slice/pids.max", "max"),
            ("/sys/fs/cgroup/system.slice/pids.current", "300"),
            ("/sys/fs/cgroup/system.slice/hil.service/memory.max", "1000"),
            (
                "/sys/fs/cgroup/system.slice/hil.service/memory.current",
                "900",
            ),
            (
                "/sys/fs/cgroup/system.slice/hil.service/memory.stat",
                "anon 5\ninactive_file 400\n",
            ),
            ("/proc/loadavg", "0.00 0.01 0.05 1/345 6789"),
            ("/proc/sys/kernel/threads-max", "1000"),
            ("/proc/meminfo", "MemTotal:  16 kB\nMemAvailable:  9 kB\n"),
        ]);
        let threads = thread_headroom(&host.files());
        let unit = "system.slice/hil.service";
        let of = |bound: Bound, left| Headroom { bound, left };
        assert!(
            threads.contains(&of(Bound::GroupThreads(group(unit)), 70)),
            "{threads:?}"
        );
        assert!(
            threads.contains(&of(Bound::KernelThreads, 655)),
            "{threads:?}"
        );
        let groups = threads
            .iter()
            .filter(|one| matches!(one.bound, Bound::GroupThreads(_)));
        assert_eq!(groups.count(), 1);
        let memory = memory_headroom(&host.files());
        let expected = [
            of(Bound::Memory, 9 * 1024),
            of(Bound::GroupMemory(group(unit)), 500),
        ];
        assert_eq!(memory, expected);
    }

    #[test]
    fn groups_of_the_first_version_have_a_folder_for_each_controller() {
        let host = FakeHost::with(&[
            ("/proc/self/cgroup", "8:cpu,pids:/a\n4:memory:/b\n0::/\n"),
            ("/sys/fs/cgroup/pids/a/pids.max", "10"),
            ("/sys/fs/cgroup/pids/a/pids.current", "12"),
            ("/sys/fs/cgroup/memory/b/memory.limit_in_bytes", "100"),
            ("/sys/fs/cgroup/memory/b/memory.usage_in_bytes", "40"),
        ]);
        let threads = thread_headroom(&host.files());
        let full = Headroom {
            bound: Bound::GroupThreads(group("pids/a")),
            left: 0,
        };
        assert!(threads.contains(&full), "{threads:?}");
        let memory = memory_headroom(&host.files());
        let left: Vec<u64> = memory.iter().map(|one| one.left).collect();
        assert_eq!(left, [60]);
    }

    #[test]
    fn threads_of_a_user_are_counted_by_the_real_one() {
        let host = FakeHost::with(&[
            (
                "/proc/7/status",
                "Name:\ta\nUid:\t1000\t0\t0\t0\nThreads:\t3\n",
            ),
            (
                "/proc/8/status",
                "Name:\tb\nUid:\t0\t1000\t0\t0\nThreads:\t9\n",
            ),
            (
                "/proc/9/status",
                "Name:\tc\nUid:\t1000\t1000\t0\t0\nThreads:\t2\n",
            ),
            ("/proc/uptime", "1 2"),
        ]);
        assert_eq!(user_threads(&host.files(), Uid::from_raw(1000)), Some(5));
    }

    #[test]
    fn a_silent_host_has_no_bound_that_could_be_named() {
        let silent = FakeHost::with(&[]);
        assert_eq!(memory_headroom(&silent.files()), []);
        assert!(
            thread_headroom(&silent.files())
                .iter()
                .all(|one| one.bound == Bound::UserThreads)
        );
    }
}
