//! A link with several impairments at once: delay by two laws, loss with copies against it,
//! duplication, reordering and stalls. It carries no bytes and knows no queue: a message's fate
//! depends on the seed, its number and the time alone, so what one message meets never changes
//! what another meets, but for a stall, which holds them all.

use core::time::Duration;

use crate::outages::OutageLink;
use hil_core::case_study::ParameterError;
use hil_core::link_model::{Fate, LinkModel};
use hil_core::random::RandomStream;
use hil_core::time::Instant;
use hil_core::{options, words};

words! {
    /// How a link's delay is drawn.
    #[derive(Default)]
    pub enum DelayLaw {
        /// Every message takes `delay_ms`.
        #[default]
        Constant = "constant",
        /// Each takes a time of its own, uniform from 0 to `delay_ms`.
        Uniform = "uniform",
    }
}

options! {
    /// What a link does to messages. The default does nothing.
    #[derive(Copy)]
    pub struct Impairments {
        /// Delay, or its upper end, ms.
        delay_ms: f64 = 0.0, in 0.0..=60_000.0;
        /// How the delay is drawn.
        delay_law: DelayLaw = DelayLaw::Constant;
        /// Probability that a copy is lost.
        loss_ratio: f64 = 0.0, in 0.0..=1.0;
        /// Copies sent of each message; a message is lost when all of them are.
        copies: u32 = 1, in 1..=16;
        /// Probability that a message arrives twice.
        duplicate_ratio: f64 = 0.0, in 0.0..=1.0;
        /// The second arrival comes up to this much later, uniform, ms.
        duplicate_lag_ms: f64 = 0.0, in 0.0..=60_000.0;
        /// Probability that a message is held back and so overtaken.
        hold_ratio: f64 = 0.0, in 0.0..=1.0;
        /// It is held up to this long, uniform, ms.
        hold_ms: f64 = 0.0, in 0.0..=60_000.0;
        /// Mean length of a stall, exponential, s; 0 for none. What is offered during a stall sets
        /// out at its end.
        stall_mean_s: f64 = 0.0, in 0.0..=60.0;
        /// Mean time from the end of a stall to the next, exponential, s.
        stall_gap_mean_s: f64 = 30.0, in 0.1..=86_400.0;
    }
}

hil_core::counts! {
    /// What became of the messages offered.
    #[derive(Eq)]
    pub struct LinkCounts {
        /// Messages offered.
        offered_count: u64;
        /// Messages of which no copy arrived.
        lost_count: u64;
        /// Messages that arrived twice.
        duplicated_count: u64;
        /// Messages held back.
        held_count: u64;
        /// Messages that waited for the end of a stall.
        stalled_count: u64;
    }
}

/// The link.
#[derive(Debug, Clone)]
pub struct ImpairedLink {
    impairments: Impairments,
    random: RandomStream,
    stalls: Option<OutageLink>,
    counts: LinkCounts,
}

impl ImpairedLink {
    /// A link that draws fates from `random` and stalls from `stalls`. Two directions of one radio
    /// stall together when they are given equal streams for it.
    ///
    /// # Errors
    /// When a number is outside its range.
    pub fn new(
        impairments: Impairments,
        random: RandomStream,
        stalls: RandomStream,
    ) -> Result<Self, ParameterError> {
        impairments.check()?;
        let (gap_mean_s, mean_s) = (impairments.stall_gap_mean_s, impairments.stall_mean_s);
        let stalls = (mean_s > 0.0).then(|| OutageLink::holding(gap_mean_s, mean_s, stalls));
        Ok(Self {
            impairments,
            random,
            stalls,
            counts: LinkCounts::default(),
        })
    }

    /// What became of the messages so far.
    pub fn counts(&self) -> LinkCounts {
        self.counts
    }

    fn extra_ms(&mut self, ratio: f64, up_to_ms: f64) -> Option<f64> {
        if ratio <= 0.0 {
            return None;
        }
        let (is_met, share) = (self.random.chance(ratio), self.random.uniform());
        is_met.then_some(share * up_to_ms)
    }
}

