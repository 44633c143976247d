//! Airtime of one frame exchange: an HE single-user PPDU, a short gap and its acknowledgement.
//! It knows no channel and no contention.
//!
//! Durations and rates are those of IEEE Std 802.11ax-2021, clause 27 (HE PHY: timing constants of
//! 27.3, TXTIME of 27.4, parameters of the HE-MCSs of 27.5) and of IEEE Std 802.11-2020, clause 17
//! (OFDM PHY: slot, SIFS, and the control responses), in the 5 and 6 GHz bands.

use crate::wifi::spec::WifiSpec;

/// aSlotTime of the OFDM PHY, 20 MHz spacing.
pub(crate) const SLOT_NS: i64 = 9_000;
/// aSIFSTime of the OFDM PHY, 20 MHz spacing.
pub(crate) const SIFS_NS: i64 = 16_000;
/// aPPDUMaxTime: no PPDU lasts longer.
pub(crate) const PPDU_MAX_NS: i64 = 5_484_000;

/// Number of HE modulation and coding schemes.
pub(crate) const MCS_COUNT: usize = 12;

/// Coded bits per subcarrier, and code rate as a fraction, of each HE-MCS.
const MODULATION: [(u32, u32, u32); MCS_COUNT] = [
    (1, 1, 2),
    (2, 1, 2),
    (2, 3, 4),
    (4, 1, 2),
    (4, 3, 4),
    (6, 2, 3),
    (6, 3, 4),
    (6, 5, 6),
    (8, 3, 4),
    (8, 5, 6),
    (10, 3, 4),
    (10, 5, 6),
];

/// L-STF 8, L-LTF 8, L-SIG 4, RL-SIG 4, HE-SIG-A 8 and HE-STF 4 µs.
const PREAMBLE_NS: i64 = 36_000;
/// An HE-LTF symbol of twofold length without its guard interval.
const TRAINING_NS: i64 = 6_400;
/// A data symbol without its guard interval.
const SYMBOL_NS: i64 = 12_800;
/// Packet extension; the longest is assumed, as wide channels at high rates need it.
const EXTENSION_NS: i64 = 16_000;
/// SERVICE field. LDPC coding has no tail.
const SERVICE_BITS: u64 = 16;

/// An acknowledgement's preamble and SIGNAL field, and its symbols (clause 17, 20 MHz).
const LEGACY_PREAMBLE_NS: i64 = 20_000;
const LEGACY_SYMBOL_NS: i64 = 4_000;
/// Compressed Block Ack; what answers an A-MPDU (10.25.6). SERVICE and tail are 22 bits.
const BLOCK_ACK_BITS: u64 = 22 + 8 * 32;

/// Largest payload of one Ethernet-sized IP packet behind its header.
const IP_PAYLOAD_BYTES: u64 = 1480;
const UDP_HEADER_BYTES: u64 = 8;
/// Per packet: A-MPDU delimiter 4, `QoS` data header with four addresses 32, CCMP 16, LLC 8, IPv4
/// 20, FCS 4, padding 2 on average.
const PACKET_OVERHEAD_BYTES: u64 = 4 + 32 + 16 + 8 + 20 + 4 + 2;

/// The PHY of one link.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Phy {
    /// Data bits of a symbol at each scheme.
    data_bits: [u64; MCS_COUNT],
    /// Block Ack at each scheme.
    response_ns: [i64; MCS_COUNT],
    head_ns: i64,
    symbol_ns: i64,
    part_max_bytes: u64,
}

impl Phy {
    pub(crate) fn new(spec: &WifiSpec) -> Self {
        let subcarriers = data_subcarriers(spec.channel_width_mhz);
        let data_bits = MODULATION
            .map(|(bits, up, down)| u64::from(subcarriers * bits * spec.stream_count * up / down));
        let guard_ns = nanoseconds(spec.guard_interval_us * 1e3);
        // An HE-LTF has the guard interval of the data, and there is one per stream.
        let head_ns = PREAMBLE_NS + i64::from(spec.stream_count) * (TRAINING_NS + guard_ns);
        let mut phy = Self {
            data_bits,
            response_ns: core::array::from_fn(response_ns),
            head_ns,
            symbol_ns: SYMBOL_NS + guard_ns,
            part_max_bytes: 0,
        };
        let symbols = (PPDU_MAX_NS - head_ns - EXTENSION_NS) / phy.symbol_ns;
        phy.part_max_bytes = (symbols.unsigned_abs() * data_bits[0] - SERVICE_BITS) / 8;
        phy
    }

    /// Bytes on the air for a UDP payload of `length_bytes`, cut into IP packets where it must be.
    pub(crate) fn air_bytes(length_bytes: usize) -> u64 {
        let datagram = length_bytes as u64 + UDP_HEADER_BYTES;
        datagram + datagram.div_ceil(IP_PAYLOAD_BYTES) * PACKET_OVERHEAD_BYTES
    }

