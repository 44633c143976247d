//! Reads a capture piece by piece, whatever its format: pcap with microseconds or nanoseconds and
//! pcapng, either byte order. It fetches no bytes; the owner feeds them as they come.
//!
//! A fault names its place and costs at most what lies behind it: all packets before it have been
//! given out. A pcapng block whose lengths are sound is passed over; where lengths are broken,
//! reading goes on only if the section says where the next one begins. pcap has no such marks, so
//! its first fault ends the file.

use super::bytes::ByteOrder;
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

/// Which format a capture has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// pcap, stamps in microseconds.
    PcapMicroseconds,
    /// pcap, stamps in nanoseconds.
    PcapNanoseconds,
    /// pcapng.
    Pcapng,
}

impl Format {
    /// The words a report prints.
    pub const fn label(self) -> &'static str {
        match self {
            Self::PcapMicroseconds => "pcap (microseconds)",
            Self::PcapNanoseconds => "pcap (nanoseconds)",
            Self::Pcapng => "pcapng",
        }
    }
}

/// The bytes that are there, and where they lie in the file.
#[derive(Debug, Default)]
pub(super) struct Window {
    buffer: Vec<u8>,
    start: usize,
    offset: u64,
    /// Bytes to drop as they come.
    owed_bytes: u64,
    is_complete: bool,
}

impl Window {
    pub(super) fn bytes(&self) -> &[u8] {
        &self.buffer[self.start..]
    }

    pub(super) fn offset(&self) -> u64 {
        self.offset
    }

    pub(super) fn is_complete(&self) -> bool {
        self.is_complete
    }

    /// Drops `length` bytes, also such as have not come yet.
    pub(super) fn skip(&mut self, length: u64) {
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

/// Where a packet's bytes lie in the window, and what is known of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    pub(super) offset: u64,
    pub(super) interface_index: usize,
    pub(super) stamp_ns: Option<i64>,
    pub(super) original_bytes: u32,
    pub(super) direction: Direction,
    pub(super) data: (usize, usize),
    pub(super) record_bytes: u64,
}

/// What a format makes of the bytes at the front of the window.
#[derive(Debug)]
pub(super) enum Next {
    Packet(Found),
    /// So many bytes were something else.
    Passed(u64),
    NeedsMore,
    /// Goes on behind so many bytes, if any.
    Fault(Problem, Option<u64>),
}

#[derive(Debug)]
enum State {
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
#[derive(Debug)]
pub struct CaptureReader {
    window: Window,
    state: State,
    format: Option<Format>,
    interfaces: Vec<CaptureInterface>,
    /// The packet given out last, dropped at the next step.
    given_bytes: u64,
}

impl Default for CaptureReader {
    fn default() -> Self {
        Self {
            window: Window::default(),
            state: State::Unknown,
            format: None,
            interfaces: Vec::new(),
            given_bytes: 0,
        }
    }
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

    /// The interfaces described so far, over all sections.
    pub fn interfaces(&self) -> &[CaptureInterface] {
        &self.interfaces
    }

    /// The next packet or fault in the bytes fed so far.
    pub fn next_step(&mut self) -> Step<'_> {
        self.window.skip(core::mem::take(&mut self.given_bytes));
        loop {
            if matches!(self.state, State::Ended) {
                return Step::Ended;
            }
            if self.window.owed_bytes > 0 {
                return self.wait();
            }
            let next = match &mut self.state {
                State::Unknown => match self.recognise() {
                    Some(step) => return step,
                    None => continue,
                },
                State::Pcap(file) => file.next(&self.window),
                State::Pcapng(file) => file.next(&self.window, &mut self.interfaces),
                State::Ended => return Step::Ended,
            };
            match next {
                Next::Passed(length) => self.window.skip(length),
                Next::Packet(found) => {
                    self.given_bytes = found.record_bytes;
                    let (from, to) = found.data;
                    let interface = &self.interfaces[found.interface_index];
                    return Step::Packet(CapturedPacket {
                        offset: found.offset,
                        interface_index: found.interface_index,
                        link_type: interface.link_type,
                        stamp_ns: found.stamp_ns,
                        original_bytes: found.original_bytes,
                        is_card_stamped: interface.has_card_clock(),
                        direction: found.direction,
                        data: &self.window.bytes()[from..to],
                    });
                }
                Next::NeedsMore if !self.window.is_complete => return Step::NeedsMore,
                Next::NeedsMore => {
                    self.state = State::Ended;
                    return Step::Ended;
                }
                Next::Fault(problem, go_on) => return self.fault(problem, go_on),
            }
        }
    }

    fn fault(&mut self, problem: Problem, go_on: Option<u64>) -> Step<'static> {
        let fault = CaptureFault {
            offset: self.window.offset(),
            problem,
            is_passed: go_on.is_some(),
        };
        match go_on {
            Some(length) => self.window.skip(length),
            None => self.state = State::Ended,
        }
        Step::Fault(fault)
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

    /// Looks at the first four bytes; `None` when the format is known now.
    fn recognise(&mut self) -> Option<Step<'static>> {
        let bytes = self.window.bytes();
        let Some(magic) = super::bytes::array_at::<4>(bytes, 0) else {
            if !self.window.is_complete {
                return Some(Step::NeedsMore);
            }
            let available_bytes = bytes.len() as u64;
            let problem = if available_bytes == 0 {
                Problem::Empty
            } else {
                Problem::Truncated {
                    what: "the file's magic number",
                    available_bytes,
                    expected_bytes: 4,
                }
            };
            return Some(self.fault(problem, None));
        };
        let (format, state) = match magic {
            [0x0a, 0x0d, 0x0d, 0x0a] => (Format::Pcapng, State::Pcapng(PcapngFile::default())),
            [0xd4, 0xc3, 0xb2, 0xa1] => micro(ByteOrder::Little),
            [0xa1, 0xb2, 0xc3, 0xd4] => micro(ByteOrder::Big),
            [0x4d, 0x3c, 0xb2, 0xa1] => nano(ByteOrder::Little),
            [0xa1, 0xb2, 0x3c, 0x4d] => nano(ByteOrder::Big),
            _ => return Some(self.fault(Problem::Foreign(magic), None)),
        };
        if let State::Pcap(file) = &state {
            match file.header(&self.window) {
                Ok(Some(interface)) => self.interfaces.push(interface),
                Ok(None) => return Some(Step::NeedsMore),
                Err(problem) => return Some(self.fault(problem, None)),
            }
            self.window.skip(PcapFile::HEADER_BYTES);
        }
        self.format = Some(format);
        self.state = state;
        None
    }
}

fn micro(order: ByteOrder) -> (Format, State) {
    (
        Format::PcapMicroseconds,
        State::Pcap(PcapFile::new(order, 1000)),
    )
}

fn nano(order: ByteOrder) -> (Format, State) {
    (
        Format::PcapNanoseconds,
        State::Pcap(PcapFile::new(order, 1)),
    )
}