impl LinkModel for ImpairedLink {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        self.counts.offered_count += 1;
        let stall = self.stalls.as_mut().and_then(|link| link.outage_at(now));
        let sets_out = stall.map_or(now, |stall| stall.end);
        self.counts.stalled_count += u64::from(sets_out > now);
        let told = self.impairments;
        // A draw is skipped only where the impairment is off for the whole run, so the fate of the
        // n-th message depends on the seed and on n alone.
        let delay_ms = match told.delay_law {
            DelayLaw::Constant => told.delay_ms,
            DelayLaw::Uniform => told.delay_ms * self.random.uniform(),
        };
        let is_lost = told.loss_ratio > 0.0 && {
            let mut lost = |_| self.random.chance(told.loss_ratio);
            (0..told.copies).filter(|copy| lost(*copy)).count() == told.copies as usize
        };
        let held_ms = self.extra_ms(told.hold_ratio, told.hold_ms);
        let second_ms = self.extra_ms(told.duplicate_ratio, told.duplicate_lag_ms);
        if is_lost {
            self.counts.lost_count += 1;
            return Fate::Lost;
        }
        self.counts.held_count += u64::from(held_ms.is_some());
        let first = sets_out + milliseconds(delay_ms + held_ms.unwrap_or(0.0));
        let Some(lag_ms) = second_ms else {
            return Fate::Delivered(first);
        };
        self.counts.duplicated_count += 1;
        let second = first + milliseconds(lag_ms);
        Fate::Duplicated { first, second }
    }
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "at most two minutes in nanoseconds"
)]
fn milliseconds(time_ms: f64) -> Duration {
    Duration::from_nanos(((time_ms * 1e6).round() as i64).unsigned_abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn link(impairments: Impairments, seed: u64) -> ImpairedLink {
        let stream = |name| RandomStream::new(seed, name);
        ImpairedLink::new(impairments, stream("link"), stream("stalls")).unwrap()
    }

    /// Offers a message every 10 ms; gives the arrivals of each.
    fn arrivals(link: &mut ImpairedLink, count: i64) -> Vec<Vec<i64>> {
        let offer = |index| {
            let now = Instant::from_ns(index * 10_000_000);
            let arrivals = link.offer(now, 0).arrivals();
            arrivals.map(|at| at.ns_since(now)).collect()
        };
        (0..count).map(offer).collect()
    }

    #[test]
    fn without_impairments_everything_arrives_at_once() {
        let mut link = link(Impairments::default(), 1);
        assert!(arrivals(&mut link, 100).iter().all(|times| times == &[0]));
        assert_eq!(link.counts().offered_count, 100);
        assert_eq!(link.counts().lost_count, 0);
    }

    #[test]
    fn copies_multiply_their_loss_ratios() {
        for (copies, expected) in [(1, 10_000.0), (2, 1_000.0), (3, 100.0)] {
            let impairments = Impairments {
                loss_ratio: 0.1,
                copies,
                ..Impairments::default()
            };
            let mut link = link(impairments, 3);
            arrivals(&mut link, 100_000);
            let lost = link.counts().lost_count as f64;
            // Five standard deviations of the binomial count.
            assert!(
                (lost - expected).abs() < 5.0 * f64::sqrt(expected),
                "{lost} lost"
            );
        }
    }

    #[test]
    fn a_uniform_delay_fills_its_range_and_a_constant_one_does_not_move() {
        let told = |delay_law| Impairments {
            delay_ms: 100.0,
            delay_law,
            ..Impairments::default()
        };
        let uniform = arrivals(&mut link(told(DelayLaw::Uniform), 1), 10_000);
        let all: Vec<_> = uniform.iter().flatten().copied().collect();
        assert!(all.iter().all(|ns| (0..=100_000_000).contains(ns)));
        let mean_ms = all.iter().sum::<i64>() as f64 / all.len() as f64 * 1e-6;
        assert!((mean_ms - 50.0).abs() < 1.5, "mean {mean_ms} ms");
        let constant = arrivals(&mut link(told(DelayLaw::Constant), 1), 100);
        assert!(constant.iter().all(|times| times == &[100_000_000]));
    }

    #[test]
    fn duplicates_arrive_twice_and_held_messages_are_overtaken() {
        let impairments = Impairments {
            duplicate_ratio: 0.2,
            duplicate_lag_ms: 500.0,
            hold_ratio: 0.2,
            hold_ms: 500.0,
            ..Impairments::default()
        };
        let mut link = link(impairments, 2);
        let all = arrivals(&mut link, 10_000);
        let twice = all.iter().filter(|times| times.len() == 2).count() as u64;
        assert_eq!(twice, link.counts().duplicated_count);
        assert!((1_800..2_200).contains(&twice), "{twice}");
        let overtaken = |two: &[Vec<i64>]| two[0][0] > two[1][0] + 10_000_000;
        assert!(all.windows(2).filter(|two| overtaken(two)).count() > 500);
    }

    #[test]
    fn equal_stall_streams_stall_both_directions_together() {
        let impairments = Impairments {
            stall_mean_s: 1.0,
            ..Impairments::default()
        };
        let (mut there, mut back) = (link(impairments, 5), link(impairments, 5));
        back.random = RandomStream::new(6, "other");
        assert_eq!(arrivals(&mut there, 100_000), arrivals(&mut back, 100_000));
        // 1000 s with a cycle of 31 s on average hold about 32 stalls of 1 s.
        let stalled = there.counts().stalled_count;
        assert!((1_500..5_500).contains(&stalled), "{stalled}");
    }

    #[test]
    fn numbers_outside_their_range_are_refused_by_name() {
        let refused = |change: fn(&mut Impairments)| {
            let mut impairments = Impairments::default();
            change(&mut impairments);
            impairments.check().unwrap_err().key
        };
        assert_eq!(refused(|i| i.loss_ratio = f64::NAN), "loss_ratio");
        assert_eq!(refused(|i| i.delay_ms = -1.0), "delay_ms");
        assert_eq!(refused(|i| i.copies = 0), "copies");
        assert_eq!(refused(|i| i.stall_gap_mean_s = 0.0), "stall_gap_mean_s");
        assert_eq!(refused(|i| i.hold_ms = f64::INFINITY), "hold_ms");
        assert_eq!(refused(|i| i.duplicate_ratio = 2.0), "duplicate_ratio");
    }
}
