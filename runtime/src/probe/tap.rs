//! Which engine taps an interface, and what person and file are told of it.

use clap::ValueEnum;
use hil_gateways::capture::flow::FlowFilter;
use hil_gateways::transport::live_tap::{LiveTap, TapEngine};
use hil_gateways::transport::packet_ring::{RingError, RingSettings};

/// What takes the packets, as the command line asks for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TapChoice {
    /// eBPF programs where the kernel grants them, otherwise a packet ring.
    Auto,
    /// eBPF programs (TCX, Linux 6.6): the least cost to what is watched.
    Bpf,
    /// A packet ring (`AF_PACKET`): departures are stamped behind the queueing discipline.
    Packet,
}

/// Opens a tap; gives it with what took it, in words, and whether the person who watches should know
/// at once: it is second best, or others come before it.
pub(super) fn open(
    choice: TapChoice,
    interface: &str,
    flows: &[FlowFilter],
    settings: &RingSettings,
) -> Result<(LiveTap, String, bool), RingError> {
    let by = |engine| LiveTap::open(engine, interface, flows, settings);
    let (tap, reason) = match choice {
        TapChoice::Auto => LiveTap::open_cheapest(interface, flows, settings)?,
        TapChoice::Bpf => (by(TapEngine::Bpf)?, None),
        TapChoice::Packet => (by(TapEngine::Packet)?, None),
    };
    let earlier_count = tap.earlier_program_count();
    let words = in_words(tap.engine(), earlier_count, reason.as_ref());
    Ok((tap, words, reason.is_some() || earlier_count > 0))
}

fn in_words(engine: TapEngine, earlier_count: u32, reason: Option<&RingError>) -> String {
    match (engine, reason) {
        (TapEngine::Bpf, _) => format!(
            "tapped by eBPF programs, what leaves stamped by them before the queueing discipline{}",
            earlier(earlier_count)
        ),
        (TapEngine::Packet, None) => "tapped by a packet ring".to_owned(),
        (TapEngine::Packet, Some(reason)) => format!("tapped by a packet ring: {reason}"),
    }
}

/// Programs that were at the interface before, and may hide departures.
fn earlier(count: u32) -> String {
    let whose = match count {
        0 => return String::new(),
        1 => "1 other program (TCX) sees what leaves".to_owned(),
        several => format!("{several} other programs (TCX) see what leaves"),
    };
    format!("; {whose} before them and may keep packets from them")
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn the_second_best_says_why() {
        let reason = RingError::Program {
            interface: "eth0".to_owned(),
            step: "attaching its program",
            source: io::Error::from_raw_os_error(22),
            hint: " (Linux 6.6 is the first that can)",
        };
        assert_eq!(
            in_words(TapEngine::Packet, 0, Some(&reason)),
            "tapped by a packet ring: no eBPF tap on `eth0`: attaching its program: Invalid argument \
             (os error 22) (Linux 6.6 is the first that can)"
        );
        let plain = in_words(TapEngine::Packet, 0, None);
        assert_eq!(plain, "tapped by a packet ring");
    }

    #[test]
    fn programs_that_come_before_are_told() {
        let alone = in_words(TapEngine::Bpf, 0, None);
        assert!(
            alone.contains("eBPF") && !alone.contains("other"),
            "{alone}"
        );
        for (count, words) in [
            (1, "; 1 other program (TCX) sees what leaves before them"),
            (3, "; 3 other programs (TCX) see what leaves before them"),
        ] {
            let text = in_words(TapEngine::Bpf, count, None);
            assert!(text.contains(words), "{text}");
        }
    }
}
