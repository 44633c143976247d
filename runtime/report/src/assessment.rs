//! What follows from a summary's figures: whether the run may be called a network result at all,
//! and what a reader must be warned of. It draws conclusions, it does not measure.

use std::collections::BTreeSet;

use hil_account::{ChannelAccount, ClosingMetrics, Coverage, MessageFate, Stage};
use serde::{Deserialize, Serialize};

use super::adapter::AdapterSummary;
use super::adapter_warnings;
use super::summary::{
    ChannelSummary, DirectionSummary, LinkKind, NO_ROOM, Outcome, ProcessSummary, RunSummary,
};
use hil_platform::text::grouped;
use hil_platform::words::{counted, named};
use hil_present::units::{JOINT, percent};
use hil_rundir::event::ProcessKind;

/// Share of skipped ticks above which the host, not the network, shaped the run.
pub const SKIPPED_TICK_RATIO_MAX: f64 = 0.001;

/// Longest time that a gateway may let a message wait on its host, before it takes it from the producer or from the kernel.
pub const HELD_MAX_NS: i64 = 50_000_000;

/// Channels that are named where many have the same fault.
const NAMED_COUNT: usize = 3;

/// Share of messages whose account must close.
const CLOSED_RATIO_MIN: f64 = 0.999;

/// Share of messages that must carry a software stamp.
const STAMPED_RATIO_MIN: f64 = 0.99;

/// Whether delays and losses of a run may be put down to the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum NetworkVerdict {
    /// The run did not take place as planned.
    RunFailed,
    /// It took no time and crossed no network: link models took its messages.
    VirtualTime,
    /// No channel went over a network.
    NoNetwork,
    /// No link of ours was a network, but a foreign program took part through an adapter.
    ForeignProgram,
    /// No link of ours was a network, and nothing came to any adapter from a foreign program.
    NoForeignProgram,
    /// A channel went over an emulated link, whatever carried the others.
    EmulatedLink,
    /// The host could not keep an emulated link: the run says nothing about its model either.
    EmulationNotKept {
        /// The channels concerned.
        channels: Vec<String>,
    },
    /// The host kept its ticks: what remains is the network's.
    NetworkResult,
    /// A process skipped too many ticks: the run says nothing about the network.
    HostOverran {
        /// The processes that did.
        processes: Vec<Overrun>,
    },
    /// Receiving gateways were late, and their kernel dropped what found no room meanwhile: the run says
    /// nothing about the network.
    ReceiverLate {
        /// The channels concerned.
        channels: Vec<String>,
        /// Datagrams without room, of the messages published.
        #[serde(flatten)]
        loss: HostLoss,
    },
    /// Gateways were late with too many messages: they replaced them by newer ones, or let them wait for longer than
    /// [`HELD_MAX_NS`] on their host. The run says nothing about the network.
    GatewayLate {
        /// The channels concerned.
        channels: Vec<String>,
        /// Messages replaced or let wait, of those published.
        #[serde(flatten)]
        loss: HostLoss,
    },
    /// A process, a queue or an inlet of ours lost too many frames of a program: the run says nothing about the
    /// network.
    FramesLost {
        /// The channels concerned.
        channels: Vec<String>,
        /// Frames lost so, of those that the programs sent.
        #[serde(flatten)]
        loss: HostLoss,
    },
    /// A component left no report, so nobody can tell whether it kept its ticks.
    TicksUnknown,
    /// Nothing that ran tells whether the host kept up: no component with a period, and no gateways that left
    /// the counters of all their starts.
    HostUnknown,
    /// Hosts lack records of others: what was lost cannot be told from what is not known.
    RecordsMissing {
        /// The hosts that lack some.
        hosts: Vec<String>,
    },
}

/// A process that skipped more than [`SKIPPED_TICK_RATIO_MAX`] of its ticks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Overrun {
    /// Its name.
    pub process: String,
    /// Its host.
    pub host: String,
    /// Ticks it passed over.
    pub skipped_tick_count: u64,
    /// Ticks it should have run.
    pub due_tick_count: u64,
}

/// What hosts, and no network, lost or may have lost.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostLoss {
    /// How many.
    pub lost_count: u64,
    /// Of so many.
    pub of_count: u64,
}

