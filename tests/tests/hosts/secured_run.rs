//! The real binary between two hosts whose hops are sealed: an ordinary run, and keys that do not fit or
//! are not private. Strangers on the wire are in `strangers.rs`.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::process::Command;
use std::time::Duration;

use hil_engine::security::PreSharedKey;
use hil_rundir::protection::HopProtection;
use hil_tests::account::{account, assert_accounts_close};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::shuttle::CHANNELS;
use hil_tests::split::{Split, count, direction, refused};
use hil_tests::trial::{Trial, hop_key, wait_until};

const LIMIT: Duration = Duration::from_mins(1);
/// No other file of tests uses these ports.
const PORT: u16 = 7860;

fn trial(record: &RunFolder) -> Trial {
    Trial::shipped("shuttle-split.toml", record.path()).set(&format!("links.hop.port={PORT}"))
}

#[test]
fn an_ordinary_run_is_sealed_and_its_account_closes() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("sealed");
    let key = PreSharedKey::read(&hop_key(record.path())).unwrap();
    let split = Split::start(&lab, &trial(&record).set("run.duration=\"6 s\""));
    let report = split.files[1].clone();
    for summary in &split.finish() {
        assert_accounts_close(summary);
        let security = summary.run.security.as_ref().unwrap();
        let HopProtection::Sealed {
            key_fingerprint, ..
        } = &security.hops
        else {
            panic!("{security}");
        };
        assert_eq!(*key_fingerprint, key.fingerprint());
        for name in CHANNELS {
            let (egress, ingress) = (
                direction(summary, name, "egress"),
                direction(summary, name, "ingress"),
            );
            assert!(count(ingress, "seal: opened_count") > 100);
            assert_eq!(
                count(ingress, "seal: opened_count"),
                count(ingress, "datagram_count")
            );
            // A greeting that waits for keys gives way to the next.
            assert!(count(egress, "seal: sealed_count") <= count(egress, "datagram_count"));
            assert_eq!(
                (refused(egress), refused(ingress)),
                (0, 0),
                "{:?}",
                ingress.counters
            );
            assert_eq!(account(summary, name).fates.lost_count(), 0);
        }
    }
    assert!(report.read("report-full.txt").contains("  security  "));
    // The secret of the run is in no file that it left.
    let launches = fs::read_dir(report.root().join("launch")).unwrap();
    for file in launches.map(|file| file.unwrap().path()) {
        let text = fs::read_to_string(&file).unwrap();
        assert!(!text.contains("secret"), "{}", file.display());
    }
}

/// What both hosts of a run end with that cannot come about.
fn ends(lab: &Lab, trials: [&Trial; 2]) -> [Finished; 2] {
    let mut hosts = [0, 1].map(|index| trials[index].start_on(lab.host(index)));
    [0, 1].map(|index| hosts[index].wait_within(LIMIT).unwrap())
}

#[test]
fn hosts_with_other_keys_or_without_one_wait_to_the_end_and_both_say_who_came() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let (record, other) = (RunFolder::new("key-a"), RunFolder::new("key-b"));
    let patience = "run.start_timeout=\"2 s\"";
    let keyed = trial(&record).set(patience);
    let other_key = format!("security.key=\"{}\"", hop_key(other.path()).display());
    let elsewhere = keyed.clone().set(&other_key);
    let plain = keyed.clone().plain();
    for (trials, words) in [
        ([&keyed, &elsewhere], "another key"),
        ([&keyed, &plain], "key"),
        ([&plain, &keyed], "plain"),
    ] {
        for finished in ends(&lab, trials) {
            // Nobody proved anything, so it is an absence, after which a unit tries again.
            assert_eq!(finished.status.code(), Some(69), "{}", finished.stderr);
            assert!(
                finished.stderr.contains(words),
                "{words}: {}",
                finished.stderr
            );
            assert!(!finished.stderr.contains("hil-psk-v1"));
        }
    }
}

