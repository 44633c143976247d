//! One look at a card outside a run, for the doctor: its clock against the host's, how it is set
//! up, and whether it really delivers a transmit stamp. Leaves the card as it was.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use hil_net::nic_arming::describe_setting;
use hil_net::nic_clock::{NicClock, NicPair};
use hil_net::timestamping::{HardwareStamping, TimestampMode};
use hil_transport::probe::{Availability, DISCARD_PORT, ProbeSettings, arm_and_probe};

use super::guard::GuardedNic;

/// Reads of the clock of which the narrowest counts.
const READ_ATTEMPTS: u32 = 10;
/// How long to wait for stamps that may never come.
const PROBE_BOUND: Duration = Duration::from_millis(500);
/// Stamps in a row that count as proof.
const PROOF_COUNT: u32 = 3;
/// All hosts of the link (RFC 1112): needs no neighbour to answer, and no router passes it on.
const LINK_HOSTS: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 1);

/// What a card showed; each in words where it did not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NicProbe {
    /// Its clock against the real-time clock.
    pub clock: Result<NicPair, String>,
    /// How it was found to be set up.
    pub setting: Result<String, String>,
    /// Whether transmit stamps of the card came back.
    pub tx_hardware: Result<Delivery, String>,
}

/// What became of the stamps of the probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// They came.
    Delivered,
    /// The driver advertises them, and none came in time.
    AdvertisedOnly,
    /// They were not even advertised.
    NotOffered,
}

/// Looks at the card behind `interface` with the clock `/dev/ptp<phc_index>`. Sends datagrams to
/// the discard port of all hosts of the link, for half a second at most.
pub fn probe_nic(interface: &str, phc_index: u32) -> NicProbe {
    let clock = NicClock::open(phc_index).and_then(|clock| clock.read(READ_ATTEMPTS));
    let setting = HardwareStamping::query(interface);
    NicProbe {
        clock: clock.map_err(|error| error.to_string()),
        setting: setting
            .map(describe_setting)
            .map_err(|error| error.to_string()),
        tx_hardware: probe_transmit(interface),
    }
}

fn probe_transmit(interface: &str) -> Result<Delivery, String> {
    // Puts the card back when it goes.
    let _armed = GuardedNic::arm(interface, false)?;
    let settings = ProbeSettings {
        timestamps: TimestampMode::Hardware,
        transmit_target: Some(SocketAddr::from((LINK_HOSTS, DISCARD_PORT))),
        interface: Some(interface.to_owned()),
        proof_count: PROOF_COUNT,
        bound: PROBE_BOUND,
    };
    let (report, _sentinel) = arm_and_probe(&settings).map_err(|error| error.to_string())?;
    if let Some(refusal) = report.newest_refusal
        && report.tx_hardware != Availability::Seen
    {
        return Err(format!("the probe could not be sent: {refusal}"));
    }
    Ok(match report.tx_hardware {
        Availability::Seen => Delivery::Delivered,
        Availability::ClaimedButNotSeen => Delivery::AdvertisedOnly,
        Availability::NotOffered => Delivery::NotOffered,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_nic_fails_in_words_everywhere() {
        let probe = probe_nic("lo", 4_000_000_000);
        assert!(probe.clock.unwrap_err().contains("/dev/ptp4000000000"));
        assert!(probe.setting.is_err());
        assert!(probe.tx_hardware.is_err());
    }
}
