//! Motion loops: how many were sent, how many executed, which were lost and why (Lv et al.,
//! equation 1). It counts on sampled signals and knows no messages; virtual-time tables use it too.

use hil_arm::egm::messages::EndCause;
use hil_core::interval::Spread;
use hil_stats::dependence::Batches;
use hil_stats::series::{Sample, peaks};

/// A motion loop counts when the tool falls back by this share of the nominal peak-to-peak.
pub(crate) const PROMINENCE_RATIO: f64 = 0.5;

/// What counts as a loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LoopCounter {
    /// How far the signal must fall and rise between peaks, metres.
    pub(crate) prominence_m: f64,
    /// Length of a loop, nanoseconds.
    pub(crate) period_ns: f64,
}

impl LoopCounter {
    /// The counter for loops of `peak_to_peak_m` and `period_s`.
    pub(crate) fn new(peak_to_peak_m: f64, period_s: f64) -> Self {
        Self {
            prominence_m: PROMINENCE_RATIO * peak_to_peak_m,
            period_ns: period_s * 1e9,
        }
    }

    /// Its definition, for the method of every figure made with it.
    pub(crate) fn text(&self) -> String {
        format!(
            "peaks of the right tool's y with a prominence of {:.4} m (half the nominal \
             peak-to-peak); loops of the last half period are left out",
            self.prominence_m
        )
    }

    /// Counts the loops of both signals, whose times are of one clock; `None` without a whole one.
    pub(crate) fn count(&self, sent: &[Sample], moved: &[Sample]) -> Option<Loops> {
        self.count_peaks(&peaks(sent, self.prominence_m), moved)
    }

    /// As [`LoopCounter::count`], with the times of the sent peaks already known. A loop sent so
    /// late that its execution may lie beyond the end of `moved` counts on neither side.
    pub(crate) fn count_peaks(&self, sent: &[i64], moved: &[Sample]) -> Option<Loops> {
        let (begin, end) = (moved.first()?.0, moved.last()?.0);
        let until = end as f64 - 0.5 * self.period_ns;
        let in_time = |at: &i64| *at >= begin && (*at as f64) <= until;
        let sent: Vec<i64> = sent.iter().copied().filter(in_time).collect();
        if sent.is_empty() {
            return None;
        }
        let executed = peaks(moved, self.prominence_m);
        let mut loops = Loops::matched(sent, &executed, self.period_ns);
        loops.leave_out_after(until);
        (loops.sent_count() > 0).then_some(loops)
    }
}

/// The loops of a run.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Loops {
    /// Times of the sent peaks.
    pub(crate) sent_ns: Vec<i64>,
    /// Times of the executed peaks that answer them; `None` for a lost one.
    pub(crate) answered_ns: Vec<Option<i64>>,
    /// Number of executed peaks.
    pub(crate) executed_count: usize,
    /// Which of the sent ones no executed one answers, with the time its execution was due.
    pub(crate) lost: Vec<LostLoop>,
    /// Executed peaks that answer none: a motion of the robot's own, or one loop cut in two.
    pub(crate) extra_count: usize,
}

/// One lost loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LostLoop {
    /// Its number among the sent ones, from 0.
    pub(crate) index: usize,
    /// When its peak would have been executed.
    pub(crate) due_ns: i64,
}

impl Loops {
    /// Gives every executed peak the sent one it lies nearest to, allowing for the delay the
    /// peaks before it had: a queue that never drains shifts all that follows. What comes after the
    /// last sent loop is over answers a later one.
    fn matched(sent_ns: Vec<i64>, executed_ns: &[i64], period_ns: f64) -> Self {
        const DELAY_SHARE: f64 = 0.25;
        let (mut delay_ns, mut next) = (0.0, 0);
        let (mut executed_count, mut extra_count) = (0, 0);
        let mut lost = Vec::new();
        let mut answered_ns = vec![None; sent_ns.len()];
        for executed in executed_ns {
            let due = |index: usize| sent_ns[index] as f64 + delay_ns;
            let apart = |index: usize| (*executed as f64 - due(index)).abs();
            if *executed as f64 > due(sent_ns.len() - 1) + 0.75 * period_ns {
                break;
            }
            executed_count += 1;
            let mut best = next;
            while best + 1 < sent_ns.len() && apart(best + 1) < apart(best) {
                best += 1;
            }
            if best >= sent_ns.len() || apart(best) > 0.75 * period_ns {
                extra_count += 1;
                continue;
            }
            for index in next..best {
                lost.push(LostLoop::of(index, due(index)));
            }
            let late_ns = *executed as f64 - due(best);
            delay_ns = (delay_ns + DELAY_SHARE * late_ns).max(-0.1 * period_ns);
            answered_ns[best] = Some(*executed);
            next = best + 1;
        }
        for (index, sent) in sent_ns.iter().enumerate().skip(next) {
            lost.push(LostLoop::of(index, *sent as f64 + delay_ns));
        }
        Self {
            sent_ns,
            answered_ns,
            executed_count,
            lost,
            extra_count,
        }
    }

