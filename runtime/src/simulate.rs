//! `hil-runtime simulate`: a topology's case in virtual time, with the link models of its emulated
//! links. It starts no process and opens no socket.

use core::fmt::Write;
use std::collections::BTreeMap;

use hil_models::case_study::Score;
use hil_models::link::bernoulli::BernoulliLink;
use hil_models::random::RandomStream;
use hil_models::simulation::{Carrier, Simulation, SimulationResult};

use crate::registry::Registry;
use crate::report::score_event::ScoreEvents;
use crate::report::summary::ScoreMetric;
use crate::report::terminal::{self, Style};
use crate::topology::{Program, Topology};

/// What the outcome is rendered as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    /// One JSON object.
    Json,
    /// A page of so many columns.
    Page(usize),
}

/// Runs the topology's case in virtual time and renders counts and score.
///
/// # Errors
/// When the topology has no case, or a link that only a real run shows.
pub(crate) fn simulate(
    topology: &Topology,
    registry: &Registry,
    form: Form,
) -> Result<String, String> {
    let case = topology
        .case()
        .ok_or("the topology names no case; only a case can be simulated")?;
    let mut processes = topology.processes().iter();
    if let Some(face) = processes.find(|one| matches!(one.program, Program::Egm { .. })) {
        let name = &face.name;
        return Err(format!(
            "process `{name}` speaks with a foreign program, which knows no virtual time"
        ));
    }
    let entry = registry.find(&case.name).ok_or("the case is unknown")?;
    let seed = topology.run().seed;
    let parameters = serde_json::to_value(&case.parameters).map_err(|error| error.to_string())?;
    let made = entry
        .make(parameters, seed)
        .map_err(|error| error.to_string())?;
    let mut carriers: BTreeMap<String, Box<dyn Carrier>> = BTreeMap::new();
    for crossing in topology.crossings() {
        let name = &crossing.channel.name;
        let impairment = crossing.impairment.ok_or_else(|| {
            format!(
                "channel {name} crosses link {} via udp, whose delay only a real run shows; \
                 use via = \"emulated\" to simulate it",
                crossing.link.name
            )
        })?;
        let stream = RandomStream::new(seed, name);
        let link = BernoulliLink::new(impairment.delay, impairment.loss_ratio, stream)
            .map_err(|error| error.to_string())?;
        carriers.insert(name.clone(), Box::new(link));
    }
    let roles = entry
        .roles
        .iter()
        .map(|role| made.role(role).map(|made| (*role, made)))
        .collect::<Option<Vec<_>>>()
        .ok_or("the case lists a role it cannot make")?;
    let result = Simulation::of_roles(entry.name, entry.channels, roles, carriers)
        .and_then(|simulation| simulation.run(topology.run().duration))
        .map_err(|error| error.to_string())?;
    let score = made.score(&result.log);
    Ok(match form {
        Form::Json => render_json(topology, &result, &score),
        Form::Page(columns) => render_page(topology, &result, &score, columns),
    })
}

/// Counts and score of a run in virtual time.
fn render_page(
    topology: &Topology,
    result: &SimulationResult,
    score: &Score,
    columns: usize,
) -> String {
    let mut text = format!(
        "{} in virtual time: {} s, seed {}\n\n",
        topology.name(),
        topology.run().duration.as_secs_f64(),
        topology.run().seed
    );
    for (name, counts) in &result.channels {
        let lost = counts
            .published_count
            .saturating_sub(counts.taken_count + counts.in_flight_count);
        let _infallible = writeln!(
            text,
            "  {name:<18} published {:>8}   taken {:>8}   lost {lost:>7}   in flight {:>4}",
            counts.published_count, counts.taken_count, counts.in_flight_count
        );
    }
    for (name, count) in &result.recorded_counts {
        let _infallible = writeln!(text, "  {name:<18} recorded  {count:>8}");
    }
    text.push_str(&terminal::render_score(
        &ScoreMetric::all_of(score),
        &ScoreEvents::in_virtual_time(score),
        columns,
        Style::Coloured,
    ));
    text
}

fn render_json(topology: &Topology, result: &SimulationResult, score: &Score) -> String {
    let channels: serde_json::Map<String, serde_json::Value> = result
        .channels
        .iter()
        .map(|(name, counts)| {
            let counts = serde_json::json!({
                "published_count": counts.published_count,
                "taken_count": counts.taken_count,
                "in_flight_count": counts.in_flight_count,
            });
            ((*name).to_owned(), counts)
        })
        .collect();
    let document = serde_json::json!({
        "name": topology.name(),
        "seed": topology.run().seed,
        "duration_s": topology.run().duration.as_secs_f64(),
        "channels": channels,
        "recorded_counts": result.recorded_counts,
        "score": score,
    });
    format!("{document:#}\n")
}
