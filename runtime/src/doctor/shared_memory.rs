//! Where channels live: `/dev/shm` and the runtime folder. It looks and does not clean: removing
//! another run's segments is a decision, and the run may be alive.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access};

use super::Finding;
use crate::host_facts::HostFiles;

/// Below this a handful of channels with large samples does not fit.
const FREE_BYTES_MIN: u64 = 64 * 1024 * 1024;
const MEBIBYTE: u64 = 1024 * 1024;

pub(crate) fn examine(files: &HostFiles, runtime_folders: &[PathBuf]) -> Vec<Finding> {
    let shm = files.locate("/dev/shm");
    vec![
        space(&shm),
        leftovers(files),
        runtime_folder(runtime_folders),
        remove_ipc(files),
    ]
}

fn space(shm: &Path) -> Finding {
    let (id, title) = ("shared_memory", "Shared memory in /dev/shm");
    let (status, metadata) = match (statvfs(shm), fs::metadata(shm)) {
        (Ok(status), Ok(metadata)) => (status, metadata),
        (Err(error), _) => return absent(id, title, &error.to_string()),
        (_, Err(error)) => return absent(id, title, &error.to_string()),
    };
    let unit = status.fragment_size();
    let free_bytes = status.blocks_available() * unit;
    let mode = metadata.permissions().mode() & 0o7777;
    let value = format!(
        "{} MiB, {} MiB free, mode {mode:04o}",
        status.blocks() * unit / MEBIBYTE,
        free_bytes / MEBIBYTE
    );
    if access(
        shm,
        AccessFlags::R_OK | AccessFlags::W_OK | AccessFlags::X_OK,
    )
    .is_err()
    {
        return Finding::problem(id, title, value)
            .because("this user may not create segments, so no channel can be opened")
            .fixed_by("chmod 1777 /dev/shm");
    }
    if free_bytes < FREE_BYTES_MIN {
        return Finding::problem(id, title, value)
            .because("a channel that outgrows the space kills its process with SIGBUS")
            .fixed_by("mount -o remount,size=1G /dev/shm (--shm-size=1g for a container)");
    }
    if mode != 0o1777 {
        return Finding::note(id, title, value)
            .because("other users cannot create, or may remove, segments here")
            .fixed_by("chmod 1777 /dev/shm");
    }
    Finding::good(id, title, value)
}

fn absent(id: &str, title: &str, error: &str) -> Finding {
    Finding::problem(id, title, format!("unavailable ({error})"))
        .because("channels are POSIX shared memory and need it")
        .fixed_by("mount -t tmpfs -o mode=1777 tmpfs /dev/shm")
}

/// Whether a file in `/dev/shm` carries the prefix of a run: `h`, eight characters, `_`.
pub(crate) fn is_of_a_run(name: &str) -> bool {
    let bytes = name.as_bytes();
    bytes.len() > 10
        && bytes[0] == b'h'
        && bytes[9] == b'_'
        && bytes[1..9].iter().all(u8::is_ascii_alphanumeric)
}

fn leftovers(files: &HostFiles) -> Finding {
    let (id, title) = ("shared_memory_leftovers", "Segments of runs in /dev/shm");
    let mut names = files.names_in("/dev/shm");
    names.retain(|name| is_of_a_run(name));
    let mut prefixes: Vec<&str> = names.iter().map(|name| &name[..10]).collect();
    prefixes.dedup();
    if prefixes.is_empty() {
        return Finding::good(id, title, "none");
    }
    let shown: Vec<String> = prefixes
        .iter()
        .take(5)
        .map(|prefix| format!("{prefix}*"))
        .collect();
    let value = format!(
        "{} files of {} runs: {}{}",
        names.len(),
        prefixes.len(),
        shown.join(" "),
        if prefixes.len() > shown.len() {
            " ..."
        } else {
            ""
        }
    );
    Finding::note(id, title, value)
        .because("a run that was killed leaves its segments behind; a run in progress owns them")
        .fixed_by(format!(
            "if nothing is running: rm /dev/shm/{}*",
            prefixes[0]
        ))
}

