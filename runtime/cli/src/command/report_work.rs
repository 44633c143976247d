//! `report`: a finished run's report again, on the terminal or as files.

use std::fs;
use std::path::{Path, PathBuf};

use crate::arguments::ReportArgs;
use clap::ValueEnum as _;
use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_report::analysis;
use hil_report::page::read::Material;
use hil_report::page::{self, Format, read, write};
use hil_report::summary::{RunSummary, SummaryError};
use hil_report::terminal;
use hil_rundir::run_folder::RunFolder;
use hil_topology::registry::Registry;

use super::{Refusal, columns, exit, failed, usage};

/// `report`.
pub(super) fn report(
    args: &ReportArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let is_file = args.output.is_some()
        || args.format.is_some()
        || args.template.is_some()
        || args.figure.is_some();
    if !is_file {
        if args.against.is_some() {
            return Err(usage(
                "--against is for a page: give --output, e.g. -o report.html",
            ));
        }
        if let [run] = args.runs.as_slice() {
            return show(run, args.full, registry, console);
        }
        let text = "several runs need --output or --format, e.g. -o report.html";
        return Err(usage(text));
    }
    to_files(args, console).map(|()| exit::RAN)
}

fn to_files(args: &ReportArgs, console: &mut Console) -> Result<(), Refusal> {
    let format = format(args)?;
    let template = args.template.as_deref().map(template).transpose()?;
    let is_figures = matches!(format, Format::Svg | Format::Pdf) && template.is_none();
    let is_folder = is_figures && args.figure.is_none();
    if let Some(output) = args.output.as_deref().filter(|_| !is_folder) {
        write::check(output, args.force).map_err(usage)?;
    }
    // The clean run is the last of them.
    let folders: Vec<&PathBuf> = args.runs.iter().chain(&args.against).collect();
    let materials = Progress::begin().during(console, "reading runs", |stage| {
        let runs = folders.iter().enumerate();
        let materials = runs.map(|(index, run)| {
            // Of the first, nothing says yet how long one takes.
            let share = (index > 0).then(|| index as f64 / folders.len() as f64);
            stage.tell(share, &format!("reading {}", run.display()));
            read::read(run)
        });
        materials.collect::<Result<Vec<_>, _>>()
    });
    let materials = materials.map_err(usage)?;
    let (materials, clean) = materials.split_at(args.runs.len());
    if is_figures {
        return charts(args, format, materials, console);
    }
    let own = template
        .as_ref()
        .map(|(name, text)| (name.as_str(), text.as_str()));
    let text = Progress::begin().during(console, "drawing", |_| {
        page::render(materials, clean.first(), format, own)
    });
    let text = text.map_err(usage)?;
    match &args.output {
        None => {
            console.result(&text);
            Ok(())
        }
        Some(path) => {
            write::write(path, &text).map_err(failed)?;
            console.say(&format!("wrote {} ({} bytes)", path.display(), text.len()));
            if own.is_none() && format == Format::Html && text.len() > page::PAGE_BYTES_MAX {
                let most = page::PAGE_BYTES_MAX;
                console.warn(&format!(
                    "the page is larger than {most} bytes although its series are as short as they \
                     may be; give each run a page of its own"
                ));
            }
            Ok(())
        }
    }
}

fn format(args: &ReportArgs) -> Result<Format, Refusal> {
    let by_name = args.output.as_deref().and_then(Format::of_path);
    let figure = args.figure.as_ref().map(|_| Format::Svg);
    let own = args.template.as_ref().map(|_| Format::Html);
    let found = args.format.or(by_name).or(figure).or(own);
    let is_of_figures = |format: &Format| matches!(format, Format::Svg | Format::Pdf);
    if args.figure.is_some() && !found.is_some_and(|format| is_of_figures(&format)) {
        return Err(usage("--figure is for --format svg or pdf only"));
    }
    found.ok_or_else(|| {
        let path = args.output.as_deref().unwrap_or_else(|| Path::new(""));
        let known = Format::value_variants().iter();
        let known = known.filter_map(Format::to_possible_value);
        let known: Vec<String> = known.map(|one| one.get_name().to_owned()).collect();
        usage(format!(
            "{}: its ending says no format; give --format, one of {}",
            path.display(),
            known.join(", ")
        ))
    })
}

fn template(path: &Path) -> Result<(String, String), Refusal> {
    let text = fs::read_to_string(path);
    let text = text.map_err(|error| usage(format!("{}: {error}", path.display())))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    Ok((name.into_owned(), text))
}

/// One figure to a file or standard output, or all of them to a folder.
fn charts(
    args: &ReportArgs,
    format: Format,
    materials: &[Material],
    console: &mut Console,
) -> Result<(), Refusal> {
    let files = Progress::begin().during(console, "drawing", |_| {
        page::figure_files(materials, args.figure.as_deref(), format)
    });
    let files = files.map_err(usage)?;
    let Some(output) = &args.output else {
        if args.figure.is_none() {
            return Err(usage(
                "all figures need a folder: give --output DIR, or one with --figure NAME",
            ));
        }
        if format == Format::Pdf {
            return Err(usage(
                "a PDF needs a file: give --output, e.g. -o figure.pdf",
            ));
        }
        for file in &files {
            console.result(&String::from_utf8_lossy(&file.bytes));
        }
        return Ok(());
    };
    if args.figure.is_some() {
        for file in files.iter().take(1) {
            write::write(output, &file.bytes).map_err(failed)?;
        }
        console.say(&format!("wrote {}", output.display()));
        return Ok(());
    }
    let ending = match format {
        Format::Pdf => "pdf",
        _ => "svg",
    };
    let paths = files.iter();
    let paths = paths.map(|file| output.join(format!("{}.{ending}", file.name)));
    let paths: Vec<PathBuf> = paths.collect();
    fs::create_dir_all(output).map_err(|error| failed(format!("{}: {error}", output.display())))?;
    for path in &paths {
        write::check(path, args.force).map_err(usage)?;
    }
    for (path, file) in paths.iter().zip(&files) {
        write::write(path, &file.bytes).map_err(failed)?;
    }
    console.say(&format!(
        "wrote {} figures to {}",
        paths.len(),
        output.display()
    ));
    Ok(())
}

/// The report as the run printed it.
fn show(
    run: &Path,
    is_full: bool,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let folder = RunFolder::existing(run);
    if !folder.summary().is_file() && folder.result().is_file() {
        // The run ended, and what was to draw up its account did not come to that.
        let root = run.canonicalize().unwrap_or_else(|_error| run.to_owned());
        let analysed = Progress::begin().during(console, "drawing up the account", |_| {
            analysis::analyse(&RunFolder::existing(&root), registry)
        });
        if let Some(error) = analysed.map_or_else(Some, |concluded| concluded.unwritten) {
            return Err(failed(error));
        }
    }
    let progress = Progress::begin();
    let text = progress.during(console, "reading the summary", |_| {
        fs::read_to_string(folder.summary())
    });
    let path = folder.summary();
    let text = text.map_err(|error| {
        let text = if folder.manifest().is_file() {
            "this run never began or was killed outright, so it left no summary".to_owned()
        } else {
            format!("not a run's folder: {error}")
        };
        usage(format!("{}: {text}", path.display()))
    })?;
    let page = progress.during(console, "laying out the report", |_| {
        let summary = RunSummary::from_json(&text)?;
        Ok::<_, SummaryError>(terminal::page(&summary, is_full, columns()))
    });
    let page = page.map_err(|error| usage(format!("{}: {error}", path.display())))?;
    console.result(&page);
    Ok(exit::RAN)
}
