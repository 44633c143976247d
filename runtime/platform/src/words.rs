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
}
