//! A link with outages: now and then nothing gets through for a while. It is what a radio does that
//! independent losses never do. It carries no bytes and adds no delay of its own.
//!
//! When outages begin and end is a function of the random stream and the time alone, so two
//! directions of one radio fail together when they are given equal streams and one origin.

use core::iter::FusedIterator;
use core::time::Duration;

use serde::{Deserialize, Serialize};

use hil_core::case_study::ParameterError;
use hil_core::link_model::{Fate, LinkModel};
use hil_core::options::{
    Field, Kind, Options, Scalar as _, Setting, Shape, Slot, Value, optional_table, table,
};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// How often a link fails and for how long: `[links.x.outages]`. The default never does.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Outages {
    /// Mean length of an outage, exponential, 0.001..=3600 s.
    pub mean_s: f64,
    /// Outages that begin per hour on average, 0..=100000; 0 for none. Together with the mean
    /// length they take up at most 95 % of the time.
    pub per_hour: f64,
    /// What is offered during an outage: false loses it, true delivers it at the end, in order.
    pub buffered: bool,
}

/// An hour.
const HOUR_S: f64 = 3600.0;
/// Share of the time that outages may take up.
const DOWN_RATIO_MAX: f64 = 0.95;

/// The mean length of an outage, which is a time in files and seconds here.
#[derive(Debug)]
struct MeanLength<'o>(&'o mut f64);

impl Value for MeanLength<'_> {
    fn get(&self) -> Option<Setting> {
        Some(Setting::Number(*self.0))
    }

    fn set(&mut self, setting: Setting) -> Result<(), String> {
        *self.0 = Duration::from_setting(setting)?.as_secs_f64();
        Ok(())
    }
}

impl Options for Outages {
    fn fields(&mut self) -> Vec<Field<'_>> {
        let lengths = Shape::Time(Duration::from_millis(1)..=Duration::from_hours(1));
        let mean = Slot::Value(Box::new(MeanLength(&mut self.mean_s)), lengths);
        let per_hour = self.per_hour.slot(0.0..=100_000.0);
        vec![
            Field::new("mean", "Mean length of an outage, exponential.", mean),
            Field::new(
                "per_hour",
                "Outages that begin per hour on average; 0 for none. With the mean length they take up at \
                 most 95 % of the time.",
                per_hour,
            ),
            Field::new(
                "buffered",
                "What is offered during an outage: false loses it, true delivers it at the end, in order.",
                self.buffered.slot(()),
            ),
        ]
    }

    fn check_together(&self) -> Result<(), ParameterError> {
        if self.down_ratio() <= DOWN_RATIO_MAX {
            return Ok(());
        }
        let problem = format!(
            "{} of {} s on average leave less than 5 % of the time in service",
            self.per_hour, self.mean_s
        );
        Err(ParameterError::new("per_hour", problem))
    }
}

impl Kind for Outages {
    type Range = ();
    const UNSET: Self = Self {
        mean_s: 0.5,
        per_hour: 0.0,
        buffered: false,
    };

    fn slot(&mut self, (): ()) -> Slot<'_> {
        table(self)
    }

    fn optional(value: &mut Option<Self>, (): ()) -> Slot<'_> {
        optional_table(value)
    }
}

impl Default for Outages {
    fn default() -> Self {
        Self::UNSET
    }
}

impl Outages {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(mut self) -> Result<(), ParameterError> {
        self.check_all()
    }

    /// Share of the time that outages take up on average.
    pub fn down_ratio(&self) -> f64 {
        self.per_hour * self.mean_s / HOUR_S
    }

    /// The outages in words.
    pub(crate) fn describe(&self) -> String {
        let Self {
            mean_s,
            per_hour,
            buffered,
        } = self;
        let what = if *buffered {
            "which hold"
        } else {
            "which lose"
        };
        let mean_ms = mean_s * 1e3;
        format!(
            "outages of {mean_ms} ms on average, {per_hour} per hour, {what} all messages of the link in both directions"
        )
    }

    /// True when there are any.
    pub fn is_active(&self) -> bool {
        self.per_hour > 0.0
    }
}

/// One outage: nothing gets through from `begin` on, until just before `end`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outage {
    /// When it begins.
    pub begin: Instant,
    /// When it is over.
    pub end: Instant,
}

impl Outage {
    /// True at `at`.
    pub fn covers(&self, at: Instant) -> bool {
        self.begin <= at && at < self.end
    }
}

