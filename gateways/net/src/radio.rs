//! What a radio says of each datagram: whether the peer radio acknowledged it (`SO_WIFI_STATUS`).
//! The report names no send; it brings back the packet, and by its content the send is found. Bytes
//! only, no socket.

use std::collections::VecDeque;

use super::TxToken;

/// Whether the peer radio acknowledged one datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RadioReport {
    /// Which send it belongs to.
    pub token: TxToken,
    /// The peer radio acknowledged the frame (IEEE 802.11, clause 10.3.2.11). Without, it was sent
    /// as often as the driver would and nobody is known to have heard it, or it was dropped before.
    pub is_acknowledged: bool,
}

/// Sends that may be waiting for their report.
const SENT_COUNT_MAX: usize = 512;
/// Reports that may be waiting for the caller.
const REPORT_COUNT_MAX: usize = 256;
/// Bytes of a datagram that tell it from others: a gateway's header is shorter.
const PREFIX_BYTES: usize = 96;
/// Room for the beginning of a returned packet: link layer, IP and UDP headers and the prefix.
pub const RETURNED_BYTES: usize = 256;

const ETHERNET_BYTES: usize = 14;
const VLAN_BYTES: usize = 4;
const UDP_HEADER_BYTES: usize = 8;
const UDP: u8 = 17;

/// The datagram inside a returned packet: what there is of its content, and its whole length.
/// `None` when the bytes are no UDP packet in one piece. They begin with an Ethernet header, as
/// wireless drivers return them, or with the IP header.
fn datagram(packet: &[u8]) -> Option<(&[u8], usize)> {
    let network = match ether_type(packet) {
        Some((0x0800, offset)) if version(packet, offset) == Some(4) => offset,
        Some((0x86dd, offset)) if version(packet, offset) == Some(6) => offset,
        _ => 0,
    };
    let bytes = packet.get(network..)?;
    let transport = match version(bytes, 0)? {
        4 => {
            let length = usize::from(bytes[0] & 0x0f) * 4;
            // More fragments, or an offset: no UDP header of ours. The two top bits say neither.
            let is_whole = u16_at(bytes, 6)? << 2 == 0;
            (length >= 20 && is_whole && *bytes.get(9)? == UDP).then_some(length)?
        }
        6 => (*bytes.get(6)? == UDP).then_some(40)?,
        _ => return None,
    };
    let stated = usize::from(u16_at(bytes, transport + 4)?);
    let length = stated.checked_sub(UDP_HEADER_BYTES)?;
    let content = bytes.get(transport + UDP_HEADER_BYTES..)?;
    Some((&content[..content.len().min(length)], length))
}

/// The type of an Ethernet frame and where its content starts, behind at most one VLAN tag.
fn ether_type(packet: &[u8]) -> Option<(u16, usize)> {
    let plain = u16_at(packet, ETHERNET_BYTES - 2)?;
    if plain == 0x8100 {
        let tagged = ETHERNET_BYTES + VLAN_BYTES;
        return Some((u16_at(packet, tagged - 2)?, tagged));
    }
    Some((plain, ETHERNET_BYTES))
}

fn version(bytes: &[u8], offset: usize) -> Option<u8> {
    bytes.get(offset).map(|byte| byte >> 4)
}

fn u16_at(bytes: &[u8], offset: usize) -> Option<u16> {
    Some(u16::from_be_bytes(*bytes.get(offset..)?.first_chunk()?))
}

/// Tells datagrams apart by their first bytes and their length (FNV-1a over 64-bit words; two of
/// the sends that wait agree by chance once in 2^55).
fn fingerprint(content: &[u8], length_bytes: usize) -> u64 {
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let prefix = &content[..content.len().min(PREFIX_BYTES)];
    let mut hash = 0xcbf2_9ce4_8422_2325_u64 ^ length_bytes as u64;
    for word in prefix.chunks(8) {
        let mut bytes = [0; 8];
        bytes[..word.len()].copy_from_slice(word);
        hash = (hash ^ u64::from_le_bytes(bytes)).wrapping_mul(PRIME);
        hash ^= hash >> 29;
    }
    hash
}

