//! The clock of a network card (`/dev/ptpN`) read against the host's real-time clock, as pairs
//! with a bound. It neither sets nor steers the card's clock.
//!
//! `unsafe` is allowed here because `PTP_SYS_OFFSET_EXTENDED` has no safe form.

use std::fs::File;
use std::io;
use std::os::fd::{AsRawFd, RawFd};

use nix::time::ClockId;

use crate::clock_pair::{nanoseconds, read_ns};

/// A card's clock and the real-time clock at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NicPair {
    /// When, on the real-time clock, nanoseconds.
    pub realtime_ns: i64,
    /// Card minus real-time clock, nanoseconds.
    pub nic_offset_ns: i64,
    /// Largest error of `nic_offset_ns`: half the time between the two real-time reads around
    /// the read of the card.
    pub bound_ns: u64,
}

impl NicPair {
    /// The pair that one read of the card between two of the real-time clock gives; `None` when
    /// the real-time clock was set back in between.
    pub const fn from_reads(before_ns: i64, nic_ns: i64, after_ns: i64) -> Option<Self> {
        let width_ns = after_ns.saturating_sub(before_ns);
        if width_ns < 0 {
            return None;
        }
        let middle_ns = before_ns + width_ns / 2;
        Some(Self {
            realtime_ns: middle_ns,
            nic_offset_ns: nic_ns.saturating_sub(middle_ns),
            bound_ns: width_ns.unsigned_abs().div_ceil(2),
        })
    }

    /// The narrowest pair of several reads.
    pub fn narrowest(reads: impl IntoIterator<Item = [i64; 3]>) -> Option<Self> {
        reads
            .into_iter()
            .filter_map(|[before, card, after]| Self::from_reads(before, card, after))
            .min_by_key(|pair| pair.bound_ns)
    }
}

hil_core::labelled! {
    /// How the pairs come about.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum ReadMethod, text {
        /// `PTP_SYS_OFFSET_EXTENDED`: the driver reads the real-time clock right before and after the
        /// card's register.
        Driver = "read within the driver (PTP_SYS_OFFSET_EXTENDED)",
        /// Calls of `clock_gettime` around one another: for drivers without the above. The window is
        /// wider, and so is the bound.
        Calls = "read by calls around one another (clock_gettime)",
    }
}

/// An open card clock.
#[derive(Debug)]
pub struct NicClock {
    file: File,
    method: ReadMethod,
}

impl NicClock {
    /// Opens `/dev/ptp<index>`, of which the index comes from
    /// [`super::timestamping::TimestampCapabilities`], and finds out how it can be read.
    ///
    /// # Errors
    /// When the device cannot be opened or read in either way; names it.
    pub fn open(index: u32) -> io::Result<Self> {
        let path = format!("/dev/ptp{index}");
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{path}: {error}"));
        let file = File::open(&path).map_err(named)?;
        let mut clock = Self {
            file,
            method: ReadMethod::Driver,
        };
        if clock.read(1).is_err() {
            clock.method = ReadMethod::Calls;
            clock.read(1).map_err(named)?;
        }
        Ok(clock)
    }

    /// How it is read.
    pub const fn method(&self) -> ReadMethod {
        self.method
    }

    /// Reads the pair `attempt_count` times, 1 to 25, and keeps the narrowest.
    ///
    /// # Errors
    /// When the kernel refuses, or the real-time clock was set back during every read.
    pub fn read(&self, attempt_count: u32) -> io::Result<NicPair> {
        let attempt_count = attempt_count.clamp(1, SAMPLES_MAX);
        let pair = match self.method {
            ReadMethod::Driver => {
                let answer = ask_driver(self.file.as_raw_fd(), attempt_count)?;
                NicPair::narrowest(answer.reads())
            }
            ReadMethod::Calls => {
                let clock = dynamic_clock(self.file.as_raw_fd());
                let reads: io::Result<Vec<[i64; 3]>> = (0..attempt_count)
                    .map(|_| {
                        let before = read_ns(ClockId::CLOCK_REALTIME)?;
                        let card = read_ns(clock)?;
                        Ok([before, card, read_ns(ClockId::CLOCK_REALTIME)?])
                    })
                    .collect();
                NicPair::narrowest(reads?)
            }
        };
        pair.ok_or_else(|| io::Error::other("the real-time clock was set back during the read"))
    }
}

/// The clock behind an open `/dev/ptpN` (`FD_TO_CLOCKID` of `clock_getres(2)`).
const fn dynamic_clock(descriptor: RawFd) -> ClockId {
    ClockId::from_raw((!descriptor << 3) | 3)
}

/// `PTP_MAX_SAMPLES` of `linux/ptp_clock.h`.
const SAMPLES_MAX: u32 = 25;

/// `struct ptp_clock_time`.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
struct ClockTime {
    seconds: i64,
    nanoseconds: u32,
    reserved: u32,
}

impl ClockTime {
    fn as_ns(self) -> i64 {
        nanoseconds(self.seconds, i64::from(self.nanoseconds))
    }
}

