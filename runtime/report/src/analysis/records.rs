//! The record files of a finished run, joined by channel, and the account drawn up from them. What
//! the account means for a reader is decided elsewhere.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bytemuck::Pod;
use hil_account::nic_clock::{NicClockRecord, NicTimeline};
use hil_account::{
    AccountContext, ChannelPath, ChannelRecords, FLIGHT_QUANTILE, FirstNumber, Interruption,
    NoRoom, ORDER_TOLERANCE_NS, RunSpan, flight_time_max,
};
use hil_core::record::{
    EgressRecord, IngressRecord, NoRoomRecord, PublishedRecord, RoundTripRecord, TakenRecord,
};
use hil_core::run_log::{Logged, RunLog};
use hil_link::condition::LinkConditionRecord;
use hil_protocol::seal::UNANSWERED_MAX;

use super::clocks::HostClocks;
use super::{AnalysisError, interruptions, link_changes};
use crate::summary::RecordedMetrics;
use hil_rundir::protection::HopProtection;
use hil_rundir::radio_record::RadioRecord;
use hil_rundir::record::stored::{
    ReadFaults, StoredFile, StoredRecords, file_bytes, sort_by_start,
};
use hil_rundir::record::{RecordFile, RecordFileError, RecordKind};
use hil_rundir::run_result::RunResult;
use hil_topology::emulation::EmulationLaunch;
use hil_topology::{Channel, Process, Topology};

/// A finished run: what it was to be, how it went, and every record file that it left.
#[derive(Debug)]
pub(crate) struct RunRecords<'a> {
    pub(crate) topology: &'a Topology,
    pub(crate) result: &'a RunResult,
    pub(super) channels: BTreeMap<String, ChannelFiles>,
    cards: BTreeMap<String, Vec<NicClockRecord>>,
    /// Every message of the run.
    pub(super) log: RunLog,
    /// How the hosts' clocks relate; none are aligned before they are related.
    pub(super) clocks: HostClocks,
    /// Records of radios, by `<process>/<interface>`.
    pub(super) radios: BTreeMap<String, Vec<RadioRecord>>,
    /// Orders to emulated links, by the channel on which they were given.
    link_orders: BTreeMap<String, Vec<LinkConditionRecord>>,
    /// Clock exchanges, by flow.
    round_trips: BTreeMap<String, BTreeMap<(u32, u64), RoundTripRecord>>,
    /// Datagrams without room, by flow.
    no_room: BTreeMap<String, Vec<NoRoomRecord>>,
    /// Files that could not be opened, with the reason.
    problems: Vec<String>,
    /// What went wrong later.
    faults: ReadFaults,
    /// Processes on the way of each channel that were not there or held up, once asked for.
    interruptions: RefCell<BTreeMap<String, Vec<Interruption>>>,
    /// The same of the stretches without room, by flow.
    stretches: RefCell<BTreeMap<String, Vec<NoRoom>>>,
}

impl<'a> RunRecords<'a> {
    /// Opens the files of the records folder. What a channel has of every message stays in them.
    pub(crate) fn read(
        topology: &'a Topology,
        result: &'a RunResult,
    ) -> Result<Self, AnalysisError> {
        let mut records = Self {
            topology,
            result,
            channels: BTreeMap::new(),
            cards: BTreeMap::new(),
            log: RunLog::default(),
            clocks: HostClocks::default(),
            radios: BTreeMap::new(),
            link_orders: BTreeMap::new(),
            round_trips: BTreeMap::new(),
            no_room: BTreeMap::new(),
            problems: Vec::new(),
            faults: ReadFaults::default(),
            interruptions: RefCell::default(),
            stretches: RefCell::default(),
        };
        let mut add = |path: &Path| {
            records.add(StoredFile::open(path)?);
            Ok(())
        };
        let folder = result.folder.records();
        let problems = each_file(&folder, &|_| true, &|_| {}, &mut add)?;
        records.problems = problems;
        for (name, files) in &mut records.channels {
            files.signs = Signs::of(files);
            if let Some(messages) = files.message.take() {
                records.log.set_stored(name, Arc::new(messages));
            }
        }
        Ok(records)
    }

