//! Switches the stamps of a network card on for a run and puts the card back as it was. What the
//! card then really delivers is found out by [`super::probe`].

use core::fmt;
use std::io;

use thiserror::Error;

use super::timestamping::HardwareStamping;

/// Names of `HWTSTAMP_FILTER_*`, `linux/net_tstamp.h`, in the order of their numbers.
const FILTER_NAMES: [&str; 16] = [
    "none",
    "all",
    "some",
    "PTPv1 event",
    "PTPv1 sync",
    "PTPv1 delay request",
    "PTPv2 event over UDP",
    "PTPv2 sync over UDP",
    "PTPv2 delay request over UDP",
    "PTPv2 event over Ethernet",
    "PTPv2 sync over Ethernet",
    "PTPv2 delay request over Ethernet",
    "PTPv2 event",
    "PTPv2 sync",
    "PTPv2 delay request",
    "NTP",
];
const FILTER_NONE: i32 = 0;
const FILTER_ALL: i32 = 1;

/// The settings of one card, as the kernel lets them be read and written.
pub trait CardControl: fmt::Debug + Send {
    /// How it is set up (`SIOCGHWTSTAMP`).
    ///
    /// # Errors
    /// When the driver does not say.
    fn query(&self) -> io::Result<HardwareStamping>;

    /// Sets it up (`SIOCSHWTSTAMP`); gives what it settled for.
    ///
    /// # Errors
    /// When the driver refuses.
    fn set(&self, wanted: HardwareStamping) -> io::Result<HardwareStamping>;
}

/// The card behind an interface of this host.
#[derive(Debug, Clone)]
pub struct InterfaceCard {
    /// Name of the interface.
    pub interface: String,
}

impl CardControl for InterfaceCard {
    fn query(&self) -> io::Result<HardwareStamping> {
        HardwareStamping::query(&self.interface)
    }

    fn set(&self, wanted: HardwareStamping) -> io::Result<HardwareStamping> {
        HardwareStamping::set(&self.interface, wanted)
    }
}

/// Why a card could not be armed.
#[derive(Debug, Error)]
pub enum ArmError {
    /// The interface has no card that stamps.
    #[error("its driver sets up no hardware stamps, as on loopback, veth and virtio")]
    NotOffered,
    /// Not allowed.
    #[error("switching the card's stamps on needs CAP_NET_ADMIN")]
    NotAllowed,
    /// The card refused every setting.
    #[error("the card refuses to stamp what it sends: {0}")]
    Refused(io::Error),
}

/// A card that stamps what it sends. Put back as it was when dropped, unless
/// [`ArmedCard::restore`] did so before.
#[derive(Debug)]
pub struct ArmedCard<C: CardControl = InterfaceCard> {
    card: C,
    former: Option<HardwareStamping>,
    granted: HardwareStamping,
    refusal: Option<String>,
    is_restored: bool,
}

impl<C: CardControl> ArmedCard<C> {
    /// Asks for stamps of all that is sent and all that arrives. A card that cannot stamp all
    /// arrivals keeps the receive filter it has, which a PTP daemon may depend on: no other
    /// filter lets a run's datagrams through.
    ///
    /// # Errors
    /// When the card does not even stamp what it sends; it is left as it was.
    pub fn arm(card: C) -> Result<Self, ArmError> {
        let former = card.query().ok();
        let kept_filter = former.map_or(FILTER_NONE, |former| former.receive_filter);
        let mut refusal: Option<io::Error> = None;
        for receive_filter in [FILTER_ALL, kept_filter, FILTER_NONE] {
            let wanted = HardwareStamping {
                is_transmit_on: true,
                receive_filter,
            };
            match card.set(wanted) {
                Ok(granted) if granted.is_transmit_on => {
                    return Ok(Self {
                        card,
                        former,
                        granted,
                        refusal: refusal.map(|error| error.to_string()),
                        is_restored: false,
                    });
                }
                Ok(_) => {
                    // What it settled for instead is not what it was.
                    if let Some(former) = former {
                        let _refused_again = card.set(former);
                    }
                    let error = io::Error::other("it accepts the setting and leaves them off");
                    return Err(ArmError::Refused(error));
                }
                Err(error) => match error.raw_os_error() {
                    Some(libc::EPERM | libc::EACCES) => return Err(ArmError::NotAllowed),
                    Some(libc::EOPNOTSUPP | libc::ENOTTY) => return Err(ArmError::NotOffered),
                    // The first is the one to report: it was for what was really wanted.
                    _ => refusal = Some(refusal.unwrap_or(error)),
                },
            }
        }
        let nothing = || io::Error::other("no setting was accepted");
        Err(ArmError::Refused(refusal.unwrap_or_else(nothing)))
    }

