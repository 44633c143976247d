//! The commands that need a case but no run: virtual time, tables, calibration, and the replay of
//! a finished run.

use std::io::IsTerminal;
use std::path::Path;

use crate::arguments::CalibrateArgs;
use hil_core::study::Batch;
use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_platform::signals::Signals;
use hil_report::replay;
use hil_report::simulate;
use hil_report::study;
use hil_report::study::BatchArgs;
use hil_report::study::{StudyEnd, StudyError, Wanted};
use hil_report::terminal;
use hil_report::terminal::Style;
use hil_rundir::run_folder::RunFolder;
use hil_topology;
use hil_topology::registry::Registry;
use hil_topology::{Topology, TopologyErrors};

use super::{columns, exit, interrupted, load, signals};

/// `simulate`, with its report and the run's folder.
pub(super) fn simulate(
    file: &Path,
    overrides: &[String],
    output: Option<&Path>,
    registry: &Registry,
    console: &mut Console,
) -> u8 {
    let signals = match signals(console) {
        Ok(signals) => signals,
        Err(code) => return code,
    };
    // Virtual time does not look at signals.
    let watch =
        signals.end_program_unless_over("a run in virtual time is shown whole or not at all");
    let Some(topology) = load(file, overrides, registry, console) else {
        return exit::USAGE;
    };
    let progress = Progress::begin();
    let outcome = output
        .map_or(Ok(()), simulate::check_output)
        .and_then(|()| {
            simulate::simulate(&topology, file, registry, &mut |share| {
                progress.show(console, Some(share), "in virtual time");
            })
        });
    let mut simulated = match outcome {
        Ok(simulated) => simulated,
        Err(error) => {
            console.error(&error.to_string());
            return exit::USAGE;
        }
    };
    let written = output.map_or(Ok(()), |folder| simulated.write(folder));
    let page = terminal::render(&simulated.summary, columns(), Style::Coloured);
    drop(watch);
    console.result(&page);
    match written {
        Ok(()) => exit::RAN,
        Err(error) => {
            console.error(&error.to_string());
            exit::FAILED
        }
    }
}

/// `tables`.
pub(super) fn tables(
    path: &Path,
    overrides: &[String],
    batch: &BatchArgs,
    registry: &Registry,
) -> u8 {
    let mut console = Console::new(batch.quiet);
    // Before the preparation, which takes its time and must not end without a word.
    let signals = match signals(&mut console) {
        Ok(signals) => signals,
        Err(code) => return code,
    };
    let topology = hil_topology::load_case(path, overrides, registry.known());
    let Some(topology) = loaded(topology, &mut console) else {
        return exit::USAGE;
    };
    let study = study::batch_of(&topology, registry, Wanted::Tables);
    compute(study, batch, &signals, &mut console)
}

/// `calibrate`.
pub(super) fn calibrate(args: CalibrateArgs, registry: &Registry) -> u8 {
    let mut console = Console::new(args.batch.quiet);
    let signals = match signals(&mut console) {
        Ok(signals) => signals,
        Err(code) => return code,
    };
    let (figure, value) = match wanted_figure(args.mlr, args.figure.as_deref()) {
        Ok(wanted) => wanted,
        Err(text) => {
            console.error(&text);
            return exit::USAGE;
        }
    };
    let entry = match registry.find_by_prefix(&args.case) {
        Ok(entry) => entry,
        Err(error) => {
            console.error(&error.to_string());
            return exit::USAGE;
        }
    };
    if entry.name != args.case {
        console.say(&format!("{:?} is taken for case {}", args.case, entry.name));
    }
    let mut overrides = args.overrides;
    overrides.extend(
        args.seeds
            .map(|count| format!("case.parameters.tables.seeds={count}")),
    );
    let known = registry.known();
    let topology = match &args.topology {
        Some(path) => hil_topology::load_case(path, &overrides, known),
        None => hil_topology::case_by_name(entry.name, &overrides, known),
    };
    let Some(topology) = loaded(topology, &mut console) else {
        return exit::USAGE;
    };
    let named = topology.case().map_or("no case", |case| case.name.as_str());
    if named != entry.name {
        let text = format!("the topology names {named}, not case {}", entry.name);
        console.error(&text);
        return exit::USAGE;
    }
    let wanted = Wanted::Calibration { figure, value };
    let study = study::batch_of(&topology, registry, wanted);
    compute(study, &args.batch, &signals, &mut console)
}