/// The sends of one socket whose reports are still to come, and the reports that came.
#[derive(Debug)]
pub struct RadioLedger {
    sent: VecDeque<(u64, TxToken)>,
    reports: VecDeque<RadioReport>,
    /// Sends forgotten because a later one needed their place; each would have a report unmatched.
    pub forgotten_count: u64,
    /// Reports dropped because they were not taken.
    pub overflow_count: u64,
}

impl Default for RadioLedger {
    fn default() -> Self {
        Self::new()
    }
}

impl RadioLedger {
    /// Nothing sent and nothing heard.
    pub fn new() -> Self {
        Self {
            sent: VecDeque::with_capacity(SENT_COUNT_MAX),
            reports: VecDeque::with_capacity(REPORT_COUNT_MAX),
            forgotten_count: 0,
            overflow_count: 0,
        }
    }

    /// Notes a send. Allocates nothing.
    pub fn note(&mut self, datagram: &[u8], token: TxToken) {
        if self.sent.len() == SENT_COUNT_MAX {
            self.sent.pop_front();
            self.forgotten_count += 1;
        }
        let print = fingerprint(datagram, datagram.len());
        self.sent.push_back((print, token));
    }

    /// Takes a report with the packet it brought back; `None` when that is no send that waits.
    pub fn settle(&mut self, packet: &[u8], is_acknowledged: bool) -> Option<RadioReport> {
        let (content, length_bytes) = datagram(packet)?;
        if content.len() < length_bytes.min(PREFIX_BYTES) {
            return None;
        }
        let print = fingerprint(content, length_bytes);
        // Reports come nearly in order, so the search ends at the front.
        let place = self.sent.iter().position(|one| one.0 == print)?;
        let (_, token) = self.sent.remove(place)?;
        let report = RadioReport {
            token,
            is_acknowledged,
        };
        if self.reports.len() == REPORT_COUNT_MAX {
            self.reports.pop_front();
            self.overflow_count += 1;
        }
        self.reports.push_back(report);
        Some(report)
    }

    /// The oldest report nobody has taken.
    pub fn take(&mut self) -> Option<RadioReport> {
        self.reports.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use hil_core::random::RandomStream;

    use super::*;

    /// As mac80211 returned a datagram of 100 bytes 0x43 over WPA2 on Linux 6.1.
    fn returned(content: &[u8]) -> Vec<u8> {
        let mut bytes = vec![2, 0, 0, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0x08, 0x00];
        let ip = u16::try_from(28 + content.len()).unwrap().to_be_bytes();
        bytes.extend([0x45, 0xb8, ip[0], ip[1], 0xee, 0xc3, 0x40, 0, 64, UDP]);
        bytes.extend([0x37, 0x49, 10, 78, 0, 2, 10, 78, 0, 1]);
        let udp = u16::try_from(8 + content.len()).unwrap().to_be_bytes();
        bytes.extend([0x96, 0x3a, 0, 9, udp[0], udp[1], 0x14, 0xf7]);
        bytes.extend(content);
        bytes
    }

    fn returned_v6(content: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0; 12];
        bytes.extend([0x86, 0xdd, 0x60, 0, 0, 0, 0, 8, UDP, 64]);
        bytes.extend([0; 32]);
        let udp = u16::try_from(8 + content.len()).unwrap().to_be_bytes();
        bytes.extend([0, 1, 0, 9, udp[0], udp[1], 0, 0]);
        bytes.extend(content);
        bytes
    }

    #[test]
    fn the_datagram_is_found_behind_every_header() {
        let content = [0x43; 100];
        let expected = Some((&content[..], 100));
        let frame = returned(&content);
        assert_eq!(datagram(&frame), expected);
        assert_eq!(datagram(&frame[ETHERNET_BYTES..]), expected);
        assert_eq!(datagram(&returned_v6(&content)), expected);
        assert_eq!(datagram(&returned_v6(&content)[ETHERNET_BYTES..]), expected);
        let mut tagged = frame[..12].to_vec();
        tagged.extend([0x81, 0, 0xc0, 0]);
        tagged.extend(&frame[12..]);
        assert_eq!(datagram(&tagged), expected);
    }

