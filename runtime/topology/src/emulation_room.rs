//! How many datagrams an emulated link must hold, and whether a gateway can: worked out before a run
//! starts. It holds nothing itself; what overflows all the same is counted by the receiver.

use core::fmt;
use core::time::Duration;

use hil_core::case_study::ParameterError;
use hil_link::spec::LinkSpec;
use hil_protocol::wire;

use crate::Topology;
use crate::emulation::{EmulationError, EmulationLaunch};

/// Datagrams there is room for whatever the link does: bursts.
const BURST_COUNT: usize = 1024;
/// Most datagrams a gateway holds on one channel.
const CAPACITY_MAX: usize = 65_536;
/// Most datagrams a gateway holds on all channels of one way of a link.
const FLOW_CAPACITY_MAX: usize = 1 << 20;
/// Datagrams per second that room is made for, while they are under way.
const SIZED_RATE_HZ: f64 = 4_000.0;
/// And while an outage holds them.
const OUTAGE_RATE_HZ: f64 = 1_000.0;
/// Long messages per second that room is made for, while their pieces are under way.
const LONG_RATE_HZ: f64 = 30.0;
/// What one of them carries on Ethernet.
const PIECE_BYTES: usize = wire::payload_budget_bytes(1_472);
/// A link that cannot be kept at this rate is refused: no control channel is slower.
const LEAST_RATE_HZ: f64 = 100.0;
/// All but one in a million are under way for less than what is reckoned with.
const QUANTILE: f64 = 1.0 - 1e-6;
/// Exponential outages are longer than so many means once in 3000.
const OUTAGE_MEANS: f64 = 8.0;

/// Room for what an emulated link holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EmulationRoom {
    /// Datagrams held at a time.
    pub capacity_count: usize,
    /// How long one may be held, but for one in a million and one outage in 3000.
    pub held_max: Duration,
    /// Datagrams per second up to which none is dropped for want of room.
    pub rate_max_hz: f64,
}

impl EmulationRoom {
    /// What a link that does as `spec` says needs on a channel of messages of `message_bytes`.
    ///
    /// # Errors
    /// When a gateway cannot hold what 100 messages per second leave under way.
    pub fn of(spec: &LinkSpec, message_bytes: usize) -> Result<Self, ParameterError> {
        let outage_s = if spec.outages.is_active() && spec.outages.buffered {
            OUTAGE_MEANS * spec.outages.mean_s
        } else {
            0.0
        };
        let without_queue = LinkSpec {
            rate: None,
            ..spec.clone()
        };
        let way_s = without_queue.flight_time(QUANTILE).as_secs_f64();
        let (queue_s, queue_count) = spec.rate.map_or((0.0, 0.0), |rate| {
            // A queue of short messages holds more of them, but never more than fit.
            let least = (message_bytes + wire::HEADER_BYTES) as u64 + rate.overhead_bytes;
            let count = (rate.queue_bytes / least.max(1)) as f64;
            (rate.longest().as_secs_f64(), count)
        });
        // What a copy of each message takes on top.
        let copies = spec.duplication.map_or(1.0, |one| 1.0 + one.ratio);
        let held = |rate_hz: f64, outage_hz: f64| {
            let queued = (rate_hz * queue_s).min(queue_count);
            copies * (rate_hz * way_s + queued + outage_hz * outage_s)
        };
        let least = held(LEAST_RATE_HZ, LEAST_RATE_HZ);
        if least > CAPACITY_MAX as f64 {
            let problem = format!(
                "asks for too much: a gateway holds at most {CAPACITY_MAX} datagrams of a channel, and {LEAST_RATE_HZ} \
                 messages per second leave {least:.0} under way: {way_s:.1} s of delay, {queue_s:.1} s \
                 of queue, {outage_s:.1} s of an outage that holds them"
            );
            return Err(ParameterError::new(
                refused_key(way_s, queue_s, outage_s),
                problem,
            ));
        }
        // A long message brings many datagrams at once, and is not sent as often.
        let more_pieces = message_bytes.div_ceil(PIECE_BYTES).max(1) - 1;
        let long =
            more_pieces as f64 * copies * (2.0 + LONG_RATE_HZ * (way_s + queue_s + outage_s));
        let wanted = BURST_COUNT as f64 + held(SIZED_RATE_HZ, OUTAGE_RATE_HZ) + long;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "positive, and cut at the bound"
        )]
        let capacity_count = wanted.min(CAPACITY_MAX as f64).ceil() as usize;
        // A full queue holds the same number at any rate that fills it.
        let beside_queue =
            capacity_count as f64 - copies * queue_count.min(SIZED_RATE_HZ * queue_s);
        let held_s = way_s + queue_s + outage_s;
        Ok(Self {
            capacity_count,
            held_max: Duration::from_secs_f64(held_s),
            rate_max_hz: beside_queue.max(0.0) / (copies * (way_s + outage_s)),
        })
    }
}

