//! The passive probe: looks at the wire in a process of its own and holds its figures against the
//! gateways'. It takes no part in any run. Packets are understood in [`hil_capture`].
#![forbid(unsafe_code)]

mod analyse;
pub mod arguments;
mod compare;
mod files;
mod live;
mod nic_tap;
mod output;
mod point_clocks;

use std::fs;
use std::path::Path;
use std::time::Duration;

use hil_capture::flow::FlowFilter;
use hil_capture::join::JoinSettings;
use hil_core::time::duration_ns;
use hil_net::filter::FILTER_COUNT_MAX;
use hil_net::packet_ring::{RingError, RingStamps};

use self::analyse::{Reading, Report};
use self::arguments::{LiveArgs, ProbeArgs, ProbeWork, ReadingArgs, Stamps};
use self::live::{InterfaceResult, LiveError, LiveResult, Request};
use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_platform::signals::{EXIT_INTERRUPTED, Signals};
use hil_platform::text::grouped;
use hil_present::terminal::canvas::Style;
use hil_present::terminal::render;
use hil_present::{Section, Tone};
use hil_report::study::probed;

/// Exit codes; the command's help lists them.
mod exit {
    pub(crate) const DONE: u8 = 0;
    pub(crate) const GAPS: u8 = 1;
    pub(crate) const USAGE: u8 = 2;
    pub(crate) const NO_INTERFACE: u8 = 69;
    pub(crate) const INTERNAL: u8 = 70;
    pub(crate) const HOST_UNFIT: u8 = 78;
}

/// Does what the command line says, on a page of `columns`, and gives the exit code.
pub fn run(args: &ProbeArgs, columns: usize, console: &mut Console) -> u8 {
    let text = |sections: &[Section]| render(sections, columns, Style::Coloured);
    match &args.work {
        None => {
            console.set_quiet(args.live.quiet);
            capture(&args.live, &text, console)
        }
        Some(ProbeWork::Analyse {
            file,
            second,
            one_clock,
            reading,
        }) => {
            let paths = paths(file, second.as_deref());
            analyse(&paths, reading, *one_clock, &text, console)
        }
        Some(ProbeWork::Compare {
            run,
            file,
            second,
            limit,
            keep,
            reading,
        }) => {
            // What is to be kept is kept also after Ctrl-C: a recording has no captures later.
            let signals = keep.then(Signals::install);
            if let Some(Err(error)) = &signals {
                console.error(&format!("cannot handle signals: {error}"));
                return exit::INTERNAL;
            }
            let paths = paths(file, second.as_deref());
            let Some(captures) = read(&paths, reading, console) else {
                return exit::USAGE;
            };
            for complaint in captures.complaints() {
                console.warn(&complaint);
            }
            let words = "reading records of the run";
            let compared = Progress::begin().during(console, words, |stage| {
                compare::compare(run, &captures, &settings(reading, false), stage)
            });
            match compared {
                Ok(comparison) => {
                    console.result(&if reading.json {
                        json(&comparison)
                    } else {
                        text(&comparison.sections(*limit))
                    });
                    if *keep && let Err(error) = probed::write(run, &comparison.probed) {
                        let path = run.join(probed::FILE);
                        console.error(&format!("{}: {error}", path.display()));
                        return exit::INTERNAL;
                    }
                    if comparison.agrees_within(*limit) && !captures.has_gaps() {
                        exit::DONE
                    } else {
                        exit::GAPS
                    }
                }
                Err(error) => {
                    console.error(&error.to_string());
                    exit::USAGE
                }
            }
        }
    }
}

fn paths<'a>(file: &'a Path, second: Option<&'a Path>) -> Vec<&'a Path> {
    core::iter::once(file).chain(second).collect()
}

fn json(value: &impl serde::Serialize) -> String {
    let text = serde_json::to_string_pretty(value);
    format!("{}\n", text.expect("figures are numbers and words"))
}

fn settings(reading: &ReadingArgs, is_one_clock: bool) -> JoinSettings {
    JoinSettings {
        window_ns: duration_ns(reading.window),
        is_one_clock,
    }
}

/// The flows asked for, or our own.
fn flows(asked: &[FlowFilter]) -> Vec<FlowFilter> {
    if asked.is_empty() {
        vec![FlowFilter::hil()]
    } else {
        asked.to_vec()
    }
}

fn read(paths: &[&Path], reading: &ReadingArgs, console: &mut Console) -> Option<Reading> {
    let flows = flows(&reading.flow);
    let sizes = paths.iter().filter_map(|path| fs::metadata(path).ok());
    let all_bytes: u64 = sizes.map(|one| one.len()).sum();
    let captures = Progress::begin().during(console, "reading packets", |stage| {
        let mut read_bytes = 0;
        Reading::of(paths, &flows, &mut |bytes| {
            read_bytes += bytes;
            // A pipe does not tell how much will come.
            if all_bytes > 0 {
                stage.reach(read_bytes as f64 / all_bytes as f64);
            }
        })
    });
    match captures {
        Ok(captures) => Some(captures),
        Err(error) => {
            console.error(&error.to_string());
            None
        }
    }
}

fn analyse(
    paths: &[&Path],
    reading: &ReadingArgs,
    is_one_clock: bool,
    text: &dyn Fn(&[Section]) -> String,
    console: &mut Console,
) -> u8 {
    let Some(captures) = read(paths, reading, console) else {
        return exit::USAGE;
    };
    let report = Progress::begin().during(console, "drawing up the figures", |_| {
        Report::of(&captures, &settings(reading, is_one_clock))
    });
    let mut complaints = captures.complaints();
    complaints.extend(report.complaints());
    for complaint in &complaints {
        console.warn(complaint);
    }
    if report.is_empty() && !complaints.is_empty() {
        return exit::USAGE;
    }
    let nothing = captures.nothing_followed();
    if let Some(words) = &nothing {
        console.warn(words);
    }
    console.result(&if reading.json {
        json(&report)
    } else {
        text(&report.sections())
    });
    if nothing.is_some() || captures.has_gaps() || report.has_doubts() {
        exit::GAPS
    } else {
        exit::DONE
    }
}

