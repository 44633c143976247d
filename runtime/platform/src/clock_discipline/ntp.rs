//! What `ntpq -n -c rv` prints: the system variables of a local `ntpd` (RFC 5905, section 9.2;
//! RFC 9327). It runs nothing.

use serde::{Deserialize, Serialize};

/// How fast a clock may stray between updates, seconds per second (RFC 5905: PHI).
const DISPERSION_RATE: f64 = 15e-6;
/// A day: a clock that far off, or that long without an update, has no bound worth the name.
const SECONDS_MAX: f64 = 86_400.0;

/// The system variables of `ntpd` that bound the clock's error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NtpVariables {
    /// Identifier of the source: an address, or a name such as `GPS`.
    pub reference: String,
    /// Leap indicator; 3 while not synchronised.
    pub leap: u32,
    /// Hops from a reference clock; 16 when not synchronised.
    pub stratum: u32,
    /// Source minus system clock, seconds.
    pub offset_s: f64,
    /// Network delay to the stratum-1 source, seconds.
    pub root_delay_s: f64,
    /// Dispersion to it at the last update, seconds.
    pub root_dispersion_s: f64,
    /// Time since the last update, seconds.
    pub age_s: f64,
}

impl NtpVariables {
    /// Reads the variables.
    ///
    /// # Errors
    /// In words, with the variable and its text.
    pub fn parse(text: &str) -> Result<Self, String> {
        let value = |name: &str| -> Result<&str, String> {
            let mut items = text.split([',', '\n']).map(str::trim);
            let found = items.find_map(|item| item.strip_prefix(name)?.strip_prefix('='));
            found.ok_or_else(|| format!("no {name} in it"))
        };
        let whole = |name: &str, radix: u32| -> Result<u32, String> {
            let text = value(name)?;
            u32::from_str_radix(text, radix).map_err(|error| format!("{name} {text:?}: {error}"))
        };
        let seconds =
            |name: &str, lowest_s: f64| within(name, number(name, value(name)?)? / 1e3, lowest_s);
        let instant_s = |name: &str| -> Result<f64, String> {
            let text = value(name)?;
            // Sixty-four bits, whole seconds before the point; then the same in words.
            let word = text.split_whitespace().next().unwrap_or_default();
            let parsed = word.split_once('.').and_then(|(whole, fraction)| {
                let whole = u32::from_str_radix(whole, 16).ok()?;
                let fraction = u32::from_str_radix(fraction, 16).ok()?;
                Some(f64::from(whole) + f64::from(fraction) / 4_294_967_296.0)
            });
            parsed.ok_or_else(|| format!("{name} {text:?} is no NTP time stamp"))
        };
        let age_s = instant_s("clock")? - instant_s("reftime")?;
        let variables = Self {
            reference: value("refid")?.to_owned(),
            leap: whole("leap", 2)?,
            stratum: whole("stratum", 10)?,
            offset_s: seconds("offset", -SECONDS_MAX)?,
            root_delay_s: seconds("rootdelay", 0.0)?,
            root_dispersion_s: seconds("rootdisp", 0.0)?,
            age_s,
        };
        if variables.is_synchronised() {
            within("time since the last update", age_s, 0.0)?;
        }
        Ok(variables)
    }

    /// True while it follows a source.
    pub fn is_synchronised(&self) -> bool {
        self.leap != 3 && (1..16).contains(&self.stratum)
    }

    /// Largest error of the system clock against the reference, nanoseconds; `None` when not
    /// synchronised. Root distance (RFC 5905, appendix A.5.5.2), the offset it has yet to correct,
    /// and what the clock may have strayed since the last update.
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "each part is at most a day and none below zero"
    )]
    pub fn bound_ns(&self) -> Option<u64> {
        let strayed_s = DISPERSION_RATE * self.age_s;
        let bound_s =
            self.root_dispersion_s + self.root_delay_s / 2.0 + self.offset_s.abs() + strayed_s;
        self.is_synchronised()
            .then(|| (bound_s * 1e9).ceil() as u64)
    }
}