    fn add(&mut self, file: StoredFile) {
        let name = file.header.channel.clone();
        let kind = file.header.kind;
        let alone = |file| {
            let mut records = StoredRecords::new(&self.faults);
            records.push(file);
            records
        };
        match kind {
            RecordKind::NicClock => {
                let card = self.cards.entry(name).or_default();
                card.extend(alone(file).records::<NicClockRecord>());
                return;
            }
            RecordKind::Radio => {
                let radio = self.radios.entry(name).or_default();
                radio.extend(alone(file).records::<RadioRecord>());
                return;
            }
            RecordKind::LinkCondition => {
                let orders = self.link_orders.entry(name).or_default();
                orders.extend(alone(file).records::<LinkConditionRecord>());
                return;
            }
            RecordKind::NoRoom => {
                let known = self.no_room.entry(name).or_default();
                known.extend(alone(file).records::<NoRoomRecord>());
                return;
            }
            RecordKind::RoundTrip => {
                let known = self.round_trips.entry(name).or_default();
                let records = alone(file);
                // An exchange whose stamps were bettered later is there twice.
                let of = |one: RoundTripRecord| ((one.session, one.sequence), one);
                known.extend(records.records().map(of));
                return;
            }
            _ => {}
        }
        let channel = self.channels.entry(name).or_default();
        let files = match kind {
            RecordKind::Published => &mut channel.published,
            RecordKind::Taken => &mut channel.taken,
            RecordKind::Egress => &mut channel.egress,
            RecordKind::Ingress => &mut channel.ingress,
            RecordKind::AdapterSent => &mut channel.adapter_sent,
            RecordKind::AdapterReceived => &mut channel.adapter_received,
            RecordKind::Message => &mut channel.message,
            RecordKind::Frame => &mut channel.frame,
            // They belong to no channel, see above.
            RecordKind::RoundTrip
            | RecordKind::NoRoom
            | RecordKind::NicClock
            | RecordKind::Radio
            | RecordKind::LinkCondition => return,
        };
        files
            .get_or_insert_with(|| StoredRecords::new(&self.faults))
            .push(file);
    }

    /// Record files that could not be read, or not to their ends, with the reason.
    pub(crate) fn problems(&self) -> Vec<String> {
        let later = self.faults.texts();
        self.problems.iter().cloned().chain(later).collect()
    }

    /// Orders to emulated links that were given on `channel`, in the order of the gateway's count.
    pub(super) fn link_orders(&self, channel: &str) -> &[LinkConditionRecord] {
        self.link_orders.get(channel).map_or(&[], Vec::as_slice)
    }

    /// The clock of a card, by the name that a
    /// [`NicHistory`](hil_rundir::nic_history::NicHistory) gives it; `None` when it was not read.
    pub(super) fn nic_timeline(&self, card: &str) -> Option<NicTimeline> {
        self.cards.get(card).map(|pairs| NicTimeline::new(pairs))
    }

