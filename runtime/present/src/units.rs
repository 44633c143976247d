//! Numbers as people read them: a unit per value, three significant digits, grouped thousands.
//! Number and unit are joined by [`JOINT`], so that no line breaks between them.

use hil_platform::text::grouped;

/// Stands for a blank at which a line must not break; a page turns it into one.
pub const JOINT: char = '\u{a0}';

/// A duration in the unit that leaves one to three digits before the point.
pub fn duration(ns: i64) -> String {
    let magnitude = ns.unsigned_abs();
    let sign = if ns < 0 { "-" } else { "" };
    let (scale, unit) = match magnitude {
        0..1_000 => return format!("{sign}{magnitude}{JOINT}ns"),
        1_000..999_500 => (1e3, "µs"),
        999_500..999_500_000 => (1e6, "ms"),
        _ => (1e9, "s"),
    };
    format!(
        "{sign}{}{JOINT}{unit}",
        three_digits(magnitude as f64 / scale)
    )
}

/// As [`duration`], of what is never below zero.
pub fn unsigned_duration(ns: u64) -> String {
    duration(i64::try_from(ns).unwrap_or(i64::MAX))
}

/// As [`duration`], of seconds.
#[allow(
    clippy::cast_possible_truncation,
    reason = "a run's durations are far below 292 years; beyond, the conversion saturates"
)]
pub fn duration_s(seconds: f64) -> String {
    duration((seconds * 1e9).round() as i64)
}

/// Seconds after the start of a run.
pub fn seconds(value: f64) -> String {
    format!("{value:.3}{JOINT}s")
}

fn three_digits(value: f64) -> String {
    // Compared after rounding: 9.996 is 10.0, not 10.00.
    if value < 9.995 {
        format!("{value:.2}")
    } else if value < 99.95 {
        format!("{value:.1}")
    } else {
        format!("{value:.0}")
    }
}

/// A ratio as per cent. Nothing but all rounds to 100 %, nothing but none to 0 %.
pub fn percent(ratio: f64) -> String {
    let value = 100.0 * ratio;
    if ratio > 0.0 && value < 0.01 {
        return format!("<0.01{JOINT}%");
    }
    if ratio < 1.0 && value > 99.99 {
        return format!(">99.99{JOINT}%");
    }
    format!("{value:.2}{JOINT}%")
}

/// A ratio near one as per cent, with two digits of what it lacks: 99.9987 %.
pub fn availability(ratio: f64) -> String {
    let lacking = (1.0 - ratio) * 100.0;
    if lacking.is_nan() || lacking <= 1e-9 {
        return percent(ratio);
    }
    let digits = digit_count((1.0 - (lacking * (1.0 + 1e-6)).log10().floor()).clamp(2.0, 12.0));
    let text = format!("{:.digits$}", 100.0 * ratio);
    // 99.990 says no more than 99.99.
    let spare = text.len() - text.trim_end_matches('0').len();
    let kept = text.len() - spare.min(digits - 2);
    format!("{}{JOINT}%", &text[..kept])
}

/// Below it a figure says no more than that it is.
const FIGURE_MIN: f64 = 1e-12;

/// A pure number, without an exponent: enough digits for its size, never more than it holds; from a thousand on
/// in groups of digits.
pub fn figure(value: f64) -> String {
    let magnitude = value.abs();
    let is_whole = magnitude.fract() < f64::EPSILON;
    if magnitude > 0.0 && magnitude < FIGURE_MIN {
        format!("<{FIGURE_MIN:.12}")
    } else if magnitude >= 1e15 {
        format!("{value:.0}")
    } else if is_whole || magnitude >= 999.95 {
        let sign = if value < 0.0 { "-" } else { "" };
        format!("{sign}{}", grouped(whole(magnitude)))
    } else {
        let digits = 3.0 - magnitude.log10().floor().clamp(-12.0, 3.0);
        format!("{value:.*}", digit_count(digits))
    }
}

/// What is below this number above zero: two digits, rounded upwards.
pub fn upper_bound(value: f64) -> String {
    let digits = (1.0 - value.log10().floor()).clamp(-15.0, 15.0);
    let scale = 10_f64.powf(digits);
    let above = (value * scale).ceil() / scale;
    format!("{above:.*}", digit_count(digits.max(0.0)))
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the caller asks for 0 to 1e15"
)]
const fn whole(value: f64) -> u64 {
    value.round() as u64
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the caller clamps to 0..=15"
)]
const fn digit_count(digits: f64) -> usize {
    digits as usize
}

/// Of an SI unit the one that people think in and the factor to it, the same for all values of a series.
pub fn scale(unit: &str) -> (f64, &str) {
    match unit {
        "rad" => (180.0 / core::f64::consts::PI, "°"),
        "m" => (1e3, "mm"),
        _ => (1.0, unit),
    }
}

