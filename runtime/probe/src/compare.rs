//! A finished run's own account of its wire beside what a probe saw of it: counts, and the time
//! between the kernel's stamps, message by message. Neither side knows of the other: the run's come
//! from record files and summary, the probe's from captures.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{fs, io};

use hil_account::{AccountContext, ChannelPath, ChannelRecords, MessageFate, each_history};
use hil_capture::flow::OwnHeader;
use hil_capture::join::{JoinSettings, Joined, Loss, Pair};
use hil_capture::observe::{Observation, Stream};
use hil_core::record::{EgressRecord, IngressRecord, stamp};
use hil_core::recorded_run::{DelayBin, ProbedCrossing, RecordedCrossing};
use hil_net::Direction;
use hil_protocol::transport::IpProtocol;
use hil_protocol::wire::Kind;
use hil_stats::histogram::{Distribution, LatencyHistogram};
use serde::Serialize;

use super::analyse::{Reading, doubts_text};
use super::point_clocks::{PointClocks, WireClocks};
use hil_platform::progress::Stage;
use hil_present::{Cell, Row, Section, Table, Tone, UNAVAILABLE};
use hil_report::quantile_table;
use hil_report::summary::{CounterGroup, LinkKind, RunSummary, SummaryError};
use hil_rundir::launch::Side;
use hil_rundir::record::{RecordFile, RecordFileError, RecordKind};
use hil_rundir::run_folder::RunFolder;

/// Why nothing could be compared.
#[derive(Debug, thiserror::Error)]
pub(super) enum CompareError {
    #[error("run folder {path}: {source}")]
    Folder { path: PathBuf, source: io::Error },
    #[error(transparent)]
    Record(#[from] RecordFileError),
    #[error("{path}: {source}")]
    Summary { path: PathBuf, source: SummaryError },
    #[error("{0}: no record of a gateway, so there is no wire to compare")]
    NoGateway(PathBuf),
    #[error("{capture}: holds no message of the run {run}: another time, place or flow?")]
    NothingOfRun { capture: PathBuf, run: String },
}

/// A count of both sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
struct BothCounts {
    gateway: Option<u64>,
    probe: u64,
}

impl BothCounts {
    fn is_equal(&self) -> bool {
        self.gateway == Some(self.probe)
    }
}

/// Datagrams that one side has for a reason and the other has not.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Difference {
    /// Only the gateways know of them: no capture was there.
    unseen: u64,
    /// Only the probe saw them: the receiving host had no room.
    no_room: u64,
}

impl Difference {
    const fn is_none(self) -> bool {
        self.unseen == 0 && self.no_room == 0
    }

    /// True where both are equal but for these.
    fn explains(self, both: BothCounts) -> bool {
        let with_reason = |gateway: u64| (gateway + self.no_room).checked_sub(self.unseen);
        both.gateway.and_then(with_reason) == Some(both.probe)
    }

    fn words(self) -> String {
        let reasons = [
            (self.no_room, "found no room"),
            (self.unseen, "before the capture"),
        ];
        let reasons = reasons.iter().filter(|(count, _)| *count > 0);
        let reasons: Vec<String> = reasons
            .map(|(count, why)| format!("{count} {why}"))
            .collect();
        reasons.join(", ")
    }
}

/// One channel in one direction.
#[derive(Debug, Serialize)]
struct ChannelComparison {
    channel: String,
    /// Every datagram of the sending gateway's socket, and the same leaving its interface.
    sent: BothCounts,
    /// Datagrams that the receiving gateway took: its messages, and greetings and requests that it
    /// answered. What came before it listened or after it left, and farewells, which nobody
    /// answers, are in neither count.
    received: BothCounts,
    /// Datagrams with messages, by the gateways' records.
    data_sent: BothCounts,
    data_received: BothCounts,
    /// Datagrams with messages that passed an interface, and for which the run says that the receiving host had no
    /// room; in the probe's counts of what was received and not in the gateways'.
    no_room: u64,
    /// Datagrams with messages of the run that left, or came, before the capture at that place has any of the channel; in
    /// the gateways' counts and not in the probe's.
    unseen_sent: u64,
    unseen_received: u64,
    /// Kernel stamp to kernel stamp, by the gateways.
    gateway_wire: Distribution,
    /// Tap to tap, by the probe, of the same messages.
    probe_wire: Distribution,
    /// Probe's less gateway's, message by message.
    difference: Distribution,
    /// Probe's stamp at departure less the gateway's: the tap is ahead of the driver.
    departure_difference: Distribution,
    /// Probe's stamp at arrival less the gateway's.
    arrival_difference: Distribution,
}

