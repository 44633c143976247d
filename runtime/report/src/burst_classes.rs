//! Runs of losses in classes of their lengths, for a table and for a drawing.

use hil_account::BurstCount;

use hil_platform::text::grouped;

/// Lengths that are a class of their own; beyond, one reaches to the next power of two.
const SINGLE_MAX: u64 = 4;

/// The classes: their words, and how many runs of losses they hold.
pub(crate) fn burst_classes(runs: &[BurstCount]) -> Vec<(String, u64)> {
    let mut classes: Vec<((u64, u64), u64)> = Vec::new();
    let longest = runs
        .iter()
        .map(|run| run.length_messages)
        .max()
        .unwrap_or(0);
    let mut from = 1;
    while from <= longest {
        let until = if from <= SINGLE_MAX {
            from
        } else {
            (from - 1).saturating_mul(2)
        };
        let within = runs
            .iter()
            .filter(|run| (from..=until).contains(&run.length_messages));
        classes.push(((from, until), within.map(|run| run.count).sum()));
        from = until.saturating_add(1);
    }
    let words = classes.into_iter().map(|((from, until), count)| {
        let words = if from == until {
            grouped(from)
        } else {
            format!("{from}–{until}")
        };
        (words, count)
    });
    words.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_runs_share_classes_and_none_is_left_out() {
        let runs = [(1, 50), (3, 2), (6, 1), (1_000, 4)];
        let runs = runs.map(|(length_messages, count)| BurstCount {
            length_messages,
            count,
        });
        let classes = burst_classes(&runs);
        assert_eq!(classes[4], ("5–8".to_owned(), 1));
        assert_eq!(classes.last(), Some(&("513–1024".to_owned(), 4)));
        assert_eq!(classes.iter().map(|(_, count)| count).sum::<u64>(), 57);
        assert_eq!(burst_classes(&[]), []);
    }
}
