//! `[processes.<name>.egm]`: a role of the case that is played by a foreign program speaking the
//! robot maker's own guided-motion datagrams (EGM). What the table says by itself is read here;
//! which of the two adapters it is follows from the case, see `check_adapter`.

use core::fmt;
use std::net::SocketAddr;

use hil_arm::egm::messages::Side;
use serde::{Deserialize, Serialize};
use toml::Table;

use super::clock_path::link_local_fault;
use super::errors::{Fault, Place};
use super::limits;
use super::model_links::Timestamps;
use super::reader::Reader;

/// A role played by a foreign EGM program.
#[derive(Debug, Clone, PartialEq)]
pub struct EgmAdapter {
    /// Which side of the protocol we are.
    pub kind: AdapterKind,
    /// Right arm: where the foreign program listens (robot adapter) or where we do (sensor adapter).
    pub right: Option<SocketAddr>,
    /// Left arm, as `right`.
    pub left: Option<SocketAddr>,
    /// Joints of an arm on the wire, 6 or 7.
    pub axes: u8,
    /// Generation of the robot's software whose message fields we write, 6 or 7.
    pub robotware: u8,
    /// When the sensor adapter sends; a robot adapter sends with every feedback.
    pub send: AdapterSend,
    /// Kernel stamps asked for.
    pub timestamps: Timestamps,
    /// Differentiated-services code point (RFC 2474), 0..=63.
    pub dscp: u8,
}

/// Which side of the protocol an adapter is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AdapterKind {
    /// We are the robot: the foreign program plays the role that commands it.
    Robot,
    /// We are the sensor: the foreign program, or a real robot, plays the robot.
    Sensor,
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Robot => "EGM robot adapter",
            Self::Sensor => "EGM sensor adapter",
        })
    }
}

/// When a sensor adapter sends.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AdapterSend {
    /// One message for each of the robot's, as the maker recommends.
    Coupled,
    /// On a clock of its own.
    Free {
        /// Messages per second.
        rate_hz: f64,
    },
}

impl EgmAdapter {
    /// The address of `side`; `None` when the adapter has no such arm.
    pub const fn address(&self, side: Side) -> Option<SocketAddr> {
        match side {
            Side::Right => self.right,
            Side::Left => self.left,
        }
    }

    /// The table as the file would say it in full.
    pub(super) fn resolved(&self) -> Table {
        let mut table = Table::new();
        for (key, address) in [("right", self.right), ("left", self.left)] {
            if let Some(address) = address {
                table.insert(key.to_owned(), address.to_string().into());
            }
        }
        table.insert("axes".to_owned(), i64::from(self.axes).into());
        table.insert("robotware".to_owned(), i64::from(self.robotware).into());
        if self.kind == AdapterKind::Sensor {
            match self.send {
                AdapterSend::Coupled => {
                    table.insert("send".to_owned(), "coupled".into());
                }
                AdapterSend::Free { rate_hz } => {
                    table.insert("send".to_owned(), "free".into());
                    table.insert("send_hz".to_owned(), rate_hz.into());
                }
            }
        }
        table.insert("timestamps".to_owned(), self.timestamps.word().into());
        table.insert("dscp".to_owned(), i64::from(self.dscp).into());
        table
    }
}

/// The table before it is known which adapter it is.
#[derive(Debug)]
pub(super) struct AdapterEntry {
    right: Option<SocketAddr>,
    left: Option<SocketAddr>,
    pub axes: u8,
    robotware: u8,
    send: AdapterSend,
    timestamps: Timestamps,
    dscp: u8,
    /// The table says when to send, which only a sensor adapter decides.
    pub says_when_to_send: bool,
    pub path: String,
    pub place: Place,
}

