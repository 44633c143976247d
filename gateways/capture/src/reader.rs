//! Reads a capture piece by piece, whatever its format: pcap with microseconds or nanoseconds and
//! pcapng, either byte order. It fetches no bytes; the owner feeds them as they come.
//!
//! A fault names its place and costs at most what lies behind it: all packets before it have been
//! given out. A pcapng block whose lengths are sound is passed over; where lengths are broken,
//! reading goes on only if the section says where the next one begins. pcap has no such marks, so
//! its first fault ends the file.

use core::ops::Range;

use super::bytes::{ByteOrder, array_at};
use super::pcap::PcapFile;
use super::pcapng::PcapngFile;
use super::{CaptureFault, CaptureInterface, CapturedPacket, Problem};
use hil_net::Direction;

/// What [`CaptureReader::next_step`] found.
#[derive(Debug, PartialEq, Eq)]
pub enum Step<'a> {
    /// A packet.
    Packet(CapturedPacket<'a>),
    /// Feed more bytes, or say that there are none.
    NeedsMore,
    /// Something is wrong; ask again, what follows it may be sound.
    Fault(CaptureFault),
    /// Nothing more.
    Ended,
}

hil_core::labelled! {
    /// Which format a capture has.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Format, label {
        /// pcap, stamps in microseconds.
        PcapMicroseconds = "pcap (microseconds)",
        /// pcap, stamps in nanoseconds.
        PcapNanoseconds = "pcap (nanoseconds)",
        /// pcap, stamps in microseconds, with interface and direction in each record.
        PcapModified = "pcap (modified)",
        /// pcapng.
        Pcapng = "pcapng",
    }
}

/// The bytes that are there, and where they lie in the file.
#[derive(Debug, Default)]
pub(super) struct Window {
    buffer: Vec<u8>,
    start: usize,
    pub(super) offset: u64,
    /// Bytes to drop as they come.
    owed_bytes: u64,
    is_complete: bool,
}

impl Window {
    pub(super) fn bytes(&self) -> &[u8] {
        &self.buffer[self.start..]
    }

    /// What is wrong when less than `expected_bytes` of `what` are there; `None` while more may come.
    pub(super) fn missing(&self, what: &'static str, expected_bytes: u64) -> Option<Problem> {
        self.is_complete.then(|| Problem::Truncated {
            what,
            available_bytes: self.bytes().len() as u64,
            expected_bytes,
        })
    }

    /// More is needed, or, when there is no more, what is missing.
    pub(super) fn needs(&self, what: &'static str, expected_bytes: u64) -> Next {
        let missing = self.missing(what, expected_bytes);
        missing.map_or(Next::NeedsMore, |problem| Next::Fault(problem, None))
    }

    /// Drops `length` bytes, also such as have not come yet.
    fn skip(&mut self, length: u64) {
        let here = self.bytes().len() as u64;
        let now = length.min(here);
        self.start += usize::try_from(now).expect("at most what is in memory");
        self.owed_bytes += length - now;
        self.offset += length;
    }

    fn feed(&mut self, bytes: &[u8]) {
        let owed = self.owed_bytes.min(bytes.len() as u64);
        self.owed_bytes -= owed;
        let fresh = &bytes[usize::try_from(owed).expect("at most what is in memory")..];
        self.buffer.drain(..self.start);
        self.start = 0;
        self.buffer.extend_from_slice(fresh);
    }
}

/// What is known of the packet at the front of the window, and where its bytes lie in it.
#[derive(Debug, Clone)]
pub(super) struct Found {
    pub(super) interface_index: usize,
    pub(super) interface_number: Option<u32>,
    pub(super) stamp_ns: Option<i64>,
    pub(super) original_bytes: u32,
    pub(super) direction: Direction,
    pub(super) is_damaged: bool,
    pub(super) data: Range<usize>,
}

/// What a format makes of the bytes at the front of the window.
#[derive(Debug)]
pub(super) enum Next {
    /// A packet, whose record or block has so many bytes.
    Packet(Found, u64),
    /// So many bytes were something else.
    Passed(u64),
    NeedsMore,
    /// Goes on behind so many bytes, if any.
    Fault(Problem, Option<u64>),
}

#[derive(Debug, Default)]
enum State {
    #[default]
    Unknown,
    Pcap(PcapFile),
    Pcapng(PcapngFile),
    Ended,
}

/// See the module documentation.
///
/// ```
/// use hil_capture::reader::{CaptureReader, Step};
///
/// let mut reader = CaptureReader::default();
/// reader.feed(b"a file of something else");
/// reader.end();
/// let Step::Fault(fault) = reader.next_step() else { panic!() };
/// assert_eq!(fault.offset, 0);
/// assert!(matches!(reader.next_step(), Step::Ended));
/// ```
#[derive(Debug, Default)]
pub struct CaptureReader {
    window: Window,
    state: State,
    format: Option<Format>,
    interfaces: Vec<CaptureInterface>,
    /// The packet given out last, dropped at the next step.
    given_bytes: u64,
}

