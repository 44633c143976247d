//! Whether this host's system clock follows a reference, which, and how well: the kernel's word, and
//! that of the daemon that steers it. It steers nothing, and it believes no bound that the daemon
//! does not keep.

mod ask;
mod chrony;
mod ntp;
mod ptp;

use serde::{Deserialize, Serialize};

pub use chrony::ChronyTracking;
pub use ntp::NtpVariables;
pub use ptp::PtpStatus;

use self::ntp::is_local_reference;
use crate::realtime::clock_discipline;

/// What `phc2sys` may leave between a card's clock and the system clock: it publishes no figure, and
/// stays below this once settled. Cross-checked by the gateways' exchanges like the rest.
const PHC2SYS_ERROR_NS: u64 = 5_000;

const LOCAL_CLOCK: &str = "; its own undisciplined clock, which is nobody else's reference";
const NOT_KEPT: &str = "; the kernel says that nobody keeps the clock";
const NOBODY: &str = "none of chronyd, ptp4l, ntpd and systemd-timesyncd runs here";

/// What is known of how a host's system clock is steered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HostDiscipline {
    /// The kernel says that somebody keeps the clock (`adjtimex(2)`: neither `TIME_ERROR` nor
    /// `STA_UNSYNC`).
    pub is_kernel_synchronised: bool,
    /// The kernel's `maxerror`. A bound under chrony and ntpd; linuxptp writes zero into it only to
    /// keep `STA_UNSYNC` clear.
    pub kernel_max_error_us: i64,
    /// The kernel's `esterror`.
    pub kernel_estimated_error_us: i64,
    /// Rate correction in force, parts per billion.
    pub frequency_ppb: i64,
    /// The reference that the daemon names, comparable between hosts; `None` without one.
    pub reference: Option<String>,
    /// Largest distance of the system clock from that reference, nanoseconds.
    pub bound_ns: Option<u64>,
    /// Who says so and on what grounds, or why nobody does.
    pub basis: String,
}

impl HostDiscipline {
    /// Asks the kernel and the daemons of this host; takes a second at most.
    ///
    /// # Errors
    /// When even the kernel does not say.
    pub fn gather() -> Result<Self, String> {
        let kernel = clock_discipline().map_err(|errno| format!("adjtimex: {errno}"))?;
        let mut found = Self {
            is_kernel_synchronised: kernel.is_synchronised,
            kernel_max_error_us: kernel.max_error_us,
            kernel_estimated_error_us: kernel.estimated_error_us,
            frequency_ppb: kernel.frequency_ppb,
            reference: None,
            bound_ns: None,
            basis: String::new(),
        };
        found.believe(&ask::running_processes());
        Ok(found)
    }

    fn believe(&mut self, processes: &[String]) {
        let runs = |daemon: &str| processes.iter().any(|name| name == daemon);
        if runs("chronyd") {
            match ask::chrony() {
                Ok(tracking) => self.believe_chrony(&tracking),
                Err(why) => self.basis = format!("chronyd runs but says nothing: {why}"),
            }
        } else if runs("ptp4l") {
            match ask::ptp() {
                Ok(status) => self.believe_ptp(&status, runs("phc2sys")),
                Err(why) => self.basis = format!("ptp4l runs but says nothing: {why}"),
            }
        } else if runs("ntpd") {
            match ask::ntp() {
                Ok(variables) => self.believe_ntp(&variables),
                Err(why) => self.basis = format!("ntpd runs but says nothing: {why}"),
            }
        } else if runs("systemd-timesyn") {
            "systemd-timesyncd keeps the clock and publishes no bound of its error"
                .clone_into(&mut self.basis);
        } else {
            NOBODY.clone_into(&mut self.basis);
        }
    }

    fn believe_ntp(&mut self, variables: &NtpVariables) {
        self.basis = format!(
            "ntpd: {} (stratum {}), offset {:+.9} s, root delay {:.9} s, root dispersion {:.9} s \
             {:.0} s ago",
            variables.reference,
            variables.stratum,
            variables.offset_s,
            variables.root_delay_s,
            variables.root_dispersion_s,
            variables.age_s
        );
        let Some(bound_ns) = variables.bound_ns() else {
            self.basis = format!("ntpd: {}; not synchronised", variables.reference);
            return;
        };
        self.follow(&variables.reference, bound_ns);
    }

