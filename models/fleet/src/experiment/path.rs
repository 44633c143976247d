//! What one direction of a fleet's network does: the impairments of a table's row, or a radio. It
//! carries no messages.

use crate::experiment::setup::Links;
use hil_core::case_study::ParameterError;
use hil_core::link_model::LinkModel;
use hil_core::random::RandomStream;
use hil_core::time::Instant;
use hil_link::impaired::{ImpairedLink, LinkCounts};
use hil_link::spec::Way;
use hil_link::wifi::WifiLink;

/// One direction.
#[derive(Debug)]
pub(crate) enum Path {
    Impaired(Box<ImpairedLink>),
    Wifi(Box<WifiLink>),
}

impl Path {
    /// Commands go forward, states backward.
    ///
    /// # Errors
    /// When a number of `links` is outside its range.
    pub(crate) fn new(links: &Links, way: Way, seed: u64) -> Result<Self, ParameterError> {
        let (impairments, name) = match way {
            Way::Forward => (links.commands, "fleet commands"),
            Way::Backward => (links.status, "fleet status"),
        };
        let own = RandomStream::new(seed, name);
        Ok(match &links.wifi {
            None => {
                let stalls = RandomStream::new(seed, "fleet stalls");
                Self::Impaired(Box::new(ImpairedLink::new(impairments, own, stalls)?))
            }
            Some(wifi) => {
                let shared = RandomStream::new(seed, "fleet radio");
                Self::Wifi(Box::new(WifiLink::new(wifi, way, own, shared)?))
            }
        })
    }

    /// Offers a message; hands each of its arrivals to `deliver`.
    pub(crate) fn offer(
        &mut self,
        now: Instant,
        length_bytes: usize,
        deliver: &mut dyn FnMut(Instant),
    ) {
        match self {
            Self::Impaired(link) => link.offer(now, deliver),
            Self::Wifi(link) => {
                if let Some(at) = link.offer(now, length_bytes).arrival() {
                    deliver(at);
                }
            }
        }
    }

    /// What became of the messages so far.
    pub(crate) fn counts(&self) -> LinkCounts {
        match self {
            Self::Impaired(link) => link.counts(),
            Self::Wifi(link) => {
                let counts = link.counts();
                LinkCounts {
                    offered_count: counts.offered_count,
                    lost_count: counts.offered_count - counts.delivered_count,
                    held_count: counts.held_count,
                    ..LinkCounts::default()
                }
            }
        }
    }
}
