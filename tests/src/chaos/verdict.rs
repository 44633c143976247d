//! What must hold after an episode, judged by what the run left: both hosts end in time and say how,
//! every message has a fate, none is delivered twice, accounts that can be closed are, what nobody
//! can know is said, and nothing is left behind.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use hil_account::MessageFate;
use hil_core::record::TakenRecord;
use hil_report::summary::{Outcome, RunSummary};
use hil_rundir::record::{RecordFile, RecordKind};
use nix::unistd::Pid;

use super::episode::{Ends, HOSTS, Stage};
use super::plan::{Kind, Plan};
use crate::account::{carried, describe};
use crate::child::Finished;
use crate::soak::held::Held;
use crate::trial::processes_mentioning;

/// Exit codes of a run: as planned, failed, another host vanished or never came, interrupted.
const EXIT_CODES: [i32; 4] = [0, 1, 69, 130];
/// Files that a process may hold for a moment.
const FILES_MORE_MAX: u64 = 3;

/// What is said of an episode.
#[derive(Debug, Default)]
pub struct Verdict {
    /// What must hold and does not.
    pub violations: Vec<String>,
    /// How each host ended.
    pub ends: [String; 2],
    /// Messages published and taken.
    pub messages: Option<(u64, u64)>,
}

impl Verdict {
    /// Judges the episode of `plan`.
    pub fn of(plan: &Plan, stage: &Stage, ends: &Ends) -> Self {
        let mut verdict = Self::default();
        let mut summaries = [None, None];
        for host in 0..2 {
            summaries[host] = verdict.judge_host(plan, stage, host, ends[host].as_ref());
            verdict.judge_deliveries(stage, host);
        }
        if let [Some(first), Some(second)] = &summaries {
            verdict.compare(plan, first, second);
        }
        let told = summaries.iter().flatten().next();
        verdict.messages = told.map(|summary| {
            let accounts = carried(summary).filter_map(|channel| channel.account.as_ref());
            accounts.fold((0, 0), |(published, taken), account| {
                (
                    published + account.published_count,
                    taken + account.fates.of(MessageFate::Taken),
                )
            })
        });
        verdict
    }

    fn complain(&mut self, host: usize, what: &str) {
        self.violations.push(format!("{}: {what}", HOSTS[host]));
    }

    fn judge_host(
        &mut self,
        plan: &Plan,
        stage: &Stage,
        host: usize,
        end: Option<&Finished>,
    ) -> Option<RunSummary> {
        let Some(end) = end else {
            "did not end".clone_into(&mut self.ends[host]);
            self.complain(host, "the supervisor did not end in time");
            return None;
        };
        let Some(code) = end.status.code() else {
            "killed".clone_into(&mut self.ends[host]);
            if !plan.has(Kind::KillSupervisor, Some(host)) {
                self.complain(host, &format!("the supervisor ended with {}", end.status));
            }
            return None;
        };
        let summary = self.read_summary(stage, host);
        let word = summary
            .as_ref()
            .map(|summary| format!("{:?}", summary.run.outcome));
        self.ends[host] = format!("{} ({code})", word.unwrap_or_else(|| "no run".to_owned()));
        if !EXIT_CODES.contains(&code) {
            self.complain(host, &format!("exit code {code}\n{}", end.stderr));
        }
        if end.stderr.contains("panicked") {
            self.complain(host, &format!("a panic\n{}", end.stderr));
        }
        self.judge_logs(stage, host);
        let Some(summary) = summary else {
            // A run that did not come about says why; one that did leaves a summary.
            let is_excused = plan.has(Kind::FillDisk, Some(host)) || code != 0;
            if !is_excused || end.stderr.trim().is_empty() {
                self.complain(
                    host,
                    &format!("no summary, exit code {code}\n{}", end.stderr),
                );
            }
            return None;
        };
        self.judge_end(plan, host, &summary, code);
        self.judge_accounts(plan, host, &summary);
        Some(summary)
    }

    fn read_summary(&mut self, stage: &Stage, host: usize) -> Option<RunSummary> {
        let folder = stage.folder_of(host)?;
        let text = fs::read_to_string(folder.join("summary.json")).ok()?;
        match RunSummary::from_json(&text) {
            Ok(summary) => Some(summary),
            Err(error) => {
                self.complain(host, &format!("summary.json: {error}"));
                None
            }
        }
    }

