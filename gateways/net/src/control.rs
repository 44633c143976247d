//! Decoder of the control messages the kernel attaches to a datagram, on plain bytes. It calls
//! no kernel; `recvmsg` is in [`super::timestamping`]. Whatever the bytes, it does not panic.
//!
//! Layout: `struct cmsghdr` of `linux/socket.h`, `struct scm_timestamping` and
//! `struct sock_extended_err` of `linux/errqueue.h`, on a 64-bit kernel.

use super::{KernelStamps, TransmitStage};

const _: () = assert!(
    size_of::<usize>() == 8 && size_of::<libc::timespec>() == 16,
    "the control message layout is the one of 64-bit Linux"
);

/// Bytes of `struct cmsghdr`: length (8), level (4), type (4).
const HEADER_BYTES: usize = 16;
/// Control messages start at multiples of this.
const ALIGNMENT_BYTES: usize = 8;
/// `SO_TIMESTAMPING_NEW`, the variant with 64-bit seconds; same bytes on a 64-bit kernel.
const SCM_TIMESTAMPING_NEW: i32 = 65;
/// `SCM_WIFI_STATUS` of `asm-generic/socket.h`, the value of `SO_WIFI_STATUS`.
pub const SCM_WIFI_STATUS: i32 = 41;
/// `IPV6_RECVERR` as a control message type.
const IPV6_RECVERR: i32 = libc::IPV6_RECVERR;
/// `ee_info` of a stamp taken on the way to the wire (`SCM_TSTAMP_SND`).
const STAMP_OF_SEND: u32 = 0;
/// `ee_info` of a stamp taken before the queueing discipline (`SCM_TSTAMP_SCHED`).
const STAMP_OF_SCHEDULING: u32 = 1;

/// `struct sock_extended_err` without its padding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExtendedError {
    /// `ee_errno`.
    pub errno: u32,
    /// `ee_origin`.
    pub origin: u8,
    /// `ee_info`: for a transmit stamp, where it was taken.
    pub info: u32,
    /// `ee_data`: for a transmit stamp, which send it belongs to.
    pub data: u32,
}

/// What one entry of the error queue is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QueueEntry {
    /// A transmit stamp of the send with this identity.
    Stamp {
        /// Counts the sends, as [`super::TxToken`] does.
        id: u32,
        /// Where on the way out it was taken.
        stage: TransmitStage,
    },
    /// The network reported an error about an earlier datagram.
    NetworkReport {
        /// What it reported.
        errno: i32,
    },
    /// This host's stack reported one.
    LocalReport {
        /// What it reported.
        errno: i32,
    },
    /// None of these.
    Unknown,
}

impl ExtendedError {
    /// Sorts the entry by its origin.
    pub fn entry(&self) -> QueueEntry {
        let errno = i32::try_from(self.errno).unwrap_or(0);
        match self.origin {
            libc::SO_EE_ORIGIN_TIMESTAMPING => {
                let stage = match self.info {
                    STAMP_OF_SEND => TransmitStage::Sent,
                    STAMP_OF_SCHEDULING => TransmitStage::Scheduled,
                    _ => return QueueEntry::Unknown,
                };
                QueueEntry::Stamp {
                    id: self.data,
                    stage,
                }
            }
            libc::SO_EE_ORIGIN_ICMP | libc::SO_EE_ORIGIN_ICMP6 => {
                QueueEntry::NetworkReport { errno }
            }
            libc::SO_EE_ORIGIN_LOCAL => QueueEntry::LocalReport { errno },
            _ => QueueEntry::Unknown,
        }
    }
}

/// Everything this crate reads from the control data of one datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ControlData {
    /// Software and hardware stamps.
    pub stamps: KernelStamps,
    /// Datagrams dropped so far because the receive buffer was full, modulo 2^32.
    pub drop_count: Option<u32>,
    /// What an entry of the error queue is about.
    pub extended_error: Option<ExtendedError>,
    /// A radio's word on an earlier datagram (`SCM_WIFI_STATUS`): the peer radio acknowledged it,
    /// or not. Such an entry has the origin of a transmit stamp and is none.
    pub is_acknowledged: Option<bool>,
    /// Traffic class the datagram arrived with (`IP_TOS`, `IPV6_TCLASS`).
    pub traffic_class: Option<u8>,
    /// A message was cut off or its length or content impossible; what came before it counts.
    pub is_damaged: bool,
}

