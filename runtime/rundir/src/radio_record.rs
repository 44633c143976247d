//! The fixed-size record of a radio: one for each station and sample, and one for each thing that
//! happened to an association.

use bytemuck::{Pod, Zeroable};
use hil_core::record::UNAVAILABLE;

/// A signal that is not known.
pub const NO_SIGNAL: i32 = i32::MIN;
/// A rate, reason or scheme that is not known.
pub const NO_RATE: u32 = u32::MAX;
/// A reason that is not known.
pub const NO_CODE: u16 = u16::MAX;
/// A scheme that is not known.
pub const NO_BYTE: u8 = u8::MAX;
/// [`RadioRecord::event`] of a sample.
pub const SAMPLE: u8 = 0;

/// Values of [`RadioRecord::event`] and commands of the wireless subsystem: `NL80211_CMD_*` of
/// `linux/nl80211.h`.
pub mod command {
    /// `NL80211_CMD_GET_INTERFACE`.
    pub const GET_INTERFACE: u8 = 5;
    /// `NL80211_CMD_GET_STATION`.
    pub const GET_STATION: u8 = 17;
    /// `NL80211_CMD_NEW_STATION`.
    pub const NEW_STATION: u8 = 19;
    /// `NL80211_CMD_DEL_STATION`.
    pub const DEL_STATION: u8 = 20;
    /// `NL80211_CMD_DEAUTHENTICATE`.
    pub const DEAUTHENTICATE: u8 = 39;
    /// `NL80211_CMD_DISASSOCIATE`.
    pub const DISASSOCIATE: u8 = 40;
    /// `NL80211_CMD_CONNECT`.
    pub const CONNECT: u8 = 46;
    /// `NL80211_CMD_ROAM`.
    pub const ROAM: u8 = 47;
    /// `NL80211_CMD_DISCONNECT`.
    pub const DISCONNECT: u8 = 48;
    /// `NL80211_CMD_GET_POWER_SAVE`.
    pub const GET_POWER_SAVE: u8 = 62;
    /// `NL80211_CMD_NOTIFY_CQM`.
    pub const NOTIFY_CQM: u8 = 64;
}

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
    /// A record of `at_ns` in which nothing is known.
    pub const fn nothing(at_ns: i64) -> Self {
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
    /// A rate of which nothing is known.
    pub const NONE: Self = Self {
        kbps: NO_RATE,
        width_mhz: 0,
        generation: 0,
        mcs: NO_BYTE,
        stream_count: NO_BYTE,
        reserved: [0; 3],
    };

    /// How it is modulated, in words; `None` when no rate is known.
    pub fn modulation(&self) -> Option<String> {
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
        let known = |value: u8, text: String| {
            if value == NO_BYTE {
                String::new()
            } else {
                text
            }
        };
        let mcs = known(self.mcs, format!(" MCS {}", self.mcs));
        let streams = format!(", {} spatial streams", self.stream_count);
        let streams = known(self.stream_count, streams);
        Some(format!(
            "{generation}{mcs}{streams}, {} MHz",
            self.width_mhz
        ))
    }
}
