//! The decoder against messages recorded from Linux 6.1 with simulated radios, and against noise.

use super::super::netlink::{Answer, Answers};
use super::*;

/// Answer to `GET_STATION`, without its per-class counters.
const STATION: &[u8] = include_bytes!("recorded/station.netlink");
/// A station that was told to leave.
const DISCONNECT: &[u8] = include_bytes!("recorded/disconnect.netlink");
/// Answer to `GET_FAMILY`, without its operations.
const FAMILY: &[u8] = include_bytes!("recorded/family.netlink");
/// Answer to `GET_INTERFACE`: a P2P device, then wlan0.
const INTERFACES: &[u8] = include_bytes!("recorded/interfaces.netlink");

fn message(bytes: &[u8]) -> (u8, Attributes<'_>) {
    match Answers::new(bytes).next() {
        Some((
            _,
            Answer::Message {
                command,
                attributes,
                ..
            },
        )) => (command, attributes),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_recorded_station_is_read_as_the_tool_printed_it() {
    let (command, attributes) = message(STATION);
    assert_eq!(command, command::NEW_STATION);
    let station = Station::decode(attributes).unwrap();
    assert_eq!(station.mac, [2, 0, 0, 0, 0, 0]);
    assert_eq!(station.signal_dbm, Some(-27));
    assert_eq!(station.signal_average_dbm, Some(-27));
    let transmit = station.transmit.unwrap();
    assert_eq!(transmit.kbps, Some(52_000));
    assert_eq!(
        (transmit.generation, transmit.mcs),
        (Generation::Ht, Some(5))
    );
    assert_eq!(transmit.width_mhz, 20);
    let receive = station.receive.unwrap();
    assert_eq!((receive.kbps, receive.mcs), (Some(78_000), Some(12)));
    assert_eq!(station.inactive_ms, Some(376));
    assert_eq!(
        (station.rx_packets, station.tx_packets),
        (Some(44), Some(18))
    );
    assert_eq!((station.tx_retries, station.tx_failed), (Some(0), Some(0)));
    assert_eq!(
        (station.beacon_losses, station.connected_s),
        (Some(0), Some(1))
    );
}

#[test]
fn a_rate_of_every_generation_is_read() {
    let rate = |attributes: &[(u16, &[u8])]| {
        let mut bytes = Vec::new();
        for (number, content) in attributes {
            bytes.extend(u16::try_from(4 + content.len()).unwrap().to_ne_bytes());
            bytes.extend(number.to_ne_bytes());
            bytes.extend(*content);
            bytes.resize(bytes.len().next_multiple_of(4), 0);
        }
        Rate::decode(&bytes)
    };
    let units = 12_010_u32.to_ne_bytes();
    let he = rate(&[(5, &units), (13, &[11]), (14, &[2]), (8, &[])]);
    assert_eq!(he.kbps, Some(1_201_000));
    assert_eq!((he.generation, he.mcs), (Generation::He, Some(11)));
    assert_eq!((he.stream_count, he.width_mhz), (Some(2), 80));
    let vht = rate(&[(6, &[9]), (7, &[1]), (10, &[])]);
    assert_eq!((vht.generation, vht.mcs), (Generation::Vht, Some(9)));
    assert_eq!((vht.kbps, vht.width_mhz), (None, 160));
    let eht = rate(&[(19, &[13]), (20, &[4]), (18, &[])]);
    assert_eq!((eht.generation, eht.width_mhz), (Generation::Eht, 320));
    let legacy = rate(&[(1, &540_u16.to_ne_bytes())]);
    assert_eq!((legacy.generation, legacy.mcs), (Generation::Legacy, None));
    assert_eq!(legacy.kbps, Some(54_000));
}

#[test]
fn the_family_and_its_group_are_found_by_name() {
    let (_, attributes) = message(FAMILY);
    assert_eq!(family(attributes, b"mlme\0"), Some((32, Some(12))));
    assert_eq!(family(attributes, b"nothing\0"), Some((32, None)));
}

#[test]
fn interfaces_say_what_they_are() {
    let found: Vec<_> = Answers::new(INTERFACES)
        .filter_map(|(_, answer)| match answer {
            Answer::Message { attributes, .. } => Some((
                number(attributes, attribute::IFINDEX),
                Wireless::decode(attributes)?,
            )),
            _ => None,
        })
        .collect();
    assert_eq!(found[0].0, None, "a P2P device has no interface");
    assert_eq!(found[1].0, Some(3));
    assert_eq!(found[1].1.label(), "station");
    assert_eq!(found[1].1.frequency_mhz, Some(5180));
}

#[test]
fn a_disconnection_names_its_interface_and_reason() {
    let (command, attributes) = message(DISCONNECT);
    let happening = AssociationEvent::decode(command, attributes).unwrap();
    assert_eq!(happening.command, command::DISCONNECT);
    assert_eq!((happening.ifindex, happening.code), (3, Some(3)));
    assert_eq!(happening.mac, None);
    assert_eq!(
        AssociationEvent::decode(command::GET_STATION, attributes),
        None
    );
}
