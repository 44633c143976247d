//! The live capture: rings looked into every few milliseconds, a pcapng file, a line of progress.
//! It analyses nothing. Nothing waits for a packet, so that no sender pays for waking the probe.

use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use std::{io, thread};

use hil_capture::flow::FlowFilter;
use hil_capture::{CaptureInterface, writer};
use hil_net::Direction;
use hil_net::filter::PacketFilter;
use hil_net::packet_ring::{PacketRing, RingCounters, RingError, RingSettings, RingStamps};
use hil_net::ring_frame::StampSource;

use super::nic_tap::{NicResult, NicTap};
use super::output::{Output, append};
use hil_platform::console::Console;
use hil_platform::signals::Signals;

/// Time between two looks into the rings.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Time between two lines of progress.
const PROGRESS_PERIOD: Duration = Duration::from_secs(1);

/// What to capture.
#[derive(Debug)]
pub(super) struct Request {
    pub(super) interfaces: Vec<String>,
    pub(super) output: PathBuf,
    /// Whether the output may replace a file.
    pub(super) replaces: bool,
    pub(super) flows: Vec<FlowFilter>,
    pub(super) duration: Option<Duration>,
    pub(super) snap_bytes: u32,
    pub(super) ring_bytes: usize,
    /// Whose stamps the file is to have, besides the kernel's.
    pub(super) stamps: RingStamps,
}

