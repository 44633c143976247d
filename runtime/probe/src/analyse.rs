//! One or two captures, drawn up: what each point saw of each flow, and what two points say of it
//! together. Sections and JSON come from the same figures.

use core::fmt::Write as _;
use std::path::Path;

use hil_capture::flow::FlowFilter;
use hil_capture::join::{
    CountedDoubt, Doubt, JoinMetrics, JoinSettings, Joined, Loss, OrderSource, Pair,
};
use hil_capture::observe::{Observation, Observer, PacketCounts, Point, Stream};
use hil_capture::pairing::join_all;
use hil_capture::point::{PointMetrics, single_point_metrics};
use hil_capture::watch::{ClockStep, Unread};
use hil_core::interval::Spread;
use serde::Serialize;

use super::files::{CaptureFile, FileError, read};
use super::point_clocks::PointClocks;
use hil_platform::text::grouped;
use hil_present::units::{duration, duration_s, percent, seconds};
use hil_present::{Cell, Section, Table, Tone};
use hil_report::quantile_table;

/// Captures read, and every point in them.
#[derive(Debug)]
pub(super) struct Reading {
    pub(super) files: Vec<CaptureFile>,
    pub(super) observer: Observer,
    /// What cards stamped of the same, each on a clock of its own.
    of_cards: Observer,
}

impl Reading {
    /// Reads up to two files; `look` hears of each piece how many bytes it was.
    pub(super) fn of(
        paths: &[&Path],
        flows: &[FlowFilter],
        look: &mut dyn FnMut(usize),
    ) -> Result<Self, FileError> {
        let mut observer = Observer::new(flows);
        let mut of_cards = Observer::new(flows);
        let mut files = Vec::with_capacity(paths.len());
        for (index, path) in paths.iter().enumerate() {
            files.push(read(path, index, &mut observer, &mut of_cards, look)?);
        }
        Ok(Self {
            files,
            observer,
            of_cards,
        })
    }

    /// A point in words: file, interface, port, direction.
    pub(super) fn name(&self, point: &Point) -> String {
        let file = &self.files[point.file_index];
        let name = file.path.file_name().map(|name| name.to_string_lossy());
        let mut text = name.unwrap_or_default().into_owned();
        let interface = file.interfaces.get(point.interface_index);
        match interface.and_then(|one| one.name.as_deref()) {
            Some(interface) => {
                let _infallible = write!(text, ":{interface}");
            }
            None if file.interfaces.len() > 1 => {
                let _infallible = write!(text, ":{}", point.interface_index);
            }
            None => {}
        }
        if let Some(port) = point.esl_port {
            let _infallible = write!(text, ":port{port}");
        }
        if let Some(number) = point.interface_number {
            let _infallible = write!(text, ":if{number}");
        }
        let _infallible = match point.vlans {
            [0, 0] => Ok(()),
            [0, vlan] => write!(text, ":vlan{vlan}"),
            [outer, vlan] => write!(text, ":vlan{outer}.{vlan}"),
        };
        match point.radio_leg {
            Some((true, false)) => text.push_str(":to-ap"),
            Some((false, true)) => text.push_str(":from-ap"),
            _ => {}
        }
        if point.direction != hil_net::Direction::Unknown {
            let _infallible = write!(text, " ({})", point.direction.label());
        }
        text
    }

    /// A point and further ones of its host over which a part of a stream went, in words.
    fn names(&self, point: &Point, also: &[Point]) -> String {
        let all = core::iter::once(point).chain(also);
        all.map(|one| self.name(one))
            .collect::<Vec<_>>()
            .join(" + ")
    }

    /// Every stream that a card stamped, with how many of its datagrams have the kernel's stamp.
    fn nic_streams(&self) -> impl Iterator<Item = (&Point, &Stream, &Vec<Observation>, u64)> {
        let seen = self.of_cards.seen().iter();
        let streams = seen.flat_map(|(point, seen)| {
            let streams = seen.iter();
            streams.map(move |(stream, list)| (point, stream, list))
        });
        streams.map(|(point, stream, list)| {
            let name = |one: &Point| {
                let interfaces = &self.files[one.file_index].interfaces;
                interfaces.get(one.interface_index)?.name.as_deref()
            };
            let is_same_place = |one: &Point| {
                (one.file_index, one.direction) == (point.file_index, point.direction)
                    && name(one) == name(point)
            };
            let of_kernel = self.observer.seen().iter();
            let all: usize = of_kernel
                .filter(|(one, _)| is_same_place(one))
                .filter_map(|(_, seen)| seen.get(stream).map(Vec::len))
                .sum();
            (point, stream, list, all as u64)
        })
    }