fn capture(args: &LiveArgs, text: &dyn Fn(&[Section]) -> String, console: &mut Console) -> u8 {
    let Some(output) = &args.output else {
        console.error("no --output FILE given for the capture; try --help");
        return exit::USAGE;
    };
    if args.interface.is_empty() {
        console.error("no --interface given; `ip link` lists those of this host");
        return exit::USAGE;
    }
    let again = (1..args.interface.len())
        .map(|index| &args.interface[index])
        .zip(1..)
        .find(|(name, index)| args.interface[..*index].contains(name));
    if let Some((name, _)) = again {
        console.error(&format!(
            "--interface {name} is given twice; one tap sees all there is"
        ));
        return exit::USAGE;
    }
    if args.flow.len() > FILTER_COUNT_MAX {
        console.error(&format!(
            "{} flows are more than the {FILTER_COUNT_MAX} one probe follows",
            args.flow.len()
        ));
        return exit::USAGE;
    }
    let flows = flows(&args.flow);
    let needed = flows.iter().map(FlowFilter::snap_bytes).max().unwrap_or(0);
    let request = Request {
        interfaces: args.interface.clone(),
        output: output.clone(),
        replaces: args.force,
        duration: args.duration,
        snap_bytes: args
            .snap_length
            .unwrap_or(u32::try_from(needed).unwrap_or(2048)),
        ring_bytes: usize::from(args.ring) << 20,
        stamps: match args.stamps {
            Stamps::Kernel => RingStamps::Kernel,
            Stamps::Card => RingStamps::Card,
        },
        flows,
    };
    let signals = match Signals::install() {
        Ok(signals) => signals,
        Err(error) => {
            console.error(&format!("cannot handle signals: {error}"));
            return exit::INTERNAL;
        }
    };
    match live::capture(&request, &signals, console) {
        Ok(result) => {
            console.result(&text(&captured(&request, &result)));
            code_of(&request, &result, console)
        }
        Err(error) => {
            console.error(&error.to_string());
            match error {
                LiveError::Ring(RingError::Interface { .. }) => exit::NO_INTERFACE,
                LiveError::Ring(RingError::Size { .. } | RingError::LinkLayer { .. })
                | LiveError::File { .. }
                | LiveError::Exists { .. } => exit::USAGE,
                LiveError::Ring(RingError::Rights { .. }) | LiveError::Card { .. } => {
                    exit::HOST_UNFIT
                }
                LiveError::Ring(RingError::Refused { .. }) | LiveError::Counters { .. } => {
                    exit::INTERNAL
                }
            }
        }
    }
}

/// What came of each interface, and of the file.
fn captured(request: &Request, result: &LiveResult) -> Vec<Section> {
    let mut sections: Vec<Section> = result.interfaces.iter().map(interface).collect();
    let mut file = Section::new("file", request.output.display().to_string(), "");
    let ended_by = result.ended_by.map(|by| format!(", ended by {by}"));
    file.note(
        Tone::Plain,
        format!(
            "{} bytes in {:.1} s{}",
            grouped(result.file_bytes),
            result.length.as_secs_f64(),
            ended_by.unwrap_or_default()
        ),
    );
    sections.push(file);
    sections
}

fn interface(one: &InterfaceResult) -> Section {
    let mut section = Section::new("interface", &one.name, "");
    let late = match one.late_stamp_count {
        0 => String::new(),
        count => format!(
            ", {} stamped by the tap instead of in the stack",
            grouped(count)
        ),
    };
    let end = if one.has_failed { ", interrupted" } else { "" };
    section.fact(
        "packets",
        Tone::Plain,
        format!(
            "{} in, {} out, {} dropped by the kernel{late}{end}",
            grouped(one.inbound_count),
            grouped(one.outbound_count),
            grouped(one.counters.dropped_count)
        ),
    );
    if let Some(card) = &one.card {
        section.fact(
            "card",
            Tone::Plain,
            format!(
                "{} of {} arrivals have the card's stamp, the others the kernel's alone; {} dropped by \
                 the kernel; {}; the card {}",
                grouped(card.stamped_count),
                grouped(card.stamped_count + card.unstamped_count),
                grouped(card.counters.dropped_count),
                card.granted,
                card.restoring
            ),
        );
    }
    section
}

fn code_of(request: &Request, result: &LiveResult, console: &mut Console) -> u8 {
    let dropped = result.interfaces.iter().map(|one| {
        let of_nic = one.card.as_ref();
        one.counters.dropped_count + of_nic.map_or(0, |card| card.counters.dropped_count)
    });
    let dropped_count: u64 = dropped.sum();
    let is_early = |planned: Duration| result.length < planned;
    if result.interfaces.iter().any(|one| one.has_failed) {
        console.warn("an interface failed while it was watched: the file has a gap from there on");
        exit::GAPS
    } else if dropped_count > 0 {
        console.warn("packets were dropped: the file has gaps; a larger --ring may help");
        exit::GAPS
    } else if result.ended_by.is_some() && request.duration.is_some_and(is_early) {
        u8::try_from(EXIT_INTERRUPTED).unwrap_or(exit::INTERNAL)
    } else {
        exit::DONE
    }
}
