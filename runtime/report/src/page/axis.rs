//! Axes of figures: where a value lies, and which values are written beside it. Linear and logarithmic,
//! and one whose steps are nines, for the tails of distributions.

use hil_present::units::{JOINT, duration};

/// A scale from values to places.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis {
    scale: Scale,
    low: f64,
    high: f64,
    from_px: f64,
    until_px: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scale {
    Linear,
    Logarithmic,
    Nines,
}

/// Fewer values beside an axis do not show its scale.
const TICKS_MIN: usize = 3;
/// Room that words need along an upright axis, and along a level one.
const LINE_PX: f64 = 13.0;
const WORDS_PX: f64 = 46.0;

impl Axis {
    const fn new(scale: Scale, low: f64, high: f64, from_px: f64, until_px: f64) -> Self {
        Self {
            scale,
            low,
            high,
            from_px,
            until_px,
        }
    }

    /// From `low` at `from_px` to `high` at `until_px`; a span of nothing is widened so that there is
    /// something to draw in.
    pub(super) fn linear(low: f64, high: f64, from_px: f64, until_px: f64) -> Self {
        let widened = low + low.abs().max(1.0) * 0.5;
        let high = if high > low { high } else { widened };
        Self::new(Scale::Linear, low, high, from_px, until_px)
    }

    /// From `low`, which is above zero, at `from_px` to `high` at `until_px`.
    pub(super) fn logarithmic(low: f64, high: f64, from_px: f64, until_px: f64) -> Self {
        let low = low.max(f64::MIN_POSITIVE);
        let high = if high > low * 1.2 { high } else { low * 2.0 };
        let low = if high > low * 2.5 { low } else { low / 2.0 };
        Self::new(Scale::Logarithmic, low, high, from_px, until_px)
    }

    /// Shares from none at `from_px` to `1 - 10^-nines` at `until_px`.
    pub(super) const fn nines(nines: f64, from_px: f64, until_px: f64) -> Self {
        Self::new(Scale::Nines, 0.0, nines, from_px, until_px)
    }

    /// Where `value` lies, kept within the axis.
    pub(super) fn at(&self, value: f64) -> f64 {
        let (low, high) = (self.low, self.high);
        let part = match self.scale {
            Scale::Linear => (value - low) / (high - low),
            Scale::Logarithmic => (value.max(low) / low).ln() / (high / low).ln(),
            Scale::Nines => -(1.0 - value).max(1e-12).log10() / high,
        };
        self.from_px + part.clamp(0.0, 1.0) * (self.until_px - self.from_px)
    }

    /// Both ends.
    pub(super) const fn ends(&self) -> (f64, f64) {
        (self.low, self.high)
    }

    /// Round values with their words.
    pub(super) fn ticks(&self, unit: Unit) -> Vec<(f64, String)> {
        match self.scale {
            Scale::Linear => self.linear_ticks(unit),
            Scale::Logarithmic => self.decades(unit),
            Scale::Nines => self.nine_ticks(),
        }
    }