impl AdapterEntry {
    pub(super) fn read(mut reader: Reader<'_>) -> Self {
        let right = read_address(&mut reader, "right");
        let left = read_address(&mut reader, "left");
        if !reader.has("right") && !reader.has("left") {
            let hint = "write right = \"ADDRESS:PORT\", left = \"ADDRESS:PORT\" or both: one for \
                        each arm";
            reader.refuse("right", Fault::Missing(hint.to_owned()));
        } else if right.is_some() && right == left {
            let fault = "is the address of the right arm too: each arm has a channel of its own";
            reader.refuse("left", Fault::Inconsistent(fault.to_owned()));
        }
        let says_when_to_send = reader.has("send") || reader.has("send_hz");
        let entry = Self {
            right,
            left,
            axes: integer(&mut reader, "axes", &limits::EGM_AXES),
            robotware: integer(&mut reader, "robotware", &limits::EGM_ROBOTWARE),
            send: read_send(&mut reader),
            timestamps: reader
                .word("timestamps", STAMP_WORDS)
                .unwrap_or(Timestamps::Software),
            dscp: integer(&mut reader, "dscp", &limits::LINK_DSCP),
            says_when_to_send,
            path: reader.path.clone(),
            place: reader.place,
        };
        reader.finish();
        entry
    }

    /// The adapter, now that its kind is known.
    pub(super) fn adapter(&self, kind: AdapterKind) -> EgmAdapter {
        EgmAdapter {
            kind,
            right: self.right,
            left: self.left,
            axes: self.axes,
            robotware: self.robotware,
            send: self.send,
            timestamps: self.timestamps,
            dscp: self.dscp,
        }
    }

    /// The arms that have an address.
    pub(super) fn addresses(&self) -> impl Iterator<Item = (Side, SocketAddr)> {
        let arms = [(Side::Right, self.right), (Side::Left, self.left)];
        arms.into_iter()
            .filter_map(|(side, address)| Some((side, address?)))
    }
}

fn integer(reader: &mut Reader<'_>, key: &'static str, limit: &limits::Limit<i64>) -> u8 {
    let default = || u8::try_from(limit.default).ok();
    let read = reader.integer(key, limit).or_else(default);
    read.expect("the default of a limit fits the type of its key")
}

/// An address is written as a number: a name would have to be resolved by a network that the file
/// is checked without.
fn read_address(reader: &mut Reader<'_>, key: &'static str) -> Option<SocketAddr> {
    let text = reader.text(key)?;
    let parsed: Option<SocketAddr> = text.value.parse().ok();
    if parsed.is_none_or(|address| address.port() < EGM_PORT_MIN || address.ip().is_multicast()) {
        let text = text.value;
        let fault = format!(
            "\"{text}\" is no address of the form 192.168.125.1:6510 with a port of \
             {EGM_PORT_MIN} to 65535"
        );
        reader.refuse(key, Fault::Inconsistent(fault));
        return None;
    }
    if let Some(SocketAddr::V6(address)) = parsed
        && address.ip().is_unicast_link_local()
        && address.scope_id() == 0
    {
        reader.refuse(key, Fault::Inconsistent(link_local_fault(&text.value)));
        return None;
    }
    parsed
}

/// A card's own clock would not compare with the software stamps of the other way.
const STAMP_WORDS: &[(&str, Timestamps)] =
    &[("off", Timestamps::Off), ("software", Timestamps::Software)];

/// Ports below belong to the system's own services.
const EGM_PORT_MIN: u16 = 1024;

fn read_send(reader: &mut Reader<'_>) -> AdapterSend {
    let is_free = reader.word("send", &[("coupled", false), ("free", true)]);
    let rate_hz = reader.number("send_hz", &limits::EGM_SEND_HZ);
    if is_free == Some(true) {
        return AdapterSend::Free {
            rate_hz: rate_hz.unwrap_or(limits::EGM_SEND_HZ.default),
        };
    }
    if is_free.is_some() || !reader.has("send") {
        reader.refuse_present(&["send_hz"], "needs send = \"free\"");
    }
    AdapterSend::Coupled
}