    fn believe_chrony(&mut self, tracking: &ChronyTracking) {
        self.basis = format!(
            "chronyd: {} (stratum {}), system {:+.9} s, root delay {:.9} s, root dispersion {:.9} s",
            tracking.reference,
            tracking.stratum,
            tracking.system_offset_s,
            tracking.root_delay_s,
            tracking.root_dispersion_s
        );
        if tracking.is_synchronised() {
            self.follow(&tracking.reference, tracking.bound_ns());
        } else {
            self.basis.push_str("; not synchronised");
        }
    }

    /// Takes the bound of a synchronised NTP daemon, unless its reference is a local clock.
    fn follow(&mut self, reference: &str, bound_ns: u64) {
        if is_local_reference(reference) {
            self.basis.push_str(LOCAL_CLOCK);
        } else if !self.is_kernel_synchronised {
            self.basis.push_str(NOT_KEPT);
        } else {
            self.reference = Some(format!("ntp {reference}"));
            self.bound_ns = Some(bound_ns);
        }
    }

    fn believe_ptp(&mut self, status: &PtpStatus, has_phc2sys: bool) {
        self.basis = format!(
            "ptp4l: grandmaster {}, offset {} ns, path delay {:.0} ns",
            status.grandmaster, status.master_offset_ns, status.path_delay_ns
        );
        if has_phc2sys {
            self.basis.push_str(", phc2sys runs");
        } else {
            // ptp4l may steer a card's clock alone, while some other daemon keeps the system's.
            self.basis
                .push_str(", but no phc2sys, so the system clock may be kept by anybody");
        }
        if !status.is_present {
            self.basis.push_str("; follows no other clock");
        } else if !self.is_kernel_synchronised {
            self.basis.push_str(NOT_KEPT);
        } else if has_phc2sys {
            self.reference = Some(format!("ptp {}", status.grandmaster));
            self.bound_ns = Some(status.bound_ns().saturating_add(PHC2SYS_ERROR_NS));
        }
    }

    /// The worse of what was found before and after a run.
    #[must_use]
    pub fn worse(self, later: Self) -> Self {
        let is_same = self.reference == later.reference;
        let bound_ns = self.bound_ns.zip(later.bound_ns).filter(|_| is_same);
        let basis = match (is_same, &self.reference) {
            (false, Some(before)) => format!("{} (before the run: {before})", later.basis),
            _ => later.basis,
        };
        Self {
            is_kernel_synchronised: self.is_kernel_synchronised && later.is_kernel_synchronised,
            kernel_max_error_us: self.kernel_max_error_us.max(later.kernel_max_error_us),
            kernel_estimated_error_us: self
                .kernel_estimated_error_us
                .max(later.kernel_estimated_error_us),
            frequency_ppb: later.frequency_ppb,
            reference: later.reference.filter(|_| is_same),
            bound_ns: bound_ns.map(|(before, after)| before.max(after)),
            basis,
        }
    }
}

