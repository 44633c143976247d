//! Network and robot of a run on one time axis: from the passages of each channel to figures,
//! events, series and correlations, and to what came before each event of the score. Live runs
//! and runs in virtual time come here alike; where passages come from is not known here.

use std::collections::BTreeMap;

use hil_account::network::{
    Moment, NetworkBin, NetworkBins, NetworkContext, NetworkEvent, NetworkEventKind,
    NetworkMetrics, Passages, Place, bin_width_ns, clock_steps, interruptions, network_events,
};
use hil_account::{Side, each_history};
use hil_core::case_study::ErrorSeries;
use hil_core::plot::PlotSeries;
use hil_core::time::Instant;
use hil_stats::correlation::{self, LagWindow, Untested};

use super::axis::RunAxis;
use super::clocks::HostClocks;
use super::frame_lengths::FrameLengths;
use super::records::RunRecords;
pub(crate) use super::robot_series::RobotSeries;
use super::robot_series::{index_of, without_holes};
use crate::network::{
    ChannelNetwork, Correlation, CorrelationTests, NetworkQuantity, NetworkReport, PRECEDING_S,
    PrecedingEvent, PrecedingLoss, PrecedingNetwork, SeldomSeries, TestedPair, TimedEvent,
    Timeline, TimelineRow, TimelineSubject,
};
use crate::score_event::ScoreEvents;
use hil_rundir::run_result::RunResult;
use hil_topology::Channel;

/// Network events a summary keeps, and of those before one event of the score, as of channels with losses then.
const EVENTS_MAX: usize = 2_000;
const PRECEDING_MAX: usize = 8;

/// Steps of the timeline in a summary.
const STEPS_MAX: usize = 120;

/// Lags searched, seconds: bins and stamps are not exact, so the robot may seem to come first.
const LEAD_MAX_S: f64 = 1.0;
const LAG_MAX_S: f64 = PRECEDING_S;

/// One channel over a network, ready to be put on the run's axis.
pub(crate) struct ChannelPassages<'a> {
    pub(crate) channel: &'a str,
    pub(crate) hosts: [&'a str; 2],
    pub(crate) passages: &'a Passages,
    /// What the passages alone do not show.
    pub(crate) other_events: Vec<NetworkEvent>,
    pub(crate) duration_ns: i64,
    /// Puts moments of its hosts on the run's axis.
    pub(crate) place: &'a Place<'a>,
    pub(crate) context: NetworkContext<'a>,
}

/// How the hosts' clocks stand to each other on the run's axis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AxisClocks {
    /// How far instants of two hosts, or of a host and the score, may lie off each other, seconds; `None`
    /// when the clocks are not aligned.
    pub(crate) bound_s: Option<f64>,
}

impl AxisClocks {
    /// All hosts read one clock.
    pub(crate) const ONE: Self = Self { bound_s: Some(0.0) };
}

/// A network under way of being put together, channel by channel, so that the passages of only
/// one need be in memory.
#[derive(Debug, Default)]
pub(crate) struct NetworkBuilder {
    channels: Vec<ChannelNetwork>,
    events: Vec<TimedEvent>,
    bins: Vec<(String, NetworkBins)>,
    /// Processes whose time without them is told already, and where among the events it stands.
    told: BTreeMap<(String, i64), Option<usize>>,
    /// Events and messages without a place on the run's axis.
    unplaced_event_count: u64,
    unplaced_message_count: u64,
}

impl NetworkBuilder {
    pub(crate) fn add(&mut self, one: ChannelPassages<'_>) {
        self.channels.push(ChannelNetwork {
            channel: one.channel.to_owned(),
            from_host: one.hosts[0].to_owned(),
            to_host: one.hosts[1].to_owned(),
            figures: NetworkMetrics::of(one.passages, &one.context),
        });
        let mut events = network_events(one.passages);
        events.extend(one.other_events);
        for event in events {
            self.add_event(one.channel, event, one.duration_ns, one.place);
        }
        let width_ns = bin_width_ns(one.duration_ns);
        let bins = NetworkBins::of(one.passages, one.duration_ns, width_ns, one.place);
        self.unplaced_message_count += bins.unplaced_count;
        self.bins.push((one.channel.to_owned(), bins));
    }

