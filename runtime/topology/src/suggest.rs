//! "Did you mean": the nearest of a few words, and lists for messages.

/// The word of `words` that `wrong` was probably meant to be.
pub(super) fn nearest<'a>(wrong: &str, words: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let words: Vec<&str> = words.collect();
    // A third of the letters may be wrong; more is another word.
    let distance_max = wrong.chars().count().div_ceil(3).max(1);
    let close = words
        .iter()
        .map(|word| (strsim::damerau_levenshtein(wrong, word), *word))
        .filter(|(distance, _)| *distance <= distance_max)
        .min();
    let is_part = |word: &&str| {
        wrong.len() >= 3
            && (word.starts_with(wrong) || (word.len() >= 3 && wrong.starts_with(*word)))
    };
    close
        .map(|(_, word)| word)
        .or_else(|| words.iter().copied().find(is_part))
}

/// `a`, `b`, `c`.
pub(super) fn listed(words: &[String]) -> String {
    let quoted: Vec<_> = words.iter().map(|word| format!("`{word}`")).collect();
    quoted.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slip_or_a_shortened_word_is_recognised_and_another_word_is_not() {
        let words = ["loss_ratio", "delay", "dscp"];
        for (wrong, right) in [
            ("los_ratio", Some("loss_ratio")),
            ("loss", Some("loss_ratio")),
            ("dealy", Some("delay")),
            ("dcsp", Some("dscp")),
            ("colour", None),
        ] {
            assert_eq!(nearest(wrong, words.into_iter()), right, "{wrong}");
        }
    }
}
