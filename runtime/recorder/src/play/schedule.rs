//! When each message of a recording is due, round after round, on an absolute grid. It reads no
//! clock and publishes nothing.

use std::time::Duration;

/// A message that left later than this after it was due is counted as late.
const LATE: Duration = Duration::from_millis(1);

/// The grid of a recording.
#[derive(Debug, Clone)]
pub(crate) struct Schedule {
    /// Of each message after the first one, nanoseconds, in order.
    after_ns: Vec<u64>,
    speed: f64,
    /// From the first message of a round to that of the next, as recorded, nanoseconds.
    round_ns: u64,
}

/// How well the grid was kept.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Punctuality {
    /// Messages published.
    pub(crate) published_count: u64,
    /// Those that left more than a millisecond after they were due.
    pub(crate) late_count: u64,
    /// Those that left less than half as long after the one before on their channel as they were
    /// due, because that one was late: receivers saw them closer together than they were recorded.
    pub(crate) bunched_count: u64,
    /// Largest lateness, nanoseconds.
    pub(crate) worst_ns: u64,
    /// When the last one was due and when it left, by channel.
    last: Vec<Option<(u64, u64)>>,
}

impl Schedule {
    /// For messages `after_ns` after the first one, in order, played at `speed` times the recorded
    /// one. A further round begins one mean gap after the last message.
    pub(crate) fn new(after_ns: Vec<u64>, speed: f64) -> Self {
        let last_ns = after_ns.last().copied().unwrap_or(0);
        let gap_count = after_ns.len().saturating_sub(1) as u64;
        let mean_ns = last_ns.checked_div(gap_count).unwrap_or(1_000_000_000);
        Self {
            after_ns,
            speed,
            round_ns: last_ns + mean_ns.max(1),
        }
    }

    /// When message `place` of `round` is due after the first one of all, nanoseconds.
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "times of runs at bounded speeds; beyond 584 years the conversion saturates"
    )]
    pub(crate) fn due_ns(&self, round: u64, place: usize) -> u64 {
        let recorded_ns = self.after_ns[place] + round.saturating_mul(self.round_ns);
        (recorded_ns as f64 / self.speed).round() as u64
    }
}

impl Punctuality {
    /// For messages on `channel_count` channels.
    pub(crate) fn of(channel_count: usize) -> Self {
        Self {
            last: vec![None; channel_count],
            ..Self::default()
        }
    }

    /// A message on `channel` that was due at `due_ns` left at `at_ns`, both since the first one of
    /// all was due.
    pub(crate) fn note(&mut self, channel: usize, due_ns: u64, at_ns: u64) {
        self.published_count += 1;
        let late_ns = at_ns.saturating_sub(due_ns);
        self.worst_ns = self.worst_ns.max(late_ns);
        self.late_count += u64::from(u128::from(late_ns) > LATE.as_nanos());
        let before = self.last[channel].replace((due_ns, at_ns));
        if let Some((due_before_ns, before_ns)) = before {
            let wanted_ns = due_ns.saturating_sub(due_before_ns);
            let had_ns = at_ns.saturating_sub(before_ns);
            self.bunched_count += u64::from(2 * had_ns < wanted_ns);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn rounds_follow_each_other_as_messages_do() {
        let schedule = Schedule::new(vec![0, 8 * MS, 16 * MS], 1.0);
        let due: Vec<u64> = (0..2)
            .flat_map(|round| [0, 1, 2].map(|place| schedule.due_ns(round, place) / MS))
            .collect();
        assert_eq!(due, [0, 8, 16, 24, 32, 40]);
    }

    #[test]
    fn twice_the_speed_is_half_the_time_and_does_not_drift() {
        let schedule = Schedule::new((0..1_000).map(|number| number * 3).collect(), 2.0);
        assert_eq!(schedule.due_ns(0, 999), 1_499);
        assert_eq!(schedule.due_ns(1_000_000, 0), 1_500_000_000);
    }

    #[test]
    fn one_message_alone_comes_once_a_second() {
        let schedule = Schedule::new(vec![0], 1.0);
        assert_eq!(schedule.due_ns(3, 0), 3_000 * MS);
    }

    #[test]
    fn what_was_late_and_what_was_pressed_together_is_counted() {
        let mut kept = Punctuality::of(1);
        for (due, at) in [(0, 0), (8, 8), (16, 26), (24, 27), (32, 32)] {
            kept.note(0, due * MS, at * MS);
        }
        assert_eq!(kept.published_count, 5);
        assert_eq!((kept.late_count, kept.bunched_count), (2, 1));
        assert_eq!(kept.worst_ns, 10 * MS);
    }

    #[test]
    fn a_late_message_of_one_channel_presses_none_of_another() {
        let mut kept = Punctuality::of(2);
        for (channel, due, at) in [(0, 0, 0), (1, 4, 7), (0, 8, 8), (1, 12, 12)] {
            kept.note(channel, due * MS, at * MS);
        }
        assert_eq!((kept.late_count, kept.bunched_count), (1, 0));
        kept.note(1, 20 * MS, 15 * MS);
        assert_eq!(kept.bunched_count, 1);
    }
}