impl ChannelComparison {
    fn medians_apart_us(&self) -> Option<f64> {
        let gateway = self.gateway_wire.measured()?.p50_ns;
        let probe = self.probe_wire.measured()?.p50_ns;
        Some((probe - gateway).abs() as f64 * 1e-3)
    }

    /// Each count, and how far the gateways' may be from the probe's with a reason: less what was not captured, and
    /// with what found no room.
    fn counts(&self) -> [(&'static str, BothCounts, Difference); 4] {
        let sent = Difference {
            unseen: self.unseen_sent,
            no_room: 0,
        };
        let received = Difference {
            unseen: self.unseen_received,
            no_room: self.no_room,
        };
        [
            ("sent", self.sent, sent),
            ("received", self.received, received),
            ("messages sent", self.data_sent, sent),
            ("messages received", self.data_received, received),
        ]
    }

    fn agrees_within(&self, limit_us: f64) -> bool {
        let counts = self.counts();
        counts
            .iter()
            .all(|(_, both, difference)| difference.explains(*both))
            && self
                .medians_apart_us()
                .is_some_and(|apart| apart <= limit_us)
    }

    fn section(&self, limit_us: f64) -> Section {
        let mut section = Section::new("channel", &self.channel, "");
        let mut counts = Table::new("", &["datagrams", "gateways", "probe", ""]);
        for (what, both, difference) in self.counts() {
            let (tone, word) = if both.is_equal() && difference.is_none() {
                (Tone::Plain, "equal".to_owned())
            } else if difference.explains(both) {
                (Tone::Plain, format!("equal, {}", difference.words()))
            } else {
                (Tone::Bad, "DIFFERENT".to_owned())
            };
            let gateway = match both.gateway {
                Some(count) => Cell::Count(count),
                None => "unknown".into(),
            };
            counts.rows.push(Row {
                cells: vec![what.into(), gateway, Cell::Count(both.probe), word.into()],
                tone,
                bar: None,
            });
        }
        section.table(counts);
        section.table(quantile_table(&[
            ("wire, gateways", &self.gateway_wire),
            ("wire, probe", &self.probe_wire),
            ("probe - gateways", &self.difference),
            ("  at departure", &self.departure_difference),
            ("  at arrival", &self.arrival_difference),
        ]));
        let (tone, words) = match self.medians_apart_us() {
            Some(apart) if apart <= limit_us => (
                Tone::Plain,
                format!("{apart:.2} µs apart, at most {limit_us} µs"),
            ),
            Some(apart) => (
                Tone::Bad,
                format!("{apart:.2} µs apart, MORE than {limit_us} µs"),
            ),
            None => (Tone::Caution, UNAVAILABLE.to_owned()),
        };
        section.fact("medians", tone, words);
        section
    }
}

/// The whole comparison.
#[derive(Debug, Serialize)]
pub(super) struct Comparison {
    schema_version: u32,
    run: String,
    clocks: WireClocks,
    channels: Vec<ChannelComparison>,
    /// Loss and delay of the datagrams with messages between the taps, on all channels together.
    #[serde(skip)]
    pub(super) probed: ProbedCrossing,
    /// Channels whose transport has no datagrams of its own that a probe could read.
    left_out: Vec<String>,
}

impl Comparison {
    pub(super) fn agrees_within(&self, limit_us: f64) -> bool {
        let channels = &self.channels;
        !channels.is_empty() && channels.iter().all(|one| one.agrees_within(limit_us))
    }

