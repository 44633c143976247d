//! What `hil-runtime trace` does: reads, computes, prints and writes. The figures are
//! `hil_models::trace`'s, the page is `report::terminal`'s.

use std::fs;
use std::path::Path;

use hil_models::plot::PlotSeries;
use hil_models::trace::figures::TraceFigures;
use hil_models::trace::fit::TraceFit;
use hil_models::trace::{Trace, csv, netem, opportunities, wire};
use serde_json::{Value, json};

use super::cli::{TraceCommand, TraceFiles, TraceForm};
use super::open::{Opened, files, open};
use super::plots;
use crate::console::Console;
use crate::report::terminal::{self, Style};
use crate::series;

/// Seed of the intervals where the user gives none.
const SEED: u64 = 1;

/// How it ended; the caller knows the exit codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    /// All is well.
    Done,
    /// Something was damaged or could not be written.
    Failed,
    /// Nothing could be done with what was asked.
    Refused,
}

/// Does what the command line says, on a page of `columns`.
pub(crate) fn work(command: TraceCommand, columns: usize, console: &mut Console) -> End {
    match command {
        TraceCommand::Info(asked) => each(&asked, console, &mut |opened, is_json, console| {
            let figures = TraceFigures::of(&opened.trace, SEED);
            if is_json {
                return Ok(info_json(opened, &figures));
            }
            let page = terminal::render_trace(&opened.trace, &figures, columns, Style::Coloured);
            console.result(&page);
            Ok(Value::Null)
        }),
        TraceCommand::Fit { files, seed, link } => {
            each(&files, console, &mut |opened, is_json, console| {
                let fit = TraceFit::of(&opened.trace, seed);
                if is_json {
                    return Ok(json!({ "file": opened.path, "fit": fit, "toml": fit.toml(&link) }));
                }
                let header = &opened.trace.header;
                console.rendered(&terminal::render_fit(
                    header,
                    &fit,
                    columns,
                    Style::Coloured,
                ));
                console.result(&fit.toml(&link));
                Ok(Value::Null)
            })
        }
        TraceCommand::Plot { files, output } => {
            each(&files, console, &mut |opened, is_json, console| {
                plot(opened, is_json, (output.as_deref(), columns), console)
            })
        }
        TraceCommand::Convert {
            from,
            into,
            to,
            force,
        } => convert(&from, (&into, to, force), console),
    }
}

/// Opens every file and hands it on; what is wrong with one is said and does not keep the others.
fn each(
    asked: &TraceFiles,
    console: &mut Console,
    show: &mut dyn FnMut(&Opened, bool, &mut Console) -> Result<Value, String>,
) -> End {
    let paths = match files(&asked.files) {
        Ok(paths) => paths,
        Err(text) => {
            console.error(&text);
            return End::Refused;
        }
    };
    let (mut end, mut documents) = (End::Done, Vec::new());
    for path in paths {
        let opened = match open(&path) {
            Ok(opened) => opened,
            Err(error) => {
                console.error(&error.to_string());
                end = End::Refused;
                continue;
            }
        };
        if let Some(fault) = &opened.fault {
            let kept = opened.trace.records.len();
            console.error(&format!("{fault}; the {kept} records before it are shown"));
            end = if end == End::Done { End::Failed } else { end };
        }
        if let Some(remark) = opened.remark {
            console.warn(&format!("{}: {remark}", path.display()));
        }
        match show(&opened, asked.json, console) {
            Ok(document) => documents.push(document),
            Err(text) => {
                console.error(&text);
                end = End::Failed;
            }
        }
    }
    if asked.json {
        console.result(&format!("{:#}\n", Value::Array(documents)));
    }
    end
}

fn info_json(opened: &Opened, figures: &TraceFigures) -> Value {
    let header = &opened.trace.header;
    json!({
        "file": opened.path,
        "fault": opened.fault,
        "run": header.run,
        "channel": header.channel,
        "link": header.link,
        "clock": header.clock,
        "direction": header.direction,
        "arrival": header.arrival,
        "figures": figures,
    })
}

fn plot(
    opened: &Opened,
    is_json: bool,
    (output, columns): (Option<&Path>, usize),
    console: &mut Console,
) -> Result<Value, String> {
    let figures = TraceFigures::of(&opened.trace, SEED);
    let made = plots::series(&opened.trace, &figures);
    let document = if is_json {
        plots_json(opened, &made)
    } else {
        let page = terminal::render_trace_plots(&opened.trace, &figures, columns, Style::Coloured);
        console.result(&page);
        Value::Null
    };
    if let Some(folder) = output {
        let channel = opened.path.file_stem().unwrap_or_default();
        let folder = folder.join(channel);
        let names = series::write(&folder, made).map_err(|error| error.to_string())?;
        let folder = folder.display();
        console.say(&format!("wrote to {folder}: {}", names.join(", ")));
    }
    Ok(document)
}

