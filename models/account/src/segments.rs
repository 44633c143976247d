//! Where the time of each message went, and whether the parts add up. It judges no fate: see
//! [`super::fate`].

use super::fold::RecordsAtHand;
use super::history::MessageHistory;
use super::metrics::{Closing, ClosingMetrics, Coverage, EndToEnd, SegmentMetrics, StampCoverage};
use super::stage::{Side, Stage};
use super::{AccountContext, ChannelPath, ORDER_TOLERANCE_NS, RESIDUAL_LIMIT_NS};
use hil_core::record::{EgressRecord, stamp};
use hil_core::time::RemoteInstant;
use hil_stats::bounds::Bounds;
use hil_stats::dependence::Quantiles;
use hil_stats::histogram::{Distribution, LatencyHistogram};
use hil_stats::samples::Samples;

pub(super) const NOT_ALIGNED: &str = "clocks not aligned";
const NO_CONSUMER: &str = "the consumer's records are not at hand";

/// One stage of one message.
#[derive(Debug, Clone, Copy)]
struct Mark {
    stage: Stage,
    /// On the monotonic clock of the stage's own host.
    host_ns: i64,
    /// The kernel's own stamp, on the host's real-time clock.
    raw_ns: Option<i64>,
}

/// The marks of one message in the order of the chain.
struct Timeline {
    marks: [Option<Mark>; Stage::CHAIN.len()],
}

impl Timeline {
    /// A direct channel has no stages between its ends, whatever a record claims.
    fn of(message: &MessageHistory, is_gateway: bool) -> Self {
        let (egress, ingress, taken) = (message.egress, message.arrived(), message.taken);
        let published_ns = message.published_ns();
        let sender_handed_ns = ingress.and_then(|record| stamp(record.handed_ns));
        let handed_ns = egress
            .and_then(|record| stamp(record.handed_ns))
            .or(sender_handed_ns);
        let forwarded_ns = ingress
            .and_then(|record| stamp(record.forwarded_ns))
            .or_else(|| stamp(taken?.forwarded_ns))
            .filter(|_| is_gateway);
        let plain = |stage, ns: Option<i64>| {
            ns.map(|host_ns| Mark {
                stage,
                host_ns,
                raw_ns: None,
            })
        };
        let kernel = |stage, raw_ns, offset_ns| {
            let (raw_ns, offset_ns) = (stamp(raw_ns)?, stamp(offset_ns)?);
            let host_ns = raw_ns.saturating_sub(offset_ns);
            Some(Mark {
                stage,
                host_ns,
                raw_ns: Some(raw_ns),
            })
        };
        // A follow-up is a difference on the sender's host, so it needs no real-time clock.
        let followed_up = || Some(sender_handed_ns?.saturating_add(message.handed_to_tx_ns?));
        let transmitted = egress
            .and_then(|e| kernel(Stage::TxSoftware, e.tx_software_ns, e.realtime_offset_ns))
            .or_else(|| plain(Stage::TxSoftware, followed_up()));
        let marks = [
            plain(Stage::Published, published_ns),
            plain(
                Stage::TakenByGateway,
                egress.and_then(|record| stamp(record.taken_ns)),
            ),
            plain(Stage::HandedToKernel, handed_ns),
            transmitted,
            ingress.and_then(|i| kernel(Stage::RxSoftware, i.rx_software_ns, i.realtime_offset_ns)),
            plain(
                Stage::Received,
                ingress.and_then(|record| stamp(record.received_ns)),
            ),
            plain(Stage::Forwarded, forwarded_ns),
            plain(
                Stage::Taken,
                taken.and_then(|record| stamp(record.taken_ns)),
            ),
        ];
        Self { marks }
    }

    fn pairs(&self) -> impl Iterator<Item = (Mark, Mark)> + '_ {
        let present = self.marks.iter().flatten().copied();
        present.clone().zip(present.skip(1))
    }
}

