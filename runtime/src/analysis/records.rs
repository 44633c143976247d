//! The record files of a finished run, joined by channel, and the account drawn up from them. What
//! the account means for a reader is decided elsewhere.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hil_models::link::condition::LinkConditionRecord;
use hil_models::measure::account::{
    AccountContext, ChannelAccount, ChannelPath, ChannelRecords, FLIGHT_TIME_MAX, Interruption,
    MessageStory, ORDER_TOLERANCE_NS, Outage, PathProcess, RunSpan, TooManyMessages, TraceChannel,
    account, link_trace, outages, stories,
};
use hil_models::measure::card_clock::{CardClockRecord, CardTimeline};
use hil_models::measure::radio::{
    RadioFigures, TransmitStampFigures, radio_figures, transmit_stamps,
};
use hil_models::measure::record::{
    EgressRecord, FollowUpRecord, IngressRecord, PublishedRecord, RoundTripRecord, TakenRecord,
};
use hil_models::run_log::{LoggedMessage, RunLog};
use hil_models::time::Instant;
use hil_models::trace::TraceRecord;

use super::AnalysisError;
use super::clocks::HostClocks;
use super::{link_changes, stalls};
use crate::face::record::{FaceReceivedRecord, FaceSentRecord};
use crate::process::launch::EmulationLaunch;
use crate::radio::record::RadioRecord;
use crate::record::{RecordFile, RecordFileError, RecordKind};
use crate::report::summary::RecordedFigures;
use crate::supervisor::RunResult;
use crate::supervisor::plan::gateway_name;
use crate::topology::{Channel, Topology};

/// Share of the messages of an emulated link that are not under way for longer than is allowed for:
/// at the end of a run, what is younger may still arrive.
const FLIGHT_QUANTILE: f64 = 0.9999;

/// All records of one channel.
#[derive(Debug, Default)]
pub(crate) struct ChannelFiles {
    pub(super) published: Option<Vec<PublishedRecord>>,
    pub(super) egress: Option<Vec<EgressRecord>>,
    pub(super) ingress: Option<Vec<IngressRecord>>,
    follow_up: Option<Vec<FollowUpRecord>>,
    pub(super) taken: Option<Vec<TakenRecord>>,
    round_trips: BTreeMap<(u32, u64), RoundTripRecord>,
    face_sent: Vec<FaceSentRecord>,
    face_received: Vec<FaceReceivedRecord>,
}

/// Every record file of a run.
#[derive(Debug, Default)]
pub(crate) struct RunRecords {
    pub(super) channels: BTreeMap<String, ChannelFiles>,
    cards: BTreeMap<String, Vec<CardClockRecord>>,
    log: RunLog,
    clocks: HostClocks,
    /// Records of radios, by `<process>/<interface>`.
    pub(super) radios: BTreeMap<String, Vec<RadioRecord>>,
    /// Orders to emulated links, by the channel on which they were given.
    link_orders: BTreeMap<String, Vec<LinkConditionRecord>>,
    /// Files that could not be read, with the reason.
    pub(crate) problems: Vec<String>,
}

impl RunRecords {
    /// Reads the records folder.
    pub(crate) fn read(folder: &Path) -> Result<Self, AnalysisError> {
        let mut records = Self::default();
        let mut add = |file| records.add(&file);
        records.problems = read_files(folder, &|_| true, &|_| {}, &mut add)?;
        Ok(records)
    }

    fn add(&mut self, file: &RecordFile) {
        if file.header.kind == RecordKind::CardClock {
            let card = self.cards.entry(file.header.channel.clone()).or_default();
            card.extend(file.records::<CardClockRecord>());
            return;
        }
        if file.header.kind == RecordKind::Radio {
            let radio = self.radios.entry(file.header.channel.clone());
            radio.or_default().extend(file.records::<RadioRecord>());
            return;
        }
        if file.header.kind == RecordKind::LinkCondition {
            let orders = self.link_orders.entry(file.header.channel.clone());
            orders
                .or_default()
                .extend(file.records::<LinkConditionRecord>());
            return;
        }
        let channel = self
            .channels
            .entry(file.header.channel.clone())
            .or_default();
        match file.header.kind {
            RecordKind::Published => extend(&mut channel.published, file.records()),
            RecordKind::Taken => extend(&mut channel.taken, file.records()),
            RecordKind::Egress => extend(&mut channel.egress, file.records()),
            RecordKind::Ingress => extend(&mut channel.ingress, file.records()),
            RecordKind::FollowUp => extend(&mut channel.follow_up, file.records()),
            RecordKind::RoundTrip => {
                let records = file.records::<RoundTripRecord>();
                // An exchange whose stamps were bettered later is there twice.
                let of = |one: RoundTripRecord| ((one.session, one.sequence), one);
                channel.round_trips.extend(records.map(of));
            }
            RecordKind::FaceSent => channel.face_sent.extend(file.records::<FaceSentRecord>()),
            RecordKind::FaceReceived => {
                let records = file.records::<FaceReceivedRecord>();
                channel.face_received.extend(records);
            }
            RecordKind::Message => file.append_messages(&mut self.log),
            // They belong to no channel, see above.
            RecordKind::CardClock | RecordKind::Radio | RecordKind::LinkCondition => {}
        }
    }

