//! A [`View`] of a run, from what its processes recorded in the last window, from what its
//! supervisor says of them and from what the kernel does.

use std::collections::BTreeMap;
use std::io;
use std::time::Duration;

use hil_account::{ChannelAccount, EndToEnd, MessageFate};
use hil_core::time::Instant;
use hil_link::condition::LinkCondition;
use hil_link::spec::{LinkSpec, Way};
use hil_stats::histogram::Distribution;

use super::draw::HISTORY_COLUMNS;
use super::robot::RobotWatch;
use super::view::{
    ChannelRow, ClockRow, LinkRow, LinkState, PeerStatusRow, ProcessRow, Quantiles, RobotView,
    RunState, RunView, SegmentRow, View,
};
use crate::live::observer::Observer;
use crate::live::process;
use hil_platform::clock::MonotonicClock;
use hil_rundir::status::{self, Phase, ProcessStatus, RunStatus};
use hil_topology::{Channel, Link, Topology};

/// The supervisor tells of its processes twice a second; what is older than this is said to be old.
const STATUS_AGE_MAX: Duration = Duration::from_secs(2);

/// The processor time of a process at one look.
#[derive(Debug, Clone, Copy)]
struct ProcessorTime {
    used_ns: u64,
    /// When it was looked at.
    at_ns: i64,
}

impl ProcessorTime {
    /// Processor time over time since an earlier look; `None` when that is of another process.
    fn ratio_since(self, before: Self) -> Option<f64> {
        let passed_ns = self.at_ns.saturating_sub(before.at_ns);
        let used_ns = self.used_ns.checked_sub(before.used_ns)?;
        (passed_ns > 0).then(|| used_ns as f64 / passed_ns as f64)
    }
}

/// What a look remembers for the next one.
#[derive(Debug, Default)]
pub(crate) struct Gatherer {
    /// By process id.
    cpu: BTreeMap<u32, ProcessorTime>,
    /// 99th percentiles of the delay, by channel.
    history: BTreeMap<String, Vec<Option<i64>>>,
    /// What the supervisor told last; it removes its file a moment before the run is over.
    status: Option<RunStatus>,
    /// The events of the robot, where the case finds any.
    robot: Option<RobotWatch>,
    /// The view while the run still ran: what is left to show when it is over.
    last: Option<View>,
}

impl Gatherer {
    /// One that looks for events of the robot, too.
    pub(crate) fn of(robot: Option<RobotWatch>) -> Self {
        Self {
            robot,
            ..Self::default()
        }
    }

    /// Reads more of what happened to the robot, without waiting.
    pub(crate) fn read(&mut self) {
        if let Some(robot) = &mut self.robot {
            robot.step(MonotonicClock::now());
        }
    }

    /// Looks at the run.
    pub(crate) fn look(&mut self, observer: &Observer, window: Duration) -> View {
        let is_over = observer.is_over();
        if is_over && let Some(mut last) = self.last.clone() {
            last.run.state = state_of(observer, None);
            return last;
        }
        let status = RunStatus::read(&observer.run().folder);
        let mut problems = observer.problems().to_vec();
        // Both read the same folder.
        let of_robot = self.robot.iter().flat_map(RobotWatch::problems);
        for problem in of_robot {
            if !problems.contains(problem) {
                problems.push(problem.clone());
            }
        }
        if !is_over {
            problems.extend(status_problem(status.as_ref()));
        }
        if let Ok(status) = status {
            self.status = Some(status);
        }
        let status = self.status.clone();
        let accounts: BTreeMap<&str, ChannelAccount> = observer
            .manifest()
            .channels
            .iter()
            .filter_map(|one| Some((one.name.as_str(), observer.account(&one.name, window)?)))
            .collect();
        let view = View {
            run: run_view(observer, status.as_ref(), window),
            processes: self.processes(status.as_ref()),
            elsewhere: status.as_ref().map(elsewhere).unwrap_or_default(),
            channels: self.channels(observer, &accounts),
            robot: self.robot(status.as_ref()),
            links: observer
                .topology()
                .map(|topology| links(topology, observer, &accounts))
                .unwrap_or_default(),
            clocks: clocks(observer),
            problems,
        };
        if status.is_some_and(|status| status.phase == Phase::Running) {
            self.last = Some(view.clone());
        }
        view
    }

