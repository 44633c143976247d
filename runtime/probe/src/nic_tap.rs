//! The stamps of a network card beside those of the kernel: a second ring of arriving packets only, on
//! a card that is set up to stamp them for as long as the probe runs. What the card did not stamp is in
//! the kernel's part of the file all the same; here it is counted.

use hil_capture::flow::FlowFilter;
use hil_capture::{CARD_CLOCK, CaptureInterface, writer};
use hil_net::filter::PacketFilter;
use hil_net::nic_clock::{NicClock, NicPair};
use hil_net::packet_ring::{PacketRing, RingCounters, RingSettings, RingStamps};
use hil_net::ring_frame::StampSource;
use hil_net::timestamping::TimestampCapabilities;

use super::live::{LiveError, flow_list, told};
use super::output::{Output, append};
use hil_nic::nic_clock::guard::GuardedNic;

/// Reads of the card's clock of which the narrowest counts.
const READ_ATTEMPTS: u32 = 10;

/// What came of asking one card for its stamps.
#[derive(Debug, Clone, Default)]
pub(super) struct NicResult {
    /// What the card granted, in words.
    pub(super) granted: String,
    /// It says that it stamps every arrival.
    pub(super) stamps_all_arrivals: bool,
    /// Arrivals with its stamp.
    pub(super) stamped_count: u64,
    /// Arrivals without.
    pub(super) unstamped_count: u64,
    /// What the kernel counted of arrivals.
    pub(super) counters: RingCounters,
    /// Whether the card was put back as it was, in words.
    pub(super) restoring: String,
}

/// A card's stamps being captured.
#[derive(Debug)]
pub(super) struct NicTap {
    name: String,
    ring: PacketRing,
    card: GuardedNic,
    clock: Result<(u32, NicClock), String>,
    /// Its clock where the capture begins and where it ends.
    start: Option<NicPair>,
    end: Option<NicPair>,
    result: NicResult,
}

impl NicTap {
    /// Sets the card behind `name` up and taps what arrives there.
    pub(super) fn open(
        name: &str,
        is_guarded: bool,
        filters: &[PacketFilter],
        settings: &RingSettings,
    ) -> Result<Self, LiveError> {
        let card = GuardedNic::arm(name, is_guarded).map_err(|reason| LiveError::Card {
            interface: name.to_owned(),
            reason,
        })?;
        let settings = RingSettings {
            stamps: RingStamps::Card,
            ..*settings
        };
        Ok(Self {
            name: name.to_owned(),
            ring: PacketRing::open(name, filters, &settings)?,
            result: NicResult {
                granted: card.armed().describe(),
                stamps_all_arrivals: card.armed().stamps_all_arrivals(),
                ..NicResult::default()
            },
            card,
            clock: open_clock(name),
            start: None,
            end: None,
        })
    }

    /// Reads the clock and forgets what was heard until now.
    pub(super) fn begin(&mut self) -> Result<(), LiveError> {
        self.start = self.read_clock();
        told(self.ring.begin().map(|_discarded| ()), &self.name)
    }

    /// Takes over what was counted until now.
    pub(super) fn count(&mut self) -> Result<(), LiveError> {
        self.result.counters = told(self.ring.counters(), &self.name)?;
        Ok(())
    }

    /// Reads the clock once more.
    pub(super) fn end(&mut self) {
        self.end = self.read_clock();
    }

    fn read_clock(&self) -> Option<NicPair> {
        let (_, clock) = self.clock.as_ref().ok()?;
        clock.read(READ_ATTEMPTS).ok()
    }

    /// The card in words, for the person who watches.
    pub(super) fn granted(&self) -> &str {
        &self.result.granted
    }

    /// The card says that it stamps every arrival.
    pub(super) fn stamps_all_arrivals(&self) -> bool {
        self.result.stamps_all_arrivals
    }

    /// Describes the card as an interface of its own: its stamps are on another clock.
    pub(super) fn describe(&self, buffer: &mut Vec<u8>, snap_bytes: u32, flows: &[FlowFilter]) {
        let device = match &self.clock {
            Ok((index, _)) => format!("/dev/ptp{index}"),
            Err(reason) => format!("not readable: {reason}"),
        };
        let interface = CaptureInterface {
            name: Some(self.name.clone()),
            description: Some(format!(
                "{CARD_CLOCK} ({device}), of arriving packets only; at the start {}",
                words(self.start)
            )),
            link_type: self.ring.link_type(),
            snap_bytes,
            ..CaptureInterface::default()
        };
        writer::interface(buffer, &interface, &flow_list(flows));
    }

    /// Everything that is in the ring now, into the file where the card stamped it.
    pub(super) fn drain(&mut self, index: u32, file: &mut Output) -> Result<(), LiveError> {
        let link_type = self.ring.link_type();
        let Self { ring, result, .. } = self;
        for _ in 0..ring.frame_count() {
            let is_there = ring.next_packet(|packet| {
                if packet.source == StampSource::Card {
                    result.stamped_count += 1;
                    append(file.buffer(), index, packet, link_type);
                } else {
                    result.unstamped_count += 1;
                }
            });
            if !is_there {
                break;
            }
            file.write_if_full()?;
        }
        Ok(())
    }