    fn add_event(
        &mut self,
        channel: &str,
        event: NetworkEvent,
        duration_ns: i64,
        place: &Place<'_>,
    ) {
        let interruption = match &event.kind {
            NetworkEventKind::ProcessDown { process, .. } => Some((process.clone(), event.from.ns)),
            _ => None,
        };
        let told = interruption.as_ref().and_then(|key| self.told.get(key));
        let told = told.copied();
        let side = event.from.side;
        let since_s = |ns: i64| Some(place(Moment { side, ns })? as f64 * 1e-9);
        let until_s = event.until_ns.map(since_s);
        let (Some(from_s), None | Some(Some(_))) = (since_s(event.from.ns), until_s) else {
            if told.is_none() {
                self.unplaced_event_count += 1;
                self.told.extend(interruption.map(|key| (key, None)));
            }
            return;
        };
        let end_s = duration_ns as f64 * 1e-9;
        let until_s = until_s.flatten().filter(|until_s| *until_s < end_s);
        if let Some(index) = told {
            // Each channel says when messages reached the process: it was there for the first.
            if let Some(known) = index.map(|index| &mut self.events[index].until_s) {
                *known = known
                    .zip(until_s)
                    .map(|(one, other)| one.min(other))
                    .or(*known)
                    .or(until_s);
            }
            return;
        }
        self.told
            .extend(interruption.map(|key| (key, Some(self.events.len()))));
        self.events.push(TimedEvent {
            channel: channel.to_owned(),
            from_s,
            until_s,
            kind: event.kind,
        });
    }

    /// What a reader must know of what has no place on the axis.
    fn unplaced(&self) -> Option<String> {
        let (events, messages) = (self.unplaced_event_count, self.unplaced_message_count);
        (events + messages > 0).then(|| {
            format!(
                "network: {events} events and {messages} messages are in no series and before no event \
                 of the score: beside a step of a clock their times do not convert"
            )
        })
    }

    /// The report, and the series of every channel; `None` when no channel crossed a network. Puts
    /// beside every event of the score what came before it.
    pub(crate) fn finish(
        mut self,
        score: &mut ScoreEvents,
        errors: Vec<RobotSeries>,
        axis: AxisClocks,
    ) -> Option<(NetworkReport, Vec<PlotSeries>)> {
        let (_, first) = self.bins.first()?;
        let (width_s, count) = (first.width_ns as f64 * 1e-9, first.bins.len());
        // Without an alignment nothing is known to widen by; the report says so.
        let bound_s = axis.bound_s.unwrap_or(0.0);
        self.events.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
        for event in &mut score.events {
            event.network = event.at_s.map(|at_s| self.before(at_s, bound_s));
        }
        // A run of programs alone has no robot.
        let has_robot = !errors.is_empty() || !score.events.is_empty();
        let mut robot: Vec<(RobotSeries, bool)> = Vec::new();
        robot.extend(has_robot.then(|| (RobotSeries::of_events(score), true)));
        robot.extend(errors.into_iter().map(|one| (one, false)));
        let robot: Vec<(RobotSeries, Vec<f64>)> = robot
            .into_iter()
            .map(|(one, is_count)| {
                let bins = one.binned(width_s, count, is_count);
                (one, bins)
            })
            .collect();
        let run_s = count as f64 * width_s;
        let dropped = self.events.len().saturating_sub(EVENTS_MAX);
        let report = NetworkReport {
            foregoing_s: PRECEDING_S,
            foregoing_chance_ratio: covered_s(&self.events, run_s, bound_s) / run_s,
            clocks_differ: axis.bound_s.is_none(),
            clock_bound_s: axis.bound_s,
            timeline: timeline(&self.bins, &robot, width_s),
            correlation: correlate(&self.bins, &robot, width_s),
            events: TimedEvent::kept(self.events, EVENTS_MAX),
            events_dropped_count: dropped as u64,
            channels: self.channels,
        };
        let series = self.bins.iter().map(|(channel, bins)| {
            let notes = vec![
                format!(
                    "bins of {width_s} s; a message belongs where it was handed to the network"
                ),
                "silence is seen from the receiver; an empty field had no message".to_owned(),
            ];
            bins.to_series(channel, notes)
        });
        Some((report, series.collect()))
    }