    /// Leaves out the loops at the end that were due later than `until_ns`: a queue may hold them
    /// back for longer than the log goes on.
    fn leave_out_after(&mut self, until_ns: f64) {
        while let Some(last) = self.lost.last() {
            let is_newest = last.index + 1 == self.sent_ns.len();
            if !is_newest || (last.due_ns as f64) <= until_ns {
                break;
            }
            self.lost.pop();
            self.sent_ns.pop();
            self.answered_ns.pop();
        }
    }

    /// Number of sent loops.
    pub(crate) fn sent_count(&self) -> usize {
        self.sent_ns.len()
    }

    /// The motion loss rate; negative when the robot made more loops than were sent.
    pub(crate) fn loss_ratio(&self) -> f64 {
        let sent = self.sent_count() as f64;
        (sent - self.executed_count as f64) / sent
    }

    /// The interval of the motion loss rate, of the loops that no executed one answers, in their order; an extra
    /// loop moves it as it moves the rate.
    pub(crate) fn loss_interval(&self) -> Spread {
        let lost = self.lost.iter().map(|lost| (lost.index as u64, 1));
        let batches = Batches::of_runs(self.sent_count() as u64, lost);
        let shift = self.loss_ratio() - batches.mean();
        batches
            .share_interval()
            .map(|end| (end + shift).clamp(0.0, 1.0))
    }

    /// Loops missing from the executed ones; `None` when there were more than were sent.
    pub(crate) fn missing_count(&self) -> Option<u64> {
        Some(self.sent_count().checked_sub(self.executed_count)? as u64)
    }
}

impl LostLoop {
    #[allow(clippy::cast_possible_truncation, reason = "a time within the log")]
    fn of(index: usize, due_ns: f64) -> Self {
        Self {
            index,
            due_ns: due_ns as i64,
        }
    }
}

/// A stretch of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Span {
    /// When it begins.
    pub(crate) begin_ns: i64,
    /// When it is over.
    pub(crate) end_ns: i64,
}

impl Span {
    /// The stretch that began then, if one did, and ends now.
    pub(crate) fn ended(began_ns: &mut Option<i64>, end_ns: i64) -> Option<Self> {
        began_ns.take().map(|begin_ns| Self { begin_ns, end_ns })
    }
}

/// A time without a running session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pause {
    /// From the end of one session to the beginning of the next.
    pub(crate) span: Span,
    pub(crate) after: PauseAfter,
}

/// What came before a pause.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PauseAfter {
    /// Nothing: no session had begun.
    Start,
    /// A session, which ended by this, where that is recorded.
    Session(Option<EndCause>),
}

impl Pause {
    /// When it was and what came before, in words, its times since `origin_ns`.
    fn text(self, origin_ns: i64) -> String {
        let since = |at_ns: i64| at_ns.saturating_sub(origin_ns) as f64 * 1e-9;
        let why = match self.after {
            PauseAfter::Start => {
                return format!(
                    "the arm was in no EGM session until {:.3} s, when its first began",
                    since(self.span.end_ns)
                );
            }
            PauseAfter::Session(Some(EndCause::CommTimeout)) => "ended by CommTimeout",
            PauseAfter::Session(Some(EndCause::ConditionTime)) => "ended by CondTime",
            PauseAfter::Session(Some(EndCause::PositionDeviation)) => "ended by MaxPosDeviation",
            PauseAfter::Session(Some(EndCause::Requested)) => "stopped by request",
            PauseAfter::Session(None) => "why it ended is not recorded",
        };
        let (begin_s, end_s) = (since(self.span.begin_ns), since(self.span.end_ns));
        format!("the arm was in no EGM session from {begin_s:.3} s to {end_s:.3} s ({why})")
    }
}

