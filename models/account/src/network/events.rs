//! What a person would note of a network: outages, bursts of losses, messages that came far too
//! late, bursts of reordering, processes that were down, clocks that were set. Every event has a
//! beginning, an end and numbers. A single lost message is no event: it is counted with the losses.

use serde::{Deserialize, Serialize};

use super::loss::{BURST_GAP_MIN, clusters, loss_runs};
use super::order::arrivals;
use super::{Moment, Passages};
use crate::{AccountContext, ChannelRecords, Side, each};
use hil_core::record::UNAVAILABLE;
use hil_stats::in_order::in_order;
use hil_stats::reordering::{Reordered, reordered};
use hil_stats::samples::Samples;

/// Losses in a row that last this long are an outage, shorter ones a burst of losses.
pub const EVENT_OUTAGE_MIN_NS: i64 = 100_000_000;

/// What the real-time clock may be corrected by without a step: the rate that the kernel's clock
/// discipline never exceeds (500 ppm), and 1 ms for reading two clocks as a pair.
const STEP_MIN_NS: u64 = 1_000_000;
const SLEW_MAX_RATIO: f64 = 500e-6;

/// How old a gateway's reading of the two clocks as a pair may be when it notes it with a message: the
/// period of the readings and the longest sleep between two looks at it. What the scheduler adds is not in it.
pub const CLOCK_READING_AGE_NS_MAX: i64 = 150_000_000;

/// What happened.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum NetworkEventKind {
    /// No message got through for at least [`EVENT_OUTAGE_MIN_NS`]; `lost_count`, at least two, were
    /// lost.
    Outage {
        /// Messages lost.
        lost_count: u64,
        /// Of these, because there was no way to the peer: an interface was down or there was no route.
        #[serde(default)]
        unreachable_count: u64,
    },
    /// At least two losses with fewer than [`BURST_GAP_MIN`] arrivals in a row between.
    LossBurst {
        /// Messages lost.
        lost_count: u64,
        /// Of so many, from the first to the last of them.
        of_count: u64,
    },
    /// Messages arrived later than the next one should have: above the median by more than one mean
    /// period, and above the 99th percentile of the run.
    Delay {
        /// Messages.
        late_count: u64,
        /// The largest delay among them.
        delay_max_ns: i64,
        /// What they exceeded.
        limit_ns: i64,
        /// Largest error of the delays among them, and of those that the limit is made of, from the
        /// alignment of the clocks; 0 on one clock.
        bound_ns: u64,
    },
    /// Messages came after later ones.
    Reordering {
        /// Messages.
        reordered_count: u64,
        /// Largest displacement, in places.
        extent_max: u64,
    },
    /// A process on the way was down.
    ProcessDown {
        /// Its name in the topology.
        process: String,
        /// True for a gateway.
        is_gateway: bool,
        /// Why.
        cause: String,
    },
    /// The real-time clock of a host was set; kernel stamps around it do not compare.
    ClockStep {
        /// By so much.
        step_ns: i64,
    },
}

/// Something of note that a channel's network went through.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetworkEvent {
    /// What.
    pub kind: NetworkEventKind,
    /// When it began.
    pub from: Moment,
    /// When it was over, on the same clock; `None` when it was not.
    pub until_ns: Option<i64>,
}

const fn producer(ns: i64) -> Moment {
    Moment {
        side: Side::Producer,
        ns,
    }
}

/// Every event of the passages of one channel, kind by kind: they lie on the clocks of two hosts.
pub fn network_events(passages: &Passages) -> Vec<NetworkEvent> {
    let mut found = losses(passages);
    found.extend(late(passages));
    found.extend(reordering(passages));
    found
}

