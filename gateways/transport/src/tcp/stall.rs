//! Stalls of a stream: when its oldest byte has waited for its acknowledgement longer than a
//! healthy connection ever needs. It asks no kernel and reads no clock.

use core::time::Duration;
use std::collections::VecDeque;

use hil_core::time::Instant;

use crate::Stalls;

/// A receiver may keep an acknowledgement back for 40 ms (`TCP_DELACK_MIN` of Linux) or for one
/// round trip, whichever is longer, and both it and the data are under way; its timer may be a
/// tick late, 10 ms at the slowest. What waits longer than that is not waiting for politeness.
const DELAYED_ACKNOWLEDGEMENT: Duration = Duration::from_millis(40 + 10);
/// Between looks while a stall lasts: the resolution of its length.
pub(super) const LOOK_PERIOD: Duration = Duration::from_millis(5);
/// Sends remembered one by one; further ones count as old as the last of these.
const MARK_COUNT_MAX: usize = 1024;

/// Everything accepted up to a place in the stream waits since then.
#[derive(Debug, Clone, Copy)]
struct Mark {
    end: u64,
    since: Instant,
}

/// The watch.
#[derive(Debug)]
pub(super) struct StallWatch {
    marks: VecDeque<Mark>,
    /// Bytes of the stream so far.
    accepted: u64,
    rtt_min: Duration,
    stalled_since: Option<Instant>,
    stalls: Stalls,
    /// Most bytes seen waiting.
    pub(super) waiting_bytes_max: u64,
}

impl StallWatch {
    pub(super) fn new() -> Self {
        Self {
            marks: VecDeque::with_capacity(MARK_COUNT_MAX),
            accepted: 0,
            rtt_min: Duration::ZERO,
            stalled_since: None,
            stalls: Stalls::default(),
            waiting_bytes_max: 0,
        }
    }

    /// Twice the smallest round trip and 50 ms.
    pub(super) fn threshold(&self) -> Duration {
        2 * self.rtt_min + DELAYED_ACKNOWLEDGEMENT
    }

    /// The smallest round trip the kernel has seen on this connection.
    pub(super) fn set_rtt_min(&mut self, rtt_min: Duration) {
        self.rtt_min = rtt_min;
    }

    /// The stream grew by `count` bytes.
    pub(super) fn on_accepted(&mut self, count: usize, now: Instant) {
        self.accepted += count as u64;
        let end = self.accepted;
        if self.marks.len() < MARK_COUNT_MAX {
            self.marks.push_back(Mark { end, since: now });
        } else if let Some(newest) = self.marks.back_mut() {
            newest.end = end;
        }
    }

    /// True while bytes wait for their acknowledgement, as far as is known.
    pub(super) fn is_waiting(&self) -> bool {
        !self.marks.is_empty()
    }

    /// The last `waiting` bytes of the stream are not acknowledged yet.
    pub(super) fn on_look(&mut self, waiting: u64, now: Instant) {
        self.waiting_bytes_max = self.waiting_bytes_max.max(waiting);
        let acknowledged = self.accepted.saturating_sub(waiting);
        while self
            .marks
            .front()
            .is_some_and(|mark| mark.end <= acknowledged)
        {
            self.marks.pop_front();
        }
        let oldest = self.marks.front().map(|mark| mark.since);
        let overdue =
            oldest.filter(|since| now.saturating_duration_since(*since) > self.threshold());
        match (self.stalled_since, overdue) {
            (None, Some(since)) => self.stalled_since = Some(since),
            (Some(since), None) => self.end_stall(since, now),
            (None, None) | (Some(_), Some(_)) => {}
        }
    }

    /// The connection is gone, and with it everything that waited.
    pub(super) fn on_lost(&mut self, now: Instant) {
        self.marks.clear();
        if let Some(since) = self.stalled_since {
            self.end_stall(since, now);
        }
    }

