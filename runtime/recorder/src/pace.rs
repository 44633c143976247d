//! How often somebody looks who reads files, which wait, and perhaps shared memory, whose room is
//! bounded: as seldom as that leaves plenty of room, for every look takes a processor and its caches from
//! whoever carries messages in the next moment.

use std::time::Duration;

use hil_watch::Feed;

/// The share of its room that a channel may take between two looks. The rest is for a look that comes
/// late, and for what a network lets through all at once.
const FILL_AIM_RATIO: f64 = 0.125;

/// The pause between two looks, fitted to what they find.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pace {
    least: Duration,
    most: Duration,
    pause: Duration,
}

impl Pace {
    /// For a run that is read from `feed`: `least` where what a late look misses is lost, `most` where
    /// all waits in files, and between them where what is missed comes again.
    pub(crate) fn of(feed: &Feed, least: Duration, most: Duration) -> Self {
        match (feed.reads_memory(), feed.waits()) {
            (false, _) => Self::between(most, most),
            (true, true) => Self::between(least, most),
            (true, false) => Self::between(least, least),
        }
    }

    const fn between(least: Duration, most: Duration) -> Self {
        Self {
            least,
            most,
            pause: least,
        }
    }

    /// The pause after a look that found so much of the fullest channel's room taken. It grows by steps,
    /// and shrinks at once.
    pub(crate) fn after(&mut self, fill_ratio: f64) -> Duration {
        let fitting = FILL_AIM_RATIO / fill_ratio.max(f64::MIN_POSITIVE);
        let next = self.pause.mul_f64(fitting.min(2.0));
        self.pause = next.clamp(self.least, self.most.max(self.least));
        self.pause
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn it_looks_as_seldom_as_an_eighth_of_the_room_allows() {
        let mut pace = Pace::between(ms(10), ms(500));
        // 1 kHz into room for 1024 messages.
        let fill = |pause: Duration| pause.as_secs_f64() * 1000.0 / 1024.0;
        let mut pause = ms(10);
        for _ in 0..10 {
            pause = pace.after(fill(pause));
        }
        assert!(pause.abs_diff(ms(128)) < ms(1), "{pause:?}");
        // All that was held up comes at once: back in one step.
        assert_eq!(pace.after(1.0), pause.mul_f64(0.125));
        // Nothing comes: by steps to the longest.
        let pauses: Vec<Duration> = (0..6).map(|_| pace.after(0.0)).collect();
        assert_eq!(pauses[0], pause.mul_f64(0.25));
        assert_eq!(pauses[5], ms(500));
        assert_eq!(pace.after(1e9), ms(10));
    }

    #[test]
    fn what_has_no_room_to_fit_itself_stays() {
        for fill in [0.0, 0.1, 1.0] {
            assert_eq!(Pace::between(ms(10), ms(10)).after(fill), ms(10));
            // Where a flush comes sooner than the shortest pause.
            assert_eq!(Pace::between(ms(10), ms(5)).after(fill), ms(10));
        }
    }
}
