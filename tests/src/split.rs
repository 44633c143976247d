//! A sealed run of the real binary between both hosts of a lab, and what its gateways counted. It judges
//! nothing but that the run went as planned.
#![allow(clippy::print_stdout, reason = "a test's figures are its result")]

use core::ops::Range;
use std::time::Duration;

use hil_core::record::TakenRecord;
use hil_report::summary::{CounterGroup, DirectionSummary, Outcome, RunSummary};

use crate::account::{account, assert_every_message_is_accounted_for, channel, describe};
use crate::child::{ChildGuard, Finished};
use crate::lab::Lab;
use crate::latency::Latencies;
use crate::shuttle::{CHANNELS, records};
use crate::trial::{RunFiles, Trial, load_average, wait_until};
use nix::sys::signal::Signal;

/// Names of the hosts in the topology.
pub const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
/// Of an arm, to its host and back.
pub const ARM_CHANNELS: [&str; 2] = ["egm/right/command", "egm/right/feedback"];
const LIMIT: Duration = Duration::from_mins(3);
const RUN_LIMIT: Duration = Duration::from_mins(6);
/// Of the host that is told to end by a signal, and of the one that hears it from there, as `--help` lists them.
const STOPPED_CODES: [i32; 2] = [130, 1];
/// Records of 32 bytes: half a second of commands.
const FLOWING_BYTES: u64 = 60 * 32;

/// The run, on both hosts.
#[derive(Debug)]
pub struct Split<'a> {
    /// The supervisors.
    pub hosts: [ChildGuard; 2],
    /// What each host leaves.
    pub files: [RunFiles; 2],
    lab: &'a Lab,
    /// To the robot's host and back.
    channels: [&'static str; 2],
}

impl<'a> Split<'a> {
    /// Starts it.
    ///
    /// # Panics
    /// When it does not start.
    pub fn start(lab: &'a Lab, trial: &Trial) -> Self {
        let hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
        Self::of(lab, trial, hosts)
    }

    /// Of supervisors that were started one by one.
    ///
    /// # Panics
    /// When their run folders do not appear.
    pub fn of(lab: &'a Lab, trial: &Trial, hosts: [ChildGuard; 2]) -> Self {
        let files = HOSTS.map(|host| trial.folder(&format!("-{host}"), LIMIT));
        Self {
            hosts,
            files,
            lab,
            channels: CHANNELS,
        }
    }

