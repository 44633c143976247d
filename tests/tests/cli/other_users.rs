//! What another user of the same PC leaves where every user may: it neither costs a run anything nor makes
//! this user's programs touch what is not theirs. Another user is made by `setpriv`, so these need root.

use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};
use std::{fs, thread};

use hil_report::summary::Outcome;
use hil_tests::account::assert_every_message_is_accounted_for;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished, run};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use nix::fcntl::{Flock, FlockArg};
use nix::sys::stat::Mode;
use nix::unistd::{Gid, Uid, chown, mkfifo};

const LIMIT: Duration = Duration::from_mins(1);
/// Nobody else on this machine has it.
const STRANGER: u32 = 45_678;
/// Nor this one, for runs of a user who is not root.
const USER: u32 = 45_679;

fn as_stranger(script: &str) {
    let id = STRANGER.to_string();
    let mut command = Command::new("setpriv");
    command.args(["--reuid", &id, "--regid", &id, "--clear-groups"]);
    run(command.args(["sh", "-c", script]), LIMIT).unwrap();
}

fn give_away(path: &Path) {
    chown(
        path,
        Some(Uid::from_raw(STRANGER)),
        Some(Gid::from_raw(STRANGER)),
    )
    .unwrap();
}

/// Runs a short run, or a sweep, that finds its folder of domains below `temporary`.
fn with_temporary(temporary: &Path, arguments: &[std::ffi::OsString]) -> Finished {
    // Without /run/hil, as on a PC where no package made it.
    let script = "umount /run/hil 2>/dev/null; mount -t tmpfs -o mode=000,size=1 none /run/hil || \
                  exit 99; chown 45678 /run/hil; exec \"$@\"";
    let mut command = Command::new("unshare");
    command.args(["--mount", "sh", "-c", script, "sh"]);
    command.arg(hil_runtime_binary()).args(arguments);
    command
        .env("TMPDIR", temporary)
        .env_remove("XDG_RUNTIME_DIR");
    fs::create_dir_all("/run/hil").unwrap();
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    child.wait_within(LIMIT).unwrap()
}

/// An open folder with a home in it that is closed to others, and that the stranger made look like what a
/// dead run left.
fn victim(record: &RunFolder) -> std::path::PathBuf {
    let home = record.join("home");
    fs::create_dir_all(home.join("papers")).unwrap();
    fs::set_permissions(&home, fs::Permissions::from_mode(0o700)).unwrap();
    record.write("home/papers/thesis.tex", "x");
    record.write("home/papers/hil-domain", "not a prefix");
    home
}

#[test]
fn a_sweep_and_a_run_leave_alone_what_another_users_links_lead_to() {
    let record = RunFolder::new("links");
    let home = victim(&record);
    let temporary = record.join("tmp");
    fs::create_dir(&temporary).unwrap();
    let base = temporary.join("hil-0");
    let papers = home.join("papers");
    let trial = Trial::shipped("local.toml", &record.join("runs")).set("run.duration=\"1 s\"");
    for is_link in [true, false] {
        if is_link {
            symlink(&home, &base).unwrap();
        } else {
            fs::create_dir(&base).unwrap();
            symlink(&papers, base.join("0123456789ab")).unwrap();
            give_away(&base);
        }
        let swept = with_temporary(&temporary, &["sweep".into()]);
        let ran = with_temporary(&temporary, &trial.arguments());
        let left = papers.join("thesis.tex").exists();
        println!(
            "link {is_link}: thesis there {left}, sweep {}, run {}",
            swept.status, ran.status
        );
        assert!(left && papers.join("hil-domain").exists());
        assert_eq!(ran.status.code(), Some(77), "{ran:?}");
        let why = if is_link {
            "hil-0 is no folder but a link or a file, of user 0"
        } else {
            "belongs to user 45678, and this is user 0"
        };
        assert!(ran.stderr.contains(why), "{}", ran.stderr);
        if is_link {
            fs::remove_file(&base).unwrap();
        }
    }
    // The own folder with a link in it.
    give_back(&base);
    with_temporary(&temporary, &["sweep".into()]);
    with_temporary(&temporary, &trial.arguments()).assert_success();
    assert!(papers.join("thesis.tex").exists());
}

fn give_back(path: &Path) {
    chown(path, Some(Uid::from_raw(0)), Some(Gid::from_raw(0))).unwrap();
}

/// What `hil-runtime channel list RUN` says where `folder` is the base of domains beside `/run/hil`, where runs of other
/// tests may be.
fn listed(folder: &RunFolder, run: &str) -> Finished {
    let mut command = Command::new(hil_runtime_binary());
    command
        .args(["channel", "list", run])
        .env("TMPDIR", folder.path());
    let began = Instant::now();
    let finished = ChildGuard::spawn(&mut command).unwrap().wait_within(LIMIT);
    println!("{:.2} s", began.elapsed().as_secs_f64());
    finished.unwrap()
}

