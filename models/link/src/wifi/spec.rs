//! What a Wi-Fi 6 link is told: every number with its unit, its range and what it stands for, in
//! one table that the checks and the readers of files share. It computes nothing.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use crate::outages::Outages;
use crate::wifi::phy::PPDU_MAX_NS;
use crate::wifi::preset::WifiPreset;
use crate::wifi::rate::Rates;
use crate::wifi::{channel, contention};
use hil_core::case_study::ParameterError;

/// EDCA access category, which decides how long a frame defers (IEEE 802.11-2020, 10.23.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AccessCategory {
    /// `AC_BK`.
    Background,
    /// `AC_BE`: what a datagram without a code point gets.
    #[default]
    BestEffort,
    /// `AC_VI`.
    Video,
    /// `AC_VO`.
    Voice,
}

/// Which direction's receiver dozes between beacons, so that its frames wait at the access point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PowerSave {
    /// None: both ends stay awake.
    #[default]
    Off,
    /// The receiver of the link's forward direction.
    Forward,
    /// The receiver of the link's backward direction.
    Backward,
}

impl AccessCategory {
    /// Each with its word in files.
    pub const WORDS: &[(&'static str, Self)] = &[
        ("background", Self::Background),
        ("best-effort", Self::BestEffort),
        ("video", Self::Video),
        ("voice", Self::Voice),
    ];

    /// Its word in files.
    pub fn word(self) -> &'static str {
        word_of(Self::WORDS, &self)
    }
}

impl PowerSave {
    /// Each with its word in files.
    pub const WORDS: &[(&'static str, Self)] = &[
        ("off", Self::Off),
        ("forward", Self::Forward),
        ("backward", Self::Backward),
    ];

    /// Its word in files.
    pub fn word(self) -> &'static str {
        word_of(Self::WORDS, &self)
    }
}