    /// The records that `channel` has of one kind; empty when there are none.
    pub(super) fn of_kind<R: Pod>(
        &self,
        channel: &str,
        kind: fn(&ChannelFiles) -> Option<&StoredRecords>,
    ) -> impl Iterator<Item = R> + '_ {
        let files = self.channels.get(channel).and_then(kind);
        files.into_iter().flat_map(StoredRecords::records)
    }

    /// The clock exchanges of the gateways of `flow`: one way of a link, or a clock path.
    pub(super) fn round_trips(&self, flow: &str) -> impl Iterator<Item = &RoundTripRecord> + Clone {
        let known = self.round_trips.get(flow);
        known.into_iter().flat_map(BTreeMap::values)
    }

    /// The clock exchanges of the gateways that carry `channel`; none of one that stays on its host.
    pub(super) fn exchanges_of(&self, channel: &Channel) -> impl Iterator<Item = &RoundTripRecord> {
        let crossing = self.topology.crossing(channel);
        let known = crossing.and_then(|one| self.round_trips.get(&one.flow_name()));
        known.into_iter().flat_map(BTreeMap::values)
    }

    /// Real-time minus monotonic clock of `host` as its gateways noted it; `None` when none did, or
    /// the clock was stepped.
    pub(super) fn realtime_offset_ns(&self, host: &str) -> Option<i64> {
        let process = |name: &str| self.topology.process(name);
        let is_here = |name: &str| process(name).is_some_and(|one| one.host == host);
        let mut ends: Option<(i64, i64)> = None;
        for channel in self.topology.channels() {
            let Some(files) = self.channels.get(&channel.name) else {
                continue;
            };
            let is_receiver = channel.to.as_deref().is_some_and(is_here);
            let of_sender = files.signs.sender_realtime_ns;
            let of_receiver = files.signs.receiver_realtime_ns;
            let own = [
                of_sender.filter(|_| is_here(&channel.from)),
                of_receiver.filter(|_| is_receiver),
            ];
            for (lowest, highest) in own.into_iter().flatten() {
                widen(&mut ends, lowest);
                widen(&mut ends, highest);
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

    /// What there is of a channel that is only recorded; `None` when nothing is.
    pub(super) fn recorded(&self, channel: &str) -> Option<RecordedMetrics> {
        let messages = self.log.raw(channel);
        self.has(channel).then(|| RecordedMetrics {
            message_count: messages.len() as u64,
            missing_count: missing_count(messages),
        })
    }

    /// Asks something of the records of `channel` and of what the run knows about its way.
    pub(crate) fn consult<T>(
        &self,
        channel: &Channel,
        ask: impl FnOnce(&ChannelRecords<'_>, &AccountContext<'_>) -> T,
    ) -> T {
        self.consult_with(channel, &self.stretches(channel), ask)
    }

    fn consult_with<T>(
        &self,
        channel: &Channel,
        no_room: &[NoRoom],
        ask: impl FnOnce(&ChannelRecords<'_>, &AccountContext<'_>) -> T,
    ) -> T {
        let (topology, result) = (self.topology, self.result);
        let nothing = ChannelFiles::default();
        let files = self.channels.get(&channel.name).unwrap_or(&nothing);
        let interruptions = self.interruptions(channel);
        let span_of = |process: &str| {
            let (start, end) = *result.spans.get(&topology.process(process)?.host)?;
            Some(RunSpan { start, end })
        };
        let is_witnessed =
            |process: &str| topology.process(process).is_some_and(Process::is_witnessed);
        let crossing = topology.crossing(channel);
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
            .map(|crossing| link_changes::longest_delay(self, crossing));
        let delay = crossing
            .and_then(|crossing| EmulationLaunch::of(&crossing, topology.run().seed))
            .map(|emulation| match emulation.trace {
                // A run begins when its traces were read, and what was read is in its result.
                Some(_) => {
                    let noted = result.trace_delays.get(&channel.name);
                    noted.copied().unwrap_or_default()
                }
                None => emulation.spec.flight_time(FLIGHT_QUANTILE),
            });
        let round_trips = self.exchanges_of(channel);
        let round_trips_ns: Vec<i64> = round_trips.map(RoundTripRecord::rtt_ns).collect();
        let context = AccountContext {
            interruptions: &interruptions,
            no_room,
            producer_run: span_of(&channel.from),
            consumer_run: channel.to.as_deref().and_then(span_of),
            flight_time_max: flight_time_max(delay.max(changed).unwrap_or(Duration::ZERO)),
            depth: Some(channel.depth),
            // What such a program published before the run began is no message of the run.
            first_number: if is_witnessed(&channel.from) {
                FirstNumber::OnRecord
            } else {
                FirstNumber::Zero
            },
            has_witness: channel.to.as_deref().is_some_and(is_witnessed),
            round_trips_ns: &round_trips_ns,
            ..AccountContext::new(path)
        };
        let records = ChannelRecords {
            published: files.published.as_ref().map(|files| files as _),
            egress: files.egress.as_ref().map(|files| files as _),
            ingress: files.ingress.as_ref().map(|files| files as _),
            taken: files.taken.as_ref().map(|files| files as _),
        };
        ask(&records, &context)
    }

    /// Where the receiving host had no room for datagrams of the flow that carries `channel`, beside what is missing
    /// there of all its channels.
    fn stretches(&self, channel: &Channel) -> Vec<NoRoom> {
        let crossing = self.topology.crossing(channel);
        let Some(flow) = crossing.map(|crossing| crossing.flow_name()) else {
            return Vec::new();
        };
        let Some(records) = self.no_room.get(&flow).filter(|all| !all.is_empty()) else {
            return Vec::new();
        };
        if let Some(known) = self.stretches.borrow().get(&flow) {
            return known.clone();
        }
        let mut found = NoRoom::of(records.iter().copied());
        let crossings = self.topology.crossings();
        for crossing in crossings.filter(|crossing| crossing.flow_name() == flow) {
            self.consult_with(crossing.channel, &[], |records, context| {
                NoRoom::add_missing(&mut found, records, context);
            });
        }
        let security = self.result.security.as_ref();
        let is_sealed =
            security.is_some_and(|one| matches!(one.hops, HopProtection::Sealed { .. }));
        let unanswered_max = is_sealed.then_some(UNANSWERED_MAX);
        NoRoom::add_requests(&mut found, self.round_trips(&flow), unanswered_max);
        self.stretches.borrow_mut().insert(flow, found.clone());
        found
    }

    /// Both kinds read what the channel's processes left.
    fn interruptions(&self, channel: &Channel) -> Vec<Interruption> {
        if let Some(known) = self.interruptions.borrow().get(&channel.name) {
            return known.clone();
        }
        let mut found = interruptions::noted(self, channel);
        found.extend(interruptions::at_end(self, channel));
        let mut interruptions = self.interruptions.borrow_mut();
        interruptions.insert(channel.name.clone(), found.clone());
        found
    }
}

/// Hands every record file of `folder` with a `wanted` name to `take`, and before each the share of
/// their bytes that lies before it to `reach`; gives what could not be read.
fn each_file(
    folder: &Path,
    wanted: &dyn Fn(&str) -> bool,
    reach: &dyn Fn(f64),
    take: &mut dyn FnMut(&Path) -> Result<(), RecordFileError>,
) -> Result<Vec<String>, AnalysisError> {
    let failed = |source| AnalysisError::Folder {
        folder: folder.to_owned(),
        source,
    };
    let mut paths: Vec<PathBuf> = fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(failed)?;
    sort_by_start(&mut paths);
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default();
        wanted(&name.to_string_lossy())
    });
    let all_bytes: u64 = paths.iter().map(|path| file_bytes(path)).sum();
    let mut read_bytes = 0;
    let mut problems = Vec::new();
    for path in paths {
        reach(read_bytes as f64 / all_bytes.max(1) as f64);
        read_bytes += file_bytes(&path);
        match take(&path) {
            Ok(()) => {}
            // A process killed while it opened its files leaves one without a header.
            Err(error @ RecordFileError::Malformed { offset: 0, .. }) => {
                problems.push(format!("{error}; left out"));
            }
            Err(error) => problems.push(error.to_string()),
        }
    }
    Ok(problems)
}

