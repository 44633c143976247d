//! The latency account of one channel: what became of every message, where its time went, and
//! whether the parts add up to the whole. It reads records, not files, and it knows nothing of
//! sockets or shared memory.
//!
//! Each message goes *published → taken by gateway → handed to kernel → TX stamp → RX stamp →
//! received by gateway → forwarded → taken by consumer*. On one clock the wire segment is the
//! difference of the two raw kernel stamps, while the segments beside it are converted to the
//! monotonic clock with the offset each gateway read at its own time. So the sum of segments
//! equals end-to-end only when records, stamps and both offsets agree: the closing check can
//! fail, which is what makes it worth printing.
//!
//! Between hosts whose clocks are only aligned, raw stamps do not compare: the wire segment is of
//! converted ones, in which the offsets of the gateways cancel out of the sum. The check proves
//! less then: that records belong together, that no stage lies before its predecessor by more than
//! the alignment's bound, and that no clock stepped while a message was under way. It cannot prove
//! the alignment; the bound beside each figure that crosses hosts says how far that may be off.
#![forbid(unsafe_code)]

mod account;
mod demand;
mod fate;
#[cfg(test)]
mod feed_tests;
pub mod flow;
mod fold;
mod follow_up;
mod gaps;
mod history;
mod metrics;
pub mod network;
pub mod nic_clock;
mod no_room;
mod outage;
pub mod radio;
#[cfg(test)]
mod random_fates_tests;
mod segments;
mod stage;
#[cfg(any(test, feature = "lab"))]
#[path = "tests/synthetic.rs"]
pub mod synthetic;
#[cfg(test)]
mod tests;

use core::fmt::Debug;
use core::time::Duration;

pub use account::{AccountFold, account};
pub use demand::{
    Demand, DemandFold, DemandMetrics, DemandVerdict, DownTime, ServiceMetrics, Transfer,
};
pub use fold::{
    ChannelFold, FirstNumber, FoldSettings, MessageName, RecordEvent, RecordsAtHand, each_history,
};
pub use history::{Copies, Key, MessageHistory};
pub use metrics::{
    BurstCount, BurstLengths, ChannelAccount, Closing, ClosingMetrics, Coverage, EndToEnd,
    FateCounts, Gap, Gaps, InterruptionMetrics, ProducerSilence, SegmentMetrics, StampCoverage,
};
pub use no_room::NoRoom;
pub use outage::{
    EventTime, LongestOutage, OUTAGE_EFFECT_MAX, Outage, OutageClass, OutageFinder, OutageMetrics,
    Preceding, Standing, preceding,
};
pub use stage::{MessageFate, Side, Stage};

use hil_clock::{ClockMap, ClockSettings};
use hil_core::record::{EgressRecord, IngressRecord, PublishedRecord, TakenRecord};
use hil_core::time::{Alignment, Instant, RemoteInstant};

/// Largest difference between end-to-end and the sum of segments for a message that closes.
pub const RESIDUAL_LIMIT_NS: i64 = 1_000;

/// How far a stage may lie before its predecessor: two clocks of one host are read as a pair
/// with an error below this.
pub const ORDER_TOLERANCE_NS: i64 = 1_000;

/// How long a message may travel before it counts as lost instead of in flight, on a link that
/// delays none on purpose.
const FLIGHT_TIME_MAX: Duration = Duration::from_millis(50);

/// Share of the messages of an emulated link that are not under way for longer than is allowed for.
pub const FLIGHT_QUANTILE: f64 = 0.9999;

/// Longest time from what a record tells until the record is in its file: processes write every 20 ms,
/// each at its own time.
pub const WRITING_TIME_MAX: Duration = Duration::from_millis(100);

/// The longest flight after which a missing message is lost, on a link that delays messages on purpose by
/// up to `link_delay`, at [`FLIGHT_QUANTILE`]. The one definition for reports and for those who watch.
pub const fn flight_time_max(link_delay: Duration) -> Duration {
    FLIGHT_TIME_MAX.saturating_add(link_delay)
}

/// The record files of one channel. `None` means the file is not at hand, which differs from an
/// empty one: nothing is concluded from the absence of a record in an absent file.
#[derive(Debug, Clone, Copy, Default)]
pub struct ChannelRecords<'a> {
    /// The producer's.
    pub published: Option<&'a dyn RecordSource<PublishedRecord>>,
    /// The sending gateway's.
    pub egress: Option<&'a dyn RecordSource<EgressRecord>>,
    /// The receiving gateway's.
    pub ingress: Option<&'a dyn RecordSource<IngressRecord>>,
    /// The consumer's.
    pub taken: Option<&'a dyn RecordSource<TakenRecord>>,
}

