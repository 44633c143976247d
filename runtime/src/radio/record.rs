//! The fixed-size record of a radio: one for each station and sample, and one for each thing that
//! happened to an association.

use bytemuck::{Pod, Zeroable};
use hil_models::record::UNAVAILABLE;

use super::nl80211::{Happening, Rate, Station};

/// A signal that is not known.
pub(crate) const NO_SIGNAL: i32 = i32::MIN;
/// A rate, reason or scheme that is not known.
pub(crate) const NO_RATE: u32 = u32::MAX;
pub(crate) const NO_CODE: u16 = u16::MAX;
pub(crate) const NO_BYTE: u8 = u8::MAX;
/// [`RadioRecord::event`] of a sample.
pub(crate) const SAMPLE: u8 = 0;

/// A rate as recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct RateRecord {
    /// Bits on the air, kbit/s; `u32::MAX` when not known.
    pub kbps: u32,
    /// Channel width, MHz.
    pub width_mhz: u16,
    /// 0 up to 802.11g, 4 802.11n, 5 ac, 6 ax, 7 be.
    pub generation: u8,
    /// Modulation and coding scheme; 255 when there is none.
    pub mcs: u8,
    /// Spatial streams; 255 when not told apart from the scheme.
    pub stream_count: u8,
    /// Zero.
    pub reserved: [u8; 3],
}

/// What a radio said at one time. `i64::MIN` where the driver does not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct RadioRecord {
    /// When it was asked, this host's monotonic clock.
    pub at_ns: i64,
    /// Packets received of the station, since it associated.
    pub rx_packets: i64,
    /// Packets sent to it.
    pub tx_packets: i64,
    /// Frames sent again.
    pub tx_retries: i64,
    /// Packets given up.
    pub tx_failed: i64,
    /// Beacons missed so often that the driver counted a loss.
    pub beacon_losses: i64,
    /// Since anything was heard of it, milliseconds.
    pub inactive_ms: i64,
    /// Since it associated, seconds.
    pub connected_s: i64,
    /// Of the newest packet, dBm; `i32::MIN` when not known.
    pub signal_dbm: i32,
    /// The driver's moving average, dBm; `i32::MIN` when not known.
    pub signal_average_dbm: i32,
    /// The newest rate sent with.
    pub transmit: RateRecord,
    /// The newest rate received with.
    pub receive: RateRecord,
    /// The other radio; zero when an event does not name it.
    pub mac: [u8; 6],
    /// 0 for a sample, else the `NL80211_CMD_*` that told of an event.
    pub event: u8,
    /// Zero.
    pub reserved: u8,
    /// Reason or status of an event; 65535 when it has none.
    pub code: u16,
    /// Zero.
    pub reserved_end: [u8; 6],
}

const _: () = assert!(size_of::<RadioRecord>() == 112);

impl RadioRecord {
    /// A sample of `station`.
    pub(crate) fn sample(at_ns: i64, station: &Station) -> Self {
        let count = |word: Option<u32>| word.map_or(UNAVAILABLE, i64::from);
        let signal = |dbm: Option<i8>| dbm.map_or(NO_SIGNAL, i32::from);
        Self {
            rx_packets: count(station.rx_packets),
            tx_packets: count(station.tx_packets),
            tx_retries: count(station.tx_retries),
            tx_failed: count(station.tx_failed),
            beacon_losses: count(station.beacon_losses),
            inactive_ms: count(station.inactive_ms),
            connected_s: count(station.connected_s),
            signal_dbm: signal(station.signal_dbm),
            signal_average_dbm: signal(station.signal_average_dbm),
            transmit: station.transmit.map_or(RateRecord::NONE, RateRecord::from),
            receive: station.receive.map_or(RateRecord::NONE, RateRecord::from),
            mac: station.mac,
            event: SAMPLE,
            ..Self::nothing(at_ns)
        }
    }

    /// An event.
    pub(crate) fn happening(at_ns: i64, happening: &Happening) -> Self {
        Self {
            mac: happening.mac.unwrap_or_default(),
            event: happening.command,
            code: happening.code.unwrap_or(NO_CODE),
            ..Self::nothing(at_ns)
        }
    }

    const fn nothing(at_ns: i64) -> Self {
        Self {
            at_ns,
            rx_packets: UNAVAILABLE,
            tx_packets: UNAVAILABLE,
            tx_retries: UNAVAILABLE,
            tx_failed: UNAVAILABLE,
            beacon_losses: UNAVAILABLE,
            inactive_ms: UNAVAILABLE,
            connected_s: UNAVAILABLE,
            signal_dbm: NO_SIGNAL,
            signal_average_dbm: NO_SIGNAL,
            transmit: RateRecord::NONE,
            receive: RateRecord::NONE,
            mac: [0; 6],
            event: SAMPLE,
            reserved: 0,
            code: NO_CODE,
            reserved_end: [0; 6],
        }
    }
}

impl RateRecord {
    const NONE: Self = Self {
        kbps: NO_RATE,
        width_mhz: 0,
        generation: 0,
        mcs: NO_BYTE,
        stream_count: NO_BYTE,
        reserved: [0; 3],
    };

    /// How it is modulated, in words; `None` when no rate is known.
    pub(crate) fn modulation(&self) -> Option<String> {
        if self.kbps == NO_RATE && self.mcs == NO_BYTE {
            return None;
        }
        let generation = match self.generation {
            4 => "HT",
            5 => "VHT",
            6 => "HE",
            7 => "EHT",
            _ => "legacy",
        };
        let mut text = generation.to_owned();
        if self.mcs != NO_BYTE {
            let words = format!(" MCS {}", self.mcs);
            text.push_str(&words);
        }
        if self.stream_count != NO_BYTE {
            let words = format!(", {} spatial streams", self.stream_count);
            text.push_str(&words);
        }
        let words = format!(", {} MHz", self.width_mhz);
        text.push_str(&words);
        Some(text)
    }
}

impl From<Rate> for RateRecord {
    fn from(rate: Rate) -> Self {
        Self {
            kbps: rate.kbps.unwrap_or(NO_RATE),
            width_mhz: rate.width_mhz,
            generation: rate.generation as u8,
            mcs: rate.mcs.unwrap_or(NO_BYTE),
            stream_count: rate.stream_count.unwrap_or(NO_BYTE),
            reserved: [0; 3],
        }
    }
}
