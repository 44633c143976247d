//! What may take files away from under a run, or not give them room: systemd's private folders and
//! its clean-up at log-out, and the disk of the run's folder. It writes nothing.

use std::path::{Path, PathBuf};

use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, Uid, access};

use super::finding::{Answer, Checked, Finding, Severity, settled};
use hil_platform::host_facts::{Fact, HostFiles};

pub(super) const MEBIBYTE: u64 = 1024 * 1024;
/// Below this a run of an hour does not fit.
const FREE_BYTES_WARNING: u64 = 1024 * MEBIBYTE;
/// And below this not even a short one.
const FREE_BYTES_ERROR: u64 = 100 * MEBIBYTE;
/// File systems that are on another machine.
const REMOTE: [&str; 8] = [
    "nfs",
    "nfs4",
    "cifs",
    "smb3",
    "9p",
    "ceph",
    "fuse.sshfs",
    "afs",
];
/// The last user id that systemd takes for a system user's, unless built otherwise.
const SYSTEM_USER_MAX: u32 = 999;

pub(super) fn examine(
    files: &HostFiles,
    record_folder: &Path,
    runtime_folder: &Path,
) -> Vec<Finding> {
    let checks = [
        remove_ipc(files, Uid::current().as_raw()),
        private_tmp(files, runtime_folder),
        run_disk(files, record_folder),
    ];
    checks.map(settled).into()
}

/// Later files, and later lines, override earlier ones.
const LOGIND: [&str; 4] = [
    "/etc/systemd/logind.conf",
    "/usr/lib/systemd/logind.conf.d",
    "/run/systemd/logind.conf.d",
    "/etc/systemd/logind.conf.d",
];

fn remove_ipc(files: &HostFiles, user: u32) -> Checked {
    let id = "remove_ipc";
    if !files.locate("/run/systemd/system").exists() {
        return Ok(Finding::ok(id, "yes (systemd does not run here)"));
    }
    let mut setting: Option<String> = None;
    for place in LOGIND.iter().filter(|place| files.locate(place).exists()) {
        let mut paths = vec![(*place).to_owned()];
        if files.locate(place).is_dir() {
            paths = files.list(place).told(id)?;
            paths.retain(|name| Path::new(name).extension().is_some_and(|end| end == "conf"));
            paths = paths.iter().map(|name| format!("{place}/{name}")).collect();
        }
        for path in paths {
            let text = files.read(&path).told(id)?;
            let lines = text.lines().map(str::trim);
            let last = lines
                .filter_map(|line| line.strip_prefix("RemoveIPC="))
                .next_back();
            setting = last.map(str::to_owned).or(setting);
        }
    }
    let value = match &setting {
        None => "RemoveIPC= is not set, so yes by default".to_owned(),
        Some(value) => format!("RemoveIPC={value}"),
    };
    let word = setting.unwrap_or_default().trim().to_lowercase();
    Ok(if ["no", "false", "off", "0"].contains(&word.as_str()) {
        Finding::ok(id, value)
    } else if user <= SYSTEM_USER_MAX {
        let value = format!("{value}; user {user} is a system user, whose segments stay");
        Finding::ok(id, value)
    } else {
        Finding::warning(id, value)
    })
}

/// One line of `mountinfo`: where it is mounted, from which folder of its file system, of which type.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Mount {
    point: PathBuf,
    root: String,
    kind: String,
}

fn mounts(files: &HostFiles) -> Result<Vec<Mount>, String> {
    let text = files.read("/proc/self/mountinfo").known()?;
    let mounts = text.lines().filter_map(|line| {
        let (left, right) = line.split_once(" - ")?;
        let words: Vec<&str> = left.split(' ').collect();
        Some(Mount {
            root: (*words.get(3)?).to_owned(),
            // Blanks in a path are written as octal digits.
            point: PathBuf::from(words.get(4)?.replace("\\040", " ")),
            kind: right.split(' ').next()?.to_owned(),
        })
    });
    Ok(mounts.collect())
}