impl HostLoss {
    fn is_beyond_limit(self) -> bool {
        self.lost_count as f64 > SKIPPED_TICK_RATIO_MAX * self.of_count as f64
    }

    /// Their share, in more digits than the limit has.
    pub(crate) fn share(self) -> String {
        let share = self.lost_count as f64 / self.of_count.max(self.lost_count).max(1) as f64;
        format!("{:.3}{JOINT}%", 100.0 * share)
    }

    /// The two counts, their share and what is allowed; `of` what there were.
    pub(crate) fn words(self, of: &str) -> String {
        let [lost, all] = [self.lost_count, self.of_count].map(grouped);
        let limit = percent(SKIPPED_TICK_RATIO_MAX);
        format!("{lost} of {all} {of} ({}, limit {limit})", self.share())
    }

    /// Those of `all` that are beyond the limit, by name, and what they lost together; `None` without any.
    fn beyond_limit<'a>(all: impl Iterator<Item = (&'a str, Self)>) -> Option<(Vec<String>, Self)> {
        let (mut names, mut sum) = (Vec::new(), Self::default());
        for (name, one) in all.filter(|(_, one)| one.is_beyond_limit()) {
            names.push(name.to_owned());
            sum.lost_count += one.lost_count;
            sum.of_count += one.of_count;
        }
        (!names.is_empty()).then_some((names, sum))
    }
}

/// What follows from a summary's figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Assessment {
    /// Whether this is a network result.
    pub network: NetworkVerdict,
    /// What a reader must be warned of, most important first.
    pub warnings: Vec<String>,
}

impl Assessment {
    /// Draws the conclusions.
    pub fn of(summary: &RunSummary) -> Self {
        let overruns: Vec<Overrun> = summary.processes.iter().filter_map(overrun).collect();
        let mut warnings: Vec<String> = overruns.iter().map(overrun_warning).collect();
        warnings.extend(summary.channels.iter().filter_map(emulation_warning));
        warnings.extend(
            summary
                .directions
                .iter()
                .filter_map(|one| no_room_warning(summary, one)),
        );
        warnings.extend(summary.warnings.iter().cloned());
        warnings.extend(
            summary
                .faces
                .iter()
                .flat_map(adapter_warnings::adapter_warnings),
        );
        warnings.extend(uncounted(summary).map(uncounted_warning));
        warnings.extend(summary.processes.iter().flat_map(process_warnings));
        warnings.extend(unrecorded_warning(&summary.channels));
        warnings.extend(summary.channels.iter().flat_map(channel_warnings));
        warnings.extend(
            summary
                .realtime
                .refused
                .iter()
                .map(|one| format!("{}: {}", one.value, one.label)),
        );
        let network = verdict(summary, overruns);
        // The joint is for pages; in JSON it would only surprise.
        for warning in &mut warnings {
            *warning = warning.replace(JOINT, " ");
        }
        Self { network, warnings }
    }
}

fn verdict(summary: &RunSummary, overruns: Vec<Overrun>) -> NetworkVerdict {
    let links = || summary.channels.iter().map(|channel| channel.link);
    let has_network = links().any(|link| matches!(link, LinkKind::Network(_)));
    let has_emulation = links().any(|link| link == LinkKind::Emulated);
    let has_adapter = !summary.faces.is_empty();
    // A component that was killed took its count with it; other kinds have none to take.
    let is_silent =
        |process: &ProcessSummary| process.kind.counts_ticks() && process.cpu_time_s.is_none();
    let has_ticks = |process: &ProcessSummary| process.tick_count.is_some();
    // A program of the user's and a component that only messages drive have none; the gateways tell then.
    let has_counters = !summary.directions.is_empty() && uncounted(summary).next().is_none();
    let has_evidence = has_counters || summary.processes.iter().any(has_ticks);
    if summary.run.outcome == Outcome::Failed {
        NetworkVerdict::RunFailed
    } else if summary.run.is_virtual {
        NetworkVerdict::VirtualTime
    } else if !has_network && !has_emulation && !has_adapter {
        NetworkVerdict::NoNetwork
    } else if !summary.record_gaps.is_empty() {
        let hosts: BTreeSet<_> = summary.record_gaps.iter().map(|gap| &gap.host).collect();
        NetworkVerdict::RecordsMissing {
            hosts: hosts.into_iter().cloned().collect(),
        }
    } else if !overruns.is_empty() {
        NetworkVerdict::HostOverran {
            processes: overruns,
        }
    } else if !unkept(summary).is_empty() {
        NetworkVerdict::EmulationNotKept {
            channels: unkept(summary),
        }
    } else if let Some((channels, loss)) = received_late(summary) {
        NetworkVerdict::ReceiverLate { channels, loss }
    } else if let Some((channels, loss)) = gateway_late(summary) {
        NetworkVerdict::GatewayLate { channels, loss }
    } else if let Some((channels, loss)) = frames_lost(summary) {
        NetworkVerdict::FramesLost { channels, loss }
    } else if summary.processes.iter().any(is_silent) {
        NetworkVerdict::TicksUnknown
    } else if !has_evidence {
        NetworkVerdict::HostUnknown
    } else if has_emulation {
        NetworkVerdict::EmulatedLink
    } else if has_network {
        NetworkVerdict::NetworkResult
    } else if summary.faces.iter().all(AdapterSummary::is_unanswered) {
        NetworkVerdict::NoForeignProgram
    } else {
        NetworkVerdict::ForeignProgram
    }
}

