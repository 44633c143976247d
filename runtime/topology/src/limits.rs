//! Default, minimum and maximum of the numbers that the topology itself defines. Parts of a link,
//! transports and cases state their own.

use core::fmt;
use core::ops::RangeInclusive;
use core::time::Duration;

use super::units::format_duration;

/// The bounds of one number.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit<T> {
    /// What it is when the file does not say.
    pub default: T,
    /// Smallest allowed.
    pub min: T,
    /// Largest allowed.
    pub max: T,
}

const fn limit<T: Copy>(default: T, min: T, max: T) -> Limit<T> {
    Limit { default, min, max }
}

const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

/// The only version of the format.
pub(super) const VERSION: Limit<i64> = limit(1, 1, 1);

pub(super) const RUN_DURATION: Limit<Duration> = limit(ms(20_000), ms(100), ms(7 * 86_400_000));
pub(super) const RUN_SEED: Limit<i64> = limit(1, 0, i64::MAX);
pub(super) const RUN_START_TIMEOUT: Limit<Duration> = limit(ms(30_000), ms(1_000), ms(3_600_000));
/// Long enough for a radio to roam; a host that really vanished is noticed within half a minute.
pub(super) const RUN_PEER_TIMEOUT: Limit<Duration> = limit(ms(30_000), ms(1_000), ms(3_600_000));

pub(super) const HOST_CONTROL_PORT: Limit<i64> = limit(7_399, 1_024, 65_535);
/// Below the ports of links, with room for ten clock paths of one host.
pub(super) const HOST_CLOCK_PORT: Limit<i64> = limit(7_390, 1_024, 65_535);

/// Cores are counted from 0; without the key any core will do, so the default is unused.
pub(super) const CPU: Limit<i64> = limit(0, 0, 1_023);
/// Below the 50 that threaded interrupt handlers get on `PREEMPT_RT`, so that the network card
/// is served first.
pub(super) const FIFO_PRIORITY: Limit<i64> = limit(40, 1, 99);
/// 0 would mean "the kernel's own default" of 50 us.
pub(super) const TIMER_SLACK: Limit<Duration> =
    limit(Duration::from_micros(1), Duration::from_nanos(1), ms(1));
/// Of a gateway on an emulated link: it sleeps until 90 us before a datagram is due and spins then,
/// so a timer that is half of that late is still in time.
pub(super) const EMULATED_TIMER_SLACK_MAX: Duration = Duration::from_micros(45);
pub(super) const RESTART_LIMIT: Limit<i64> = limit(3, 1, 100);

pub(super) const CHANNEL_DEPTH: Limit<i64> = limit(16, 1, 1_024);
/// Without default: a foreign channel must say how large its messages are.
pub(super) const MESSAGE_SIZE_BYTES: Limit<i64> = limit(1, 1, 16_777_216);
/// A power of two.
pub(super) const MESSAGE_ALIGNMENT_BYTES: Limit<i64> = limit(8, 1, 64);

pub(super) const LINK_PORT: Limit<i64> = limit(7_400, 1_024, 65_534);
pub(super) const LINK_DSCP: Limit<i64> = limit(0, 0, 63);
/// 256 to 263 select a Wi-Fi user priority directly. Without the key the kernel derives the
/// priority from the code point, so the default is unused.
pub(super) const LINK_SOCKET_PRIORITY: Limit<i64> = limit(0, 0, 263);
/// Linux's own default size.
pub(super) const LINK_BUFFER_BYTES: Limit<i64> = limit(212_992, 4_096, 67_108_864);
/// Smallest: what every IPv4 host must accept (RFC 791).
pub(super) const LINK_PATH_MTU_BYTES: Limit<i64> = limit(1_500, 576, 65_535);
/// Of the shorthands of a link, as the laws they stand for have it.
pub(super) const LINK_DELAY: Limit<Duration> = limit(ms(0), ms(0), ms(10_000));
pub(super) const LINK_LOSS_RATIO: Limit<f64> = limit(0.0, 0.0, 1.0);