fn private_tmp(files: &HostFiles, runtime_folder: &Path) -> Checked {
    let id = "private_tmp";
    let mounts = mounts(files).told(id)?;
    let is_private = mounts
        .iter()
        .any(|mount| mount.point == Path::new("/tmp") && mount.root.contains("/systemd-private-"));
    let folder = runtime_folder.display();
    Ok(if !is_private {
        Finding::ok(id, "no, /tmp is everybody's")
    } else if runtime_folder.starts_with("/tmp") {
        Finding::warning(
            id,
            format!("yes, and channels have their files in {folder}"),
        )
    } else {
        Finding::note(id, format!("yes; channels have their files in {folder}"))
    })
}

/// The folder itself, or the nearest above it that exists.
pub(super) fn nearest_existing(folder: &Path) -> Option<&Path> {
    folder.ancestors().find(|one| one.exists())
}

/// What is known of a disk.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Disk {
    /// The nearest folder that exists.
    folder: PathBuf,
    is_writable: bool,
    free_bytes: u64,
    kind: Fact<String>,
}

fn run_disk(files: &HostFiles, record_folder: &Path) -> Checked {
    let disk = disk_of(files, record_folder).told("run_disk")?;
    Ok(judge(record_folder, &disk))
}

fn disk_of(files: &HostFiles, record_folder: &Path) -> Result<Disk, String> {
    let absolute = std::path::absolute(record_folder)
        .map_err(|error| format!("{}: {error}", record_folder.display()))?;
    let existing = nearest_existing(&absolute).unwrap_or(Path::new("/"));
    let folder = existing.canonicalize().unwrap_or(existing.to_owned());
    let status =
        statvfs(&folder).map_err(|errno| format!("{}: {}", folder.display(), errno.desc()))?;
    let kind = mounts(files).and_then(|mounts| {
        let holds_it = |mount: &Mount| folder.starts_with(&mount.point);
        let own = mounts.into_iter().filter(holds_it);
        // The last of equal ones covers the others.
        let nearest = own.max_by_key(|mount| mount.point.as_os_str().len());
        let nearest = nearest.ok_or_else(|| format!("no mount holds {}", folder.display()))?;
        Ok(nearest.kind)
    });
    Ok(Disk {
        is_writable: access(&folder, AccessFlags::W_OK | AccessFlags::X_OK).is_ok(),
        free_bytes: status.blocks_available() * status.fragment_size(),
        folder,
        kind: kind.map_or_else(Fact::Unavailable, Fact::Available),
    })
}

