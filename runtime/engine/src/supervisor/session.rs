//! One run from beginning to end. Each step is short; what a step does is in its own file.

use std::collections::BTreeMap;
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::time::{Duration, Instant as WallInstant, SystemTime};
use std::{fs, thread};

use hil_core::time::Instant;
use hil_net::clock_pair::ClockPair;

use super::claims::Claims;
use super::domains::{self, Domains};
use super::exchange::exchange;
use super::frame::{Frame, PeerMessage};
use super::needs;
use super::neighbours::Neighbours;
use super::outcome::{Heard, RunError, RunOptions};
use super::peer::{Peer, PeerEvent};
use super::peer_status::{PeerStatus, greeting, own_ticks};
use super::plan::{ProcessPlan, domain_base, plan};
use super::process_group::ProcessGroup;
use super::rendezvous::{gather, read_key};
use super::status_publisher::StatusPublisher;
use crate::process::own_program;
use hil_nic::nic_clock::NicWatch;
use hil_platform::clock::MonotonicClock;
use hil_platform::clock_discipline::HostDiscipline;
use hil_platform::console::Console;
use hil_platform::host_facts::HostFacts;
use hil_platform::signals::Signals;
use hil_rundir::announcement::Announcement;
use hil_rundir::event::{Event, EventKind, HostHistory, ProcessHistory, disciplines};
use hil_rundir::file_fault::{FileFault, is_of_full_disk};
use hil_rundir::manifest::{self, ManifestContent};
use hil_rundir::pipe::Failure;
use hil_rundir::protection::RunSecurity;
use hil_rundir::run_folder::{RunFolder, utc_text};
use hil_rundir::run_result::{self, Outcome, RunResult};
use hil_rundir::status::Phase;
use hil_shm::clock_id;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::emulation_room::check_emulation;
use hil_topology::{Host, Topology};

/// Reads of the two clocks of which the narrowest counts.
const CLOCK_READS: u32 = 5;
/// How often the supervisor looks after everything.
const WATCH_PERIOD: Duration = Duration::from_millis(5);
/// How often the memory of dead processes is freed: short against the second in which a
/// restarted process is to be back.
const CLEANUP_PERIOD: Duration = Duration::from_millis(100);
const ALIVE_PERIOD: Duration = Duration::from_millis(500);
/// How long components and gateways may take to end in order.
const STOP_PATIENCE: Duration = Duration::from_secs(3);
/// How long the other hosts wait for the first host's word that the time is up.
const END_GRACE: Duration = Duration::from_secs(3);
/// Time for what is still under way when the components have stopped.
const DRAIN: Duration = Duration::from_millis(200);
/// Room that is held for a `result.json`: of any run, of each process, and of each channel with both its
/// gateways.
const RESULT_BYTES: u64 = 32 << 10;
const RESULT_PROCESS_BYTES: u64 = 4 << 10;
const RESULT_CHANNEL_BYTES: u64 = 32 << 10;