    /// Every stream at two points, joined.
    pub(super) fn joined(&self, settings: &JoinSettings) -> Vec<(Stream, Joined)> {
        join_all(&self.observer, settings)
    }

    /// True when a file has a fault or says that packets were dropped.
    pub(super) fn has_gaps(&self) -> bool {
        let is_bad = |file: &CaptureFile| file.fault_count > 0 || file.dropped_count() > Some(0);
        self.files.iter().any(is_bad) || self.observer.folded().next().is_some()
    }

    /// Says so when nothing was followed, and what there was.
    pub(super) fn nothing_followed(&self) -> Option<String> {
        /// Ports named.
        const PORT_COUNT: usize = 5;
        if self.observer.counts().followed_count > 0 {
            return None;
        }
        let flows: Vec<String> = self
            .observer
            .flows()
            .iter()
            .map(ToString::to_string)
            .collect();
        let flows = flows.join(" or ");
        let ports = self
            .observer
            .busiest_other_ports()
            .into_iter()
            .take(PORT_COUNT);
        let ports = ports.map(|(port, count)| format!("{port} ({})", grouped(count)));
        let ports: Vec<String> = ports.collect();
        Some(if ports.is_empty() {
            format!("no datagram of {flows} is known, nor is there UDP of other flows")
        } else {
            let ports = ports.join(", ");
            format!(
                "no datagram of {flows} is known; most UDP went to ports {ports}: try --flow udp:dport=PORT"
            )
        })
    }

    /// Every fault told and every gap, in words.
    pub(super) fn complaints(&self) -> Vec<String> {
        let mut complaints = Vec::new();
        for file in &self.files {
            complaints.extend(file.faults.iter().cloned());
            let (path, told) = (file.path.display(), file.faults.len() as u64);
            if file.fault_count > told {
                complaints.push(format!("{path}: {} more faults", file.fault_count - told));
            }
            if let Some(count) = file.dropped_count().filter(|count| *count > 0) {
                complaints.push(format!(
                    "{path}: {count} packets were dropped while it was captured: what it lacks may \
                     have been on the wire"
                ));
            }
        }
        complaints.extend(self.observer.folded().map(|(point, _)| {
            format!(
                "{}: most datagrams are there twice: mergecap made one interface of several captures; give both files, or merge \
                 them with `mergecap -I none`",
                self.name(point)
            )
        }));
        complaints
    }
}

#[derive(Debug, Serialize)]
struct FileReport {
    path: String,
    format: Option<&'static str>,
    packet_count: u64,
    /// Names or numbers of its interfaces.
    interfaces: Vec<String>,
    dropped_count: Option<u64>,
    fault_count: u64,
    faults: Vec<String>,
}

#[derive(Debug, Serialize)]
struct StreamReport {
    flow: String,
    source: String,
    destination: String,
    channel: Option<u16>,
    kind: Option<&'static str>,
}

#[derive(Debug, Serialize)]
struct PointReport {
    point: String,
    /// By a network card's clock: datagrams of this stream that have the kernel's stamp, of which
    /// the figures hold those that have the card's as well.
    #[serde(skip_serializing_if = "Option::is_none")]
    kernel_stamped_count: Option<u64>,
    #[serde(flatten)]
    stream: StreamReport,
    figures: PointMetrics,
}

#[derive(Debug, Serialize)]
struct JoinReport {
    first: String,
    second: String,
    clocks: PointClocks,
    /// How far the clocks may lead the delays astray; `None` where it is unknown.
    delay_bound_ns: Option<u64>,
    #[serde(flatten)]
    stream: StreamReport,
    figures: JoinMetrics,
}

/// Everything that is said of the captures.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    schema_version: u32,
    files: Vec<FileReport>,
    packets: PacketCounts,
    points: Vec<PointReport>,
    joins: Vec<JoinReport>,
}

