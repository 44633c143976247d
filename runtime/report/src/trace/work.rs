//! What `hil-runtime trace` does: reads, computes, prints and writes. The figures are
//! `hil_trace`'s, the page is `report::terminal`'s.

use core::fmt::Write as _;
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use hil_core::plot::PlotSeries;
use hil_trace::fit::TraceFit;
use hil_trace::metrics::TraceMetrics;
use hil_trace::netem::NetemTable;
use hil_trace::{Trace, TraceDirection, csv, netem, opportunities, wire};
use serde_json::{Value, json};

use super::cli::{TraceCommand, TraceFiles, TraceForm};
use super::open::{Opened, files, open};
use super::plots;
use crate::terminal::{self, Style};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::progress::Progress;
use hil_platform::text::shell_word;
use hil_rundir::series;
use hil_topology::trace_source::TraceFileError;

/// Does what the command line says, on a page of `columns`.
pub fn work(command: TraceCommand, columns: usize, console: &mut Console) -> CommandEnd {
    match command {
        TraceCommand::Info(asked) => each(&asked, console, &mut |opened, is_json, talk| {
            let figures = talk.figures_of(opened);
            if is_json {
                return Ok(info_json(opened, &figures));
            }
            let page = terminal::render_trace(&opened.trace, &figures, columns, Style::Coloured);
            talk.console.result(&page);
            Ok(Value::Null)
        }),
        TraceCommand::Fit {
            files: asked,
            seed,
            link,
        } => {
            let is_one = files(&asked.files).is_ok_and(|all| all.len() == 1);
            let mut written = FittedLinks {
                named: link,
                is_one,
                tables: BTreeSet::new(),
            };
            each(&asked, console, &mut |opened, is_json, talk| {
                let words = format!("fitting {}", opened.path.display());
                let fit = talk.during(&words, || TraceFit::of(&opened.trace, seed));
                let toml = written.toml(opened, &fit);
                if is_json {
                    return Ok(json!({ "file": opened.path, "fit": fit, "toml": toml }));
                }
                let header = &opened.trace.header;
                talk.console.rendered(&terminal::render_fit(
                    header,
                    &fit,
                    columns,
                    Style::Coloured,
                ));
                talk.console.result(&toml);
                Ok(Value::Null)
            })
        }
        TraceCommand::Plot { files, output } => {
            each(&files, console, &mut |opened, is_json, talk| {
                plot(opened, is_json, output.as_deref(), columns, talk)
            })
        }
        TraceCommand::Convert {
            from,
            into,
            to,
            force,
        } => convert(&from, &into, to, force, console),
    }
}

/// The links that were printed so far, so that what several traces come to is one topology.
struct FittedLinks {
    /// What the user calls the link; else each trace's own name of it.
    named: Option<String>,
    /// One trace speaks for both directions.
    is_one: bool,
    tables: BTreeSet<String>,
}

impl FittedLinks {
    /// The lines for one trace, and above them where they come from.
    fn toml(&mut self, opened: &Opened, fit: &TraceFit) -> String {
        let header = &opened.trace.header;
        let own = Some(header.link.as_str()).filter(|name| !name.is_empty());
        let link = key(self.named.as_deref().or(own).unwrap_or("hop"));
        let changed = if header.link_change_count > 0 {
            "# the link was changed by hand: the fit mixes its conditions\n"
        } else {
            ""
        };
        let source = format!(
            "# {} of {}, direction {}\n{changed}",
            header.channel,
            opened.path.display(),
            header.direction.word()
        );
        if self.is_one {
            return format!("{source}{}", fit.toml(&link));
        }
        let toml = fit.toml_of_direction(&link, header.direction);
        let is_first = self.tables.insert(link.clone());
        let opening = if is_first && header.direction != TraceDirection::Unknown {
            format!("[links.{link}]\nvia = \"emulated\"\n\n")
        } else {
            String::new()
        };
        if self
            .tables
            .insert(format!("{link}.{}", header.direction.word()))
        {
            return format!("{opening}{source}{toml}\n");
        }
        // A second table of one name would make the file invalid.
        let lines: Vec<String> = toml.lines().map(|line| format!("# {line}")).collect();
        format!(
            "{source}# another channel's fit of this direction stands above; to take this one instead:\n{}\n\n",
            lines.join("\n")
        )
    }
}

