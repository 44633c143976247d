//! What `hil-runtime link` does: finds the run, asks or orders, prints. The orders are [`super`]'s.

use std::path::PathBuf;
use std::time::Duration;

use hil_link::condition::LinkCondition;
use serde_json::{Value, json};

use super::cli::{LinkCommand, RunChoice, SetArgs};
use super::{Confirmed, EMULATED, LinkDirection, LinkError, RunLinks};
use hil_platform::clock::MonotonicClock;
use hil_platform::console::{CommandEnd, Console};
use hil_rundir::select;

/// Does what the command line says.
pub fn work(command: &LinkCommand, console: &mut Console) -> CommandEnd {
    let outcome = match command {
        LinkCommand::Show(choice) => show(choice),
        LinkCommand::Set(args) => {
            condition(args).and_then(|condition| set(&args.link, condition, &args.choice, console))
        }
        LinkCommand::Reset { link, choice } => set(link, LinkCondition::Topology, choice, console),
    };
    match outcome {
        Ok(text) => {
            console.result(&format!("{text}\n"));
            CommandEnd::Done
        }
        Err((end, text)) => {
            console.error(&text);
            end
        }
    }
}

type Outcome<T> = Result<T, (CommandEnd, String)>;

fn refused(text: impl core::fmt::Display) -> (CommandEnd, String) {
    (CommandEnd::Refused, text.to_string())
}

fn end_of(error: &LinkError) -> (CommandEnd, String) {
    let end = match error {
        LinkError::Folder { .. }
        | LinkError::UnknownLink { .. }
        | LinkError::NotEmulated { .. }
        | LinkError::Elsewhere { .. }
        | LinkError::Range(_)
        | LinkError::NoRoom { .. } => CommandEnd::Refused,
        LinkError::Over(_)
        | LinkError::Channel(_)
        | LinkError::Record(_)
        | LinkError::Refused { .. }
        | LinkError::Silent { .. } => CommandEnd::Failed,
    };
    (end, error.to_string())
}

fn condition(args: &SetArgs) -> Outcome<LinkCondition> {
    if args.cut {
        return Ok(LinkCondition::Cut);
    }
    let condition = LinkCondition::Fixed {
        delay: args.delay.unwrap_or(Duration::ZERO),
        loss_ratio: args.loss.unwrap_or(0.0),
    };
    condition.check().map_err(refused)?;
    Ok(condition)
}

fn open(choice: &RunChoice) -> Outcome<RunLinks> {
    let folder = folder(choice.run.as_deref())?;
    RunLinks::open(&folder).map_err(|error| end_of(&error))
}

fn folder(run: Option<&str>) -> Outcome<PathBuf> {
    match run.map(PathBuf::from) {
        Some(folder) if folder.join("manifest.json").is_file() => Ok(folder),
        _ => select::select(run)
            .map(|run| run.run_folder().root().to_owned())
            .map_err(refused),
    }
}

fn show(choice: &RunChoice) -> Outcome<String> {
    let links = open(choice)?;
    let mut rows = Vec::new();
    let mut text = Vec::new();
    for direction in &links.directions {
        let (condition, since) = links.condition(direction).map_err(|error| end_of(&error))?;
        let ago_s = since.map(|since| MonotonicClock::now().seconds_since(since));
        rows.push(json!({
            "direction": direction.name(),
            "gateway": direction.gateway,
            "channels": direction.channels,
            "topology": direction.described,
            "condition": condition_json(condition),
            "changed_s_ago": ago_s,
            "delay_max_s": direction.delay_max.map(|longest| longest.as_secs_f64()),
        }));
        text.push(shown(direction, condition, ago_s));
    }
    for (link, via) in &links.carried {
        if via != EMULATED {
            rows.push(json!({ "direction": link, "via": via }));
            text.push(format!("{link}: carried by {via}, nothing to set"));
        } else if links.directions.iter().all(|one| one.link != *link) {
            text.push(format!("{link}: emulated on another host"));
        }
    }
    if choice.json {
        return pretty(&Value::Array(rows));
    }
    if text.is_empty() {
        text.push("the run has no links".to_owned());
    }
    Ok(text.join("\n"))
}

fn shown(direction: &LinkDirection, condition: LinkCondition, ago_s: Option<f64>) -> String {
    let now = match condition {
        LinkCondition::Topology => "as the topology says".to_owned(),
        changed => format!("changed by hand: {changed}"),
    };
    let since = ago_s.map_or_else(String::new, |ago_s| format!(" (since {ago_s:.1} s ago)"));
    let longest = direction.delay_max.map_or_else(
        || "unavailable".to_owned(),
        |longest| format!("{:.1} s", longest.as_secs_f64()),
    );
    format!(
        "{}: {now}{since}\n    topology: {}\n    channels: {}\n    longest delay that can be set: \
         {longest}",
        direction.name(),
        direction.described,
        direction.channels.join(", ")
    )
}

fn set(
    name: &str,
    condition: LinkCondition,
    choice: &RunChoice,
    console: &mut Console,
) -> Outcome<String> {
    let mut links = open(choice)?;
    let directions = links.named(name).map_err(|error| end_of(&error))?;
    let mut done: Vec<(LinkDirection, Confirmed)> = Vec::new();
    for direction in directions {
        match links.set(&direction, condition) {
            Ok(confirmed) => done.push((direction, confirmed)),
            Err(error) => {
                // What was changed before it stays changed, and must be said.
                for (direction, _) in &done {
                    console.warn(&format!("{} was changed", direction.name()));
                }
                return Err(end_of(&error));
            }
        }
    }
    if choice.json {
        let rows = done.iter().map(|(direction, confirmed)| {
            json!({
                "direction": direction.name(),
                "gateway": direction.gateway,
                "condition": condition_json(confirmed.condition),
                "number": confirmed.number,
                "from_monotonic_ns": confirmed.from.as_ns(),
                "certain_monotonic_ns": confirmed.certain.as_ns(),
            })
        });
        return pretty(&rows.collect());
    }
    let said = done.iter().map(|(direction, confirmed)| {
        format!(
            "{}: {}, confirmed by {} (change {})",
            direction.name(),
            confirmed.condition,
            direction.gateway,
            confirmed.number
        )
    });
    Ok(said.collect::<Vec<_>>().join("\n"))
}

fn condition_json(condition: LinkCondition) -> Value {
    match condition {
        LinkCondition::Topology => json!({ "kind": "topology" }),
        LinkCondition::Fixed { delay, loss_ratio } => json!({
            "kind": "fixed",
            "delay_s": delay.as_secs_f64(),
            "loss_ratio": loss_ratio,
        }),
        LinkCondition::Cut => json!({ "kind": "cut" }),
    }
}

fn pretty(value: &Value) -> Outcome<String> {
    serde_json::to_string_pretty(value).map_err(|error| (CommandEnd::Failed, error.to_string()))
}