    /// What the network went through before `at_s`, nearest first.
    fn before(&self, at_s: f64, clock_bound_s: f64) -> PrecedingNetwork {
        let mut found: Vec<(f64, &TimedEvent)> = self
            .events
            .iter()
            .filter_map(|event| Some((event.over_for_s(at_s, clock_bound_s)?, event)))
            .collect();
        // Of those under way the one that began first weighs most.
        found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.from_s.total_cmp(&b.1.from_s)));
        let loss = |(channel, bins): &(String, NetworkBins)| {
            let width_s = bins.width_ns as f64 * 1e-9;
            let from_s = at_s - PRECEDING_S - clock_bound_s;
            let first = index_of(from_s.max(0.0) / width_s).unwrap_or(0);
            let last = index_of((at_s + clock_bound_s) / width_s).map_or(0, |last| last + 1);
            let within = || bins.bins.iter().take(last).skip(first);
            PrecedingLoss {
                channel: channel.clone(),
                lost_count: within().map(|bin| bin.lost_count).sum(),
                sent_count: within().map(|bin| bin.sent_count).sum(),
            }
        };
        let losses = self.bins.iter().map(loss);
        let mut losses: Vec<_> = losses.filter(|one| one.lost_count > 0).collect();
        let lost_count = losses.iter().map(|one| one.lost_count).sum();
        losses.sort_by(|a, b| b.ratio().total_cmp(&a.ratio()));
        losses.truncate(PRECEDING_MAX);
        PrecedingNetwork {
            foregoing_s: PRECEDING_S,
            more_count: found.len().saturating_sub(PRECEDING_MAX) as u64,
            events: found
                .iter()
                .take(PRECEDING_MAX)
                .map(|(over_for_s, event)| PrecedingEvent::of(event, at_s, *over_for_s))
                .collect(),
            lost_count,
            losses,
        }
    }
}

/// How much of the run has an event in the time looked at before it.
fn covered_s(events: &[TimedEvent], run_s: f64, clock_bound_s: f64) -> f64 {
    let (mut covered_s, mut until_s) = (0.0, 0.0_f64);
    for event in events {
        let from_s = (event.from_s - clock_bound_s).clamp(until_s, run_s);
        let after_s = PRECEDING_S + clock_bound_s;
        let end_s = event.until_s.map_or(run_s, |end_s| end_s + after_s);
        let end_s = end_s.clamp(from_s, run_s);
        covered_s += end_s - from_s;
        until_s = until_s.max(end_s);
    }
    covered_s
}

fn quantity_of(bin: &NetworkBin, quantity: NetworkQuantity) -> Option<f64> {
    let seconds = |ns: i64| ns as f64 * 1e-9;
    match quantity {
        NetworkQuantity::Loss if bin.sent_count == 0 => None,
        NetworkQuantity::Loss => Some(bin.lost_count as f64 / bin.sent_count as f64),
        NetworkQuantity::Delay => bin.delay_max_ns.map(seconds),
        NetworkQuantity::Silence => bin.silence_max_ns.map(seconds),
    }
}

/// Largest error of any delay in the bins; `None` without delays.
fn delay_bound_s(bins: &NetworkBins) -> Option<f64> {
    let bounds = bins.bins.iter().filter_map(|bin| bin.delay_bound_ns);
    bounds.max().map(|ns| ns as f64 * 1e-9)
}

/// True for a channel with less than a message per bin: its silence is nobody's trouble, as nobody
/// speaks.
fn speaks_seldom(bins: &NetworkBins) -> bool {
    let sent_count: u64 = bins.bins.iter().map(|bin| bin.sent_count).sum();
    sent_count < bins.bins.len() as u64
}

type RobotBins = [(RobotSeries, Vec<f64>)];

