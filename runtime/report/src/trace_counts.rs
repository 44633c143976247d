//! What a link met of the trace that it replays, in words: the same for a run and for virtual time.

use core::fmt::Write;

use hil_core::link_model::{ReplayCounts, TraceMatch};

/// `counts` as a line.
pub(crate) fn replay_words(counts: &ReplayCounts) -> String {
    let mut text = format!(
        "met {} of {} records of its trace: {} delivered, {} lost",
        counts.met_count, counts.record_count, counts.delivered_count, counts.lost_count
    );
    let how = match counts.matching {
        TraceMatch::Index => "message by message",
        TraceMatch::Time => "by time",
        TraceMatch::Tick => "tick by tick",
    };
    let _infallible = write!(text, ", {how}");
    for (count, what) in [
        (counts.unknown_count, "of unknown fate, taken as lost"),
        (
            counts.unpublished_count,
            "at ticks without a record, taken as lost",
        ),
        (counts.repeated_count, "at a tick for the second time"),
        (counts.beyond_end_count, "after its end"),
        (
            counts.negative_delay_count,
            "with a delay below zero, taken as zero",
        ),
    ] {
        if count > 0 {
            let _infallible = write!(text, ", {count} {what}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_count_that_is_not_zero_is_said() {
        let mut counts = ReplayCounts {
            record_count: 10,
            met_count: 9,
            delivered_count: 6,
            lost_count: 3,
            ..ReplayCounts::default()
        };
        let plain = "met 9 of 10 records of its trace: 6 delivered, 3 lost, message by message";
        assert_eq!(replay_words(&counts), plain);
        counts.unknown_count = 1;
        counts.unpublished_count = 2;
        counts.repeated_count = 3;
        counts.beyond_end_count = 4;
        counts.negative_delay_count = 5;
        counts.matching = TraceMatch::Tick;
        let text = replay_words(&counts);
        let rest = text.split_once("tick by tick, ").unwrap().1;
        assert_eq!(
            rest,
            "1 of unknown fate, taken as lost, 2 at ticks without a record, taken as lost, 3 at a \
             tick for the second time, 4 after its end, 5 with a delay below zero, taken as zero"
        );
    }
}