    pub(super) fn sections(&self, limit_us: f64) -> Vec<Section> {
        let mut head = Section::new("run", &self.run, "gateways and probe");
        head.note(Tone::Plain, self.clocks.words());
        let mut sections = vec![head];
        sections.extend(self.channels.iter().map(|one| one.section(limit_us)));
        let mut rest = Section::new("left-out", "Not compared", "");
        if !self.left_out.is_empty() {
            let names = self.left_out.join(", ");
            let why = "they go over TCP, which does not keep datagrams";
            rest.note(Tone::Plain, format!("{names}: {why}"));
        }
        sections.push(rest);
        sections
    }
}

/// What the gateways recorded of one channel.
#[derive(Debug, Default)]
struct GatewaySide {
    egress: Vec<EgressRecord>,
    ingress: Vec<IngressRecord>,
}

/// A message: producer's start and its number there.
type Message = (u32, u64);

/// Draws up the comparison.
pub(super) fn compare(
    run: &Path,
    captures: &Reading,
    settings: &JoinSettings,
    stage: &Stage,
) -> Result<Comparison, CompareError> {
    let folder = RunFolder::existing(run);
    let sides = gateway_sides(&folder, stage)?;
    stage.tell(None, "joining with the run");
    if sides.is_empty() {
        return Err(CompareError::NoGateway(run.to_owned()));
    }
    if let Some(capture) = file_without(&sides, captures) {
        let run = folder.name();
        return Err(CompareError::NothingOfRun { capture, run });
    }
    let summary = summary(&folder)?;
    let clocks = WireClocks::of(summary.as_ref());
    let joined = captures.joined(settings);
    let numbers = channel_numbers(&sides, captures);
    let is_read = |name: &str| {
        summary
            .as_ref()
            .is_none_or(|summary| has_datagrams(summary, name))
    };
    let (compared, left_out): (Vec<_>, Vec<_>) = sides.iter().partition(|(name, _)| is_read(name));
    let compared_numbers: BTreeSet<u16> = (compared.iter())
        .filter_map(|(name, _)| numbers.get(*name).copied())
        .collect();
    let channels = compared.iter().map(|(name, side)| {
        let said = summary.as_ref().map(|summary| said(summary, name));
        let probe = Probe {
            captures,
            joined: &joined,
            number: numbers.get(*name).copied(),
        };
        channel(name, side, said.unwrap_or_default(), &probe)
    });
    let channels: Vec<_> = channels.collect();
    let left_out: Vec<_> = left_out.into_iter().map(|(name, _)| name.clone()).collect();
    let is_meant = |(stream, joined): &&(Stream, Joined)| {
        let own = stream.own;
        let (first, second) = (&joined.first_point, &joined.second_point);
        own.is_some_and(|(number, kind)| {
            kind == Kind::Data as u8 && compared_numbers.contains(&number)
        }) && (first.direction, second.direction) == (Direction::Outbound, Direction::Inbound)
    };
    let passed = joined
        .iter()
        .filter(is_meant)
        .map(|(_, joined)| Passed::of(joined));
    let loss = if captures.has_gaps() {
        Err("a capture has gaps or faults".to_owned())
    } else {
        sound_loss(&compared, &channels, &compared_numbers, captures)
    };
    let delays = match clocks {
        WireClocks::One => Ok(()),
        WireClocks::Two | WireClocks::Unknown => {
            Err("the hosts are not known to read one clock, and a probe aligns none".to_owned())
        }
    };
    Ok(Comparison {
        schema_version: 1,
        run: folder.name(),
        clocks,
        probed: ProbedCrossing {
            crossing: crossing(passed, loss, delays),
            left_out: left_out.clone(),
        },
        channels,
        left_out,
    })
}

/// What the probe saw of a stream of datagrams with messages between two hosts.
#[derive(Debug)]
struct Passed {
    matched_count: u64,
    /// Else why that is unavailable.
    lost_count: Result<u64, String>,
    /// Likewise.
    delays_ns: Result<Vec<i64>, String>,
}

impl Passed {
    fn of(joined: &Joined) -> Self {
        let figures = &joined.figures;
        let lost_count = match &figures.loss {
            _ if figures.unexplained_count > 0 => Err(format!(
                "{} datagrams were seen at the second host only",
                figures.unexplained_count
            )),
            Loss::Counted(loss) => Ok(loss.count),
            Loss::Unavailable { doubts, .. } => Err(doubts_text(doubts, PointClocks::OneFile)),
        };
        let pairs = joined.pairs.iter().filter(|pair| pair.is_stamped());
        let of_pair = |pair: &Pair| pair.second.stamp_ns.saturating_sub(pair.first.stamp_ns);
        let delays_ns = match &figures.delay {
            Distribution::Measured(_) => Ok(pairs.map(of_pair).collect()),
            Distribution::Unavailable { .. } if figures.matched_count == 0 => Ok(Vec::new()),
            Distribution::Unavailable { reason } => Err(reason.clone()),
        };
        Self {
            matched_count: figures.matched_count,
            lost_count,
            delays_ns,
        }
    }
}

/// All of them together, unless something speaks against `loss` or `delays` as a whole.
fn crossing(
    streams: impl Iterator<Item = Passed>,
    loss: Result<(), String>,
    delays: Result<(), String>,
) -> RecordedCrossing {
    let (mut matched_count, mut lost_count) = (0, Ok(0));
    let mut histogram = Ok(LatencyHistogram::default());
    for passed in streams {
        matched_count += passed.matched_count;
        lost_count = lost_count.and_then(|sum| passed.lost_count.map(|count| sum + count));
        histogram = histogram.and_then(|mut histogram: LatencyHistogram| {
            passed
                .delays_ns?
                .into_iter()
                .for_each(|ns| histogram.record(ns));
            Ok(histogram)
        });
    }
    let offered_count = matched_count + *lost_count.as_ref().unwrap_or(&0);
    let seen = match offered_count {
        0 => Err("nothing was seen at both hosts".to_owned()),
        _ => Ok(()),
    };
    let bins =
        |histogram: LatencyHistogram| histogram.bins().into_iter().map(DelayBin::from).collect();
    RecordedCrossing {
        offered_count,
        lost_count: loss.and(seen.clone()).and(lost_count),
        delays: delays.and(seen).and(histogram.map(bins)),
    }
}

/// What speaks against the loss that captures tell of the channels: they hold messages that are not of the run, or their
/// counts are not the gateways'.
fn sound_loss(
    compared: &[(&String, &GatewaySide)],
    channels: &[ChannelComparison],
    numbers: &BTreeSet<u16>,
    captures: &Reading,
) -> Result<(), String> {
    let records = compared.iter().flat_map(|(_, side)| &side.egress);
    let of_run: BTreeSet<_> = records
        .map(|one| (one.session, one.epoch, one.sequence))
        .collect();
    let seen = captures.observer.seen().values();
    let headers = seen
        .flat_map(|seen| seen.values().flatten())
        .filter_map(own);
    let mut messages = headers.filter(|one| is_data(one) && numbers.contains(&one.channel));
    if messages.any(|one| !of_run.contains(&(one.session, one.epoch, one.sequence))) {
        return Err("the captures hold messages of another run".to_owned());
    }
    let is_other = |one: &&ChannelComparison| {
        let [_, _, sent, received] = one.counts();
        [sent, received]
            .iter()
            .any(|(_, both, difference)| !difference.explains(*both))
    };
    let other = channels.iter().find(is_other);
    other.map_or(Ok(()), |one| {
        Err(format!(
            "its counts of {} are not the gateways'",
            one.channel
        ))
    })
}

/// Whether a channel's gateways send datagrams that stand on the wire as they made them.
fn has_datagrams(summary: &RunSummary, channel: &str) -> bool {
    let found = summary.channels.iter().find(|one| one.name == channel);
    !matches!(
        found.map(|one| one.link),
        Some(LinkKind::Network(transport))
            if transport.capabilities.receiver_port == Some(IpProtocol::Tcp)
    )
}

/// A capture in which no message of the run was seen.
fn file_without(sides: &BTreeMap<String, GatewaySide>, captures: &Reading) -> Option<PathBuf> {
    let mut of_run: BTreeSet<Message> = BTreeSet::new();
    for side in sides.values() {
        of_run.extend(side.egress.iter().map(|one| (one.epoch, one.sequence)));
        of_run.extend(side.ingress.iter().map(|one| (one.epoch, one.sequence)));
    }
    let is_of_run = |own: OwnHeader| is_data(&own) && of_run.contains(&(own.epoch, own.sequence));
    let has_some = |index: usize| {
        let points = captures.observer.seen().iter();
        let points = points.filter(|(point, _)| point.file_index == index);
        let mut observations = points.flat_map(|(_, seen)| seen.values().flatten());
        observations.any(|one| own(one).is_some_and(is_of_run))
    };
    let mut files = captures.files.iter().enumerate();
    let (_, file) = files.find(|(index, _)| !has_some(*index))?;
    Some(file.path.clone())
}

fn gateway_sides(
    folder: &RunFolder,
    stage: &Stage,
) -> Result<BTreeMap<String, GatewaySide>, CompareError> {
    let files = folder
        .record_files()
        .map_err(|source| CompareError::Folder {
            path: folder.records(),
            source,
        })?;
    let all_bytes: u64 = files.iter().map(|(_, bytes)| bytes).sum();
    let mut read_bytes = 0;
    let mut sides: BTreeMap<String, GatewaySide> = BTreeMap::new();
    for (path, bytes) in files {
        stage.reach(read_bytes as f64 / all_bytes.max(1) as f64);
        read_bytes += bytes;
        let file = RecordFile::read(&path)?;
        let side = sides.entry(file.header.channel.clone());
        match file.header.kind {
            RecordKind::Egress => side
                .or_default()
                .egress
                .extend(file.records::<EgressRecord>()),
            RecordKind::Ingress => side
                .or_default()
                .ingress
                .extend(file.records::<IngressRecord>()),
            _ => {}
        }
    }
    Ok(sides)
}

fn summary(folder: &RunFolder) -> Result<Option<RunSummary>, CompareError> {
    let path = folder.summary();
    if !path.is_file() {
        return Ok(None);
    }
    let failed = |source| CompareError::Folder {
        path: path.clone(),
        source,
    };
    let text = fs::read_to_string(&path).map_err(failed)?;
    let summary = RunSummary::from_json(&text);
    summary
        .map(Some)
        .map_err(|source| CompareError::Summary { path, source })
}

/// What the run's summary says of a channel, where it has it.
#[derive(Debug, Clone, Copy, Default)]
struct Said {
    /// Datagrams of the sockets.
    sent: Option<u64>,
    received: Option<u64>,
    /// Messages for which the receiving host had no room, or may have had none.
    no_room_messages: u64,
}

fn said(summary: &RunSummary, channel: &str) -> Said {
    let of = |side: Side| {
        let channel = summary.channels.iter().find(|one| one.name == channel)?;
        let ends = channel.ends.iter().filter(|one| one.direction == side);
        let counters = ends.flat_map(|one| &one.counters);
        let named = counters
            .filter(|one| one.group == CounterGroup::Own && one.name == "datagram_count")
            .map(|one| one.count);
        named.reduce(|a, b| a + b)
    };
    let account = summary.channels.iter().find(|one| one.name == channel);
    let fates = account.and_then(|one| Some(&one.account.as_ref()?.fates));
    let no_room = fates.map(|fates| {
        fates.of(MessageFate::LostByHarness) + fates.of(MessageFate::LostOnWireOrByHarness)
    });
    Said {
        sent: of(Side::Egress),
        received: of(Side::Ingress),
        no_room_messages: no_room.unwrap_or_default(),
    }
}

/// The number by which each channel goes on the wire, found by the first message both sides know:
/// its session, number, and the time it was handed to the kernel.
fn channel_numbers(
    sides: &BTreeMap<String, GatewaySide>,
    captures: &Reading,
) -> BTreeMap<String, u16> {
    let mut known: BTreeMap<(u32, u32, u64, i64), &str> = BTreeMap::new();
    for (name, side) in sides {
        let records = side.egress.iter();
        known.extend(records.map(|one| {
            (
                (one.session, one.epoch, one.sequence, one.handed_ns),
                name.as_str(),
            )
        }));
    }
    let mut numbers = BTreeMap::new();
    let seen = captures.observer.seen().values();
    for observation in seen.flat_map(|seen| seen.values().flatten()) {
        let Some(own) = observation
            .identity
            .own
            .filter(|own| own.kind == Kind::Data)
        else {
            continue;
        };
        let key = (own.session, own.epoch, own.sequence, own.handed_ns);
        if let Some(name) = known.get(&key) {
            numbers.entry((*name).to_owned()).or_insert(own.channel);
        }
    }
    numbers
}

struct Probe<'a> {
    captures: &'a Reading,
    joined: &'a [(Stream, Joined)],
    /// `None` when no message of the channel was seen.
    number: Option<u16>,
}

