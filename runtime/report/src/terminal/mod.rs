//! Renders a summary for a terminal of 80 to 120 columns. It returns text; the caller prints it.

mod adapter;
mod answer;
mod brief;
mod canvas;
mod changes;
mod channel;
mod clocks;
mod emulation;
mod events;
mod link;
mod network;
mod nics;
mod outages;
mod radio;
mod tables;
mod timeline;
mod trace;
mod units;

pub use brief::brief;
pub use canvas::Style;
pub(crate) use canvas::{Tone, left, wrapped};
pub(crate) use channel::{closing_text, stall_words};
use hil_platform::text::{grouped, shortened};
pub(crate) use trace::{render_fit, render_trace, render_trace_plots};
pub use units::{JOINT, duration, percent, unsigned_duration};
pub(crate) use units::{duration_s, figure, seconds};

use canvas::{Canvas, INDENT};

use super::assessment::{Assessment, NetworkVerdict, SKIPPED_TICK_RATIO_MAX};
use std::path::PathBuf;

use super::summary::{Outcome, RunSummary};
use hil_rundir::protection::HopProtection;
use hil_rundir::run_folder::RunFolder;

/// Width of the files.
const FILE_WIDTH: usize = 100;

/// The report as printed and every figure, as files of the run's folder.
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

/// The report of a run for a terminal: as a run prints it, or with every figure.
pub fn page(summary: &RunSummary, is_full: bool, width_columns: usize) -> String {
    let text = if is_full { render } else { brief };
    text(summary, width_columns, Style::Coloured)
}

/// Every figure of a run as text of at most `width_columns` columns (clamped to 80..=120).
pub fn render(summary: &RunSummary, width_columns: usize, style: Style) -> String {
    let assessment = Assessment::of(summary);
    let mut canvas = Canvas::new(width_columns, style);
    title(&mut canvas, summary);
    verdict(&mut canvas, summary, &assessment);
    changes::changes(&mut canvas, &summary.link_changes);
    tables::score(&mut canvas, &summary.score);
    events::score_events(&mut canvas, &summary.score_events);
    if let Some(report) = &summary.network {
        timeline::timeline(&mut canvas, &report.timeline, &summary.link_changes);
        network::what_preceded_what(&mut canvas, report, &summary.score_events);
        network::network(&mut canvas, report);
    }
    for channel in &summary.channels {
        channel::channel(&mut canvas, channel);
        radio::channel(&mut canvas, summary.radio.channel(&channel.name));
    }
    link::links(&mut canvas, &summary.directions);
    for adapter in &summary.faces {
        adapter::adapter(&mut canvas, adapter);
    }
    if let Some(stamps) = &summary.hardware_stamps {
        nics::hardware_stamps(&mut canvas, stamps);
    }
    if let Some(section) = &summary.clocks {
        clocks::clocks(&mut canvas, section);
    }
    radio::hops(&mut canvas, &summary.radio);
    tables::processes(&mut canvas, &summary.processes);
    tables::events(&mut canvas, &summary.events);
    tables::realtime(&mut canvas, &summary.realtime);
    tables::host(&mut canvas, &summary.host_facts);
    method(&mut canvas, summary);
    files(&mut canvas, summary);
    answer::answer(&mut canvas, summary, &assessment);
    canvas.finish()
}

fn title(canvas: &mut Canvas, summary: &RunSummary) {
    let run = &summary.run;
    canvas.rule(Tone::Faint);
    let title = shortened(&format!("{} · {}", run.case, run.name), canvas.width());
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
    canvas.rule(Tone::Faint);
}

fn verdict(canvas: &mut Canvas, summary: &RunSummary, assessment: &Assessment) {
    let (tone, word) = outcome_words(summary.run.outcome);
    canvas.field(
        "Outcome",
        tone,
        &format!("{word}: {}", summary.run.exit_reason),
    );
    let (tone, text) = network_words(&assessment.network);
    canvas.field("Network", tone, &text);
    if let Some(security) = &summary.run.security {
        let tone = match security.hops {
            HopProtection::Plain => Tone::Caution,
            HopProtection::Sealed { .. } => Tone::Good,
        };
        canvas.field("Security", tone, &security.to_string());
    }
    for (index, warning) in assessment.warnings.iter().enumerate() {
        let label = if index == 0 { "Warnings" } else { "" };
        canvas.field(label, Tone::Caution, warning);
    }
}

