//! A disk that is full: before a run, while it goes, while the hosts exchange records, and when the report is
//! written. Both hosts come to one verdict that names host and cause, and what was recorded can be read.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use hil_account::MessageFate;
use hil_report::assessment::{Assessment, NetworkVerdict};
use hil_report::summary::{Outcome, RunEventKind, RunSummary};
use hil_rundir::event::EventKind;
use hil_rundir::file_fault::{GapCause, RecordGap};
use hil_rundir::run_folder::RunFolder as Folder;
use hil_rundir::run_result::{Outcome as RunOutcome, RunResult};
use hil_tests::account::account;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_tests::lab::{Lab, LabHost};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, shipped_topology, wait_until};

const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
const CHANNELS: [&str; 2] = ["shuttle/command", "shuttle/status"];
const LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(2);
/// The exit code of what failed, as `--help` lists it.
const FAILED: i32 = 1;
const NO_SPACE: &str = "No space left on device";
/// Where each host records.
const DISK: &str = "/run/disk";

fn code(finished: &Finished) -> i32 {
    let code = finished.status.code();
    code.unwrap_or_else(|| panic!("{finished:?}"))
}

/// A run between two hosts, each with a disk of its own.
struct Stage {
    lab: Lab,
    // Removed after the hosts.
    _keys: RunFolder,
    hosts: [ChildGuard; 2],
}

impl Stage {
    /// Starts a run of `duration` on disks of `sizes`; `None` where there can be no lab.
    fn start(sizes: [&str; 2], duration: &str) -> Option<Self> {
        let lab = Lab::two_hosts_or_skip()?;
        for (index, size) in sizes.iter().enumerate() {
            lab.host(index).mount_disk(Path::new(DISK), size);
        }
        let keys = RunFolder::new("full-disk");
        let trial = Trial::shipped("shuttle-split.toml", keys.path())
            .set(&format!("run.record=\"{DISK}\""))
            .set(&format!("run.duration=\"{duration}\""));
        let hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
        Some(Self {
            lab,
            _keys: keys,
            hosts,
        })
    }

    fn host(&self, index: usize) -> &LabHost {
        self.lab.host(index)
    }

    /// The run folder of host `index`, as it is found from here.
    fn folder(&self, index: usize) -> Option<PathBuf> {
        let entries = fs::read_dir(self.host(index).locate(DISK)).ok()?;
        let mut folders = entries.flatten().map(|entry| entry.path());
        folders.find(|path| path.is_dir())
    }

    fn wait_for_records(&self, index: usize, name: &str) {
        wait_until(LIMIT, name, || {
            let records = self.folder(index).map(|folder| folder.join("records"));
            let size = records.and_then(|records| fs::metadata(records.join(name)).ok());
            size.is_some_and(|data| data.len() > 4096)
        });
    }

    /// Takes all of the disk of host `index` but `kept` bytes, at once.
    fn fill(&self, index: usize, kept: u64) {
        self.host(index).fill_disk(Path::new(DISK), kept);
    }

    /// Waits for both ends.
    fn end(&mut self) -> [Finished; 2] {
        let ends = self.hosts.each_mut().map(|host| {
            let finished = host.wait_within(RUN_LIMIT).unwrap();
            println!("{:?} {}", finished.status, finished.stderr);
            finished
        });
        for index in 0..2 {
            assert!(self.host(index).shared_memory_leftovers().is_empty());
        }
        ends
    }

    fn result(&self, index: usize) -> RunResult {
        RunResult::read(&Folder::existing(&self.folder(index).unwrap())).unwrap()
    }

    /// What `hil-runtime report` draws up from the records of host `index`, after room was made.
    fn summary(&self, index: usize) -> RunSummary {
        let host = self.host(index);
        // There is one where the test filled the disk.
        host.clear_disk(Path::new(DISK));
        let folder = self.folder(index).unwrap();
        drop(fs::remove_file(folder.join("summary.json")));
        let inside = Path::new(DISK).join(folder.file_name().unwrap());
        let mut command = host.command(hil_runtime_binary());
        let read = command.arg("report").arg(inside).output().unwrap();
        assert!(read.status.success(), "{read:?}");
        let text = fs::read_to_string(folder.join("summary.json")).unwrap();
        RunSummary::from_json(&text).unwrap()
    }
}