    /// Orders to emulated links that were given on `channel`, in the order of the gateway's count.
    pub(super) fn link_orders(&self, channel: &str) -> &[LinkConditionRecord] {
        self.link_orders.get(channel).map_or(&[], Vec::as_slice)
    }

    /// The clock of a card, as [`crate::card_clock`] names it; `None` when it was not read.
    pub(super) fn card_timeline(&self, card: &str) -> Option<CardTimeline> {
        self.cards.get(card).map(|pairs| CardTimeline::new(pairs))
    }

    /// What the gateways recorded of `channel`: what they sent and what they received.
    pub(super) fn of_gateways(&self, channel: &str) -> (&[EgressRecord], &[IngressRecord]) {
        let files = self.channels.get(channel);
        let egress = files.and_then(|files| files.egress.as_deref());
        let ingress = files.and_then(|files| files.ingress.as_deref());
        (egress.unwrap_or_default(), ingress.unwrap_or_default())
    }

    /// Every message of the run, to bring them to one clock.
    pub(super) const fn log_mut(&mut self) -> &mut RunLog {
        &mut self.log
    }

    /// Relates the hosts' clocks; until then none are aligned.
    pub(super) fn set_clocks(&mut self, clocks: HostClocks) {
        self.clocks = clocks;
    }

    /// How the hosts' clocks relate.
    pub(super) const fn clocks(&self) -> &HostClocks {
        &self.clocks
    }

    /// The clock exchanges of the gateways of `channel`.
    pub(super) fn round_trips(&self, channel: &str) -> impl Iterator<Item = &RoundTripRecord> {
        let files = self.channels.get(channel);
        files
            .into_iter()
            .flat_map(|files| files.round_trips.values())
    }

    /// Real-time minus monotonic clock of `host` as its gateways noted it; `None` when none did, or
    /// the clock was stepped.
    pub(super) fn realtime_offset_ns(&self, topology: &Topology, host: &str) -> Option<i64> {
        let is_here = |process: &str| {
            topology
                .process(process)
                .is_some_and(|one| one.host == host)
        };
        let mut ends: Option<(i64, i64)> = None;
        for channel in topology.channels() {
            let Some(files) = self.channels.get(&channel.name) else {
                continue;
            };
            let sent = files.egress.iter().flatten();
            let sent = sent.map(|record| record.realtime_offset_ns);
            let sent = sent.filter(|_| is_here(&channel.from));
            let is_receiver = channel.to.as_deref().is_some_and(is_here);
            let received = files.ingress.iter().flatten();
            let received = received.map(|record| record.realtime_offset_ns);
            let received = received.filter(|_| is_receiver);
            for offset_ns in sent.chain(received) {
                let (lowest, highest) = ends.unwrap_or((offset_ns, offset_ns));
                ends = Some((lowest.min(offset_ns), highest.max(offset_ns)));
            }
        }
        let (lowest, highest) = ends?;
        let width_ns = highest.saturating_sub(lowest);
        (width_ns <= ORDER_TOLERANCE_NS).then_some(lowest + width_ns / 2)
    }

    /// True when anything was recorded of `channel`.
    pub(super) fn has(&self, channel: &str) -> bool {
        self.channels.contains_key(channel)
    }

    /// What the receiving gateway of `channel` noted of each datagram; empty when it left nothing.
    pub(super) fn arrivals(&self, channel: &str) -> &[IngressRecord] {
        let files = self.channels.get(channel);
        let records = files.and_then(|files| files.ingress.as_deref());
        records.unwrap_or_default()
    }

    /// Every message of the run.
    pub(crate) fn log(&self) -> &RunLog {
        &self.log
    }

    /// What there is of a channel that is only recorded; `None` when nothing is.
    pub(super) fn recorded(&self, channel: &str) -> Option<RecordedFigures> {
        let messages = self.log.raw(channel);
        self.has(channel).then(|| RecordedFigures {
            message_count: messages.len() as u64,
            missing_count: missing_count(messages),
        })
    }

    /// What a face recorded that sends the messages of `out` and publishes on `back`.
    pub(super) fn of_face(
        &self,
        out: &str,
        back: &str,
    ) -> (&[FaceSentRecord], &[FaceReceivedRecord]) {
        let sent = self
            .channels
            .get(out)
            .map(|files| files.face_sent.as_slice());
        let received = self
            .channels
            .get(back)
            .map(|files| files.face_received.as_slice());
        (sent.unwrap_or_default(), received.unwrap_or_default())
    }