    fn processes(&mut self, status: Option<&RunStatus>) -> Vec<ProcessRow> {
        let processes = status.map(|status| status.processes.as_slice());
        let mut cpu = BTreeMap::new();
        let rows = processes.unwrap_or_default().iter().map(|one| {
            let look = one.pid.map(process::look).unwrap_or_default();
            let at_ns = MonotonicClock::now().as_ns();
            let now = look.cpu_ns.map(|used_ns| ProcessorTime { used_ns, at_ns });
            let before = one.pid.and_then(|pid| self.cpu.get(&pid));
            cpu.extend(one.pid.zip(now));
            let both = now.zip(before);
            process_row(
                one,
                look,
                both.and_then(|(now, before)| now.ratio_since(*before)),
            )
        });
        let rows = rows.collect();
        self.cpu = cpu;
        rows
    }

    fn robot(&self, status: Option<&RunStatus>) -> Option<RobotView> {
        let start_ns = status.and_then(|status| status.start_ns);
        self.robot.as_ref()?.look(start_ns.map(Instant::from_ns))
    }

    fn channels(
        &mut self,
        observer: &Observer,
        accounts: &BTreeMap<&str, ChannelAccount>,
    ) -> Vec<ChannelRow> {
        let here = observer.manifest().channels.iter();
        let here = here.filter(|one| observer.source(&one.name).is_some());
        let rows = here.map(|one| {
            let account = accounts.get(one.name.as_str());
            let history = self.history.entry(one.name.clone()).or_default();
            let mut row = channel_row(observer, &one.name, account);
            history.push(row.delay.map(|delay| delay.p99_ns));
            if history.len() > HISTORY_COLUMNS {
                history.remove(0);
            }
            row.history_ns.clone_from(history);
            row
        });
        rows.collect()
    }
}

/// The other hosts; once the run is being ended, as they were heard before.
fn elsewhere(status: &RunStatus) -> Vec<PeerStatusRow> {
    let now = match status.phase {
        Phase::Ending => Instant::from_ns(status.written_ns),
        Phase::Starting | Phase::Running => MonotonicClock::now(),
    };
    let hosts = status.elsewhere.iter().map(|host| {
        let processes = host.processes.iter();
        let skipped = processes.filter_map(|one| {
            let count = one.skipped_tick_count.filter(|count| *count > 0)?;
            Some((one.name.clone(), count))
        });
        PeerStatusRow {
            hearing: status::hearing(&host.name, host.heard_ns, now, host.left_out_count),
            overruns: skipped.collect(),
        }
    });
    hosts.collect()
}

/// What is wrong with what the supervisor tells.
fn status_problem(status: Result<&RunStatus, &io::Error>) -> Option<String> {
    let status = match status {
        Ok(status) => status,
        Err(error) => {
            return Some(format!(
                "the supervisor does not tell of its processes: {error}"
            ));
        }
    };
    let now_ns = MonotonicClock::now().as_ns();
    let elapsed_ns = now_ns.saturating_sub(status.written_ns).max(0);
    let age = Duration::from_nanos(elapsed_ns.unsigned_abs());
    (age > STATUS_AGE_MAX).then(|| {
        let seconds = age.as_secs_f64();
        format!("what the supervisor tells of its processes is {seconds:.1} s old")
    })
}

fn state_of(observer: &Observer, status: Option<&RunStatus>) -> RunState {
    let run = observer.run();
    match status {
        _ if run.is_supervisor_gone() => RunState::SupervisorGone,
        _ if !run.is_announced() => RunState::Ended,
        Some(status) => status.phase.into(),
        None => RunState::Unknown,
    }
}

