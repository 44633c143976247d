//! Switches the stamps of a network card on for a run and puts the card back as it was. What the
//! card then really delivers only sending shows.

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
const FILTER_ALL: i32 = 1;
/// Names of `HWTSTAMP_TX_*` in the order of their numbers.
const TRANSMIT_NAMES: [&str; 4] = [
    "off",
    "on",
    "on with one-step PTP sync",
    "on with one-step PTP sync and peer delay",
];

/// The settings of one card, as the kernel lets them be read and written.
pub trait NicControl: fmt::Debug + Send {
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
pub struct InterfaceNic {
    /// Name of the interface.
    pub interface: String,
}

impl NicControl for InterfaceNic {
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
    /// The driver does not say how the card is set up.
    #[error(
        "its driver does not say how the card is set up ({0}), as on loopback, veth and virtio; what \
         could not be put back is left alone"
    )]
    Unreadable(io::Error),
    /// Not allowed.
    #[error("switching the card's stamps on needs CAP_NET_ADMIN")]
    NotAllowed,
    /// The card refused every setting.
    #[error("the card refuses to stamp what it sends: {0}")]
    Refused(io::Error),
}

/// A card that stamps what it sends. Put back as it was when dropped, unless
/// [`ArmedNic::restore`] did so before.
#[derive(Debug)]
pub struct ArmedNic<C: NicControl = InterfaceNic> {
    card: C,
    former: HardwareStamping,
    granted: HardwareStamping,
    refusal: Option<String>,
    is_restored: bool,
}

