//! The links of a report: how the gateways at both ends of each way stood, and what they refused.

use super::canvas::{Canvas, Tone};
use super::channel::stall_words;
use crate::summary::DirectionSummary;
use hil_platform::words::counted;

/// Both ends of each way of each link, one after the other.
pub(super) fn links(canvas: &mut Canvas, directions: &[DirectionSummary]) {
    let mut shown: Vec<&str> = Vec::new();
    for first in directions {
        if shown.contains(&first.flow.as_str()) {
            continue;
        }
        shown.push(&first.flow);
        let channels = counted(first.channels.len() as u64, "channel");
        canvas.heading(&format!("Link {}", first.label()), &channels);
        for end in directions.iter().filter(|one| one.flow == first.flow) {
            let refused = end.refusal_words();
            if !refused.is_empty() {
                let text = format!("datagrams: {}", refused.join(" · "));
                canvas.field("refused", Tone::Caution, &text);
            }
            let words = end.words().join(" · ");
            canvas.field(end.direction.word(), Tone::Faint, &words);
            // Whether a stream stood still is a result, and not one to be looked for among options.
            if let Some(stalls) = &end.stalls {
                canvas.field("stalls", Tone::Plain, &stall_words(stalls));
            }
        }
    }
}