/// Why a loop was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LossCause {
    /// No session ran in part of its time: the pause that took most of it.
    Trip(Pause),
    /// A session ran, but no commands came: the arm held.
    Held,
    /// Commands came, but inverse kinematics could not follow the hand.
    Clipped,
    /// `MaxSpeedDeviation` slowed the joints.
    Throttled,
    /// None of these: too little motion between this peak and its neighbours.
    Merged,
    /// No feedback came in part of its time: nobody knows what the robot did.
    Unseen,
}

/// The kinds of [`LossCause`], in the order of lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum LossKind {
    /// [`LossCause::Trip`].
    Trip,
    /// [`LossCause::Held`].
    Held,
    /// [`LossCause::Clipped`].
    Clipped,
    /// [`LossCause::Throttled`].
    Throttled,
    /// [`LossCause::Merged`].
    Merged,
    /// [`LossCause::Unseen`].
    Unseen,
}

impl LossKind {
    pub(crate) const COUNT: usize = 6;
}

/// Lost loops by [`LossKind`].
pub(crate) type LostByKind = [u64; LossKind::COUNT];

impl LossCause {
    /// Its kind.
    pub(crate) const fn kind(self) -> LossKind {
        match self {
            Self::Trip(_) => LossKind::Trip,
            Self::Held => LossKind::Held,
            Self::Clipped => LossKind::Clipped,
            Self::Throttled => LossKind::Throttled,
            Self::Merged => LossKind::Merged,
            Self::Unseen => LossKind::Unseen,
        }
    }

    /// In words; times are told since `origin_ns`.
    pub(crate) fn text(self, origin_ns: i64) -> String {
        match self {
            Self::Trip(pause) => return pause.text(origin_ns),
            Self::Held => "held through for want of commands",
            Self::Clipped => "commands were clipped: the hand was out of the arm's reach",
            Self::Throttled => "throttled by MaxSpeedDeviation",
            Self::Merged => "merged with its neighbour: the tool moved too little in between",
            Self::Unseen => "no feedback came in part of it: what the robot did is not known",
        }
        .to_owned()
    }
}

/// What may have cost a loop; each list in order of time and without overlaps.
#[derive(Debug, Clone, Default)]
pub(crate) struct Evidence {
    /// Times without a running session.
    pub(crate) pauses: Vec<Pause>,
    /// Times without commands while a session ran.
    pub(crate) holds: Vec<Span>,
    /// Times in which commands were limited or unreachable.
    pub(crate) clipped: Vec<Span>,
    /// Times in which `MaxSpeedDeviation` bound.
    pub(crate) throttled: Vec<Span>,
    /// Times without feedback.
    pub(crate) unseen: Vec<Span>,
    /// Since when there is no session, and what came before.
    pub(crate) pause_began: Option<(i64, PauseAfter)>,
    /// Since when the arm holds.
    pub(crate) hold_began_ns: Option<i64>,
    /// Since when `MaxSpeedDeviation` binds.
    pub(crate) throttle_began_ns: Option<i64>,
}

/// Something explains a lost loop when it fills at least this share of the loop's time.
const EXPLAINS_RATIO: f64 = 0.05;

/// The share for throttling: after every hold the arm hurries for a moment, which costs no loop.
const THROTTLES_RATIO: f64 = 0.2;

impl Evidence {
    /// Why the loop whose peak was due at `due_ns` was lost: what happened within half a period
    /// of it. A pause explains it before missing feedback does, then a hold, clipping, throttling.
    pub(crate) fn cause_of(&self, due_ns: i64, period_ns: f64) -> LossCause {
        let window = Span::around(due_ns, period_ns);
        let pauses = within(&self.pauses, window, |pause| pause.span);
        let paused_ns: i64 = pauses
            .iter()
            .map(|pause| pause.span.overlap_ns(window))
            .sum();
        let longest = pauses.iter().max_by_key(|p| p.span.overlap_ns(window));
        if let Some(longest) = longest
            && paused_ns as f64 >= EXPLAINS_RATIO * period_ns
        {
            return LossCause::Trip(*longest);
        }
        let explains = |spans: &[Span], share: f64| {
            let overlap_ns: i64 = within(spans, window, |span| *span)
                .iter()
                .map(|span| span.overlap_ns(window))
                .sum();
            overlap_ns as f64 >= share * period_ns
        };
        if explains(&self.unseen, EXPLAINS_RATIO) {
            LossCause::Unseen
        } else if explains(&self.holds, EXPLAINS_RATIO) {
            LossCause::Held
        } else if explains(&self.clipped, EXPLAINS_RATIO) {
            LossCause::Clipped
        } else if explains(&self.throttled, THROTTLES_RATIO) {
            LossCause::Throttled
        } else {
            LossCause::Merged
        }
    }
}