fn plots_json(opened: &Opened, made: &[PlotSeries]) -> Value {
    let series = made.iter().map(|one| {
        let columns: Vec<&str> = one.columns.iter().map(|column| column.name).collect();
        let rows: Vec<&[f64]> = one.rows().collect();
        json!({
            "name": one.name,
            "title": one.title,
            "notes": one.notes,
            "columns": columns,
            "rows": rows,
        })
    });
    json!({ "file": opened.path, "series": series.collect::<Vec<_>>() })
}

fn convert(
    from: &Path,
    (into, to, force): (&Path, Option<TraceForm>, bool),
    console: &mut Console,
) -> End {
    let Some(form) = to.or_else(|| form_of(into)) else {
        let name = into.display();
        console.error(&format!(
            "{name}: no form by that ending; end it in .trace, .csv, .mahimahi or .netem, or say --to"
        ));
        return End::Refused;
    };
    if into.exists() && !force {
        console.error(&format!("{}: exists; say --force", into.display()));
        return End::Refused;
    }
    let opened = match open(from) {
        Ok(opened) => opened,
        Err(error) => {
            console.error(&error.to_string());
            return End::Refused;
        }
    };
    if let Some(remark) = opened.remark {
        console.warn(remark);
    }
    let (bytes, remark) = match converted(&opened.trace, form) {
        Ok(converted) => converted,
        Err(text) => {
            console.error(&format!("{}: {text}", from.display()));
            return End::Failed;
        }
    };
    if let Err(error) = fs::write(into, bytes) {
        console.error(&format!("{}: {error}", into.display()));
        return End::Failed;
    }
    let count = opened.trace.records.len();
    console.say(&format!(
        "wrote {count} records to {}{remark}",
        into.display()
    ));
    if let Some(fault) = &opened.fault {
        console.error(&format!("{fault}; what stands before it was converted"));
        return End::Failed;
    }
    End::Done
}

/// The bytes, and what there is to say about them.
fn converted(trace: &Trace, form: TraceForm) -> Result<(Vec<u8>, String), String> {
    match form {
        TraceForm::Trace => {
            let bytes = wire::encode(trace).map_err(|error| error.to_string())?;
            Ok((bytes, String::new()))
        }
        TraceForm::Csv => Ok((csv::encode(trace).into_bytes(), String::new())),
        TraceForm::Mahimahi => {
            let text = opportunities::encode(trace);
            let text = text.map_err(|error| error.to_string())?;
            let remark = format!("; {}; {}", opportunities::ENCODE_LOSS, bound_words(trace));
            Ok((text.into_bytes(), remark))
        }
        TraceForm::Netem => {
            let table = netem::table(trace).ok_or("fewer than two delays, or all are equal")?;
            let remark = format!(
                "; use it as: netem delay {:.0}us {:.0}us distribution FILE. Not kept: losses, and \
                 the order of the delays; {}",
                table.mean_ns / 1e3,
                table.deviation_ns / 1e3,
                bound_words(trace)
            );
            Ok((table.text.into_bytes(), remark))
        }
    }
}

/// How far the clocks may have led the delays of `trace` astray.
fn bound_words(trace: &Trace) -> String {
    match trace.delay_bound_ns() {
        Some(0) => "delays are of one clock".to_owned(),
        Some(ns) => format!("each delay within {:.3}us by the clocks", ns as f64 / 1e3),
        None => "how far the clocks may have led the delays astray is unknown".to_owned(),
    }
}

fn form_of(path: &Path) -> Option<TraceForm> {
    match path.extension()?.to_str()? {
        "trace" => Some(TraceForm::Trace),
        "csv" => Some(TraceForm::Csv),
        "mahimahi" | "mahi" | "up" | "down" => Some(TraceForm::Mahimahi),
        "netem" | "dist" => Some(TraceForm::Netem),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_form_is_told_by_the_ending() {
        let of = |name: &str| form_of(Path::new(name));
        assert_eq!(of("a/b.trace"), Some(TraceForm::Trace));
        assert_eq!(of("wlan.down"), Some(TraceForm::Mahimahi));
        assert_eq!(of("wlan.txt"), None);
        assert_eq!(of("wlan"), None);
    }
}
