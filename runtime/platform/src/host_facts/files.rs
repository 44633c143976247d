//! Reads the kernel's text files (`/proc`, `/sys`, `/etc`) below a root that tests can move.
//! It writes nothing and interprets nothing beyond numbers and CPU lists.

use std::path::PathBuf;
use std::{fs, io};

use super::Fact;

/// The kernel's text files of this host, or a copy of them below another root.
#[derive(Debug, Clone)]
pub struct HostFiles {
    root: PathBuf,
}

impl Default for HostFiles {
    fn default() -> Self {
        Self::of_this_host()
    }
}

impl HostFiles {
    /// The files of the running host.
    pub fn of_this_host() -> Self {
        Self::under("/")
    }

    /// A copy of a host's files below `root`, for example one sent in with a fault report.
    pub fn under(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// Where the absolute path `path` of the host lies on this machine.
    pub fn locate(&self, path: &str) -> PathBuf {
        self.root.join(path.trim_start_matches('/'))
    }

    /// The text of a file without the white space around it.
    pub fn read(&self, path: &str) -> Fact<String> {
        match fs::read(self.locate(path)) {
            Ok(bytes) => Fact::Available(String::from_utf8_lossy(&bytes).trim().to_owned()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Fact::Unavailable(format!("this kernel has no {path}"))
            }
            Err(error) => Fact::Unavailable(format!("{path}: {error}")),
        }
    }

    /// A file that holds one whole number.
    pub fn read_number(&self, path: &str) -> Fact<i64> {
        self.read(path).and_then(|text| match text.parse() {
            Ok(number) => Fact::Available(number),
            Err(_not_a_number) => Fact::Unavailable(format!("{path}: `{text}` is not a number")),
        })
    }

    /// A file that holds a CPU list such as `0-3,8`.
    pub fn read_cpu_list(&self, path: &str) -> Fact<Vec<usize>> {
        self.read(path)
            .and_then(|text| match parse_cpu_list(&text) {
                Some(cpus) => Fact::Available(cpus),
                None => Fact::Unavailable(format!("{path}: `{text}` is not a list of CPUs")),
            })
    }

    /// The names in a folder, sorted.
    pub fn list(&self, path: &str) -> Fact<Vec<String>> {
        Fact::of(path, fs::read_dir(self.locate(path))).map(|entries| {
            let mut names: Vec<String> = entries
                .flatten()
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .collect();
            names.sort();
            names
        })
    }

    /// The names of the processes that this one can see, cut at fifteen bytes as the kernel does.
    pub fn process_names(&self) -> Fact<Vec<String>> {
        self.list("/proc").and_then(|entries| {
            let is_number = |name: &&String| name.bytes().all(|byte| byte.is_ascii_digit());
            let names: Vec<String> = entries
                .iter()
                .filter(is_number)
                .filter_map(|process| {
                    // One that ended in between has no name any more.
                    let name = self.read(&format!("/proc/{process}/comm"));
                    name.available().cloned()
                })
                .collect();
            if names.is_empty() {
                return Fact::Unavailable("/proc shows no process".to_owned());
            }
            Fact::Available(names)
        })
    }

    /// Where the symbolic link `path` points, as it is written.
    pub fn link_target(&self, path: &str) -> Fact<String> {
        Fact::of(path, fs::read_link(self.locate(path)))
            .map(|target| target.to_string_lossy().into_owned())
    }

    /// The first number of a binary file: a signed 32-bit word in the host's order.
    pub fn read_word(&self, path: &str) -> Fact<i32> {
        let read = fs::File::open(self.locate(path)).and_then(|mut file| {
            let mut word = [0; 4];
            io::Read::read_exact(&mut file, &mut word).map(|()| i32::from_ne_bytes(word))
        });
        Fact::of(path, read)
    }

    /// The value behind `key` in a file of `key: value` lines, such as `/proc/meminfo`.
    pub fn read_field(&self, path: &str, key: &str) -> Fact<String> {
        self.read(path).and_then(|text| {
            let value = text.lines().find_map(|line| {
                let (name, value) = line.split_once(':')?;
                (name.trim() == key).then(|| value.trim().to_owned())
            });
            match value {
                Some(value) => Fact::Available(value),
                None => Fact::Unavailable(format!("{path} has no line `{key}`")),
            }
        })
    }

    /// Whether this process holds the capability with the kernel's number `capability`
    /// (`linux/capability.h`).
    pub fn holds_capability(&self, capability: u32) -> Fact<bool> {
        let field = self.read_field("/proc/self/status", "CapEff");
        field.and_then(|text| match u64::from_str_radix(&text, 16) {
            Ok(mask) => Fact::Available(mask >> capability & 1 == 1),
            Err(_not_hexadecimal) => Fact::Unavailable(format!("CapEff `{text}` is not a mask")),
        })
    }
}

/// `CAP_IPC_LOCK`: memory may be locked beyond `RLIMIT_MEMLOCK`.
pub const CAP_IPC_LOCK: u32 = 14;
/// `CAP_SYS_ADMIN`.
pub(crate) const CAP_SYS_ADMIN: u32 = 21;
/// `CAP_SYS_RESOURCE`: limits of a user do not bind.
pub(crate) const CAP_SYS_RESOURCE: u32 = 24;
/// `CAP_SYS_NICE`: real-time priorities may be taken beyond `RLIMIT_RTPRIO`.
pub const CAP_SYS_NICE: u32 = 23;

/// Largest CPU number accepted; beyond it a line is taken as damaged.
const CPU_INDEX_MAX: usize = 8191;

/// The CPUs of a kernel list such as `0-3,8`; an empty line and `(null)` mean none.
pub(crate) fn parse_cpu_list(text: &str) -> Option<Vec<usize>> {
    let text = text.trim();
    if text.is_empty() || text == "(null)" {
        return Some(Vec::new());
    }
    let mut cpus = Vec::new();
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last): (usize, usize) = (first.trim().parse().ok()?, last.trim().parse().ok()?);
        if first > last || last > CPU_INDEX_MAX {
            return None;
        }
        cpus.extend(first..=last);
    }
    cpus.sort_unstable();
    cpus.dedup();
    Some(cpus)
}

