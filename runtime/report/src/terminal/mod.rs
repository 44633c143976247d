//! The report of a run as text for a terminal of 80 to 120 columns: what a run prints, and every section. It returns
//! text; the caller prints it.

mod answer;
mod brief;
mod trace;

use std::path::PathBuf;

use answer::AnswerExtent;
pub use brief::brief;
use hil_platform::text::shortened;
use hil_present::Tone;
use hil_present::terminal::canvas::Canvas;
pub use hil_present::terminal::canvas::Style;
use hil_present::terminal::section;
use hil_present::units::seconds;
use hil_rundir::run_folder::RunFolder;
pub(crate) use trace::{render_fit, render_trace, render_trace_plots};

use crate::assessment::Assessment;
use crate::sections;
use crate::summary::{RunFacts, RunSummary};

/// Width of the files.
const FILE_WIDTH: usize = 100;

/// The report as printed and every section, as files of the run's folder.
pub(crate) fn text_files(folder: &RunFolder, summary: &RunSummary) -> [(PathBuf, String); 2] {
    [
        (
            folder.full_report(),
            render(summary, FILE_WIDTH, Style::Plain),
        ),
        // The last one: who waits for it finds all there is.
        (folder.report(), brief(summary, FILE_WIDTH, Style::Plain)),
    ]
}

/// The report of a run for a terminal: as a run prints it, or every section.
pub fn page(summary: &RunSummary, is_full: bool, width_columns: usize) -> String {
    let text = if is_full { render } else { brief };
    text(summary, width_columns, Style::Coloured)
}

/// Every section of a run as text of at most `width_columns` columns (clamped to 80..=120).
pub fn render(summary: &RunSummary, width_columns: usize, style: Style) -> String {
    let assessment = Assessment::of(summary);
    let mut canvas = Canvas::new(width_columns, style);
    title(&mut canvas, summary);
    for one in sections::of_run(summary, &assessment) {
        section(&mut canvas, &one);
    }
    answer::answer(&mut canvas, summary, &assessment, AnswerExtent::WHOLE);
    canvas.finish()
}

fn title(canvas: &mut Canvas, summary: &RunSummary) {
    let run = &summary.run;
    canvas.rule(Tone::Faint);
    let title = format!("{}{}", case_lead(run), run.name);
    let title = shortened(&title, canvas.width());
    canvas.painted_line(Tone::Strong, &title);
    let facts = format!(
        "{} · {} long · seed {} · host {} · topology {} ({})",
        run.started,
        seconds(run.duration_s),
        run.seed,
        run.host,
        run.topology_file,
        run.topology_hash,
    );
    canvas.paragraph(0, Tone::Faint, &facts);
    if let Some(words) = sections::link_words(summary) {
        canvas.paragraph(0, Tone::Plain, &format!("emulated link {words}"));
    }
    canvas.rule(Tone::Faint);
}

/// The case before the run's name; nothing of a run without one.
fn case_lead(run: &RunFacts) -> String {
    match run.case.as_str() {
        "" => String::new(),
        case => format!("{case} · "),
    }
}