#[test]
fn a_key_is_looked_at_before_anything_starts_and_by_a_check_of_its_host() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("key-mode");
    let key = hop_key(record.path());
    fs::set_permissions(&key, Permissions::from_mode(0o644)).unwrap();
    let start = |trial: &Trial, more: &[&str]| {
        let mut command = lab.host(1).command(hil_runtime_binary());
        command.args(trial.arguments());
        command.args(["--host", "robot-pc"]).args(more);
        ChildGuard::spawn(&mut command)
            .unwrap()
            .wait_within(LIMIT)
            .unwrap()
    };
    let path = key.display().to_string();
    let anywhere = trial(&record).command_here().arg("--check").status();
    assert!(anywhere.unwrap().success(), "a file is checked anywhere");
    for check in [&[][..], &["--check"]] {
        let finished = start(&trial(&record), check);
        assert_eq!(finished.status.code(), Some(77), "{}", finished.stderr);
        for words in [path.as_str(), "0644", "chmod 0600"] {
            assert!(finished.stderr.contains(words), "{}", finished.stderr);
        }
    }
    fs::set_permissions(&key, Permissions::from_mode(0o600)).unwrap();
    // The kernel tells of the carrier of a new interface after up to a second.
    wait_until(LIMIT, "a carrier", || {
        start(&trial(&record), &["--check"]).status.code() != Some(75)
    });
    let checked = start(&trial(&record), &["--check"]);
    checked.assert_success();
    let fingerprint = PreSharedKey::read(&key).unwrap().fingerprint();
    assert!(checked.stdout.contains(&fingerprint), "{}", checked.stdout);
    let plain = trial(&record).set("security.hops=\"plain\"");
    let unneeded = start(&plain, &["--check"]);
    unneeded.assert_success();
    assert!(!unneeded.stdout.contains(&fingerprint));
    fs::remove_file(&key).unwrap();
    let gone = trial(&record).set(&format!("security.key=\"{}.gone\"", key.display()));
    for check in [&[][..], &["--check"]] {
        let finished = start(&gone, check);
        assert_eq!(finished.status.code(), Some(77), "{}", finished.stderr);
        let cure = "hil-runtime key new";
        assert!(finished.stderr.contains(cure), "{}", finished.stderr);
    }
}

#[test]
fn two_hosts_without_a_word_on_security_do_not_start() {
    let record = RunFolder::new("unsaid");
    let shipped =
        fs::read_to_string(hil_tests::trial::shipped_topology("shuttle-split.toml")).unwrap();
    let local = hil_tests::trial::shipped_topology("shuttle-local.toml");
    let unsaid: Vec<&str> = shipped
        .lines()
        .filter(|line| !line.starts_with("key = ") && *line != "[security]")
        .collect();
    let text = unsaid
        .join("\n")
        .replace("shuttle-local.toml", &local.display().to_string());
    let path = record.write("unsaid.toml", &text);
    for arguments in [&["--host", "robot-pc"][..], &["--check"]] {
        let mut command = Command::new(hil_runtime_binary());
        command.arg("--topology").arg(&path).args(arguments);
        let finished = ChildGuard::spawn(&mut command)
            .unwrap()
            .wait_within(LIMIT)
            .unwrap();
        assert_eq!(finished.status.code(), Some(2), "{}", finished.stderr);
        for cure in ["hil-runtime key new", "hops = \"plain\""] {
            assert!(finished.stderr.contains(cure), "{}", finished.stderr);
        }
    }
}

#[test]
fn the_key_command_makes_checks_and_never_shows_a_key() {
    let folder = RunFolder::new("key-command");
    let path = folder.join("hop.key");
    let run = |word: &str| {
        let mut command = Command::new(hil_runtime_binary());
        command.args(["key", word]).arg(&path);
        ChildGuard::spawn(&mut command)
            .unwrap()
            .wait_within(LIMIT)
            .unwrap()
    };
    let made = run("new");
    made.assert_success();
    let fingerprint = PreSharedKey::read(&path).unwrap().fingerprint();
    let again = run("new");
    assert_eq!(again.status.code(), Some(2), "{}", again.stderr);
    let checked = run("check");
    checked.assert_success();
    let secret = fs::read_to_string(&path).unwrap();
    let secret = secret.trim().strip_prefix("hil-psk-v1:").unwrap();
    for finished in [made, checked] {
        assert!(
            finished.stdout.contains(&fingerprint),
            "{}",
            finished.stdout
        );
        assert!(!finished.stdout.contains(secret));
    }
}
