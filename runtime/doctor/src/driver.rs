//! What the driver of a card was told: how long it gathers packets before it interrupts, and how many
//! it can hold. Asked over ethtool's netlink family; nothing is set.

use nix::sys::socket::SockProtocol;

use super::finding::{Answer, Checked, Finding, Severity, settled};
use hil_nic::radio::conversation::Conversation;
use hil_nic::radio::netlink::{Attributes, encode_attributes, u32_at};

/// Numbers of `linux/ethtool_netlink.h`.
const RINGS_GET: u8 = 15;
const COALESCE_GET: u8 = 19;
/// The header of a request, and in it the name of the interface; `NLA_F_NESTED` marks it.
const HEADER: u16 = 1 | 0x8000;
const HEADER_DEVICE_NAME: u16 = 2;
const RINGS_RX_MAX: u16 = 2;
const RINGS_RX: u16 = 6;
const COALESCE_RX_US: u16 = 2;
const COALESCE_TX_US: u16 = 6;
const COALESCE_ADAPTIVE_RX: u16 = 11;

/// Added to a delay without being worth a line.
const COALESCING_US_OK: u32 = 1;
/// More than the resolution of a software stamp.
const COALESCING_US_NOTE: u32 = 10;
/// Bursts of a few channels at 1 kHz, over a stall of the CPU of some milliseconds.
const RING_MIN: u32 = 128;

