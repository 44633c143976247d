//! `hil-runtime simulate`: a topology's case in virtual time, with the link models of its emulated
//! links. It starts no process and opens no socket.

mod events;
mod link_figures;
mod network;
mod watched;

use core::fmt::Write;
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hil_models::account::OutageFigures;
use hil_models::case_study::Score;
use hil_models::link_model::LinkModel;
use hil_models::link_model::{ReplayCounts, ReplayTally};
use hil_models::plot::PlotSeries;
use hil_models::simulation::{Carrier, Simulation, SimulationError, SimulationResult};
use hil_models::time::Instant;

use crate::analysis::outages::OutageStory;
use crate::process::launch::EmulationLaunch;
use crate::registry::{Case, Registry};
use crate::report::event_log;
use crate::report::network::NetworkReport;
use crate::report::replay::replay_words;
use crate::report::score_event::ScoreEvents;
use crate::report::summary::ScoreMetric;
use crate::report::terminal::{self, Style};
use crate::run_folder::RunFolder;
use crate::series;
use crate::topology::{Crossing, Program, Topology};

use self::link_figures::LinkFigures;
use self::watched::Watch;

/// What the outcome is rendered as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    /// One JSON object.
    Json,
    /// A page of so many columns.
    Page(usize),
}

/// Why there is no outcome, or not all of its files.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SimulateError {
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

/// A run in virtual time that is over.
#[derive(Debug)]
pub(crate) struct Simulated {
    topology_name: String,
    duration_s: f64,
    seed: u64,
    case: Box<dyn Case>,
    result: SimulationResult,
    score: Score,
    /// Of every channel that replays a trace, what it met.
    replays: BTreeMap<String, ReplayTally>,
    /// Of every channel that a link model carried.
    outages: Vec<OutageStory>,
    /// What each model was asked for and did, by channel.
    links: Vec<(String, LinkFigures)>,
    events: ScoreEvents,
    /// `None` when no link model carried anything.
    network: Option<NetworkReport>,
    network_series: Vec<PlotSeries>,
}

/// Runs the topology's case in virtual time; tells `watch` now and then which share of it is over.
///
/// # Errors
/// When the topology has no case, or a link that only a real run shows.
pub(crate) fn simulate(
    topology: &Topology,
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
    let mut watches = Vec::new();
    let mut carriers: BTreeMap<String, Box<dyn Carrier>> = BTreeMap::new();
    let mut replays = BTreeMap::new();
    for (name, emulation) in emulations(topology).map_err(refused)? {
        // Virtual time begins with the run.
        let link = emulation
            .model(&name)
            .map_err(|error| refused(error.to_string()))?;
        replays.extend(link.replay_tally().map(|tally| (name.clone(), tally)));
        let (carrier, watch) = Watch::over(link);
        watches.push((name.clone(), emulation, watch));
        carriers.insert(name, carrier);
    }
    let roles = entry
        .roles
        .iter()
        .map(|role| case.role(role).map(|made| (*role, made)))
        .collect::<Option<Vec<_>>>()
        .ok_or_else(|| refused("the case lists a role it cannot make".to_owned()))?;
    let result = Simulation::of_roles(entry.name, entry.channels, roles, carriers)
        .and_then(|simulation| run_watched(simulation, topology.run().duration, watch))
        .map_err(|error| refused(error.to_string()))?;
    let score = case.score(&result.log);
    let duration = topology.run().duration;
    let links = watches.iter().map(|(name, emulation, watch)| {
        let (words, loss_ratio) = (emulation.describe(), emulation.loss_ratio());
        (name.clone(), watch.figures(&words, loss_ratio))
    });
    let links = links.collect();
    let outages: Vec<_> = watches
        .iter()
        .map(|(name, _, watch)| events::story(name.clone(), watch.outages(), duration))
        .collect();
    let mut events = events::explained(&score, entry.channels, &outages, &result.log);
    let errors = case.errors(&result.log);
    let watches = watches.into_iter().map(|(name, _, watch)| (name, watch));
    let (network, network_series) = network::of_simulation(
        topology,
        watches.collect(),
        &result.log,
        (errors, &mut events),
    )
    .unzip();
    Ok(Simulated {
        topology_name: topology.name().to_owned(),
        duration_s: duration.as_secs_f64(),
        seed: topology.run().seed,
        events,
        network,
        network_series: network_series.unwrap_or_default(),
        case,
        result,
        score,
        replays,
        outages,
        links,
    })
}

/// Runs for `duration`; tells `watch` which share of it is over.
fn run_watched(
    simulation: Simulation,
    duration: Duration,
    watch: &mut dyn FnMut(f64),
) -> Result<SimulationResult, SimulationError> {
    simulation.run_watched(duration, &mut |now| {
        let passed = now.saturating_duration_since(Instant::ZERO);
        watch(passed.as_secs_f64() / duration.as_secs_f64());
    })
}