/// All records of one channel.
#[derive(Debug, Default)]
pub(super) struct ChannelFiles {
    pub(super) published: Option<StoredRecords>,
    pub(super) egress: Option<StoredRecords>,
    pub(super) ingress: Option<StoredRecords>,
    pub(super) taken: Option<StoredRecords>,
    pub(super) adapter_sent: Option<StoredRecords>,
    pub(super) adapter_received: Option<StoredRecords>,
    pub(super) message: Option<StoredRecords>,
    pub(super) frame: Option<StoredRecords>,
    pub(super) signs: Signs,
}

/// The last signs of life that a channel's records give, and the ends of what its gateways noted of the
/// clocks: asked for by other channels, too, so read once.
#[derive(Debug, Default)]
#[allow(clippy::struct_field_names, reason = "the unit, as everywhere")]
pub(super) struct Signs {
    pub(super) published_ns: Option<i64>,
    pub(super) sent_ns: Option<i64>,
    pub(super) received_ns: Option<i64>,
    pub(super) taken_ns: Option<i64>,
    pub(super) sender_realtime_ns: Option<(i64, i64)>,
    pub(super) receiver_realtime_ns: Option<(i64, i64)>,
}

impl Signs {
    fn of(files: &ChannelFiles) -> Self {
        let mut signs = Self::default();
        for record in all::<PublishedRecord>(files.published.as_ref()) {
            signs.published_ns = signs.published_ns.max(Some(record.published_ns));
        }
        for record in all::<EgressRecord>(files.egress.as_ref()) {
            signs.sent_ns = signs.sent_ns.max(Some(record.taken_ns));
            widen(&mut signs.sender_realtime_ns, record.realtime_offset_ns);
        }
        for record in all::<IngressRecord>(files.ingress.as_ref()) {
            signs.received_ns = signs.received_ns.max(Some(record.received_ns));
            widen(&mut signs.receiver_realtime_ns, record.realtime_offset_ns);
        }
        for record in all::<TakenRecord>(files.taken.as_ref()) {
            signs.taken_ns = signs.taken_ns.max(Some(record.taken_ns));
        }
        signs
    }
}

/// Lets `ends` take in `ns`.
fn widen(ends: &mut Option<(i64, i64)>, ns: i64) {
    let (lowest, highest) = ends.unwrap_or((ns, ns));
    *ends = Some((lowest.min(ns), highest.max(ns)));
}

/// The records of files that may not be there.
pub(super) fn all<R: Pod>(files: Option<&StoredRecords>) -> impl Iterator<Item = R> + '_ {
    files.into_iter().flat_map(StoredRecords::records)
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
        let problems = each_file(folder, &wanted, reach, &mut |path| {
            let file = RecordFile::read(path)?;
            if file.header.kind != RecordKind::Message {
                return Ok(());
            }
            let channel = &file.header.channel;
            records.files.insert(channel.clone());
            file.append_messages(&mut records.log);
            if file.truncated_bytes > 0 {
                let problem = format!("{channel}: a record file ends in half a message");
                records.problems.push(problem);
            }
            Ok(())
        })?;
        records.problems.extend(problems);
        Ok(records)
    }
}

/// Sequence numbers below the highest of each start of a producer that are not among its
/// recorded messages.
pub(crate) fn missing_count(messages: Logged<'_>) -> u64 {
    let mut next_of_epoch: BTreeMap<u32, u64> = BTreeMap::new();
    for message in messages {
        let next = next_of_epoch.entry(message.envelope.epoch).or_default();
        *next = (*next).max(message.envelope.sequence.saturating_add(1));
    }
    let given = next_of_epoch.values();
    let given_count = given.fold(0_u64, |sum, count| sum.saturating_add(*count));
    given_count.saturating_sub(messages.len() as u64)
}