    /// With these channels to the robot's host and back, instead of the shuttle's.
    #[must_use]
    pub fn carrying(self, channels: [&'static str; 2]) -> Self {
        Self { channels, ..self }
    }

    /// Waits until both hosts have taken half a second's messages from now on.
    ///
    /// # Panics
    /// When they do not.
    pub fn wait_for_messages(&self, after: &str) {
        let taken = || {
            [(1, self.channels[0]), (0, self.channels[1])].map(|(index, name)| {
                let start = format!("{}.taken.", name.replace('/', "."));
                self.files[index].record_bytes(&start)
            })
        };
        let before = taken();
        wait_until(LIMIT, &format!("messages both ways after {after}"), || {
            let now = taken();
            (0..2).all(|way| now[way] >= before[way] + FLOWING_BYTES)
        });
    }

    /// Kills `process` on host `index`, and waits until it is back and messages flow.
    ///
    /// # Panics
    /// When it does not come back.
    pub fn kill(&self, index: usize, process: &str) {
        self.files[index].kill_process(process, 0, LIMIT);
        let back = format!("the restart of {process}");
        wait_until(LIMIT, &back, || {
            self.files[index].process(process, 1).is_some()
        });
        self.wait_for_messages(&back);
    }

    /// Waits for the end, however it comes, and checks that it left nothing behind.
    ///
    /// # Panics
    /// When it does not come, or left something.
    pub fn ended(&mut self) -> [Finished; 2] {
        let finished = self.hosts.each_mut().map(|host| {
            let ended = host.wait_within(RUN_LIMIT);
            ended.unwrap_or_else(|reason| panic!("{reason}"))
        });
        for (index, files) in self.files.iter().enumerate() {
            files.assert_nothing_left_on(self.lab.host(index));
        }
        finished
    }

    /// What both hosts report.
    pub fn summaries(&self) -> [RunSummary; 2] {
        self.files.each_ref().map(RunFiles::summary)
    }

    /// Ends the run once a test has what it needs and messages flow, so that those of a moment ago have come, and
    /// checks that it ended so, and that every message has a fate.
    ///
    /// # Panics
    /// When one of these does not hold.
    pub fn stop(mut self) -> [RunSummary; 2] {
        self.wait_for_messages("all that the test did");
        self.interrupt();
        let summaries = self.stopped();
        for summary in &summaries {
            assert_every_message_is_accounted_for(summary);
        }
        summaries
    }

    /// Tells the first host to end the run, as a service manager does.
    ///
    /// # Panics
    /// When either host has ended before.
    pub fn interrupt(&mut self) {
        for host in &mut self.hosts {
            assert!(host.is_running(), "{}", host.stderr_so_far());
        }
        let told = self.hosts[0].signal(Signal::SIGTERM);
        assert_eq!(told, Ok(()), "SIGTERM to {}", HOSTS[0]);
    }

    /// Waits for the end of a run that was interrupted, and checks that both hosts say so, that it left nothing
    /// behind and that no records are missing.
    ///
    /// # Panics
    /// When one of these does not hold.
    pub fn stopped(mut self) -> [RunSummary; 2] {
        for (finished, code) in self.ended().iter().zip(STOPPED_CODES) {
            finished.assert_code(code);
        }
        let summaries = self.summaries();
        for summary in &summaries {
            assert_eq!(summary.run.outcome, Outcome::Stopped, "{:?}", summary.run);
            let reason = &summary.run.exit_reason;
            assert!(reason.contains("interrupted by SIGTERM"), "{reason}");
            assert!(summary.record_gaps.is_empty(), "{:?}", summary.record_gaps);
            self.print(summary);
        }
        summaries
    }

    /// Waits for the end, and checks that it was the planned one, left nothing behind, and that every
    /// message has a fate.
    ///
    /// # Panics
    /// When one of these does not hold.
    pub fn finish(self) -> [RunSummary; 2] {
        let summaries = self.end();
        for summary in &summaries {
            assert_every_message_is_accounted_for(summary);
        }
        summaries
    }

    /// Waits for the end, and checks that it was the planned one and left nothing behind.
    ///
    /// # Panics
    /// When it was not, or did.
    pub fn end(mut self) -> [RunSummary; 2] {
        for finished in self.ended() {
            finished.assert_success();
        }
        let summaries = self.summaries();
        for summary in &summaries {
            assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
            self.print(summary);
        }
        summaries
    }

    fn print(&self, summary: &RunSummary) {
        for name in self.channels {
            let said = describe(name, account(summary, name));
            println!("{}: {said}; load {}", summary.run.host, load_average());
        }
    }
}

/// The gateway thread that carried the channel `name` with others of its way: `egress` or `ingress`.
///
/// # Panics
/// When the summary has none.
pub fn direction<'a>(summary: &'a RunSummary, name: &str, which: &str) -> &'a DirectionSummary {
    let mut all = summary.directions.iter();
    let found = all.find(|one| {
        one.direction.word() == which && one.channels.iter().any(|channel| channel == name)
    });
    found.unwrap_or_else(|| panic!("{name} has no {which}"))
}

/// What the gateways counted of the channel `name` alone; 0 when there is no such counter.
pub fn count_of_channel(summary: &RunSummary, name: &str, counter: &str) -> u64 {
    let ends = channel(summary, name).ends.iter();
    let counters = ends.flat_map(|one| &one.counters);
    let named = counters.filter(|one| one.label() == counter);
    named.map(|one| one.count).sum()
}

/// The counter `name` of a direction; 0 when there is none.
pub fn count(direction: &DirectionSummary, name: &str) -> u64 {
    let counters = direction.counters.iter().filter(|one| one.label() == name);
    counters.map(|one| one.count).sum()
}

/// Datagrams that a direction refused, whatever the cause.
pub fn refused(direction: &DirectionSummary) -> u64 {
    let counters = direction.counters.iter();
    let refused = counters.filter(|one| one.group == CounterGroup::Refused);
    refused.map(|one| one.count).sum()
}

/// How long the messages of `channel` that were published in `window_ns` took over the hop
/// (until the receiving gateway published them) and end to end.
///
/// # Panics
/// When the records cannot be read.
pub fn delays(files: &RunFiles, channel: &str, window_ns: Range<i64>) -> [Latencies; 2] {
    let mut taken: Vec<TakenRecord> = records(files, channel, "taken");
    taken.retain(|one| window_ns.contains(&one.published_ns));
    let hop = taken.iter().map(|one| one.forwarded_ns - one.published_ns);
    let whole = taken.iter().map(|one| one.taken_ns - one.published_ns);
    [Latencies::of(hop.collect()), Latencies::of(whole.collect())]
}