impl ControlData {
    /// Reads all control messages in `bytes`, of which the first starts at offset 0.
    pub fn decode(bytes: &[u8]) -> Self {
        let mut data = Self::default();
        let mut messages = Messages { rest: bytes };
        for message in &mut messages {
            data.is_damaged |= data.absorb(&message).is_none();
        }
        data.is_damaged |= !messages.rest.is_empty();
        data
    }

    /// Takes what `message` says; `None` when it is cut short or nonsense.
    fn absorb(&mut self, message: &Message<'_>) -> Option<()> {
        let payload = message.payload;
        match (message.level, message.kind) {
            (libc::SOL_SOCKET, libc::SCM_TIMESTAMPING | SCM_TIMESTAMPING_NEW) => {
                self.stamps = decode_stamps(payload)?;
            }
            (libc::SOL_SOCKET, libc::SO_RXQ_OVFL) => self.drop_count = Some(u32_at(payload, 0)?),
            (libc::SOL_SOCKET, SCM_WIFI_STATUS) => {
                self.is_acknowledged = Some(u32_at(payload, 0)? != 0);
            }
            (libc::SOL_IP, libc::IP_TOS) | (libc::SOL_IPV6, libc::IPV6_TCLASS) => {
                self.traffic_class = Some(decode_class(payload)?);
            }
            (libc::SOL_IP, libc::IP_RECVERR) | (libc::SOL_IPV6, IPV6_RECVERR) => {
                self.extended_error = Some(decode_extended_error(payload)?);
            }
            _ => {}
        }
        Some(())
    }
}

/// One control message.
struct Message<'a> {
    level: i32,
    kind: i32,
    payload: &'a [u8],
}

/// The control messages of a buffer. At the end `rest` is empty unless the last header is cut
/// off or states an impossible length.
struct Messages<'a> {
    rest: &'a [u8],
}

impl<'a> Iterator for Messages<'a> {
    type Item = Message<'a>;

    fn next(&mut self) -> Option<Message<'a>> {
        let length = usize::from_ne_bytes(*self.rest.first_chunk()?);
        let payload = self.rest.get(HEADER_BYTES..length)?;
        let message = Message {
            level: i32_at(self.rest, 8)?,
            kind: i32_at(self.rest, 12)?,
            payload,
        };
        let next = length.checked_next_multiple_of(ALIGNMENT_BYTES)?;
        // The last message need not be padded.
        self.rest = self.rest.get(next..).unwrap_or_default();
        Some(message)
    }
}

/// `struct scm_timestamping`: software, a retired field, hardware.
fn decode_stamps(payload: &[u8]) -> Option<KernelStamps> {
    Some(KernelStamps {
        software_ns: decode_time(payload, 0)?,
        hardware_ns: decode_time(payload, 32)?,
    })
}

/// A `struct timespec` at `offset` in nanoseconds: outer `None` when it is impossible, inner
/// `None` when it is zero, the kernel's way of saying that there is no such stamp.
#[expect(clippy::option_option, reason = "impossible and absent are different")]
fn decode_time(payload: &[u8], offset: usize) -> Option<Option<i64>> {
    let seconds = i64_at(payload, offset)?;
    let nanoseconds = i64_at(payload, offset + 8)?;
    if !(0..1_000_000_000).contains(&nanoseconds) {
        return None;
    }
    let total_ns = seconds
        .checked_mul(1_000_000_000)?
        .checked_add(nanoseconds)?;
    Some((total_ns != 0).then_some(total_ns))
}

/// IPv4 gives one byte, IPv6 an `int`.
fn decode_class(payload: &[u8]) -> Option<u8> {
    match payload {
        [class] => Some(*class),
        _ => u8::try_from(u32_at(payload, 0)?).ok(),
    }
}

fn decode_extended_error(payload: &[u8]) -> Option<ExtendedError> {
    Some(ExtendedError {
        errno: u32_at(payload, 0)?,
        origin: *payload.get(4)?,
        info: u32_at(payload, 8)?,
        data: u32_at(payload, 12)?,
    })
}

fn u32_at(bytes: &[u8], offset: usize) -> Option<u32> {
    Some(u32::from_ne_bytes(*bytes.get(offset..)?.first_chunk()?))
}