/// How far two hosts' system clocks may be apart, nanoseconds.
///
/// # Errors
/// Why nothing can be said.
pub fn common_bound_ns(
    one_name: &str,
    one: &HostDiscipline,
    other_name: &str,
    other: &HostDiscipline,
) -> Result<u64, String> {
    let of = |name: &str, host: &HostDiscipline| {
        let stated = host.reference.clone().zip(host.bound_ns);
        stated.ok_or_else(|| format!("on {name}, {}", host.basis))
    };
    let (one_reference, one_ns) = of(one_name, one)?;
    let (other_reference, other_ns) = of(other_name, other)?;
    if one_reference != other_reference {
        return Err(format!(
            "{one_name} follows {one_reference}, {other_name} follows {other_reference}"
        ));
    }
    Ok(one_ns.saturating_add(other_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nobody() -> HostDiscipline {
        HostDiscipline {
            is_kernel_synchronised: true,
            kernel_max_error_us: 0,
            kernel_estimated_error_us: 0,
            frequency_ppb: 0,
            reference: None,
            bound_ns: None,
            basis: NOBODY.to_owned(),
        }
    }

    fn following(reference: &str, bound_ns: u64) -> HostDiscipline {
        HostDiscipline {
            reference: Some(reference.to_owned()),
            bound_ns: Some(bound_ns),
            ..nobody()
        }
    }

    #[test]
    fn bounds_add_up_only_under_one_reference() {
        let (near, far) = (following("ptp a", 300), following("ptp a", 900));
        assert_eq!(common_bound_ns("x", &near, "y", &far), Ok(1_200));
        let other = following("ptp b", 300);
        let why = common_bound_ns("x", &near, "y", &other).unwrap_err();
        assert_eq!(why, "x follows ptp a, y follows ptp b");
        let why = common_bound_ns("x", &near, "y", &nobody()).unwrap_err();
        assert_eq!(why, format!("on y, {NOBODY}"));
    }

    #[test]
    fn a_reference_that_changed_during_the_run_is_none() {
        let (early, late) = (following("ptp a", 300), following("ptp a", 900));
        assert_eq!(early.clone().worse(late.clone()).bound_ns, Some(900));
        assert_eq!(late.worse(early.clone()).bound_ns, Some(900));
        let changed = early.worse(following("ptp b", 1));
        assert_eq!((changed.reference, changed.bound_ns), (None, None));
    }

    #[test]
    fn a_daemon_is_not_believed_against_the_kernel() {
        let status = PtpStatus {
            grandmaster: "00a069.fffe.0b552d".to_owned(),
            is_present: true,
            master_offset_ns: -310,
            path_delay_ns: 9_310.0,
        };
        let mut host = nobody();
        host.is_kernel_synchronised = false;
        host.believe_ptp(&status, true);
        assert_eq!(host.bound_ns, None);
        // It may steer a card's clock only.
        let mut host = nobody();
        host.believe_ptp(&status, false);
        assert_eq!((host.bound_ns, host.reference), (None, None));
        assert!(host.basis.contains("no phc2sys"), "{}", host.basis);
        let mut host = nobody();
        host.believe_ptp(&status, true);
        assert_eq!(host.bound_ns, Some(9_620 + PHC2SYS_ERROR_NS));
    }

    #[test]
    fn ntpd_has_a_bound_only_while_it_and_the_kernel_say_synchronised() {
        let variables = NtpVariables {
            reference: "192.0.2.7".to_owned(),
            leap: 0,
            stratum: 2,
            offset_s: -0.000_1,
            root_delay_s: 0.002,
            root_dispersion_s: 0.003,
            age_s: 100.0,
        };
        let mut host = nobody();
        host.believe_ntp(&variables);
        assert_eq!(host.reference.as_deref(), Some("ntp 192.0.2.7"));
        // 3 + 2 / 2 + 0.1 milliseconds, and 15 ppm of 100 s.
        let bound_ns = host.bound_ns.unwrap();
        assert!((5_600_000..=5_600_001).contains(&bound_ns), "{bound_ns}");
        for local in ["LOCL", "127.127.1.0", "LOCAL(0)"] {
            let own = NtpVariables {
                reference: local.to_owned(),
                ..variables.clone()
            };
            let mut host = nobody();
            host.believe_ntp(&own);
            assert_eq!((host.bound_ns, &host.reference), (None, &None), "{local}");
        }
        let alarmed = NtpVariables {
            leap: 3,
            ..variables.clone()
        };
        let mut host = nobody();
        host.believe_ntp(&alarmed);
        assert_eq!((host.bound_ns, host.reference), (None, None));
        let mut host = nobody();
        host.is_kernel_synchronised = false;
        host.believe_ntp(&variables);
        assert_eq!((host.bound_ns, host.reference), (None, None));
        assert!(
            host.basis.ends_with("nobody keeps the clock"),
            "{}",
            host.basis
        );
    }

    #[test]
    fn a_daemon_without_figures_is_named_all_the_same() {
        let mut host = nobody();
        let names = ["systemd-timesyn", "bash", "ntpdate"].map(str::to_owned);
        host.believe(&names);
        assert!(
            host.basis.starts_with("systemd-timesyncd keeps"),
            "{}",
            host.basis
        );
        assert_eq!((&host.reference, host.bound_ns), (&None, None));
        host.believe(&["bash", "ntpdate"].map(str::to_owned));
        assert_eq!(host.basis, NOBODY);
    }

    #[test]
    fn this_host_says_something() {
        let found = HostDiscipline::gather().unwrap();
        assert!(!found.basis.is_empty());
        assert_eq!(found.reference.is_some(), found.bound_ns.is_some());
    }
}