/// The channels whose emulated link the host could not keep.
fn unkept(summary: &RunSummary) -> Vec<String> {
    let is_unkept = |channel: &&ChannelSummary| {
        let figures = channel.emulation.as_ref();
        figures.is_some_and(|figures| !figures.is_kept())
    };
    let channels = summary.channels.iter().filter(is_unkept);
    channels.map(|channel| channel.name.clone()).collect()
}

/// The channels that a direction carried.
fn carried<'a>(
    summary: &'a RunSummary,
    direction: &'a DirectionSummary,
) -> impl Iterator<Item = &'a ChannelSummary> {
    let channels = summary.channels.iter();
    channels.filter(|one| direction.channels.contains(&one.name))
}

/// The ways of links on which more than [`SKIPPED_TICK_RATIO_MAX`] of the messages may have been lost to the
/// receiver's host: a gateway keeps no ticks that would tell that it was late.
fn received_late(summary: &RunSummary) -> Option<(Vec<String>, HostLoss)> {
    HostLoss::beyond_limit(summary.directions.iter().map(|direction| {
        let accounts = carried(summary, direction).filter_map(|one| one.account.as_ref());
        let loss = HostLoss {
            lost_count: direction.no_room_count(),
            of_count: accounts.map(|account| account.published_count).sum(),
        };
        (direction.label(), loss)
    }))
}

/// The channels with which gateways were late in more than [`SKIPPED_TICK_RATIO_MAX`] of the messages. Before a stream (TCP), messages
/// also wait because the network is slow: there only what waited in the receiving host counts. Behind an emulated link,
/// whose datagrams no stream carries, they wait in the receiving host because the model says so: there only the sending
/// host counts.
fn gateway_late(summary: &RunSummary) -> Option<(Vec<String>, HostLoss)> {
    HostLoss::beyond_limit(summary.channels.iter().filter_map(|channel| {
        let (is_stream, is_modelled) = match channel.link {
            LinkKind::Network(transport) => (transport.capabilities.cuts_to_path, false),
            LinkKind::Emulated => (false, true),
            LinkKind::SharedMemory | LinkKind::RecordOnly => return None,
        };
        let account = channel.account.as_ref()?;
        let held = |from, to| -> u64 {
            let segments = account.segments.iter();
            let within = segments.filter(|one| (one.from, one.to) == (from, to));
            let bins = within.flat_map(|one| &one.bins);
            let long = bins.filter(|bin| bin.from_ns() >= HELD_MAX_NS);
            long.map(|bin| bin.count).sum()
        };
        let mut lost_count = 0;
        if !is_modelled {
            lost_count += held(Stage::RxSoftware, Stage::Received);
        }
        if !is_stream {
            lost_count += held(Stage::Published, Stage::TakenByGateway)
                + account.fates.of(MessageFate::SupersededAtInput);
        }
        let loss = HostLoss {
            lost_count,
            of_count: account.published_count,
        };
        // A single one may be the first of a run, from before the gateway looked.
        (lost_count > 1).then_some((channel.name.as_str(), loss))
    }))
}