impl Report {
    /// Draws up the figures.
    pub(super) fn of(reading: &Reading, settings: &JoinSettings) -> Self {
        let stream_report = |stream: &Stream| StreamReport {
            flow: reading.observer.flows()[stream.flow_index].to_string(),
            source: stream.source.to_string(),
            destination: stream.destination.to_string(),
            channel: stream.own.map(|(channel, _)| channel),
            kind: stream.kind_label(),
        };
        let mut points = Vec::new();
        for (point, seen) in reading.observer.seen() {
            for (stream, observations) in seen {
                points.extend(
                    single_point_metrics(observations).map(|figures| PointReport {
                        point: reading.name(point),
                        kernel_stamped_count: None,
                        stream: stream_report(stream),
                        figures,
                    }),
                );
            }
        }
        for (point, stream, observations, all) in reading.nic_streams() {
            let figures = single_point_metrics(observations);
            points.extend(figures.map(|figures| PointReport {
                point: format!("{}, by the card's clock", reading.name(point)),
                kernel_stamped_count: Some(all),
                stream: stream_report(stream),
                // A number that the card did not stamp was not skipped.
                figures: PointMetrics {
                    numbers: figures.numbers.filter(|_| figures.datagram_count == all),
                    ..figures
                },
            }));
        }
        let joins = reading.joined(settings).into_iter();
        let clocks = |one: &Joined| {
            let (first, second) = (&one.first_point, &one.second_point);
            let mut interfaces = reading.files[first.file_index].interfaces.iter();
            let is_apart = first.tap() != second.tap() && interfaces.any(|one| one.is_merged);
            let declared = PointClocks::of(first, second, is_apart, settings);
            // Where a clock was set there are none.
            let is_delay =
                |pair: &&Pair| one.figures.delay.measured().is_some() && pair.is_stamped();
            let pairs = one.pairs.iter().filter(is_delay);
            let delays_ns =
                pairs.map(|pair| pair.second.stamp_ns.saturating_sub(pair.first.stamp_ns));
            declared.beside(delays_ns, one.unit_ns)
        };
        Self {
            schema_version: 2,
            files: reading.files.iter().map(file_report).collect(),
            packets: *reading.observer.counts(),
            points,
            joins: joins
                .map(|(stream, joined)| {
                    let clocks = clocks(&joined);
                    JoinReport {
                        first: reading.names(&joined.first_point, &joined.also[0]),
                        second: reading.names(&joined.second_point, &joined.also[1]),
                        clocks,
                        delay_bound_ns: clocks.bound_ns(),
                        stream: stream_report(&stream),
                        figures: joined.figures,
                    }
                })
                .collect(),
        }
    }

    /// True when loss is unavailable between two points, a clock was set or may have been, or delays contradict that
    /// it is one.
    pub(super) fn has_doubts(&self) -> bool {
        let is_doubtful = |one: &JoinReport| {
            one.figures.loss.count().is_none()
                || one.clocks == PointClocks::Contradicted
                || !one.figures.delay_shifts.is_empty()
                || one
                    .figures
                    .clock_steps
                    .iter()
                    .any(|steps| !steps.is_empty())
        };
        self.joins.iter().any(is_doubtful)
    }

    /// What makes figures unavailable, in words.
    pub(super) fn complaints(&self) -> Vec<String> {
        let mut complaints = Vec::new();
        for one in &self.joins {
            if one.clocks == PointClocks::Contradicted {
                let (first, second) = (&one.first, &one.second);
                let why = one.clocks.words();
                complaints.push(format!("clocks of {first} and {second}: {why}"));
            }
            if let Loss::Unavailable { doubts, .. } = &one.figures.loss {
                let why = doubts_text(doubts, one.clocks);
                complaints.push(format!("loss from {} to {}: {why}", one.first, one.second));
            }
            if !one.figures.delay_shifts.is_empty() {
                let (first, second) = (&one.first, &one.second);
                let shifts = one.figures.delay_shifts.iter();
                let by: Vec<String> = shifts.map(|shift| duration(shift.by_ns)).collect();
                complaints.push(format!(
                    "delays from {first} to {second}: unavailable, they changed their level by {}: a clock was \
                     set, or the way changed",
                    by.join(", ")
                ));
            }
            for (point, steps) in [&one.first, &one.second]
                .into_iter()
                .zip(&one.figures.clock_steps)
            {
                complaints.extend(steps.iter().map(|step| {
                    format!(
                        "{point}: its clock was set {}: delays are unavailable",
                        step_words(step)
                    )
                }));
            }
        }
        complaints
    }