/// Drivers of an undisciplined local clock: ntpd's (127.127.1.u, `LOCL`, ntpsec's `LOCAL(u)`) and
/// chronyd's (`7F7F0101`, 127.127.1.1). Two hosts that each follow their own have no clock in
/// common, whatever their references are called.
pub(super) fn is_local_reference(reference: &str) -> bool {
    reference.split_whitespace().any(|word| {
        word.starts_with("127.")
            || word == "LOCL"
            || word.starts_with("LOCAL")
            || word.starts_with("7F7F")
    })
}

pub(super) fn number(name: &str, text: &str) -> Result<f64, String> {
    text.parse::<f64>()
        .map_err(|error| format!("{name} {text:?}: {error}"))
}

pub(super) fn within(name: &str, value_s: f64, lowest_s: f64) -> Result<f64, String> {
    if (lowest_s..=SECONDS_MAX).contains(&value_s) {
        Ok(value_s)
    } else {
        Err(format!(
            "{name} {value_s} s is outside {lowest_s} to {SECONDS_MAX}"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Printed by `ntpq -n -c rv 127.0.0.1` for ntpd of ntpsec 1.2.2 (Debian 12), without the right
    /// to set a clock, 20 s after it began to follow a `chronyd` over a veth.
    const RECORDED: &str = "associd=0 status=0014 leap_none, sync_unspec, 1 event, freq_mode,
leap=00, stratum=11, precision=-23, rootdelay=0.045, rootdisp=1.015,
refid=10.99.4.1, reftime=eead2f17.a61d0317 2026-11-22T09:06:31.648Z, tc=0,
peer=17767, offset=0.012957, frequency=0.0, sys_jitter=0.0,
clk_jitter=0.004144, clock=eead2f18.c2294c3a 2026-11-22T09:06:32.758Z,
processor=\"x86_64\", system=\"Linux/6.18.44\",
version=\"ntpd ntpsec-1.2.2\", clk_wander=0.0, mintc=0
";
    /// The same three seconds after its start.
    const UNSYNCHRONISED: &str = "associd=0 status=c016 leap_alarm, sync_unspec, 1 event, restart,
leap=11, stratum=16, precision=-23, rootdelay=0.0, rootdisp=0.045,
refid=INIT, reftime=00000000.00000000 2036-02-07T06:28:16.000Z, tc=0, peer=0,
offset=0.0, frequency=0.0, sys_jitter=0.0, clk_jitter=0.000119,
clock=eead2edc.af208e30 2026-11-22T09:05:32.684Z, processor=\"x86_64\",
system=\"Linux/6.18.44\", version=\"ntpd ntpsec-1.2.2\", clk_wander=0.0,
mintc=0
";

    #[test]
    fn a_recorded_answer_gives_root_distance_offset_and_drift() {
        let variables = NtpVariables::parse(RECORDED).unwrap();
        assert_eq!(variables.reference, "10.99.4.1");
        assert_eq!((variables.leap, variables.stratum), (0, 11));
        assert!(
            (1.109..1.110).contains(&variables.age_s),
            "{}",
            variables.age_s
        );
        // 1015 + 45 / 2 + 12.957 microseconds, and 15 ppm of 1.1094 s.
        let bound_ns = variables.bound_ns().unwrap();
        assert!((1_067_090..=1_067_110).contains(&bound_ns), "{bound_ns}");
    }

    #[test]
    fn an_idle_daemon_has_no_bound() {
        let variables = NtpVariables::parse(UNSYNCHRONISED).unwrap();
        assert!(!variables.is_synchronised());
        assert_eq!(variables.bound_ns(), None);
        assert_eq!(variables.reference, "INIT");
    }

    #[test]
    fn faults_are_named() {
        let silent = NtpVariables::parse("***Request timed out\n").unwrap_err();
        assert_eq!(silent, "no clock in it");
        let infinite = RECORDED.replace("rootdisp=1.015", "rootdisp=inf");
        let error = NtpVariables::parse(&infinite).unwrap_err();
        assert_eq!(error, "rootdisp inf s is outside 0 to 86400");
        let odd = RECORDED.replace("eead2f18.c2294c3a", "noon");
        let error = NtpVariables::parse(&odd).unwrap_err();
        assert!(error.ends_with("is no NTP time stamp"), "{error}");
        let ahead = RECORDED.replace("eead2f17", "eead2f19");
        let error = NtpVariables::parse(&ahead).unwrap_err();
        assert!(error.starts_with("time since the last update"), "{error}");
    }
}