    /// The account of `channel`.
    pub(crate) fn account(
        &self,
        topology: &Topology,
        result: &RunResult,
        channel: &Channel,
    ) -> ChannelAccount {
        self.consult((topology, result), channel, account)
    }

    /// Where the messages of `channel` were stamped, and what the radio said of them.
    pub(super) fn radio_figures(
        &self,
        run: (&Topology, &RunResult),
        channel: &Channel,
    ) -> (Option<TransmitStampFigures>, Option<RadioFigures>) {
        self.consult(run, channel, |records, context| {
            let stamps = records.egress.map(transmit_stamps);
            (stamps, radio_figures(records, context))
        })
    }

    /// What became of the `wanted` messages of `channel`, by start of the producer and number.
    pub(super) fn stories(
        &self,
        run: (&Topology, &RunResult),
        channel: &Channel,
        wanted: &BTreeSet<(u32, u64)>,
    ) -> BTreeMap<(u32, u64), MessageStory> {
        self.consult(run, channel, |records, context| {
            stories(records, context, wanted)
        })
    }

    /// The outages of `channel`, in the order of its messages.
    pub(super) fn outages(&self, run: (&Topology, &RunResult), channel: &Channel) -> Vec<Outage> {
        self.consult(run, channel, outages)
    }

    /// The processes on the way of `channel` that were down, one for each interruption.
    pub(super) fn interrupted(
        &self,
        run: (&Topology, &RunResult),
        channel: &Channel,
    ) -> Vec<String> {
        self.consult(run, channel, |_, context| {
            let interruptions = context.interruptions.iter();
            interruptions.map(|one| one.process.clone()).collect()
        })
    }

    /// What the link of `channel` did to every message.
    ///
    /// # Errors
    /// When there are more than a trace holds.
    pub(crate) fn link_trace(
        &self,
        run: (&Topology, &RunResult),
        channel: &Channel,
        traced: TraceChannel,
    ) -> Result<Vec<TraceRecord>, TooManyMessages> {
        self.consult(run, channel, |records, context| {
            link_trace(records, context, traced)
        })
    }

    /// Asks something of the records of `channel` and of what the run knows about its way.
    pub(super) fn consult<T>(
        &self,
        (topology, result): (&Topology, &RunResult),
        channel: &Channel,
        ask: impl FnOnce(&ChannelRecords<'_>, &AccountContext<'_>) -> T,
    ) -> T {
        let nothing = ChannelFiles::default();
        let files = self.channels.get(&channel.name).unwrap_or(&nothing);
        let mut interruptions = interruptions(topology, result, channel);
        interruptions.extend(stalls::at_end(self, (topology, result), channel));
        let span_of = |process: &str| {
            let (start, end) = *result.spans.get(&topology.process(process)?.host)?;
            Some(RunSpan { start, end })
        };
        let crossing = topology.crossing(channel);
        let cards_share_clock = crossing
            .as_ref()
            .is_some_and(|crossing| super::cards::share_a_clock(result, crossing));
        let path = if crossing.is_some() {
            let host_of = |process: Option<&str>| Some(&topology.process(process?)?.host);
            let hosts = host_of(Some(&channel.from)).zip(host_of(channel.to.as_deref()));
            hosts.map_or(ChannelPath::Gateway { alignment: None }, |(from, to)| {
                self.clocks.path(from, to)
            })
        } else {
            ChannelPath::SharedMemory
        };
        // A link that delays on purpose keeps messages under way for that much longer.
        let changed = crossing
            .as_ref()
            .map(|crossing| link_changes::longest_delay(topology, self, crossing));
        let delay = crossing
            .and_then(|crossing| EmulationLaunch::of(&crossing, topology.run().seed))
            .map(|emulation| {
                let delay = emulation.flight_time(FLIGHT_QUANTILE);
                delay.expect("a run begins when its traces were read, and what was read is noted")
            });
        let round_trips = files.round_trips.values();
        let round_trips_ns: Vec<i64> = round_trips.map(RoundTripRecord::rtt_ns).collect();
        let context = AccountContext {
            interruptions: &interruptions,
            producer_run: span_of(&channel.from),
            consumer_run: channel.to.as_deref().and_then(span_of),
            flight_time_max: FLIGHT_TIME_MAX + delay.max(changed).unwrap_or(Duration::ZERO),
            cards_share_clock,
            round_trips_ns: &round_trips_ns,
            seed: topology.run().seed,
            ..AccountContext::new(path)
        };
        let records = ChannelRecords {
            published: files.published.as_deref(),
            egress: files.egress.as_deref(),
            ingress: files.ingress.as_deref(),
            follow_up: files.follow_up.as_deref(),
            taken: files.taken.as_deref(),
        };
        ask(&records, &context)
    }
}

