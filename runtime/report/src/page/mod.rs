//! Reports as files: one self-contained page with figures, or the same data as Markdown, LaTeX, CSV,
//! JSON or SVG, or through a user's own template. [`read`] and [`mod@write`] touch files; everything
//! else turns what was read into text.

mod axis;
mod channel;
mod charts;
pub(crate) mod csv;
pub(crate) mod data;
mod drawings;
mod events;
mod paper;
pub mod read;
mod run;
pub(crate) mod series;
mod svg;
mod template;
#[cfg(test)]
mod tests;
mod timeline;
mod words;
pub mod write;

use std::collections::BTreeSet;
use std::path::Path;

use clap::ValueEnum;

use self::data::{Drawing, Page, Run, RunKind, SCHEMA_VERSION, Table};
use self::read::Material;
use super::terminal::JOINT;
use hil_platform::text::grouped;

pub(crate) use self::template::TemplateError;

/// What a report is written as.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// One self-contained page: offline, printable, with figures.
    Html,
    /// GitHub's Markdown.
    Md,
    /// A `LaTeX` table (booktabs).
    Tex,
    /// One row per channel and figure.
    Csv,
    /// All data, as templates are given it.
    Json,
    /// The figures.
    Svg,
}

impl Format {
    /// By the ending of a file's name.
    pub fn of_path(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        match ending.as_str() {
            "html" | "htm" => Some(Self::Html),
            "md" | "markdown" => Some(Self::Md),
            "tex" => Some(Self::Tex),
            "csv" => Some(Self::Csv),
            "json" => Some(Self::Json),
            "svg" => Some(Self::Svg),
            _ => None,
        }
    }
}

/// Largest page, bytes.
pub const PAGE_BYTES_MAX: usize = 2_000_000;
/// Points of a series over time on a page of one run, and the fewest.
const STEPS_MAX: usize = 600;
const STEPS_MIN: usize = 40;

/// The data of `materials`, with series over time thinned to `steps` points.
pub(crate) fn page_of(materials: &[Material], steps: usize) -> Page {
    let runs = materials.iter().enumerate();
    let runs: Vec<Run> = runs
        .map(|(index, one)| run::of(one, index, steps))
        .collect();
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    let title = match names.as_slice() {
        [one] => (*one).to_owned(),
        many => format!("{} runs", many.len()),
    };
    Page {
        schema_version: SCHEMA_VERSION,
        program: concat!("hil-runtime ", env!("CARGO_PKG_VERSION")).to_owned(),
        title,
        overview: (runs.len() > 1).then(|| overview(&runs)),
        runs,
    }
}

/// One row per run.
fn overview(runs: &[Run]) -> Table {
    let mut columns = vec!["run", "outcome", "did the network hurt the robot"];
    let mut names: Vec<(&str, &str)> = Vec::new();
    for figure in runs.iter().flat_map(|run| &run.headline) {
        if names.iter().all(|(name, _)| *name != figure.name) {
            let worst = run::WORST.iter().find(|(name, _)| *name == figure.name);
            let label = worst.map_or(figure.label.as_str(), |(_, label)| label);
            names.push((&figure.name, label));
        }
    }
    columns.extend(names.iter().map(|(_, label)| *label));
    columns.push("incidents and hazards");
    let mut table = Table::new("Runs", &columns);
    for run in runs {
        let mut row = vec![
            run.name.clone(),
            run.outcome.word.clone(),
            run.answer.as_ref().map_or_else(
                || words::UNAVAILABLE.to_owned(),
                |answer| answer.answer.text.clone(),
            ),
        ];
        for (name, _) in &names {
            let found = run.headline.iter().find(|figure| figure.name == *name);
            row.push(found.map_or_else(
                || words::UNAVAILABLE.to_owned(),
                |figure| match figure.interval.as_str() {
                    "" => figure.text.clone(),
                    interval => format!("{} ({interval})", figure.text),
                },
            ));
        }
        let count = match run.kind {
            RunKind::Unfinished => words::UNAVAILABLE.to_owned(),
            RunKind::Live | RunKind::Virtual => grouped(run.score_events.grave_count),
        };
        row.push(count);
        table.rows.push(row);
    }
    "Largest values are those of the channel that has the largest; intervals are 95 %."
        .clone_into(&mut table.note);
    table
}

/// The report as text; a page keeps to [`PAGE_BYTES_MAX`] by fewer points over time where it must.
///
/// # Errors
/// When the template cannot be rendered.
pub fn render(
    materials: &[Material],
    format: Format,
    template: Option<(&str, &str)>,
) -> Result<String, TemplateError> {
    let mut steps = (STEPS_MAX / materials.len().max(1)).max(STEPS_MIN);
    loop {
        let page = page_of(materials, steps);
        let text = match (template, format) {
            (Some((name, text)), _) => template::own(name, text, &page)?,
            (None, Format::Html) => template::html(&page)?,
            (None, Format::Md) => template::markdown(&page)?,
            (None, Format::Tex) => template::tex(&page)?,
            (None, Format::Csv) => csv::text(&page),
            (None, Format::Json) => json(&page),
            (None, Format::Svg) => charts(&page).iter().map(|one| one.svg.as_str()).collect(),
        };
        let is_page = template.is_none() && format == Format::Html;
        if !is_page || text.len() <= PAGE_BYTES_MAX || steps <= STEPS_MIN {
            return Ok(text);
        }
        steps = (steps / 2).max(STEPS_MIN);
    }
}

fn json(page: &Page) -> String {
    // The joint is for pages; in JSON it would only surprise.
    let text = serde_json::to_string_pretty(page).expect("texts, numbers and lists");
    text.replace(JOINT, " ") + "\n"
}

/// Every figure of a page.
pub(crate) fn charts(page: &Page) -> Vec<&Drawing> {
    let runs = page.runs.iter();
    runs.flat_map(|run| {
        let channels = run.channels.iter().flat_map(|channel| &channel.drawings);
        run.drawings.iter().chain(channels)
    })
    .collect()
}

/// Figures as files of their own: name and text. `wanted` is a name, with or without `run-1-`.
///
/// # Errors
/// Names the figure that is not there, and those that are.
pub fn figure_files(
    materials: &[Material],
    wanted: Option<&str>,
) -> Result<Vec<(String, String)>, String> {
    let page = page_of(materials, STEPS_MAX);
    let all = charts(&page);
    let is_wanted = |one: &&&Drawing| {
        wanted.is_none_or(|wanted| {
            one.name == wanted || one.name.strip_prefix("run-1-") == Some(wanted)
        })
    };
    let chosen = all.iter().filter(is_wanted);
    let files: Vec<_> = chosen
        .map(|one| (one.name.clone(), svg::standalone(&one.svg)))
        .collect();
    if files.is_empty() {
        let names: BTreeSet<&str> = all
            .iter()
            .map(|one| one.name.strip_prefix("run-1-").unwrap_or(&one.name))
            .collect();
        let names: Vec<&str> = names.into_iter().collect();
        let there = if names.is_empty() {
            "it has none".to_owned()
        } else {
            names.join(", ")
        };
        return Err(match wanted {
            Some(wanted) => format!("no figure {wanted:?}; figures of this report: {there}"),
            None => "this report has no figure: nothing was measured".to_owned(),
        });
    }
    Ok(files)
}