/// The channels of which more than [`SKIPPED_TICK_RATIO_MAX`] of the frames were lost in what is ours.
fn frames_lost(summary: &RunSummary) -> Option<(Vec<String>, HostLoss)> {
    HostLoss::beyond_limit(summary.flows.iter().map(|one| {
        let inlet_count = one.inlet_lost_count();
        let flows = || one.flows.iter();
        let in_flows_count: u64 = flows().map(|flow| flow.lost_by_harness_count).sum();
        let loss = HostLoss {
            lost_count: inlet_count + in_flows_count,
            of_count: inlet_count + flows().map(|flow| flow.frame_count).sum::<u64>(),
        };
        (one.channel.as_str(), loss)
    }))
}

/// Processes some of whose starts left no counters. A process tells its counters as it ends in order, and those
/// of its last start are kept.
pub(crate) fn uncounted(summary: &RunSummary) -> impl Iterator<Item = &ProcessSummary> {
    let carries_frames = |process: &ProcessSummary| {
        let mut channels = summary.channels.iter().filter(|channel| {
            let name = Some(process.name.as_str());
            Some(channel.from.as_str()) == name || channel.to.as_deref() == name
        });
        channels.any(|channel| summary.flows.iter().any(|one| one.channel == channel.name))
    };
    summary.processes.iter().filter(move |process| {
        let has_counters = match process.kind {
            ProcessKind::Component
            | ProcessKind::Gateway
            | ProcessKind::Adapter
            | ProcessKind::Witness => true,
            // It carries no message.
            ProcessKind::ClockPath => false,
            ProcessKind::OwnProgram => carries_frames(process),
        };
        has_counters && process.uncounted_start_count() > 0
    })
}

/// Starts of processes that left no counters.
pub(crate) fn uncounted_start_count(summary: &RunSummary) -> u64 {
    uncounted(summary)
        .map(ProcessSummary::uncounted_start_count)
        .sum()
}

fn uncounted_warning(process: &ProcessSummary) -> String {
    format!(
        "{}: the counters of {} of its {} are unavailable; what it dropped, lost or skipped then is unknown",
        process.name,
        grouped(process.uncounted_start_count()),
        counted(process.restart_count + 1, "start"),
    )
}

fn no_room_warning(summary: &RunSummary, direction: &DirectionSummary) -> Option<String> {
    let count = Some(direction.no_room_count()).filter(|count| *count > 0)?;
    let of = |fate| -> u64 {
        let accounts = carried(summary, direction).filter_map(|one| one.account.as_ref());
        accounts.map(|account| account.fates.of(fate)).sum()
    };
    let lost = of(MessageFate::LostByHarness);
    let doubtful = of(MessageFate::LostOnWireOrByHarness);
    let lost = match (lost, doubtful) {
        (0, 0) => String::new(),
        (lost, 0) => format!(", and lost {} so", counted(lost, "message")),
        (lost, doubtful) => format!(
            ", and lost {} so and perhaps {} more",
            counted(lost, "message"),
            grouped(doubtful)
        ),
    };
    Some(format!(
        "{}: {} had {NO_ROOM}, because the receiving gateway was late or more came than it could take{lost}",
        direction.label(),
        counted(count, "datagram"),
    ))
}

fn emulation_warning(channel: &ChannelSummary) -> Option<String> {
    let figures = channel
        .emulation
        .as_ref()
        .filter(|figures| !figures.is_kept())?;
    let ms = |ns: i64| ns as f64 * 1e-6;
    let dropped = figures.overflow_count.filter(|count| *count > 0);
    let dropped = dropped.map_or_else(String::new, |count| {
        format!(", and {} found no room", grouped(count))
    });
    Some(format!(
        "the host could not keep the emulated link: {} had its datagrams {:.3} ms late at p99, where \
         {:.3} ms are allowed{dropped}; neither network nor model is to blame for that",
        channel.name,
        ms(figures.scheduling_error.p99_ns),
        ms(figures.error_max_ns),
    ))
}

fn overrun(process: &ProcessSummary) -> Option<Overrun> {
    let skipped_tick_count = process.skipped_tick_count?;
    let due_tick_count = process.tick_count?.saturating_add(skipped_tick_count);
    let limit = SKIPPED_TICK_RATIO_MAX * due_tick_count as f64;
    (skipped_tick_count as f64 > limit).then(|| Overrun {
        process: process.name.clone(),
        host: process.host.clone(),
        skipped_tick_count,
        due_tick_count,
    })
}