fn run_view(observer: &Observer, status: Option<&RunStatus>, window: Duration) -> RunView {
    let run = observer.run();
    let seconds = |ns: i64| Duration::from_nanos(ns.max(0).unsigned_abs()).as_secs_f64();
    let state = state_of(observer, status);
    let now_ns = MonotonicClock::now().as_ns();
    let start_ns = status.and_then(|status| status.start_ns);
    RunView {
        name: run.name.clone(),
        folder: run.folder.clone(),
        hosts_here: run.hosts().map(str::to_owned).collect(),
        state,
        elapsed_s: start_ns.map(|start_ns| seconds(now_ns.saturating_sub(start_ns))),
        duration_s: status
            .and_then(|status| status.duration_ns)
            .map(|duration_ns| Duration::from_nanos(duration_ns).as_secs_f64()),
        window_s: window.as_secs_f64(),
    }
}

fn process_row(
    status: &ProcessStatus,
    look: process::ProcessLook,
    cpu_ratio: Option<f64>,
) -> ProcessRow {
    ProcessRow {
        name: status.name.clone(),
        host: status.host.clone(),
        kind: status.kind,
        role: status.role.clone(),
        state: status.state.clone(),
        pid: status.pid,
        cpu_ratio,
        cpus: look.cpus,
        scheduling: look.scheduling,
        overrun_count: status.skipped_tick_count,
        restart_count: status.restart_count,
    }
}

fn channel_row(observer: &Observer, name: &str, account: Option<&ChannelAccount>) -> ChannelRow {
    let topology = observer.topology();
    let channel = topology.and_then(|topology| topology.channel(name));
    let end_to_end = account.map(|account| &account.end_to_end);
    let segments = account.map(|account| {
        let each = account.segments.iter();
        each.map(|one| SegmentRow {
            name: one.name(),
            time: quantiles(&one.distribution),
        })
        .collect()
    });
    ChannelRow {
        name: name.to_owned(),
        via: via(topology, channel),
        rate_hz: observer.rate_hz(name),
        lost_count: account.and_then(lost_count),
        delay: end_to_end.and_then(|one| quantiles(&one.distribution)),
        why_no_delay: match end_to_end.map(|one| &one.distribution) {
            Some(Distribution::Measured(_)) => None,
            Some(Distribution::Unavailable { reason }) => Some(reason.clone()),
            None if channel.is_some_and(Channel::is_recorded_only) => {
                Some("its messages only go to the record".to_owned())
            }
            None if observer.is_recorded(name) => Some("no message in this time".to_owned()),
            None => Some("nothing of it is recorded here".to_owned()),
        },
        bound_ns: end_to_end.and_then(EndToEnd::alignment_bound_ns),
        segments: segments.unwrap_or_default(),
        history_ns: Vec::new(),
    }
}

/// `None` where the other host's records would have to say.
fn lost_count(account: &ChannelAccount) -> Option<u64> {
    let unknown = account.fates.of(MessageFate::UnknownPeerRecordsUnavailable);
    (unknown == 0).then(|| account.fates.lost_count())
}

fn quantiles(distribution: &Distribution) -> Option<Quantiles> {
    distribution.measured().map(|summary| Quantiles {
        p50_ns: summary.p50_ns,
        p99_ns: summary.p99_ns,
    })
}

/// What carries a channel, in words.
pub(crate) fn via(topology: Option<&Topology>, channel: Option<&Channel>) -> String {
    let Some((topology, channel)) = topology.zip(channel) else {
        return "unknown".to_owned();
    };
    if channel.is_recorded_only() {
        return "record only".to_owned();
    }
    topology
        .crossing(channel)
        .map_or_else(|| "shared memory".to_owned(), |one| one.link.name.clone())
}

fn links(
    topology: &Topology,
    observer: &Observer,
    accounts: &BTreeMap<&str, ChannelAccount>,
) -> Vec<LinkRow> {
    let used = topology.links().iter().filter(|link| {
        let mut crossings = topology.crossings();
        crossings.any(|crossing| crossing.link.name == link.name)
    });
    used.map(|link| link_row(link, topology, observer, accounts))
        .collect()
}

