//! Where channels live: `/dev/shm` and the runtime folder. It looks and does not clean: removing
//! another run's segments is a decision, and the run may be alive.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access};

use super::finding::{Answer, Checked, Finding, Severity, settled};
use super::storage::{MEBIBYTE, nearest_existing};
use hil_platform::host_facts::HostFiles;
use hil_shm::{Domain, ForeignNodes};

/// Below this a handful of channels with large samples does not fit.
const FREE_BYTES_MIN: u64 = 64 * MEBIBYTE;
/// Runs named in one line.
const SHOWN_MAX: usize = 4;

pub(super) fn examine(
    files: &HostFiles,
    runtime_folders: &[PathBuf],
    nodes: Result<ForeignNodes, String>,
) -> Vec<Finding> {
    vec![
        space(&files.locate("/dev/shm")),
        settled(leftovers(files, runtime_folders)),
        settled(foreign_nodes(nodes)),
        runtime_folder(runtime_folders),
    ]
}

/// What a run of the topology would be refused for.
pub(super) fn run_limits(shortfalls: &[String]) -> Finding {
    let id = "run_limits";
    if shortfalls.is_empty() {
        return Finding::ok(id, "enough for the run");
    }
    Finding::error(id, shortfalls.join("; "))
}

fn space(shm: &Path) -> Finding {
    let id = "shared_memory";
    let absent = |error: &str| {
        Finding::error(id, format!("unavailable ({error})"))
            .fixed_by("mount -t tmpfs -o mode=1777 tmpfs /dev/shm")
    };
    let (status, metadata) = match (statvfs(shm), fs::metadata(shm)) {
        (Ok(status), Ok(metadata)) => (status, metadata),
        (Err(errno), _) => return absent(errno.desc()),
        (_, Err(error)) => return absent(&error.to_string()),
    };
    let unit = status.fragment_size();
    let free_bytes = status.blocks_available() * unit;
    let mode = metadata.permissions().mode() & 0o7777;
    let value = format!(
        "{} MiB, {} MiB free, mode {mode:04o}",
        status.blocks() * unit / MEBIBYTE,
        free_bytes / MEBIBYTE
    );
    let rights = AccessFlags::R_OK | AccessFlags::W_OK | AccessFlags::X_OK;
    if access(shm, rights).is_err() {
        Finding::error(id, value)
            .because("this user may not create segments, so no channel can be opened")
            .fixed_by("chmod 1777 /dev/shm")
    } else if free_bytes < FREE_BYTES_MIN {
        Finding::error(id, value)
    } else if mode != 0o1777 {
        Finding::note(id, value)
            .because("other users cannot create, or may remove, segments here")
            .fixed_by("chmod 1777 /dev/shm")
    } else {
        Finding::ok(id, value)
    }
}

/// Whether a file in `/dev/shm` carries the prefix of a run: `h`, eight characters, `_`.
fn is_of_a_run(name: &str) -> bool {
    let bytes = name.as_bytes();
    bytes.len() > 10
        && bytes[0] == b'h'
        && bytes[9] == b'_'
        && bytes[1..9].iter().all(u8::is_ascii_alphanumeric)
}

fn leftovers(files: &HostFiles, runtime_folders: &[PathBuf]) -> Checked {
    let id = "shared_memory_leftovers";
    let names = files.list("/dev/shm").told(id)?;
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for name in names.iter().filter(|name| is_of_a_run(name)) {
        *counts.entry(&name[..10]).or_default() += 1;
    }
    if counts.is_empty() {
        return Ok(Finding::ok(id, "none"));
    }
    let count = counts.len();
    let locks = files.read("/proc/locks").told_as(id, |reason| {
        format!("segments of {count} runs, and whether they go on is unknown: {reason}")
    })?;
    let roots = domains_below(runtime_folders);
    let (mut ended, mut unplaced, mut going, mut file_count) = (Vec::new(), Vec::new(), 0, 0);
    for (prefix, count) in counts {
        match roots.get(prefix) {
            // Its supervisor holds the lock.
            Some(root) if is_locked(&locks, root) => {
                going += 1;
                continue;
            }
            Some(_) => ended.push(format!("{prefix}*")),
            // Its folder is nowhere that this user looks.
            None => unplaced.push(format!("{prefix}*")),
        }
        file_count += count;
    }
    if file_count == 0 {
        return Ok(Finding::ok(id, format!("none; {going} runs go on")));
    }
    let kinds = [
        (ended.len(), "ended"),
        (unplaced.len(), "of which no folder is found"),
        (going, "go on, their files not counted"),
    ];
    let kinds = kinds.iter().filter(|(count, _)| *count > 0);
    let kinds = kinds.map(|(count, words)| format!("{count} {words}"));
    let kinds = kinds.collect::<Vec<_>>().join(", ");
    let unplaced_paths = unplaced.iter().map(|prefix| format!("/dev/shm/{prefix}"));
    let unplaced_paths = unplaced_paths.collect::<Vec<_>>().join(" ");
    let mut shown = [ended, unplaced].concat();
    if shown.len() > SHOWN_MAX {
        shown.truncate(SHOWN_MAX);
        shown.push("...".to_owned());
    }
    let shown = shown.join(" ");
    let finding = Finding::note(id, format!("{file_count} files, {shown}; of runs: {kinds}"));
    if unplaced_paths.is_empty() {
        return Ok(finding);
    }
    Ok(finding.fixed_by(format!(
        "if no other user's run goes on: rm {unplaced_paths}; any start of a run removes those of ended runs"
    )))
}