fn i32_at(bytes: &[u8], offset: usize) -> Option<i32> {
    Some(i32::from_ne_bytes(*bytes.get(offset..)?.first_chunk()?))
}

fn i64_at(bytes: &[u8], offset: usize) -> Option<i64> {
    Some(i64::from_ne_bytes(*bytes.get(offset..)?.first_chunk()?))
}

#[cfg(test)]
mod tests {

    use super::*;

    fn push(bytes: &mut Vec<u8>, level: i32, kind: i32, payload: &[u8]) {
        bytes.resize(bytes.len().next_multiple_of(ALIGNMENT_BYTES), 0);
        bytes.extend((HEADER_BYTES + payload.len()).to_ne_bytes());
        bytes.extend(level.to_ne_bytes());
        bytes.extend(kind.to_ne_bytes());
        bytes.extend(payload);
    }

    fn times(times: [(i64, i64); 3]) -> Vec<u8> {
        let words = times.iter().flat_map(|&(s, ns)| [s, ns]);
        words.flat_map(i64::to_ne_bytes).collect()
    }

    fn error(errno: u32, origin: u8, info: u32, data: u32) -> Vec<u8> {
        let mut bytes = errno.to_ne_bytes().to_vec();
        bytes.extend([origin, 3, 3, 0]);
        bytes.extend(info.to_ne_bytes());
        bytes.extend(data.to_ne_bytes());
        bytes
    }

    /// A transmit report as the kernel builds it: both stamps and the identity 41.
    fn transmit_report() -> Vec<u8> {
        let mut bytes = Vec::new();
        let stamps = times([(1_700_000_000, 5), (0, 0), (37, 250)]);
        push(
            &mut bytes,
            libc::SOL_SOCKET,
            libc::SCM_TIMESTAMPING,
            &stamps,
        );
        let entry = error(42, libc::SO_EE_ORIGIN_TIMESTAMPING, STAMP_OF_SEND, 41);
        push(&mut bytes, libc::SOL_IP, libc::IP_RECVERR, &entry);
        bytes
    }

    #[test]
    fn a_transmit_report_yields_both_stamps_and_the_identity() {
        let data = ControlData::decode(&transmit_report());
        assert_eq!(data.stamps.software_ns, Some(1_700_000_000_000_000_005));
        assert_eq!(data.stamps.hardware_ns, Some(37_000_000_250));
        assert_eq!(
            data.extended_error.unwrap().entry(),
            QueueEntry::Stamp {
                id: 41,
                stage: TransmitStage::Sent
            }
        );
        assert!(!data.is_damaged);
    }

    #[test]
    fn a_hardware_stamp_alone_leaves_the_software_stamp_unavailable() {
        let mut bytes = Vec::new();
        let stamps = times([(0, 0), (0, 0), (9, 1)]);
        push(
            &mut bytes,
            libc::SOL_SOCKET,
            libc::SCM_TIMESTAMPING,
            &stamps,
        );
        let data = ControlData::decode(&bytes);
        assert_eq!(data.stamps.software_ns, None);
        assert_eq!(data.stamps.hardware_ns, Some(9_000_000_001));
    }

    /// A radio's report as Linux 6.1 builds it: the origin of a stamp, number 0, a status.
    fn radio_report(status: u32) -> Vec<u8> {
        let mut bytes = Vec::new();
        let status = status.to_ne_bytes();
        push(&mut bytes, libc::SOL_SOCKET, SCM_WIFI_STATUS, &status);
        let entry = error(42, libc::SO_EE_ORIGIN_TIMESTAMPING, STAMP_OF_SEND, 0);
        push(&mut bytes, libc::SOL_IP, libc::IP_RECVERR, &entry);
        bytes
    }

    #[test]
    fn a_report_of_the_radio_is_told_from_the_stamp_it_looks_like() {
        for (status, expected) in [(1, true), (0, false)] {
            let data = ControlData::decode(&radio_report(status));
            assert_eq!(data.is_acknowledged, Some(expected));
            assert_eq!(data.stamps, KernelStamps::default());
            assert!(!data.is_damaged);
        }
        let stamp = ControlData::decode(&transmit_report());
        assert_eq!(stamp.is_acknowledged, None);
        let mut cut = Vec::new();
        push(&mut cut, libc::SOL_SOCKET, SCM_WIFI_STATUS, &[1, 0]);
        assert!(ControlData::decode(&cut).is_damaged);
    }