/// The messages of a run, without the rest of its records.
#[derive(Debug, Default)]
pub(crate) struct MessageRecords {
    /// The messages.
    pub(crate) log: RunLog,
    /// Channels whose messages someone recorded, be it none.
    pub(crate) files: BTreeSet<String>,
    /// What could not be read.
    pub(crate) problems: Vec<String>,
}

impl MessageRecords {
    /// Reads them from a records folder; `reach` hears the share that is read.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub(crate) fn read(folder: &Path, reach: &dyn Fn(f64)) -> Result<Self, AnalysisError> {
        let mut records = Self::default();
        let wanted = |name: &str| name.contains(".message.");
        let problems = read_files(folder, &wanted, reach, &mut |file| {
            if file.header.kind != RecordKind::Message {
                return;
            }
            let channel = &file.header.channel;
            records.files.insert(channel.clone());
            file.append_messages(&mut records.log);
            if file.truncated_bytes > 0 {
                let problem = format!("{channel}: a record file ends in half a message");
                records.problems.push(problem);
            }
        })?;
        records.problems.extend(problems);
        Ok(records)
    }
}

/// Sequence numbers below the highest of each start of a producer that are not among its
/// recorded messages.
pub(crate) fn missing_count(messages: &[LoggedMessage]) -> u64 {
    let mut next_of_epoch: BTreeMap<u32, u64> = BTreeMap::new();
    for message in messages {
        let next = next_of_epoch.entry(message.envelope.epoch).or_default();
        *next = (*next).max(message.envelope.sequence.saturating_add(1));
    }
    let given = next_of_epoch.values();
    let given_count = given.fold(0_u64, |sum, count| sum.saturating_add(*count));
    given_count.saturating_sub(messages.len() as u64)
}

/// Hands every record file of `folder` with a `wanted` name to `take`, and before each the share of
/// their bytes that is read to `reach`; gives what could not be read.
fn read_files(
    folder: &Path,
    wanted: &dyn Fn(&str) -> bool,
    reach: &dyn Fn(f64),
    take: &mut dyn FnMut(RecordFile),
) -> Result<Vec<String>, AnalysisError> {
    let failed = |source| AnalysisError::Folder {
        folder: folder.to_owned(),
        source,
    };
    let mut paths: Vec<PathBuf> = fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(failed)?;
    // By name, so that the instances of a restarted process come in order.
    paths.sort();
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default();
        wanted(&name.to_string_lossy())
    });
    let size = |path: &PathBuf| fs::metadata(path).map_or(0, |file| file.len());
    let all_bytes: u64 = paths.iter().map(size).sum();
    let mut read_bytes = 0;
    let mut problems = Vec::new();
    for path in paths {
        reach(read_bytes as f64 / all_bytes.max(1) as f64);
        read_bytes += size(&path);
        match RecordFile::read(&path) {
            Ok(file) => take(file),
            // A process killed while it opened its files leaves one without a header.
            Err(error @ RecordFileError::Malformed { offset: 0, .. }) => {
                problems.push(format!("{error}; left out"));
            }
            Err(error) => problems.push(error.to_string()),
        }
    }
    Ok(problems)
}

fn extend<T>(records: &mut Option<Vec<T>>, more: impl Iterator<Item = T>) {
    records.get_or_insert_default().extend(more);
}

/// The times in which a process on the channel's way was not there.
fn interruptions(topology: &Topology, result: &RunResult, channel: &Channel) -> Vec<Interruption> {
    let gateway = |process: &str| {
        let host = &topology.process(process)?.host;
        Some(gateway_name(channel.link.as_deref()?, host))
    };
    let places = [
        (Some(channel.from.clone()), PathProcess::Producer),
        (gateway(&channel.from), PathProcess::SendingGateway),
        (
            channel.to.as_deref().and_then(gateway),
            PathProcess::ReceivingGateway,
        ),
        (channel.to.clone(), PathProcess::Consumer),
    ];
    let end_of = |host: &str| {
        result
            .spans
            .get(host)
            .map_or(Instant::from_ns(i64::MAX), |span| span.1)
    };
    let mut found = Vec::new();
    for event in &result.events {
        let Some(gap) = event.interruption else {
            continue;
        };
        for (_, place) in places
            .iter()
            .filter(|(name, _)| name.as_ref() == Some(&event.process))
        {
            found.push(Interruption {
                process: event.process.clone(),
                place: *place,
                from: gap.from,
                until: gap.until.unwrap_or(end_of(&event.host)),
                cause: event.what.clone(),
            });
        }
    }
    found
}
