//! The records of a run that never was, for the reports that are checked in.

use hil_account::{
    AccountContext, ChannelAccount, ChannelPath, ChannelRecords, Demand, DemandFold, DemandMetrics,
    Interruption, OutageFinder, OutageMetrics, PathProcess, RunSpan, account, each_history,
};
use hil_core::random::RandomStream;
use hil_core::record::{EgressRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE};
use hil_core::time::{Alignment, Instant};

const PERIOD_NS: i64 = 4_000_000;
const REALTIME_NS: i64 = 1_790_000_000_000_000_000;

/// The records of 5000 messages with losses, missing stamps and a killed gateway.
#[derive(Default)]
pub(super) struct Files {
    published: Vec<PublishedRecord>,
    egress: Vec<EgressRecord>,
    ingress: Vec<IngressRecord>,
    taken: Vec<TakenRecord>,
}

impl Files {
    /// All of them.
    pub(crate) fn sample() -> Self {
        let mut files = Self::default();
        let mut stream = RandomStream::new(1, "report sample");
        for sequence in 0..5_000_u64 {
            files.write(sequence, &mut stream);
        }
        files
    }

    fn write(&mut self, sequence: u64, stream: &mut RandomStream) {
        let published_ns = i64::try_from(sequence).unwrap() * PERIOD_NS;
        let mut now_ns = published_ns;
        let mut next = |scale: f64| {
            // A skewed delay: mostly near its scale, sometimes far above.
            let exponent = 0.3 * stream.normal() + if stream.chance(0.01) { 1.5 } else { 0.0 };
            #[allow(clippy::cast_possible_truncation, reason = "far below 10^18")]
            let delay_ns = (scale * exponent.exp()) as i64;
            now_ns += delay_ns;
            now_ns
        };
        self.published.push(PublishedRecord {
            sequence,
            published_ns,
            epoch: 1,
            reserved: 0,
        });
        let is_down = (2_000..2_190).contains(&sequence);
        if sequence % 1_700 == 13 {
            return;
        }
        let (taken_ns, handed_ns) = (next(14_000.0), next(900.0));
        let has_tx = !sequence.is_multiple_of(97) && !is_down;
        let tx_ns = REALTIME_NS + next(2_300.0);
        self.egress.push(EgressRecord {
            sequence,
            published_ns,
            taken_ns,
            handed_ns,
            tx_software_ns: if has_tx { tx_ns } else { UNAVAILABLE },
            tx_hardware_ns: UNAVAILABLE,
            realtime_offset_ns: REALTIME_NS,
            epoch: 1,
            session: 9,
            flags: u32::from(is_down && sequence.is_multiple_of(2)),
            fragment_count: 1,
        });
        if is_down || matches!(sequence, 900 | 3_000..3_003) {
            return;
        }
        let rx_ns = REALTIME_NS + next(700.0);
        let (received_ns, forwarded_ns) = (next(13_000.0), next(1_100.0));
        self.ingress.push(IngressRecord {
            sequence,
            published_ns,
            handed_ns,
            rx_hardware_ns: UNAVAILABLE,
            rx_software_ns: rx_ns,
            received_ns,
            forwarded_ns,
            // Two reads of one clock pair differ by a little; one pair was read across a step.
            realtime_offset_ns: REALTIME_NS + if sequence == 4_000 { 7_000 } else { 40 },
            emulated_ns: UNAVAILABLE,
            due_ns: UNAVAILABLE,
            follow_up_sequence: 0,
            follow_up_ns: UNAVAILABLE,
            epoch: 1,
            session: 9,
            flags: 0,
            fragment_count: 1,
        });
        self.taken.push(TakenRecord {
            sequence,
            published_ns,
            forwarded_ns,
            taken_ns: next(16_000.0),
            epoch: 1,
            reserved: 0,
        });
    }

    /// The account of a channel between gateways, one of which was killed.
    pub(crate) fn account(&self, alignment: Option<Alignment>) -> ChannelAccount {
        self.consult(alignment, account)
    }

    /// The outages of the same channel on one clock.
    pub(crate) fn outages(&self) -> OutageMetrics {
        let mut found = OutageFinder::default();
        self.consult(Some(Alignment::SAME_CLOCK), |records, context| {
            each_history(records, context, |message| found.add(message));
        });
        let end = Instant::from_ns(5_000 * PERIOD_NS);
        OutageMetrics::of(&found.finish(), Some(end))
    }

    /// A demand on the same channel, judged.
    pub(crate) fn demand(&self, demand: &Demand, alignment: Option<Alignment>) -> DemandMetrics {
        self.consult(alignment, |records, context| {
            let mut fold = DemandFold::of_channel(demand, context);
            each_history(records, context, |message| fold.add(message, context));
            fold.finish()
        })
    }

    fn consult<T>(
        &self,
        alignment: Option<Alignment>,
        ask: impl FnOnce(&ChannelRecords<'_>, &AccountContext<'_>) -> T,
    ) -> T {
        let run = RunSpan {
            start: Instant::ZERO,
            end: Instant::from_ns(5_000 * PERIOD_NS),
        };
        let interruptions = [Interruption {
            process: "robot gateway".to_owned(),
            place: PathProcess::ReceivingGateway,
            from: Instant::from_ns(2_000 * PERIOD_NS - 1_000_000),
            until: Instant::from_ns(2_190 * PERIOD_NS - 1_000_000),
            cause: "killed by signal 9".to_owned(),
        }];
        let records = ChannelRecords {
            published: Some(&self.published),
            egress: Some(&self.egress),
            ingress: Some(&self.ingress),
            taken: Some(&self.taken),
        };
        let context = AccountContext {
            producer_run: Some(run),
            consumer_run: Some(run),
            round_trips_ns: &[41_000, 44_000, 47_500, 90_000],
            ..AccountContext::new(ChannelPath::Gateway { alignment })
        };
        ask(&records, &context.with_interruptions(&interruptions))
    }

    /// The account of a direct channel with the same messages.
    pub(crate) fn direct(&self) -> ChannelAccount {
        let records = ChannelRecords {
            published: Some(&self.published),
            taken: Some(&self.taken),
            ..ChannelRecords::default()
        };
        account(&records, &AccountContext::new(ChannelPath::SharedMemory))
    }
}
