//! The clock path's end on this host, where a topology names one: whether its address is here, and
//! what its interface claims to stamp. It exchanges no clocks; nobody may be at the other end yet.

use std::net::IpAddr;

use super::finding::{Answer, Checked, Finding};
use super::network::{StampQuery, describe, has_software_both_ways};
use hil_topology::ClockEnd;

/// What a run makes of a clock path that it cannot use.
const GOES_ON: &str = "the run would go on with the clock exchanges of the data path, whose bound is as wide as that \
                       path is slow";

/// Which interface has an address, in words when the host does not tell.
pub(super) type InterfaceOf<'a> = &'a dyn Fn(IpAddr) -> Result<Option<String>, String>;

/// `end` is that of the topology on this host, if it has one.
pub(super) fn examine(
    end: Option<&ClockEnd>,
    interface_of: InterfaceOf<'_>,
    stamps: StampQuery<'_>,
) -> Checked {
    let id = "clock_path";
    let Some(end) = end else {
        let value = "the topology names no clock_address of this host";
        return Ok(Finding::note(id, value).fixed_by(
            "clock_address and clock_interface of both hosts in the topology (docs/clocks.md)",
        ));
    };
    let unusable = |value, fix| Ok(Finding::error(id, value).because(GOES_ON).fixed_by(fix));
    let (address, port) = (end.address, end.port);
    let Some(interface) = interface_of(address).told(id)? else {
        let on = end.interface.as_deref().unwrap_or("<interface>");
        return unusable(
            format!("no interface has {address}, the clock_address"),
            format!("ip address add {address}/24 dev {on}"),
        );
    };
    if let Some(named) = &end.interface
        && *named != interface
    {
        return unusable(
            format!("{address} is on {interface}, and clock_interface says {named}"),
            format!("clock_interface = \"{interface}\""),
        );
    }
    let claims = stamps(&interface).told(id)?;
    let claimed = describe(&claims);
    let value = format!("{address} on {interface}, UDP from port {port}; {claimed}");
    if has_software_both_ways(&claims) {
        return Ok(Finding::ok(id, value));
    }
    Ok(Finding::note(id, value)
        .because(
            "without kernel stamps both ways the time to wake up counts as the path's, and the \
             bound is that much wider",
        )
        .fixed_by("use an interface whose driver has software stamps (ethtool -T shows them)"))
}

#[cfg(test)]
mod tests {
    use hil_net::timestamping::TimestampCapabilities;

    use super::*;
    use crate::finding::{Severity, settled};
    use hil_topology::ClockEnd;

    fn end(interface: Option<&str>) -> ClockEnd {
        ClockEnd {
            address: "10.78.0.1".parse().unwrap(),
            interface: interface.map(str::to_owned),
            port: 7390,
        }
    }

    fn examined(
        interface: Option<&str>,
        found: Result<Option<&str>, &str>,
        tx_software: bool,
    ) -> Finding {
        let query = |_: &str| {
            Ok(TimestampCapabilities {
                tx_software,
                rx_software: true,
                tx_hardware: false,
                rx_hardware: false,
                phc_index: None,
            })
        };
        let of = |_| {
            found
                .map(|name| name.map(str::to_owned))
                .map_err(str::to_owned)
        };
        settled(examine(Some(&end(interface)), &of, &query))
    }

    #[test]
    fn an_end_that_is_here_is_told_with_its_stamps() {
        for named in [None, Some("eth1")] {
            let finding = examined(named, Ok(Some("eth1")), true);
            assert_eq!(finding.severity, Severity::Ok);
            let expected = "10.78.0.1 on eth1, UDP from port 7390; software tx+rx, hardware none";
            assert_eq!(finding.value, expected);
        }
        let deaf = examined(None, Ok(Some("wlan0")), false);
        assert_eq!(deaf.severity, Severity::Note);
        assert!(deaf.value.contains("software rx only"), "{}", deaf.value);
    }

    #[test]
    fn an_address_that_is_not_here_or_elsewhere_is_a_problem_with_its_cure() {
        let missing = examined(Some("eth1"), Ok(None), true);
        assert_eq!(missing.severity, Severity::Error);
        assert_eq!(missing.fix, "ip address add 10.78.0.1/24 dev eth1");
        let elsewhere = examined(Some("eth2"), Ok(Some("eth1")), true);
        assert_eq!(elsewhere.severity, Severity::Error);
        assert_eq!(elsewhere.fix, "clock_interface = \"eth1\"");
        assert_eq!(
            examined(None, Err("no"), true).severity,
            Severity::CannotTell
        );
        let query = |name: &str| panic!("{name} was asked");
        let unnamed = settled(examine(None, &|_| Ok(None), &query));
        assert_eq!(unnamed.severity, Severity::Note, "looked at, and not there");
    }
}