/// Why a capture failed. What was written until then is a file of whole blocks.
#[derive(Debug, thiserror::Error)]
pub(super) enum LiveError {
    #[error(transparent)]
    Ring(#[from] RingError),
    #[error("the card of {interface} gives no stamps: {reason}")]
    Card { interface: String, reason: String },
    #[error("capture file {path}: {source}")]
    File { path: PathBuf, source: io::Error },
    #[error("{path}: exists; say --force")]
    Exists { path: PathBuf },
    #[error("the kernel does not tell what it dropped on {interface}: {source}")]
    Counters {
        interface: String,
        source: io::Error,
    },
}

/// What was captured on one interface.
#[derive(Debug, Clone, Default)]
pub(super) struct InterfaceResult {
    pub(super) name: String,
    pub(super) inbound_count: u64,
    pub(super) outbound_count: u64,
    /// Stamped by the tap itself, because the kernel had not yet.
    pub(super) late_stamp_count: u64,
    pub(super) counters: RingCounters,
    /// The interface was taken down or has gone.
    pub(super) has_failed: bool,
    /// Of its card, if that was asked for stamps.
    pub(super) card: Option<NicResult>,
}

/// How a capture ended.
#[derive(Debug)]
pub(super) struct LiveResult {
    pub(super) interfaces: Vec<InterfaceResult>,
    pub(super) length: Duration,
    pub(super) file_bytes: u64,
    /// The signal that ended it.
    pub(super) ended_by: Option<&'static str>,
}

struct Tap {
    ring: PacketRing,
    card: Option<NicTap>,
    /// Number of the interface when it was opened: names are given anew.
    index: Option<u32>,
    /// When the interface had gone, nanoseconds since 1970.
    gone_ns: Option<u64>,
    result: InterfaceResult,
}

/// Captures until the time is over or a signal comes.
pub(super) fn capture(
    request: &Request,
    signals: &Signals,
    console: &mut Console,
) -> Result<LiveResult, LiveError> {
    let mut taps = open_taps(request, console)?;
    let mut file = Output::create(&request.output, request.replaces)?;
    begin(&mut taps)?;
    let start_ns = realtime_ns();
    describe(file.buffer(), request, &taps);
    file.write_out()?;
    let began = Instant::now();
    let room = taps.iter().map(|tap| tap.ring.frame_count()).min();
    console.say(&format!(
        "probing {} for {}; room for {} packets each; Ctrl-C ends",
        request.interfaces.join(" and "),
        flow_list(&request.flows),
        room.unwrap_or(0),
    ));
    let tap_count = u32::try_from(taps.len()).unwrap_or(u32::MAX);
    let mut progress_due = began + PROGRESS_PERIOD;
    let (ended_by, end_ns) = loop {
        let ended_by = signals.received();
        let is_over = ended_by.is_some() || request.duration.is_some_and(|d| began.elapsed() >= d);
        let look_ns = realtime_ns();
        for (index, tap) in (0_u32..).zip(&mut taps) {
            drain(tap, index, tap_count, &mut file)?;
            if is_over {
                // See `begin`.
                drain(tap, index, tap_count, &mut file)?;
            }
            watch(tap, look_ns, console);
        }
        if is_over || taps.iter().all(|tap| tap.gone_ns.is_some()) {
            break (ended_by, look_ns);
        }
        if Instant::now() >= progress_due {
            progress_due += PROGRESS_PERIOD;
            file.write_out()?;
            show(&mut taps, began.elapsed(), file.written_bytes(), console)?;
        }
        thread::sleep(LOOK_PERIOD);
    };
    conclude(&mut taps, start_ns, end_ns, &mut file)?;
    file.finish()?;
    Ok(LiveResult {
        interfaces: taps.into_iter().map(|tap| tap.result).collect(),
        length: began.elapsed(),
        file_bytes: file.written_bytes(),
        ended_by,
    })
}

fn open_taps(request: &Request, console: &mut Console) -> Result<Vec<Tap>, LiveError> {
    let settings = RingSettings {
        snap_bytes: request.snap_bytes,
        ring_bytes: request.ring_bytes,
        stamps: RingStamps::Kernel,
    };
    let filters: Vec<PacketFilter> = request.flows.iter().map(|flow| flow.packets).collect();
    let mut taps: Vec<Tap> = Vec::with_capacity(request.interfaces.len());
    for name in &request.interfaces {
        let index = nix::net::if_::if_nametoindex(name.as_str()).ok();
        let ring = PacketRing::open(name, &filters, &settings)?;
        let card = match request.stamps {
            RingStamps::Kernel => None,
            RingStamps::Card => {
                let is_guarded = taps.iter().any(|tap| tap.result.name == *name);
                let card = NicTap::open(name, is_guarded, &filters, &settings)?;
                let granted = format!("{name}: the card grants {}", card.granted());
                if card.stamps_all_arrivals() {
                    console.say(&granted);
                } else {
                    console.warn(&granted);
                }
                Some(card)
            }
        };
        taps.push(Tap {
            ring,
            card,
            index,
            gone_ns: None,
            result: InterfaceResult {
                name: name.clone(),
                ..InterfaceResult::default()
            },
        });
    }
    Ok(taps)
}

/// Lets all taps begin together. While a card is set up, behind a guard process of its own, the taps
/// that are open already hear packets: kept, an interface's two parts would not be of the same packets.
/// What arrives between the looks into an interface's two rings is in one part only. The second look is
/// into rings that are nearly empty, so that this is short; the card's ring is the later one here and the
/// earlier one at the end, so that the card's part has no packet that the kernel's has not.
fn begin(taps: &mut [Tap]) -> Result<(), LiveError> {
    for _look in 0..2 {
        for tap in &mut *taps {
            told(tap.ring.begin(), &tap.result.name)?;
            if let Some(card) = &mut tap.card {
                card.begin()?;
            }
        }
    }
    Ok(())
}

/// Writes what was counted and puts the cards back. That takes a while, in which taps go on counting what
/// is in no file: all are asked before.
fn conclude(
    taps: &mut [Tap],
    start_ns: u64,
    end_ns: u64,
    file: &mut Output,
) -> Result<(), LiveError> {
    for tap in &mut *taps {
        count(tap)?;
    }
    for card in taps.iter_mut().filter_map(|tap| tap.card.as_mut()) {
        card.end();
    }
    let tap_count = u32::try_from(taps.len()).unwrap_or(u32::MAX);
    for (index, tap) in (0_u32..).zip(taps) {
        let RingCounters {
            matched_count,
            dropped_count,
        } = tap.result.counters;
        let to_ns = tap.gone_ns.unwrap_or(end_ns).max(start_ns);
        let buffer = file.buffer();
        writer::statistics(
            buffer,
            index,
            start_ns,
            to_ns,
            matched_count,
            dropped_count,
            None,
        );
        if let Some(card) = tap.card.take() {
            let index = tap_count + index;
            tap.result.card = Some(card.finish(index, start_ns, to_ns, buffer));
        }
    }
    Ok(())
}

/// Interfaces first, then their cards in the same order.
fn describe(buffer: &mut Vec<u8>, request: &Request, taps: &[Tap]) {
    let application = concat!("hil-runtime probe ", env!("CARGO_PKG_VERSION"));
    let system = nix::sys::utsname::uname().ok();
    let release = system.map(|names| format!("Linux {}", names.release().to_string_lossy()));
    writer::begin(buffer, application, release.as_deref().unwrap_or("Linux"));
    for tap in taps {
        let interface = CaptureInterface {
            name: Some(tap.result.name.clone()),
            link_type: tap.ring.link_type(),
            snap_bytes: request.snap_bytes,
            ..CaptureInterface::default()
        };
        writer::interface(buffer, &interface, &flow_list(&request.flows));
    }
    for card in taps.iter().filter_map(|tap| tap.card.as_ref()) {
        card.describe(buffer, request.snap_bytes, &request.flows);
    }
}

pub(super) fn flow_list(flows: &[FlowFilter]) -> String {
    let names: Vec<String> = flows.iter().map(ToString::to_string).collect();
    names.join(" or ")
}

/// Everything that is in the ring now.
fn drain(tap: &mut Tap, index: u32, tap_count: u32, file: &mut Output) -> Result<(), LiveError> {
    if let Some(card) = &mut tap.card {
        card.drain(tap_count + index, file)?;
    }
    let link_type = tap.ring.link_type();
    let Tap { ring, result, .. } = tap;
    // A ring that fills as fast as it is emptied must not keep the others waiting.
    for _ in 0..ring.frame_count() {
        let buffer = file.buffer();
        let is_there = ring.next_packet(|packet| {
            let is_outbound = packet.direction == Direction::Outbound;
            result.outbound_count += u64::from(is_outbound);
            result.inbound_count += u64::from(!is_outbound);
            result.late_stamp_count += u64::from(packet.source == StampSource::Tap);
            append(buffer, index, packet, link_type);
        });
        if !is_there {
            break;
        }
        file.write_if_full()?;
    }
    Ok(())
}

/// Says what has happened to the interface of a tap, once. One that is down may come up again, under
/// another name too; one that has gone does not come back under its number.
fn watch(tap: &mut Tap, now_ns: u64, console: &mut Console) {
    if tap.gone_ns.is_some() {
        return;
    }
    let told = tap.ring.check().err();
    // Of an interface that was down before, the kernel does not tell a packet ring that it has gone.
    let is_gone = (told.is_some() || tap.result.has_failed) && !is_there(tap.index);
    if told.is_none() && !is_gone {
        return;
    }
    tap.result.has_failed = true;
    let what = if is_gone {
        tap.gone_ns = Some(now_ns);
        "it has gone, and its part of the capture ends here"
    } else {
        "nothing is captured until it is up again"
    };
    let why = told.map_or_else(String::new, |error| format!("{error}: "));
    console.warn(&format!("{}: {why}{what}", tap.result.name));
}

/// Whether there is an interface of this number. For one that is missing `nix` gives an empty name.
fn is_there(index: Option<u32>) -> bool {
    let name = index.map(nix::net::if_::if_indextoname);
    name.is_some_and(|name| name.is_ok_and(|name| !name.is_empty()))
}

fn count(tap: &mut Tap) -> Result<(), LiveError> {
    tap.result.counters = told(tap.ring.counters(), &tap.result.name)?;
    if let Some(card) = &mut tap.card {
        card.count()?;
    }
    Ok(())
}

/// What the kernel counted, if it told.
pub(super) fn told<T>(counters: io::Result<T>, interface: &str) -> Result<T, LiveError> {
    counters.map_err(|source| LiveError::Counters {
        interface: interface.to_owned(),
        source,
    })
}

fn show(
    taps: &mut [Tap],
    elapsed: Duration,
    written_bytes: u64,
    console: &mut Console,
) -> Result<(), LiveError> {
    let mut parts = Vec::with_capacity(taps.len());
    for tap in taps {
        count(tap)?;
        let result = &tap.result;
        parts.push(format!(
            "{} {} in {} out {} dropped",
            result.name, result.inbound_count, result.outbound_count, result.counters.dropped_count
        ));
    }
    console.progress(&format!(
        "{:.0} s | {} | {:.1} MB",
        elapsed.as_secs_f64(),
        parts.join(" | "),
        written_bytes as f64 * 1e-6
    ));
    Ok(())
}

/// Nanoseconds since 1970, the clock of the kernel's stamps.
fn realtime_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |time| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_is_known_by_its_number() {
        let loopback = nix::net::if_::if_nametoindex("lo").ok();
        assert!(loopback.is_some() && is_there(loopback));
        assert!(!is_there(Some(0x7fff_fff0)), "nothing has that number");
        assert!(!is_there(None));
    }
}
