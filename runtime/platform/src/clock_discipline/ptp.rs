//! What linuxptp's `pmc` prints of a local `ptp4l`: responses to `GET TIME_STATUS_NP` and
//! `GET CURRENT_DATA_SET` (pmc(8); IEEE 1588 clause 15.5). It runs nothing.

use serde::{Deserialize, Serialize};

use super::ntp::number;

/// What `ptp4l` says of its own clock.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PtpStatus {
    /// Identity of the grandmaster.
    pub grandmaster: String,
    /// It follows that clock; false on the grandmaster itself.
    pub is_present: bool,
    /// Last measured offset from the master, nanoseconds.
    pub master_offset_ns: i64,
    /// Mean path delay to the master, nanoseconds.
    pub path_delay_ns: f64,
}

impl PtpStatus {
    /// Reads both responses out of one text.
    ///
    /// # Errors
    /// In words: a missing or unreadable field, or more than one clock that answered.
    #[allow(
        clippy::cast_possible_truncation,
        reason = "numbers beyond nine days are refused"
    )]
    pub fn parse(text: &str) -> Result<Self, String> {
        let value = |name: &str| -> Result<&str, String> {
            let mut found = text.lines().filter_map(|line| {
                let mut words = line.split_whitespace();
                (words.next() == Some(name)).then(|| words.next().unwrap_or_default())
            });
            let value = found.next().ok_or_else(|| format!("no {name} in it"))?;
            if found.next().is_some() {
                return Err(format!("more than one clock answered with a {name}"));
            }
            Ok(value)
        };
        let number = |name: &str| {
            let number = number(name, value(name)?)?;
            // Nine days in nanoseconds: a double holds them exactly.
            if number.abs() <= 8e14 {
                Ok(number)
            } else {
                Err(format!("{name} {number} ns is outside -8e14 to 8e14"))
            }
        };
        let path_delay_ns = number("meanPathDelay")?;
        if path_delay_ns < 0.0 {
            return Err(format!("meanPathDelay {path_delay_ns} ns is below zero"));
        }
        let is_present = match value("gmPresent")? {
            "true" => true,
            "false" => false,
            other => return Err(format!("gmPresent {other:?} is neither true nor false")),
        };
        let grandmaster = value("gmIdentity")?;
        if grandmaster.is_empty() {
            return Err("gmIdentity is empty".to_owned());
        }
        Ok(Self {
            grandmaster: grandmaster.to_owned(),
            is_present,
            master_offset_ns: number("master_offset")?.round() as i64,
            path_delay_ns,
        })
    }

    /// Largest error against the grandmaster, nanoseconds: the offset not yet corrected, and a path
    /// that may take all of its time in one direction.
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "checked when read: not below zero, and nine days at most"
    )]
    pub fn bound_ns(&self) -> u64 {
        let path_ns = self.path_delay_ns.ceil() as u64;
        self.master_offset_ns.unsigned_abs().saturating_add(path_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Printed by `pmc -u -b 0` of linuxptp 3.1.1 (Debian 12) beside a `ptp4l` with software stamps and
    /// `free_running 1` that hears another over a veth.
    const RECORDED: &str = "sending: GET TIME_STATUS_NP
sending: GET CURRENT_DATA_SET
\t361e6c.fffe.0d61b0-0 seq 0 RESPONSE MANAGEMENT TIME_STATUS_NP\x20
\t\tmaster_offset              -519
\t\tingress_time               1795338462591352301
\t\tcumulativeScaledRateOffset +0.000000000
\t\tscaledLastGmPhaseChange    0
\t\tgmTimeBaseIndicator        0
\t\tlastGmPhaseChange          0x0000'0000000000000000.0000
\t\tgmPresent                  true
\t\tgmIdentity                 622b0d.fffe.8ca8c0
\t361e6c.fffe.0d61b0-0 seq 1 RESPONSE MANAGEMENT CURRENT_DATA_SET\x20
\t\tstepsRemoved     1
\t\toffsetFromMaster -519.0
\t\tmeanPathDelay    1291.0
";
    /// The same of the clock that it hears.
    const GRANDMASTER: &str = "sending: GET TIME_STATUS_NP
sending: GET CURRENT_DATA_SET
\t622b0d.fffe.8ca8c0-0 seq 0 RESPONSE MANAGEMENT TIME_STATUS_NP\x20
\t\tmaster_offset              0
\t\tingress_time               0
\t\tcumulativeScaledRateOffset +0.000000000
\t\tscaledLastGmPhaseChange    0
\t\tgmTimeBaseIndicator        0
\t\tlastGmPhaseChange          0x0000'0000000000000000.0000
\t\tgmPresent                  false
\t\tgmIdentity                 622b0d.fffe.8ca8c0
\t622b0d.fffe.8ca8c0-0 seq 1 RESPONSE MANAGEMENT CURRENT_DATA_SET\x20
\t\tstepsRemoved     0
\t\toffsetFromMaster 0.0
\t\tmeanPathDelay    0.0
";

    #[test]
    fn a_recorded_answer_gives_grandmaster_and_bound() {
        let status = PtpStatus::parse(RECORDED).unwrap();
        assert_eq!(status.grandmaster, "622b0d.fffe.8ca8c0");
        assert!(status.is_present);
        assert_eq!(status.bound_ns(), 519 + 1_291);
        let own = PtpStatus::parse(GRANDMASTER).unwrap();
        assert_eq!(own.grandmaster, status.grandmaster);
        assert!(!own.is_present);
    }

    #[test]
    fn faults_are_named() {
        let nothing = PtpStatus::parse("sending: GET TIME_STATUS_NP\n").unwrap_err();
        assert_eq!(nothing, "no meanPathDelay in it");
        let two = [RECORDED, RECORDED].concat();
        let error = PtpStatus::parse(&two).unwrap_err();
        assert_eq!(error, "more than one clock answered with a meanPathDelay");
        let odd = RECORDED.replace("true", "perhaps");
        let error = PtpStatus::parse(&odd).unwrap_err();
        assert_eq!(error, "gmPresent \"perhaps\" is neither true nor false");
    }
}