/// Joints of an arm on the wire of an EGM adapter.
pub(super) const EGM_AXES: Limit<i64> = limit(7, 6, 7);
/// Generation of the robot's software whose fields an EGM adapter writes.
pub(super) const EGM_ROBOTWARE: Limit<i64> = limit(7, 6, 7);
/// A robot takes one message per cycle of 4 ms; senders of up to four times that are seen.
pub(super) const EGM_SEND_HZ: Limit<f64> = limit(250.0, 1.0, 1_000.0);

/// Longest name of a run, host, process, channel or link.
pub(super) const NAME_LENGTH_MAX: usize = 64;
/// Longest chain of files that extend each other.
pub(super) const EXTENDS_DEPTH_MAX: usize = 16;
/// Largest topology file.
pub(super) const FILE_BYTES_MAX: u64 = 1_048_576;

impl<T: PartialOrd + Copy> Limit<T> {
    /// Of an option that is required, or whose default its part knows.
    pub(super) fn of(range: &RangeInclusive<T>) -> Self {
        limit(*range.start(), *range.start(), *range.end())
    }

    /// True when `value` is allowed; NaN never is.
    pub(super) fn allows(&self, value: &T) -> bool {
        (self.min..=self.max).contains(value)
    }
}

impl Limit<i64> {
    /// As [`Limit::of`], of integers of another type: a file's have 64 bits.
    pub(super) fn whole<T: TryInto<i64> + Copy>(range: &RangeInclusive<T>) -> Self {
        let [min, max] = [*range.start(), *range.end()].map(|end| end.try_into().ok());
        let (min, max) = min.zip(max).expect("ranges are within 64 bits");
        limit(min, min, max)
    }
}

/// `min..=max` in the words of the file.
pub(super) trait RangeText {
    fn range_text(&self) -> String;
}

impl RangeText for Limit<i64> {
    fn range_text(&self) -> String {
        plain_range(self)
    }
}

impl RangeText for Limit<f64> {
    fn range_text(&self) -> String {
        plain_range(self)
    }
}

impl RangeText for Limit<Duration> {
    fn range_text(&self) -> String {
        let (min, max) = (format_duration(self.min), format_duration(self.max));
        format!("\"{min}\" to \"{max}\"")
    }
}

fn plain_range<T: fmt::Display + PartialEq>(limit: &Limit<T>) -> String {
    if limit.min == limit.max {
        limit.min.to_string()
    } else {
        format!("{} to {}", limit.min, limit.max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_default_lies_within_its_own_limits() {
        for limit in [
            VERSION,
            RUN_SEED,
            HOST_CONTROL_PORT,
            HOST_CLOCK_PORT,
            CPU,
            FIFO_PRIORITY,
            RESTART_LIMIT,
            CHANNEL_DEPTH,
            MESSAGE_SIZE_BYTES,
            MESSAGE_ALIGNMENT_BYTES,
            LINK_PORT,
            LINK_DSCP,
            LINK_SOCKET_PRIORITY,
            LINK_BUFFER_BYTES,
            LINK_PATH_MTU_BYTES,
            EGM_AXES,
            EGM_ROBOTWARE,
        ] {
            assert!(limit.allows(&limit.default), "{limit:?}");
        }
        for limit in [
            RUN_DURATION,
            RUN_START_TIMEOUT,
            RUN_PEER_TIMEOUT,
            TIMER_SLACK,
            LINK_DELAY,
        ] {
            assert!(limit.allows(&limit.default), "{limit:?}");
        }
        assert!(LINK_LOSS_RATIO.allows(&LINK_LOSS_RATIO.default));
        assert!(EGM_SEND_HZ.allows(&EGM_SEND_HZ.default));
        assert!(!LINK_LOSS_RATIO.allows(&f64::NAN));
    }
}