    fn linear_ticks(&self, unit: Unit) -> Vec<(f64, String)> {
        let room = ((self.until_px - self.from_px).abs() / 70.0).clamp(2.0, 10.0);
        let rough = (self.high - self.low) / room;
        let base = 10_f64.powf(rough.log10().floor());
        let steps = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * base);
        let step = steps.into_iter().find(|step| *step >= rough);
        let step = step.unwrap_or(10.0 * base);
        let mut ticks = self.stepped(unit, step);
        // Few round values lie between neighbouring ones: one tick alone gives no scale.
        for finer in [2.0, 5.0, 10.0, 20.0] {
            if ticks.len() >= TICKS_MIN {
                break;
            }
            ticks = self.stepped(unit, step / finer);
        }
        ticks
    }

    /// Every multiple of `step` on the axis, with words that tell neighbours apart.
    fn stepped(&self, unit: Unit, step: f64) -> Vec<(f64, String)> {
        let step = if unit == Unit::Count {
            step.max(1.0)
        } else {
            step
        };
        let mut ticks = Vec::new();
        let mut index = (self.low / step - 1e-9).ceil();
        while index * step <= self.high + step * 1e-9 && ticks.len() < 16 {
            let value = index * step;
            ticks.push((value, unit.words_apart(value, step)));
            index += 1.0;
        }
        ticks
    }

    fn decades(&self, unit: Unit) -> Vec<(f64, String)> {
        let ticks = self.within_decades(unit, &[]);
        if ticks.len() >= TICKS_MIN {
            return ticks;
        }
        let finer: [&[f64]; 2] = [
            &[1.0, 2.0, 5.0],
            &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0],
        ];
        for factors in finer {
            let ticks = self.apart(self.within_decades(unit, factors));
            if ticks.len() >= TICKS_MIN {
                return ticks;
            }
        }
        self.linear_ticks(unit)
    }

    /// Those of `ticks` whose words have room beside the one before.
    fn apart(&self, ticks: Vec<(f64, String)>) -> Vec<(f64, String)> {
        let is_upright = self.until_px < self.from_px;
        let room_px = if is_upright { LINE_PX } else { WORDS_PX };
        let mut last_px = f64::NEG_INFINITY;
        let mut kept = ticks;
        kept.retain(|(value, _)| {
            let place_px = (self.at(*value) - self.from_px).abs();
            let has_room = place_px - last_px >= room_px;
            if has_room {
                last_px = place_px;
            }
            has_room
        });
        kept
    }

    fn within_decades(&self, unit: Unit, wanted: &[f64]) -> Vec<(f64, String)> {
        let factors: &[f64] = match (self.high / self.low).log10() {
            _ if !wanted.is_empty() => wanted,
            ..2.0 => &[1.0, 2.0, 5.0],
            2.0..4.0 if (self.until_px - self.from_px).abs() > 400.0 => &[1.0, 3.0],
            _ => &[1.0],
        };
        let mut ticks = Vec::new();
        let mut decade = self.low.log10().floor();
        while decade <= self.high.log10() {
            for factor in factors {
                let value = factor * 10_f64.powf(decade);
                if value >= self.low * 0.999 && value <= self.high * 1.001 {
                    ticks.push((value, unit.words(value, value)));
                }
            }
            decade += 1.0;
        }
        ticks
    }

    fn nine_ticks(&self) -> Vec<(f64, String)> {
        let words = ["0", "90", "99", "99.9", "99.99", "99.999", "99.9999"];
        let mut ticks = vec![(0.5, format!("50{JOINT}%"))];
        for (nines, word) in words.iter().enumerate() {
            let nines = nines as f64;
            if nines <= self.high + 1e-9 {
                ticks.push((1.0 - 10_f64.powf(-nines), format!("{word}{JOINT}%")));
            }
        }
        ticks
    }
}

/// What the numbers of an axis are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unit {
    /// Nanoseconds, written in the unit of their size.
    Nanoseconds,
    /// Seconds after a start.
    Seconds,
    /// Seconds that are a length, written in the unit of their size.
    Length,
    /// A share, written as per cent.
    Share,
    /// A plain number.
    Number,
    /// How many: nothing between two whole numbers is written.
    Count,
}

impl Unit {
    /// Of the words of a summary.
    pub(super) fn of(unit: &str) -> Self {
        match unit {
            "s" => Self::Length,
            "share" => Self::Share,
            "count" => Self::Count,
            _ => Self::Number,
        }
    }

    #[allow(
        clippy::cast_possible_truncation,
        reason = "saturates, and what an axis shows is far from it"
    )]
    pub(super) fn words(self, value: f64, step: f64) -> String {
        match self {
            _ if value.abs() < f64::MIN_POSITIVE => "0".to_owned(),
            Self::Nanoseconds => rounded(&duration(value.round() as i64)),
            Self::Length => rounded(&duration((value * 1e9).round() as i64)),
            Self::Seconds | Self::Number | Self::Count => number(value, step),
            Self::Share => format!("{}{JOINT}%", number(value * 100.0, step * 100.0)),
        }
    }

    /// As [`Self::words`], but with as many digits as tell values apart that differ by `step`.
    fn words_apart(self, value: f64, step: f64) -> String {
        let ns = match self {
            Self::Nanoseconds => 1.0,
            Self::Length => 1e9,
            Self::Seconds | Self::Number | Self::Count | Self::Share => {
                return self.words(value, step);
            }
        };
        let units = [(1e9, "s"), (1e6, "ms"), (1e3, "µs"), (1.0, "ns")];
        let fits = |unit: &&(f64, &str)| value.abs() * ns >= unit.0 * 0.999_999;
        let (scale, word) = units.iter().find(fits).unwrap_or(&units[3]);
        // Three digits are what the words have by themselves.
        if step * ns / scale * 1e3 > value.abs() * ns / scale {
            return self.words(value, step);
        }
        format!(
            "{}{JOINT}{word}",
            number(value * ns / scale, step * ns / scale)
        )
    }
}

/// `1.00 ms` as `1 ms`.
fn rounded(text: &str) -> String {
    match text.split_once(JOINT) {
        Some((number, unit)) if number.contains('.') => {
            let number = number.trim_end_matches('0').trim_end_matches('.');
            format!("{number}{JOINT}{unit}")
        }
        _ => text.to_owned(),
    }
}