    /// How it was set up before; `None` when the driver does not say.
    pub const fn former(&self) -> Option<HardwareStamping> {
        self.former
    }

    /// What it granted.
    pub const fn granted(&self) -> HardwareStamping {
        self.granted
    }

    /// True when all arrivals are stamped.
    pub const fn stamps_all_arrivals(&self) -> bool {
        self.granted.receive_filter == FILTER_ALL
    }

    /// What was asked for and granted, in words.
    pub fn describe(&self) -> String {
        let filter = filter_name(self.granted.receive_filter);
        match &self.refusal {
            Some(refusal) => format!(
                "transmit on; receive filter {filter} (all was refused: {refusal}): arriving \
                 datagrams of a run get no hardware stamp from this card"
            ),
            None => format!("transmit on; receive filter {filter}"),
        }
    }

    /// Puts the card back as it was, or switches it off where that is not known.
    ///
    /// # Errors
    /// When the driver refuses.
    pub fn restore(&mut self) -> io::Result<HardwareStamping> {
        self.is_restored = true;
        self.card.set(self.former.unwrap_or(HardwareStamping {
            is_transmit_on: false,
            receive_filter: FILTER_NONE,
        }))
    }
}

impl<C: CardControl> Drop for ArmedCard<C> {
    fn drop(&mut self) {
        if !self.is_restored {
            // There is nobody left to tell.
            let _untold = self.restore();
        }
    }
}

/// A receive filter in words.
pub fn filter_name(filter: i32) -> String {
    let known = usize::try_from(filter).ok();
    let name = known.and_then(|number| FILTER_NAMES.get(number));
    name.map_or_else(|| format!("number {filter}"), |name| (*name).to_owned())
}

