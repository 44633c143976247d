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

/// Opens a tap; gives it with what took it, in words, and whether that is second best.
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
    let words = in_words(tap.engine(), reason.as_ref());
    Ok((tap, words, reason.is_some()))
}

fn in_words(engine: TapEngine, reason: Option<&RingError>) -> String {
    match (engine, reason) {
        (TapEngine::Bpf, _) => {
            "tapped by eBPF programs, what leaves stamped by them before the queueing discipline"
                .to_owned()
        }
        (TapEngine::Packet, None) => "tapped by a packet ring".to_owned(),
        (TapEngine::Packet, Some(reason)) => format!("tapped by a packet ring: {reason}"),
    }
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
            in_words(TapEngine::Packet, Some(&reason)),
            "tapped by a packet ring: no eBPF tap on `eth0`: attaching its program: Invalid argument \
             (os error 22) (Linux 6.6 is the first that can)"
        );
        let plain = in_words(TapEngine::Packet, None);
        assert_eq!(plain, "tapped by a packet ring");
        assert!(in_words(TapEngine::Bpf, None).contains("eBPF"));
    }
}
