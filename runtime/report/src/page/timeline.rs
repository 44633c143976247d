//! Figures over time: the network and the robot on the axis of the run, and the case's own series on
//! theirs.

use core::ops::Range;

use hil_account::network::network_series_name;
use hil_core::case_study::Severity;

use super::charts::time::{Mark, MarkClass, over_time};
use super::series::{Plot, PlotPanel, Series, Thinned, thinned};
use crate::link_change::LinkChange;
use crate::network::{NetworkQuantity, NetworkReport, TimelineRow, TimelineSubject};
use crate::score_event::{ExplainedEvent, ScoreEvents};
use hil_platform::text::grouped;
use hil_present::Drawing;
use hil_present::units::{duration_s, scale};

/// Lines of one panel; a series with more columns gets more panels.
const LINES_MAX: usize = 7;
/// Panels of the case's own series.
const CASE_PANELS_MAX: usize = 12;
/// Outages shaded in the panels of the network.
const BANDS_MAX: usize = 300;

/// Network and robot on one axis.
pub(super) fn over_run(
    key: &str,
    report: &NetworkReport,
    events: &ScoreEvents,
    changes: &[LinkChange],
    series: &[Series],
    point_count: usize,
) -> (Drawing, Plot) {
    let rows = &report.timeline.rows;
    let step_s = report.timeline.step_s;
    let ends = rows.iter().map(|row| row.values.len() as f64 * step_s);
    let until_s = ends.fold(0.0, f64::max);
    let span = 0.0..if until_s > 0.0 { until_s } else { 1.0 };
    let (mut panels, width_s) = network_panels(report, series, &span, point_count);
    for row in rows {
        let TimelineSubject::Robot { label } = &row.subject else {
            continue;
        };
        let (factor, unit) = scale(&row.unit);
        // A number of events has no unit; an error has.
        let (title, unit) = match unit {
            "1" => (format!("Robot: {label}"), "count"),
            unit => (format!("Robot: {label} ({unit})"), unit),
        };
        let mut series = of_row(label, row);
        for value in series.high.iter_mut().flatten() {
            *value *= factor;
        }
        panels.push(PlotPanel {
            title,
            unit: unit.to_owned(),
            series: vec![series],
        });
    }
    let bands = bands(report);
    let by_hand = changes.iter().filter_map(changed_at);
    let moments = events.events.iter().filter_map(moment);
    let moments: Vec<Mark> = moments.chain(by_hand).collect();
    let mut caption = run_caption(report, step_s, width_s, bands.len() == BANDS_MAX);
    if events.dropped_count > 0 {
        let marked = format!(
            " Marked: {} of {} events; the robot's series has all.",
            grouped(events.events.len() as u64),
            grouped(events.total_count())
        );
        caption.push_str(&marked);
    }
    let plot = Plot {
        axis: format!("{key}-run"),
        from_s: span.start,
        until_s: span.end,
        panels,
    };
    let name = format!("{key}-timeline");
    let title = report.timeline.title();
    let drawing = Drawing {
        svg: over_time(&name, title, &plot, &bands, &moments),
        name,
        title: title.to_owned(),
        caption,
        is_wide: true,
    };
    (drawing, plot)
}

/// What is shaded: outages and processes that were down; of too many the longest.
fn bands(report: &NetworkReport) -> Vec<Mark> {
    let outages = report.events.iter().filter(|event| event.is_outage());
    let mut outages: Vec<_> = outages.collect();
    if outages.len() > BANDS_MAX {
        outages.sort_by(|a, b| b.length_s().total_cmp(&a.length_s()));
        outages.truncate(BANDS_MAX);
    }
    outages
        .into_iter()
        .map(|event| Mark {
            from_s: event.from_s,
            until_s: event.until_s,
            class: MarkClass::Band,
            channel: event.channel.clone(),
            words: event.words(),
        })
        .collect()
}

fn run_caption(report: &NetworkReport, robot_s: f64, width_s: f64, is_cut: bool) -> String {
    let [above, robot] = if report.timeline.has_robot() {
        let robot = format!("; the robot's for {}", duration_s(robot_s));
        ["Above the network, below the robot. ".to_owned(), robot]
    } else {
        Default::default()
    };
    let mut caption = format!(
        "{above}Each point stands for up to {} and has the smallest and largest value within{robot}. Figures are \
         from all messages. Shaded: outages{}.",
        duration_s(width_s),
        if is_cut { ", the longest 300" } else { "" }
    );
    if report.clocks_differ {
        caption.push_str(
            " The hosts' clocks are not aligned: each host's times count from its own start of the run.",
        );
    } else if let Some(bound_s) = report.clock_bound_s.filter(|bound_s| *bound_s > 0.0) {
        let bound = duration_s(bound_s);
        caption.push_str(
            &[
                " Times of two hosts are known to ",
                &bound,
                " of each other.",
            ]
            .concat(),
        );
    }
    caption
}