    /// PPDUs that carry so many bytes, each of which may last [`PPDU_MAX_NS`] at the lowest rate.
    pub(crate) fn part_count(&self, air_bytes: u64) -> u64 {
        air_bytes.div_ceil(self.part_max_bytes).max(1)
    }

    /// How long a PPDU of `air_bytes` lasts at the scheme `mcs`.
    pub(crate) fn ppdu_ns(&self, mcs: usize, air_bytes: u64) -> i64 {
        let symbols = (8 * air_bytes + SERVICE_BITS).div_ceil(self.data_bits[mcs]);
        self.head_ns + symbols.cast_signed() * self.symbol_ns + EXTENSION_NS
    }

    /// Gap and Block Ack after a PPDU at the scheme `mcs`; without an answer, the sender waits as
    /// long.
    pub(crate) fn response_ns(&self, mcs: usize) -> i64 {
        self.response_ns[mcs]
    }
}

/// `N_SD` of a full-width resource unit (27.5).
const fn data_subcarriers(channel_width_mhz: u32) -> u32 {
    match channel_width_mhz {
        20 => 234,
        40 => 468,
        80 => 980,
        _ => 1960,
    }
}

/// A response goes at the highest of the basic rates 6, 12, 24 Mbit/s that the reference rate of
/// the data reaches (802.11-2020, 10.6.6.5).
const fn response_ns(mcs: usize) -> i64 {
    let bits_per_symbol = match mcs {
        0 => 24,
        1 | 2 => 48,
        _ => 96,
    };
    let symbols = BLOCK_ACK_BITS.div_ceil(bits_per_symbol);
    SIFS_NS + LEGACY_PREAMBLE_NS + symbols.cast_signed() * LEGACY_SYMBOL_NS
}

/// Rounds to a whole nanosecond; what is beyond an `i64` saturates.
#[allow(clippy::cast_possible_truncation, reason = "saturates")]
pub(crate) fn nanoseconds(ns: f64) -> i64 {
    ns.round() as i64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data rate, Mbit/s.
    fn rate_mbps(phy: &Phy, mcs: usize) -> f64 {
        phy.data_bits[mcs] as f64 * 1e3 / phy.symbol_ns as f64
    }

    fn phy(channel_width_mhz: u32, stream_count: u32, guard_interval_us: f64) -> Phy {
        Phy::new(&WifiSpec {
            channel_width_mhz,
            stream_count,
            guard_interval_us,
            ..WifiSpec::default()
        })
    }

    #[test]
    fn data_rates_are_those_of_the_tables_of_clause_27_5() {
        // Mbit/s of one stream, guard interval 0.8 µs, rounded as printed.
        let printed = [
            (20, 0, 8.6),
            (20, 7, 86.0),
            (20, 11, 143.4),
            (40, 11, 286.8),
            (80, 0, 36.0),
            (80, 4, 216.2),
            (80, 9, 480.4),
            (80, 11, 600.5),
            (160, 11, 1201.0),
        ];
        for (width, mcs, rate) in printed {
            let found = rate_mbps(&phy(width, 1, 0.8), mcs);
            assert!((found - rate).abs() < 0.11, "{width} MHz, {mcs}: {found}");
            let two = rate_mbps(&phy(width, 2, 0.8), mcs);
            assert!((two / found - 2.0).abs() < 1e-3, "{two}");
        }
        assert!((rate_mbps(&phy(80, 1, 3.2), 11) - 510.4).abs() < 0.11);
    }

    #[test]
    fn a_ppdu_lasts_as_long_as_its_fields() {
        // 20 MHz, one stream, 0.8 µs: 36 + 7.2 of preamble, 117 bits per symbol of 13.6 µs.
        let phy = phy(20, 1, 0.8);
        let symbols = (8 * 200 + 16_i64 + 116) / 117;
        assert_eq!(phy.ppdu_ns(0, 200), 43_200 + symbols * 13_600 + 16_000);
        // A Block Ack of 32 bytes: 278 bits in 12 symbols of 24, or 3 of 96.
        assert_eq!(phy.response_ns(0), 16_000 + 20_000 + 48_000);
        assert_eq!(phy.response_ns(11), 16_000 + 20_000 + 12_000);
    }

    #[test]
    fn no_part_of_a_long_message_lasts_longer_than_a_ppdu_may() {
        for (width, streams, guard) in [(20, 1, 3.2), (80, 2, 0.8), (160, 2, 1.6)] {
            let phy = phy(width, streams, guard);
            for length in [0, 1, 1472, 1473, 9000, 65_507] {
                let air = Phy::air_bytes(length);
                let part = air.div_ceil(phy.part_count(air));
                assert!(phy.ppdu_ns(0, part) <= PPDU_MAX_NS, "{width} MHz, {length}");
            }
        }
        assert_eq!(Phy::air_bytes(100), 100 + 8 + 86);
        assert_eq!(Phy::air_bytes(1473), 1481 + 2 * 86);
    }
}
