//! The radios of this host: what each is used as, and whether it sleeps to save power. Wired
//! interfaces have no finding here.

use super::finding::{Finding, Severity};
use hil_nic::radio::nl80211::Station;
use hil_nic::radio::socket::{RadioError, RadioSocket};

/// Below this a datagram of 200 bytes is on the air for 270 us and more.
const BITRATE_KBPS_MIN: u32 = 6_000;

pub(super) fn examine(names: &[String]) -> Vec<Finding> {
    names.iter().filter_map(|name| radio(name)).collect()
}

fn radio(interface: &str) -> Option<Finding> {
    let finding = match RadioSocket::open(interface) {
        Ok((mut socket, wireless)) => {
            let power_save = socket.is_power_save_on().map_err(|error| error.to_string());
            let stations = socket.stations().map_err(|error| error.to_string());
            let frequency = wireless.frequency_mhz;
            let channel = frequency.map_or_else(String::new, |mhz| format!(", {mhz} MHz"));
            let what = format!("{}{channel}", wireless.label());
            judge(&what, power_save, stations.as_deref())
        }
        // That it is missing or wired is said, or no matter, elsewhere.
        Err(RadioError::NotWireless(_) | RadioError::NoInterface(_)) => return None,
        Err(error) => Finding::cannot_tell("radio", error.to_string()),
    };
    Some(finding.of(interface))
}

fn judge(
    what: &str,
    power_save: Result<bool, String>,
    stations: Result<&[Station], &String>,
) -> Finding {
    let id = "radio";
    let (rate, kbps) = match stations {
        Ok(stations) => bitrate(stations),
        Err(reason) => (format!("bitrate unknown ({reason})"), None),
    };
    let is_on = match power_save {
        Ok(is_on) => is_on,
        Err(reason) => {
            let value = format!("{what}, power save unknown: {reason}; {rate}");
            return Finding::cannot_tell(id, value);
        }
    };
    let mode = if is_on { "on" } else { "off" };
    let value = format!("{what}, power save {mode}, {rate}");
    if is_on {
        Finding::warning(id, value)
    } else if kbps.is_some_and(|kbps| kbps < BITRATE_KBPS_MIN) {
        Finding::warning(id, value)
            .fixed_by("bring the hosts and the access point nearer, or take another channel")
    } else {
        Finding::new(id, Severity::ok_if(kbps.is_some(), Severity::Note), value)
    }
}

/// The slowest bitrate towards a station, in words and kbit/s; there is none without an association.
fn bitrate(stations: &[Station]) -> (String, Option<u32>) {
    let rates = stations.iter().filter_map(|station| station.transmit?.kbps);
    let slowest = rates.min();
    let words = match slowest {
        Some(kbps) => format!("sends at {:.1} Mbit/s", f64::from(kbps) / 1000.0),
        None if stations.is_empty() => "not associated".to_owned(),
        None => "bitrate not told by the driver".to_owned(),
    };
    (words, slowest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_nic::radio::nl80211::{Generation, Rate};

    fn station(kbps: Option<u32>) -> Station {
        Station {
            transmit: Some(Rate {
                kbps,
                generation: Generation::He,
                mcs: None,
                stream_count: None,
                width_mhz: 20,
            }),
            ..Station::default()
        }
    }

    #[test]
    fn loopback_is_no_radio_and_has_no_finding() {
        assert!(examine(&["lo".to_owned(), "no-such-device".to_owned()]).is_empty());
    }

    #[test]
    fn power_save_is_a_warning_with_its_cure() {
        let fast = [station(Some(86_700))];
        let on = judge("station, 5180 MHz", Ok(true), Ok(&fast)).of("wlan0");
        assert_eq!(on.severity, Severity::Warning);
        assert_eq!(on.fix, "iw dev wlan0 set power_save off");
        let off = judge("station, 5180 MHz", Ok(false), Ok(&fast)).of("wlan0");
        assert_eq!(off.severity, Severity::Ok);
        let value = "station, 5180 MHz, power save off, sends at 86.7 Mbit/s";
        assert_eq!(off.value, value);
    }

    #[test]
    fn a_slow_or_missing_association_is_not_ok() {
        for (stations, expected) in [
            (
                vec![station(Some(1_000)), station(Some(54_000))],
                Severity::Warning,
            ),
            (vec![station(None)], Severity::Note),
            (vec![], Severity::Note),
        ] {
            let finding = judge("station", Ok(false), Ok(&stations));
            assert_eq!(finding.severity, expected, "{finding:?}");
        }
        let silent = judge("station", Err("not told".to_owned()), Ok(&[]));
        assert_eq!(silent.severity, Severity::CannotTell);
    }
}