/// How a channel gets from its producer to its consumer.
#[derive(Debug, Clone, Copy)]
pub enum ChannelPath<'a> {
    /// Shared memory of one host.
    SharedMemory,
    /// A gateway pair.
    Gateway {
        /// From the producer's host clock to the consumer's; [`Alignment::SAME_CLOCK`] on one
        /// machine, `None` when the clocks are not aligned.
        alignment: Option<Alignment>,
    },
    /// A gateway pair between hosts whose clocks are related differently at each instant.
    Mapped {
        /// From the producer's host clock to the consumer's.
        map: &'a ClockMap,
    },
}

impl ChannelPath<'_> {
    /// An instant of the producer's host on the clock of the consumer's, with the largest error of
    /// the conversion in nanoseconds; `None` when the clocks are not aligned, or not then.
    pub fn localise(self, remote: RemoteInstant) -> Option<(Instant, u64)> {
        match self {
            Self::SharedMemory => Some((Alignment::SAME_CLOCK.localise(remote), 0)),
            Self::Gateway { alignment } => {
                let alignment = alignment?;
                Some((alignment.localise(remote), alignment.bound_ns))
            }
            Self::Mapped { map } => {
                let localised = map.localise(remote)?;
                Some((localised.instant, localised.bound_ns()))
            }
        }
    }

    /// As [`Self::localise`], and further outside the exchanges too; see
    /// [`ClockMap::localise_beyond`].
    pub fn localise_beyond(self, remote: RemoteInstant) -> Option<(Instant, u64)> {
        match self {
            Self::Mapped { map } => {
                let localised = map.localise_beyond(remote)?;
                Some((localised.instant, localised.bound_ns()))
            }
            Self::SharedMemory | Self::Gateway { .. } => self.localise(remote),
        }
    }

    /// As [`Self::localise`], and further before the first exchange too, with true beside those that only
    /// this converts; see [`ClockMap::localise_early`].
    pub fn localise_early(self, remote: RemoteInstant) -> Option<(Instant, u64, bool)> {
        match self {
            Self::Mapped { map } => {
                let (localised, is_early) = map.localise_early(remote)?;
                Some((localised.instant, localised.bound_ns(), is_early))
            }
            Self::SharedMemory | Self::Gateway { .. } => {
                let (at, bound_ns) = self.localise(remote)?;
                Some((at, bound_ns, false))
            }
        }
    }

    /// An instant of the consumer's host on the clock of the producer's, with the largest error.
    pub fn to_remote(self, local: Instant) -> Option<(RemoteInstant, u64)> {
        let shifted = |alignment: Alignment| {
            let remote_ns = local.as_ns().saturating_sub(alignment.offset_ns);
            (RemoteInstant::from_ns(remote_ns), alignment.bound_ns)
        };
        match self {
            Self::SharedMemory => Some(shifted(Alignment::SAME_CLOCK)),
            Self::Gateway { alignment } => alignment.map(shifted),
            Self::Mapped { map } => map.to_remote(local),
        }
    }

    /// How far the two hosts' clocks may have moved against each other between two instants of the
    /// producer's, by the drift allowance of [`ClockSettings`], which needs no alignment; 0 on one
    /// clock, `None` across a noticed step.
    pub fn drift_ns(self, from: RemoteInstant, until: RemoteInstant) -> Option<u64> {
        match self {
            _ if self.has_one_clock() => Some(0),
            Self::Mapped { map } => map.drift_ns(from, until),
            Self::SharedMemory | Self::Gateway { .. } => {
                let span_ns = until.as_ns().saturating_sub(from.as_ns());
                Some(ClockSettings::default().drift_ns(span_ns).unsigned_abs())
            }
        }
    }

    /// True when instants of the two hosts compare at all.
    pub const fn is_aligned(self) -> bool {
        match self {
            Self::SharedMemory => true,
            Self::Gateway { alignment } => alignment.is_some(),
            Self::Mapped { map } => map.metrics().bound.is_some(),
        }
    }

    /// True when both ends read one clock, so that raw kernel stamps compare.
    pub fn has_one_clock(self) -> bool {
        match self {
            Self::SharedMemory => true,
            Self::Gateway { alignment } => alignment == Some(Alignment::SAME_CLOCK),
            Self::Mapped { .. } => false,
        }
    }

    const fn is_gateway(self) -> bool {
        !matches!(self, Self::SharedMemory)
    }
}