    /// Writes what was counted last, between two instants of the system clock, and puts the card back.
    pub(super) fn finish(
        mut self,
        index: u32,
        from_ns: u64,
        to_ns: u64,
        buffer: &mut Vec<u8>,
    ) -> NicResult {
        let from_ns = on_nic(from_ns, self.start);
        let to_ns = on_nic(to_ns, self.end);
        let RingCounters {
            matched_count,
            dropped_count,
        } = self.result.counters;
        let comment = format!(
            "{} of {} arrivals were stamped by the card; at the end {}",
            self.result.stamped_count,
            self.result.stamped_count + self.result.unstamped_count,
            words(self.end)
        );
        writer::statistics(
            buffer,
            index,
            from_ns,
            to_ns,
            matched_count,
            dropped_count,
            Some(&comment),
        );
        self.result.restoring = self.card.restore_in_words();
        self.result
    }
}

fn open_clock(name: &str) -> Result<(u32, NicClock), String> {
    let claims = TimestampCapabilities::query(name).map_err(|error| error.to_string())?;
    let index = claims.phc_index.ok_or("the interface names no clock")?;
    let clock = NicClock::open(index).map_err(|error| error.to_string())?;
    Ok((index, clock))
}

/// Where the card's clock stands, in words.
fn words(pair: Option<NicPair>) -> String {
    pair.map_or("its clock could not be read".to_owned(), |pair| {
        format!(
            "it is {:+} ns against the system clock, within {} ns",
            pair.nic_offset_ns, pair.bound_ns
        )
    })
}

/// An instant of the system clock on the card's, as far as that is known.
fn on_nic(system_ns: u64, pair: Option<NicPair>) -> u64 {
    pair.map_or(system_ns, |pair| {
        system_ns.saturating_add_signed(pair.nic_offset_ns)
    })
}

#[cfg(test)]
mod tests {
    use hil_capture::join::JoinSettings;
    use hil_capture::writer::PacketToWrite;
    use hil_net::{Direction, link_type};

    use super::super::analyse::{Reading, Report};
    use super::*;

    #[test]
    fn a_nic_clocks_place_is_told_with_its_bound_or_as_unknown() {
        let pair = NicPair {
            realtime_ns: 0,
            nic_offset_ns: -37,
            bound_ns: 4,
        };
        assert_eq!(
            words(Some(pair)),
            "it is -37 ns against the system clock, within 4 ns"
        );
        assert_eq!(words(None), "its clock could not be read");
        assert_eq!((on_nic(100, Some(pair)), on_nic(100, None)), (63, 100));
    }

    /// An Ethernet frame with a datagram to port 5004 that begins with its number.
    fn frame(number: u8) -> Vec<u8> {
        let mut bytes = vec![2; 12];
        bytes.extend([8, 0, 0x45, 0, 0, 30, 0, 0, 0, 0, 64, 17, 0, 0]);
        bytes.extend([10, 0, 0, 1, 10, 0, 0, 2]);
        bytes.extend([0x13, 0x8c, 0x13, 0x8c, 0, 10, 0, 0]);
        bytes.extend([0, number]);
        bytes
    }

    #[test]
    fn what_a_nic_stamped_is_a_point_of_its_own_and_joined_with_none() {
        let path = std::env::temp_dir().join(format!("hil-card-{}.pcapng", std::process::id()));
        let mut file = Vec::new();
        writer::begin(&mut file, "test", "none");
        for description in [None, Some(format!("{CARD_CLOCK} (/dev/ptp0)"))] {
            let interface = CaptureInterface {
                name: Some("eth0".to_owned()),
                description,
                link_type: link_type::ETHERNET,
                ..CaptureInterface::default()
            };
            writer::interface(&mut file, &interface, "all");
        }
        // Of three arrivals the card stamped the first and the third, an hour ahead.
        for (interface_index, number, stamp_ns) in [
            (0, 1, 1_000),
            (0, 2, 2_000),
            (0, 3, 3_000),
            (1, 1, 3_600_000_000_900),
            (1, 3, 3_600_000_002_950),
        ] {
            let bytes = frame(number);
            let packet = PacketToWrite {
                interface_index,
                stamp_ns,
                original_bytes: 44,
                direction: Direction::Inbound,
                data: [&bytes, &[]],
            };
            writer::packet(&mut file, &packet);
        }
        std::fs::write(&path, file).unwrap();
        let flow = "udp:port=5004,id=0+2".parse().unwrap();
        let reading = Reading::of(&[path.as_path()], &[flow], &mut |_| {}).unwrap();
        let settings = JoinSettings {
            window_ns: 1_000_000,
            is_one_clock: false,
        };
        let report = serde_json::to_value(Report::of(&reading, &settings)).unwrap();
        std::fs::remove_file(path).unwrap();
        assert_eq!(report["packets"]["packet_count"], 3, "{report:#}");
        assert_eq!(report["joins"], serde_json::json!([]), "{report:#}");
        let points = report["points"].as_array().unwrap();
        assert_eq!(points.len(), 2, "{report:#}");
        let [kernel, card] = [&points[0], &points[1]];
        assert_eq!(kernel["figures"]["datagram_count"], 3);
        assert_eq!(kernel["figures"]["numbers"]["skipped_count"], 0);
        assert!(
            card["point"]
                .as_str()
                .unwrap()
                .ends_with("by the card's clock")
        );
        assert_eq!(card["figures"]["datagram_count"], 2);
        assert_eq!(card["kernel_stamped_count"], 3);
        assert_eq!(card["figures"]["interval"]["min_ns"], 2_050, "{card:#}");
        assert!(card["figures"]["numbers"].is_null(), "{card:#}");
    }

    #[test]
    fn an_interface_without_a_card_is_refused_in_words() {
        let settings = RingSettings {
            snap_bytes: 128,
            ring_bytes: 1 << 16,
            stamps: RingStamps::Card,
        };
        let error = NicTap::open("lo", false, &[FlowFilter::hil().packets], &settings).unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("lo") && text.contains("as on loopback"),
            "{text}"
        );
    }
}
