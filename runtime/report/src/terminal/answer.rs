//! The answer of a run as the last lines of a report, where a reader looks first. It draws no conclusions.

use crate::answer::Answer;
use crate::assessment::Assessment;
use crate::sections::AnswerFacts;
use crate::summary::RunSummary;
use hil_platform::text::{columns, shortened};
use hil_present::Tone;
use hil_present::terminal::canvas::Canvas;

/// Columns of a line's label, with the blank behind it.
const LABEL_WIDTH_MIN: usize = 14;
const LABEL_WIDTH_MAX: usize = 36;
/// Lines of what the emulated links do, where not all is shown.
const BRIEF_LINK_LINES: usize = 2;

/// How much of it is shown.
#[derive(Debug, Clone, Copy)]
pub(super) struct AnswerExtent {
    /// Ways in which the robot was hurt, and figures of the case; `None` for all, and those in which it was not.
    pub(super) harms: Option<usize>,
    /// Lines of what stands beside a label.
    pub(super) lines: usize,
}

impl AnswerExtent {
    /// All there is.
    pub(super) const WHOLE: Self = Self {
        harms: None,
        lines: 20,
    };
}

/// Draws it.
pub(super) fn answer(
    canvas: &mut Canvas,
    summary: &RunSummary,
    assessment: &Assessment,
    extent: AnswerExtent,
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
    let facts = AnswerFacts::of(summary, assessment, &answer, extent.harms);
    let link_lines = match extent.harms {
        None => extent.lines,
        Some(_) => BRIEF_LINK_LINES,
    };
    let all: Vec<_> = [facts.measurement, facts.sample]
        .into_iter()
        .chain(facts.harms)
        .chain(facts.rest)
        .map(|field| (field, extent.lines))
        .chain(facts.links.map(|links| (links, link_lines)))
        .collect();
    let widest = all.iter().map(|(one, _)| columns(&one.label) + 2).max();
    let label_width = widest.unwrap_or(0).clamp(LABEL_WIDTH_MIN, LABEL_WIDTH_MAX);
    for (one, lines) in &all {
        let room = lines * (canvas.width() - label_width) - 30;
        let value = shortened(&one.value, room);
        canvas.field_of(label_width, &one.label, one.tone, &value);
    }
}