    #[test]
    fn the_traffic_class_of_both_families_is_read() {
        let mut bytes = Vec::new();
        push(&mut bytes, libc::SOL_IP, libc::IP_TOS, &[0xb8]);
        assert_eq!(ControlData::decode(&bytes).traffic_class, Some(0xb8));
        let mut bytes = Vec::new();
        let class = 0xc0_i32.to_ne_bytes();
        push(&mut bytes, libc::SOL_IPV6, libc::IPV6_TCLASS, &class);
        assert_eq!(ControlData::decode(&bytes).traffic_class, Some(0xc0));
        let mut bytes = Vec::new();
        push(&mut bytes, libc::SOL_IP, libc::IP_TOS, &[]);
        assert!(ControlData::decode(&bytes).is_damaged);
    }

    #[test]
    fn unknown_messages_are_passed_over_and_the_drop_count_is_found_behind_them() {
        let mut bytes = Vec::new();
        push(&mut bytes, libc::SOL_IP, libc::IP_TTL, &[0x2e]);
        push(
            &mut bytes,
            libc::SOL_SOCKET,
            libc::SO_RXQ_OVFL,
            &7_u32.to_ne_bytes(),
        );
        let data = ControlData::decode(&bytes);
        assert_eq!((data.drop_count, data.is_damaged), (Some(7), false));
    }

    #[test]
    fn each_origin_is_sorted_and_foreign_kinds_are_unknown() {
        let entry = |origin, info| {
            let mut bytes = Vec::new();
            let payload = error(111, origin, info, 9);
            push(&mut bytes, libc::SOL_IPV6, libc::IPV6_RECVERR, &payload);
            ControlData::decode(&bytes).extended_error.unwrap().entry()
        };
        let report = QueueEntry::NetworkReport { errno: 111 };
        assert_eq!(entry(libc::SO_EE_ORIGIN_ICMP, 0), report);
        assert_eq!(entry(libc::SO_EE_ORIGIN_ICMP6, 0), report);
        let local = QueueEntry::LocalReport { errno: 111 };
        assert_eq!(entry(libc::SO_EE_ORIGIN_LOCAL, 0), local);
        let scheduled = QueueEntry::Stamp {
            id: 9,
            stage: TransmitStage::Scheduled,
        };
        assert_eq!(entry(libc::SO_EE_ORIGIN_TIMESTAMPING, 1), scheduled);
        assert_eq!(
            entry(libc::SO_EE_ORIGIN_TIMESTAMPING, 2),
            QueueEntry::Unknown
        );
        assert_eq!(entry(99, 0), QueueEntry::Unknown);
    }

    #[test]
    fn every_cut_is_either_harmless_or_called_damaged() {
        let whole = transmit_report();
        let expected = ControlData::decode(&whole);
        for length in 0..whole.len() {
            let data = ControlData::decode(&whole[..length]);
            let second_starts = HEADER_BYTES + 48;
            let is_clean_cut = length == 0 || length == second_starts;
            assert_eq!(data.is_damaged, !is_clean_cut, "cut at {length}");
            if length >= second_starts {
                assert_eq!(data.stamps, expected.stamps);
            }
            assert_eq!(data.extended_error, None);
        }
    }

    #[test]
    fn impossible_lengths_and_times_are_damage() {
        for length in [0_usize, 1, 15, 113, usize::MAX, usize::MAX - 6] {
            let mut bytes = transmit_report();
            bytes[..8].copy_from_slice(&length.to_ne_bytes());
            let data = ControlData::decode(&bytes);
            assert!(data.is_damaged, "length {length}");
            assert_eq!(data.stamps, KernelStamps::default());
        }
        for time in [(1, 1_000_000_000), (1, -1), (i64::MAX, 0), (i64::MIN, 0)] {
            let mut bytes = Vec::new();
            let stamps = times([time, (0, 0), (0, 0)]);
            push(
                &mut bytes,
                libc::SOL_SOCKET,
                libc::SCM_TIMESTAMPING,
                &stamps,
            );
            assert!(ControlData::decode(&bytes).is_damaged, "{time:?}");
        }
    }
}