fn losses(passages: &Passages) -> Vec<NetworkEvent> {
    let (runs, _) = loss_runs(passages);
    let mut found = Vec::new();
    for cluster in clusters(&runs) {
        let mut lost_in_outages = 0;
        for run in cluster {
            let Some(from_ns) = run.from_ns else { continue };
            let length_ns = run
                .until_ns
                .map(|until_ns| until_ns.saturating_sub(from_ns));
            // A single loss is none, however slowly a channel sends.
            let is_long = length_ns.is_none_or(|ns| ns >= EVENT_OUTAGE_MIN_NS);
            let is_outage = run.lost_count > 1 && is_long;
            if is_outage {
                lost_in_outages += run.lost_count;
                found.push(NetworkEvent {
                    kind: NetworkEventKind::Outage {
                        lost_count: run.lost_count,
                        unreachable_count: run.unreachable_count,
                    },
                    from: producer(from_ns),
                    until_ns: run.until_ns,
                });
            }
        }
        let (Some(first), Some(last)) = (cluster.first(), cluster.last()) else {
            continue;
        };
        let lost_count: u64 = cluster.iter().map(|run| run.lost_count).sum();
        let Some(from_ns) = first.from_ns else {
            continue;
        };
        if lost_count - lost_in_outages >= 2 {
            found.push(NetworkEvent {
                kind: NetworkEventKind::LossBurst {
                    lost_count,
                    of_count: last.place + last.lost_count - first.place,
                },
                from: producer(from_ns),
                until_ns: last.until_ns,
            });
        }
    }
    found
}

/// What a delay must exceed to be an event: the median and one mean period, so that the next
/// message should have been there; and the 99th percentile, as messages of several robots may follow
/// each other at once. `None` without delays or a period.
fn delay_limit_ns(passages: &Passages) -> Option<i64> {
    let mut delays_ns = Samples::default();
    let (mut ends, mut count): (Option<(i64, i64)>, i64) = (None, 0);
    for one in passages.each() {
        delays_ns.extend(one.delay_ns);
        if let Some(ns) = one.offered_ns {
            let (first_ns, last_ns) = ends.unwrap_or((ns, ns));
            ends = Some((first_ns.min(ns), last_ns.max(ns)));
            count += 1;
        }
    }
    let (first_ns, last_ns) = ends?;
    let period_ns = last_ns.saturating_sub(first_ns) / count;
    if delays_ns.is_empty() || period_ns == 0 {
        return None;
    }
    delays_ns.sort();
    let limit_ns = delays_ns.at_share(0.5).saturating_add(period_ns);
    Some(limit_ns.max(delays_ns.at_share(0.99)))
}

fn late(passages: &Passages) -> Vec<NetworkEvent> {
    let Some(limit_ns) = delay_limit_ns(passages) else {
        return Vec::new();
    };
    let with_delay = passages.each().filter(|one| one.delay_ns.is_some());
    let bound_ns = with_delay.map(|one| one.delay_bound_ns).max().unwrap_or(0);
    let mut found: Vec<NetworkEvent> = Vec::new();
    let mut since_last = u64::MAX;
    for one in passages.each() {
        since_last = since_last.saturating_add(one.count);
        let Some((delay_ns, offered_ns)) = one.delay_ns.zip(one.offered_ns) else {
            continue;
        };
        if delay_ns <= limit_ns {
            continue;
        }
        let received_ns = offered_ns.saturating_add(delay_ns);
        let is_same = core::mem::replace(&mut since_last, 0) <= BURST_GAP_MIN;
        if is_same
            && let Some(NetworkEvent {
                kind:
                    NetworkEventKind::Delay {
                        late_count,
                        delay_max_ns,
                        ..
                    },
                until_ns,
                ..
            }) = found.last_mut()
        {
            *late_count += 1;
            *delay_max_ns = (*delay_max_ns).max(delay_ns);
            *until_ns = (*until_ns).max(Some(received_ns));
            continue;
        }
        found.push(NetworkEvent {
            kind: NetworkEventKind::Delay {
                late_count: 1,
                delay_max_ns: delay_ns,
                limit_ns,
                bound_ns,
            },
            from: producer(offered_ns),
            until_ns: Some(received_ns),
        });
    }
    found
}

