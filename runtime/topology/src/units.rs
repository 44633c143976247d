//! Durations as the file writes them: a decimal number and a unit, exact to the nanosecond.

use core::time::Duration;

use hil_core::text_file::has_decimal_comma;

/// Unit words, largest first, in nanoseconds.
const UNITS: &[(&str, u128)] = &[
    ("h", 3_600_000_000_000),
    ("min", 60_000_000_000),
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];

/// The words of all units, largest first.
pub(super) fn unit_words() -> impl Iterator<Item = &'static str> {
    UNITS.iter().map(|(word, _)| *word)
}

/// All of them, for whoever wrote none.
fn allowed() -> String {
    unit_words().collect::<Vec<_>>().join(", ")
}

/// Why a text is no duration.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum DurationError {
    /// No number.
    #[error("has no number before its unit")]
    NoNumber,
    /// No unit.
    #[error("has no unit; allowed: {}", allowed())]
    NoUnit,
    /// A comma where a point is expected.
    #[error("has a decimal comma; write {0}")]
    DecimalComma(String),
    /// A unit that is none.
    #[error("has the unknown unit `{0}`; allowed: {allowed}", allowed = allowed())]
    UnknownUnit(String),
    /// Too fine.
    #[error("is finer than 1 ns")]
    TooFine,
    /// Too long.
    #[error("is too long to count in nanoseconds")]
    TooLong,
}

/// `us` with the sign for micro, and with the Greek letter that looks like it.
pub(super) const MICROSECONDS: [&str; 2] = ["\u{b5}s", "\u{3bc}s"];

/// Reads `20 s`, `4ms`, `1.5 us`.
///
/// # Errors
/// When it is no duration.
pub(super) fn parse_duration(text: &str) -> Result<Duration, DurationError> {
    let text = text.trim();
    let is_of_number = |letter: char| letter.is_ascii_digit() || letter == '.';
    let end = |is_of: &dyn Fn(char) -> bool| text.find(|one| !is_of(one)).unwrap_or(text.len());
    let with_comma = end(&|letter| is_of_number(letter) || letter == ',');
    if has_decimal_comma(&text[..with_comma]) {
        return Err(DurationError::DecimalComma(text.replacen(',', ".", 1)));
    }
    let end = end(&is_of_number);
    let (number, unit) = text.split_at(end);
    let unit = unit.trim();
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    if whole.is_empty() || fraction.contains('.') || number.ends_with('.') {
        return Err(DurationError::NoNumber);
    }
    if unit.is_empty() {
        return Err(DurationError::NoUnit);
    }
    let unit_ns = UNITS
        .iter()
        .find(|(word, _)| *word == unit || (*word == "us" && MICROSECONDS.contains(&unit)))
        .map(|(_, ns)| *ns)
        .ok_or_else(|| DurationError::UnknownUnit(unit.to_owned()))?;
    to_duration(whole, fraction, unit_ns)
}

/// Reads a duration from `least` to `most` for the command line, and says the range when it is none.
pub fn duration_within(
    least: Duration,
    most: Duration,
) -> impl Fn(&str) -> Result<Duration, String> + Clone {
    move |text| {
        let range = format!("{} to {}", format_duration(least), format_duration(most));
        let read = parse_duration(text);
        let read = read.map_err(|error| format!("{error}; a time such as `1 s`, {range}"))?;
        if (least..=most).contains(&read) {
            Ok(read)
        } else {
            Err(format!("is outside {range}"))
        }
    }
}

/// `whole.fraction` times `unit_ns`, in integers so that `0.1 ms` is exact.
fn to_duration(whole: &str, fraction: &str, unit_ns: u128) -> Result<Duration, DurationError> {
    let fraction = fraction.trim_end_matches('0');
    // 13 decimals already reach below 1 ns for an hour.
    let scale = u32::try_from(fraction.len())
        .ok()
        .filter(|digits| *digits <= 13)
        .map(|digits| 10_u128.pow(digits))
        .ok_or(DurationError::TooFine)?;
    let digits: u64 = whole
        .parse()
        .map_err(|_overflow: core::num::ParseIntError| DurationError::TooLong)?;
    let decimals: u128 = if fraction.is_empty() {
        0
    } else {
        fraction.parse().expect("at most 13 digits fit")
    };
    let scaled = (u128::from(digits) * scale + decimals)
        .checked_mul(unit_ns)
        .ok_or(DurationError::TooLong)?;
    if !scaled.is_multiple_of(scale) {
        return Err(DurationError::TooFine);
    }
    let total_ns = u64::try_from(scaled / scale)
        .map_err(|_overflow: core::num::TryFromIntError| DurationError::TooLong)?;
    Ok(Duration::from_nanos(total_ns))
}

/// Writes a duration in the largest unit that needs no fraction.
pub(super) fn format_duration(duration: Duration) -> String {
    let total_ns = duration.as_nanos();
    if total_ns == 0 {
        return "0 s".to_owned();
    }
    let exact = |(_, unit_ns): &&(&str, u128)| total_ns.is_multiple_of(*unit_ns);
    let (word, unit_ns) = UNITS.iter().find(exact).copied().unwrap_or(("ns", 1));
    format!("{} {word}", total_ns / unit_ns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_exact_and_survive_writing() {
        for (text, ns) in [
            ("20 s", 20_000_000_000),
            ("4ms", 4_000_000),
            ("0.1 ms", 100_000),
            ("1.5 us", 1_500),
            ("2 \u{b5}s", 2_000),
            ("2 \u{3bc}s", 2_000),
            ("1 h", 3_600_000_000_000),
            ("2 min", 120_000_000_000),
            ("0 s", 0),
            ("7 ns", 7),
        ] {
            let duration = parse_duration(text).unwrap();
            assert_eq!(duration, Duration::from_nanos(ns), "{text}");
            assert_eq!(parse_duration(&format_duration(duration)), Ok(duration));
        }
    }

    #[test]
    fn a_duration_outside_its_range_is_refused_with_it() {
        let period = duration_within(Duration::from_micros(100), Duration::from_hours(1));
        assert_eq!(period("1 ms"), Ok(Duration::from_millis(1)));
        assert_eq!(period("2 h").unwrap_err(), "is outside 100 us to 1 h");
        let why = period("30").unwrap_err();
        assert!(
            why.contains("no unit") && why.contains("100 us to 1 h"),
            "{why}"
        );
    }

    #[test]
    fn a_faulty_duration_says_what_it_lacks() {
        for (text, error) in [
            ("20", DurationError::NoUnit),
            ("s", DurationError::NoNumber),
            ("", DurationError::NoNumber),
            (".5 s", DurationError::NoNumber),
            ("1.2.3 s", DurationError::NoNumber),
            ("-4 ms", DurationError::NoNumber),
            ("4 sec", DurationError::UnknownUnit("sec".to_owned())),
            ("2,5 ms", DurationError::DecimalComma("2.5 ms".to_owned())),
            ("0.5 ns", DurationError::TooFine),
            ("99999999999999999999 s", DurationError::TooLong),
            ("9999999999999999999 h", DurationError::TooLong),
        ] {
            assert_eq!(parse_duration(text), Err(error), "{text}");
        }
    }
}