fn refuse_faces(topology: &Topology) -> Result<(), String> {
    let mut processes = topology.processes().iter();
    let face = processes.find(|one| matches!(one.program, Program::Egm { .. }));
    face.map_or(Ok(()), |face| {
        let name = &face.name;
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
pub(crate) fn check_output(folder: &Path) -> Result<(), SimulateError> {
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
    /// Counts, outages and score.
    pub(crate) fn render(&self, form: Form) -> String {
        match form {
            Form::Json => self.json(),
            Form::Page(columns) => self.page(columns, Style::Coloured),
        }
    }

    /// Writes report, events and the case's series to `folder`; gives the names of the series.
    ///
    /// # Errors
    /// Names the file that cannot be written.
    pub(crate) fn write(&self, folder: &Path) -> Result<Vec<String>, SimulateError> {
        let failed = |path: PathBuf, error: io::Error| {
            SimulateError::Output(format!("{}: {error}", path.display()))
        };
        fs::create_dir_all(folder).map_err(|error| failed(folder.to_owned(), error))?;
        let files = RunFolder::existing(folder);
        let page = self.page(REPORT_FILE_WIDTH, Style::Plain);
        let events = event_log::text(&self.topology_name, &self.events, &[]);
        for (path, text) in [
            (files.report(), page),
            (files.virtual_report(), self.json()),
            (files.events(), events),
        ] {
            fs::write(&path, text).map_err(|error| failed(path, error))?;
        }
        let mut made = self.case.series(&self.result.log);
        made.extend(self.network_series.iter().cloned());
        series::write(&files.series(), made)
            .map_err(|error| SimulateError::Output(error.to_string()))
    }

    fn page(&self, columns: usize, style: Style) -> String {
        let mut text = format!(
            "{} in virtual time: {} s, seed {}\n\n",
            self.topology_name, self.duration_s, self.seed
        );
        for (name, counts) in &self.result.channels {
            let lost = counts
                .published_count
                .saturating_sub(counts.taken_count + counts.in_flight_count);
            let _infallible = writeln!(
                text,
                "  {name:<18} published {:>8}   taken {:>8}   lost {lost:>7}   in flight {:>4}",
                counts.published_count, counts.taken_count, counts.in_flight_count
            );
        }
        for (name, count) in &self.result.recorded_counts {
            let _infallible = writeln!(text, "  {name:<18} recorded  {count:>8}");
        }
        if !self.links.is_empty() {
            text.push_str("\nLink models, asked and done:\n");
        }
        for (name, figures) in &self.links {
            text.push_str(&figures.page(name));
        }
        for (name, tally) in &self.replays {
            let words = replay_words(&tally.counts());
            let _infallible = writeln!(text, "  {name:<18} {words}");
        }
        for (name, figures) in self.outage_figures() {
            text.push_str(&terminal::render_outages(name, &figures, columns, style));
        }
        text.push_str(&terminal::render_score(
            &ScoreMetric::all_of(&self.score),
            &self.events,
            columns,
            style,
        ));
        if let Some(report) = &self.network {
            text.push_str(&terminal::render_network(
                report,
                &self.events,
                columns,
                style,
            ));
        }
        text
    }

    fn json(&self) -> String {
        let channels = self.result.channels.iter().map(|(name, counts)| {
            let counts = serde_json::json!({
                "published_count": counts.published_count,
                "taken_count": counts.taken_count,
                "in_flight_count": counts.in_flight_count,
            });
            ((*name).to_owned(), counts)
        });
        let outages: BTreeMap<&str, OutageFigures> = self.outage_figures().collect();
        let replays = self.replays.iter();
        let replays: BTreeMap<&str, ReplayCounts> = replays
            .map(|(name, tally)| (name.as_str(), tally.counts()))
            .collect();
        let document = serde_json::json!({
            "name": self.topology_name,
            "seed": self.seed,
            "duration_s": self.duration_s,
            "channels": channels.collect::<serde_json::Map<_, _>>(),
            "recorded_counts": self.result.recorded_counts,
            "links": self.links.iter().cloned().collect::<BTreeMap<_, _>>(),
            "outages": outages,
            "trace_replays": replays,
            "score": self.score,
            "score_events": self.events,
            "network": self.network,
        });
        format!("{document:#}\n")
    }

    fn outage_figures(&self) -> impl Iterator<Item = (&str, OutageFigures)> {
        let stories = self.outages.iter();
        stories.filter_map(|story| Some((story.channel.as_str(), story.figures()?)))
    }
}

/// Width of `report.txt`.
const REPORT_FILE_WIDTH: usize = 100;
