//! Network and robot on one time axis.

use hil_present::units::{self, duration_s, percent};
use hil_present::{Strip, Strips, Tone, UNAVAILABLE};

use crate::link_change::LinkChange;
use crate::network::{NetworkQuantity, Timeline, TimelineRow, TimelineSubject};

/// The rows of `all`; `None` where there are none.
pub(crate) fn strips(all: &Timeline, changes: &[LinkChange]) -> Option<Strips> {
    let step_count = all.rows.first()?.values.len();
    let mut last = "";
    let mut rows = Vec::new();
    for row in &all.rows {
        let mut strip = Strip {
            values: row.values.clone(),
            scale: scale(row),
            ..Strip::default()
        };
        match &row.subject {
            // A robot's rows have names of their own.
            TimelineSubject::Robot { label } => {
                label.clone_into(&mut strip.name);
                strip.tone = Tone::Bad;
            }
            TimelineSubject::Channel { channel, quantity } => {
                if channel != last {
                    channel.clone_into(&mut strip.name);
                }
                last = channel;
                strip.tone = Tone::Bar;
                let what = match quantity {
                    NetworkQuantity::Loss => "network loss",
                    NetworkQuantity::Delay => "network delay",
                    NetworkQuantity::Silence => "silence",
                };
                what.clone_into(&mut strip.what);
            }
        }
        rows.push(strip);
    }
    let in_force = changes.iter().filter(|change| change.is_in_force());
    Some(Strips {
        whole_s: all.step_s * step_count as f64,
        rows,
        marks_s: in_force.filter_map(|change| change.at_s).collect(),
        marks_label: "link changed by hand",
    })
}

/// The largest value of the row, and how far it may be off by the alignment of two clocks.
fn scale(row: &TimelineRow) -> String {
    let Some(largest) = row.values.iter().flatten().copied().reduce(f64::max) else {
        return UNAVAILABLE.to_owned();
    };
    let bound_s = row.bound.filter(|bound_s| *bound_s > 0.0);
    let bound = bound_s.map_or_else(String::new, |bound_s| format!(" ±{}", duration_s(bound_s)));
    match row.unit.as_str() {
        _ if largest <= 0.0 => "none".to_owned(),
        "s" => duration_s(largest) + &bound,
        "1" if matches!(row.subject, TimelineSubject::Channel { .. }) => percent(largest),
        unit => units::value(largest, unit),
    }
}