/// As many decimals as steps of `step` need.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 0..=9 before"
)]
fn number(value: f64, step: f64) -> String {
    if value.abs() >= 1e6 || (step.abs() < 1e-9 && value.abs() > 0.0) {
        return format!("{value:.2e}");
    }
    let least = (-(step.abs().max(1e-9)).log10() - 1e-9)
        .ceil()
        .clamp(0.0, 9.0) as usize;
    // A step of 0.25 has a digit more than its size.
    let is_exact = |decimals: &usize| {
        let scale = 10_f64.powi(i32::try_from(*decimals).unwrap_or(9));
        (value * scale - (value * scale).round()).abs() < step.abs() * scale * 1e-3
    };
    let decimals = (least..=least + 1).find(is_exact).unwrap_or(least);
    let text = format!("{value:.decimals$}");
    let is_zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
    if is_zero { "0".to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(ticks: &[(f64, String)]) -> Vec<String> {
        ticks
            .iter()
            .map(|(_, word)| word.replace(JOINT, " "))
            .collect()
    }

    #[test]
    fn ticks_are_round_and_within() {
        let axis = Axis::linear(0.0, 61.0, 0.0, 500.0);
        assert_eq!(
            words(&axis.ticks(Unit::Seconds)),
            ["0", "10", "20", "30", "40", "50", "60"]
        );
        let axis = Axis::logarithmic(2e4, 3e7, 0.0, 300.0);
        assert_eq!(
            words(&axis.ticks(Unit::Nanoseconds)),
            ["100 µs", "1 ms", "10 ms"]
        );
        let axis = Axis::nines(3.0, 0.0, 100.0);
        assert_eq!(
            words(&axis.ticks(Unit::Share)),
            ["50 %", "0 %", "90 %", "99 %", "99.9 %"]
        );
        assert_eq!(number(0.25, 0.25), "0.25");
        assert_eq!(number(0.5, 0.25), "0.5");
        let axis = Axis::linear(-0.02, 0.02, 0.0, 140.0);
        assert_eq!(words(&axis.ticks(Unit::Number)), ["-0.02", "0", "0.02"]);
    }

    #[test]
    fn nothing_lies_outside_and_no_span_is_empty() {
        for axis in [
            Axis::linear(5.0, 5.0, 0.0, 100.0),
            Axis::logarithmic(5.0, 5.0, 0.0, 100.0),
            Axis::logarithmic(0.0, 0.0, 0.0, 100.0),
        ] {
            for value in [-1.0, 0.0, 5.0, 1e300] {
                let place = axis.at(value);
                assert!((0.0..=100.0).contains(&place), "{axis:?} {value} {place}");
            }
        }
        assert!((Axis::nines(2.0, 100.0, 0.0).at(0.99) - 0.0).abs() < 1e-6);
        assert!((Axis::nines(2.0, 100.0, 0.0).at(0.0) - 100.0).abs() < 1e-6);
    }
    #[test]
    fn words_do_not_lie_on_each_other() {
        // What a figure has room for, over half a decade and over one and a half.
        for (low, high) in [(18e3, 110e3), (2e4, 7e5), (2e6, 9e6), (15e3, 95e3)] {
            let axis = Axis::logarithmic(low, high, 110.0, 20.0);
            let ticks = axis.ticks(Unit::Nanoseconds);
            assert!(ticks.len() >= TICKS_MIN, "{low} to {high}: {ticks:?}");
            for two in ticks.windows(2) {
                let gap_px = (axis.at(two[0].0) - axis.at(two[1].0)).abs();
                assert!(gap_px >= 12.0, "{low} to {high}: {two:?} {gap_px}");
            }
        }
    }

    #[test]
    fn values_near_each_other_still_have_a_scale() {
        for (low, high) in [
            (4.9e-3, 5.05e-3),
            (5.001e-3, 5.003e-3),
            (0.9e-3, 1.1e-3),
            (7.0, 7.9),
        ] {
            let axes = [
                Axis::linear(low, high, 100.0, 20.0),
                Axis::logarithmic(low, high, 100.0, 20.0),
            ];
            for axis in axes {
                let ticks = axis.ticks(Unit::Length);
                assert!(ticks.len() >= TICKS_MIN, "{low} to {high}: {ticks:?}");
                let mut words: Vec<&String> = ticks.iter().map(|tick| &tick.1).collect();
                words.dedup();
                assert_eq!(words.len(), ticks.len(), "{ticks:?}");
            }
        }
    }
}