fn word_of<T: PartialEq>(words: &[(&'static str, T)], value: &T) -> &'static str {
    let found = words.iter().find(|(_, known)| known == value);
    found.expect("every variant has its word").0
}

/// A Wi-Fi 6 link between two stations. Missing keys are those of `wifi6-short-range`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WifiSpec {
    /// Distance of the two radios, m.
    pub distance_m: f64,
    /// Walls between them.
    pub wall_count: u32,
    /// Loss of one wall, dB.
    pub wall_loss_db: f64,
    /// Centre frequency, MHz.
    pub frequency_mhz: f64,
    /// Channel width, 20, 40, 80 or 160 MHz.
    pub channel_width_mhz: u32,
    /// Spatial streams, 1 or 2.
    pub stream_count: u32,
    /// Guard interval of data symbols, 0.8, 1.6 or 3.2 µs.
    pub guard_interval_us: f64,
    /// Transmit power with both antenna gains, less losses of cables, dBm.
    pub tx_power_dbm: f64,
    /// Noise figure of the receiver, dB.
    pub noise_figure_db: f64,
    /// Up to here the path loss grows as `exponent_near`, m.
    pub breakpoint_m: f64,
    /// Path loss exponent up to the break point; 2 is free space.
    pub exponent_near: f64,
    /// Path loss exponent beyond it.
    pub exponent_far: f64,
    /// Standard deviation of the slow log-normal variation, dB; 0 for none.
    pub shadowing_db: f64,
    /// Time in which its autocorrelation falls to 1/e, s.
    pub shadowing_correlation_s: f64,
    /// Shape of the Nakagami fading of one attempt: 1 is Rayleigh, larger is milder; 0 for none.
    pub fading_m: f64,
    /// A fade lasts so long, ms.
    pub fading_coherence_ms: f64,
    /// Steepness of the packet error rate over the signal-to-noise ratio, per dB.
    pub error_slope_per_db: f64,
    /// The sender's rate needs so much more than the rate's threshold, dB.
    pub rate_margin_db: f64,
    /// Highest modulation and coding scheme, 0 to 11.
    pub mcs_max: u32,
    /// Attempts at one rate before the next lower.
    pub attempts_per_rate: u32,
    /// Attempts until a frame is given up.
    pub attempt_limit: u32,
    /// Access category of the link's frames.
    pub access_category: AccessCategory,
    /// Other stations that contend for the medium.
    pub contender_count: u32,
    /// Share of the time the medium is busy with their frames.
    pub busy_ratio: f64,
    /// Mean of one of their busy periods, exponential, µs.
    pub busy_mean_us: f64,
    /// No attempt begins so long after the frame was offered: it is given up, ms.
    pub lifetime_ms: f64,
    /// What drivers and bridges take besides, µs.
    pub forwarding_us: f64,
    /// Which receiver dozes.
    pub power_save: PowerSave,
    /// Time between beacons, ms.
    pub beacon_interval_ms: f64,
    /// A dozing receiver listens to every n-th beacon.
    pub listen_interval: u32,
    /// It dozes after so long without a frame, ms.
    pub awake_ms: f64,
    /// When nothing gets through: roaming, channel switches, interference.
    pub outages: Outages,
}

impl Default for WifiSpec {
    fn default() -> Self {
        WifiPreset::ShortRange.spec()
    }
}

/// One number of a [`WifiSpec`].
#[derive(Debug, Clone, Copy)]
pub struct WifiField {
    /// Its key, with the unit at its end.
    pub key: &'static str,
    /// Lowest allowed value.
    pub low: f64,
    /// Highest allowed value.
    pub high: f64,
    /// True for counts.
    pub is_integer: bool,
    /// Reads it.
    pub get: fn(&WifiSpec) -> f64,
    /// Writes it; a count is cut to a whole number.
    pub set: fn(&mut WifiSpec, f64),
}

impl WifiField {
    /// The range in words.
    pub fn range_text(&self) -> String {
        format!("{} to {}", self.low, self.high)
    }
}

macro_rules! real {
    ($key:ident, $low:expr, $high:expr) => {
        WifiField {
            key: stringify!($key),
            low: $low,
            high: $high,
            is_integer: false,
            get: |spec| spec.$key,
            set: |spec, value| spec.$key = value,
        }
    };
}

macro_rules! count {
    ($key:ident, $low:expr, $high:expr) => {
        WifiField {
            key: stringify!($key),
            low: $low,
            high: $high,
            is_integer: true,
            get: |spec| f64::from(spec.$key),
            set: |spec, value| spec.$key = whole(value),
        }
    };
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to the range of the type"
)]
fn whole(value: f64) -> u32 {
    value.clamp(0.0, f64::from(u32::MAX)) as u32
}

/// Every number of a [`WifiSpec`] but those of its outages, in the order of the struct.
pub const WIFI_FIELDS: [WifiField; 29] = [
    real!(distance_m, 1.0, 300.0),
    count!(wall_count, 0.0, 20.0),
    real!(wall_loss_db, 0.0, 40.0),
    real!(frequency_mhz, 5150.0, 7125.0),
    count!(channel_width_mhz, 20.0, 160.0),
    count!(stream_count, 1.0, 2.0),
    real!(guard_interval_us, 0.8, 3.2),
    real!(tx_power_dbm, -20.0, 40.0),
    real!(noise_figure_db, 0.0, 20.0),
    real!(breakpoint_m, 1.0, 300.0),
    real!(exponent_near, 1.0, 6.0),
    real!(exponent_far, 1.0, 6.0),
    real!(shadowing_db, 0.0, 12.0),
    real!(shadowing_correlation_s, 1.0, 3600.0),
    real!(fading_m, 0.0, 100.0),
    real!(fading_coherence_ms, 1.0, 10_000.0),
    real!(error_slope_per_db, 0.2, 20.0),
    real!(rate_margin_db, 0.0, 20.0),
    count!(mcs_max, 0.0, 11.0),
    count!(attempts_per_rate, 1.0, 16.0),
    count!(attempt_limit, 1.0, 16.0),
    count!(contender_count, 0.0, 64.0),
    real!(busy_ratio, 0.0, 0.99),
    real!(busy_mean_us, 50.0, 6000.0),
    real!(lifetime_ms, 1.0, 10_000.0),
    real!(forwarding_us, 0.0, 100_000.0),
    real!(beacon_interval_ms, 10.24, 1024.0),
    count!(listen_interval, 1.0, 100.0),
    real!(awake_ms, 0.0, 60_000.0),
];

impl WifiSpec {
    /// Checks every number against its range, and those that must fit each other.
    ///
    /// # Errors
    /// The first key outside its range, with the value and the range.
    pub fn check(&self) -> Result<(), ParameterError> {
        for field in &WIFI_FIELDS {
            let range = field.low..=field.high;
            ParameterError::check(field.key, (field.get)(self), range, &field.range_text())?;
        }
        self.check_words()?;
        self.check_contention()?;
        self.outages.check()
    }

    /// How long a message is under way at most: its last attempt begins within the lifetime and
    /// lasts no longer than a PPDU may.
    pub fn flight_time_max(&self) -> Duration {
        const LAST: Duration = Duration::from_nanos(PPDU_MAX_NS.unsigned_abs());
        Duration::from_secs_f64(1e-3 * self.lifetime_ms + 1e-6 * self.forwarding_us) + LAST
    }

    /// The link in words, with what follows from its numbers.
    pub fn describe(&self) -> String {
        let snr_db = channel::median_snr_db(self);
        let contenders = match self.contender_count {
            0 => "nobody else".to_owned(),
            count => format!("{count} others, {} % busy", 100.0 * self.busy_ratio),
        };
        format!(
            "Wi-Fi 6 over {} m and {} walls, {} MHz, {} streams, signal-to-noise ratio {snr_db:.1} \
             dB, settles on MCS {} of {}, {contenders}, {} attempts within {} ms, power save {}",
            self.distance_m,
            self.wall_count,
            self.channel_width_mhz,
            self.stream_count,
            Rates::new(self).settled(snr_db),
            self.mcs_max,
            self.attempt_limit,
            self.lifetime_ms,
            self.power_save.word(),
        )
    }

    /// Numbers of which only some are allowed.
    fn check_words(&self) -> Result<(), ParameterError> {
        let refuse = |key: &str, problem: String| Err(ParameterError::new(key, problem));
        if !matches!(self.channel_width_mhz, 20 | 40 | 80 | 160) {
            let problem = format!("{} is none of 20, 40, 80, 160", self.channel_width_mhz);
            return refuse("channel_width_mhz", problem);
        }
        let interval_us = self.guard_interval_us;
        if ![0.8, 1.6, 3.2].contains(&interval_us) {
            let problem = format!("{interval_us} is none of 0.8, 1.6, 3.2");
            return refuse("guard_interval_us", problem);
        }
        if self.fading_m > 0.0 && self.fading_m < 0.5 {
            let problem = format!(
                "{} is neither 0, for no fading, nor within 0.5 to 100",
                self.fading_m
            );
            return refuse("fading_m", problem);
        }
        Ok(())
    }

    /// So many stations can keep the medium only so busy.
    fn check_contention(&self) -> Result<(), ParameterError> {
        let most = contention::saturated_busy_ratio(self);
        if self.busy_ratio > most {
            let problem = format!(
                "{} is more than {most:.3}, which {} stations with busy periods of {} µs reach when \
                 each always has a frame to send",
                self.busy_ratio, self.contender_count, self.busy_mean_us
            );
            return Err(ParameterError::new("busy_ratio", problem));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_is_refused_by_name_on_both_sides_of_its_range() {
        let base = WifiSpec::default();
        assert_eq!(base.check(), Ok(()));
        for field in &WIFI_FIELDS {
            let step = if field.is_integer { 1.0 } else { 1e-3 };
            for value in [field.low - step, field.high + step, f64::NAN] {
                let mut spec = base;
                (field.set)(&mut spec, value);
                // A count cannot hold what is below zero or no number.
                if (field.get)(&spec) < field.low || (field.get)(&spec) > field.high {
                    assert_eq!(spec.check().unwrap_err().key, field.key, "{value}");
                }
            }
        }
    }

    #[test]
    fn numbers_that_do_not_fit_each_other_are_refused_by_name() {
        let refused = |change: fn(&mut WifiSpec)| {
            let mut spec = WifiSpec::default();
            change(&mut spec);
            spec.check().unwrap_err().key
        };
        assert_eq!(
            refused(|spec| spec.channel_width_mhz = 60),
            "channel_width_mhz"
        );
        assert_eq!(
            refused(|spec| spec.guard_interval_us = 1.0),
            "guard_interval_us"
        );
        assert_eq!(refused(|spec| spec.fading_m = 0.2), "fading_m");
        assert_eq!(refused(|spec| spec.contender_count = 0), "busy_ratio");
        assert_eq!(refused(|spec| spec.distance_m = f64::NAN), "distance_m");
        assert_eq!(refused(|spec| spec.outages.per_hour = -1.0), "per_hour");
    }
}
