//! What the driver of a card was told: how long it gathers packets before it interrupts, and how many
//! it can hold. Asked over ethtool's netlink family; nothing is set.

use nix::sys::socket::SockProtocol;

use super::Finding;
use super::finding::Severity;
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

/// What an interface answers; each in words where it does not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Driver {
    coalescing: Result<Coalescing, String>,
    ring: Result<Ring, String>,
}

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

/// Asks one driver after the other over one socket; what keeps it from that is every answer.
pub(super) fn asker() -> impl FnMut(&str) -> Driver {
    let mut opened = open();
    move |interface| match &mut opened {
        Ok((talk, family)) => Driver {
            coalescing: ask(talk, *family, COALESCE_GET, interface, Coalescing::decode),
            ring: ask(talk, *family, RINGS_GET, interface, Ring::decode),
        },
        Err(reason) => Driver {
            coalescing: Err(reason.clone()),
            ring: Err(reason.clone()),
        },
    }
}

fn open() -> Result<(Conversation, u16), String> {
    let words = |error: std::io::Error| format!("netlink: {error}");
    let mut talk = Conversation::open(SockProtocol::NetlinkGeneric).map_err(words)?;
    let found = talk.family(b"ethtool\0", b"").map_err(words)?;
    let (family, _) = found.ok_or("this kernel has no ethtool netlink (Linux 5.6 brought it)")?;
    Ok((talk, family))
}

fn ask<T>(
    talk: &mut Conversation,
    family: u16,
    command: u8,
    interface: &str,
    decode: fn(Attributes<'_>) -> Option<T>,
) -> Result<T, String> {
    let mut name = interface.as_bytes().to_vec();
    name.push(0);
    if name.len() > libc::IFNAMSIZ {
        return Err("a name too long".to_owned());
    }
    let header = encode_attributes(&[(HEADER_DEVICE_NAME, &name)]);
    let answer = talk.ask(
        family,
        command,
        false,
        &[(HEADER, &header)],
        |_, attributes| decode(attributes),
    );
    match answer {
        Ok(found) => found
            .into_iter()
            .next()
            .ok_or_else(|| "the driver answered without the figures".to_owned()),
        Err(error) if error.raw_os_error() == Some(libc::EOPNOTSUPP) => {
            Err("its driver has no such setting".to_owned())
        }
        Err(error) => Err(error.to_string()),
    }
}

impl Coalescing {
    fn decode(attributes: Attributes<'_>) -> Option<Self> {
        let word = |number| attributes.find(number).and_then(|bytes| u32_at(bytes, 0));
        let (rx_us, tx_us) = (word(COALESCE_RX_US), word(COALESCE_TX_US));
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
        let word = |number| attributes.find(number).and_then(|bytes| u32_at(bytes, 0));
        Some(Self {
            places: word(RINGS_RX)?,
            places_max: word(RINGS_RX_MAX)?,
        })
    }
}

/// The two findings of an interface that has a device behind it.
pub(super) fn examine(interface: &str, driver: &Driver) -> Vec<Finding> {
    vec![
        coalescing(driver.coalescing.as_ref()).of(interface),
        ring(driver.ring.as_ref()).of(interface),
    ]
}

fn coalescing(found: Result<&Coalescing, &String>) -> Finding {
    let id = "coalescing";
    let found = match found {
        Ok(found) => found,
        Err(reason) => return Finding::cannot_tell(id, reason),
    };
    let in_words = |us: Option<u32>| us.map_or("unknown".to_owned(), |us| format!("{us} us"));
    let (rx, tx) = (in_words(found.rx_us), in_words(found.tx_us));
    let adaptive = if found.is_adaptive {
        ", adaptive: it changes with the traffic"
    } else {
        ""
    };
    let value = format!("receive {rx}, send {tx}{adaptive}");
    let longest = found.rx_us.max(found.tx_us).unwrap_or(0);
    let severity = if found.is_adaptive || longest > COALESCING_US_NOTE {
        Severity::Warning
    } else if longest > COALESCING_US_OK {
        Severity::Note
    } else {
        Severity::Ok
    };
    Finding::new(id, severity, value)
}

fn ring(found: Result<&Ring, &String>) -> Finding {
    let id = "ring";
    let found = match found {
        Ok(found) => found,
        Err(reason) => return Finding::cannot_tell(id, reason),
    };
    let value = format!("{} places of at most {}", found.places, found.places_max);
    if found.places >= RING_MIN || found.places == found.places_max {
        Finding::ok(id, value)
    } else {
        Finding::note(id, value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn severities(driver: &Driver) -> [Severity; 2] {
        let findings = examine("eth0", driver);
        assert_eq!(findings[0].id, "coalescing.eth0");
        assert!(findings[0].fix.contains("ethtool -C eth0"), "{findings:?}");
        [findings[0].severity, findings[1].severity]
    }

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
        let driver = |us, is_adaptive, places| Driver {
            coalescing: Ok(Coalescing {
                rx_us: Some(us),
                tx_us: None,
                is_adaptive,
            }),
            ring: Ok(Ring {
                places,
                places_max: 4096,
            }),
        };
        let good = severities(&driver(0, false, 256));
        assert_eq!(good, [Severity::Ok, Severity::Ok]);
        let tuned = severities(&driver(5, false, 4096));
        assert_eq!(tuned, [Severity::Note, Severity::Ok]);
        let bad = severities(&driver(50, false, 64));
        assert_eq!(bad, [Severity::Warning, Severity::Note]);
        assert_eq!(severities(&driver(0, true, 64))[0], Severity::Warning);
        let silent = Driver {
            coalescing: Err("no".to_owned()),
            ring: Err("no".to_owned()),
        };
        let silent = severities(&silent);
        assert_eq!(silent, [Severity::CannotTell, Severity::CannotTell]);
    }

    #[test]
    fn loopback_says_that_it_has_neither() {
        let found = asker()("lo");
        assert!(
            found.coalescing.is_err() && found.ring.is_err(),
            "{found:?}"
        );
        let missing = asker()("no-such-device");
        assert!(missing.ring.is_err(), "{missing:?}");
    }
}
