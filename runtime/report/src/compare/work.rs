//! What `hil-runtime compare` does: reads, compares, judges, prints.

use std::path::PathBuf;

use serde::Serialize;

use super::cli::{CompareArgs, CompareFormat};
use super::conditions::{Condition, Judged, Unjudged, Verdicts};
use super::{ComparedRun, Comparison, render};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::progress::{Progress, Stage};

/// Does what the command line says, on a page of `columns`.
pub fn work(args: &CompareArgs, columns: usize, console: &mut Console) -> CommandEnd {
    let compared = Progress::begin().during(console, "reading runs", |stage| {
        compared(args, columns, stage)
    });
    match compared {
        Ok((text, has_failed)) => {
            console.result(&text);
            if has_failed {
                console.error("a condition of --fail-if holds");
                return CommandEnd::Failed;
            }
            CommandEnd::Done
        }
        Err(text) => {
            console.error(&text);
            CommandEnd::Refused
        }
    }
}

fn compared(args: &CompareArgs, columns: usize, stage: &Stage) -> Result<(String, bool), String> {
    let (base, new) = sides(args);
    // Wrong words are told before folders are read.
    let conditions = args.fail_if.iter().map(|text| Condition::parse(text));
    let conditions = conditions
        .collect::<Result<Vec<_>, _>>()
        .map_err(|error| error.to_string())?;
    let (run_count, mut read_count) = (base.len() + new.len(), 0_usize);
    let mut read = |folders: &[PathBuf]| {
        let runs = folders.iter().map(|folder| {
            let run = ComparedRun::read(folder);
            read_count += 1;
            stage.reach(read_count as f64 / run_count as f64);
            run
        });
        runs.collect::<Result<Vec<_>, _>>()
            .map_err(|error| error.to_string())
    };
    let (base, new) = (read(&base)?, read(&new)?);
    stage.tell(None, "comparing");
    let comparison = Comparison::of(&base, &new);
    let mut verdicts = Verdicts::default();
    for condition in &conditions {
        condition
            .judge(&comparison, args.strict, &mut verdicts)
            .map_err(|error| error.to_string())?;
    }
    let has_failed = verdicts.judged.iter().any(|one| one.holds);
    let text = match args.format {
        CompareFormat::Text if args.full => render::full(&comparison, &verdicts, columns),
        CompareFormat::Text => render::brief(&comparison, &verdicts, columns),
        CompareFormat::Md => {
            render::markdown(&comparison, &verdicts).map_err(|error| error.to_string())?
        }
        CompareFormat::Json => json(&comparison, &verdicts)?,
    };
    Ok((text, has_failed))
}

fn sides(args: &CompareArgs) -> (Vec<PathBuf>, Vec<PathBuf>) {
    match args.runs.as_slice() {
        [base, new] => (vec![base.clone()], vec![new.clone()]),
        _ => (args.base.clone(), args.new.clone()),
    }
}

fn json(comparison: &Comparison, verdicts: &Verdicts) -> Result<String, String> {
    #[derive(Serialize)]
    struct Document<'a> {
        schema_version: u32,
        #[serde(flatten)]
        comparison: &'a Comparison,
        conditions: &'a [Judged],
        unjudged: &'a [Unjudged],
    }
    let document = Document {
        schema_version: 1,
        comparison,
        conditions: &verdicts.judged,
        unjudged: &verdicts.unjudged,
    };
    let text = serde_json::to_string_pretty(&document).map_err(|error| error.to_string())?;
    Ok(text + "\n")
}