    /// No process may have panicked, whatever came of it.
    fn judge_logs(&mut self, stage: &Stage, host: usize) {
        let folder = stage.folder_of(host).unwrap_or_default();
        for entry in fs::read_dir(folder.join("logs"))
            .into_iter()
            .flatten()
            .flatten()
        {
            let text = fs::read_to_string(entry.path()).unwrap_or_default();
            if text.contains("panicked") {
                let name = entry.file_name().to_string_lossy().into_owned();
                self.complain(host, &format!("{name} says\n{text}"));
            }
        }
    }

    fn judge_end(&mut self, plan: &Plan, host: usize, summary: &RunSummary, code: i32) {
        let outcome = summary.run.outcome;
        let fits = match outcome {
            // 1: it completed, but records are missing, and it says so.
            Outcome::Completed => code == 0 || (code == 1 && !summary.warnings.is_empty()),
            Outcome::CriterionFailed => code == 1,
            Outcome::Stopped => matches!(code, 1 | 130),
            Outcome::Failed => matches!(code, 1 | 69),
        };
        let reason = &summary.run.exit_reason;
        if !fits || reason.is_empty() {
            self.complain(host, &format!("{outcome:?}, {reason:?}, exit code {code}"));
        }
        if plan.is_survived() && (outcome, code) != (Outcome::Completed, 0) {
            let warnings = summary.warnings.join("; ");
            let text = format!("survivable, and {outcome:?} ({code}): {reason}; {warnings}");
            self.complain(host, &text);
        }
    }

    fn judge_accounts(&mut self, plan: &Plan, host: usize, summary: &RunSummary) {
        // Where a supervisor was lost, its records are, and then that must be said.
        let is_whole = !plan.has(Kind::KillSupervisor, None)
            && !plan.has(Kind::HangSupervisor, None)
            && !plan.has(Kind::FillDisk, None)
            && summary.run.outcome != Outcome::Failed;
        for channel in carried(summary) {
            let Some(account) = &channel.account else {
                if is_whole && summary.run.duration_s > 0.5 {
                    self.complain(host, &format!("{} has no account", channel.name));
                }
                continue;
            };
            let said = describe(&channel.name, account);
            if account.fates.total() != account.published_count {
                self.complain(host, &format!("not every message has one fate: {said}"));
            }
            let unknown = account.fates.of(MessageFate::UnknownPeerRecordsUnavailable);
            if unknown > 0 && summary.warnings.is_empty() {
                self.complain(host, &format!("unknown without a warning: {said}"));
            }
            if !is_whole {
                continue;
            }
            for fate in [
                MessageFate::Unexplained,
                MessageFate::UnknownPeerRecordsUnavailable,
                MessageFate::RefusedAtIngress,
            ] {
                if account.fates.of(fate) > 0 {
                    self.complain(host, &format!("{fate:?} in {said}"));
                }
            }
            if let Some(closing) = account.closing.checked()
                && closing.negative_segment_count > 0
            {
                self.complain(host, &format!("negative segments in {said}"));
            }
        }
    }

    /// No consumer may have taken a message twice, by the records of its own host.
    fn judge_deliveries(&mut self, stage: &Stage, host: usize) {
        let folder = stage.folder_of(host).unwrap_or_default().join("records");
        for twice in taken_twice(&folder) {
            self.complain(host, &twice);
        }
    }

    /// Both hosts tell the same of the same messages, when both have all records.
    fn compare(&mut self, plan: &Plan, first: &RunSummary, second: &RunSummary) {
        let both = [first, second];
        if !plan.is_survived() || both.iter().any(|one| one.run.outcome != Outcome::Completed) {
            return;
        }
        for (here, there) in carried(first).zip(carried(second)) {
            let of = |channel: &hil_report::summary::ChannelSummary| {
                channel.account.as_ref().map(|account| {
                    let fates: Vec<_> = account.fates.iter().collect();
                    (account.published_count, fates)
                })
            };
            if of(here) != of(there) {
                let (here, there) = (of(here), of(there));
                let text = format!("the hosts disagree: {here:?} and {there:?}");
                self.violations.push(text);
            }
        }
    }
}