/// CPUs as people write them: `0-3,8`, or `none`.
pub fn format_cpu_list(cpus: &[usize]) -> String {
    let mut parts = Vec::new();
    let mut index = 0;
    while index < cpus.len() {
        let first = cpus[index];
        let mut last = first;
        while let Some(&next) = cpus.get(index + 1)
            && last.checked_add(1) == Some(next)
        {
            index += 1;
            last = next;
        }
        parts.push(if first == last {
            first.to_string()
        } else {
            format!("{first}-{last}")
        });
        index += 1;
    }
    if parts.is_empty() {
        "none".to_owned()
    } else {
        parts.join(",")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    #[test]
    fn cpu_lists_are_read_as_the_kernel_writes_them() {
        for (text, expected) in [
            ("", Some(vec![])),
            ("(null)\n", Some(vec![])),
            ("2", Some(vec![2])),
            ("0-3,8", Some(vec![0, 1, 2, 3, 8])),
            ("8,1-2,2", Some(vec![1, 2, 8])),
            ("3-1", None),
            ("0-99999999", None),
            ("one", None),
        ] {
            assert_eq!(parse_cpu_list(text), expected, "{text:?}");
        }
    }

    #[test]
    fn cpu_lists_are_written_as_ranges() {
        assert_eq!(format_cpu_list(&[]), "none");
        assert_eq!(format_cpu_list(&[0, 1, 2, 3, 8, 10, 11]), "0-3,8,10-11");
    }

    #[test]
    fn a_missing_file_names_itself() {
        let host = FakeHost::with(&[]);
        let Fact::Unavailable(reason) = host.files().read("/proc/nothing") else {
            panic!("an absent file was read");
        };
        assert_eq!(reason, "this kernel has no /proc/nothing");
    }

    #[test]
    fn numbers_fields_and_capabilities_are_found() {
        let host = FakeHost::with(&[
            ("/proc/sys/kernel/sched_rt_runtime_us", "-1\n"),
            (
                "/proc/self/status",
                "Name:\ttest\nCapEff:\t0000000000804000\n",
            ),
        ]);
        let files = host.files();
        let number = files.read_number("/proc/sys/kernel/sched_rt_runtime_us");
        assert_eq!(number, Fact::Available(-1));
        assert_eq!(files.holds_capability(CAP_SYS_NICE), Fact::Available(true));
        assert_eq!(files.holds_capability(CAP_IPC_LOCK), Fact::Available(true));
        assert_eq!(files.holds_capability(21), Fact::Available(false));
    }
}
