//! The answer of a run as the last lines of a report, where a reader looks first. It draws no conclusions.

use crate::answer::{Answer, HarmCount, Hurt, counted_as_harm, metric_words};
use crate::assessment::Assessment;
use crate::sections::events::first_harm;
use crate::summary::RunSummary;
use hil_platform::text::{columns, shortened};
use hil_platform::words::counted;
use hil_present::Tone;
use hil_present::terminal::canvas::Canvas;

/// Columns of a line's label: the longest harm of a case fits.
const LABEL_WIDTH: usize = 34;

pub(super) fn answer(
    canvas: &mut Canvas,
    summary: &RunSummary,
    assessment: &Assessment,
    harms_shown: usize,
) {
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
    if answer.hurt == Hurt::Yes
        && let Some(words) = first_harm(summary)
    {
        let words = shortened(&words, 3 * (canvas.width() - LABEL_WIDTH) - 30);
        canvas.field_of(LABEL_WIDTH, "first harm", Tone::Plain, &words);
    }
    // Those that happened come first where there is no room for all.
    let mut harms: Vec<&HarmCount> = summary.harms.iter().collect();
    if harms.len() > harms_shown {
        harms.sort_by_key(|harm| harm.count == Some(0));
    }
    for harm in harms.iter().take(harms_shown) {
        canvas.field_of(LABEL_WIDTH, &harm.what, Tone::Plain, &harm.words());
    }
    let hidden = harms.len().saturating_sub(harms_shown) as u64;
    if hidden > 0 {
        let words = format!("{} with --full", counted(hidden, "further count"));
        canvas.field_of(LABEL_WIDTH, "", Tone::Faint, &words);
    }
    if let Some(words) = counted_as_harm(summary) {
        canvas.field_of(LABEL_WIDTH, "counted as harm", Tone::Plain, words);
    }
    for name in &summary.headline {
        let metric = summary.score.iter().find(|one| one.name == *name);
        if let Some(metric) = metric.filter(|one| one.value.is_some()) {
            let words = format!("{}, not counted as harm", metric_words(metric));
            canvas.field_of(LABEL_WIDTH, &metric.label, Tone::Plain, &words);
        }
    }
    let (tone, words) = answer.measurement_words(&assessment.network);
    canvas.field_of(LABEL_WIDTH, "measurement", tone, &words);
    let sample = format!("{}; brackets are 95 % intervals", answer.sample_words());
    canvas.field_of(LABEL_WIDTH, "sample", Tone::Plain, &sample);
}