/// Messages that the record files of `folder` have as taken more than once, in words.
fn taken_twice(folder: &Path) -> Vec<String> {
    let mut taken: BTreeMap<String, BTreeSet<(u32, u64)>> = BTreeMap::new();
    let mut twice = Vec::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        // A file that a full disk cut short within its header is none.
        let file = RecordFile::read(&entry.path()).ok();
        let Some(file) = file.filter(|file| file.header.kind == RecordKind::Taken) else {
            continue;
        };
        let known = taken.entry(file.header.channel.clone()).or_default();
        for record in file.records::<TakenRecord>() {
            let key = (record.epoch, record.sequence);
            if !known.insert(key) {
                twice.push(format!("{} was taken twice: {key:?}", file.header.channel));
            }
        }
    }
    twice
}

/// Supervisors and gateways that hold more files than before, of those that are the same process.
pub fn gained_files(before: &[(String, Pid, Held)], after: &[(String, Pid, Held)]) -> Vec<String> {
    let mut gained = Vec::new();
    for (name, process, now) in after {
        let known = before.iter().find(|(_, known, _)| known == process);
        if let Some((_, _, then)) = known
            && now.file_count > then.file_count + FILES_MORE_MAX
        {
            let (then, now) = (then.file_count, now.file_count);
            gained.push(format!("{name} held {then} files and holds {now}"));
        }
    }
    gained
}

/// What is left on a host although its run has ended.
pub fn leftovers(stage: &Stage, host: usize) -> Vec<String> {
    let lab_host = stage.lab().host(host);
    let mut left: Vec<String> = Vec::new();
    let launch = stage.folder_inside(host).join("launch");
    for process in processes_mentioning(&launch.to_string_lossy()) {
        left.push(format!("process {process}"));
    }
    left.extend(lab_host.shared_memory_leftovers());
    let domains = fs::read_dir(lab_host.locate("/run/hil"));
    for entry in domains.into_iter().flatten().flatten() {
        left.push(entry.path().display().to_string());
    }
    if left.is_empty() {
        return left;
    }
    vec![format!("{}: left behind: {left:?}", HOSTS[host])]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_folder::RunFolder;
    use hil_rundir::record::file::RecordHeader;

    fn taken(epoch: u32, sequence: u64) -> TakenRecord {
        TakenRecord {
            sequence,
            published_ns: 0,
            forwarded_ns: 0,
            taken_ns: 0,
            epoch,
            reserved: 0,
        }
    }

    /// A record file of one start of the consumer.
    fn write(folder: &RunFolder, instance: u32, records: &[TakenRecord]) {
        let header = RecordHeader {
            kind: RecordKind::Taken,
            channel: "a/b".to_owned(),
            record_bytes: u32::try_from(size_of::<TakenRecord>()).unwrap(),
            instance,
        };
        let path = folder.join(header.file_name("c"));
        let mut bytes = header.encode(&path).unwrap().to_vec();
        bytes.extend_from_slice(bytemuck::cast_slice(records));
        fs::write(path, bytes).unwrap();
    }

    #[test]
    fn a_message_that_was_taken_twice_is_found_across_starts_of_the_consumer() {
        let folder = RunFolder::new("twice");
        write(&folder, 0, &[taken(1, 0), taken(1, 1), taken(2, 0)]);
        assert_eq!(taken_twice(folder.path()), Vec::<String>::new());
        write(&folder, 1, &[taken(1, 2), taken(1, 1)]);
        assert_eq!(taken_twice(folder.path()), ["a/b was taken twice: (1, 1)"]);
    }

    #[test]
    fn files_that_one_process_gained_are_found_and_another_process_is_another() {
        let held = |file_count| Held {
            file_count,
            ..Held::default()
        };
        let of = |process, count| ("gateway".to_owned(), Pid::from_raw(process), held(count));
        let before = [of(7, 20)];
        assert!(gained_files(&before, &[of(7, 20 + FILES_MORE_MAX)]).is_empty());
        assert!(gained_files(&before, &[of(8, 90)]).is_empty());
        let gained = gained_files(&before, &[of(7, 30)]);
        assert_eq!(gained, ["gateway held 20 files and holds 30"]);
    }
}