    fn end_stall(&mut self, since: Instant, now: Instant) {
        self.stalled_since = None;
        self.stalls.add(now.saturating_duration_since(since));
    }

    /// When to look next without any other reason to; `None` while nothing waits.
    pub(super) fn next_look(&self, looked: Instant) -> Option<Instant> {
        let oldest = self.marks.front()?;
        Some(if self.stalled_since.is_some() {
            looked + LOOK_PERIOD
        } else {
            // One nanosecond later it is overdue.
            (oldest.since + self.threshold() + Duration::from_nanos(1)).max(looked + LOOK_PERIOD)
        })
    }

    /// What was seen until `now`, a stall that still lasts included.
    pub(super) fn metrics(&self, now: Instant) -> Stalls {
        let mut stalls = Stalls {
            threshold: self.threshold(),
            ..self.stalls
        };
        if let Some(since) = self.stalled_since {
            stalls.add(now.saturating_duration_since(since));
        }
        stalls
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    fn watch() -> StallWatch {
        let mut watch = StallWatch::new();
        watch.set_rtt_min(Duration::from_millis(5));
        assert_eq!(watch.threshold(), Duration::from_millis(60));
        watch
    }

    #[test]
    fn a_stall_is_as_long_as_its_oldest_byte_waited() {
        let mut watch = watch();
        watch.on_accepted(100, at(0));
        watch.on_accepted(100, at(10));
        watch.on_look(200, at(60));
        assert_eq!(watch.metrics(at(60)).count, 0, "60 ms are no stall yet");
        assert_eq!(watch.next_look(at(60)), Some(at(65)));
        watch.on_look(200, at(65));
        assert_eq!(watch.metrics(at(65)).longest, Duration::from_millis(65));
        // The first is acknowledged, the second is overdue as well: it is one stall.
        watch.on_look(100, at(80));
        watch.on_look(0, at(90));
        let figures = watch.metrics(at(1_000));
        assert_eq!(
            (figures.count, figures.longest),
            (1, Duration::from_millis(90))
        );
        assert_eq!(watch.waiting_bytes_max, 200);
        assert_eq!(watch.next_look(at(90)), None);
    }

    #[test]
    fn acknowledgements_in_time_are_no_stall_however_long_the_stream_is_busy() {
        let mut watch = watch();
        for ms in 0..1_000 {
            watch.on_accepted(100, at(ms));
            // Thirty messages are always under way.
            watch.on_look(3_000, at(ms));
        }
        assert_eq!(watch.metrics(at(1_000)).count, 0);
        assert!(watch.is_waiting());
    }

    #[test]
    fn a_late_look_at_what_was_acknowledged_in_time_is_no_stall() {
        let mut watch = watch();
        watch.on_accepted(100, at(0));
        watch.on_look(0, at(500));
        let none = Stalls {
            threshold: watch.threshold(),
            ..Stalls::default()
        };
        assert_eq!((watch.metrics(at(500)), watch.waiting_bytes_max), (none, 0));
    }

    #[test]
    fn a_lost_connection_ends_its_stall() {
        let mut watch = watch();
        watch.on_accepted(100, at(0));
        watch.on_look(100, at(100));
        watch.on_lost(at(200));
        assert_eq!(watch.metrics(at(900)).total, Duration::from_millis(200));
        assert!(!watch.is_waiting());
    }

    #[test]
    fn more_sends_than_are_remembered_stay_accounted_for() {
        let mut watch = watch();
        for index in 0..3_000 {
            watch.on_accepted(10, at(index / 100));
        }
        watch.on_look(30_000, at(100));
        assert_eq!(watch.metrics(at(100)).count, 1);
        watch.on_look(10, at(110));
        assert!(watch.is_waiting(), "the last byte is still out");
        watch.on_look(0, at(120));
        assert_eq!(watch.metrics(at(120)).longest, Duration::from_millis(120));
        assert!(!watch.is_waiting());
    }
}
