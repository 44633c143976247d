//! The clocks of this host: which counter, what a read costs, and who steers the time of day. It
//! does not compare the host with another; that is the gateways' alignment.

use std::hint::black_box;

use super::finding::{Answer, Checked, Finding, Severity, settled};
use hil_platform::clock::MonotonicClock;
use hil_platform::clock_discipline::{HostDiscipline, common_bound_ns};

/// A vDSO read stays below this on any PC of the last ten years.
const READ_COST_NS_OK: f64 = 100.0;
/// Above this the read is a system call, as long as a shared-memory hop.
const READ_COST_NS_BAD: f64 = 1000.0;

/// `found` is what kernel and daemons say; `other` the same of another host, with its name.
pub(super) fn examine(
    found: &Result<HostDiscipline, String>,
    other: Option<(&str, Option<&HostDiscipline>)>,
) -> Vec<Finding> {
    let mut findings = vec![read_cost(cheapest_read_ns())];
    findings.extend(steering(found));
    let own = found.as_ref().ok();
    findings.extend(other.map(|(name, other)| settled(between(own, name, other)).of(name)));
    findings
}

/// The cheapest of 20 batches: the cost itself, with the scheduler's interruptions left out.
fn cheapest_read_ns() -> f64 {
    const READ_COUNT: u32 = 5000;
    let batches = (0..20).map(|_| {
        let start = MonotonicClock::now();
        for _ in 0..READ_COUNT {
            black_box(MonotonicClock::now());
        }
        MonotonicClock::now().ns_since(start) as f64 / f64::from(READ_COUNT)
    });
    batches.fold(f64::INFINITY, f64::min)
}

fn read_cost(cost_ns: f64) -> Finding {
    let severity = match cost_ns {
        ..READ_COST_NS_OK => Severity::Ok,
        ..READ_COST_NS_BAD => Severity::Note,
        _ => Severity::Warning,
    };
    Finding::new("clock_read_cost", severity, format!("{cost_ns:.0} ns"))
}

const SYNCHRONISATION: &str = "clock_synchronisation";
const REFERENCE: &str = "clock_reference";

/// What the kernel says of the time of day, and what the daemon that keeps it does.
fn steering(found: &Result<HostDiscipline, String>) -> [Finding; 2] {
    match found {
        Ok(found) => [judge_discipline(found), judge_reference(found)],
        Err(why) => [SYNCHRONISATION, REFERENCE].map(|id| Finding::cannot_tell(id, why)),
    }
}

/// How far apart the clocks of this host and of another may be.
fn between(own: Option<&HostDiscipline>, name: &str, other: Option<&HostDiscipline>) -> Checked {
    let id = "clock_between_hosts";
    let silent = |whose| format!("the kernel of {whose} says nothing");
    let own = own.ok_or(silent("this host")).told(id)?;
    let other = other.ok_or(silent(name)).told(id)?;
    Ok(match common_bound_ns("this host", own, name, other) {
        Ok(bound_ns) => {
            let value = format!("apart by at most {} us", bound_ns.div_ceil(1_000));
            let why = format!("{}; {name}: {}", own.basis, other.basis);
            Finding::ok(id, value).because(why)
        }
        Err(why) => Finding::note(id, format!("no bound: {why}"))
            .fixed_by("keep both on one reference with chronyd, or ptp4l and phc2sys"),
    })
}

/// What one-way figures to another host could rest on besides clock exchanges.
fn judge_reference(found: &HostDiscipline) -> Finding {
    let basis = found.basis.clone();
    let (Some(reference), Some(bound_ns)) = (&found.reference, found.bound_ns) else {
        return Finding::note(REFERENCE, basis);
    };
    let value = format!("{reference}, within ±{} us", bound_ns.div_ceil(1_000));
    Finding::ok(REFERENCE, value).because(basis)
}

fn judge_discipline(found: &HostDiscipline) -> Finding {
    let is_synchronised = found.is_kernel_synchronised;
    let value = format!(
        "{}synchronised, claimed error {} us, estimate {} us, rate {:+} ppb",
        if is_synchronised { "" } else { "not " },
        found.kernel_max_error_us,
        found.kernel_estimated_error_us,
        found.frequency_ppb
    );
    if !is_synchronised {
        return Finding::note(SYNCHRONISATION, value);
    }
    // ptp4l and phc2sys leave maxerror alone or write a constant into it.
    Finding::ok(SYNCHRONISATION, value).because(
        "the claimed error is the daemon's word: chronyd and ntpd keep it, ptp4l and phc2sys do \
         not, so it is no bound under PTP",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    #[test]
    fn the_read_cost_is_judged_by_its_class() {
        for (cost_ns, expected) in [
            (25.0, Severity::Ok),
            (400.0, Severity::Note),
            (15_000.0, Severity::Warning),
        ] {
            assert_eq!(read_cost(cost_ns).severity, expected);
        }
        assert!(cheapest_read_ns() > 0.0);
    }

    fn kept() -> HostDiscipline {
        HostDiscipline {
            is_kernel_synchronised: true,
            kernel_max_error_us: 16,
            kernel_estimated_error_us: 3,
            frequency_ppb: -1200,
            reference: None,
            bound_ns: None,
            basis: "systemd-timesyncd keeps the clock".to_owned(),
        }
    }

    #[test]
    fn what_the_kernel_does_not_say_is_unknown_in_both_findings() {
        for finding in steering(&Err("adjtimex: EPERM".to_owned())) {
            assert_eq!(finding.severity, Severity::CannotTell);
            assert!(finding.value.contains("EPERM"), "{}", finding.value);
        }
    }

    #[test]
    fn only_a_reference_with_a_bound_is_good() {
        let mut found = kept();
        let finding = judge_reference(&found);
        assert_eq!(finding.severity, Severity::Note);
        assert_eq!(finding.value, found.basis);
        found.reference = Some("ptp 00a069.fffe.0b552d".to_owned());
        found.bound_ns = Some(9_620);
        let finding = judge_reference(&found);
        assert_eq!(finding.severity, Severity::Ok);
        assert_eq!(finding.value, "ptp 00a069.fffe.0b552d, within ±10 us");
    }

    #[test]
    fn a_claimed_error_is_never_called_a_bound() {
        let discipline = kept();
        let finding = judge_discipline(&discipline);
        assert_eq!(finding.severity, Severity::Ok);
        assert_eq!(
            finding.value,
            "synchronised, claimed error 16 us, estimate 3 us, rate -1200 ppb"
        );
        assert!(finding.why.contains("no bound under PTP"));
        let loose = HostDiscipline {
            is_kernel_synchronised: false,
            ..discipline
        };
        assert_eq!(judge_discipline(&loose).severity, Severity::Note);
    }

    #[test]
    fn two_hosts_are_bounded_only_by_one_reference_of_both() {
        let mut own = kept();
        own.reference = Some("ptp a".to_owned());
        own.bound_ns = Some(4_000);
        let other = own.clone();
        let finding = settled(between(Some(&own), "robot-pc", Some(&other)));
        assert_eq!(finding.severity, Severity::Ok);
        let named = finding.clone().of("robot-pc");
        assert_eq!(named.id, "clock_between_hosts.robot-pc");
        assert_eq!(finding.value, "apart by at most 8 us");
        let finding = settled(between(Some(&own), "robot-pc", Some(&kept())));
        assert_eq!(finding.severity, Severity::Note);
        assert!(finding.value.contains("on robot-pc"), "{}", finding.value);
        let finding = settled(between(Some(&own), "robot-pc", None));
        assert_eq!(finding.severity, Severity::CannotTell);
    }
}