impl Probe<'_> {
    /// Headers of the channel's datagrams that went `direction`.
    fn headers(&self, direction: Direction) -> impl Iterator<Item = OwnHeader> + '_ {
        let points = self.captures.observer.seen().iter();
        let points = points.filter(move |(point, _)| point.direction == direction);
        let streams = points.flat_map(|(_, seen)| seen);
        let ours = streams.filter(|(stream, _)| {
            self.number.is_some() && stream.own.map(|(channel, _)| channel) == self.number
        });
        ours.flat_map(|(_, list)| list).filter_map(own)
    }

    fn count(&self, direction: Direction, wanted: fn(&OwnHeader) -> bool) -> u64 {
        self.headers(direction).filter(wanted).count() as u64
    }

    /// Datagrams of each message of the channel that went `direction`.
    fn data(&self, direction: Direction) -> BTreeMap<Message, u64> {
        let mut all = BTreeMap::new();
        for own in self.headers(direction).filter(is_data) {
            *all.entry((own.epoch, own.sequence)).or_default() += 1;
        }
        all
    }

    /// Greetings and requests of the channel that were answered where they came in.
    fn answered_count(&self) -> u64 {
        let answers: BTreeSet<(u8, u32, u64)> = self
            .headers(Direction::Outbound)
            .filter(|own| !is_forward(own))
            .map(|own| (own.kind as u8, own.session, own.sequence))
            .collect();
        let requests = self.headers(Direction::Inbound).filter(|own| {
            let answer = match own.kind {
                Kind::Hello => Kind::HelloAck,
                Kind::SyncRequest => Kind::SyncResponse,
                Kind::KeyRequest => Kind::KeyAnswer,
                _ => return false,
            };
            answers.contains(&(answer as u8, own.session, own.sequence))
        });
        requests.count() as u64
    }

    /// Departure of the last piece and arrival of the latest, of each message of the channel.
    fn wire(&self) -> BTreeMap<Message, (i64, i64)> {
        let mut wire: BTreeMap<Message, (i64, i64)> = BTreeMap::new();
        for (stream, joined) in self.joined {
            if self.number.is_none() || stream.own.map(|(channel, _)| channel) != self.number {
                continue;
            }
            for pair in joined.pairs.iter().filter(|pair| pair.is_stamped()) {
                let Some(own) = own(&pair.first).filter(|own| own.kind == Kind::Data) else {
                    continue;
                };
                let both = (pair.first.stamp_ns, pair.second.stamp_ns);
                let latest = wire.entry((own.epoch, own.sequence)).or_insert(both);
                *latest = (latest.0.max(both.0), latest.1.max(both.1));
            }
        }
        wire
    }
}

