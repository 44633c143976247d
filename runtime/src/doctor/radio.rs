//! The radios of this host: what each is used as, and whether it sleeps to save power. Wired
//! interfaces have no finding here.

use super::Finding;
use super::finding::State;
use super::network::interfaces;
use crate::radio::socket::{RadioError, RadioSocket};

pub(crate) fn examine(wanted: &[String]) -> Vec<Finding> {
    let names = if wanted.is_empty() {
        let present = interfaces().unwrap_or_default();
        present.into_keys().collect()
    } else {
        wanted.to_vec()
    };
    names.iter().filter_map(|name| radio(name)).collect()
}

fn radio(interface: &str) -> Option<Finding> {
    let (id, title) = (
        format!("radio.{interface}"),
        format!("Radio of {interface}"),
    );
    match RadioSocket::open(interface) {
        Ok((mut socket, wireless)) => {
            let power_save = socket.is_power_save_on().map_err(|error| error.to_string());
            let frequency = wireless.frequency_mhz;
            let channel = frequency.map_or_else(String::new, |mhz| format!(", {mhz} MHz"));
            let what = format!("{}{channel}", wireless.label());
            Some(judge(&id, &title, &what, power_save))
        }
        // That it is missing or wired is said, or no matter, elsewhere.
        Err(RadioError::NotWireless(_) | RadioError::NoInterface(_)) => None,
        Err(error) => Some(Finding::unknown(&id, &title, &error.to_string())),
    }
}

fn judge(id: &str, title: &str, what: &str, power_save: Result<bool, String>) -> Finding {
    match power_save {
        Ok(false) => Finding::good(id, title, format!("{what}, power save off")),
        Ok(true) => {
            let mut finding = Finding::good(id, title, format!("{what}, power save on"));
            finding.state = State::Note;
            let interface = id.trim_start_matches("radio.");
            finding
                .because(
                    "a radio that sleeps hears of an arrival with the next beacon only, some \
                     100 ms late: delays of that size are then its own, not the network's",
                )
                .fixed_by(format!("iw dev {interface} set power_save off"))
        }
        Err(reason) => {
            let finding = Finding::good(id, title, format!("{what}, power save unknown"));
            finding.because(format!("the driver does not say: {reason}"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_is_no_radio_and_has_no_finding() {
        assert!(examine(&["lo".to_owned(), "no-such-device".to_owned()]).is_empty());
    }

    #[test]
    fn power_save_is_a_note_with_its_cure() {
        let on = judge(
            "radio.wlan0",
            "Radio of wlan0",
            "station, 5180 MHz",
            Ok(true),
        );
        assert_eq!(on.state, State::Note);
        assert!(format!("{on:?}").contains("iw dev wlan0 set power_save off"));
        let off = judge("radio.wlan0", "Radio of wlan0", "station", Ok(false));
        assert_eq!(off.state, State::Good);
    }
}