/// How often `said` names the cause.
fn count(said: &str) -> usize {
    let words: Vec<&str> = said.split_whitespace().collect();
    words.join(" ").matches(NO_SPACE).count()
}

/// A run that `host` could not record: both hosts say so, once, and what was recorded is there.
fn check_unrecorded(stage: &mut Stage, host: &str) {
    let ends = stage.end();
    let results = [0, 1].map(|index| stage.result(index));
    assert_eq!(results[0].outcome, results[1].outcome);
    let RunOutcome::Unwritable { host: said, fault } = &results[0].outcome else {
        panic!("{:?}", results[0].outcome);
    };
    assert_eq!(said, host);
    assert!(fault.error.contains(NO_SPACE), "{fault}");
    assert_eq!(results[0].gaps, results[1].gaps);
    for (index, finished) in ends.iter().enumerate() {
        assert_eq!(code(finished), FAILED);
        // The end of the run tells it; a second host that is full has its own cause.
        let full = results[0].gaps.iter().map(|gap| &gap.host);
        let others = full.filter(|name| *name != host).count();
        assert_eq!(count(&finished.stdout), 1 + others, "{}", finished.stdout);
        let summary = stage.summary(index);
        assert_eq!(summary.run.outcome, Outcome::Failed);
        assert_eq!(Assessment::of(&summary).network, NetworkVerdict::RunFailed);
        assert!(
            summary
                .run
                .exit_reason
                .starts_with(&format!("{host} cannot write /"))
        );
        let told = summary.events.iter().find(|event| {
            let RunEventKind::Process(kind) = &event.kind else {
                return false;
            };
            matches!(kind, EventKind::Unrecorded { .. })
        });
        assert!(
            told.and_then(|event| event.at_s)
                .is_some_and(|at_s| at_s > 0.0)
        );
        let published: u64 = summary
            .channels
            .iter()
            .filter_map(|one| one.account.as_ref())
            .map(|account| account.published_count)
            .sum();
        assert!(published > 50, "{published}");
        for channel in summary
            .channels
            .iter()
            .filter_map(|one| one.account.as_ref())
        {
            assert_eq!(
                channel.fates.of(MessageFate::LostOnWire),
                0,
                "{:?}",
                channel.fates
            );
        }
    }
}

#[test]
fn a_full_disk_ends_the_run_and_says_so() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    // Small enough to be full within seconds, on a file system of the host's own.
    let host = lab.host(0);
    host.mount_disk(Path::new(DISK), "256k");
    let mut command: Command = host.command(hil_runtime_binary());
    command
        .arg("--topology")
        .arg(shipped_topology("shuttle-local.toml"));
    command.args(["--set", &format!("run.record=\"{DISK}\"")]);
    command.args(["--set", "run.duration=\"10 min\""]);
    let mut child = ChildGuard::spawn(&mut command).unwrap();
    let finished = child.wait_within(RUN_LIMIT).unwrap();
    println!("{finished:?}");
    assert_eq!(code(&finished), FAILED, "{finished:?}");
    assert_eq!(count(&finished.stdout), 1);
    assert!(finished.stdout.contains(DISK));
    assert!(host.shared_memory_leftovers().is_empty());
}

#[test]
fn a_disk_that_fills_while_a_run_goes_is_told_once_on_both_hosts() {
    let Some(mut stage) = Stage::start(["200m", "64m"], "10 min") else {
        return;
    };
    stage.wait_for_records(1, "shuttle.status.published.robot.0.rec");
    stage.fill(1, 0);
    check_unrecorded(&mut stage, HOSTS[1]);
    let gap = &stage.result(0).gaps[0];
    assert_eq!(
        (&*gap.host, &*gap.of),
        (HOSTS[1], &[HOSTS[0].to_owned()][..])
    );
}

#[test]
fn two_disks_that_fill_while_a_run_goes_come_to_one_end() {
    let Some(mut stage) = Stage::start(["64m", "64m"], "10 min") else {
        return;
    };
    stage.wait_for_records(1, "shuttle.status.published.robot.0.rec");
    stage.fill(0, 0);
    stage.fill(1, 0);
    let outcome = |stage: &Stage| match stage.result(0).outcome {
        RunOutcome::Unwritable { host, .. } => host,
        other => panic!("{other:?}"),
    };
    for host in &mut stage.hosts {
        host.wait_within(RUN_LIMIT).unwrap();
    }
    let host = outcome(&stage);
    check_unrecorded(&mut stage, &host);
}