fn own(observation: &Observation) -> Option<OwnHeader> {
    observation.identity.own
}

/// What the sender of a channel sends; the rest are replies of the receiver.
fn is_forward(own: &OwnHeader) -> bool {
    !matches!(
        own.kind,
        Kind::SyncResponse | Kind::HelloAck | Kind::PieceAck | Kind::KeyAnswer
    )
}

fn is_data(own: &OwnHeader) -> bool {
    own.kind == Kind::Data
}

/// Departure and arrival of each message by the gateways' kernel stamps.
fn gateway_wire(side: &GatewaySide) -> BTreeMap<Message, (i64, i64)> {
    let records = ChannelRecords {
        egress: Some(&side.egress),
        ingress: Some(&side.ingress),
        ..ChannelRecords::default()
    };
    let path = ChannelPath::Gateway { alignment: None };
    let mut gateway = BTreeMap::new();
    each_history(&records, &AccountContext::new(path), |message| {
        let left_ns = message.egress.and_then(|one| stamp(one.tx_software_ns));
        let came_ns = message.ingress.and_then(|one| stamp(one.rx_software_ns));
        let both = left_ns.zip(came_ns);
        gateway.extend(both.map(|both| ((message.epoch, message.key.sequence), both)));
    });
    gateway
}

/// A message that a gateway has a record of.
#[derive(Debug, Clone, Copy)]
struct NotedMessage {
    message: Message,
    /// When it was handed to the kernel, on the sender's clock.
    handed_ns: i64,
    datagram_count: u64,
}

