//! Network cards with a clock of their own: how they are set up, whether a stamp they advertise
//! comes back when something is sent, and where their clock stands. Other interfaces have no
//! finding here; what they claim is said beside.

use super::finding::{Finding, Severity};
use super::network::{Interfaces, StampQuery};
use hil_nic::nic_clock::probing::{Delivery, NicProbe};

/// Offsets above this are no matter of accuracy but of another time scale or an unset clock.
const FOREIGN_OFFSET_NS: u64 = 1_000_000;

pub(super) fn examine(
    present: &Interfaces,
    names: &[String],
    query: StampQuery<'_>,
    probe: &dyn Fn(&str, u32) -> NicProbe,
) -> Vec<Finding> {
    let cards = names.iter().filter_map(|name| {
        // What is missing, or does not answer, is a finding of the network already.
        let interface = present.get(name)?;
        let index = query(name).ok()?.phc_index?;
        Some(judge(index, interface.has_link, &probe(name, index)).of(name))
    });
    cards.collect()
}

fn judge(index: u32, has_link: bool, probe: &NicProbe) -> Finding {
    let id = "card";
    let unknown = |reason| format!("setting unknown ({reason})");
    let setting = probe.setting.clone().unwrap_or_else(unknown);
    let clock = match &probe.clock {
        Ok(pair) => format!(
            "/dev/ptp{index} is {} ns against the system clock, within {} ns",
            pair.nic_offset_ns, pair.bound_ns
        ),
        Err(reason) => format!("clock not readable ({reason})"),
    };
    let unprobed: String;
    let (delivery, severity, why, fix) = match &probe.tx_hardware {
        Ok(Delivery::Delivered) => ("delivers hardware transmit stamps", Severity::Ok, "", ""),
        Ok(Delivery::AdvertisedOnly) => (
            "hardware transmit stamps advertised but never delivered",
            Severity::Note,
            "the driver advertises what its card does not do: a run that asks for hardware stamps \
             gets software stamps and says so",
            "leave timestamps = \"software\", or use another card",
        ),
        Ok(Delivery::NotOffered) => (
            "offers no hardware transmit stamps",
            Severity::Note,
            "the card has a clock and does not stamp what it sends",
            "leave timestamps = \"software\"",
        ),
        Err(reason) => {
            unprobed = format!("not probed ({reason})");
            (
                unprobed.as_str(),
                Severity::CannotTell,
                "whether the card delivers the stamps it advertises is not known",
                "run the doctor with CAP_NET_ADMIN and an address on the interface",
            )
        }
    };
    let value = format!("{setting}; {delivery}; {clock}");
    if !has_link {
        return Finding::note(id, format!("{value}; link down"))
            .because("nothing leaves an interface without a link, so no stamp can come")
            .fixed_by("connect it and run the doctor again");
    }
    let finding = Finding::new(id, severity, value);
    if severity != Severity::Ok {
        return finding.because(why).fixed_by(fix);
    }
    match &probe.clock {
        Ok(pair) if pair.nic_offset_ns.unsigned_abs() > FOREIGN_OFFSET_NS => finding.because(
            "the card's clock is on another time scale (PTP's TAI is 37 s ahead) or was never \
             set; a run converts its stamps by paired reads, so that costs nothing",
        ),
        _ => finding,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finding::Severity;
    use crate::network::Interface;
    use hil_net::nic_clock::NicPair;
    use hil_net::timestamping::TimestampCapabilities;

    fn probe(tx_hardware: Result<Delivery, String>) -> NicProbe {
        NicProbe {
            clock: Ok(NicPair {
                realtime_ns: 0,
                nic_offset_ns: 37_000_000_120,
                bound_ns: 900,
            }),
            setting: Ok("transmit off, receive filter none".to_owned()),
            tx_hardware,
        }
    }

    #[test]
    fn a_nic_that_delivers_is_good_and_its_clock_is_told_with_its_bound() {
        let finding = judge(2, true, &probe(Ok(Delivery::Delivered)));
        assert_eq!(finding.severity, Severity::Ok);
        assert!(finding.value.contains("transmit off"), "{}", finding.value);
        let clock = "/dev/ptp2 is 37000000120 ns against the system clock, within 900 ns";
        assert!(finding.value.contains(clock), "{}", finding.value);
        assert!(finding.why.contains("TAI"), "{}", finding.why);
    }

    #[test]
    fn a_nic_that_only_advertises_is_called_that() {
        let finding = judge(0, true, &probe(Ok(Delivery::AdvertisedOnly)));
        assert_eq!(finding.severity, Severity::Note);
        let words = "advertised but never delivered";
        assert!(finding.value.contains(words), "{}", finding.value);
    }

    #[test]
    fn what_could_not_be_found_out_is_told_with_the_reason() {
        let refused = Err("switching the card's stamps on needs CAP_NET_ADMIN".to_owned());
        let finding = judge(0, true, &probe(refused));
        assert_eq!(finding.severity, Severity::CannotTell);
        assert!(finding.value.contains("CAP_NET_ADMIN"), "{}", finding.value);
        let finding = judge(0, false, &probe(Ok(Delivery::AdvertisedOnly)));
        assert!(finding.value.ends_with("link down"), "{}", finding.value);
    }

    #[test]
    fn an_interface_without_a_clock_is_not_probed() {
        let query = |_: &str| {
            Ok(TimestampCapabilities {
                tx_software: true,
                rx_software: true,
                tx_hardware: false,
                rx_hardware: false,
                phc_index: None,
            })
        };
        let present = Interfaces::from([("eth0".to_owned(), Interface::default())]);
        let names = ["eth0".to_owned()];
        let findings = examine(&present, &names, &query, &|name, _| {
            panic!("{name} was probed")
        });
        assert!(findings.is_empty());
    }
}