fn link_row(
    link: &Link,
    topology: &Topology,
    observer: &Observer,
    accounts: &BTreeMap<&str, ChannelAccount>,
) -> LinkRow {
    let crossings = topology.crossings();
    let carried = crossings.filter(|crossing| crossing.link.name == link.name);
    let (mut came_count, mut lost_count, mut known_count, mut doubtful_count) = (None, 0, 0, 0);
    for crossing in carried {
        let name = crossing.channel.name.as_str();
        if let Some(count) = observer.brought_count(name) {
            came_count = Some(came_count.unwrap_or(0) + count);
        }
        let Some(account) = accounts.get(name) else {
            continue;
        };
        let fates = &account.fates;
        let unknown = fates.of(MessageFate::UnknownPeerRecordsUnavailable);
        let never_sent = fates.of(MessageFate::SupersededAtInput) + fates.of(MessageFate::InFlight);
        lost_count += fates.of(MessageFate::LostOnWire)
            + fates.of(MessageFate::Incomplete)
            + fates.of(MessageFate::NetworkUnreachable);
        doubtful_count += fates.of(MessageFate::LostOnWireOrByHarness);
        known_count += fates.total().saturating_sub(unknown + never_sent);
    }
    let state = match came_count {
        None => LinkState::Unknown,
        Some(0) => LinkState::Silent,
        Some(_) => LinkState::Carries,
    };
    LinkRow {
        name: link.name.clone(),
        via: link.via.word().to_owned(),
        state,
        condition: link.emulation().map(|emulation| {
            let words = |way, spec| condition_words(observer, topology, link, way, spec);
            let there = words(Way::Forward, &emulation.forward);
            let back = words(Way::Backward, &emulation.backward);
            if there == back {
                there
            } else {
                format!("there: {there}; back: {back}")
            }
        }),
        loss_ratio: (known_count > 0 && doubtful_count == 0)
            .then(|| lost_count as f64 / known_count as f64),
    }
}

/// What one direction of an emulated link does at present.
fn condition_words(
    observer: &Observer,
    topology: &Topology,
    link: &Link,
    way: Way,
    spec: &LinkSpec,
) -> String {
    let ordered = observer.link_condition(&link.name, way);
    if ordered != LinkCondition::Topology {
        return format!("{ordered}, changed by hand");
    }
    let mut crossings = topology.crossings();
    let crossing = crossings.find(|one| one.link.name == link.name && one.direction == way);
    // Changes are on record where the gateway is that emulates the direction.
    let is_known = crossing.is_none_or(|crossing| {
        let mut here = observer.run().hosts();
        here.any(|host| host == crossing.to_host.name)
    });
    let words = spec.describe();
    if is_known {
        words
    } else {
        format!("{words}, by the topology")
    }
}

/// The hosts that have a channel between them.
fn clocks(observer: &Observer) -> Vec<ClockRow> {
    let mut rows: Vec<ClockRow> = Vec::new();
    for channel in &observer.manifest().channels {
        let Some((from, to)) = observer.hosts_of(&channel.name) else {
            continue;
        };
        let is_known = |row: &ClockRow| {
            (&row.from, &row.to) == (&from, &to) || (&row.from, &row.to) == (&to, &from)
        };
        if rows.iter().any(is_known) {
            continue;
        }
        rows.push(clock_row(observer, from, to));
    }
    rows
}

fn clock_row(observer: &Observer, from: String, to: String) -> ClockRow {
    let figures = observer.clock(&from, &to);
    let has_path_exchanges = observer.has_clock_path_exchanges(&from, &to);
    ClockRow {
        rung: figures.rung.words(has_path_exchanges).to_owned(),
        exchange_count: figures.exchange_count,
        offset_ns: figures.offset_ns,
        bound_ns: figures.bound_ns,
        from,
        to,
    }
}