#[test]
fn records_that_a_disk_cannot_take_from_another_host_leave_no_verdict_on_either() {
    let Some(mut stage) = Stage::start(["200m", "64m"], "4 s") else {
        return;
    };
    // What this host records fits, and no record of the other.
    stage.wait_for_records(1, "shuttle.status.published.robot.0.rec");
    // In 4 s a host records about 150 KB, of which the last two thirds are still to come.
    stage.fill(1, 180 << 10);
    let ends = stage.end();
    let results = [0, 1].map(|index| stage.result(index));
    for (index, result) in results.iter().enumerate() {
        assert_eq!(code(&ends[index]), FAILED);
        assert_eq!(result.outcome, RunOutcome::Completed);
        let [RecordGap { host, of, cause }] = &result.gaps[..] else {
            panic!("{:?}", result.gaps);
        };
        assert_eq!((&**host, &**of), (HOSTS[1], &[HOSTS[0].to_owned()][..]));
        assert!(matches!(cause, GapCause::Unwritable(fault) if fault.error.contains(NO_SPACE)));
        assert_eq!(count(&ends[index].stdout), 1, "{}", ends[index].stdout);
        let summary = stage.summary(index);
        let hosts = vec![HOSTS[1].to_owned()];
        let verdict = NetworkVerdict::RecordsMissing { hosts };
        assert_eq!(Assessment::of(&summary).network, verdict);
        for name in CHANNELS {
            let fates = &account(&summary, name).fates;
            assert_eq!(fates.of(MessageFate::LostOnWire), 0, "{name}: {fates:?}");
        }
    }
    // Of the other host's records none is left where not all are.
    let left = fs::read_dir(stage.folder(1).unwrap().join("records")).unwrap();
    let names = left
        .flatten()
        .map(|file| file.file_name().to_string_lossy().into_owned());
    assert!(names.into_iter().all(|name| !name.contains(".controller.")));
}

#[test]
fn a_disk_that_is_full_before_a_run_is_told_to_the_other_host() {
    let Some(mut stage) = Stage::start(["200m", "40k"], "10 min") else {
        return;
    };
    let ends = stage.end();
    let words = format!("{} cannot write {DISK}", HOSTS[1]);
    let result = stage.result(0);
    assert!(result.outcome.reason().starts_with(&words), "{result:?}");
    assert_eq!(ends.each_ref().map(code), [FAILED; 2]);
    assert_eq!(count(&ends[0].stdout), 1, "{}", ends[0].stdout);
    assert!(ends[1].stderr.contains(NO_SPACE), "{}", ends[1].stderr);
    assert_eq!(stage.folder(1), None, "nothing is left on the full disk");
}

#[test]
fn a_report_that_a_disk_does_not_take_leaves_both_hosts_their_verdict() {
    // Room for the records of both hosts and for the result, and not for traces, series and summary.
    let Some(mut stage) = Stage::start(["200m", "64m"], "3 s") else {
        return;
    };
    stage.wait_for_records(1, "shuttle.status.published.robot.0.rec");
    // Quickly filled then.
    stage.fill(1, 1 << 20);
    // The exchange is over when the last file of the other host is there.
    let records = stage.folder(1).unwrap().join("records");
    wait_until(LIMIT, "the exchange", || {
        let files = fs::read_dir(&records).unwrap().flatten();
        files
            .filter(|file| {
                file.file_name()
                    .to_string_lossy()
                    .contains(".taken.controller.")
            })
            .any(|file| file.metadata().is_ok_and(|data| data.len() > 4096))
    });
    stage.fill(1, 0);
    let ends = stage.end();
    let verdicts = [0, 1].map(|index| {
        let result = stage.result(index);
        assert_eq!(result.outcome, RunOutcome::Completed);
        assert!(count(&ends[index].stdout) <= 1, "{}", ends[index].stdout);
        let summary = stage.summary(index);
        (result.gaps, Assessment::of(&summary).network)
    });
    assert_eq!(verdicts[0], verdicts[1]);
    assert_eq!(code(&ends[1]), FAILED);
}
