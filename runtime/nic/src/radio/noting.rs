//! From what the wireless subsystem says to the records of a radio.

use hil_core::record::UNAVAILABLE;

use super::nl80211::{Happening, Rate, Station};
use hil_rundir::radio_record::{
    NO_BYTE, NO_CODE, NO_RATE, NO_SIGNAL, RadioRecord, RateRecord, SAMPLE,
};

/// A sample of `station`.
pub(super) fn sample(at_ns: i64, station: &Station) -> RadioRecord {
    let count = |word: Option<u32>| word.map_or(UNAVAILABLE, i64::from);
    let signal = |dbm: Option<i8>| dbm.map_or(NO_SIGNAL, i32::from);
    RadioRecord {
        rx_packets: count(station.rx_packets),
        tx_packets: count(station.tx_packets),
        tx_retries: count(station.tx_retries),
        tx_failed: count(station.tx_failed),
        beacon_losses: count(station.beacon_losses),
        inactive_ms: count(station.inactive_ms),
        connected_s: count(station.connected_s),
        signal_dbm: signal(station.signal_dbm),
        signal_average_dbm: signal(station.signal_average_dbm),
        transmit: station.transmit.map_or(RateRecord::NONE, rate),
        receive: station.receive.map_or(RateRecord::NONE, rate),
        mac: station.mac,
        event: SAMPLE,
        ..RadioRecord::nothing(at_ns)
    }
}

/// An event.
pub(super) fn happening(at_ns: i64, happening: &Happening) -> RadioRecord {
    RadioRecord {
        mac: happening.mac.unwrap_or_default(),
        event: happening.command,
        code: happening.code.unwrap_or(NO_CODE),
        ..RadioRecord::nothing(at_ns)
    }
}

fn rate(rate: Rate) -> RateRecord {
    RateRecord {
        kbps: rate.kbps.unwrap_or(NO_RATE),
        width_mhz: rate.width_mhz,
        generation: rate.generation as u8,
        mcs: rate.mcs.unwrap_or(NO_BYTE),
        stream_count: rate.stream_count.unwrap_or(NO_BYTE),
        reserved: [0; 3],
    }
}
