//! The radio of a wireless hop: what the kernel knows of the association, sampled beside the data
//! and never on the measured path.
//!
//! - `netlink`, `nl80211`: the messages, as bytes; `conversation`: question and answer.
//! - `socket`: asking and listening; `sampler`: doing so ten times a second.
//! - `noting`: what is written down, as [`RadioRecord`](hil_rundir::radio_record::RadioRecord)s.
//! - [`category`]: which access category a mark leads to.

pub mod category;
pub mod conversation;
pub mod netlink;
pub mod nl80211;
pub mod sampler;
pub mod socket;

use netlink::{Answer, Answers};

/// What one receive call's bytes were found to hold, for tests from outside the crate.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Heard {
    /// Messages of netlink, of whatever kind.
    pub answer_count: usize,
    /// Of these, answers about an association.
    pub station_count: usize,
    /// Answers about a wireless interface.
    pub interface_count: usize,
    /// Events, such as a roam.
    pub event_count: usize,
    /// Answers about a family of generic netlink.
    pub family_count: usize,
}

/// Reads `bytes` in every way there is; whatever they are, it does not panic.
pub fn heard(bytes: &[u8]) -> Heard {
    let mut heard = Heard::default();
    for (_, answer) in Answers::new(bytes) {
        heard.answer_count += 1;
        if let Answer::Message {
            command,
            attributes,
            ..
        } = answer
        {
            let event = nl80211::AssociationEvent::decode(command, attributes);
            let family = nl80211::family(attributes, b"mlme\0");
            heard.station_count += usize::from(nl80211::Station::decode(attributes).is_some());
            heard.interface_count += usize::from(nl80211::Wireless::decode(attributes).is_some());
            heard.event_count += usize::from(event.is_some());
            heard.family_count += usize::from(family.is_some());
        }
    }
    heard
}