/// A value of this SI unit as people think of it: a ratio of the unit `share` in per cent, angles in degrees,
/// durations, short lengths and rates of bytes in the unit of their size.
pub fn value(value: f64, unit: &str) -> String {
    match unit {
        "s" => duration_s(value),
        "share" => percent(value),
        "1" => figure(value),
        "1/s" => format!("{}{JOINT}per{JOINT}second", figure(value)),
        "B/s" => byte_rate(value),
        "m" if value.abs() >= 1.0 => format!("{}{JOINT}m", figure(value)),
        unit => {
            let (factor, unit) = scale(unit);
            format!("{}{JOINT}{unit}", figure(factor * value))
        }
    }
}

fn byte_rate(value: f64) -> String {
    let (factor, unit) = match value.abs() {
        ..999.5 => return format!("{value:.0}{JOINT}B/s"),
        ..999_500.0 => (1e-3, "kB/s"),
        ..999.5e6 => (1e-6, "MB/s"),
        _ => (1e-9, "GB/s"),
    };
    format!("{}{JOINT}{unit}", three_digits(factor * value))
}

/// Nanoseconds as seconds.
pub fn ns_s(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_duration_has_the_unit_of_its_size() {
        for (ns, expected) in [
            (0, "0 ns"),
            (999, "999 ns"),
            (1_000, "1.00 µs"),
            (12_345, "12.3 µs"),
            (-12_345, "-12.3 µs"),
            (999_499, "999 µs"),
            (999_500, "1.00 ms"),
            (9_996_000, "10.0 ms"),
            (4_033_000_000, "4.03 s"),
            (i64::MIN, "-9223372037 s"),
        ] {
            assert_eq!(duration(ns).replace(JOINT, " "), expected);
        }
    }

    #[test]
    fn shares_never_round_into_all_or_nothing() {
        assert_eq!(percent(1.0).replace(JOINT, " "), "100.00 %");
        assert_eq!(percent(0.999_999).replace(JOINT, " "), ">99.99 %");
        assert_eq!(percent(0.5).replace(JOINT, " "), "50.00 %");
        assert_eq!(percent(0.000_001).replace(JOINT, " "), "<0.01 %");
        assert_eq!(percent(0.0).replace(JOINT, " "), "0.00 %");
    }

    #[test]
    fn an_availability_has_the_digits_that_tell_it_from_one() {
        for (ratio, expected) in [
            (0.9999, "99.99 %"),
            (0.999_987_2, "99.9987 %"),
            (0.999_999, "99.9999 %"),
            (0.943_75, "94.38 %"),
            (0.5, "50.00 %"),
            (1.0, "100.00 %"),
            (0.0, "0.00 %"),
        ] {
            assert_eq!(availability(ratio).replace(JOINT, " "), expected, "{ratio}");
        }
    }

    #[test]
    fn each_unit_has_its_words() {
        let words = |number, unit| value(number, unit).replace(JOINT, " ");
        assert_eq!(words(0.0012, "s"), "1.20 ms");
        assert_eq!(words(0.5, "share"), "50.00 %");
        assert_eq!(words(12_345.0, "1"), "12,345");
        assert_eq!(words(-1.5, "m"), "-1.500 m");
        assert_eq!(words(0.1612, "m"), "161.2 mm");
        assert_eq!(words(0.0, "m"), "0 mm");
        assert_eq!(words(0.045_64, "rad"), "2.615 °");
        assert_eq!(words(93.4, "s"), "93.4 s");
        assert_eq!(words(125.0, "1/s"), "125 per second");
        assert_eq!(words(11_338.0, "B/s"), "11.3 kB/s");
        assert_eq!(words(3.0, "grasps"), "3 grasps");
    }

    #[test]
    fn bounds_are_rounded_away_from_what_they_exclude() {
        assert_eq!(upper_bound(4.9929), "5.0");
        assert_eq!(upper_bound(176.2), "180");
        assert_eq!(upper_bound(299.57), "300");
        assert_eq!(upper_bound(0.066_76), "0.067");
        assert_eq!(upper_bound(1.01), "1.1");
    }

    #[test]
    fn figures_keep_four_digits() {
        assert_eq!(figure(890.0), "890");
        assert_eq!(figure(195.324_5), "195.3");
        assert_eq!(figure(0.001_234_56), "0.001235");
        assert_eq!(figure(1.234_56e-6), "0.000001235");
        assert_eq!(figure(-1e-15), "<0.000000000001");
        assert_eq!(figure(f64::MIN_POSITIVE), "<0.000000000001");
        assert_eq!(figure(-0.5), "-0.5000");
        assert_eq!(figure(7_315_012.4), "7,315,012");
        assert_eq!(figure(12_345.6), "12,346");
        assert_eq!(figure(-1_234.5), "-1,235");
        assert_eq!(figure(999.96), "1,000");
        assert_eq!(figure(12_345.0), "12,345");
    }
}
