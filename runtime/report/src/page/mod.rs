//! Reports as files: one self-contained page with figures, or the same data as Markdown, LaTeX, CSV,
//! JSON or SVG, or through a user's own template. [`read`] and [`mod@write`] touch files; everything else
//! turns what was read into text.

mod axis;
mod charts;
pub(crate) mod data;
mod drawings;
mod pdf;
pub mod read;
mod run;
pub(crate) mod series;
mod svg;
#[cfg(test)]
mod tests;
mod timeline;
pub mod write;

use std::collections::BTreeSet;
use std::path::Path;

use clap::ValueEnum;

use hil_present::template::{self, TemplateError};
use hil_present::units::JOINT;
use hil_present::{Cell, Drawing, Section, Table, UNAVAILABLE, csv};
use minijinja::{Value, context};
use serde_json::json;

use self::data::{Page, Run, SCHEMA_VERSION};
use self::read::Material;

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
    /// The figures, for print.
    Pdf,
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
            "pdf" => Some(Self::Pdf),
            _ => None,
        }
    }
}

/// Largest page, bytes.
pub const PAGE_BYTES_MAX: usize = 2_000_000;
/// Points of a series over time on a page of one run, and the fewest.
const STEPS_MAX: usize = 600;
const STEPS_MIN: usize = 40;

/// The data of `materials`, with series over time thinned to `steps` points. `clean` is a run over a link that
/// does not hurt: its values stand below those to see first.
pub(crate) fn page_of(materials: &[Material], clean: Option<&Material>, steps: usize) -> Page {
    let runs = materials.iter().enumerate();
    let mut runs: Vec<Run> = runs
        .map(|(index, one)| run::of(one, index, steps))
        .collect();
    if let Some(clean) = clean.map(|clean| run::of(clean, runs.len(), steps)) {
        for tile in runs.iter_mut().flat_map(|run| &mut run.headline) {
            let mut found = clean.headline.iter();
            let found = found.find(|one| one.metric.name == tile.metric.name);
            let text = found.map_or(UNAVAILABLE, |one| &one.metric.text);
            tile.clean = Some(text.to_owned());
        }
    }
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
    let mut columns = vec!["run", "outcome", "did the network hurt"];
    let mut names: Vec<(&str, &str)> = Vec::new();
    for tile in runs.iter().flat_map(|run| &run.headline) {
        let metric = &tile.metric;
        if names.iter().all(|(name, _)| *name != metric.name) {
            let worst = run::WORST.iter().find(|(name, _)| *name == metric.name);
            let label = worst.map_or(metric.label.as_str(), |(_, label)| label);
            names.push((&metric.name, label));
        }
    }
    columns.extend(names.iter().map(|(_, label)| *label));
    columns.push("incidents and hazards");
    let mut table = Table::new("Runs", &columns);
    for run in runs {
        let answer = run
            .answer
            .as_ref()
            .map(|answer| answer.answer.text.as_str());
        let mut row: Vec<Cell> = vec![
            run.name.clone().into(),
            run.outcome.word.clone().into(),
            answer.unwrap_or(UNAVAILABLE).into(),
        ];
        for (name, _) in &names {
            let mut metrics = run.headline.iter().map(|tile| &tile.metric);
            let found = metrics.find(|one| one.name == *name);
            let text = found.map_or_else(
                || UNAVAILABLE.to_owned(),
                |one| match one.interval.as_str() {
                    "" => one.text.clone(),
                    interval => format!("{} ({interval})", one.text),
                },
            );
            row.push(text.into());
        }
        row.push(Cell::count(run.grave_count));
        table.push(row);
    }
    "Largest values are those of the channel that has the largest; intervals are 95 %."
        .clone_into(&mut table.note);
    table
}