impl Evidence {
    /// The time without a session is over, if one is under way.
    pub(crate) fn end_pause(&mut self, end_ns: i64) {
        if let Some((begin_ns, after)) = self.pause_began.take() {
            let span = Span { begin_ns, end_ns };
            self.pauses.push(Pause { span, after });
        }
    }

    /// The hold is over, if one is under way.
    pub(crate) fn end_hold(&mut self, end_ns: i64) {
        self.holds
            .extend(Span::ended(&mut self.hold_began_ns, end_ns));
    }

    /// `MaxSpeedDeviation` binds no more, if it did.
    pub(crate) fn end_throttle(&mut self, end_ns: i64) {
        self.throttled
            .extend(Span::ended(&mut self.throttle_began_ns, end_ns));
    }

    /// How many of the lost loops of `loops` were lost for each reason.
    pub(crate) fn lost_by_kind(&self, loops: &Loops, period_ns: f64) -> LostByKind {
        let mut counts = LostByKind::default();
        for lost in &loops.lost {
            counts[self.cause_of(lost.due_ns, period_ns).kind() as usize] += 1;
        }
        counts
    }
}

impl Span {
    /// Half a period before and after the peak at `at_ns`.
    #[allow(clippy::cast_possible_truncation, reason = "at most a minute")]
    pub(crate) fn around(at_ns: i64, period_ns: f64) -> Self {
        let half_ns = (0.5 * period_ns) as i64;
        Self {
            begin_ns: at_ns - half_ns,
            end_ns: at_ns + half_ns,
        }
    }

    fn overlap_ns(self, other: Self) -> i64 {
        let begin_ns = self.begin_ns.max(other.begin_ns);
        (self.end_ns.min(other.end_ns) - begin_ns).max(0)
    }
}

