//! What `chronyc -c tracking` prints: one line of comma-separated values (chronyc(1), "tracking").
//! It runs nothing.

use serde::{Deserialize, Serialize};

use super::ntp::{number, within};

/// The fields of `chronyc -c tracking` that bound the clock's error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChronyTracking {
    /// Reference identifier and name or address of the source.
    pub reference: String,
    /// Hops from a reference clock; 0 when not synchronised.
    pub stratum: u32,
    /// chronyd's idea of the time minus the system clock, seconds: what it has yet to slew.
    pub system_offset_s: f64,
    /// Network delay to the stratum-1 source, seconds.
    pub root_delay_s: f64,
    /// Accumulated dispersion to it, seconds.
    pub root_dispersion_s: f64,
    /// `Normal`, `Insert second`, `Delete second` or `Not synchronised`.
    pub leap_status: String,
}

/// Fields of the line.
const FIELD_COUNT: usize = 14;

impl ChronyTracking {
    /// Reads the line.
    ///
    /// # Errors
    /// In words, with the field and its text.
    pub fn parse(text: &str) -> Result<Self, String> {
        let line = text.lines().find(|line| !line.trim().is_empty());
        let line = line.ok_or("an empty answer")?;
        let fields: Vec<&str> = line.trim().split(',').collect();
        if fields.len() != FIELD_COUNT {
            let count = fields.len();
            return Err(format!("{count} fields, {FIELD_COUNT} expected: {line:?}"));
        }
        let seconds = |index: usize, name: &str, lowest_s: f64| {
            within(name, number(name, fields[index])?, lowest_s)
        };
        let stratum = fields[2]
            .parse()
            .map_err(|error| format!("stratum {:?}: {error}", fields[2]))?;
        Ok(Self {
            reference: format!("{} {}", fields[0], fields[1]).trim().to_owned(),
            stratum,
            system_offset_s: seconds(4, "system time", -86_400.0)?,
            root_delay_s: seconds(10, "root delay", 0.0)?,
            root_dispersion_s: seconds(11, "root dispersion", 0.0)?,
            leap_status: fields[13].to_owned(),
        })
    }

    /// True while it follows a source.
    pub fn is_synchronised(&self) -> bool {
        self.leap_status != "Not synchronised" && (1..16).contains(&self.stratum)
    }

    /// Largest error of the system clock against the reference, nanoseconds: root dispersion, half
    /// the root delay, and what chronyd has yet to slew (chrony FAQ, "clock error bound").
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "each part is at most a day and none below zero"
    )]
    pub fn bound_ns(&self) -> u64 {
        let bound_s = self.root_dispersion_s + self.root_delay_s / 2.0 + self.system_offset_s.abs();
        (bound_s * 1e9).ceil() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Printed by `chronyc -n -c tracking` of chrony 4.3 (Debian 12): a `chronyd -x` that follows
    /// another over a veth, ten seconds after its start.
    const RECORDED: &str = "0A630401,10.99.4.1,11,1795338139.876353805,-0.000002356,-0.000000850,\
                            0.000001875,0.011,0.002,0.268,0.000009866,0.000002140,1.0,Normal\n";
    /// The same with a server that does not answer.
    const UNSYNCHRONISED: &str = "00000000,,0,0.000000000,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,\
         1.000000000,1.000000000,0.0,Not synchronised\n";

    #[test]
    fn a_recorded_answer_gives_the_bound_of_the_manual() {
        let tracking = ChronyTracking::parse(RECORDED).unwrap();
        assert_eq!(tracking.reference, "0A630401 10.99.4.1");
        assert_eq!(tracking.stratum, 11);
        assert!(tracking.is_synchronised());
        // 2.140 + 9.866 / 2 + 2.356 microseconds.
        assert!((9_429..=9_430).contains(&tracking.bound_ns()));
    }

    #[test]
    fn an_idle_daemon_is_not_synchronised() {
        let tracking = ChronyTracking::parse(UNSYNCHRONISED).unwrap();
        assert!(!tracking.is_synchronised());
        assert_eq!(tracking.reference, "00000000");
    }

    #[test]
    fn faults_are_named() {
        let short = ChronyTracking::parse("506 Cannot talk to daemon\n").unwrap_err();
        assert!(short.starts_with("1 fields, 14 expected"), "{short}");
        let infinite = RECORDED.replace("0.000009866", "inf");
        let error = ChronyTracking::parse(&infinite).unwrap_err();
        assert_eq!(error, "root delay inf s is outside 0 to 86400");
    }
}
