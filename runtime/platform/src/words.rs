//! Numbers with their nouns, as people say them.

use crate::text::grouped;

/// `1 message`, `12,345 messages`.
pub fn counted(count: u64, what: &str) -> String {
    format!("{} {}", grouped(count), plural(count, what))
}

/// The same with a plain number, as scripts read it: `1 message`, `12345 messages`.
pub fn counted_plainly(count: u64, what: &str) -> String {
    format!("{count} {}", plural(count, what))
}

/// `what` of so many.
pub fn plural(count: u64, what: &str) -> String {
    let ending = if count == 1 { "" } else { "s" };
    format!("{what}{ending}")
}

/// `512 B`, `44.0 KiB`, `3.2 MiB`: bytes in the largest unit of which there is one.
pub fn bytes(count: u64) -> String {
    const KIBIBYTE: u64 = 1 << 10;
    const MEBIBYTE: u64 = 1 << 20;
    let scaled = |unit: u64| count as f64 / unit as f64;
    match count {
        0..KIBIBYTE => format!("{count} B"),
        KIBIBYTE..MEBIBYTE => format!("{:.1} KiB", scaled(KIBIBYTE)),
        _ => format!("{:.1} MiB", scaled(MEBIBYTE)),
    }
}

/// As many of `names` as `shown_count`, and the number of the others: `a, b and 1,000 more`.
pub fn named(names: &[impl AsRef<str>], shown_count: usize) -> String {
    let shown = names.iter().take(shown_count).map(AsRef::as_ref);
    let shown = shown.collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(shown_count) {
        0 => shown,
        more => format!("{shown} and {} more", grouped(more as u64)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural() {
        assert_eq!(counted(1, "message"), "1 message");
        assert_eq!(counted(0, "message"), "0 messages");
        assert_eq!(counted(12_345, "message"), "12,345 messages");
        assert_eq!(counted_plainly(12_345, "message"), "12345 messages");
    }

    #[test]
    fn bytes_are_told_in_the_largest_unit_of_which_there_is_one() {
        assert_eq!(bytes(0), "0 B");
        assert_eq!(bytes(1023), "1023 B");
        assert_eq!(bytes(45_056), "44.0 KiB");
        assert_eq!(bytes(3_355_443), "3.2 MiB");
    }

    #[test]
    fn a_few_of_many_are_named() {
        assert_eq!(named(&["a", "b"], 2), "a, b");
        assert_eq!(named(&["a", "b", "c"], 2), "a, b and 1 more");
        assert_eq!(named(&[""; 1003], 3), ", ,  and 1,000 more");
    }
}
