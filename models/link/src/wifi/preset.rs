//! The two wireless links of the seed paper (Lv et al., section III.A) as presets. What in them is
//! from a standard, what is assumed and what is fitted is told in docs/wifi-model.md, number by
//! number. They are no measurement of those routers.

use crate::outages::Outages;
use crate::wifi::spec::{AccessCategory, PowerSave, WifiSpec};

/// A link by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WifiPreset {
    /// Two routers, 20 m apart, in adjacent laboratory areas.
    ShortRange,
    /// Two routers, 35 m apart, the second at the end of the corridor.
    LongRange,
}

impl WifiPreset {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::ShortRange, Self::LongRange];

    /// Its name in files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ShortRange => "wifi6-short-range",
            Self::LongRange => "wifi6-long-range",
        }
    }

    /// The preset of that name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|preset| preset.name() == name)
    }

    /// Its numbers.
    pub const fn spec(self) -> WifiSpec {
        match self {
            Self::ShortRange => SHORT_RANGE,
            Self::LongRange => LONG_RANGE,
        }
    }
}

const SHORT_RANGE: WifiSpec = WifiSpec {
    distance_m: 20.0,
    wall_count: 1,
    wall_loss_db: 7.0,
    frequency_mhz: 5500.0,
    channel_width_mhz: 80,
    stream_count: 2,
    guard_interval_us: 0.8,
    tx_power_dbm: 23.0,
    noise_figure_db: 7.0,
    breakpoint_m: 10.0,
    exponent_near: 2.0,
    exponent_far: 3.5,
    shadowing_db: 3.0,
    shadowing_correlation_s: 10.0,
    fading_m: 4.0,
    fading_coherence_ms: 20.0,
    error_slope_per_db: 3.0,
    rate_margin_db: 3.0,
    mcs_max: 11,
    attempts_per_rate: 2,
    attempt_limit: 7,
    access_category: AccessCategory::BestEffort,
    contender_count: 5,
    busy_ratio: 0.3,
    busy_mean_us: 1000.0,
    lifetime_ms: 512.0,
    forwarding_us: 200.0,
    power_save: PowerSave::Off,
    beacon_interval_ms: 102.4,
    listen_interval: 1,
    awake_ms: 100.0,
    outages: Outages {
        mean_s: 0.5,
        per_hour: 100.0,
        buffered: false,
    },
};

/// Farther, behind one more wall, and more often interrupted; else the same routers.
const LONG_RANGE: WifiSpec = WifiSpec {
    distance_m: 35.0,
    wall_count: 2,
    outages: Outages {
        per_hour: 300.0,
        ..SHORT_RANGE.outages
    },
    ..SHORT_RANGE
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_preset_is_sound_and_found_by_its_name() {
        for preset in WifiPreset::ALL {
            assert_eq!(preset.spec().check(), Ok(()));
            assert_eq!(WifiPreset::named(preset.name()), Some(preset));
        }
        assert_eq!(WifiPreset::named("wifi7"), None);
    }
}