/// The prefix and the root of every domain in `folders`.
fn domains_below(folders: &[PathBuf]) -> BTreeMap<String, PathBuf> {
    let entries = folders.iter().flat_map(fs::read_dir).flatten().flatten();
    let roots = entries.map(|entry| entry.path());
    let with_prefix = roots.filter_map(|root| Some((Domain::prefix_at(&root)?, root)));
    with_prefix.collect()
}

/// Whether somebody holds the exclusive lock on `root`. Asking for the lock would be in the way of a
/// run that starts at this moment; the kernel's list is not.
fn is_locked(locks: &str, root: &Path) -> bool {
    let Ok(metadata) = fs::metadata(root) else {
        return false;
    };
    let (major, minor) = (libc::major(metadata.dev()), libc::minor(metadata.dev()));
    let place = format!("{major:02x}:{minor:02x}:{}", metadata.ino());
    locks.lines().any(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        words.contains(&"FLOCK") && words.contains(&"WRITE") && words.contains(&place.as_str())
    })
}

fn foreign_nodes(found: Result<ForeignNodes, String>) -> Checked {
    let id = "iceoryx2_nodes";
    let nodes = found.told(id)?;
    let (living, dead, hidden) = (nodes.living, nodes.dead, nodes.hidden);
    let value = format!("{dead} dead, {living} alive, {hidden} of other users or damaged");
    let severity = Severity::ok_if(dead == 0 && hidden == 0, Severity::Note);
    Ok(Finding::new(id, severity, value))
}

/// Which of the folders is the first that exists, or can be made, for this user.
pub(super) fn first_usable(folders: &[PathBuf]) -> Option<usize> {
    let rights = AccessFlags::W_OK | AccessFlags::X_OK;
    let is_usable = |folder: &Path| folder.is_dir() && access(folder, rights).is_ok();
    let mut nearest = folders.iter().map(|folder| nearest_existing(folder));
    nearest.position(|folder| folder.is_some_and(is_usable))
}

