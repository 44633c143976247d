//! One or two captures, drawn up: what each point saw of each flow, and what two points say of it
//! together. Text and JSON come from the same figures.

use core::fmt::Write as _;
use std::path::Path;

use hil_capture::flow::FlowFilter;
use hil_capture::join::{JoinMetrics, Joined, OrderSource};
use hil_capture::observe::{Observation, Observer, PacketCounts, Point, Stream};
use hil_capture::pairing::join_all;
use hil_capture::point::{PointMetrics, single_point_metrics};
use hil_core::interval::Spread;
use hil_stats::histogram::Distribution;
use serde::Serialize;

use super::files::{CaptureFile, FileError, read};
use super::point_clocks::PointClocks;

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
        if point.direction != hil_net::Direction::Unknown {
            let _infallible = write!(text, " ({})", point.direction.label());
        }
        text
    }

    /// Every stream that a card stamped, with how many of its datagrams have the kernel's stamp.
    fn nic_streams(&self) -> impl Iterator<Item = (&Point, &Stream, &Vec<Observation>, u64)> {
        let seen = self.of_cards.seen().iter();
        let streams = seen.flat_map(|(point, seen)| {
            let streams = seen.streams.iter();
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
                .filter_map(|(_, seen)| seen.streams.get(stream).map(Vec::len))
                .sum();
            (point, stream, list, all as u64)
        })
    }

    /// Every stream at two points, joined.
    pub(super) fn joined(&self, window_ns: i64) -> Vec<(Stream, Joined)> {
        join_all(&self.observer, window_ns)
    }

    /// True when a file has a fault or says that packets were dropped.
    pub(super) fn has_gaps(&self) -> bool {
        let is_bad = |file: &CaptureFile| file.fault_count > 0 || file.dropped_count() > Some(0);
        self.files.iter().any(is_bad)
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
    pub(super) fn of(reading: &Reading, window_ns: i64, is_one_clock: bool) -> Self {
        let stream_report = |stream: &Stream| StreamReport {
            flow: reading.observer.flows()[stream.flow_index].to_string(),
            source: stream.source.to_string(),
            destination: stream.destination.to_string(),
            channel: stream.own.map(|(channel, _)| channel),
            kind: stream.kind_label(),
        };
        let mut points = Vec::new();
        for (point, seen) in reading.observer.seen() {
            for (stream, observations) in &seen.streams {
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
        let joins = reading.joined(window_ns).into_iter();
        let clocks =
            |one: &Joined| PointClocks::of(&one.first_point, &one.second_point, is_one_clock);
        Self {
            schema_version: 1,
            files: reading.files.iter().map(file_report).collect(),
            packets: *reading.observer.counts(),
            points,
            joins: joins
                .map(|(stream, joined)| JoinReport {
                    first: reading.name(&joined.first_point),
                    second: reading.name(&joined.second_point),
                    clocks: clocks(&joined),
                    delay_bound_ns: clocks(&joined).bound_ns(),
                    stream: stream_report(&stream),
                    figures: joined.figures,
                })
                .collect(),
        }
    }

    /// True when no packet was read at all.
    pub(super) fn is_empty(&self) -> bool {
        self.packets.packet_count == 0
    }

    pub(super) fn to_text(&self) -> String {
        let mut lines: Vec<String> = self.files.iter().map(file_line).collect();
        let counts = &self.packets;
        lines.push(format!(
            "{} packets: {} followed, {} of other flows, {} not IP, {} not UDP, {} unreadable",
            counts.packet_count,
            counts.followed_count,
            counts.other_flow_count,
            counts.not_ip_count,
            counts.not_udp_count,
            counts.unreadable_count
        ));
        for (count, what) in [
            (
                counts.foreign_count,
                "with a flow's address but of another protocol",
            ),
            (
                counts.unidentified_count,
                "captured too short to be known again",
            ),
            (
                counts.fragmented_count,
                "first fragments: stamped when their first piece passed",
            ),
            (counts.later_fragment_count, "later fragments, left out"),
            (counts.stampless_count, "without a time stamp, left out"),
            (
                counts.backward_stamp_count,
                "earlier than the one before, put in order",
            ),
            (counts.esl_damaged_count, "damaged, says the ET2000"),
            (
                counts.esl_port_unclear_count,
                "for which the ET2000 names no or several ports",
            ),
        ] {
            if count > 0 {
                lines.push(format!("  {count} {what}"));
            }
        }
        for point in &self.points {
            lines.push(String::new());
            lines.push(format!(
                "{}  at {}",
                stream_line(&point.stream),
                point.point
            ));
            if let Some(all) = point.kernel_stamped_count {
                lines.push(format!("  {all} arrived, of which"));
            }
            point_lines(&mut lines, &point.figures);
        }
        for joined in &self.joins {
            lines.push(String::new());
            lines.push(stream_line(&joined.stream));
            lines.push(format!("  from {} to {}", joined.first, joined.second));
            lines.push(format!("  clock       {}", joined.clocks.words()));
            join_lines(&mut lines, &joined.figures);
        }
        lines.join("\n") + "\n"
    }
}

fn file_report(file: &CaptureFile) -> FileReport {
    let names = file.interfaces.iter().enumerate();
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

fn file_line(file: &FileReport) -> String {
    let format = file.format.unwrap_or("unknown format");
    let dropped = match file.dropped_count {
        Some(count) => format!("{count} dropped by the kernel"),
        None => "drops unknown".to_owned(),
    };
    let faults = match file.fault_count {
        0 => String::new(),
        count => format!(", {count} faults"),
    };
    format!(
        "{}: {format}, {} packets on {}, {dropped}{faults}",
        file.path,
        file.packet_count,
        file.interfaces.join(" and ")
    )
}

fn stream_line(stream: &StreamReport) -> String {
    let own = match (stream.channel, stream.kind) {
        (Some(channel), Some(kind)) => format!(" channel {channel} {kind}"),
        _ => String::new(),
    };
    format!(
        "{}{own}  {} -> {}",
        stream.flow, stream.source, stream.destination
    )
}

fn point_lines(lines: &mut Vec<String>, figures: &PointMetrics) {
    let seconds = figures.last_ns.saturating_sub(figures.first_ns) as f64 * 1e-9;
    lines.push(format!(
        "  {} datagrams, {} bytes in {seconds:.3} s",
        figures.datagram_count, figures.payload_bytes
    ));
    lines.push(format!("  interval    {}", quantiles(&figures.interval)));
    if let Some(gap) = figures.longest_gap {
        let after = gap.from_ns.saturating_sub(figures.first_ns) as f64 * 1e-9;
        let length = time(gap.length_ns);
        lines.push(format!("  longest gap {length} after {after:.3} s"));
    }
    if let Some(numbers) = figures.numbers {
        let repeated = numbers.repeated_count;
        let repeated = repeated.map_or("unknown (pieces)".to_owned(), |count| count.to_string());
        lines.push(format!(
            "  numbers     {} series, step {}, {} skipped, {repeated} repeated, {} reordered",
            numbers.series_count, numbers.step, numbers.skipped_count, numbers.reordered_count
        ));
    }
}

fn join_lines(lines: &mut Vec<String>, figures: &JoinMetrics) {
    let order = match figures.order {
        OrderSource::PacketDirection => "by the packets' direction",
        OrderSource::Stamps => "by most stamps",
    };
    lines.push(format!(
        "  seen        {} then {} ({order}), {} at both, {} at an edge",
        figures.first_count, figures.second_count, figures.matched_count, figures.edge_count
    ));
    lines.push(format!(
        "  lost        {}{}, {} duplicated, {} unexplained",
        figures.lost_count,
        percent(figures.loss_ratio, figures.loss_interval),
        figures.duplicated_count,
        figures.unexplained_count
    ));
    if !figures.loss_bursts.is_empty() {
        let bursts = figures.loss_bursts.iter();
        let bursts = bursts.map(|(length, count)| format!("{count}x{length}"));
        let words: Vec<String> = bursts.collect();
        lines.push(format!("  loss bursts {}", words.join(" ")));
    }
    lines.push(format!("  delay       {}", quantiles(&figures.delay)));
    for (name, interval) in [
        ("p50", figures.delay_p50_interval),
        ("p99", figures.delay_p99_interval),
    ] {
        if let Some(spread) = interval {
            #[expect(clippy::cast_possible_truncation, reason = "two of the delays")]
            let ends = spread
                .known()
                .map(|one| [one.low, one.high].map(|ns| time(ns as i64)));
            let words = ends.map_or_else(String::new, |[low, high]| format!("{low} to {high}; "));
            lines.push(format!("    {name} 95 %: {words}{spread}"));
        }
    }
    lines.push(format!(
        "  variation   {} (RFC 5481)",
        quantiles(&figures.variation)
    ));
    if let (Some(last), Some(mean)) = (figures.jitter_last_ns, figures.jitter_mean_ns) {
        let (last, mean) = (last * 1e-3, mean * 1e-3);
        lines.push(format!(
            "  jitter      {last:.2} us at the end, {mean:.2} us mean (RFC 3550)"
        ));
    }
    lines.push(format!(
        "  reordered   {}, extent at most {} (RFC 4737)",
        figures.reordered_count, figures.reordering_extent_max
    ));
}

fn percent(ratio: Option<f64>, interval: Option<Spread>) -> String {
    let mut text = String::new();
    if let Some(ratio) = ratio {
        // Writing to a string cannot fail.
        let _infallible = write!(text, " = {:.4} %", 100.0 * ratio).is_ok();
    }
    match interval {
        Some(Spread::Known(one)) => {
            let (low, high) = (100.0 * one.low, 100.0 * one.high);
            let _infallible = write!(text, " ({low:.4} to {high:.4} %, 95 %)").is_ok();
        }
        Some(Spread::Unknown(why)) => {
            let _infallible = write!(text, " ({why})").is_ok();
        }
        None => {}
    }
    text
}

/// Nanoseconds in a unit of at most four digits before the point.
pub(super) fn time(ns: i64) -> String {
    match ns.unsigned_abs() {
        0..10_000_000 => format!("{:.2} us", ns as f64 * 1e-3),
        10_000_000..10_000_000_000 => format!("{:.2} ms", ns as f64 * 1e-6),
        _ => format!("{:.3} s", ns as f64 * 1e-9),
    }
}

pub(super) fn quantiles(distribution: &Distribution) -> String {
    match distribution {
        Distribution::Unavailable { reason } => format!("unavailable: {reason}"),
        Distribution::Measured(one) => format!(
            "min {}  p50 {}  p99 {}  p99.9 {}  max {}",
            time(one.min_ns),
            time(one.p50_ns),
            time(one.p99_ns),
            time(one.p999_ns),
            time(one.max_ns)
        ),
    }
}
