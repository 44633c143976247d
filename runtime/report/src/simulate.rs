//! `hil-runtime simulate`: a topology's case in virtual time, with the link models of its emulated
//! links. It starts no process and opens no socket.

mod events;
mod links;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{fs, io};

use hil_account::network::{Moment, NetworkContext};
use hil_account::{
    ChannelAccount, ChannelPath, Closing, DemandFold, DemandMetrics, EndToEnd, FateCounts, Gaps,
    MessageFate, RunSpan, StampCoverage,
};
use hil_core::case_study::ErrorSeries;
use hil_core::link_model::{LinkModel, ReplayTally};
use hil_core::plot::PlotSeries;
use hil_core::run_log::RunLog;
use hil_core::simulation::{Carrier, ChannelCounts, Simulation, SimulationResult};
use hil_core::time::{Instant, duration_ns};
use hil_stats::histogram::Distribution;

use crate::analysis::network::{AxisClocks, ChannelPassages, NetworkBuilder, RobotSeries};
use crate::analysis::outages::OutageHistory;

use crate::event_log;
use crate::network::NetworkReport;
use crate::score_event::ScoreEvents;
use crate::summary::{
    ChannelEnd, ChannelSummary, CountByName, DirectionSummary, Fact, LinkKind, Outcome,
    RecordedMetrics, RunFacts, RunSummary, emulated_links,
};
use crate::terminal;
use hil_platform::text::shell_words;
use hil_present::units::percent;
use hil_rundir::launch::Side;
use hil_rundir::pipe::CounterGroup;
use hil_rundir::run_folder::RunFolder;
use hil_rundir::series;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::registry::{Case, Registry};
use hil_topology::{Channel, Crossing, Program, Topology};

use self::links::{DatagramLink, LinkAccount, LinkAccounts, Progress};

/// Why there is no outcome, or not all of its files.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// The topology cannot be simulated.
    #[error("{0}")]
    Topology(String),
    /// A file could not be written.
    #[error("{0}")]
    Output(String),
    /// What is in the folder would be overwritten, or left beside what it does not belong to.
    #[error("{}: the folder is not empty; name another one, or empty it", .0.display())]
    Occupied(PathBuf),
}

/// In place of the folder of a run that left none.
pub(crate) const NO_FOLDER: &str = "none; --output DIR writes one";

/// A run in virtual time that is over.
#[derive(Debug)]
pub struct Simulated {
    /// As of any run.
    pub summary: RunSummary,
    case: Box<dyn Case>,
    log: RunLog,
    network_series: Vec<PlotSeries>,
}