fn judge(record_folder: &Path, disk: &Disk) -> Finding {
    let id = "run_disk";
    let (folder, record_folder) = (disk.folder.display(), record_folder.display());
    let free = disk.free_bytes / MEBIBYTE;
    let kind = disk.kind.to_text();
    let value = format!("{record_folder} in {folder}: {free} MiB free, {kind}");
    if !disk.is_writable {
        return Finding::error(id, format!("{value}; this user may not write there"));
    }
    let severity = match (disk.free_bytes, disk.kind.available()) {
        (..FREE_BYTES_ERROR, _) => Severity::Error,
        (..FREE_BYTES_WARNING, _) => Severity::Warning,
        (_, None) => Severity::CannotTell,
        (_, Some(kind)) => Severity::ok_if(!REMOTE.contains(&kind.as_str()), Severity::Warning),
    };
    Finding::new(id, severity, value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_platform::host_facts::FakeHost;

    const PERSON: u32 = 1000;

    #[test]
    fn the_last_word_on_remove_ipc_counts() {
        let main = LOGIND[0];
        let unit = ("/run/systemd/system/x", "");
        let dropped = ("/etc/systemd/logind.conf.d/a.conf", "RemoveIPC=yes\n");
        let other = ("/etc/systemd/logind.conf.d/a.bak", "RemoveIPC=yes\n");
        for (files, user, expected) in [
            (
                vec![(main, "#RemoveIPC=no\n"), unit],
                PERSON,
                Severity::Warning,
            ),
            (vec![(main, "#RemoveIPC=no\n"), unit], 998, Severity::Ok),
            (vec![(main, "RemoveIPC=no\n"), unit], PERSON, Severity::Ok),
            (
                vec![(main, "RemoveIPC=no\n"), dropped, unit],
                PERSON,
                Severity::Warning,
            ),
            (
                vec![(main, "RemoveIPC=no\n"), other, unit],
                PERSON,
                Severity::Ok,
            ),
            (vec![(main, "")], PERSON, Severity::Ok),
            (
                vec![("/etc/systemd/logind.conf.d/a.conf/x", ""), unit],
                PERSON,
                Severity::CannotTell,
            ),
        ] {
            let host = FakeHost::with(&files);
            let finding = settled(remove_ipc(&host.files(), user));
            assert_eq!(finding.severity, expected, "{files:?}: {finding:?}");
        }
    }

    #[test]
    fn a_private_tmp_matters_where_channels_are_in_it() {
        let mounted = "30 1 8:1 / / rw - ext4 /dev/sda1 rw\n\
            41 30 8:1 /tmp/systemd-private-1a-hil.service-x/tmp /tmp rw - ext4 /dev/sda1 rw\n";
        let look = |text: &str, folder: &str| {
            let host = FakeHost::with(&[("/proc/self/mountinfo", text)]);
            settled(private_tmp(&host.files(), Path::new(folder))).severity
        };
        assert_eq!(look(mounted, "/tmp/hil-1000"), Severity::Warning);
        assert_eq!(look(mounted, "/run/hil"), Severity::Note);
        let shared = mounted.lines().next().unwrap();
        assert_eq!(look(shared, "/tmp/hil-1000"), Severity::Ok);
        let silent = FakeHost::with(&[]);
        let finding = settled(private_tmp(&silent.files(), Path::new("/run/hil")));
        assert_eq!(finding.severity, Severity::CannotTell);
    }

    #[test]
    fn a_disk_is_judged_by_room_rights_and_distance() {
        let disk = |free_bytes, kind: &str, is_writable| Disk {
            folder: PathBuf::from("/data"),
            is_writable,
            free_bytes,
            kind: Fact::Available(kind.to_owned()),
        };
        let gibibyte = 1024 * MEBIBYTE;
        for (disk, expected) in [
            (disk(5 * gibibyte, "ext4", true), Severity::Ok),
            (disk(gibibyte / 2, "ext4", true), Severity::Warning),
            (disk(5 * gibibyte, "nfs4", true), Severity::Warning),
            (disk(MEBIBYTE, "ext4", true), Severity::Error),
            (disk(5 * gibibyte, "ext4", false), Severity::Error),
        ] {
            let finding = judge(Path::new("runs"), &disk);
            assert_eq!(finding.severity, expected, "{finding:?}");
        }
        let unknown = Disk {
            kind: Fact::Unavailable("no".to_owned()),
            ..disk(5 * gibibyte, "", true)
        };
        let finding = judge(Path::new("runs"), &unknown);
        assert_eq!(finding.severity, Severity::CannotTell);
    }

    #[test]
    fn the_folder_that_is_not_made_yet_is_that_of_its_parent() {
        let host = FakeHost::with(&[("/here/file", "")]);
        let here = host.files().locate("/here");
        let line = format!("41 30 8:1 / {} rw - xfs /dev/sda1 rw", here.display());
        let info = FakeHost::with(&[("/proc/self/mountinfo", line.as_str())]);
        let disk = disk_of(&info.files(), &here.join("not/yet"));
        let disk = disk.unwrap();
        assert_eq!(disk.folder, here);
        assert_eq!(disk.kind, Fact::Available("xfs".to_owned()));
    }
}