/// How a run ended, in a word.
pub(crate) const fn outcome_words(outcome: Outcome) -> (Tone, &'static str) {
    match outcome {
        Outcome::Completed => (Tone::Good, "completed"),
        Outcome::CriterionFailed => (Tone::Bad, "criterion failed"),
        Outcome::Stopped => (Tone::Caution, "stopped early"),
        Outcome::Failed => (Tone::Bad, "failed"),
    }
}

fn no_result(why: &str) -> (Tone, String) {
    let cure = "repeat on an idle host or at a lower rate";
    (Tone::Bad, format!("NOT a network result{why}; {cure}"))
}

/// What a run says about a network, in words.
pub(crate) fn network_words(verdict: &NetworkVerdict) -> (Tone, String) {
    let limit = percent(SKIPPED_TICK_RATIO_MAX);
    match verdict {
        NetworkVerdict::RunFailed => (Tone::Caution, "no verdict: the run failed".to_owned()),
        NetworkVerdict::VirtualTime => {
            let text = "virtual time: a result about the link models, not about a network";
            (Tone::Plain, text.to_owned())
        }
        NetworkVerdict::EmulatedLink => {
            let text = format!(
                "an emulated link: a result about the model, not about a network; no process \
                 skipped more than {limit} of its ticks"
            );
            (Tone::Good, text)
        }
        NetworkVerdict::EmulationNotKept { channels } => {
            let why =
                ", nor one about the link model: the host could not keep the emulated link of";
            no_result(&format!("{why} {}", channels.join(", ")))
        }
        NetworkVerdict::NoNetwork => {
            let text = "no channel went over a network; nothing here says anything about one";
            (Tone::Plain, text.to_owned())
        }
        NetworkVerdict::ForeignProgram => {
            let text = format!(
                "a foreign program took part over its own protocol: its answers are its and its \
                 network's; no process of ours skipped more than {limit} of its ticks"
            );
            (Tone::Plain, text)
        }
        NetworkVerdict::NoForeignProgram => {
            let text = "no foreign program answered, and no link of ours was a network; nothing \
                        here says anything about one";
            (Tone::Caution, text.to_owned())
        }
        NetworkVerdict::NetworkResult => {
            let text =
                format!("a network result: no process skipped more than {limit} of its ticks");
            (Tone::Good, text)
        }
        NetworkVerdict::HostOverran { processes } => {
            let skipped = processes
                .iter()
                .map(|overrun| overrun.skipped_tick_count)
                .sum();
            let skipped = grouped(skipped);
            no_result(&format!(
                ": the host overran ({skipped} skipped ticks, more than {limit})"
            ))
        }
        NetworkVerdict::ReceiverLate { channels } => {
            let why = ": datagrams had no room in the receive buffer, their gateway was late with";
            no_result(&format!("{why} {}", channels.join(", ")))
        }
        NetworkVerdict::RecordsMissing { hosts } => {
            let hosts = hosts.join(", ");
            let text = format!("no verdict: records of other hosts are missing on {hosts}");
            (Tone::Caution, text)
        }
        NetworkVerdict::TicksUnknown => {
            let text = "no verdict: a component left no count of its ticks";
            (Tone::Caution, text.to_owned())
        }
    }
}

/// How messages are joined and when one closes.
pub(crate) const CLOSING_METHOD: &str = "Each message is joined across records by the producer's start and its sequence number. It \
     closes when every stage is recorded, in order, and the segments add up to published → taken \
     within 1 µs; on one clock the wire is the difference of raw kernel stamps.";

fn method(canvas: &mut Canvas, summary: &RunSummary) {
    if summary.channels.is_empty() {
        return;
    }
    canvas.heading("How to read this", "");
    for text in [
        CLOSING_METHOD,
        "Quantiles are from histograms with three digits, of taken messages. Bars show medians \
         end to end. Intervals are 95 %: Wilson for shares, block bootstrap for quantiles, because \
         successive delays are correlated.",
    ] {
        canvas.paragraph(INDENT, Tone::Faint, text);
    }
}

fn files(canvas: &mut Canvas, summary: &RunSummary) {
    let run = &summary.run;
    canvas.heading("Files", "");
    canvas.field("folder", Tone::Plain, &run.folder);
    for file in &run.files {
        canvas.field(&file.label, Tone::Plain, &file.value);
    }
    canvas.field("repeat with", Tone::Strong, &run.repeat_command);
}
