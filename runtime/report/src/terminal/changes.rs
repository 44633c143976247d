//! Links that were changed while the run went on, as a terminal shows them.

use super::canvas::{Canvas, Tone};
use crate::link_change::LinkChange;
use hil_platform::text::grouped;

/// Changes on the page; all of them are in the summary and in events.log.
const SHOWN_COUNT: usize = 10;

/// One line per change, below the verdict: what was measured after one is about another link.
pub(super) fn changes(canvas: &mut Canvas, all: &[LinkChange]) {
    for (index, change) in all.iter().take(SHOWN_COUNT).enumerate() {
        let label = if index == 0 { "Changed" } else { "" };
        let text = format!("{}: {}", change.time(), change.what());
        canvas.field(label, Tone::Caution, &text);
    }
    let hidden = all.len().saturating_sub(SHOWN_COUNT) as u64;
    if hidden > 0 {
        let text = format!("{} more in events.log and summary.json", grouped(hidden));
        canvas.field("", Tone::Caution, &text);
    }
}

#[cfg(test)]
mod tests {
    use hil_link::spec::Way;

    use super::*;
    use crate::link_change::ChangedTo;
    use crate::terminal::{Style, render};
    use crate::tests::sample::full;

    #[test]
    fn a_report_names_every_change_or_how_many_more_there_were() {
        let mut summary = full();
        let change = |number: u64| LinkChange {
            link: "hop".to_owned(),
            way: Way::Backward,
            number,
            at_s: Some(number as f64),
            unsure_s: 0.0,
            to: ChangedTo::Cut,
            refused: None,
        };
        summary.link_changes = (1..=12).map(change).collect();
        let page = render(&summary, 100, Style::Plain);
        assert!(
            page.contains("at 1.000 s: link hop.backward changed by hand: cut"),
            "{page}"
        );
        assert!(page.contains("2 more in events.log"), "{page}");
        summary.link_changes.clear();
        assert!(!render(&summary, 100, Style::Plain).contains("by hand"));
    }
}