/// All outages from an origin on, in order: lengths are exponential, and so are the times from the
/// end of one to the beginning of the next. It ends only where there are none, or where time does.
#[derive(Debug, Clone)]
pub struct OutageSchedule {
    /// Infinite without outages.
    gap_mean_s: f64,
    mean_s: f64,
    random: RandomStream,
    end: Instant,
}

impl OutageSchedule {
    /// The outages after `origin` as `random` has them.
    ///
    /// # Errors
    /// The first key of `outages` outside its range.
    pub fn new(
        outages: Outages,
        random: RandomStream,
        origin: Instant,
    ) -> Result<Self, ParameterError> {
        outages.check()?;
        Ok(Self {
            gap_mean_s: HOUR_S / outages.per_hour - outages.mean_s,
            mean_s: outages.mean_s,
            random,
            end: origin,
        })
    }
}

impl Iterator for OutageSchedule {
    type Item = Outage;

    fn next(&mut self) -> Option<Outage> {
        if self.gap_mean_s.is_infinite() || self.end == END_OF_TIME {
            return None;
        }
        let begin = self.end + exponential(&mut self.random, self.gap_mean_s);
        self.end = begin + exponential(&mut self.random, self.mean_s);
        Some(Outage {
            begin,
            end: self.end,
        })
    }
}

impl FusedIterator for OutageSchedule {}

/// Where adding to an [`Instant`] saturates.
const END_OF_TIME: Instant = Instant::from_ns(i64::MAX);

/// Exponential with the mean `mean_s`. A uniform number has 53 bits, so it is at most 37 means.
fn exponential(random: &mut RandomStream, mean_s: f64) -> Duration {
    Duration::from_secs_f64(-mean_s * (1.0 - random.uniform()).ln())
}

/// The link.
#[derive(Debug, Clone)]
pub struct OutageLink {
    schedule: OutageSchedule,
    buffered: bool,
    /// The first outage that is not over yet, as of the last question.
    next: Option<Outage>,
}

impl OutageLink {
    /// A link that fails as `random` has it, from `origin` on.
    ///
    /// # Errors
    /// The first key of `outages` outside its range.
    pub fn new(
        outages: Outages,
        random: RandomStream,
        origin: Instant,
    ) -> Result<Self, ParameterError> {
        let mut schedule = OutageSchedule::new(outages, random, origin)?;
        Ok(Self {
            next: schedule.next(),
            schedule,
            buffered: outages.buffered,
        })
    }

    /// A link that holds everything during outages of `mean_s` on average, `gap_mean_s` apart.
    pub(crate) fn holding(gap_mean_s: f64, mean_s: f64, random: RandomStream) -> Self {
        let mut schedule = OutageSchedule {
            gap_mean_s,
            mean_s,
            random,
            end: Instant::ZERO,
        };
        Self {
            next: schedule.next(),
            schedule,
            buffered: true,
        }
    }

    /// The outage at `now`, if there is one. Calls come in non-decreasing `now`, those of
    /// [`LinkModel::offer`] included.
    pub fn outage_at(&mut self, now: Instant) -> Option<Outage> {
        while self.next.is_some_and(|outage| outage.end <= now) {
            self.next = self.schedule.next();
        }
        self.next.filter(|outage| outage.covers(now))
    }
}

impl LinkModel for OutageLink {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        match self.outage_at(now) {
            None => Fate::Delivered(now),
            Some(outage) if self.buffered => Fate::Delivered(outage.end),
            Some(_) => Fate::Lost,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALF_SECOND_100: Outages = Outages {
        mean_s: 0.5,
        per_hour: 100.0,
        buffered: false,
    };

    fn stream(seed: u64) -> RandomStream {
        RandomStream::new(seed, "outages")
    }

    fn schedule(outages: Outages, seed: u64) -> OutageSchedule {
        OutageSchedule::new(outages, stream(seed), Instant::ZERO).unwrap()
    }