impl CaptureReader {
    /// More of the file.
    pub fn feed(&mut self, bytes: &[u8]) {
        self.window.skip(core::mem::take(&mut self.given_bytes));
        if !matches!(self.state, State::Ended) {
            self.window.feed(bytes);
        }
    }

    /// There is no more.
    pub fn end(&mut self) {
        self.window.is_complete = true;
    }

    /// Its format, once known.
    pub fn format(&self) -> Option<Format> {
        self.format
    }

    /// The interfaces described so far. One that a later section describes again is the same.
    pub fn interfaces(&self) -> &[CaptureInterface] {
        &self.interfaces
    }

    /// The next packet or fault in the bytes fed so far.
    pub fn next_step(&mut self) -> Step<'_> {
        self.window.skip(core::mem::take(&mut self.given_bytes));
        loop {
            if self.window.owed_bytes > 0 && !matches!(self.state, State::Ended) {
                return self.wait();
            }
            let next = match &mut self.state {
                State::Unknown => self.recognise(),
                State::Pcap(file) => file.next(&self.window),
                State::Pcapng(file) => file.next(&self.window, &mut self.interfaces),
                State::Ended => return Step::Ended,
            };
            match next {
                Next::Passed(length) => self.window.skip(length),
                Next::Packet(found, record_bytes) => {
                    self.given_bytes = record_bytes;
                    let interface = &self.interfaces[found.interface_index];
                    return Step::Packet(CapturedPacket {
                        offset: self.window.offset,
                        interface_index: found.interface_index,
                        interface_number: found.interface_number,
                        link_type: interface.link_type,
                        stamp_ns: found.stamp_ns,
                        original_bytes: found.original_bytes,
                        is_damaged: found.is_damaged,
                        is_nic_stamped: interface.has_nic_clock(),
                        direction: found.direction,
                        data: &self.window.bytes()[found.data],
                    });
                }
                Next::NeedsMore if !self.window.is_complete => return Step::NeedsMore,
                Next::NeedsMore => self.state = State::Ended,
                Next::Fault(problem, go_on) => {
                    let fault = CaptureFault {
                        offset: self.window.offset,
                        problem,
                        is_passed: go_on.is_some(),
                    };
                    match go_on {
                        Some(length) => self.window.skip(length),
                        None => self.state = State::Ended,
                    }
                    return Step::Fault(fault);
                }
            }
        }
    }

    /// Bytes that are passed over have not come yet.
    fn wait(&mut self) -> Step<'static> {
        if !self.window.is_complete {
            return Step::NeedsMore;
        }
        self.state = State::Ended;
        Step::Fault(CaptureFault {
            // Where the file ends.
            offset: self.window.offset - self.window.owed_bytes,
            problem: Problem::Truncated {
                what: "the rest of a section",
                available_bytes: 0,
                expected_bytes: self.window.owed_bytes,
            },
            is_passed: false,
        })
    }

    /// Looks at the first four bytes and, of pcap, at the file header.
    fn recognise(&mut self) -> Next {
        let bytes = self.window.bytes();
        let Some(magic) = array_at::<4>(bytes, 0) else {
            if self.window.is_complete && bytes.is_empty() {
                return Next::Fault(Problem::Empty, None);
            }
            return self.window.needs("the file's magic number", 4);
        };
        let (format, order) = match magic {
            [0x0a, 0x0d, 0x0d, 0x0a] => {
                self.format = Some(Format::Pcapng);
                self.state = State::Pcapng(PcapngFile::default());
                return Next::Passed(0);
            }
            [0xd4, 0xc3, 0xb2, 0xa1] => (Format::PcapMicroseconds, ByteOrder::Little),
            [0xa1, 0xb2, 0xc3, 0xd4] => (Format::PcapMicroseconds, ByteOrder::Big),
            [0x4d, 0x3c, 0xb2, 0xa1] => (Format::PcapNanoseconds, ByteOrder::Little),
            [0xa1, 0xb2, 0x3c, 0x4d] => (Format::PcapNanoseconds, ByteOrder::Big),
            [0x34, 0xcd, 0xb2, 0xa1] => (Format::PcapModified, ByteOrder::Little),
            [0xa1, 0xb2, 0xcd, 0x34] => (Format::PcapModified, ByteOrder::Big),
            _ => return Next::Fault(Problem::Foreign(magic), None),
        };
        let file = PcapFile {
            order,
            fraction_ns: if format == Format::PcapNanoseconds {
                1
            } else {
                1000
            },
            is_modified: format == Format::PcapModified,
        };
        match file.header(&self.window) {
            Ok(Some(interface)) => self.interfaces.push(interface),
            Ok(None) => return Next::NeedsMore,
            Err(problem) => return Next::Fault(problem, None),
        }
        self.format = Some(format);
        self.state = State::Pcap(file);
        Next::Passed(PcapFile::HEADER_BYTES)
    }
}
