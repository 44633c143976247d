//! What the wireless subsystem says (`linux/nl80211.h`), read from generic netlink messages: stations
//! with their signal and rates, interfaces, and what happens to an association. Bytes only.

use super::netlink::{Attributes, u16_at, u32_at};

use hil_rundir::radio_record::command;

/// `NL80211_ATTR_*`.
pub(crate) mod attribute {
    pub(crate) const IFINDEX: u16 = 3;
    pub(crate) const IFTYPE: u16 = 5;
    pub(crate) const MAC: u16 = 6;
    pub(crate) const STA_INFO: u16 = 21;
    pub(crate) const WIPHY_FREQ: u16 = 38;
    pub(crate) const REASON_CODE: u16 = 54;
    pub(crate) const STATUS_CODE: u16 = 72;
    pub(crate) const PS_STATE: u16 = 93;
}

/// `CTRL_ATTR_*` of `linux/genetlink.h`.
pub(crate) mod control {
    pub(crate) const GET_FAMILY: u8 = 3;
    pub(crate) const FAMILY_ID: u16 = 1;
    pub(crate) const FAMILY_NAME: u16 = 2;
    pub(crate) const GROUPS: u16 = 7;
    pub(crate) const GROUP_NAME: u16 = 1;
    pub(crate) const GROUP_ID: u16 = 2;
}

/// A family's number and that of one of its groups; the group may be missing.
pub(crate) fn family(attributes: Attributes<'_>, group: &[u8]) -> Option<(u16, Option<u32>)> {
    let number = u16_at(attributes.find(control::FAMILY_ID)?, 0)?;
    let groups = attributes.find(control::GROUPS).unwrap_or_default();
    let mut groups = Attributes::nested(groups)
        .into_iter()
        .map(|(_, one)| Attributes::nested(one));
    let found = groups.find(|one| one.find(control::GROUP_NAME) == Some(group));
    let id = found.and_then(|one| u32_at(one.find(control::GROUP_ID)?, 0));
    Some((number, id))
}

/// What a wireless interface is used as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wireless {
    /// `enum nl80211_iftype`.
    pub kind: u32,
    /// Its channel, MHz.
    pub frequency_mhz: Option<u32>,
}

impl Wireless {
    pub(crate) fn decode(attributes: Attributes<'_>) -> Option<Self> {
        Some(Self {
            kind: u32_at(attributes.find(attribute::IFTYPE)?, 0)?,
            frequency_mhz: number(attributes, attribute::WIPHY_FREQ),
        })
    }

    /// The kind in words.
    pub const fn label(self) -> &'static str {
        match self.kind {
            1 => "ad-hoc station",
            2 => "station",
            3 => "access point",
            6 => "monitor",
            7 => "mesh point",
            8 => "P2P client",
            9 => "P2P group owner",
            _ => "other",
        }
    }
}

/// One rate of a radio (`NL80211_RATE_INFO_*`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Rate {
    /// Bits on the air, kbit/s.
    pub kbps: Option<u32>,
    /// How it is modulated.
    pub generation: Generation,
    /// Modulation and coding scheme.
    pub mcs: Option<u8>,
    /// Spatial streams, where the generation tells them apart from the scheme.
    pub stream_count: Option<u8>,
    /// Channel width, MHz; 20 where the kernel names no other.
    pub width_mhz: u16,
}

/// A generation of IEEE 802.11, by the attribute its rates come in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum Generation {
    /// Up to 802.11g.
    #[default]
    Legacy = 0,
    /// 802.11n.
    Ht = 4,
    /// 802.11ac.
    Vht = 5,
    /// 802.11ax.
    He = 6,
    /// 802.11be.
    Eht = 7,
}

impl Rate {
    fn decode(content: &[u8]) -> Self {
        let mut rate = Self {
            width_mhz: 20,
            ..Self::default()
        };
        for (number, content) in Attributes::nested(content) {
            let byte = content.first().copied();
            let mut of = |generation, mcs: Option<u8>| {
                rate.generation = generation;
                rate.mcs = mcs;
            };
            match number {
                2 => of(Generation::Ht, byte),
                6 => of(Generation::Vht, byte),
                13 => of(Generation::He, byte),
                19 => of(Generation::Eht, byte),
                7 | 14 | 20 => rate.stream_count = byte,
                // The 16-bit form saturates and comes before the 32-bit form or alone.
                1 if rate.kbps.is_none() => {
                    rate.kbps = u16_at(content, 0).map(|units| u32::from(units) * 100);
                }
                5 => {
                    let kbps = u32_at(content, 0).and_then(|units| units.checked_mul(100));
                    rate.kbps = kbps.or(rate.kbps);
                }
                12 => rate.width_mhz = 5,
                11 => rate.width_mhz = 10,
                3 => rate.width_mhz = 40,
                8 => rate.width_mhz = 80,
                9 | 10 => rate.width_mhz = 160,
                18 => rate.width_mhz = 320,
                _ => {}
            }
        }
        rate
    }
}