    /// True when no packet was read at all.
    pub(super) fn is_empty(&self) -> bool {
        self.packets.packet_count == 0
    }

    pub(super) fn sections(&self) -> Vec<Section> {
        let mut sections = vec![self.captures()];
        sections.extend(self.points.iter().map(point_section));
        sections.extend(self.joins.iter().map(join_section));
        sections
    }

    /// What was read.
    fn captures(&self) -> Section {
        let mut section = Section::new("captures", "Captures", "");
        for file in &self.files {
            section.fact("file", Tone::Plain, file_words(file));
        }
        let counts = &self.packets;
        let mut table = Table::new("", &["packets", ""]);
        for (count, what) in [
            (counts.packet_count, "read"),
            (counts.followed_count, "followed"),
            (counts.other_flow_count, "of other flows"),
            (counts.not_ip_count, "not IP"),
            (counts.not_udp_count, "not UDP"),
            (counts.unreadable_count, "unreadable"),
            (
                counts.foreign_count,
                "with a flow's address but of another protocol",
            ),
            (
                counts.unidentified_count,
                "captured too short or in fragments, not known again",
            ),
            (
                counts.fragmented_count,
                "in fragments: stamped when the first passed",
            ),
            (counts.later_fragment_count, "later fragments"),
            (
                counts.incomplete_count,
                "of which fragments are missing, not counted as seen",
            ),
            (
                counts.damaged_count,
                "damaged (check sequence, length or symbols), not counted as seen",
            ),
            (counts.stampless_count, "without a time stamp, left out"),
            (counts.radio_retry_count, "sent again by a radio, left out"),
            (
                counts.elsewhere_count,
                "seen again on another link of the capturing host, left out",
            ),
            (
                counts.backward_stamp_count,
                "earlier than the one before, put in order",
            ),
            (
                counts.esl_damaged_count,
                "damaged, says the ET2000, not counted as seen",
            ),
            (
                counts.esl_port_unclear_count,
                "for which the ET2000 names no or several ports",
            ),
        ] {
            if count > 0 || table.rows.len() < 2 {
                table.push([Cell::Count(count), what.into()]);
            }
        }
        "kinds of which there are none are not listed".clone_into(&mut table.note);
        section.table(table);
        section
    }
}

fn file_report(file: &CaptureFile) -> FileReport {
    let names = file.interfaces.iter().enumerate();
    let names = names.filter(|(_, one)| one.repeats.is_none());
    FileReport {
        path: file.path.display().to_string(),
        format: file.format,
        packet_count: file.packet_count,
        interfaces: names
            .map(|(index, one)| {
                let name = one.name.clone().unwrap_or_else(|| index.to_string());
                let of_nic = if one.has_nic_clock() { " (card)" } else { "" };
                name + of_nic
            })
            .collect(),
        dropped_count: file.dropped_count(),
        fault_count: file.fault_count,
        faults: file.faults.clone(),
    }
}

fn file_words(file: &FileReport) -> String {
    let format = file.format.unwrap_or("unknown format");
    let dropped = match file.dropped_count {
        Some(count) => format!("{} dropped", grouped(count)),
        None => "drops unknown".to_owned(),
    };
    let faults = match file.fault_count {
        0 => String::new(),
        count => format!(", {} faults", grouped(count)),
    };
    format!(
        "{}: {format}, {} packets on {}, {dropped}{faults}",
        file.path,
        grouped(file.packet_count),
        file.interfaces.join(" and ")
    )
}

/// A section under the name of a stream.
fn stream_section(id: &str, stream: &StreamReport) -> Section {
    let own = match (stream.channel, stream.kind) {
        (Some(channel), Some(kind)) => format!(" channel {channel} {kind}"),
        _ => String::new(),
    };
    let ends = format!("{} -> {}", stream.source, stream.destination);
    Section::new(id, format!("{}{own}", stream.flow), ends)
}