fn moment(event: &ExplainedEvent) -> Option<Mark> {
    let class = match event.severity {
        Severity::Notice => MarkClass::Notice,
        Severity::Hazard => MarkClass::Hazard,
        Severity::Incident => MarkClass::Incident,
    };
    Some(Mark::moment(event.at_s?, class, event.what.clone()))
}

/// Refused changes changed nothing.
fn changed_at(change: &LinkChange) -> Option<Mark> {
    let at_s = change.at_s.filter(|_| change.is_in_force())?;
    Some(Mark::moment(at_s, MarkClass::Change, change.what()))
}

fn of_row(name: &str, row: &TimelineRow) -> Thinned {
    Thinned {
        name: name.to_owned(),
        channel: match &row.subject {
            TimelineSubject::Channel { channel, .. } => channel.clone(),
            TimelineSubject::Robot { .. } => String::new(),
        },
        high: row.values.clone(),
        low: Vec::new(),
    }
}

/// What of the network is drawn: title, unit, what the timeline has of it.
const PANELS: [(&str, &str, Option<NetworkQuantity>); 4] = [
    ("Delay, median", "s", None),
    ("Delay, largest", "s", Some(NetworkQuantity::Delay)),
    ("Share lost", "share", Some(NetworkQuantity::Loss)),
    ("Longest silence", "s", Some(NetworkQuantity::Silence)),
];

/// From the series where they are, else from the summary's timeline; with the width of a step.
fn network_panels(
    report: &NetworkReport,
    series: &[Series],
    span: &Range<f64>,
    steps: usize,
) -> (Vec<PlotPanel>, f64) {
    let mut panels: Vec<PlotPanel> = PANELS
        .iter()
        .map(|(title, unit, _)| PlotPanel {
            title: (*title).to_owned(),
            unit: (*unit).to_owned(),
            series: Vec::new(),
        })
        .collect();
    let mut width_s = 0.0_f64;
    for one in &report.channels {
        let channel = one.channel.as_str();
        let file = network_series_name(channel);
        let found = series.iter().find(|one| one.name == file);
        if let Some(found) = found.filter(|found| !found.rows.is_empty()) {
            let steps = steps.min(found.rows.len()).max(1);
            width_s = width_s.max((span.end - span.start) / steps as f64);
            // A channel that speaks seldom has no silence to tell of; see the summary's timeline.
            let told = |quantity: Option<NetworkQuantity>| {
                let mut rows = report.timeline.rows.iter();
                quantity.is_none_or(|quantity| rows.any(|row| row.subject.is_of(channel, quantity)))
            };
            let points = network_points(found).into_iter().zip(PANELS);
            for (panel, (points, (_, _, quantity))) in panels.iter_mut().zip(points) {
                if !told(quantity) {
                    continue;
                }
                let thin = thinned(channel, channel, points.into_iter(), span, steps);
                panel.series.push(thin);
            }
            continue;
        }
        width_s = width_s.max(report.timeline.step_s);
        for (panel, (_, _, quantity)) in panels.iter_mut().zip(PANELS) {
            let row = quantity.and_then(|quantity| {
                let mut rows = report.timeline.rows.iter();
                rows.find(|row| row.subject.is_of(channel, quantity))
            });
            panel.series.extend(row.map(|row| of_row(channel, row)));
        }
    }
    let has_values = |one: &Thinned| one.high.iter().any(Option::is_some);
    for panel in &mut panels {
        panel.series.retain(has_values);
    }
    panels.retain(|panel| !panel.series.is_empty());
    (panels, width_s)
}

/// Median delay, largest delay, share lost, silence; each at the middle of its bin.
fn network_points(series: &Series) -> [Vec<(f64, f64)>; 4] {
    let starts = series.rows.iter().filter_map(|row| *row.first()?);
    let width_s = match starts.take(2).collect::<Vec<_>>()[..] {
        [first, second] => second - first,
        _ => 0.0,
    };
    let column = |name: &str| -> Vec<(f64, f64)> {
        let index = series.column(name);
        let points = index.map(|index| series.points(index).collect::<Vec<_>>());
        let points = points.unwrap_or_default().into_iter();
        points
            .map(|(at, value)| (at + width_s / 2.0, value))
            .collect()
    };
    let lost = series.column("sent_count").zip(series.column("lost_count"));
    let share = |row: &Vec<Option<f64>>| {
        let (sent, lost) = lost?;
        let (sent, lost) = ((*row.get(sent)?)?, (*row.get(lost)?)?);
        (sent > 0.0).then_some(((*row.first()?)? + width_s / 2.0, lost / sent))
    };
    let shares = series.rows.iter().filter_map(share).collect();
    [
        column("delay_s_p50"),
        column("delay_s_max"),
        shares,
        column("silence_s_max"),
    ]
}