/// Runs `topology` here; `claims` are what it needs for itself, and are given up at its end.
///
/// # Errors
/// When the run did not come about. Once it has begun, every end is an [`Outcome`].
pub fn run(
    topology: &Topology,
    options: &RunOptions,
    claims: Claims,
    signals: &Signals,
    console: &mut Console,
) -> Result<RunResult, RunError> {
    let hosts: Vec<&Host> = topology
        .hosts()
        .iter()
        .filter(|host| options.hosts.contains(&host.name))
        .collect();
    own_program::find_all(topology, &options.hosts)?;
    let key = read_key(topology, &hosts)?;
    let plan = plan(topology, &hosts);
    check_emulation(topology).map_err(RunError::Emulation)?;
    let base = options.domain_root.as_ref();
    domains::check_path(base, &hosts[0].name)?;
    // What dead runs left is no reason to refuse this one.
    domains::sweep_below(&domain_base(base));
    needs::check(&plan, base)?;
    let facts = HostFacts::gather().built_from(options.revision);
    let discipline = HostDiscipline::gather().ok();
    let folder = match prepare_folder(topology, &hosts, options, &facts) {
        Ok(folder) => folder,
        Err(unprepared) => {
            if is_of_full_disk(&unprepared.source) && topology.has_hosts_beside(hosts.len()) {
                console.warn(&format!("{unprepared}; telling the other hosts"));
                let run = unprepared.folder.to_string_lossy();
                let domains = Domains::create(&plan.hosts, base, &run)?;
                let mut gathered =
                    gather(topology, key.as_ref(), &hosts, &domains, signals, console);
                let told = PeerMessage::Stop(unprepared.outcome(&hosts[0].name));
                for peer in gathered.iter_mut().flat_map(|one| &mut one.peers) {
                    peer.say(&told);
                }
            }
            return Err(unprepared.into());
        }
    };
    let unwritable = |source| RunError::Folder {
        folder: folder.root().to_owned(),
        source,
    };
    claims.tell(folder.root(), console);
    let run = folder.root().to_string_lossy();
    let discard = |_error: &RunError| {
        // It holds nothing of a run yet; the error that is told is the first one.
        let _left = fs::remove_dir_all(folder.root()).is_err();
    };
    let domains = Domains::create(&plan.hosts, base, &run).map_err(RunError::from);
    let domains = domains.inspect_err(discard)?;
    console.say(&format!("run folder {}", folder.root().display()));
    let gathered = gather(topology, key.as_ref(), &hosts, &domains, signals, console);
    let gathered = gathered.inspect_err(discard)?;
    let peers = gathered.peers;
    let here = clock_id().map_err(RunError::from).inspect_err(discard)?;
    let process_group =
        ProcessGroup::new(plan.processes, domains.addresses(), &folder, gathered.seal);
    let announcement = Announcement::make(
        topology,
        &folder,
        domains.addresses(),
        process_group.names(),
        clocks_known(topology, &hosts, &peers, here),
    );
    let announcement = announcement.map_err(unwritable).inspect_err(discard)?;
    // Before the gateways: they find out by sending what the cards deliver.
    let cards = NicWatch::start(topology, &hosts, &folder.records());
    let status_publisher = StatusPublisher::new(folder.root());
    let mut session = Session {
        topology,
        announcement,
        cards,
        neighbours: Neighbours::of(topology, &hosts),
        is_first_host: is_here(&topology.hosts()[0], &hosts),
        has_one_clock: peers.iter().all(|peer| peer.hello.clock_id == here),
        process_group,
        domains,
        peers,
        signals,
        console,
        discipline,
        security: gathered.security,
        cleaned: WallInstant::now(),
        greeted: WallInstant::now(),
        status_publisher,
        elsewhere: PeerStatus::new(topology, &hosts),
    };
    let begun = session.begin(topology.run().start_timeout);
    let start = session.process_group.started;
    let start = start.unwrap_or_else(MonotonicClock::now);
    let started = utc_text(SystemTime::now());
    let outcome = match begun {
        Err(outcome) => outcome,
        Ok(()) => session.watch(start, topology.run().duration),
    };
    let end = MonotonicClock::now();
    let outcome = session.stop(outcome);
    let result = session.conclude(folder, outcome, start, end, started, facts);
    drop(claims);
    Ok(result)
}

/// The longest delay of each trace that a link of `topology` replays, by channel: known since before
/// the run began.
fn trace_delays(topology: &Topology) -> BTreeMap<String, Duration> {
    let seed = topology.run().seed;
    let delays = topology.crossings().filter_map(|crossing| {
        let trace = EmulationLaunch::of(&crossing, seed)?.trace?;
        Some((crossing.channel.name.clone(), trace.delay_max().ok()?))
    });
    delays.collect()
}

pub(super) fn is_here(host: &Host, hosts: &[&Host]) -> bool {
    hosts.iter().any(|here| here.name == host.name)
}

/// Whether all hosts read one clock, where this host has met them all.
fn clocks_known(topology: &Topology, hosts: &[&Host], peers: &[Peer], here: u64) -> Option<bool> {
    let has_met_all = peers.len() + hosts.len() == topology.hosts().len();
    has_met_all.then(|| peers.iter().all(|peer| peer.hello.clock_id == here))
}

/// A run folder that cannot be made, or not be filled with what it begins with.
struct Unprepared {
    folder: PathBuf,
    source: io::Error,
}