fn point_section(point: &PointReport) -> Section {
    let mut section = stream_section("point", &point.stream);
    let mut fact = |label: &str, words: String| section.fact(label, Tone::Plain, words);
    let figures = &point.figures;
    fact("at", point.point.clone());
    if let Some(all) = point.kernel_stamped_count {
        fact("arrived", format!("{}, of which", grouped(all)));
    }
    let length_ns = figures.last_ns.saturating_sub(figures.first_ns);
    fact(
        "datagrams",
        format!(
            "{}, {} bytes in {}",
            grouped(figures.datagram_count),
            grouped(figures.payload_bytes),
            seconds(length_ns as f64 * 1e-9)
        ),
    );
    if let Some(gap) = figures.longest_gap {
        let after_ns = gap.from_ns.saturating_sub(figures.first_ns);
        let after = seconds(after_ns as f64 * 1e-9);
        fact(
            "longest gap",
            format!("{} after {after}", duration(gap.length_ns)),
        );
    }
    if let Some(numbers) = figures.numbers {
        let repeated = numbers.repeated_count;
        let repeated = repeated.map_or_else(|| "unknown (pieces)".to_owned(), grouped);
        fact(
            "numbers",
            format!(
                "{} series, step {}, {} skipped, {repeated} repeated, {} reordered",
                grouped(numbers.series_count),
                numbers.step,
                grouped(numbers.skipped_count),
                grouped(numbers.reordered_count)
            ),
        );
    }
    section.table(quantile_table(&[("interval", &figures.interval)]));
    section
}

fn join_section(joined: &JoinReport) -> Section {
    let mut section = stream_section("join", &joined.stream);
    let mut fact = |label: &str, words: String| section.fact(label, Tone::Plain, words);
    let figures = &joined.figures;
    fact("from", joined.first.clone());
    fact("to", joined.second.clone());
    fact("clock", joined.clocks.words().to_owned());
    let order = match figures.order {
        OrderSource::PacketDirection => "by the packets' direction",
        OrderSource::HopLimit => "by the time to live",
        OrderSource::Stamps => "by most stamps",
        OrderSource::RoundTrip => "by the round trip",
        OrderSource::Missing => "by what is missing",
        OrderSource::Unknown => "order unknown",
    };
    fact("order", order.to_owned());
    let loss_words = match &figures.loss {
        Loss::Counted(loss) => {
            let ratio = loss
                .ratio
                .map_or_else(String::new, |ratio| format!(" = {}", percent(ratio)));
            format!(
                "{}{ratio}{}",
                grouped(loss.count),
                spread_words(loss.interval)
            )
        }
        Loss::Unavailable { range, doubts } => {
            let range =
                range.map(|(least, most)| format!(" ({} to {})", grouped(least), grouped(most)));
            format!(
                "unavailable{}: {}",
                range.unwrap_or_default(),
                doubts_text(doubts, joined.clocks)
            )
        }
    };
    fact("lost", loss_words);
    if let Loss::Counted(loss) = &figures.loss
        && !loss.bursts.is_empty()
    {
        let bursts = loss.bursts.iter();
        let bursts = bursts.map(|(length, count)| format!("{count}x{length}"));
        fact("loss runs, RFC 3357", bursts.collect::<Vec<_>>().join(" "));
    }
    for (which, steps) in ["first", "second"].into_iter().zip(&figures.clock_steps) {
        for one in steps {
            fact(
                "clock step",
                format!("{} at the {which} point", step_words(one)),
            );
        }
    }
    for shift in &figures.delay_shifts {
        let more = duration(shift.by_ns);
        fact(
            "level",
            format!("{more} more from one datagram on: a clock set, or another way"),
        );
    }
    let (extent, n) = (figures.reordering_extent_max, figures.reordering_n_max);
    fact(
        "reordering",
        format!("extent at most {extent}, {n}-reordered at most, RFC 4737"),
    );
    if let (Some(last), Some(mean)) = (figures.jitter_last_ns, figures.jitter_mean_ns) {
        let (last, mean) = (duration_s(last * 1e-9), duration_s(mean * 1e-9));
        fact(
            "jitter",
            format!("{last} at the end, {mean} mean (RFC 3550)"),
        );
    }
    for (label, interval) in [
        ("delay, p50", figures.delay_p50_interval),
        ("delay, p99", figures.delay_p99_interval),
    ] {
        match interval {
            Some(Spread::Known(one)) => {
                let (low, high) = (duration_s(one.low * 1e-9), duration_s(one.high * 1e-9));
                let method = one.method.name();
                fact(label, format!("{low} to {high} (95 %, {method})"));
            }
            Some(Spread::Unknown(why)) => fact(label, why.to_string()),
            None => {}
        }
    }
    let counts = [
        ("first", Some(figures.first_count)),
        ("second", Some(figures.second_count)),
        ("both", Some(figures.matched_count)),
        ("at an edge", Some(figures.edge_count)),
        ("duplicated, RFC 5560", figures.duplicated_count),
        ("unexplained", Some(figures.unexplained_count)),
        ("reordered", Some(figures.reordered_count)),
    ];
    let mut seen = Table::new("", &counts.map(|(label, _)| label));
    seen.push(counts.map(|(_, count)| count.map_or_else(|| "unknown".into(), Cell::Count)));
    if figures.duplicated_count.is_none() {
        "a cooked capture of several links that names none: a duplicate looks like a copy on \
         another link"
            .clone_into(&mut seen.note);
    }
    section.table(seen);
    section.table(quantile_table(&[
        ("delay", &figures.delay),
        ("variation, RFC 5481 PDV", &figures.variation),
        ("variation, RFC 5481 IPDV", &figures.successive),
    ]));
    section
}

