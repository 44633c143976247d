//! The commands that need a case but no run: virtual time, tables, calibration, and the replay of
//! a finished run.

use std::path::Path;

use crate::arguments::CalibrateArgs;
use hil_core::study::Batch;
use hil_platform::console::{CommandEnd, Console};
use hil_platform::progress::Progress;
use hil_platform::signals::Signals;
use hil_report::study::{self, BatchArgs, Invocation, RunArgument, StudyError, Wanted};
use hil_report::terminal;
use hil_report::{replay, simulate};
use hil_rundir::run_folder::RunFolder;
use hil_topology::registry::Registry;

use super::{
    Refusal, check_traces, code_of, columns, exit, failed, load, loaded, signals, tell_undecided,
    usage,
};

/// Where a run in virtual time is shown.
#[derive(Clone, Copy)]
pub(super) struct SimulatedShown<'a> {
    pub(super) output: Option<&'a Path>,
    pub(super) is_full: bool,
}

/// `simulate`, with its report and the run's folder.
pub(super) fn simulate(
    file: &Path,
    overrides: &[String],
    shown: SimulatedShown<'_>,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let SimulatedShown { output, is_full } = shown;
    let signals = signals()?;
    // Virtual time does not look at signals.
    let watch =
        signals.end_program_unless_over("a run in virtual time is shown whole or not at all");
    let topology = load(file, overrides, registry, console)?;
    check_traces(file, overrides, &topology, console)?;
    tell_undecided(&topology, registry, console);
    let progress = Progress::begin();
    let outcome = output
        .map_or(Ok(()), simulate::check_output)
        .and_then(|()| {
            simulate::simulate(&topology, file, registry, &mut |share| {
                progress.show(console, Some(share), "in virtual time");
            })
        });
    let mut simulated = outcome.map_err(usage)?;
    let written = output.map_or(Ok(()), |folder| simulated.write(folder));
    let page = terminal::page(&simulated.summary, is_full, columns());
    drop(watch);
    console.result(&page);
    written.map(|()| exit::RAN).map_err(failed)
}

/// `tables`.
pub(super) fn tables(
    path: &Path,
    overrides: &[String],
    runs: &[RunArgument],
    batch: &BatchArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    console.set_quiet(batch.quiet);
    // Before the preparation, which takes its time and must not end without a word.
    let signals = signals()?;
    let topology = hil_topology::load_case(path, overrides, registry.known());
    let topology = loaded(topology, console)?;
    let study = study::batch_of(&topology, registry, Wanted::Tables { runs });
    let path = path.display().to_string();
    let invocation = with_runs(&["tables", "--topology", &path], runs, overrides);
    compute(study, batch, &invocation, &signals, console)
}

/// The call of tables with `runs`.
pub(super) fn with_runs(words: &[&str], runs: &[RunArgument], overrides: &[String]) -> Invocation {
    let runs: Vec<String> = runs.iter().map(RunArgument::to_string).collect();
    let mut all = vec!["hil-runtime"];
    all.extend(words);
    all.extend(runs.iter().flat_map(|run| ["--run", run]));
    invocation(&all, overrides)
}

/// `calibrate`.
pub(super) fn calibrate(
    args: CalibrateArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    console.set_quiet(args.batch.quiet);
    let signals = signals()?;
    let (figure, value) = wanted_figure(args.mlr, args.figure.as_deref()).map_err(usage)?;
    let entry = registry.find_by_prefix(&args.case).map_err(usage)?;
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
    let topology = loaded(topology, console)?;
    let named = topology.case().map_or("no case", |case| case.name.as_str());
    if named != entry.name {
        let text = format!("the topology names {named}, not case {}", entry.name);
        return Err(usage(text));
    }
    let wanted = Wanted::Calibration { figure, value };
    let study = study::batch_of(&topology, registry, wanted);
    let wanted = format!("{figure}={value}");
    let mut words = vec!["hil-runtime", "calibrate", entry.name, "--figure", &wanted];
    let path = args
        .topology
        .as_ref()
        .map(|path| path.display().to_string());
    words.extend(path.iter().flat_map(|path| ["--topology", path]));
    let invocation = invocation(&words, &overrides);
    compute(study, &args.batch, &invocation, &signals, console)
}

fn invocation(words: &[&str], overrides: &[String]) -> Invocation {
    Invocation {
        words: words.iter().map(|word| (*word).to_owned()).collect(),
        overrides: overrides.to_vec(),
        remarks: Vec::new(),
        columns: columns(),
    }
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

pub(super) fn compute(
    study: Result<Box<dyn Batch>, StudyError>,
    args: &BatchArgs,
    invocation: &Invocation,
    signals: &Signals,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let study = study.map_err(usage)?;
    match study::run(study.as_ref(), args, invocation, signals, console).map_err(failed)? {
        CommandEnd::Failed => Err(failed(
            "a criterion is missed: the lines marked MISSED at the end of the tables",
        )),
        end => Ok(code_of(end)),
    }
}

/// `replay`.
pub(super) fn replay(
    run: &Path,
    json: bool,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let folder = RunFolder::existing(run);
    let replayed = Progress::begin().during(console, "reading messages", |stage| {
        replay::replay(&folder, registry, &|share, words| {
            stage.tell(share, words);
        })
    });
    let replayed = replayed.map_err(usage)?;
    console.result(&if json {
        replayed.json()
    } else {
        replayed.text(columns())
    });
    Ok(if replayed.is_identical() {
        exit::RAN
    } else {
        exit::FAILED
    })
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