impl Unprepared {
    fn outcome(&self, host: &str) -> Outcome {
        Outcome::Unwritable {
            host: host.to_owned(),
            fault: FileFault::new(&self.folder, &self.source),
        }
    }
}

impl fmt::Display for Unprepared {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}: {}", self.folder.display(), self.source)
    }
}

impl From<Unprepared> for RunError {
    fn from(unprepared: Unprepared) -> Self {
        let Unprepared { folder, source } = unprepared;
        Self::Folder { folder, source }
    }
}

/// Makes the run's folder with its manifest, and holds room for its result.
fn prepare_folder(
    topology: &Topology,
    hosts: &[&Host],
    options: &RunOptions,
    facts: &HostFacts,
) -> Result<RunFolder, Unprepared> {
    let parent = PathBuf::from(topology.run().record.as_ref());
    let suffix = (hosts.len() < topology.hosts().len()).then(|| hosts[0].name.as_str());
    let folder = match RunFolder::create(&parent, topology.name(), suffix) {
        Ok(folder) => folder,
        Err(source) => {
            let folder = parent;
            return Err(Unprepared { folder, source });
        }
    };
    let content = ManifestContent {
        topology,
        topology_file: &options.topology_file,
        hosts: &options.hosts,
        command_line: &options.command_line,
        layouts: &options.layouts,
        facts,
        realtime_minus_monotonic_ns: ClockPair::read(CLOCK_READS).ok().map(|pair| pair.offset_ns),
    };
    let written = manifest::write(&content, &folder)
        .and_then(|()| run_result::hold_room(&folder, result_bytes(topology)));
    match written {
        Ok(()) => Ok(folder),
        Err(source) => {
            let folder = folder.root().to_owned();
            // It holds nothing of a run yet; the error that is told is the first one.
            let _left = fs::remove_dir_all(&folder).is_err();
            Err(Unprepared { folder, source })
        }
    }
}

/// Room for a `result.json` in bytes: more than its processes and channels have been seen to take.
fn result_bytes(topology: &Topology) -> u64 {
    let processes = topology.processes().len() as u64;
    let channels = topology.channels().len() as u64;
    RESULT_BYTES + processes * RESULT_PROCESS_BYTES + channels * RESULT_CHANNEL_BYTES
}

struct Session<'a> {
    topology: &'a Topology,
    // Before the domains: its files lie beside theirs.
    announcement: Announcement,
    cards: NicWatch,
    neighbours: Neighbours,
    is_first_host: bool,
    /// All hosts of the run read one clock.
    has_one_clock: bool,
    // Before the domains: no process may be left when its shared memory goes.
    process_group: ProcessGroup,
    domains: Domains,
    peers: Vec<Peer>,
    signals: &'a Signals,
    console: &'a mut Console,
    /// Who steered the system clock before the run.
    discipline: Option<HostDiscipline>,
    /// How the hops are protected, in words.
    security: Option<RunSecurity>,
    cleaned: WallInstant,
    greeted: WallInstant,
    status_publisher: StatusPublisher,
    elsewhere: PeerStatus,
}