fn timeline(all: &[(String, NetworkBins)], robot: &RobotBins, width_s: f64) -> Timeline {
    let count = all.first().map_or(0, |(_, bins)| bins.bins.len());
    let per_step = count.div_ceil(STEPS_MAX).max(1);
    let largest = |values: &[Option<f64>]| values.iter().flatten().copied().reduce(f64::max);
    let row = |subject, unit: &str, values: Vec<Option<f64>>| TimelineRow {
        subject,
        unit: unit.to_owned(),
        values: values.chunks(per_step).map(largest).collect(),
        bound: None,
    };
    let mut rows = Vec::new();
    for (channel, bins) in all {
        for quantity in NetworkQuantity::ALL {
            if quantity == NetworkQuantity::Silence && speaks_seldom(bins) {
                continue;
            }
            let values = bins.bins.iter().map(|bin| quantity_of(bin, quantity));
            let is_delay = quantity == NetworkQuantity::Delay;
            let subject = TimelineSubject::Channel {
                channel: channel.clone(),
                quantity,
            };
            rows.push(TimelineRow {
                bound: is_delay.then(|| delay_bound_s(bins)).flatten(),
                ..row(subject, quantity.unit(), values.collect())
            });
        }
    }
    for (one, bins) in robot {
        let known = |value: &f64| one.is_known().then_some(*value);
        let values = bins.iter().map(known).collect();
        let label = one.label().to_owned();
        rows.push(row(TimelineSubject::Robot { label }, one.unit(), values));
    }
    Timeline {
        step_s: per_step as f64 * width_s,
        rows,
    }
}

fn correlate(all: &[(String, NetworkBins)], robot: &RobotBins, width_s: f64) -> Correlation {
    let mut names = Vec::new();
    let mut causes = Vec::new();
    for (channel, bins) in all {
        for quantity in NetworkQuantity::ALL {
            if quantity == NetworkQuantity::Silence && speaks_seldom(bins) {
                continue;
            }
            let values = bins.bins.iter().map(|bin| quantity_of(bin, quantity));
            causes.push(without_holes(values.collect()));
            names.push((channel, quantity));
        }
    }
    let effects: Vec<Vec<f64>> = robot.iter().map(|(_, bins)| bins.clone()).collect();
    let in_bins = |seconds: f64| index_of((seconds / width_s).round()).unwrap_or(0);
    let window = LagWindow {
        lead_max: in_bins(LEAD_MAX_S),
        lag_max: in_bins(LAG_MAX_S),
    };
    let tested = match correlation::family(&causes, &effects, window) {
        Ok(tested) => tested,
        Err(error) => {
            return Correlation::Unavailable {
                reason: error.to_string(),
            };
        }
    };
    let mut pairs = Vec::new();
    for ((one, _), row) in robot.iter().zip(&tested.pairs) {
        for ((channel, network), pair) in names.iter().zip(row) {
            pairs.extend(pair.map(|correlation| TestedPair {
                channel: (*channel).clone(),
                network: *network,
                robot: one.label().to_owned(),
                lag_s: correlation.lag_bins as f64 * width_s,
                correlation,
            }));
        }
    }
    let of_robot = robot.iter().map(|(one, _)| one.label().to_owned());
    let of_network = names
        .iter()
        .map(|(channel, network)| format!("{network} on {channel}"));
    let untested = of_robot
        .zip(&tested.untested_effects)
        .chain(of_network.zip(&tested.untested_causes));
    let (mut constant, mut seldom) = (Vec::new(), Vec::new());
    for (series, why) in untested {
        match why {
            Some(Untested::Constant) => constant.push(series),
            Some(Untested::TooFew { spell_count }) => seldom.push(SeldomSeries {
                series,
                spell_count: *spell_count as u64,
            }),
            Some(Untested::NoNumber) | None => {}
        }
    }
    Correlation::Tested(CorrelationTests {
        bin_s: width_s,
        lead_max_s: tested.window.lead_max as f64 * width_s,
        lag_max_s: tested.window.lag_max as f64 * width_s,
        shift_count: tested.shift_count as u64,
        constant,
        seldom,
        pairs,
    })
}