/// A setting in words.
pub fn describe_setting(setting: HardwareStamping) -> String {
    let transmit = if setting.is_transmit_on { "on" } else { "off" };
    let filter = filter_name(setting.receive_filter);
    format!("transmit {transmit}, receive filter {filter}")
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;

    const OFF: HardwareStamping = HardwareStamping {
        is_transmit_on: false,
        receive_filter: FILTER_NONE,
    };
    const PTP_V2_EVENT: i32 = 12;

    /// A card that accepts some filters and remembers how it is set.
    #[derive(Debug, Clone)]
    struct FakeCard {
        filters: Vec<i32>,
        error: i32,
        setting: Arc<Mutex<HardwareStamping>>,
        has_query: bool,
        can_transmit: bool,
    }

    impl FakeCard {
        fn new(filters: &[i32], setting: HardwareStamping) -> Self {
            Self {
                filters: filters.to_vec(),
                error: libc::ERANGE,
                setting: Arc::new(Mutex::new(setting)),
                has_query: true,
                can_transmit: true,
            }
        }

        fn setting(&self) -> HardwareStamping {
            *self.setting.lock().unwrap()
        }
    }

    impl CardControl for FakeCard {
        fn query(&self) -> io::Result<HardwareStamping> {
            if self.has_query {
                Ok(self.setting())
            } else {
                Err(io::Error::from_raw_os_error(libc::EOPNOTSUPP))
            }
        }

        fn set(&self, wanted: HardwareStamping) -> io::Result<HardwareStamping> {
            if !self.filters.contains(&wanted.receive_filter) {
                return Err(io::Error::from_raw_os_error(self.error));
            }
            let settled = HardwareStamping {
                is_transmit_on: wanted.is_transmit_on && self.can_transmit,
                ..wanted
            };
            *self.setting.lock().unwrap() = settled;
            Ok(settled)
        }
    }

    #[test]
    fn a_card_that_stamps_everything_is_armed_and_put_back() {
        let card = FakeCard::new(&[0, 1], OFF);
        let armed = ArmedCard::arm(card.clone()).unwrap();
        assert!(armed.stamps_all_arrivals());
        assert_eq!(armed.describe(), "transmit on; receive filter all");
        assert!(card.setting().is_transmit_on);
        drop(armed);
        assert_eq!(card.setting(), OFF);
    }

    #[test]
    fn a_card_that_refuses_all_arrivals_keeps_the_filter_of_a_ptp_daemon() {
        let daemon = HardwareStamping {
            is_transmit_on: true,
            receive_filter: PTP_V2_EVENT,
        };
        let card = FakeCard::new(&[0, PTP_V2_EVENT], daemon);
        let mut armed = ArmedCard::arm(card.clone()).unwrap();
        assert_eq!(armed.granted().receive_filter, PTP_V2_EVENT);
        assert!(!armed.stamps_all_arrivals());
        let text = armed.describe();
        assert!(text.contains("receive filter PTPv2 event"), "{text}");
        assert!(text.contains("all was refused"), "{text}");
        assert_eq!(armed.restore().unwrap(), daemon);
    }

    #[test]
    fn a_card_that_knows_no_other_filter_is_granted_none() {
        let card = FakeCard::new(&[0], OFF);
        let armed = ArmedCard::arm(card).unwrap();
        assert_eq!(armed.granted().receive_filter, FILTER_NONE);
        assert_eq!(armed.former(), Some(OFF));
    }

    #[test]
    fn a_card_that_does_not_tell_its_setting_is_switched_off_at_the_end() {
        let mut card = FakeCard::new(&[0, 1], OFF);
        card.has_query = false;
        let mut armed = ArmedCard::arm(card.clone()).unwrap();
        assert_eq!(armed.former(), None);
        assert_eq!(armed.restore().unwrap(), OFF);
        assert_eq!(card.setting(), OFF);
    }

    #[test]
    fn a_refusal_says_what_is_missing_and_leaves_the_card_alone() {
        for (error, words) in [
            (libc::EPERM, "CAP_NET_ADMIN"),
            (libc::EOPNOTSUPP, "veth"),
            (libc::EIO, "refuses to stamp"),
        ] {
            let mut card = FakeCard::new(&[], OFF);
            card.error = error;
            let text = ArmedCard::arm(card.clone()).unwrap_err().to_string();
            assert!(text.contains(words), "{text}");
            assert_eq!(card.setting(), OFF);
        }
        let mut mute = FakeCard::new(&[0, 1], OFF);
        mute.can_transmit = false;
        let text = ArmedCard::arm(mute.clone()).unwrap_err().to_string();
        assert!(text.contains("leaves them off"), "{text}");
        assert_eq!(mute.setting(), OFF);
    }

    #[test]
    fn loopback_has_no_card_to_arm() {
        let interface = "lo".to_owned();
        let error = ArmedCard::arm(InterfaceCard { interface }).unwrap_err();
        assert!(
            matches!(error, ArmError::NotOffered | ArmError::NotAllowed),
            "{error}"
        );
    }

    #[test]
    fn settings_are_put_into_words() {
        assert_eq!(filter_name(15), "NTP");
        assert_eq!(filter_name(77), "number 77");
        assert_eq!(filter_name(-1), "number -1");
        assert_eq!(describe_setting(OFF), "transmit off, receive filter none");
    }
}