    #[test]
    fn rate_and_mean_length_come_out_as_asked() {
        for (mean_s, per_hour) in [(0.5, 100.0), (2.0, 30.0), (5.0, 600.0)] {
            let outages = Outages {
                mean_s,
                per_hour,
                buffered: false,
            };
            let found: Vec<_> = schedule(outages, 4).take(40_000).collect();
            let n = found.len() as f64;
            let hours = found.last().unwrap().end.seconds_since(Instant::ZERO) / HOUR_S;
            assert!((n / hours / per_hour - 1.0).abs() < 0.03, "{}", n / hours);
            let down_s: f64 = found.iter().map(|o| o.end.seconds_since(o.begin)).sum();
            assert!((down_s / n / mean_s - 1.0).abs() < 0.03, "{}", down_s / n);
            let ratio = down_s / hours / HOUR_S;
            assert!((ratio / outages.down_ratio() - 1.0).abs() < 0.05, "{ratio}");
        }
    }

    #[test]
    fn equal_streams_fail_both_directions_together_whatever_is_offered() {
        let link = |seed| OutageLink::new(HALF_SECOND_100, stream(seed), Instant::ZERO).unwrap();
        let (mut there, mut back, mut other) = (link(1), link(1), link(2));
        let (mut differ_count, mut lost_count) = (0, 0);
        for step in 0..900_000 {
            let now = Instant::from_ns(step * 4_000_000);
            let fate = there.offer(now, 100);
            lost_count += u32::from(fate == Fate::Lost);
            // The way back carries a message now and then.
            if step % 7 == 0 {
                assert_eq!(back.offer(now, 10), fate);
            }
            differ_count += u32::from(other.offer(now, 100) != fate);
        }
        assert!(differ_count > 0);
        let ratio = f64::from(lost_count) / 900_000.0;
        assert!((0.007..0.025).contains(&ratio), "{ratio}");
    }

    #[test]
    fn the_link_fails_exactly_when_its_schedule_says() {
        let mut link = OutageLink::new(HALF_SECOND_100, stream(9), Instant::ZERO).unwrap();
        for outage in schedule(HALF_SECOND_100, 9).take(50) {
            let just_before = |at: Instant| Instant::from_ns(at.as_ns() - 1);
            let begin = just_before(outage.begin);
            assert_eq!(link.offer(begin, 1), Fate::Delivered(begin));
            assert_eq!(link.offer(outage.begin, 1), Fate::Lost);
            assert_eq!(link.outage_at(just_before(outage.end)), Some(outage));
            assert_eq!(link.offer(just_before(outage.end), 1), Fate::Lost);
            assert_eq!(link.offer(outage.end, 1), Fate::Delivered(outage.end));
        }
    }

    #[test]
    fn a_buffered_outage_delivers_everything_in_order_at_its_end() {
        let outages = Outages {
            buffered: true,
            ..HALF_SECOND_100
        };
        let outage = schedule(outages, 3).next().unwrap();
        let mut link = OutageLink::new(outages, stream(3), Instant::ZERO).unwrap();
        let (mut newest, mut held_count) = (Instant::ZERO, 0);
        for step in 0..60_000 {
            let now = Instant::from_ns(step * 8_000_000);
            let Fate::Delivered(at) = link.offer(now, 1) else {
                panic!("lost at {now}");
            };
            assert!(at >= newest && at >= now);
            held_count += u32::from(at > now);
            if outage.covers(now) {
                assert_eq!(at, outage.end);
            }
            newest = at;
        }
        assert!(held_count > 0);
    }

    #[test]
    fn without_a_rate_nothing_ever_fails() {
        let mut link = OutageLink::new(Outages::default(), stream(0), Instant::ZERO).unwrap();
        assert_eq!(schedule(Outages::default(), 0).next(), None);
        for now in [0, 1, i64::MAX].map(Instant::from_ns) {
            assert_eq!(link.offer(now, 1), Fate::Delivered(now));
        }
    }

    #[test]
    fn numbers_outside_their_range_are_refused_by_name() {
        let refused = |mean_s, per_hour| {
            let outages = Outages {
                mean_s,
                per_hour,
                buffered: false,
            };
            outages.check().unwrap_err().key
        };
        assert_eq!(refused(0.0, 1.0), "mean_s");
        assert_eq!(refused(f64::NAN, 1.0), "mean_s");
        assert_eq!(refused(1.0, -1.0), "per_hour");
        assert_eq!(refused(1.0, f64::INFINITY), "per_hour");
        assert_eq!(refused(36.0, 99.0), "per_hour");
        let at_the_edge = Outages {
            mean_s: 36.0,
            per_hour: 95.0,
            buffered: true,
        };
        assert_eq!(at_the_edge.check(), Ok(()));
    }
}