/// A process on a channel's way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PathProcess {
    /// Publishes the messages.
    Producer,
    /// Takes them to the network, on the producer's host.
    SendingGateway,
    /// Takes them from the network, on the consumer's host.
    ReceivingGateway,
    /// Takes the messages.
    Consumer,
}

impl PathProcess {
    /// The host it runs on.
    pub const fn side(self) -> Side {
        match self {
            Self::Producer | Self::SendingGateway => Side::Producer,
            Self::ReceivingGateway | Self::Consumer => Side::Consumer,
        }
    }
}

/// A time during which a process on the way was down.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interruption {
    /// Its name in the topology.
    pub process: String,
    /// Its place on this channel's way.
    pub place: PathProcess,
    /// When it went down, on the clock of its own host.
    pub from: Instant,
    /// When it worked again, or the end of the run, on the clock of its own host.
    pub until: Instant,
    /// Why, e.g. `killed by signal 9`.
    pub cause: String,
}

/// The run on one host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunSpan {
    /// First instant of the run.
    pub start: Instant,
    /// Last instant of the run.
    pub end: Instant,
}

/// What the records alone do not say.
#[derive(Debug, Clone, Copy)]
pub struct AccountContext<'a> {
    /// How the channel is carried.
    pub path: ChannelPath<'a>,
    /// Interruptions of processes on this channel's way.
    pub interruptions: &'a [Interruption],
    /// Where the receiving host had no room for datagrams of the channel's flow.
    pub no_room: &'a [NoRoom],
    /// The run on the producer's host clock, if known.
    pub producer_run: Option<RunSpan>,
    /// The run on the consumer's host clock, if known.
    pub consumer_run: Option<RunSpan>,
    /// Longest time a message may travel; see [`flight_time_max`]. Messages seen last within
    /// this time of the end of the run count as in flight, and those seen last within this time
    /// before an interruption count as lost in it.
    pub flight_time_max: Duration,
    /// Messages that a reader of the channel has room for, if known: one that so many came after was
    /// pushed out, and any other that was not taken waits.
    pub depth: Option<usize>,
    /// Where the numbers of the channel's messages begin.
    pub first_number: FirstNumber,
    /// True when a witness reads the channel beside its consumer, who keeps no records, and wrote the records of what
    /// was taken: what it missed the consumer may have taken, and what it took while the consumer was away was lost.
    pub has_witness: bool,
    /// Round trips of the gateways' clock exchange, nanoseconds.
    pub round_trips_ns: &'a [i64],
}

impl<'a> AccountContext<'a> {
    /// The context of a channel about whose run nothing else is known.
    pub const fn new(path: ChannelPath<'a>) -> Self {
        Self {
            path,
            interruptions: &[],
            no_room: &[],
            producer_run: None,
            consumer_run: None,
            flight_time_max: FLIGHT_TIME_MAX,
            depth: None,
            first_number: FirstNumber::Zero,
            has_witness: false,
            round_trips_ns: &[],
        }
    }
}

/// The records of one kind, in the order they were written.
pub trait RecordSource<R>: Debug {
    /// How many.
    fn count(&self) -> u64;

    /// All of them from the first on; every call gives the same ones.
    fn each(&self) -> Box<dyn Iterator<Item = R> + '_>;
}

impl<R: Copy + Debug> RecordSource<R> for Vec<R> {
    fn count(&self) -> u64 {
        self.len() as u64
    }

    fn each(&self) -> Box<dyn Iterator<Item = R> + '_> {
        Box::new(self.iter().copied())
    }
}

impl<R: Copy + Debug, const N: usize> RecordSource<R> for [R; N] {
    fn count(&self) -> u64 {
        N as u64
    }

    fn each(&self) -> Box<dyn Iterator<Item = R> + '_> {
        Box::new(self.iter().copied())
    }
}

/// The records of a file that may not be at hand; none when it is not.
pub fn each<'a, R: 'a>(
    source: Option<&'a dyn RecordSource<R>>,
) -> impl Iterator<Item = R> + use<'a, R> {
    source.into_iter().flat_map(RecordSource::each)
}