/// `name` as a key of TOML: quoted where a bare key cannot say it.
fn key(name: &str) -> String {
    let is_bare = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
    if !name.is_empty() && name.chars().all(is_bare) {
        return name.to_owned();
    }
    let mut quoted = String::from("\"");
    for c in name.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => {
                write!(quoted, "\\u{:04X}", u32::from(c)).expect("writing to a string cannot fail");
            }
            c => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}

/// Opens every file and hands it on; what is wrong with one is said and does not keep the others.
fn each(
    asked: &TraceFiles,
    console: &mut Console,
    show: &mut dyn FnMut(&Opened, bool, &mut ProgressReporter<'_>) -> Result<Value, String>,
) -> CommandEnd {
    let paths = match files(&asked.files) {
        Ok(paths) => paths,
        Err(text) => {
            console.error(&text);
            return CommandEnd::Refused;
        }
    };
    let (mut end, mut documents) = (CommandEnd::Done, Vec::new());
    let mut talk = ProgressReporter::begin(console);
    for (index, path) in paths.iter().enumerate() {
        // Of the first, nothing says yet how long one takes.
        talk.share = (index > 0).then(|| index as f64 / paths.len() as f64);
        let opened = match talk.open(path) {
            Ok(opened) => opened,
            Err(error) => {
                talk.console.error(&error.to_string());
                end = CommandEnd::Refused;
                continue;
            }
        };
        if let Some(fault) = &opened.fault {
            let kept = opened.trace.records.len();
            talk.console
                .error(&format!("{fault}; the {kept} records before it are shown"));
            end = if end == CommandEnd::Done {
                CommandEnd::Failed
            } else {
                end
            };
        }
        if let Some(remark) = opened.remark {
            let name = path.display();
            talk.console.warn(&format!("{name}: {remark}"));
        }
        match show(&opened, asked.json, &mut talk) {
            Ok(document) => documents.push(document),
            Err(text) => {
                talk.console.error(&text);
                end = CommandEnd::Failed;
            }
        }
    }
    if asked.json {
        talk.console
            .result(&format!("{:#}\n", Value::Array(documents)));
    }
    end
}

/// Says how far the work on all files is while there is nothing else to say.
struct ProgressReporter<'a> {
    console: &'a mut Console,
    progress: Progress,
    /// Files that are done.
    share: Option<f64>,
}

impl<'a> ProgressReporter<'a> {
    fn begin(console: &'a mut Console) -> Self {
        Self {
            console,
            progress: Progress::begin(),
            share: None,
        }
    }

    fn during<T>(&mut self, words: &str, work: impl FnOnce() -> T) -> T {
        let share = self.share;
        self.progress.during(self.console, words, |stage| {
            stage.tell(share, words);
            work()
        })
    }

    fn open(&mut self, path: &Path) -> Result<Opened, TraceFileError> {
        self.during(&format!("reading {}", path.display()), || open(path))
    }

    fn figures_of(&mut self, opened: &Opened) -> TraceMetrics {
        let words = format!("computing the figures of {}", opened.path.display());
        self.during(&words, || TraceMetrics::of(&opened.trace))
    }
}

fn info_json(opened: &Opened, figures: &TraceMetrics) -> Value {
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
        "link_change_count": header.link_change_count,
        "figures": figures,
    })
}