impl<C: NicControl> ArmedNic<C> {
    /// Asks for stamps of all that is sent and all that arrives. What the card is set up for
    /// besides stays: its flags, a transmit type that gives stamps already, and, when it cannot
    /// stamp all arrivals, its receive filter, which a PTP daemon may depend on. No other filter
    /// lets a run's datagrams through.
    ///
    /// # Errors
    /// When the card does not say how it is set up, or does not even stamp what it sends; it is left
    /// as it was.
    pub fn arm(card: C) -> Result<Self, ArmError> {
        let former = card.query().map_err(ArmError::Unreadable)?;
        let mut refusal: Option<io::Error> = None;
        for receive_filter in [FILTER_ALL, former.receive_filter] {
            let wanted = HardwareStamping {
                receive_filter,
                ..former.with_transmit()
            };
            match card.set(wanted) {
                Ok(granted) if granted.is_transmit_on() => {
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
                    let _refused_again = card.set(former);
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

    /// How it was set up before.
    pub const fn former(&self) -> HardwareStamping {
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
        let granted = describe_setting(self.granted);
        match &self.refusal {
            Some(refusal) => format!(
                "{granted} (all was refused: {refusal}): arriving datagrams of a run get no hardware \
                 stamp from this card"
            ),
            None => granted,
        }
    }

    /// Puts the card back as it was; gives how it says it is set up now, which may differ from
    /// [`ArmedNic::former`].
    ///
    /// # Errors
    /// When the driver refuses.
    pub fn restore(&mut self) -> io::Result<HardwareStamping> {
        self.is_restored = true;
        let settled = self.card.set(self.former)?;
        Ok(self.card.query().unwrap_or(settled))
    }

    /// Puts the card back as it was, and says what it was and whether that came about.
    pub fn restore_in_words(&mut self) -> String {
        let former = describe_setting(self.former);
        match self.restore() {
            Ok(now) if now == self.former => format!("was {former}; put back so"),
            Ok(now) => format!(
                "was {former}; could NOT be put back so: the card settled for {}",
                describe_setting(now)
            ),
            Err(error) => format!("was {former}; could NOT be put back: {error}"),
        }
    }
}

impl<C: NicControl> Drop for ArmedNic<C> {
    fn drop(&mut self) {
        if !self.is_restored {
            // There is nobody left to tell.
            let _untold = self.restore();
        }
    }
}

/// A receive filter in words.
pub fn filter_name(filter: i32) -> String {
    numbered(&FILTER_NAMES, filter)
}

fn numbered(names: &[&str], number: i32) -> String {
    let known = usize::try_from(number).ok();
    let name = known.and_then(|index| names.get(index));
    name.map_or_else(|| format!("number {number}"), |name| (*name).to_owned())
}

/// A setting in words.
pub fn describe_setting(setting: HardwareStamping) -> String {
    let transmit = numbered(&TRANSMIT_NAMES, setting.transmit_type);
    let filter = filter_name(setting.receive_filter);
    let flags = match setting.flags {
        0 => String::new(),
        flags => format!(", flags {flags:#x}"),
    };
    format!("transmit {transmit}, receive filter {filter}{flags}")
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;

    const OFF: HardwareStamping = HardwareStamping::OFF;
    const PTP_V2_EVENT: i32 = 12;
    const TX_ON: i32 = 1;
    const TX_ONESTEP_SYNC: i32 = 2;
    const TX_ONESTEP_P2P: i32 = 3;
    const BONDED: i32 = 1;

    /// A card that accepts some filters and remembers how it is set.
    #[derive(Debug, Clone)]
    struct FakeNic {
        filters: Vec<i32>,
        error: i32,
        setting: Arc<Mutex<HardwareStamping>>,
        has_query: bool,
        can_transmit: bool,
    }

    impl FakeNic {
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

    impl NicControl for FakeNic {
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
            let transmit_type = if self.can_transmit {
                wanted.transmit_type
            } else {
                OFF.transmit_type
            };
            let settled = HardwareStamping {
                transmit_type,
                ..wanted
            };
            *self.setting.lock().unwrap() = settled;
            Ok(settled)
        }
    }

    #[test]
    fn a_nic_that_stamps_everything_is_armed_and_put_back() {
        let card = FakeNic::new(&[0, 1], OFF);
        let armed = ArmedNic::arm(card.clone()).unwrap();
        assert!(armed.stamps_all_arrivals());
        assert_eq!(armed.describe(), "transmit on, receive filter all");
        assert_eq!(card.setting().transmit_type, TX_ON);
        drop(armed);
        assert_eq!(card.setting(), OFF);
    }

    #[test]
    fn a_nic_that_refuses_all_arrivals_keeps_the_filter_of_a_ptp_daemon() {
        let daemon = HardwareStamping {
            transmit_type: TX_ON,
            receive_filter: PTP_V2_EVENT,
            ..OFF
        };
        let card = FakeNic::new(&[0, PTP_V2_EVENT], daemon);
        let mut armed = ArmedNic::arm(card.clone()).unwrap();
        assert_eq!(armed.granted().receive_filter, PTP_V2_EVENT);
        assert!(!armed.stamps_all_arrivals());
        let text = armed.describe();
        assert!(text.contains("receive filter PTPv2 event"), "{text}");
        assert!(text.contains("all was refused"), "{text}");
        assert_eq!(armed.restore().unwrap(), daemon);
    }

    #[test]
    fn one_step_ptp_and_the_flags_of_a_bond_stay_while_armed_and_afterwards() {
        for transmit_type in [TX_ON, TX_ONESTEP_SYNC, TX_ONESTEP_P2P] {
            let daemon = HardwareStamping {
                flags: BONDED,
                transmit_type,
                receive_filter: PTP_V2_EVENT,
            };
            let card = FakeNic::new(&[0, 1, PTP_V2_EVENT], daemon);
            let mut armed = ArmedNic::arm(card.clone()).unwrap();
            let while_armed = HardwareStamping {
                receive_filter: FILTER_ALL,
                ..daemon
            };
            assert_eq!(
                (armed.granted(), card.setting()),
                (while_armed, while_armed)
            );
            let told = armed.restore_in_words();
            assert!(told.ends_with("flags 0x1; put back so"), "{told}");
            assert_eq!(card.setting(), daemon);
        }
    }

    #[test]
    fn a_filter_of_another_user_is_never_switched_off() {
        let daemon = HardwareStamping {
            transmit_type: TX_ON,
            receive_filter: PTP_V2_EVENT,
            ..OFF
        };
        // It grants nothing but silence now.
        let card = FakeNic::new(&[0], daemon);
        let error = ArmedNic::arm(card.clone()).unwrap_err();
        assert!(matches!(error, ArmError::Refused(_)), "{error}");
        assert_eq!(card.setting(), daemon);
    }

    #[test]
    fn a_nic_that_settles_for_something_else_at_the_end_is_said_to() {
        let one_step = HardwareStamping {
            transmit_type: TX_ONESTEP_SYNC,
            ..OFF
        };
        let mut armed = ArmedNic::arm(FakeNic::new(&[0, 1], one_step)).unwrap();
        armed.card.can_transmit = false;
        let told = armed.restore_in_words();
        let expected = "was transmit on with one-step PTP sync, receive filter none; could NOT be put \
                        back so: the card settled for transmit off, receive filter none";
        assert_eq!(told, expected);
    }

    #[test]
    fn a_nic_that_knows_no_other_filter_is_granted_none() {
        let card = FakeNic::new(&[0], OFF);
        let armed = ArmedNic::arm(card).unwrap();
        assert_eq!(armed.granted().receive_filter, OFF.receive_filter);
        assert_eq!(armed.former(), OFF);
    }

    #[test]
    fn a_nic_that_does_not_tell_its_setting_is_left_alone() {
        let found = HardwareStamping {
            transmit_type: TX_ON,
            receive_filter: PTP_V2_EVENT,
            ..OFF
        };
        let mut card = FakeNic::new(&[0, 1, PTP_V2_EVENT], found);
        card.has_query = false;
        let error = ArmedNic::arm(card.clone()).unwrap_err().to_string();
        assert!(error.contains("could not be put back"), "{error}");
        assert_eq!(card.setting(), found);
    }

    #[test]
    fn a_refusal_says_what_is_missing_and_leaves_the_nic_alone() {
        for (error, words) in [
            (libc::EPERM, "CAP_NET_ADMIN"),
            (libc::EOPNOTSUPP, "veth"),
            (libc::EIO, "refuses to stamp"),
        ] {
            let mut card = FakeNic::new(&[], OFF);
            card.error = error;
            let text = ArmedNic::arm(card.clone()).unwrap_err().to_string();
            assert!(text.contains(words), "{text}");
            assert_eq!(card.setting(), OFF);
        }
        let mut mute = FakeNic::new(&[0, 1], OFF);
        mute.can_transmit = false;
        let text = ArmedNic::arm(mute.clone()).unwrap_err().to_string();
        assert!(text.contains("leaves them off"), "{text}");
        assert_eq!(mute.setting(), OFF);
    }

    #[test]
    fn loopback_has_no_nic_to_arm() {
        let interface = "lo".to_owned();
        let error = ArmedNic::arm(InterfaceNic { interface }).unwrap_err();
        assert!(matches!(error, ArmError::Unreadable(_)), "{error}");
    }

    #[test]
    fn settings_are_put_into_words() {
        assert_eq!(filter_name(15), "NTP");
        assert_eq!(filter_name(77), "number 77");
        assert_eq!(filter_name(-1), "number -1");
        assert_eq!(describe_setting(OFF), "transmit off, receive filter none");
    }
}