/// How far a clock was set; time went on meanwhile.
fn step_words(step: &ClockStep) -> String {
    let (by, side) = if step.by_ns < 0 {
        (step.by_ns.saturating_neg(), "back by at least")
    } else {
        (step.by_ns, "forward by at most")
    };
    format!("{side} {}", duration(by))
}

/// Why loss is unavailable.
pub(super) fn doubts_text(doubts: &[CountedDoubt], clocks: PointClocks) -> String {
    let words = doubts
        .iter()
        .map(|CountedDoubt { doubt, count }| match doubt {
            Doubt::Unread(Unread::LinkType { link_type }) => {
                format!("{count} of link type {link_type}, which is not read")
            }
            Doubt::Unread(Unread::Protocol { space, number }) => {
                format!("{count} of {space} {number:#06x}, which is not read")
            }
            Doubt::Unread(Unread::Tunnel { port }) => {
                format!("{count} in a tunnel on UDP port {port}, which is not read")
            }
            Doubt::Unread(Unread::CutShort) => format!("{count} captured too short"),
            Doubt::Unread(Unread::Fragmented) => format!("{count} in IP fragments"),
            Doubt::Unread(Unread::Malformed) => format!("{count} malformed"),
            Doubt::Unread(Unread::Encrypted) => format!("{count} encrypted"),
            Doubt::Unread(Unread::Aggregate) => {
                format!("{count} hold several datagrams (segmentation or receive offload, A-MSDU)")
            }
            Doubt::Unread(Unread::NoStamp) => format!("{count} without a time stamp"),
            Doubt::Filtered { filter } => {
                format!("{count} may have been left out by the capture's filter `{filter}`")
            }
            Doubt::Pieces => {
                format!("{count} in IP fragments of which the capture kept only the first")
            }
            Doubt::Dropped => format!("{count} dropped by the capture"),
            Doubt::Apart => format!(
                "{count} seen at both points farther apart than --window: a clock that was set, or clocks \
                 far apart"
            ),
            Doubt::Ambiguous => format!(
                "{count} whose numbers come again too soon: half a lap must be longer than the delays vary"
            ),
            Doubt::Readdressed => format!(
                "{count} seen at the other point under other addresses (an address was translated on the way)"
            ),
            Doubt::Unwatched => format!(
                "{count} seen at one point while the other was not watched, as far as its file tells"
            ),
            Doubt::Order => {
                let hint = match clocks {
                    PointClocks::Unknown => " (--one-clock)",
                    PointClocks::OneFile | PointClocks::DeclaredOne | PointClocks::Contradicted => "",
                };
                format!("{count} at one point only, and which comes first is unknown{hint}")
            }
        });
    words.collect::<Vec<String>>().join(", ")
}

/// An interval of a share with its method, or why there is none.
fn spread_words(interval: Option<Spread>) -> String {
    match interval {
        Some(Spread::Known(one)) => {
            let (low, high) = (percent(one.low), percent(one.high));
            format!(" ({low} to {high}, 95 %, {})", one.method.name())
        }
        Some(Spread::Unknown(why)) => format!(" ({why})"),
        None => String::new(),
    }
}