    #[test]
    fn fragments_and_other_protocols_are_no_datagram() {
        let mut piece = returned(&[1; 30]);
        piece[ETHERNET_BYTES + 6] = 0x20;
        assert_eq!(datagram(&piece), None);
        let mut tcp = returned(&[1; 30]);
        tcp[ETHERNET_BYTES + 9] = 6;
        assert_eq!(datagram(&tcp), None);
        let mut short = returned(&[1; 30]);
        short[ETHERNET_BYTES + 24..ETHERNET_BYTES + 26].copy_from_slice(&[0, 7]);
        assert_eq!(datagram(&short), None);
    }

    #[test]
    fn each_report_finds_its_send_in_any_order_and_once() {
        let mut ledger = RadioLedger::new();
        let datagrams: Vec<Vec<u8>> = (0..5).map(|byte| vec![byte; 120]).collect();
        for (datagram, number) in datagrams.iter().zip(0..) {
            ledger.note(datagram, TxToken(number));
        }
        for number in [1_u32, 0, 4, 3, 2] {
            let packet = returned(&datagrams[number as usize]);
            let cut = &packet[..packet.len().min(RETURNED_BYTES)];
            let report = ledger.settle(cut, number != 3).unwrap();
            assert_eq!(report.token, TxToken(number));
            assert_eq!(ledger.settle(cut, true), None, "settled twice");
        }
        let taken: Vec<RadioReport> = core::iter::from_fn(|| ledger.take()).collect();
        let tokens: Vec<u32> = taken.iter().map(|report| report.token.0).collect();
        assert_eq!(tokens, [1, 0, 4, 3, 2]);
        let unheard = taken.iter().filter(|report| !report.is_acknowledged);
        assert_eq!(unheard.count(), 1);
    }

    #[test]
    fn a_long_datagram_is_told_by_its_beginning_and_length() {
        let mut ledger = RadioLedger::new();
        ledger.note(&[7; 1400], TxToken(8));
        ledger.note(&[7; 1401], TxToken(9));
        let packet = returned(&[7; 1401]);
        let report = ledger.settle(&packet[..RETURNED_BYTES], true).unwrap();
        assert_eq!(report.token, TxToken(9));
        // Too little came back to tell.
        let packet = returned(&[7; 1400]);
        assert_eq!(ledger.settle(&packet[..100], true), None);
    }

    #[test]
    fn both_queues_are_bounded_and_count_what_they_drop() {
        let mut ledger = RadioLedger::new();
        let content = |number: usize| {
            let mut bytes = vec![0; 100];
            bytes[..8].copy_from_slice(&number.to_le_bytes());
            bytes
        };
        for number in 0..SENT_COUNT_MAX + 3 {
            ledger.note(&content(number), TxToken(u32::try_from(number).unwrap()));
        }
        assert_eq!(ledger.forgotten_count, 3);
        assert_eq!(ledger.settle(&returned(&content(2)), true), None);
        for number in 3..REPORT_COUNT_MAX + 8 {
            assert!(ledger.settle(&returned(&content(number)), true).is_some());
        }
        assert_eq!(ledger.overflow_count, 5);
        assert_eq!(ledger.take().unwrap().token, TxToken(8));
    }

    #[test]
    fn a_hundred_thousand_mutations_never_panic() {
        let mut random = RandomStream::new(2026, "radio");
        let mut pick = |below: usize| {
            let bound = u64::try_from(below).unwrap();
            usize::try_from(random.next_u64() % bound).unwrap()
        };
        let whole = [returned(&[9; 90]), returned_v6(&[9; 90])];
        let mut found_count = 0;
        for round in 0..100_000 {
            let mut bytes = whole[round % 2].clone();
            for _ in 0..=pick(4) {
                let index = pick(bytes.len());
                bytes[index] = u8::try_from(pick(256)).unwrap();
            }
            if pick(3) == 0 {
                bytes.truncate(pick(bytes.len()));
            }
            if let Some((content, length)) = datagram(&bytes) {
                assert!(content.len() <= length);
                found_count += 1;
            }
        }
        assert!((1_000..100_000).contains(&found_count), "{found_count}");
    }
}