#[test]
fn looking_for_runs_does_not_wait_for_another_users_pipe() {
    let record = RunFolder::new("pipe");
    let base = record.join("hil-0");
    fs::create_dir_all(base.join("x")).unwrap();
    mkfifo(&base.join("x/live.json"), Mode::from_bits_truncate(0o644)).unwrap();
    give_away(&base);
    listed(&record, "x");
}

/// Of a run whose shared memory lies at a pipe, and of one that is held and whose files are pipes.
#[test]
fn looking_at_a_run_that_another_user_announces_does_not_wait_for_his_pipes() {
    let record = RunFolder::new("announced");
    let base = record.join("hil-0");
    let run = record.join("run");
    fs::create_dir_all(base.join("x")).unwrap();
    fs::create_dir_all(&run).unwrap();
    let [pipe, held] = ["pipe", "held"].map(|name| base.join(name));
    fs::create_dir(&held).unwrap();
    for path in [&pipe, &run.join("manifest.json"), &run.join("status.json")] {
        mkfifo(path, Mode::from_bits_truncate(0o644)).unwrap();
    }
    let lock = fs::File::open(&held).unwrap();
    let _held = Flock::lock(lock, FlockArg::LockExclusiveNonblock).unwrap();
    give_away(&base);
    for (root, said) in [(&pipe, "no run \"x-1\""), (&held, "not a regular file")] {
        let announced = serde_json::json!({
            "schema_version": 1, "name": "x-1", "topology": "x", "folder": run, "pid": 1,
            "since": "today", "domains": { "a": format!("h0123abcd_@{}", root.display()) },
        });
        record.write("hil-0/x/live.json", &announced.to_string());
        let finished = listed(&record, "x-1");
        assert!(finished.stderr.contains(said), "{said}: {finished:?}");
    }
}

#[test]
fn an_empty_file_of_another_user_in_shared_memory_costs_a_run_nothing() {
    let record = RunFolder::new("empty-file");
    let trial = Trial::shipped("local.toml", &record.join("runs"))
        .set("run.duration=\"4 s\"")
        .set("processes.controller.on_exit=\"restart\"");
    // Root could remove the stranger's files; a user cannot.
    let id = USER.to_string();
    fs::create_dir_all(record.path()).unwrap();
    chown(record.path(), Some(Uid::from_raw(USER)), None).unwrap();
    let mut command = Command::new("setpriv");
    command.args(["--reuid", &id, "--regid", &id, "--clear-groups"]);
    command.arg(hil_runtime_binary()).args(trial.arguments());
    command
        .env("TMPDIR", record.path())
        .env_remove("XDG_RUNTIME_DIR");
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    let files = trial.folder("", LIMIT);
    wait_until(LIMIT, "messages", || {
        files.record_bytes("egm.right.command.taken.robot.") > 2048
    });
    let prefix = files.domains()[0].prefix().to_owned();
    let planted = [format!("{prefix}x"), format!("{prefix}_1_2.connection")];
    for name in &planted {
        as_stranger(&format!("umask 0; : > /dev/shm/{name}"));
    }
    let files_of_run = fs::read_dir("/dev/shm").unwrap().flatten();
    for file in files_of_run {
        let name = file.file_name().into_string().unwrap();
        if name.starts_with(&prefix) && !planted.contains(&name) {
            let mode = file.metadata().unwrap().permissions().mode();
            assert_eq!(mode & 0o077, 0, "{name}: {mode:o}");
        }
    }
    // It is also in the way of nobody who is started again.
    files.kill_process("controller", 0, LIMIT);
    let began = Instant::now();
    let finished = child.wait_within(LIMIT);
    println!(
        "ended {:.1} s after the files came",
        began.elapsed().as_secs_f64()
    );
    for name in &planted {
        // Gone where the run was root's, which could remove them.
        let _was_there = fs::remove_file(Path::new("/dev/shm").join(name)).is_ok();
    }
    finished.unwrap().assert_success();
    let summary = files.summary();
    assert_eq!(summary.run.outcome, Outcome::Completed);
    let mut processes = summary.processes.iter();
    let controller = processes.find(|one| one.name == "controller").unwrap();
    assert_eq!(controller.restart_count, 1);
    assert_every_message_is_accounted_for(&summary);
    files.assert_nothing_left_here();
}

/// The account is there however long others hold up the removal.
#[test]
fn the_account_is_written_before_anything_is_removed() {
    let record = RunFolder::new("account-first");
    let trial = Trial::shipped("local.toml", record.path()).set("run.duration=\"2 s\"");
    let mut child = trial.start_here();
    let files = trial.folder("", LIMIT);
    wait_until(LIMIT, "messages", || {
        files.record_bytes("egm.right.command.taken.robot.") > 2048
    });
    let root = files.domains()[0].root_path().to_owned();
    let mut had_result = None;
    while had_result.is_none() {
        let is_written = fs::read_to_string(files.root().join("result.json"))
            .is_ok_and(|text| text.contains("outcome"));
        if !root.exists() {
            had_result = Some(is_written);
        }
        thread::sleep(Duration::from_millis(1));
    }
    child.wait_within(LIMIT).unwrap().assert_success();
    assert_eq!(had_result, Some(true));
}