/// Collects segments, closing and coverage over the messages of a channel.
#[derive(Debug)]
pub(super) struct SegmentFold<'a> {
    at_hand: RecordsAtHand,
    is_gateway: bool,
    path: ChannelPath<'a>,
    /// By first and last stage of the segment.
    segments: Vec<Option<LatencyHistogram>>,
    /// Of the segments that cross from host to host: how far each length may be off.
    bounds_ns: Vec<Bounds>,
    mark_counts: [u64; Stage::COUNT],
    end_to_end: LatencyHistogram,
    end_to_end_ns: Samples,
    end_to_end_bounds_ns: Bounds,
    residual: LatencyHistogram,
    closing: ClosingMetrics,
    pub(super) coverage: StampCoverage,
}

impl<'a> SegmentFold<'a> {
    pub(super) fn new(at_hand: RecordsAtHand, context: &AccountContext<'a>) -> Self {
        let covers = |is_known: bool| is_known.then(Coverage::default);
        let (egress, ingress) = (at_hand.egress, at_hand.ingress);
        Self {
            at_hand,
            is_gateway: context.path.is_gateway(),
            path: context.path,
            segments: vec![None; Stage::COUNT * Stage::COUNT],
            bounds_ns: vec![Bounds::default(); Stage::COUNT * Stage::COUNT],
            mark_counts: [0; Stage::COUNT],
            end_to_end: LatencyHistogram::default(),
            end_to_end_ns: Samples::default(),
            end_to_end_bounds_ns: Bounds::default(),
            residual: LatencyHistogram::default(),
            closing: ClosingMetrics {
                checked_count: 0,
                closed_count: 0,
                closed_combined_count: 0,
                missing_stage_count: 0,
                negative_segment_count: 0,
                residual_count: 0,
                unaligned_count: 0,
                is_converted: !context.path.has_one_clock(),
                residual_limit_ns: RESIDUAL_LIMIT_NS,
                residual: Distribution::unavailable("no message was taken"),
            },
            coverage: StampCoverage {
                tx_software: covers(egress || ingress),
                tx_hardware: covers(egress),
                rx_software: covers(ingress),
                rx_hardware: covers(ingress),
                tx_before_queue_count: 0,
            },
        }
    }

    /// Counts one message. Segments are of taken messages, so that they belong to the same
    /// messages as end-to-end; of all messages when the consumer's records are not at hand.
    pub(super) fn count(&mut self, message: &MessageHistory) {
        self.cover(message);
        if self.at_hand.taken && message.taken.is_none() {
            return;
        }
        let timeline = Timeline::of(message, self.is_gateway);
        let (mut sum_ns, mut is_ordered, mut is_whole) = (0_i64, true, true);
        for mark in timeline.marks.iter().flatten() {
            self.mark_counts[mark.stage.index()] += 1;
        }
        for (from, to) in timeline.pairs() {
            let Some((length_ns, bound_ns)) = self.difference(from, to) else {
                is_whole = false;
                continue;
            };
            let cell = from.stage.index() * Stage::COUNT + to.stage.index();
            let histogram = self.segments[cell].get_or_insert_with(LatencyHistogram::default);
            histogram.record(length_ns);
            sum_ns = sum_ns.saturating_add(length_ns);
            if from.stage.side() != to.stage.side() {
                self.bounds_ns[cell].push(bound_ns);
            }
            is_ordered &= length_ns >= -ORDER_TOLERANCE_NS.saturating_add_unsigned(bound_ns);
        }
        // Of a part of the way there is no sum to hold against the whole: a clock was stepped meanwhile.
        if !is_whole && self.path.is_aligned() && message.taken.is_some() {
            self.closing.unaligned_count += 1;
            return;
        }
        self.close(message, &timeline, sum_ns, is_ordered);
    }

    /// A length and how far it may be off. On one clock, two kernel stamps are compared raw, so
    /// that an error in either host's offset shows as a residual instead of cancelling out.
    fn difference(&self, from: Mark, to: Mark) -> Option<(i64, u64)> {
        if from.stage.side() == to.stage.side() {
            return Some((to.host_ns.saturating_sub(from.host_ns), 0));
        }
        if self.path.has_one_clock()
            && let Some((sent_ns, received_ns)) = from.raw_ns.zip(to.raw_ns)
        {
            return Some((received_ns.saturating_sub(sent_ns), 0));
        }
        let remote = RemoteInstant::from_ns(from.host_ns);
        let (local, bound_ns) = self.path.localise(remote)?;
        Some((to.host_ns.saturating_sub(local.as_ns()), bound_ns))
    }