/// The figure asked for, and its value.
fn wanted_figure(mlr: Option<f64>, figure: Option<&str>) -> Result<(&str, f64), String> {
    let (name, value) = match (mlr, figure) {
        (Some(ratio), _) => ("mlr", ratio),
        (None, Some(text)) => {
            let (name, value) = text
                .split_once('=')
                .ok_or_else(|| format!("--figure {text} is not NAME=VALUE, e.g. mlr=0.008"))?;
            let value = value
                .trim()
                .parse()
                .map_err(|_error| format!("--figure {text}: {value:?} is not a number"))?;
            (name.trim(), value)
        }
        (None, None) => return Err("no figure to calibrate for; see --mlr and --figure".to_owned()),
    };
    if value.is_finite() {
        Ok((name, value))
    } else {
        Err(format!("{name} {value} is not a finite number"))
    }
}

fn loaded(topology: Result<Topology, TopologyErrors>, console: &mut Console) -> Option<Topology> {
    match topology {
        Ok(topology) => Some(topology),
        Err(errors) => {
            console.faults(&errors.render(std::io::stderr().is_terminal()));
            None
        }
    }
}

fn compute(
    study: Result<Box<dyn Batch>, StudyError>,
    args: &BatchArgs,
    signals: &Signals,
    console: &mut Console,
) -> u8 {
    let study = match study {
        Ok(study) => study,
        Err(error) => {
            console.error(&error.to_string());
            return exit::USAGE;
        }
    };
    match study::run(study.as_ref(), args, signals, console) {
        Ok(StudyEnd::Passed) => exit::RAN,
        Ok(StudyEnd::Missed) => {
            console
                .error("a criterion is missed: the lines marked MISSED at the end of the tables");
            exit::FAILED
        }
        Ok(StudyEnd::Interrupted) => interrupted(),
        Err(error) => {
            console.error(&error.to_string());
            exit::FAILED
        }
    }
}

/// `replay`.
pub(super) fn replay(run: &Path, json: bool, registry: &Registry, console: &mut Console) -> u8 {
    let folder = RunFolder::existing(run);
    let replayed = Progress::begin().during(console, "reading messages", |stage| {
        replay::replay(&folder, registry, &|share, words| {
            stage.tell(share, words);
        })
    });
    let replayed = match replayed {
        Ok(replayed) => replayed,
        Err(error) => {
            console.error(&error.to_string());
            return exit::USAGE;
        }
    };
    console.result(&if json {
        replayed.json()
    } else {
        replayed.text()
    });
    if replayed.is_identical() {
        exit::RAN
    } else {
        exit::FAILED
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_has_a_name_and_a_finite_value() {
        assert_eq!(wanted_figure(Some(0.008), None), Ok(("mlr", 0.008)));
        assert_eq!(wanted_figure(None, Some("mlr = 0.5")), Ok(("mlr", 0.5)));
        for (mlr, figure, expected) in [
            (
                None,
                Some("mlr"),
                "--figure mlr is not NAME=VALUE, e.g. mlr=0.008",
            ),
            (None, Some("mlr=x"), "--figure mlr=x: \"x\" is not a number"),
            (Some(f64::NAN), None, "mlr NaN is not a finite number"),
            (None, Some("a=inf"), "a inf is not a finite number"),
        ] {
            assert_eq!(wanted_figure(mlr, figure).unwrap_err(), expected);
        }
    }
}