/// Runs the case of the topology in `file` in virtual time; tells `watch` now and then which share of
/// it is over.
///
/// # Errors
/// When the topology has no case, or a link that only a real run shows.
pub fn simulate(
    topology: &Topology,
    file: &Path,
    registry: &Registry,
    watch: &mut dyn FnMut(f64),
) -> Result<Simulated, SimulateError> {
    let refused = |text: String| SimulateError::Topology(text);
    let made = registry
        .make_case(topology)
        .map_err(|error| refused(error.to_string()))?;
    let no_case = "the topology names no case; only a case can be simulated";
    let (entry, case) = made.ok_or_else(|| refused(no_case.to_owned()))?;
    refuse_faces(topology).map_err(refused)?;
    let mut links = BTreeMap::new();
    let mut carriers: BTreeMap<String, Box<dyn Carrier>> = BTreeMap::new();
    for (name, emulation) in emulations(topology).map_err(refused)? {
        // Virtual time begins with the run.
        let link = emulation
            .model(&name)
            .map_err(|error| refused(error.to_string()))?;
        let replay = link.replay_tally();
        carriers.insert(name.clone(), Box::new(DatagramLink(link)));
        links.insert(name, EmulatedLink { emulation, replay });
    }
    let roles = entry
        .roles
        .iter()
        .map(|role| case.role(role).map(|made| (*role, made)))
        .collect::<Option<Vec<_>>>()
        .ok_or_else(|| refused("the case lists a role it cannot make".to_owned()))?;
    let duration = topology.run().duration;
    let names = links.keys().cloned();
    let run = Some(RunSpan {
        start: Instant::ZERO,
        end: Instant::ZERO + duration,
    });
    let account = |name: String| {
        let demand = topology.channel(&name).and_then(|one| one.demand.as_ref());
        let mut account = LinkAccount::default();
        account.demand = demand.map(|demand| DemandFold::new(demand, run));
        (name, account)
    };
    let mut accounts = LinkAccounts(names.map(account).collect());
    let mut progress = Progress {
        duration,
        next: Instant::ZERO,
        watch,
    };
    let result = Simulation::of_roles(entry.name, entry.channels, roles, carriers)
        .and_then(|simulation| {
            simulation.run_observed(duration, &mut (&mut accounts, &mut progress))
        })
        .map_err(|error| refused(error.to_string()))?;
    let score = case.score(&result.log);
    let mut summary = RunSummary::new(run_facts(topology, file));
    let mut accounts = accounts.0;
    let outages: Vec<_> = accounts
        .iter_mut()
        .map(|(name, account)| {
            let outages = core::mem::take(&mut account.outages).finish();
            events::history(name.clone(), outages, duration)
        })
        .collect();
    let channels = topology.channels().iter();
    summary.channels = channels
        .map(|channel| {
            let story = outages.iter().find(|story| story.channel == channel.name);
            let mut found = channel_summary(topology, channel, &result, links.get(&channel.name));
            found.outages = story.and_then(OutageHistory::metrics);
            found.demand = demand_metrics(channel, &mut accounts);
            if let Some(account) = &mut found.account {
                let link = accounts.get(&channel.name);
                account.duplicated_count = link.map(|link| link.duplicated_count);
            }
            found
        })
        .collect();
    let directions = links.iter().map(|(name, link)| link.direction(name));
    summary.directions = directions.collect();
    summary.put_score(&score);
    summary.score_events = events::explained(&score, entry.channels, &outages, &result.log);
    let (network, network_series) = network(
        topology,
        accounts,
        case.errors(&result.log),
        &mut summary.score_events,
    )
    .unzip();
    summary.network = network;
    Ok(Simulated {
        summary,
        case,
        log: result.log,
        network_series: network_series.unwrap_or_default(),
    })
}

/// The report and the series of every channel that a link model carried; `None` when none did.
fn network(
    topology: &Topology,
    accounts: BTreeMap<String, LinkAccount>,
    errors: Vec<ErrorSeries>,
    events: &mut ScoreEvents,
) -> Option<(NetworkReport, Vec<PlotSeries>)> {
    let length_ns = duration_ns(topology.run().duration);
    let mut builder = NetworkBuilder::default();
    for (name, account) in accounts {
        let crossing = topology.crossings().find(|one| one.channel.name == name)?;
        builder.add(ChannelPassages {
            channel: &name,
            hosts: [&crossing.from_host.name, &crossing.to_host.name],
            passages: &account.passages,
            other_events: Vec::new(),
            duration_ns: length_ns,
            // Virtual time begins with the run, for all hosts alike.
            place: &|at: Moment| Some(at.ns),
            context: NetworkContext {
                path: ChannelPath::SharedMemory,
                run_ns: Some((0, length_ns)),
                payload_bytes: Some(crossing.channel.message.size_bytes as f64),
            },
        });
    }
    let errors = errors.into_iter();
    let errors = errors.map(|one| RobotSeries::of(one, |at| Some(at.seconds_since(Instant::ZERO))));
    builder.finish(events, errors.collect(), AxisClocks::ONE)
}

fn run_facts(topology: &Topology, file: &Path) -> RunFacts {
    let case = topology.case().map(|case| case.name.clone());
    let command_line: Vec<String> = std::env::args().collect();
    RunFacts {
        name: topology.name().to_owned(),
        case: case.unwrap_or_default(),
        topology_file: file.display().to_string(),
        topology_hash: format!("{:016x}", topology.hash()),
        links: emulated_links(topology),
        seed: topology.run().seed,
        security: None,
        is_virtual: true,
        host: "none".to_owned(),
        started: "virtual time".to_owned(),
        starts_ns: BTreeMap::new(),
        duration_s: topology.run().duration.as_secs_f64(),
        outcome: Outcome::Completed,
        exit_reason: "ran its full length in virtual time".to_owned(),
        folder: NO_FOLDER.to_owned(),
        files: Vec::new(),
        repeat_command: shell_words(&command_line),
    }
}