    fn close(
        &mut self,
        message: &MessageHistory,
        timeline: &Timeline,
        sum_ns: i64,
        is_ordered: bool,
    ) {
        let Some(taken) = message.taken.filter(|_| self.path.is_aligned()) else {
            return;
        };
        let published = stamp(taken.published_ns)
            .map(|published_ns| self.path.localise(RemoteInstant::from_ns(published_ns)));
        if published == Some(None) {
            self.closing.unaligned_count += 1;
            return;
        }
        self.closing.checked_count += 1;
        let ends = stamp(taken.taken_ns).zip(published.flatten());
        let residual_ns = ends.map(|(taken_ns, (published, bound_ns))| {
            let end_to_end_ns = taken_ns.saturating_sub(published.as_ns());
            self.end_to_end.record(end_to_end_ns);
            self.end_to_end_ns.push(end_to_end_ns);
            self.end_to_end_bounds_ns.push(bound_ns);
            end_to_end_ns.saturating_sub(sum_ns).saturating_abs()
        });
        if let Some(residual_ns) = residual_ns {
            self.residual.record(residual_ns);
        }
        match residual_ns {
            Some(_) if self.misses_stage(message, timeline) => {
                self.closing.missing_stage_count += 1;
            }
            None => self.closing.missing_stage_count += 1,
            Some(_) if !is_ordered => self.closing.negative_segment_count += 1,
            Some(residual_ns) if residual_ns > RESIDUAL_LIMIT_NS => {
                self.closing.residual_count += 1;
            }
            Some(_) => {
                self.closing.closed_count += 1;
                let is_stamped =
                    |index: usize| timeline.marks[index].is_some_and(|mark| mark.raw_ns.is_some());
                let is_combined = self.is_gateway && !(is_stamped(3) && is_stamped(4));
                self.closing.closed_combined_count += u64::from(is_combined);
            }
        }
    }

    /// True when a file at hand lacks a stage the message must have passed. Kernel stamps may
    /// be missing: their segments are combined.
    fn misses_stage(&self, message: &MessageHistory, timeline: &Timeline) -> bool {
        let lacks = |stage: Stage| {
            let mut marks = timeline.marks.iter().flatten();
            !marks.any(|mark| mark.stage == stage)
        };
        if self.at_hand.published && message.published.is_none() {
            return true;
        }
        if !self.is_gateway {
            return false;
        }
        let sent = [Stage::TakenByGateway, Stage::HandedToKernel];
        let arrived = [Stage::Received, Stage::Forwarded];
        (self.at_hand.egress && (message.egress.is_none() || sent.into_iter().any(lacks)))
            || (self.at_hand.ingress
                && (message.ingress.is_none() || arrived.into_iter().any(lacks)))
    }

    fn cover(&mut self, message: &MessageHistory) {
        let has = |ns: i64| stamp(ns).is_some();
        let coverage = &mut self.coverage;
        let handed = message.egress.filter(EgressRecord::was_handed);
        if let Some(egress) = handed {
            for (coverage, ns) in [
                (&mut coverage.tx_software, egress.tx_software_ns),
                (&mut coverage.tx_hardware, egress.tx_hardware_ns),
            ] {
                coverage.get_or_insert_default().count(has(ns));
            }
            let is_before_queue = egress.flags & EgressRecord::STAMPED_BEFORE_QUEUE != 0;
            coverage.tx_before_queue_count +=
                u64::from(has(egress.tx_software_ns) && is_before_queue);
        } else if !self.at_hand.egress
            && message.arrived().is_some()
            && let Some(coverage) = &mut coverage.tx_software
        {
            coverage.count(message.handed_to_tx_ns.is_some_and(has));
        }
        if let Some(ingress) = message.arrived() {
            for (coverage, ns) in [
                (&mut coverage.rx_software, ingress.rx_software_ns),
                (&mut coverage.rx_hardware, ingress.rx_hardware_ns),
            ] {
                coverage.get_or_insert_default().count(has(ns));
            }
        }
    }

