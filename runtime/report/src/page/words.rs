//! Values as texts, in the units of a page.

use crate::terminal::{JOINT, duration_s, figure, percent};
use hil_platform::text::grouped;

/// What stands where there is no value.
pub(super) const UNAVAILABLE: &str = "unavailable";

/// A value of this unit. Shares are given in per cent by the unit `share`; see [`share`].
pub(super) fn value(value: f64, unit: &str) -> String {
    match unit {
        "s" => duration_s(value),
        "share" => percent(value),
        "1" => number(value),
        unit => format!("{}{JOINT}{unit}", number(value)),
    }
}

/// A pure number; whole ones in groups of digits.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "whole and between 0 and 1e15"
)]
pub(super) fn number(value: f64) -> String {
    let is_count = value.fract().abs() < f64::EPSILON && (0.0..1e15).contains(&value);
    if is_count {
        grouped(value as u64)
    } else {
        figure(value)
    }
}

/// A count, or that there is none.
pub(super) fn count(count: Option<u64>) -> String {
    count.map_or_else(|| UNAVAILABLE.to_owned(), grouped)
}

/// Nanoseconds as seconds.
pub(super) fn ns_s(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_unit_has_its_words() {
        let words = |number, unit| value(number, unit).replace(JOINT, " ");
        assert_eq!(words(0.0012, "s"), "1.20 ms");
        assert_eq!(words(0.5, "share"), "50.00 %");
        assert_eq!(words(12_345.0, "1"), "12,345");
        assert_eq!(words(-1.5, "m"), "-1.500 m");
        assert_eq!(count(None), "unavailable");
    }
}