/// The report as text, with the values of a `clean` run beside the first ones; a page keeps to [`PAGE_BYTES_MAX`] by fewer points over time where it must.
///
/// # Errors
/// When the template cannot be rendered.
pub fn render(
    materials: &[Material],
    clean: Option<&Material>,
    format: Format,
    template: Option<(&str, &str)>,
) -> Result<String, TemplateError> {
    let mut steps = (STEPS_MAX / materials.len().max(1)).max(STEPS_MIN);
    loop {
        let page = page_of(materials, clean, steps);
        let text = match (template, format) {
            (Some((name, text)), _) => template::render(name, text, &page, context! {})?,
            (None, Format::Html) => html(&page)?,
            (None, Format::Md) => {
                let text =
                    template::render("report.md", MARKDOWN, &page, context! { mark => MARK })?;
                text.replace(JOINT, " ")
            }
            (None, Format::Tex) => {
                let text = template::render("table.tex", TEX, &page, context! { mark => MARK })?;
                text.replace(JOINT, "~")
            }
            (None, Format::Csv) => {
                let rows = page
                    .runs
                    .iter()
                    .map(|run| csv::rows(&run.name, &run.sections));
                csv::HEADER.to_owned() + &rows.collect::<String>()
            }
            (None, Format::Json) => json(&page),
            (None, Format::Svg | Format::Pdf) => {
                charts(&page).iter().map(|one| one.svg.as_str()).collect()
            }
        };
        let is_page = template.is_none() && format == Format::Html;
        if !is_page || text.len() <= PAGE_BYTES_MAX || steps <= STEPS_MIN {
            return Ok(text);
        }
        steps = (steps / 2).max(STEPS_MIN);
    }
}

const PAGE: &str = include_str!("templates/page.html");
const MARKDOWN: &str = include_str!("templates/report.md");
const TEX: &str = include_str!("templates/table.tex");
const PAGE_STYLE: &str = include_str!("templates/page.css");
const PAGE_SCRIPT: &str = include_str!("templates/page.js");

/// What marks a file as one of ours, which may be overwritten.
const MARK: &str = "hil-runtime report";

fn html(page: &Page) -> Result<String, TemplateError> {
    let plots = page.runs.iter().flat_map(|run| &run.plots);
    let plots: serde_json::Map<String, serde_json::Value> = plots
        .map(|(name, plot)| (name.clone(), json!(plot)))
        .collect();
    // Within a script element nothing is escaped, and "</script>" ends it.
    let data = json!(plots)
        .to_string()
        .replace('<', "\\u003c")
        .replace('>', "\\u003e")
        .replace('&', "\\u0026");
    let extra = context! {
        style => Value::from_safe_string(format!("{}{PAGE_STYLE}", svg::STYLE)),
        script => Value::from_safe_string(PAGE_SCRIPT.to_owned()),
        plots => Value::from_safe_string(data),
        mark => MARK,
    };
    template::render("page.html", PAGE, page, extra)
}

fn json(page: &Page) -> String {
    // The joint is for pages; in JSON it would only surprise.
    let text = serde_json::to_string_pretty(page).expect("texts, numbers and lists");
    text.replace(JOINT, " ") + "\n"
}

/// Every figure of a page.
pub(crate) fn charts(page: &Page) -> Vec<&Drawing> {
    let sections = page.runs.iter().flat_map(|run| &run.sections);
    sections.flat_map(Section::drawings).collect()
}

/// A figure as a file of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FigureFile {
    /// Without ending.
    pub name: String,
    /// What is in it.
    pub bytes: Vec<u8>,
}

/// Figures as files of their own, also each series of the case. `wanted` is a name, with or without `run-1-`.
///
/// # Errors
/// Names the figure that is not there, and those that are; says why a PDF cannot be made.
pub fn figure_files(
    materials: &[Material],
    wanted: Option<&str>,
    format: Format,
) -> Result<Vec<FigureFile>, String> {
    let page = page_of(materials, None, STEPS_MAX);
    let runs = page.runs.iter().zip(materials);
    let of_case = runs
        .flat_map(|(run, material)| timeline::each_of_case(&run.key, &material.series, STEPS_MAX));
    let of_case: Vec<_> = of_case.collect();
    let all: Vec<_> = charts(&page).into_iter().chain(&of_case).collect();
    let is_wanted = |one: &&&Drawing| {
        wanted.is_none_or(|wanted| {
            one.name == wanted || one.name.strip_prefix("run-1-") == Some(wanted)
        })
    };
    let chosen = all.iter().filter(is_wanted);
    let chosen: Vec<_> = chosen.collect();
    if chosen.is_empty() {
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
    let print = match format {
        Format::Pdf => Some(pdf::options()?),
        _ => None,
    };
    let file = |one: &&&Drawing| {
        Ok(FigureFile {
            name: one.name.clone(),
            bytes: match &print {
                Some(options) => pdf::of_figure(&one.svg, options)?,
                None => svg::standalone(&one.svg).into_bytes(),
            },
        })
    };
    chosen.iter().map(file).collect()
}