fn runtime_folder(folders: &[PathBuf]) -> Finding {
    let (id, title) = ("runtime_folder", "Folder for sockets and service files");
    let is_writable = |folder: &Path| {
        folder.is_dir() && access(folder, AccessFlags::W_OK | AccessFlags::X_OK).is_ok()
    };
    let Some(index) = folders.iter().position(|folder| is_writable(folder)) else {
        let tried: Vec<String> = folders.iter().map(|f| f.display().to_string()).collect();
        return Finding::problem(id, title, format!("none writable of {}", tried.join(", ")))
            .because("channels keep their sockets and locks there")
            .fixed_by("RuntimeDirectory=hil in the unit, or install -d -o USER /run/hil");
    };
    let value = folders[index].display().to_string();
    Finding::note_unless(index == 0, id, title, format!("{value} is writable"))
        .because(format!(
            "{} is not writable or absent, so the fallback serves; a clean-up of temporary files, \
             or PrivateTmp= in a unit, hides it from other processes",
            folders[0].display()
        ))
        .fixed_by("RuntimeDirectory=hil in the unit, or install -d -o USER /run/hil")
        .quiet_when_good()
}

fn remove_ipc(files: &HostFiles) -> Finding {
    let (id, title) = ("remove_ipc", "Segments survive a log-out");
    if !files.locate("/run/systemd/system").exists() {
        return Finding::good(id, title, "yes (systemd does not run here)");
    }
    let main_file = files.read("/etc/systemd/logind.conf");
    let mut texts: Vec<String> = main_file.available().cloned().into_iter().collect();
    for name in files.names_in("/etc/systemd/logind.conf.d") {
        let text = files.read(&format!("/etc/systemd/logind.conf.d/{name}"));
        texts.extend(text.available().cloned());
    }
    let setting = texts
        .iter()
        .flat_map(|text| text.lines())
        .filter_map(|line| line.trim().strip_prefix("RemoveIPC="))
        .next_back();
    let is_kept = setting.is_some_and(|value| {
        ["no", "false", "off", "0"].contains(&value.trim().to_lowercase().as_str())
    });
    let value = setting.map_or(
        "RemoveIPC= is not set, so yes by default".to_owned(),
        |value| format!("RemoveIPC={value}"),
    );
    Finding::note_unless(is_kept, id, title, value)
        .because("logind removes the shared memory of a normal user at log-out, under a live run")
        .fixed_by("run as a system user (User=hil), or set RemoveIPC=no in logind.conf")
        .quiet_when_good()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::State;
    use crate::host_facts::FakeHost;

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

    #[test]
    fn leftovers_are_counted_by_run() {
        let host = FakeHost::with(&[
            ("/dev/shm/h1a2b3c4d_one", ""),
            ("/dev/shm/h1a2b3c4d_two", ""),
            ("/dev/shm/hffffffff_one", ""),
            ("/dev/shm/other", ""),
        ]);
        let finding = leftovers(&host.files());
        assert_eq!(finding.value, "3 files of 2 runs: h1a2b3c4d_* hffffffff_*");
        assert_eq!(finding.state, State::Note);
        assert_eq!(leftovers(&FakeHost::with(&[]).files()).state, State::Good);
    }

    #[test]
    fn a_missing_folder_is_a_problem_and_a_fallback_a_note() {
        let host = FakeHost::with(&[("/fallback/file", "")]);
        let files = host.files();
        let (absent, fallback) = (files.locate("/absent"), files.locate("/fallback"));
        assert_eq!(space(&absent).state, State::Problem);
        let state = |folders: &[&PathBuf]| {
            runtime_folder(&folders.iter().copied().cloned().collect::<Vec<_>>()).state
        };
        assert_eq!(state(&[&absent]), State::Problem);
        assert_eq!(state(&[&absent, &fallback]), State::Note);
        assert_eq!(state(&[&fallback, &absent]), State::Good);
    }

    #[test]
    fn the_last_word_on_remove_ipc_counts() {
        let logind = "/etc/systemd/logind.conf";
        let unit = ("/run/systemd/system/x", "");
        for (files, expected) in [
            (vec![(logind, "#RemoveIPC=no\n"), unit], State::Note),
            (vec![(logind, "RemoveIPC=no\n"), unit], State::Good),
            (
                vec![
                    (logind, "RemoveIPC=no\n"),
                    ("/etc/systemd/logind.conf.d/a.conf", "RemoveIPC=yes\n"),
                    unit,
                ],
                State::Note,
            ),
            (vec![(logind, "")], State::Good),
        ] {
            let host = FakeHost::with(&files);
            assert_eq!(remove_ipc(&host.files()).state, expected, "{files:?}");
        }
    }
}