/// Datagrams of messages that were handed over before the first one that a capture has: it was not there yet.
fn unseen(records: &[NotedMessage], captured: &BTreeMap<Message, u64>) -> u64 {
    let seen = records
        .iter()
        .filter(|one| captured.contains_key(&one.message));
    let Some(first_ns) = seen.map(|one| one.handed_ns).min() else {
        return 0;
    };
    let before = records.iter().filter(|one| one.handed_ns < first_ns);
    before.map(|one| one.datagram_count).sum()
}

/// Datagrams of messages that came to the receiving host and to no gateway, where the run says of so many that the
/// host had no room for them; 0 where more are missing than it says.
fn no_room(
    received: &[NotedMessage],
    captured: &BTreeMap<Message, u64>,
    said_messages: u64,
) -> u64 {
    let received: BTreeSet<Message> = received.iter().map(|one| one.message).collect();
    let missing = captured.iter().filter(|(one, _)| !received.contains(one));
    let missing: Vec<u64> = missing.map(|(_, count)| *count).collect();
    if missing.len() as u64 > said_messages {
        return 0;
    }
    missing.iter().sum()
}

fn channel(name: &str, side: &GatewaySide, said: Said, probe: &Probe<'_>) -> ChannelComparison {
    let left = side.egress.iter().filter(|one| !one.is_refused());
    let data_sent: u64 = left.map(|one| u64::from(one.fragment_count)).sum();
    let data_received: u64 = side
        .ingress
        .iter()
        .map(|one| u64::from(one.fragment_count))
        .sum();
    let sent = side.egress.iter().filter(|one| !one.is_refused());
    let sent = sent.map(|one| NotedMessage {
        message: (one.epoch, one.sequence),
        handed_ns: one.handed_ns,
        datagram_count: u64::from(one.fragment_count),
    });
    let received = side.ingress.iter().map(|one| NotedMessage {
        message: (one.epoch, one.sequence),
        handed_ns: one.handed_ns,
        datagram_count: u64::from(one.fragment_count),
    });
    let received: Vec<NotedMessage> = received.collect();
    let no_room = no_room(
        &received,
        &probe.data(Direction::Inbound),
        said.no_room_messages,
    );
    let unseen_sent = unseen(&sent.collect::<Vec<_>>(), &probe.data(Direction::Outbound));
    let unseen_received = unseen(&received, &probe.data(Direction::Inbound));
    let gateway = gateway_wire(side);
    let mut columns: [LatencyHistogram; 5] = Default::default();
    for (key, (departure, arrival)) in probe.wire() {
        if let Some((left_ns, came_ns)) = gateway.get(&key) {
            let (ours, theirs) = (came_ns - left_ns, arrival - departure);
            let (ahead, behind) = (departure - left_ns, arrival - came_ns);
            for (column, value) in
                columns
                    .iter_mut()
                    .zip([ours, theirs, theirs - ours, ahead, behind])
            {
                column.record(value);
            }
        }
    }
    let reason = "no message was stamped by both";
    ChannelComparison {
        channel: name.to_owned(),
        sent: BothCounts {
            gateway: said.sent,
            probe: probe.count(Direction::Outbound, is_forward),
        },
        received: BothCounts {
            gateway: said.received,
            probe: probe.count(Direction::Inbound, is_data) + probe.answered_count(),
        },
        data_sent: BothCounts {
            gateway: Some(data_sent),
            probe: probe.count(Direction::Outbound, is_data),
        },
        data_received: BothCounts {
            gateway: Some(data_received),
            probe: probe.count(Direction::Inbound, is_data),
        },
        no_room,
        unseen_sent,
        unseen_received,
        gateway_wire: columns[0].distribution(reason),
        probe_wire: columns[1].distribution(reason),
        difference: columns[2].distribution(reason),
        departure_difference: columns[3].distribution(reason),
        arrival_difference: columns[4].distribution(reason),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Messages of one datagram each, one a millisecond.
    fn handed(sequences: impl Iterator<Item = u64>) -> Vec<NotedMessage> {
        let of = |sequence: u64| NotedMessage {
            message: (1, sequence),
            handed_ns: sequence.cast_signed() * 1_000_000,
            datagram_count: 1,
        };
        sequences.map(of).collect()
    }

    fn captured(sequences: impl Iterator<Item = u64>) -> BTreeMap<Message, u64> {
        sequences.map(|sequence| ((1, sequence), 1)).collect()
    }

    fn passed(
        matched_count: u64,
        lost_count: Result<u64, String>,
        delays_ns: Result<Vec<i64>, String>,
    ) -> Passed {
        Passed {
            matched_count,
            lost_count,
            delays_ns,
        }
    }

    #[test]
    fn streams_are_one_crossing_and_what_is_missing_of_one_is_missing_of_all() {
        let sum = |streams: Vec<Passed>| crossing(streams.into_iter(), Ok(()), Ok(()));
        let two = || {
            vec![
                passed(8, Ok(2), Ok(vec![20_000; 8])),
                passed(10, Ok(0), Ok(vec![40_000; 10])),
            ]
        };
        let both = sum(two());
        assert_eq!((both.offered_count, both.lost_count), (20, Ok(2)));
        let bins = both.delays.unwrap();
        let counts: Vec<_> = bins.iter().map(|bin| bin.count).collect();
        assert_eq!(counts, [8, 10]);
        assert!(bins[0].above_ns < 20_000 && bins[0].until_ns >= 20_000);
        let why = || "1 malformed".to_owned();
        let mut three = two();
        three.insert(1, passed(5, Err(why()), Err("a clock was set".to_owned())));
        let three = sum(three);
        assert_eq!(three.lost_count, Err(why()));
        assert_eq!(three.delays, Err("a clock was set".to_owned()));
        let none = sum(Vec::new());
        assert!(none.lost_count.is_err() && none.delays.is_err());
        let refused = crossing(two().into_iter(), Err(why()), Ok(()));
        assert_eq!(refused.lost_count, Err(why()));
        assert!(refused.delays.is_ok());
    }

    #[test]
    fn what_went_before_the_capture_is_not_compared_and_a_hole_in_it_is() {
        let records = handed(0..100);
        assert_eq!(unseen(&records, &captured(3..100)), 3);
        assert_eq!(unseen(&records, &captured(0..100)), 0);
        let with_hole = captured((3..50).chain(52..100));
        assert_eq!(unseen(&records, &with_hole), 3);
        assert_eq!(unseen(&records, &captured(200..210)), 0, "of another time");
    }

    #[test]
    fn what_found_no_room_explains_as_many_as_the_run_says() {
        // 1201 were sent, 183 of them found no room, and the capture began with the fourth.
        let received = handed((0..1_000).chain(1_183..1_201));
        let wire = captured(3..1_201);
        let difference = |said| Difference {
            unseen: unseen(&received, &wire),
            no_room: no_room(&received, &wire, said),
        };
        let both = BothCounts {
            gateway: Some(1_018),
            probe: 1_198,
        };
        assert_eq!((difference(183).unseen, difference(183).no_room), (3, 183));
        assert!(difference(183).explains(both));
        assert_eq!(
            difference(183).words(),
            "183 found no room, 3 before the capture"
        );
        // The run says so of one less than are missing: then something else took one.
        assert!(!difference(182).explains(both));
        let unknown = BothCounts {
            gateway: None,
            probe: 1_198,
        };
        assert!(!difference(183).explains(unknown));
        let other = BothCounts {
            gateway: Some(1_017),
            probe: 1_198,
        };
        assert!(!difference(183).explains(other));
    }
}