fn runtime_folder(folders: &[PathBuf]) -> Finding {
    let id = "runtime_folder";
    let shown: Vec<String> = folders.iter().map(|f| f.display().to_string()).collect();
    match first_usable(folders) {
        None => Finding::error(id, format!("none writable of {}", shown.join(", "))),
        Some(0) => Finding::ok(id, format!("{} is writable", shown[0])),
        Some(index) => {
            let (first, chosen) = (&shown[0], &shown[index]);
            Finding::note(id, format!("{chosen} is writable, {first} is not"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_platform::host_facts::FakeHost;

    const MARK: &str = "/run/hil/abc/hil-domain";
    const SEGMENT: &str = "/dev/shm/h1a2b3c4d_one";

    #[test]
    fn only_names_with_a_runs_prefix_are_ours() {
        for (name, expected) in [
            ("h1a2b3c4d_segment", true),
            ("h00000000_x", true),
            ("h1a2b3c4d_", false),
            ("h1a2b3c4_segment", false),
            ("iox2_abcdef", false),
            ("g1a2b3c4d_segment", false),
            ("h1a2_3c4d_segment", false),
        ] {
            assert_eq!(is_of_a_run(name), expected, "{name}");
        }
    }

    fn judged(host: &FakeHost) -> Finding {
        let files = host.files();
        settled(leftovers(&files, &[files.locate("/run/hil")]))
    }

    #[test]
    fn segments_are_told_apart_by_the_lock_of_their_run() {
        let ended = FakeHost::with(&[(SEGMENT, ""), (MARK, "h1a2b3c4d_"), ("/proc/locks", "")]);
        let finding = judged(&ended);
        assert_eq!(finding.severity, Severity::Note);
        assert!(finding.value.ends_with("of runs: 1 ended"), "{finding:?}");
        assert!(finding.value.contains("h1a2b3c4d_*"), "{finding:?}");
        // The kernel's line for whoever holds the folder's lock.
        let metadata = fs::metadata(ended.files().locate("/run/hil/abc")).unwrap();
        let (major, minor) = (libc::major(metadata.dev()), libc::minor(metadata.dev()));
        let line = format!(
            "1: FLOCK  ADVISORY  WRITE 99 {major:02x}:{minor:02x}:{} 0 EOF\n",
            metadata.ino()
        );
        fs::write(ended.files().locate("/proc/locks"), line).unwrap();
        assert_eq!(judged(&ended).severity, Severity::Ok);
        let unplaced = FakeHost::with(&[(SEGMENT, ""), ("/proc/locks", "")]);
        let finding = judged(&unplaced);
        assert!(
            finding.fix.starts_with("if no other user's run"),
            "{finding:?}"
        );
    }

    #[test]
    fn what_a_run_would_be_refused_for_is_an_error_in_its_words() {
        assert_eq!(run_limits(&[]).severity, Severity::Ok);
        let short = run_limits(&["too few files".to_owned(), "too few threads".to_owned()]);
        assert_eq!(short.severity, Severity::Error);
        assert_eq!(short.value, "too few files; too few threads");
    }

    #[test]
    fn nothing_there_is_ok_and_nothing_readable_is_not() {
        let empty = FakeHost::with(&[("/dev/shm/other", "")]);
        assert_eq!(judged(&empty).severity, Severity::Ok);
        let no_folder = FakeHost::with(&[]);
        assert_eq!(judged(&no_folder).severity, Severity::CannotTell);
        let no_locks = FakeHost::with(&[(SEGMENT, "")]);
        assert_eq!(judged(&no_locks).severity, Severity::CannotTell);
    }

    #[test]
    fn a_held_domain_is_seen_in_the_kernels_list() {
        let host = FakeHost::with(&[(MARK, "h1a2b3c4d_")]);
        let root = host.files().locate("/run/hil/abc");
        let locks = || HostFiles::of_this_host().read("/proc/locks").to_text();
        assert!(!is_locked(&locks(), &root));
        let folder = fs::File::open(&root).unwrap();
        let exclusive = nix::fcntl::FlockArg::LockExclusiveNonblock;
        let lock = nix::fcntl::Flock::lock(folder, exclusive).unwrap();
        assert!(is_locked(&locks(), &root), "{}", locks());
        drop(lock);
    }

    #[test]
    fn a_missing_folder_is_an_error_and_a_fallback_a_note() {
        let host = FakeHost::with(&[("/fallback/file", "")]);
        let files = host.files();
        let (blocked, fallback) = (files.locate("/fallback/file/x"), files.locate("/fallback"));
        let severity = |folders: &[&PathBuf]| {
            let folders: Vec<PathBuf> = folders.iter().copied().cloned().collect();
            runtime_folder(&folders).severity
        };
        assert_eq!(space(&files.locate("/absent")).severity, Severity::Error);
        assert_eq!(severity(&[&blocked]), Severity::Error);
        assert_eq!(severity(&[&blocked, &fallback]), Severity::Note);
        assert_eq!(severity(&[&fallback, &blocked]), Severity::Ok);
    }

    #[test]
    fn dead_nodes_are_a_note_and_an_unreadable_list_is_not_ok() {
        let nodes = |living, dead| {
            settled(foreign_nodes(Ok(ForeignNodes {
                living,
                dead,
                hidden: 0,
            })))
        };
        assert_eq!(nodes(3, 0).severity, Severity::Ok);
        assert_eq!(nodes(3, 1).severity, Severity::Note);
        let unreadable = settled(foreign_nodes(Err("no".to_owned())));
        assert_eq!(unreadable.severity, Severity::CannotTell);
    }
}