fn refuse_faces(topology: &Topology) -> Result<(), String> {
    let mut processes = topology.processes().iter();
    let adapter = processes.find(|one| matches!(one.program, Program::Egm { .. }));
    adapter.map_or(Ok(()), |adapter| {
        let name = &adapter.name;
        Err(format!(
            "process `{name}` speaks with a foreign program, which knows no virtual time"
        ))
    })
}

/// What the links do to the channels that cross one, by the channel's name.
fn emulations(topology: &Topology) -> Result<Vec<(String, EmulationLaunch)>, String> {
    let seed = topology.run().seed;
    let emulation = |crossing: Crossing<'_>| {
        let name = &crossing.channel.name;
        let emulation = EmulationLaunch::of(&crossing, seed).ok_or_else(|| {
            format!(
                "channel {name} crosses link {} via {}, whose delay only a real run shows; use \
                 via = \"emulated\" to simulate it",
                crossing.link.name,
                crossing.link.via.word()
            )
        })?;
        Ok((name.clone(), emulation))
    };
    topology.crossings().map(emulation).collect()
}

/// Makes sure that nothing is in the way of the files in `folder`, before anything is computed.
///
/// # Errors
/// When the folder has anything in it, or cannot be read.
pub fn check_output(folder: &Path) -> Result<(), SimulateError> {
    let is_occupied = match fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_some(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        Err(error) => {
            let text = format!("{}: {error}", folder.display());
            return Err(SimulateError::Output(text));
        }
    };
    if is_occupied {
        return Err(SimulateError::Occupied(folder.to_owned()));
    }
    Ok(())
}

impl Simulated {
    /// Writes the run's folder: series, summary, events and report.
    ///
    /// # Errors
    /// Names the file that cannot be written.
    pub fn write(&mut self, folder: &Path) -> Result<(), SimulateError> {
        let failed = |path: PathBuf, error: io::Error| {
            SimulateError::Output(format!("{}: {error}", path.display()))
        };
        fs::create_dir_all(folder).map_err(|error| failed(folder.to_owned(), error))?;
        let files = RunFolder::existing(folder);
        let mut made = self.case.series(&self.log);
        made.append(&mut self.network_series);
        let names = series::write(&files.series(), made)
            .map_err(|error| SimulateError::Output(error.to_string()))?;
        let run = &mut self.summary.run;
        run.folder = folder.display().to_string();
        run.files = vec![
            Fact::new("summary.json", "every figure of this report"),
            Fact::new("events.log", "what happened to the robot, one line each"),
        ];
        if !names.is_empty() {
            let what = format!("{}; columns in series/series.json", names.join(", "));
            run.files.push(Fact::new("series/", what));
        }
        let summary = &self.summary;
        let written = summary.write(&files.summary());
        written.map_err(|error| SimulateError::Output(error.to_string()))?;
        let events = event_log::of(summary);
        let events = [(files.events(), events)];
        for (path, text) in terminal::text_files(&files, summary)
            .into_iter()
            .chain(events)
        {
            fs::write(&path, text).map_err(|error| failed(path, error))?;
        }
        Ok(())
    }
}

/// Whether the demand of `channel` was met, if the topology states one.
fn demand_metrics(
    channel: &Channel,
    accounts: &mut BTreeMap<String, LinkAccount>,
) -> Option<DemandMetrics> {
    let demand = channel.demand.as_ref()?;
    let account = accounts.get_mut(&channel.name);
    let fold = account.and_then(|account| account.demand.take());
    Some(fold.map_or_else(|| DemandMetrics::on_one_host(demand), DemandFold::finish))
}

