//! What a Wi-Fi 6 link is told: every number with its unit, its range and what it stands for, in
//! one table that the checks and the readers of files share. It computes nothing.

use core::time::Duration;

use crate::outages::Outages;
use crate::wifi::phy::PPDU_MAX_NS;
use crate::wifi::{channel, contention};
use hil_core::case_study::ParameterError;
use hil_core::{options, words};

words! {
    /// EDCA access category, which decides how long a frame defers (IEEE 802.11-2020, 10.23.2).
    #[derive(Default)]
    pub enum AccessCategory {
        /// `AC_BK`.
        Background = "background",
        /// `AC_BE`: what a datagram without a code point gets.
        #[default]
        BestEffort = "best-effort",
        /// `AC_VI`.
        Video = "video",
        /// `AC_VO`.
        Voice = "voice",
    }
}

words! {
    /// Which direction's receiver dozes between beacons, so that its frames wait at the access point.
    #[derive(Default)]
    pub enum PowerSave {
        /// None: both ends stay awake.
        #[default]
        Off = "off",
        /// The receiver of the link's forward direction.
        Forward = "forward",
        /// The receiver of the link's backward direction.
        Backward = "backward",
    }
}

/// Those of the preset that is the default.
const SHORT_RANGE_OUTAGES: Outages = Outages {
    mean_s: 0.5,
    per_hour: 100.0,
    buffered: false,
};

options! {
    /// A Wi-Fi 6 link between two stations. The defaults are the preset `wifi6-short-range`.
    #[derive(Copy)]
    pub struct WifiSpec as short {
        /// Distance of the two radios, m.
        distance_m: f64 = 20.0, in 1.0..=300.0;
        /// Walls between them.
        wall_count: u32 = 1, in 0..=20;
        /// Loss of one wall, dB.
        wall_loss_db: f64 = 7.0, in 0.0..=40.0;
        /// Centre frequency, MHz.
        frequency_mhz: f64 = 5500.0, in 5150.0..=7125.0;
        /// Channel width, 20, 40, 80 or 160 MHz.
        channel_width_mhz: u32 = 80, in 20..=160;
        /// Spatial streams, 1 or 2.
        stream_count: u32 = 2, in 1..=2;
        /// Guard interval of data symbols, 0.8, 1.6 or 3.2 µs.
        guard_interval_us: f64 = 0.8, in 0.8..=3.2;
        /// Transmit power with both antenna gains, less losses of cables, dBm.
        tx_power_dbm: f64 = 23.0, in -20.0..=40.0;
        /// Noise figure of the receiver, dB.
        noise_figure_db: f64 = 7.0, in 0.0..=20.0;
        /// Up to here the path loss grows as `exponent_near`, m.
        breakpoint_m: f64 = 10.0, in 1.0..=300.0;
        /// Path loss exponent up to the break point; 2 is free space.
        exponent_near: f64 = 2.0, in 1.0..=6.0;
        /// Path loss exponent beyond it.
        exponent_far: f64 = 3.5, in 1.0..=6.0;
        /// Standard deviation of the slow log-normal variation, dB; 0 for none.
        shadowing_db: f64 = 3.0, in 0.0..=12.0;
        /// Time in which its autocorrelation falls to 1/e, s.
        shadowing_correlation_s: f64 = 10.0, in 1.0..=3600.0;
        /// Shape of the Nakagami fading of one attempt: 1 is Rayleigh, larger is milder; 0 for none.
        fading_m: f64 = 4.0, in 0.0..=100.0;
        /// A fade lasts so long, ms.
        fading_coherence_ms: f64 = 20.0, in 1.0..=10_000.0;
        /// Steepness of the packet error rate over the signal-to-noise ratio, per dB.
        error_slope_per_db: f64 = 3.0, in 0.2..=20.0;
        /// The sender's rate needs so much more than the rate's threshold, dB.
        rate_margin_db: f64 = 3.0, in 0.0..=20.0;
        /// Highest modulation and coding scheme, 0 to 11.
        mcs_max: u32 = 11, in 0..=11;
        /// Attempts at one rate before the next lower.
        attempts_per_rate: u32 = 2, in 1..=16;
        /// Attempts until a frame is given up.
        attempt_limit: u32 = 7, in 1..=16;
        /// Access category of the link's frames.
        access_category: AccessCategory = AccessCategory::BestEffort;
        /// Other stations that contend for the medium.
        contender_count: u32 = 5, in 0..=64;
        /// Share of the time the medium is busy with their frames.
        busy_ratio: f64 = 0.3, in 0.0..=0.99;
        /// Mean of one of their busy periods, exponential, µs.
        busy_mean_us: f64 = 1000.0, in 50.0..=6000.0;
        /// No attempt begins so long after the frame was offered: it is given up, ms.
        lifetime_ms: f64 = 512.0, in 1.0..=10_000.0;
        /// What drivers and bridges take besides, µs.
        forwarding_us: f64 = 200.0, in 0.0..=100_000.0;
        /// Which receiver dozes.
        power_save: PowerSave = PowerSave::Off;
        /// Time between beacons, ms.
        beacon_interval_ms: f64 = 102.4, in 10.24..=1024.0;
        /// A dozing receiver listens to every n-th beacon.
        listen_interval: u32 = 1, in 1..=100;
        /// It dozes after so long without a frame, ms.
        awake_ms: f64 = 100.0, in 0.0..=60_000.0;
        /// When nothing gets through: roaming, channel switches, interference.
        outages: Outages = SHORT_RANGE_OUTAGES;
    }
    check WifiSpec::check_fit;
}

impl WifiSpec {
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
            self.settled(snr_db),
            self.mcs_max,
            self.attempt_limit,
            self.lifetime_ms,
            self.power_save.word(),
        )
    }

    /// Numbers of which only some are allowed, and what so many stations can do to the medium.
    fn check_fit(&self) -> Result<(), ParameterError> {
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
    use hil_core::options::{Options, Setting, Shape, Slot};

    #[test]
    fn every_number_is_refused_by_name_on_both_sides_of_its_range() {
        let base = WifiSpec::default();
        assert_eq!(base.check(), Ok(()));
        let count = WifiSpec::default().fields().len();
        for index in 0..count {
            for side in 0..3 {
                let mut spec = base;
                if let Some(key) = put_outside(&mut spec, index, side) {
                    assert_eq!(spec.check().unwrap_err().key, key, "{side}");
                }
            }
        }
    }

    /// Puts the option at `index` below its range, above it, or to what is no number; its key, if that
    /// can be.
    fn put_outside(spec: &mut WifiSpec, index: usize, side: usize) -> Option<&'static str> {
        let field = spec.fields().swap_remove(index);
        let Slot::Value(mut value, shape) = field.slot else {
            return None;
        };
        let outside = match shape {
            Shape::Number(range) => {
                Setting::Number([range.start() - 1e-3, range.end() + 1e-3, f64::NAN][side])
            }
            Shape::Integer(range) if side < 2 => {
                Setting::Integer([range.start() - 1, range.end() + 1][side])
            }
            _ => return None,
        };
        // A count cannot hold what is below zero.
        value.set(outside).ok().map(|()| field.key)
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
        assert_eq!(
            refused(|spec| spec.outages.per_hour = -1.0),
            "outages.per_hour"
        );
    }
}