impl EmulationRoom {
    /// Room for this and for what another channel holds beside it, as far as one gateway can have it.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        let wanted = self.capacity_count + other.capacity_count;
        let largest = self.capacity_count.max(other.capacity_count);
        Self {
            capacity_count: wanted.min(FLOW_CAPACITY_MAX.max(largest)),
            held_max: self.held_max.max(other.held_max),
            rate_max_hz: self.rate_max_hz + other.rate_max_hz,
        }
    }

    /// The longest fixed delay that this much room holds at 100 messages per second.
    pub fn longest_delay(&self) -> Duration {
        Duration::from_secs_f64(self.capacity_count as f64 / LEAST_RATE_HZ)
    }
}

/// Whether gateways can hold what every emulated link of `topology` leaves under way.
///
/// # Errors
/// The first link for which they cannot, or a trace that cannot be read.
pub fn check_emulation(topology: &Topology) -> Result<(), EmulationError> {
    for crossing in topology.crossings() {
        if let Some(emulation) = EmulationLaunch::of(&crossing, topology.run().seed) {
            emulation.room(crossing.channel.message.size_bytes)?;
        }
    }
    Ok(())
}

/// The part of the description that weighs most.
fn refused_key(way_s: f64, queue_s: f64, outage_s: f64) -> &'static str {
    if outage_s >= way_s.max(queue_s) {
        "outages.mean"
    } else if queue_s >= way_s {
        "rate.queue_bytes"
    } else {
        "delay"
    }
}

impl fmt::Display for EmulationRoom {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} datagrams", self.capacity_count)?;
        if self.rate_max_hz.is_finite() {
            let held_ms = self.held_max.as_secs_f64() * 1e3;
            write!(
                formatter,
                ", enough for {:.0} per second that are held for up to {held_ms:.0} ms",
                self.rate_max_hz
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use hil_link::outages::Outages;
    use hil_link::rate::RateLimit;

    use super::*;

    fn held(delay_ms: u64, mean_s: f64, buffered: bool) -> LinkSpec {
        LinkSpec {
            outages: Outages {
                mean_s,
                per_hour: 1.0,
                buffered,
            },
            ..LinkSpec::fixed(Duration::from_millis(delay_ms), 0.0)
        }
    }

    #[test]
    fn room_is_made_for_what_is_under_way_and_none_above_the_bound() {
        let room = |spec: &LinkSpec| EmulationRoom::of(spec, 64).unwrap();
        assert_eq!(room(&LinkSpec::default()).capacity_count, 1_024);
        assert!(room(&LinkSpec::default()).rate_max_hz.is_infinite());
        assert_eq!(room(&held(5, 0.5, false)).capacity_count, 1_024 + 20);
        assert_eq!(room(&held(5, 0.5, true)).capacity_count, 1_024 + 20 + 4_000);
        let cut = room(&held(5, 60.0, true));
        assert_eq!(cut.capacity_count, CAPACITY_MAX);
        assert!((100.0..140.0).contains(&cut.rate_max_hz), "{cut}");
        assert!(
            cut.to_string().contains("held for up to 480005 ms"),
            "{cut}"
        );
    }

    #[test]
    fn a_link_that_no_gateway_can_hold_is_refused_with_its_numbers() {
        let error = EmulationRoom::of(&held(5, 100.0, true), 64).unwrap_err();
        assert_eq!(error.key, "outages.mean");
        let said = error.to_string();
        assert!(
            said.contains("65536") && said.contains("800.0 s of an outage"),
            "{said}"
        );
        // 64 MiB at 10 kbit/s take 15 hours, and short messages fill it with 400 000.
        let slow = |queue_bytes| LinkSpec {
            rate: Some(RateLimit {
                bits_per_second: 10_000,
                queue_bytes,
                overhead_bytes: 28,
            }),
            ..LinkSpec::default()
        };
        let error = EmulationRoom::of(&slow(67_108_864), 64).unwrap_err();
        assert_eq!(error.key, "rate.queue_bytes");
        // A queue of a thousand is one, however slow it empties.
        let room = EmulationRoom::of(&slow(164_000), 64).unwrap();
        assert_eq!(room.capacity_count, 1_024 + 1_000);
    }
}