/// `struct ptp_sys_offset_extended`: each sample is the system's clock, the card's, the system's.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
struct OffsetAnswer {
    sample_count: u32,
    /// 0 asks for the real-time clock (kernels before 6.12 know no other).
    reserved: [u32; 3],
    samples: [[ClockTime; 3]; SAMPLES_MAX as usize],
}

/// Part of the request's number.
const _: () = assert!(size_of::<OffsetAnswer>() == 1216);

impl OffsetAnswer {
    fn asking_for(sample_count: u32) -> Self {
        Self {
            sample_count,
            reserved: [0; 3],
            samples: [[ClockTime::default(); 3]; SAMPLES_MAX as usize],
        }
    }

    fn reads(&self) -> impl Iterator<Item = [i64; 3]> {
        let count = self.sample_count.min(SAMPLES_MAX) as usize;
        self.samples[..count]
            .iter()
            .map(|sample| sample.map(ClockTime::as_ns))
    }
}

nix::ioctl_readwrite!(
    /// `PTP_SYS_OFFSET_EXTENDED`.
    ptp_sys_offset_extended,
    b'=',
    9,
    OffsetAnswer
);

#[allow(unsafe_code, reason = "no crate wraps PTP_SYS_OFFSET_EXTENDED")]
fn ask_driver(descriptor: RawFd, sample_count: u32) -> io::Result<OffsetAnswer> {
    let mut answer = OffsetAnswer::asking_for(sample_count);
    // SAFETY: the request reads and writes one `ptp_sys_offset_extended`, which `answer` is.
    unsafe { ptp_sys_offset_extended(descriptor, &raw mut answer) }?;
    Ok(answer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    #[test]
    fn the_bound_covers_every_place_of_the_read_in_its_window() {
        for read_ns in 10_000..=10_301 {
            let pair = NicPair::from_reads(10_000, read_ns + 37_000_000_000, 10_301).unwrap();
            assert!(pair.nic_offset_ns.abs_diff(37_000_000_000) <= pair.bound_ns);
        }
    }

    #[test]
    fn reads_of_simulated_clocks_are_within_their_bound_and_the_narrowest_wins() {
        let mut random = RandomStream::new(3, "card pairs");
        for _ in 0..10_000 {
            let offset_ns = (random.next_u64() >> 20).cast_signed() - (1 << 43);
            let reads: Vec<[i64; 3]> = (0..5)
                .map(|index| {
                    let before_ns = 1_000_000 * index;
                    let width_ns = (random.next_u64() % 50_000).cast_signed() + 1;
                    let read_ns = before_ns + random.next_u64().cast_signed().rem_euclid(width_ns);
                    [before_ns, read_ns + offset_ns, before_ns + width_ns]
                })
                .collect();
            let pair = NicPair::narrowest(reads.clone()).unwrap();
            let narrowest_ns = reads.iter().map(|read| read[2] - read[0]).min().unwrap();
            assert_eq!(pair.bound_ns, narrowest_ns.unsigned_abs().div_ceil(2));
            assert!(pair.nic_offset_ns.abs_diff(offset_ns) <= pair.bound_ns);
        }
    }

    #[test]
    fn a_clock_set_back_during_the_read_gives_no_pair() {
        assert_eq!(NicPair::from_reads(100, 50, 99), None);
        assert_eq!(NicPair::narrowest([[100, 50, 99]]), None);
        let good = NicPair::narrowest([[100, 50, 99], [100, 150, 120]]).unwrap();
        assert_eq!((good.realtime_ns, good.bound_ns), (110, 10));
    }

    #[test]
    fn an_answer_of_the_driver_is_read_as_far_as_it_was_filled() {
        let mut answer = OffsetAnswer::asking_for(2);
        let time = |seconds, nanoseconds| ClockTime {
            seconds,
            nanoseconds,
            reserved: 0,
        };
        answer.samples[0] = [time(5, 999_999_900), time(42, 0), time(6, 100)];
        answer.samples[1] = [time(7, 0), time(43, 999_999_990), time(7, 20)];
        let reads: Vec<[i64; 3]> = answer.reads().collect();
        assert_eq!(reads[0], [5_999_999_900, 42_000_000_000, 6_000_000_100]);
        let pair = NicPair::narrowest(reads).unwrap();
        assert_eq!((pair.bound_ns, pair.realtime_ns), (10, 7_000_000_010));
        assert_eq!(pair.nic_offset_ns, 36_999_999_980);
        answer.sample_count = 1_000;
        assert_eq!(answer.reads().count(), 25);
    }

    #[test]
    fn a_clock_that_is_not_there_is_named() {
        let error = NicClock::open(4_000_000_000).unwrap_err();
        assert!(error.to_string().contains("/dev/ptp4000000000"), "{error}");
    }

    #[test]
    fn what_is_no_nic_clock_refuses_both_ways_of_reading() {
        let file = File::open("/dev/null").unwrap();
        assert!(ask_driver(file.as_raw_fd(), 1).is_err());
        assert!(read_ns(dynamic_clock(file.as_raw_fd())).is_err());
    }
}
