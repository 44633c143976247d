//! The answer of a run as the last lines of a report, where a reader looks first. It draws no conclusions.

use super::canvas::{Canvas, Tone};
use super::units::figure;
use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::summary::{RunSummary, ScoreMetric};
use hil_platform::text::columns;

/// Columns of a line's label: the longest harm of a case fits.
const LABEL_WIDTH: usize = 34;

pub(super) fn answer(canvas: &mut Canvas, summary: &RunSummary, assessment: &Assessment) {
    let answer = Answer::of(summary, assessment);
    canvas.rule(Tone::Faint);
    let question = answer.question();
    let words = answer.words();
    if columns(&question) + 2 + columns(&words) <= canvas.width() {
        let line = format!(
            "{}  {}",
            canvas.paint(Tone::Strong, &question),
            canvas.paint(answer.tone(), &words)
        );
        canvas.line(&line);
    } else {
        canvas.painted_line(Tone::Strong, &question);
        canvas.paragraph(0, answer.tone(), &words);
    }
    for harm in &summary.harms {
        canvas.field_of(LABEL_WIDTH, &harm.what, Tone::Plain, &harm.words());
    }
    for name in &summary.headline {
        let metric = summary.score.iter().find(|one| one.name == *name);
        if let Some(metric) = metric.filter(|one| one.value.is_some()) {
            canvas.field_of(
                LABEL_WIDTH,
                &metric.label,
                Tone::Plain,
                &metric_words(metric),
            );
        }
    }
    let (tone, words) = answer.measurement_words(&assessment.network);
    canvas.field_of(LABEL_WIDTH, "measurement", tone, &words);
    canvas.field_of(LABEL_WIDTH, "sample", Tone::Plain, &answer.sample_words());
    canvas.rule(Tone::Faint);
}

/// The figure in the unit that people think in, with its interval.
fn metric_words(metric: &ScoreMetric) -> String {
    let (scale, unit) = match metric.unit.as_str() {
        "rad" => (180.0 / core::f64::consts::PI, "°"),
        "m" => (1e3, "mm"),
        "s" => (1e3, "ms"),
        "1" => (1.0, ""),
        unit => (1.0, unit),
    };
    let value = metric
        .value
        .map_or_else(|| "unavailable".to_owned(), |value| figure(scale * value));
    let interval = metric.interval.map_or_else(String::new, |(low, high)| {
        format!(" [{}, {}]", figure(scale * low), figure(scale * high))
    });
    format!("{value} {unit}{interval}").replace("  ", " ")
}