/// What an interface knows of one peer station (`NL80211_STA_INFO_*`). `None` where the driver does
/// not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Station {
    /// Its address.
    pub mac: [u8; 6],
    /// Signal of the newest packet.
    pub signal_dbm: Option<i8>,
    /// The driver's moving average of the signal.
    pub signal_average_dbm: Option<i8>,
    /// The newest rate sent with.
    pub transmit: Option<Rate>,
    /// The newest rate received with.
    pub receive: Option<Rate>,
    /// Since anything was heard of it.
    pub inactive_ms: Option<u32>,
    /// Since it associated.
    pub connected_s: Option<u32>,
    /// Packets received of it.
    pub rx_packets: Option<u32>,
    /// Packets sent to it.
    pub tx_packets: Option<u32>,
    /// Frames sent again.
    pub tx_retries: Option<u32>,
    /// Packets given up.
    pub tx_failed: Option<u32>,
    /// Beacons missed so often that the driver counted a loss.
    pub beacon_losses: Option<u32>,
}

impl Station {
    /// The station of a `NEW_STATION` message.
    pub fn decode(attributes: Attributes<'_>) -> Option<Self> {
        let mut station = Self {
            mac: mac(attributes)?,
            ..Self::default()
        };
        let info = Attributes::nested(attributes.find(attribute::STA_INFO)?);
        for (number, content) in info {
            let word = u32_at(content, 0);
            let signal = content.first().map(|byte| byte.cast_signed());
            match number {
                1 => station.inactive_ms = word,
                7 => station.signal_dbm = signal,
                8 => station.transmit = Some(Rate::decode(content)),
                9 => station.rx_packets = word,
                10 => station.tx_packets = word,
                11 => station.tx_retries = word,
                12 => station.tx_failed = word,
                13 => station.signal_average_dbm = signal,
                14 => station.receive = Some(Rate::decode(content)),
                16 => station.connected_s = word,
                18 => station.beacon_losses = word,
                _ => {}
            }
        }
        Some(station)
    }
}

/// Something that happened to an association.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AssociationEvent {
    /// The command that tells of it.
    pub(crate) command: u8,
    /// The interface.
    pub(crate) ifindex: u32,
    /// The other radio, where the message names it.
    pub(crate) mac: Option<[u8; 6]>,
    /// Reason or status (IEEE 802.11, clause 9.4.1.7 and 9.4.1.9).
    pub(crate) code: Option<u16>,
}

impl AssociationEvent {
    /// The happening a message of the `mlme` group tells of; `None` for one of no concern here.
    pub(crate) fn decode(command: u8, attributes: Attributes<'_>) -> Option<Self> {
        use command::{
            CONNECT, DEAUTHENTICATE, DEL_STATION, DISASSOCIATE, DISCONNECT, NEW_STATION,
            NOTIFY_CQM, ROAM,
        };
        let concerns = [
            CONNECT,
            ROAM,
            DISCONNECT,
            DEAUTHENTICATE,
            DISASSOCIATE,
            NEW_STATION,
            DEL_STATION,
            NOTIFY_CQM,
        ];
        if !concerns.contains(&command) {
            return None;
        }
        let code = |number| u16_at(attributes.find(number)?, 0);
        Some(Self {
            command,
            ifindex: number(attributes, attribute::IFINDEX)?,
            mac: mac(attributes),
            code: code(attribute::REASON_CODE).or_else(|| code(attribute::STATUS_CODE)),
        })
    }
}

/// Whether a `GET_POWER_SAVE` answer says that power save is on.
pub(crate) fn is_power_save_on(attributes: Attributes<'_>) -> Option<bool> {
    Some(number(attributes, attribute::PS_STATE)? != 0)
}

pub(crate) fn number(attributes: Attributes<'_>, number: u16) -> Option<u32> {
    u32_at(attributes.find(number)?, 0)
}

fn mac(attributes: Attributes<'_>) -> Option<[u8; 6]> {
    attributes.find(attribute::MAC)?.first_chunk().copied()
}

#[cfg(test)]
#[path = "nl80211_tests.rs"]
mod tests;