impl Session<'_> {
    /// Starts the processes and waits until those of all hosts are ready, then begins
    /// everywhere.
    ///
    /// # Errors
    /// Why the run ended before it began.
    fn begin(&mut self, timeout: Duration) -> Result<(), Outcome> {
        self.process_group.start()?;
        let deadline = WallInstant::now() + timeout;
        let mut ready_peers = 0;
        let mut has_told = false;
        loop {
            match self.look_after() {
                None => {}
                // Whoever ends before the run has begun has failed, however politely.
                Some(Outcome::EndedEarly(text)) => {
                    return Err(Outcome::Failed(Failure::fault(text)));
                }
                Some(outcome) => return Err(outcome),
            }
            self.tell(Phase::Starting);
            let is_ready = self.process_group.is_ready();
            if is_ready && !has_told && !self.is_first_host {
                self.say_to_all(&PeerMessage::Ready);
                has_told = true;
            }
            let mut may_begin = self.peers.is_empty();
            for event in self.hear_in_time() {
                match event {
                    Heard::Said(PeerMessage::Ready) => ready_peers += 1,
                    Heard::Said(PeerMessage::Start { has_one_clock }) => {
                        self.has_one_clock = has_one_clock;
                        may_begin = true;
                    }
                    other => {
                        if let Some(outcome) = other.outcome() {
                            return Err(outcome);
                        }
                    }
                }
            }
            if self.is_first_host && ready_peers == self.peers.len() {
                may_begin = true;
            }
            if is_ready && may_begin {
                let has_one_clock = self.has_one_clock;
                self.say_to_all(&PeerMessage::Start { has_one_clock });
                // Only observers read it; they do without.
                let _is_said = self.announcement.say_clock(has_one_clock).is_ok();
                self.process_group.begin();
                return Ok(());
            }
            if WallInstant::now() > deadline {
                let missing = self.process_group.missing();
                let text = if missing.is_empty() {
                    "the other host".to_owned()
                } else {
                    missing
                };
                let limit_s = timeout.as_secs();
                let text = format!("{text} was not ready within {limit_s} s");
                return Err(Outcome::Failed(Failure::fault(text)));
            }
            thread::sleep(WATCH_PERIOD);
        }
    }

    /// Watches until the time is up or something ends the run.
    fn watch(&mut self, start: Instant, duration: Duration) -> Outcome {
        loop {
            if let Some(outcome) = self.look_after() {
                return outcome;
            }
            if let Some(outcome) = self.hear_in_time().into_iter().find_map(Heard::outcome) {
                return outcome;
            }
            let elapsed = MonotonicClock::now().saturating_duration_since(start);
            // The others end when the first host says so; on their own only if it does not.
            let grace = if self.is_first_host {
                Duration::ZERO
            } else {
                END_GRACE
            };
            if elapsed >= duration + grace {
                return Outcome::Completed;
            }
            self.tell(Phase::Running);
            thread::sleep(WATCH_PERIOD);
        }
    }

    /// What must be done all the time, and the first reason to end.
    fn look_after(&mut self) -> Option<Outcome> {
        if self.cleaned.elapsed() >= CLEANUP_PERIOD {
            self.domains.free_what_the_dead_held();
            self.cleaned = WallInstant::now();
            for change in self.neighbours.changes() {
                self.note(MonotonicClock::now(), change);
            }
        }
        if self.greeted.elapsed() >= ALIVE_PERIOD {
            self.greet();
            self.greeted = WallInstant::now();
        }
        if let Some(signal) = self.signals.received() {
            self.console.say(&format!(
                "{signal}: ending the run and writing its report; a second one drops the report"
            ));
            return Some(Outcome::Interrupted(signal.to_owned()));
        }
        let known = self.process_group.events().len();
        let outcome = self.process_group.watch();
        for event in &self.process_group.events()[known..] {
            self.console
                .warn(&format!("{}: {}", event.process, event.kind));
        }
        outcome
    }

    /// Tells each peer that this host lives, and what is known of ticks.
    fn greet(&mut self) {
        let ticks = own_ticks(&self.own_hosts(), self.process_group.members());
        let told = self.elsewhere.told(ticks, MonotonicClock::now());
        for peer in &mut self.peers {
            let is_heard = peer.silence() <= 2 * ALIVE_PERIOD;
            let greeting = greeting(&told, &peer.hello.host, is_heard);
            peer.say(&greeting);
        }
    }

    /// Names of the hosts that run here.
    fn own_hosts(&self) -> Vec<String> {
        self.domains.addresses().into_keys().collect()
    }

    fn say_to_all(&mut self, message: &PeerMessage) {
        for peer in &mut self.peers {
            peer.say(message);
        }
    }

    fn hear(&mut self) -> Vec<Heard> {
        let mut heard = Vec::new();
        for peer in &mut self.peers {
            let host = peer.hello.host.clone();
            while !peer.is_quiet
                && let Some(event) = peer.receive(Duration::ZERO)
            {
                match event {
                    PeerEvent::Frame(Frame::Message(PeerMessage::Quiet)) => peer.is_quiet = true,
                    PeerEvent::Frame(Frame::Message(PeerMessage::Ticks(said))) => {
                        self.elsewhere.hear(&host, said, MonotonicClock::now());
                    }
                    PeerEvent::Frame(Frame::Message(message)) => {
                        heard.push(Heard::Said(message).named(&host));
                    }
                    PeerEvent::Frame(Frame::Chunk(_)) => {}
                    PeerEvent::Closed(reason) => {
                        heard.push(Heard::Lost(format!("{host}: {reason}")));
                        break;
                    }
                }
            }
        }
        self.note_cuts();
        heard
    }

    /// The same, with a host that has been silent for too long as one that is lost. Not once the run ends: a host says
    /// nothing while it waits for its processes.
    fn hear_in_time(&mut self) -> Vec<Heard> {
        let mut heard = self.hear();
        let silence_max = self.topology.run().peer_timeout;
        for peer in &mut self.peers {
            if !peer.is_quiet && peer.silence() > silence_max {
                let (host, silence_s) = (&peer.hello.host, silence_max.as_secs());
                let text = format!("{host} has been silent for {silence_s} s");
                heard.push(Heard::Lost(text));
                // Nothing is waited for any more; it hears so if it can.
                peer.hang_up();
            }
        }
        heard
    }

    /// Notes when connections to other hosts were cut and came back.
    fn note_cuts(&mut self) {
        let cuts = self.peers.iter_mut().flat_map(|peer| {
            let host = peer.hello.host.clone();
            let cuts = peer.take_cuts().into_iter();
            cuts.map(move |cut| {
                let kind = EventKind::Reconnected {
                    peer: host.clone(),
                    away_ms: u64::try_from(cut.length.as_millis()).unwrap_or(u64::MAX),
                    cause: cut.cause,
                };
                (cut.since, kind)
            })
        });
        for (since, kind) in cuts.collect::<Vec<_>>() {
            self.note(since, kind);
        }
    }

    /// Notes and says what happened to this host.
    fn note(&mut self, at: Instant, kind: EventKind) {
        let own = self.own_hosts().into_iter().next().unwrap_or_default();
        self.console.warn(&format!("{own}: {kind}"));
        self.process_group.note_of_host(at, &own, kind);
    }

    fn tell(&mut self, phase: Phase) {
        let (topology, process_group, elsewhere) =
            (self.topology, &mut self.process_group, &self.elsewhere);
        self.status_publisher
            .tell(phase, topology, process_group, elsewhere, self.console);
    }

    /// Ends components everywhere first, then gateways, so that what is under way arrives, and last
    /// the clock paths, so that an exchange follows the last message. Gives how the run ended, which is
    /// what the topology's first of the hosts that could not write says, if several say so at once.
    fn stop(&mut self, outcome: Outcome) -> Outcome {
        self.tell(Phase::Ending);
        self.say_to_all(&PeerMessage::Stop(outcome.clone()));
        self.process_group
            .stop(STOP_PATIENCE, ProcessPlan::is_component);
        self.say_to_all(&PeerMessage::Quiet);
        let mut told = Vec::new();
        if !matches!(outcome, Outcome::PeerLost(_)) {
            told = self.wait_for_quiet();
        }
        thread::sleep(DRAIN);
        self.process_group
            .stop(STOP_PATIENCE, ProcessPlan::is_carrier);
        self.process_group
            .stop(STOP_PATIENCE, ProcessPlan::is_clock_path);
        self.process_group.cut_logs();
        self.first_unwritable(outcome, told)
    }

    /// `own` outcome, unless a host before this one could not write either.
    fn first_unwritable(&self, own: Outcome, told: Vec<Outcome>) -> Outcome {
        let hosts = self.topology.hosts();
        let place = |outcome: &Outcome| match outcome {
            Outcome::Unwritable { host, .. } => hosts.iter().position(|one| one.name == *host),
            _ => None,
        };
        if place(&own).is_none() {
            return own;
        }
        let all = [own].into_iter().chain(told);
        let first = all.filter(|one| place(one).is_some()).min_by_key(place);
        first.expect("the own one is among them")
    }

    /// Gives what the other hosts said of the run's end meanwhile.
    fn wait_for_quiet(&mut self) -> Vec<Outcome> {
        let deadline = WallInstant::now() + STOP_PATIENCE + DRAIN;
        let mut told = Vec::new();
        while self.peers.iter().any(|peer| !peer.is_quiet) && WallInstant::now() < deadline {
            let heard = self.hear();
            let is_lost = heard.iter().any(|heard| matches!(heard, Heard::Lost(_)));
            told.extend(heard.into_iter().filter_map(Heard::outcome));
            if is_lost {
                break;
            }
            thread::sleep(WATCH_PERIOD);
        }
        told
    }

    /// Exchanges records with the other hosts and takes everything down.
    fn conclude(
        mut self,
        folder: RunFolder,
        outcome: Outcome,
        start: Instant,
        end: Instant,
        started: String,
        facts: HostFacts,
    ) -> RunResult {
        let own_hosts = self.own_hosts();
        let watch = core::mem::take(&mut self.cards);
        let (cards, mut problems) = watch.finish();
        let own = HostHistory {
            hosts: own_hosts.clone(),
            span: (start, end),
            events: self.process_group.events().to_vec(),
            discipline: self.discipline(),
            processes: self.stories(),
            cards,
        };
        let mut stories = vec![own.clone()];
        let mut gaps = Vec::new();
        if let Outcome::PeerLost(who) = &outcome {
            problems.push(format!("no records of the host that vanished ({who})"));
        } else if !self.peers.is_empty() {
            self.console
                .progress("exchanging records with the other host");
            let records = folder.records();
            let first = self.is_first_host;
            let received = exchange(&mut self.peers, first, &records, &own);
            problems.extend(received.problems);
            gaps = received.gaps;
            stories.extend(received.stories);
            self.note_cuts();
            // The other hosts have this one's up to the exchange.
            stories[0].events = self.process_group.events().to_vec();
        }
        // The same on every host.
        let place = |story: &HostHistory| {
            let hosts = self.topology.hosts().iter();
            let mut names = hosts.map(|host| &host.name);
            names.position(|name| story.hosts.contains(name))
        };
        stories.sort_by_key(place);
        let spans = stories.iter().flat_map(|story| {
            let span = story.span;
            story.hosts.iter().map(move |host| (host.clone(), span))
        });
        let spans: BTreeMap<String, (Instant, Instant)> = spans.collect();
        let disciplines = disciplines(&stories);
        let mut events: Vec<Event> = stories.iter().flat_map(|one| one.events.clone()).collect();
        // Each host counts from its own start of the run.
        let since_start =
            |event: &Event| spans.get(&event.host).map(|span| event.at.ns_since(span.0));
        events.sort_by_key(since_start);
        let cards = stories.iter().flat_map(|one| one.cards.clone()).collect();
        let processes = stories.into_iter().flat_map(|one| one.processes).collect();
        let mut result = RunResult {
            folder,
            outcome,
            spans,
            started,
            events,
            processes,
            cards,
            has_one_clock: self.has_one_clock,
            security: self.security,
            disciplines,
            own_hosts,
            gaps,
            problems,
            facts,
            trace_delays: trace_delays(self.topology),
        };
        // Before anything is removed: whatever becomes of that, the run has its account. Who cannot write it
        // here is told when it is written with what is left.
        let _is_written = result.write().is_ok();
        drop(self.process_group);
        drop(self.status_publisher);
        self.announcement.withdraw();
        self.domains.let_observers_leave();
        let left = self.domains.remove().into_iter();
        let left = left.map(|what| format!("left in shared memory: {what}"));
        result.problems.extend(left);
        result
    }

    /// Who steered this host's system clock, before and after.
    fn discipline(&self) -> Option<HostDiscipline> {
        let before = self.discipline.clone()?;
        Some(before.worse(HostDiscipline::gather().ok()?))
    }

    fn stories(&self) -> Vec<ProcessHistory> {
        let members = self.process_group.members().iter();
        members
            .map(|member| ProcessHistory {
                name: member.plan.name.clone(),
                host: member.plan.host.clone(),
                kind: member.plan.kind(),
                role: member.plan.role(),
                end: member
                    .end
                    .clone()
                    .unwrap_or_else(|| "never started".to_owned()),
                restart_count: member.restart_count,
                report: member.report.clone(),
            })
            .collect()
    }
}