/// The account of one channel, with what virtual time lacks "unavailable".
fn channel_summary(
    topology: &Topology,
    channel: &Channel,
    result: &SimulationResult,
    link: Option<&EmulatedLink>,
) -> ChannelSummary {
    let recorded = result.recorded_counts.get(channel.name.as_str());
    let counts = result.channels.get(channel.name.as_str());
    ChannelSummary {
        name: channel.name.clone(),
        from: channel.from.clone(),
        to: channel.to.clone(),
        link: LinkKind::of(topology, channel),
        account: counts.map(account),
        outages: None,
        demand: None,
        emulation: None,
        trace_replay: link.and_then(|link| Some(link.replay.as_ref()?.counts())),
        recorded: recorded.map(|count| RecordedMetrics {
            message_count: *count,
            missing_count: 0,
        }),
        ends: link.and(counts).map(link_end).into_iter().collect(),
    }
}

fn account(counts: &ChannelCounts) -> ChannelAccount {
    const REASON: &str = "virtual time notes what a link did, and no stage of a message";
    let unavailable = || Distribution::unavailable(REASON);
    let ChannelCounts {
        published_count,
        lost_count,
        ..
    } = *counts;
    let in_flight_count = counts.in_flight_count.min(published_count - lost_count);
    let mut fates = FateCounts::default();
    for (fate, count) in [
        (
            MessageFate::Taken,
            published_count - lost_count - in_flight_count,
        ),
        (MessageFate::LostOnWire, lost_count),
        (MessageFate::InFlight, in_flight_count),
    ] {
        if count > 0 {
            fates.add(fate, count);
        }
    }
    ChannelAccount {
        published_count,
        published_unrecorded_count: Some(0),
        producer_restart_count: 0,
        fates,
        reordered_count: None,
        duplicated_count: None,
        late_count: None,
        segments: Vec::new(),
        end_to_end: EndToEnd {
            distribution: unavailable(),
            bins: Vec::new(),
            p50_interval: None,
            p99_interval: None,
            bound: None,
        },
        closing: Closing::Unavailable {
            reason: REASON.to_owned(),
        },
        coverage: StampCoverage::default(),
        round_trip: unavailable(),
        loss_bursts: Vec::new(),
        gaps: Gaps {
            between_taken: unavailable(),
            longest: None,
            longest_unattributed: None,
            last_taken_to_run_end_ns: None,
            producer: None,
        },
        interruptions: Vec::new(),
    }
}

/// The counts of a link model, where a real run has those of its gateways.
fn link_end(counts: &ChannelCounts) -> ChannelEnd {
    let causes = counts.losses.into_iter().flat_map(|causes| {
        [
            ("link_outage_lost_count", causes.outage_count),
            ("link_chance_lost_count", causes.chance_count),
            ("link_queue_lost_count", causes.queue_count),
        ]
    });
    let all = [("link_lost_count", counts.lost_count)];
    let counters = all.into_iter().chain(causes);
    ChannelEnd {
        process: VIRTUAL_GATEWAY.to_owned(),
        direction: VIRTUAL_SIDE,
        counters: CountByName::all(CounterGroup::Own, counters).collect(),
    }
}

/// A link model of the topology.
struct EmulatedLink {
    emulation: EmulationLaunch,
    replay: Option<ReplayTally>,
}

impl EmulatedLink {
    /// The model of `channel`.
    fn direction(&self, channel: &str) -> DirectionSummary {
        let mut facts = vec![Fact::new("model", self.emulation.describe())];
        let ratio = self.emulation.loss_ratio();
        facts.extend(ratio.map(|ratio| Fact::new("loss asked for", percent(ratio))));
        DirectionSummary {
            flow: channel.to_owned(),
            process: VIRTUAL_GATEWAY.to_owned(),
            direction: VIRTUAL_SIDE,
            channels: vec![channel.to_owned()],
            peer_state: "none, in virtual time".to_owned(),
            counters: Vec::new(),
            facts,
            stalls: None,
        }
    }
}

/// What stands for the gateway of a channel.
const VIRTUAL_GATEWAY: &str = "simulate";
/// Where a real run has its link model: behind the receiving socket.
const VIRTUAL_SIDE: Side = Side::Ingress;