/// A socket to ask one driver after the other, with the number of the family; or why there is none.
pub(super) type Line = Result<(Conversation, u16), String>;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Coalescing {
    rx_us: Option<u32>,
    tx_us: Option<u32>,
    is_adaptive: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Ring {
    places: u32,
    places_max: u32,
}

pub(super) fn open() -> Line {
    let words = |error: std::io::Error| format!("netlink: {error}");
    let mut talk = Conversation::open(SockProtocol::NetlinkGeneric).map_err(words)?;
    let found = talk.family(b"ethtool\0", b"").map_err(words)?;
    let (family, _) = found.ok_or("this kernel has no ethtool netlink (Linux 5.6 brought it)")?;
    Ok((talk, family))
}

fn ask<T>(
    line: &mut Line,
    command: u8,
    interface: &str,
    decode: fn(Attributes<'_>) -> Option<T>,
) -> Result<T, String> {
    let (talk, family) = line.as_mut().map_err(|reason| reason.clone())?;
    let name = [interface.as_bytes(), b"\0"].concat();
    if name.len() > libc::IFNAMSIZ {
        return Err("a name too long".to_owned());
    }
    let header = encode_attributes(&[(HEADER_DEVICE_NAME, &name)]);
    let decode = |_, attributes: Attributes<'_>| decode(attributes);
    let answer = talk.ask(*family, command, false, &[(HEADER, &header)], decode);
    let found = answer.map_err(|error| match error.raw_os_error() {
        Some(libc::EOPNOTSUPP) => "its driver has no such setting".to_owned(),
        _ => error.to_string(),
    })?;
    let first = found.into_iter().next();
    first.ok_or("the driver answered without the figures".to_owned())
}

fn word(attributes: Attributes<'_>, number: u16) -> Option<u32> {
    u32_at(attributes.find(number)?, 0)
}

impl Coalescing {
    fn decode(attributes: Attributes<'_>) -> Option<Self> {
        let [rx_us, tx_us] = [COALESCE_RX_US, COALESCE_TX_US].map(|of| word(attributes, of));
        let adaptive = attributes.find(COALESCE_ADAPTIVE_RX);
        (rx_us.is_some() || tx_us.is_some()).then(|| Self {
            rx_us,
            tx_us,
            is_adaptive: adaptive.and_then(|bytes| bytes.first()) == Some(&1),
        })
    }
}

impl Ring {
    fn decode(attributes: Attributes<'_>) -> Option<Self> {
        Some(Self {
            places: word(attributes, RINGS_RX)?,
            places_max: word(attributes, RINGS_RX_MAX)?,
        })
    }
}

/// The two findings of an interface that has a device behind it.
pub(super) fn examine(interface: &str, line: &mut Line) -> [Finding; 2] {
    let coalescing = coalescing(ask(line, COALESCE_GET, interface, Coalescing::decode));
    let ring = ring(ask(line, RINGS_GET, interface, Ring::decode));
    [coalescing, ring].map(|checked| settled(checked).of(interface))
}

fn coalescing(found: Result<Coalescing, String>) -> Checked {
    let id = "coalescing";
    let found = found.told(id)?;
    let in_words = |us: Option<u32>| us.map_or("unknown".to_owned(), |us| format!("{us} us"));
    let (rx, tx) = (in_words(found.rx_us), in_words(found.tx_us));
    let longest_us = found.rx_us.max(found.tx_us).unwrap_or(0);
    let (severity, adaptive) = if found.is_adaptive {
        let words = ", adaptive: it changes with the traffic";
        (Severity::Warning, words)
    } else {
        let severity = Severity::rising(longest_us, COALESCING_US_OK, COALESCING_US_NOTE);
        (severity, "")
    };
    Ok(Finding::new(
        id,
        severity,
        format!("receive {rx}, send {tx}{adaptive}"),
    ))
}

fn ring(found: Result<Ring, String>) -> Checked {
    let id = "ring";
    let found = found.told(id)?;
    let value = format!("{} places of at most {}", found.places, found.places_max);
    let is_long = found.places >= RING_MIN || found.places == found.places_max;
    Ok(Finding::new(
        id,
        Severity::ok_if(is_long, Severity::Note),
        value,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_are_decoded_by_their_numbers() {
        let (fifty, eight) = (50_u32.to_ne_bytes(), 8_u32.to_ne_bytes());
        let answer = encode_attributes(&[
            (COALESCE_RX_US, &fifty),
            (COALESCE_TX_US, &eight),
            (COALESCE_ADAPTIVE_RX, &[1]),
        ]);
        let found = Coalescing::decode(Attributes::nested(&answer)).unwrap();
        assert_eq!((found.rx_us, found.tx_us), (Some(50), Some(8)));
        assert!(found.is_adaptive);
        assert_eq!(Coalescing::decode(Attributes::nested(&[])), None);
        let answer = encode_attributes(&[(RINGS_RX_MAX, &fifty), (RINGS_RX, &eight)]);
        let found = Ring::decode(Attributes::nested(&answer)).unwrap();
        assert_eq!((found.places, found.places_max), (8, 50));
    }

    #[test]
    fn waiting_cards_and_short_rings_are_told_and_silence_is_no_pass() {
        let severities = |us, is_adaptive, places| {
            let waits = coalescing(Ok(Coalescing {
                rx_us: Some(us),
                tx_us: None,
                is_adaptive,
            }));
            let holds = ring(Ok(Ring {
                places,
                places_max: 4096,
            }));
            [waits, holds].map(|checked| settled(checked).severity)
        };
        assert_eq!(severities(0, false, 256), [Severity::Ok, Severity::Ok]);
        assert_eq!(severities(5, false, 4096), [Severity::Note, Severity::Ok]);
        let bad = [Severity::Warning, Severity::Note];
        assert_eq!(severities(50, false, 64), bad);
        assert_eq!(severities(0, true, 64)[0], Severity::Warning);
        let silent = [coalescing(Err("no".to_owned())), ring(Err("no".to_owned()))];
        let silent = silent.map(|checked| settled(checked).severity);
        assert_eq!(silent, [Severity::CannotTell, Severity::CannotTell]);
    }

    #[test]
    fn loopback_says_that_it_has_neither() {
        let mut line = open();
        for name in ["lo", "no-such-device"] {
            let [waits, holds] = examine(name, &mut line);
            assert_eq!(waits.id, format!("coalescing.{name}"));
            let fix = format!("ethtool -C {name}");
            assert!(waits.fix.contains(&fix), "{waits:?}");
            for finding in [waits, holds] {
                assert_eq!(finding.severity, Severity::CannotTell, "{finding:?}");
            }
        }
    }
}