/// The case's own series over time.
fn timed_of_case(series: &[Series]) -> Vec<&Series> {
    let is_own = |one: &&Series| !one.name.starts_with("network-") && one.columns.len() > 1;
    let is_timed = |one: &&Series| {
        one.columns
            .first()
            .is_some_and(|column| column.name == "time_s")
    };
    series.iter().filter(is_own).filter(is_timed).collect()
}

/// Each of the case's own series over time as a picture of its own.
pub(super) fn each_of_case(key: &str, series: &[Series], steps: usize) -> Vec<Drawing> {
    let each = timed_of_case(series).into_iter();
    let drawn = each.filter_map(|one| {
        let name = format!("{key}-{}", one.name);
        let (drawn, _) = drawn(&name, &one.title, &[one], steps, usize::MAX);
        Some(drawn?.0)
    });
    drawn.collect()
}

/// The case's own series over time, on the axis that they name.
pub(super) fn of_case(
    key: &str,
    series: &[Series],
    steps: usize,
) -> (Option<(Drawing, Plot)>, Vec<String>) {
    let title = "The robot, as its case plots it";
    let timed = timed_of_case(series);
    drawn(
        &format!("{key}-robot"),
        title,
        &timed,
        steps,
        CASE_PANELS_MAX,
    )
}

/// The picture of `timed` in so many panels at most, and the files that found no room.
fn drawn(
    name: &str,
    title: &str,
    timed: &[&Series],
    steps: usize,
    panels_max: usize,
) -> (Option<(Drawing, Plot)>, Vec<String>) {
    let moments = timed
        .iter()
        .flat_map(|one| one.rows.iter().filter_map(|row| row.first().copied()?));
    let (from_s, until_s) = moments.fold((f64::MAX, f64::MIN), |(low, high), at| {
        (low.min(at), high.max(at))
    });
    if until_s <= from_s {
        return (None, Vec::new());
    }
    let (panels, left_out) = case_panels(timed, &(from_s..until_s), steps, panels_max);
    let axis_words = timed
        .iter()
        .map(|one| one.columns[0].label.as_str())
        .find(|words| !words.is_empty());
    let plot = Plot {
        axis: format!("{name}-case"),
        from_s,
        until_s,
        panels,
    };
    let caption = format!(
        "Axis: {}. Each point stands for {} and has the smallest and largest value within; all values \
         are in series/.",
        axis_words.unwrap_or("time_s of the series"),
        duration_s((until_s - from_s) / steps.max(1) as f64)
    );
    let drawing = Drawing {
        svg: over_time(name, title, &plot, &[], &[]),
        name: name.to_owned(),
        title: title.to_owned(),
        caption,
        is_wide: true,
    };
    (Some((drawing, plot)), left_out)
}

/// Panels of the case's series, and the files that found no room.
fn case_panels(
    timed: &[&Series],
    span: &Range<f64>,
    steps: usize,
    panels_max: usize,
) -> (Vec<PlotPanel>, Vec<String>) {
    let mut panels = Vec::new();
    let mut left_out = Vec::new();
    for one in timed {
        let columns: Vec<usize> = (1..one.columns.len()).collect();
        for chunk in columns.chunks(one.panel_lines.unwrap_or(LINES_MAX)) {
            if panels.len() == panels_max {
                left_out.push(format!("series/{}.csv", one.name));
                break;
            }
            let of = |column: &usize| {
                let label = &one.columns[*column];
                let words = if label.label.is_empty() {
                    &label.name
                } else {
                    &label.label
                };
                thinned(words, "", one.points(*column), span, steps)
            };
            let first = &one.columns[chunk[0]];
            let title = if one.title.is_empty() {
                &one.name
            } else {
                &one.title
            };
            panels.push(PlotPanel {
                title: format!(
                    "{title} ({})",
                    if first.unit.is_empty() {
                        "unit not said"
                    } else {
                        &first.unit
                    }
                ),
                unit: first.unit.clone(),
                series: chunk.iter().map(of).collect(),
            });
        }
    }
    (panels, left_out)
}