fn overrun_warning(overrun: &Overrun) -> String {
    format!(
        "host overran: {} skipped {} of {} ticks ({}) on {}; the network is not to blame for \
         what these ticks missed",
        overrun.process,
        grouped(overrun.skipped_tick_count),
        grouped(overrun.due_tick_count),
        percent(overrun.skipped_tick_count as f64 / overrun.due_tick_count as f64),
        overrun.host,
    )
}

fn process_warnings(process: &ProcessSummary) -> Vec<String> {
    let name = &process.name;
    let some = |count: Option<u64>| count.filter(|count| *count > 0);
    let mut warnings = Vec::new();
    if let Some(count) = some(process.recorder_drop_count) {
        warnings.push(format!(
            "{name} could not write {}; their messages show as missing stages",
            counted(count, "record")
        ));
    }
    if let Some(count) = some(process.outbox_drop_count) {
        let count = counted(count, "message");
        warnings.push(format!("{name} dropped {count} into a full outbox"));
    }
    if let Some(count) = some(process.malformed_count) {
        warnings.push(format!(
            "{name} refused {}",
            counted(count, "malformed message")
        ));
    }
    warnings
}

/// One warning for all channels without records: those between programs of the user's may be many.
fn unrecorded_warning(channels: &[ChannelSummary]) -> Option<String> {
    let has_none =
        |one: &&ChannelSummary| one.account.is_none() && one.link != LinkKind::RecordOnly;
    let names = channels
        .iter()
        .filter(has_none)
        .map(|one| one.name.as_str());
    match names.collect::<Vec<_>>()[..] {
        [] => None,
        [name] => Some(format!("{name} left no records: it has no account")),
        ref names => {
            let names = named(names, NAMED_COUNT);
            Some(format!("{names} left no records: they have no account"))
        }
    }
}

fn channel_warnings(channel: &ChannelSummary) -> Vec<String> {
    let name = &channel.name;
    if channel.link == LinkKind::RecordOnly {
        return recorded_warnings(channel);
    }
    let Some(account) = &channel.account else {
        return Vec::new();
    };
    let mut warnings = Vec::new();
    let unreachable = account.fates.of(MessageFate::NetworkUnreachable);
    if unreachable > 0 {
        warnings.push(format!(
            "{name}: {} lost because {} had no way to its peer: an interface was down or there was no route",
            counted(unreachable, "message"),
            channel.from,
        ));
    }
    let unexplained = account.fates.of(MessageFate::Unexplained);
    if unexplained > 0 {
        let count = counted(unexplained, "message");
        warnings.push(format!("{name}: {count} vanished without explanation"));
    }
    if let Some(ratio) = account
        .closing
        .checked()
        .and_then(ClosingMetrics::closed_ratio)
        && ratio < CLOSED_RATIO_MIN
    {
        let (ratio, least) = (percent(ratio), percent(CLOSED_RATIO_MIN));
        warnings.push(format!(
            "{name}: the times of only {ratio} of messages add up, less than {least}"
        ));
    }
    // What has no stamps by design, nobody can do anything about.
    if channel.link.is_stamped() {
        warnings.extend(stamp_warnings(name, account));
    }
    warnings
}

/// The record is all there is of such a channel, and a score rests on it.
fn recorded_warnings(channel: &ChannelSummary) -> Vec<String> {
    let name = &channel.name;
    match &channel.recorded {
        None => vec![format!("{name} left no record")],
        Some(figures) if figures.missing_count > 0 => {
            let count = counted(figures.missing_count, "message");
            vec![format!("{name}: {count} missing in its record")]
        }
        Some(_) => Vec::new(),
    }
}

fn stamp_warnings(name: &str, account: &ChannelAccount) -> Vec<String> {
    let coverage = &account.coverage;
    [("TX", coverage.tx_software), ("RX", coverage.rx_software)]
        .into_iter()
        .filter_map(|(kind, coverage)| {
            let ratio = coverage.as_ref().and_then(Coverage::ratio)?;
            (ratio < STAMPED_RATIO_MIN).then(|| {
                let ratio = percent(ratio);
                format!("{name}: only {ratio} of messages carry a kernel {kind} stamp")
            })
        })
        .collect()
}