/// Those of `items` that touch `window`; found by halving, since a log may hold thousands.
pub(crate) fn within<T>(items: &[T], window: Span, span: impl Fn(&T) -> Span) -> &[T] {
    let begin = items.partition_point(|item| span(item).end_ns <= window.begin_ns);
    let end = items.partition_point(|item| span(item).begin_ns < window.end_ns);
    &items[begin.min(end)..end]
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_S: f64 = 4.0;
    const COUNTER: LoopCounter = LoopCounter {
        prominence_m: 1.0,
        period_ns: 4e9,
    };

    fn wave(lag_s: f64, end_s: f64) -> Vec<Sample> {
        let count = (end_s * 125.0).round();
        let frames = (0..100_000).take_while(|index| f64::from(*index) < count);
        frames
            .map(|index: i32| {
                let time_s = f64::from(index) * 0.008;
                let phase = core::f64::consts::TAU * (time_s - lag_s).max(0.0) / PERIOD_S;
                (i64::from(index) * 8_000_000, phase.sin())
            })
            .collect()
    }

    /// The wave, standing still from one second to another.
    fn held(from_s: f64, until_s: f64) -> Vec<Sample> {
        let mut samples = wave(0.1, 80.0);
        let at = |time_s: f64| samples.partition_point(|s| (s.0 as f64) < time_s * 1e9);
        let (from, until) = (at(from_s), at(until_s));
        let value = samples[from].1;
        for sample in &mut samples[from..until] {
            sample.1 = value;
        }
        samples
    }

    fn seconds(begin_s: f64, end_s: f64) -> Span {
        #[allow(clippy::cast_possible_truncation, reason = "seconds of a test")]
        let ns = |time_s: f64| (time_s * 1e9) as i64;
        Span {
            begin_ns: ns(begin_s),
            end_ns: ns(end_s),
        }
    }

    #[test]
    fn a_loop_whose_execution_lies_beyond_the_log_is_not_lost() {
        for tenth in 0..80 {
            let end_s = 40.0 + f64::from(tenth) * 0.1;
            for lag_s in [0.0, 0.2, 0.9] {
                let loops = COUNTER
                    .count(&wave(0.0, end_s), &wave(lag_s, end_s))
                    .unwrap();
                assert_eq!(loops.missing_count(), Some(0), "end {end_s}, lag {lag_s}");
                assert_eq!(loops.lost, []);
            }
        }
    }

    #[test]
    fn the_lost_loop_is_named_by_its_number() {
        // Peaks are at 1 s, 5 s, 9 s and so on.
        for index in 2..15_u8 {
            let peak_s = 4.0 * f64::from(index) + 1.0;
            let loops = COUNTER
                .count(&wave(0.0, 80.0), &held(peak_s - 2.0, peak_s + 2.0))
                .unwrap();
            assert_eq!(loops.missing_count(), Some(1), "loop {index}");
            assert_eq!(loops.extra_count, 0);
            let lost: Vec<_> = loops.lost.iter().map(|lost| lost.index).collect();
            assert_eq!(lost, [usize::from(index)]);
        }
    }

    #[test]
    fn a_delay_that_grows_past_a_period_loses_no_loop() {
        // 1 % slower: after 500 s the tool is 5 s behind.
        let slow = wave(0.0, 500.0).into_iter();
        let slow: Vec<_> = slow.map(|(at, value)| (at + at / 100, value)).collect();
        let loops = COUNTER.count(&wave(0.0, 500.0), &slow).unwrap();
        assert_eq!(loops.lost, []);
        assert!(loops.sent_count() >= 123, "{}", loops.sent_count());
        assert_eq!(loops.extra_count, 0);
    }

    #[test]
    fn each_cause_is_told_from_the_others() {
        let pause = |begin_s, end_s, after| Pause {
            span: seconds(begin_s, end_s),
            after,
        };
        let timed_out = pause(20.0, 22.0, PauseAfter::Session(Some(EndCause::CommTimeout)));
        let unknown = pause(40.0, 41.0, PauseAfter::Session(None));
        let first = pause(0.0, 5.0, PauseAfter::Start);
        let evidence = Evidence {
            pauses: vec![
                first,
                timed_out,
                unknown,
                // Too short to explain anything.
                pause(60.0, 60.1, PauseAfter::Session(Some(EndCause::Requested))),
            ],
            holds: vec![
                seconds(19.0, 20.0),
                seconds(59.0, 61.0),
                seconds(80.0, 84.0),
            ],
            clipped: vec![seconds(79.0, 85.0), seconds(100.0, 101.0)],
            throttled: vec![
                seconds(99.0, 103.0),
                seconds(119.0, 120.0),
                seconds(140.0, 140.5),
            ],
            ..Evidence::default()
        };
        let cause = |due: i64| evidence.cause_of(due * 1_000_000_000, 4e9);
        assert_eq!(cause(3), LossCause::Trip(first));
        assert_eq!(
            cause(3).text(1_000_000_000),
            "the arm was in no EGM session until 4.000 s, when its first began"
        );
        // The loop's peak was due before the session ended: the text holds all the same.
        assert_eq!(cause(19), LossCause::Trip(timed_out));
        assert_eq!(
            cause(19).text(1_000_000_000),
            "the arm was in no EGM session from 19.000 s to 21.000 s (ended by CommTimeout)"
        );
        assert_eq!(cause(40), LossCause::Trip(unknown));
        assert_eq!(cause(60), LossCause::Held);
        assert_eq!(cause(82), LossCause::Held);
        assert_eq!(cause(101), LossCause::Clipped);
        assert_eq!(cause(120), LossCause::Throttled);
        // As little as this is an arm that hurries for a moment.
        assert_eq!(cause(140), LossCause::Merged);
        assert_eq!(cause(200), LossCause::Merged);
    }

    #[test]
    fn a_signal_without_a_whole_loop_has_no_count() {
        assert_eq!(COUNTER.count(&[], &wave(0.0, 20.0)), None);
        assert_eq!(COUNTER.count(&wave(0.0, 20.0), &[]), None);
        assert_eq!(COUNTER.count(&wave(0.0, 1.0), &wave(0.0, 1.0)), None);
    }
}