/// Everything the records of a live run say of its network; see [`NetworkBuilder::finish`].
pub(super) fn of_run(
    records: &RunRecords<'_>,
    axis: &RunAxis<'_>,
    errors: Vec<ErrorSeries>,
    score: &mut ScoreEvents,
    warnings: &mut Vec<String>,
) -> Option<(NetworkReport, Vec<PlotSeries>)> {
    let topology = records.topology;
    let mut builder = NetworkBuilder::default();
    for channel in topology.channels() {
        if topology.crossing(channel).is_some() && records.has(&channel.name) {
            let added = add_channel(&mut builder, records, axis, channel);
            warnings.extend(added.err().map(|missing| {
                let name = &channel.name;
                format!("{name}: left out of the network's figures: {missing}")
            }));
        }
    }
    warnings.extend(builder.unplaced());
    let errors = errors.into_iter().filter_map(|one| {
        let host = &topology
            .process(&topology.channel(one.clock_of)?.from)?
            .host;
        Some(RobotSeries::of(one, |at| axis.place_s(host, at)))
    });
    let errors = errors.collect();
    // The stamps that events and errors were made of may have been brought to the score's clock.
    axis.note_score(records.log.stamp_bound_ns());
    let clocks = AxisClocks {
        bound_s: axis.bound_ns().map(|ns| ns as f64 * 1e-9),
    };
    builder.finish(score, errors, clocks)
}

/// Start of the run on the clock of `host`. Hosts begin milliseconds apart; where their clocks are
/// aligned, one beginning holds for all, lest an effect come before its cause, and a start that does not
/// convert is unknown. Where they are not, each host counts from its own, and the report says so.
fn start_on(result: &RunResult, host: &str, clocks: &HostClocks) -> Option<Instant> {
    let own = result.spans.get(host).map(|span| span.0)?;
    let starts = result.spans.iter().map(|(host, span)| (host, span.0));
    if clocks.are_aligned(result.spans.keys()) {
        clocks.earliest_on(host, starts)
    } else {
        Some(own)
    }
}

fn add_channel(
    builder: &mut NetworkBuilder,
    records: &RunRecords<'_>,
    axis: &RunAxis<'_>,
    channel: &Channel,
) -> Result<(), String> {
    let (topology, result) = (records.topology, records.result);
    let to = channel.to.as_deref().ok_or("nobody receives it")?;
    let hosts = [&channel.from, to].map(|process| {
        let host = topology.process(process).map(|process| &process.host);
        host.map_or("", |host| host.as_str())
    });
    let end_on = |host: &str| {
        let (_, end) = result.spans.get(host)?;
        Some((*end, axis.at(host, end.as_ns())?.0))
    };
    let missing =
        |host: &str| format!("when the run began and ended on host {host} is unavailable");
    let [producer_end, consumer_end] = hosts.map(|host| end_on(host).ok_or_else(|| missing(host)));
    let ((producer_end, one_ns), (_, other_ns)) = (producer_end?, consumer_end?);
    let producer_start =
        start_on(result, hosts[0], &records.clocks).ok_or_else(|| missing(hosts[0]))?;
    let mut frames = channel
        .carries_frames()
        .then(|| records.of_kind(&channel.name, |files| files.frame.as_ref()))
        .map(FrameLengths::of);
    let place = |at: Moment| {
        let host = match at.side {
            Side::Producer => hosts[0],
            Side::Consumer => hosts[1],
        };
        axis.place_ns(host, at.ns)
    };
    records.consult(channel, |files, context| {
        let mut ways = Passages::default();
        each_history(files, context, |message| {
            ways.push(&message.passage(context.path));
            if let Some(frames) = &mut frames {
                frames.note(message);
            }
        });
        let payload_bytes = match &frames {
            Some(frames) => frames.arrived_mean(),
            None => Some(channel.message.size_bytes as f64),
        };
        let mut other_events = interruptions(context);
        other_events.extend(clock_steps(files));
        builder.add(ChannelPassages {
            channel: &channel.name,
            hosts,
            passages: &ways,
            other_events,
            duration_ns: one_ns.max(other_ns),
            place: &place,
            context: NetworkContext {
                path: context.path,
                run_ns: Some((producer_start.as_ns(), producer_end.as_ns())),
                payload_bytes,
            },
        });
    });
    Ok(())
}