fn plot(
    opened: &Opened,
    is_json: bool,
    output: Option<&Path>,
    columns: usize,
    talk: &mut ProgressReporter<'_>,
) -> Result<Value, String> {
    let figures = talk.figures_of(opened);
    let made = plots::series(&opened.trace, &figures);
    let document = if is_json {
        plots_json(opened, &made)
    } else {
        let page = terminal::render_trace_plots(&opened.trace, &figures, columns, Style::Coloured);
        talk.console.result(&page);
        Value::Null
    };
    if let Some(folder) = output {
        let channel = opened.path.file_stem().unwrap_or_default();
        let folder = folder.join(channel);
        let names = series::write(&folder, made).map_err(|error| error.to_string())?;
        let folder = folder.display();
        let names = names.join(", ");
        talk.console.say(&format!("wrote to {folder}: {names}"));
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
    into: &Path,
    to: Option<TraceForm>,
    force: bool,
    console: &mut Console,
) -> CommandEnd {
    let Some(form) = to.or_else(|| form_of(into)) else {
        let name = into.display();
        console.error(&format!(
            "{name}: no form by that ending; end it in .trace, .csv, .mahimahi or .dist, or say --to"
        ));
        return CommandEnd::Refused;
    };
    if into.exists() && !force {
        console.error(&format!("{}: exists; say --force", into.display()));
        return CommandEnd::Refused;
    }
    let mut talk = ProgressReporter::begin(console);
    let opened = match talk.open(from) {
        Ok(opened) => opened,
        Err(error) => {
            talk.console.error(&error.to_string());
            return CommandEnd::Refused;
        }
    };
    if let Some(remark) = opened.remark {
        talk.console.warn(remark);
    }
    let words = format!("making {}", into.display());
    let converted = talk.during(&words, || converted(&opened.trace, form, into));
    let (bytes, remark) = match converted {
        Ok(converted) => converted,
        Err(text) => {
            talk.console.error(&format!("{}: {text}", from.display()));
            return CommandEnd::Failed;
        }
    };
    if let Err(error) = fs::write(into, bytes) {
        talk.console.error(&format!("{}: {error}", into.display()));
        return CommandEnd::Failed;
    }
    let count = opened.trace.records.len();
    talk.console.say(&format!(
        "wrote {count} records to {}{remark}",
        into.display()
    ));
    if let Some(fault) = &opened.fault {
        talk.console
            .error(&format!("{fault}; what stands before it was converted"));
        return CommandEnd::Failed;
    }
    CommandEnd::Done
}

/// The bytes, and what there is to say about them.
fn converted(trace: &Trace, form: TraceForm, into: &Path) -> Result<(Vec<u8>, String), String> {
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
                "; {}. Not kept: losses, and the order of the delays{}; {}",
                netem_use(&table, into),
                cut_words(&table),
                bound_words(trace)
            );
            Ok((table.text.into_bytes(), remark))
        }
    }
}

/// The command that uses the table in `file`: tc looks for NAME.dist in a folder that its environment names
/// (`get_distribution` in `tc/q_netem.c` of iproute2).
fn netem_use(table: &NetemTable, file: &Path) -> String {
    let file = std::path::absolute(file).unwrap_or_else(|_relative| file.to_owned());
    let folder = shell_word(&file.parent().unwrap_or(&file).to_string_lossy());
    let name = file.file_stem().unwrap_or_default().to_string_lossy();
    let [mean_us, deviation_us] = [table.mean_ns, table.deviation_ns].map(|ns| ns / 1e3);
    let is_found = file.extension().is_some_and(|ending| ending == "dist");
    let renamed = if is_found {
        String::new()
    } else {
        format!("name it {name}.dist, as tc looks for that, and ")
    };
    let name = shell_word(&name);
    format!(
        "{renamed}use it as: TC_LIB_DIR={folder} tc qdisc replace dev DEVICE root netem delay {mean_us:.0}us \
         {deviation_us:.0}us distribution {name}"
    )
}

/// What of the delays no table of netem's can say.
fn cut_words(table: &NetemTable) -> String {
    if table.cut_count == 0 {
        return String::new();
    }
    let share = 100.0 * table.cut_count as f64 / netem::TABLE_COUNT as f64;
    let most_ns = table.mean_ns + 4.0 * table.deviation_ns;
    format!(
        ". Cut: {share:.2} % of the delays, more than four deviations from the mean, where the table \
         ends ({:.3} ms)",
        most_ns / 1e6
    )
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
    fn a_link_of_any_name_is_one_key() {
        for name in [
            "hop",
            "a-b_9",
            "a.b",
            "",
            "two words",
            "say \"x\\\"",
            "tab\t",
            "µ",
        ] {
            let text = format!("[links.{}]\nvia = \"emulated\"\n", key(name));
            let table: toml::Table = toml::from_str(&text).unwrap();
            assert_eq!(table["links"][name]["via"].as_str(), Some("emulated"));
        }
        assert_eq!(key("hop"), "hop");
        assert_eq!(key("a.b"), "\"a.b\"");
    }

    #[test]
    fn a_form_is_told_by_the_ending() {
        let of = |name: &str| form_of(Path::new(name));
        assert_eq!(of("a/b.trace"), Some(TraceForm::Trace));
        assert_eq!(of("wlan.down"), Some(TraceForm::Mahimahi));
        assert_eq!(of("wlan.txt"), None);
        assert_eq!(of("wlan"), None);
    }
}