fn reordering(passages: &Passages) -> Vec<NetworkEvent> {
    let (found, _) = reordered(arrivals(passages).map(|(_, number)| number));
    let near = |before: &Reordered, after: &Reordered| after.place - before.place <= BURST_GAP_MIN;
    let mut times = arrivals(passages).map(|(ns, _)| ns).zip(0_u64..);
    // Places ascend from burst to burst.
    let mut received_ns = |place: u64| times.find(|one| one.1 == place).map(|one| one.0);
    let event = |burst: &[Reordered]| {
        let (first, last) = burst.first().zip(burst.last())?;
        let extent_max = burst.iter().map(|one| one.extent).max()?;
        let from_ns = received_ns(first.place)?;
        let until_ns = if last.place == first.place {
            Some(from_ns)
        } else {
            received_ns(last.place)
        };
        Some(NetworkEvent {
            kind: NetworkEventKind::Reordering {
                reordered_count: burst.len() as u64,
                extent_max,
            },
            from: Moment {
                side: Side::Consumer,
                ns: from_ns,
            },
            until_ns,
        })
    };
    found.chunk_by(near).filter_map(event).collect()
}

/// The interruptions of processes on a channel's way, as events.
pub fn interruptions(context: &AccountContext<'_>) -> Vec<NetworkEvent> {
    use crate::PathProcess;
    let events = context.interruptions.iter().map(|one| NetworkEvent {
        kind: NetworkEventKind::ProcessDown {
            process: one.process.clone(),
            is_gateway: matches!(
                one.place,
                PathProcess::SendingGateway | PathProcess::ReceivingGateway
            ),
            cause: one.cause.clone(),
        },
        from: Moment {
            side: one.place.side(),
            ns: one.from.as_ns(),
        },
        until_ns: Some(one.until.as_ns()),
    });
    events.collect()
}

/// Steps of the two hosts' real-time clocks against their monotonic ones, as the gateways that
/// read both saw them.
pub fn clock_steps(records: &ChannelRecords<'_>) -> Vec<NetworkEvent> {
    let mut found = steps(Side::Producer, || {
        each(records.egress).map(|one| (one.handed_ns, one.realtime_offset_ns))
    });
    found.extend(steps(Side::Consumer, || {
        each(records.ingress).map(|one| (one.received_ns, one.realtime_offset_ns))
    }));
    found
}

/// The steps among readings, each with when it was and what it said.
fn steps<I: Iterator<Item = (i64, i64)>>(side: Side, read: impl Fn() -> I) -> Vec<NetworkEvent> {
    let known = |one: &(i64, i64)| one.0 != UNAVAILABLE && one.1 != UNAVAILABLE;
    let readings = in_order(|| read().filter(known).map(|one| (one, ())));
    let mut last: Option<(i64, i64)> = None;
    let pairs = readings.filter_map(|(after, ())| Some((last.replace(after)?, after)));
    let step = |(before, after): ((i64, i64), (i64, i64))| {
        let step_ns = after.1.saturating_sub(before.1);
        let passed_ns = after.0.saturating_sub(before.0) as f64;
        // A step shows up to a reading's age after it happened.
        let slewed_ns = SLEW_MAX_RATIO * (passed_ns + CLOCK_READING_AGE_NS_MAX as f64);
        let is_step = step_ns.unsigned_abs() as f64 > slewed_ns + STEP_MIN_NS as f64;
        is_step.then_some(NetworkEvent {
            kind: NetworkEventKind::ClockStep { step_ns },
            from: Moment {
                side,
                ns: before.0.saturating_sub(CLOCK_READING_AGE_NS_MAX),
            },
            until_ns: Some(after.0),
        })
    };
    pairs.filter_map(step).collect()
}