    /// Neighbouring stages first, measured or not, then combined segments that occurred.
    pub(super) fn segments(&self) -> Vec<SegmentMetrics> {
        let chain: &[Stage] = if self.is_gateway {
            &Stage::CHAIN
        } else {
            &[Stage::Published, Stage::Taken]
        };
        let histogram = |from: Stage, to: Stage| {
            self.segments[from.index() * Stage::COUNT + to.index()].as_ref()
        };
        let neighbours = chain.windows(2).map(|pair| (pair[0], pair[1], false));
        let combined = chain.iter().enumerate().flat_map(|(index, from)| {
            let later = chain.iter().skip(index + 2);
            later.map(move |to| (*from, *to, true))
        });
        neighbours
            .chain(combined.filter(|(from, to, _)| histogram(*from, *to).is_some()))
            .map(|(from, to, is_combined)| {
                let distribution = histogram(from, to).map_or_else(
                    || Distribution::unavailable(&self.reason(from, to)),
                    |histogram| histogram.distribution(NOT_ALIGNED),
                );
                let cell = from.index() * Stage::COUNT + to.index();
                SegmentMetrics {
                    from,
                    to,
                    is_combined,
                    distribution,
                    bins: histogram(from, to).map_or_else(Vec::new, LatencyHistogram::bins),
                    bound: self.bounds_ns[cell].metrics(),
                }
            })
            .collect()
    }

    fn reason(&self, from: Stage, to: Stage) -> String {
        if from.side() != to.side() && !self.path.is_aligned() {
            return NOT_ALIGNED.to_owned();
        }
        for stage in [from, to] {
            if self.mark_counts[stage.index()] > 0 {
                continue;
            }
            let (owner, has_file) = match stage {
                Stage::Published => ("producer", self.at_hand.published),
                Stage::Received | Stage::RxSoftware | Stage::Forwarded => {
                    ("receiving gateway", self.at_hand.ingress)
                }
                Stage::Taken => ("consumer", self.at_hand.taken),
                _ => ("sending gateway", self.at_hand.egress),
            };
            return if has_file {
                format!("no message has \"{stage}\"")
            } else {
                format!("the {owner}'s records are not at hand")
            };
        }
        "no message has both ends".to_owned()
    }

    pub(super) fn end_to_end(&self) -> EndToEnd {
        let reason = match (self.path.is_aligned(), self.at_hand.taken) {
            (false, _) => NOT_ALIGNED,
            (_, false) => NO_CONSUMER,
            _ => "no message was taken",
        };
        let bound = self.end_to_end_bounds_ns.metrics();
        let ascending = self.end_to_end_ns.ascending();
        let quantiles = Quantiles::of(&self.end_to_end_ns, &ascending);
        let [p50_interval, p99_interval] = [0.5, 0.99].map(|share| quantiles.interval(share));
        EndToEnd {
            p50_interval,
            p99_interval,
            distribution: self.end_to_end_ns.distribution(reason),
            bins: self.end_to_end.bins(),
            bound,
        }
    }

    pub(super) fn closing(&self) -> Closing {
        let unavailable = |reason: &str| Closing::Unavailable {
            reason: reason.to_owned(),
        };
        match (self.path.is_aligned(), self.at_hand.taken) {
            (false, _) => unavailable(NOT_ALIGNED),
            (_, false) => unavailable(NO_CONSUMER),
            _ => Closing::Checked(ClosingMetrics {
                residual: self.residual.distribution("no message was taken"),
                ..self.closing.clone()
            }),
        }
    }
}

const _: () = {
    // `close` and `Timeline` rely on these places in the chain.
    assert!(Stage::CHAIN[3].index() == Stage::TxSoftware.index());
    assert!(Stage::CHAIN[4].index() == Stage::RxSoftware.index());
    assert!(matches!(Stage::CHAIN[3].side(), Side::Producer));
};
