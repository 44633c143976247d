//! The clocks of this host: which counter, what a read costs, and who steers the time of day. It
//! does not compare the host with another; that is the gateways' alignment.

use std::hint::black_box;

use super::{Finding, State};
use crate::clock::MonotonicClock;
use crate::clock_discipline::HostDiscipline;
use crate::host_facts::{Fact, HostFiles};

/// A vDSO read stays below this on any PC of the last ten years.
const READ_COST_NS_GOOD: f64 = 100.0;
/// Above this the read is a system call, as long as a shared-memory hop.
const READ_COST_NS_BAD: f64 = 1000.0;

pub(crate) fn examine(files: &HostFiles) -> Vec<Finding> {
    let (synchronisation, reference) = steering(HostDiscipline::gather());
    vec![
        clocksource(files),
        read_cost(cheapest_read_ns()),
        synchronisation,
        reference,
    ]
}

fn clocksource(files: &HostFiles) -> Finding {
    let (id, title) = ("clocksource", "Clock source");
    let path = "/sys/devices/system/clocksource/clocksource0/current_clocksource";
    match files.read(path) {
        Fact::Available(name) => {
            // These are read in user space through the vDSO; any other is a system call.
            let is_fast = [
                "tsc",
                "arch_sys_counter",
                "kvm-clock",
                "hyperv_clocksource_tsc_page",
            ]
            .contains(&name.as_str());
            Finding::note_unless(is_fast, id, title, name)
                .because("reads are system calls, and the kernel may have found the TSC unstable")
                .fixed_by("look for `clocksource` in dmesg; boot with tsc=reliable if it is")
                .quiet_when_good()
        }
        Fact::Unavailable(reason) => Finding::unknown(id, title, &reason),
    }
}

/// The cheapest of 20 batches: the cost itself, with the scheduler's interruptions left out.
fn cheapest_read_ns() -> f64 {
    const READ_COUNT: u32 = 5000;
    (0..20)
        .map(|_| {
            let start = MonotonicClock::now();
            for _ in 0..READ_COUNT {
                black_box(MonotonicClock::now());
            }
            MonotonicClock::now().ns_since(start) as f64 / f64::from(READ_COUNT)
        })
        .fold(f64::INFINITY, f64::min)
}

fn read_cost(cost_ns: f64) -> Finding {
    let state = if cost_ns < READ_COST_NS_GOOD {
        State::Good
    } else if cost_ns < READ_COST_NS_BAD {
        State::Note
    } else {
        State::Problem
    };
    Finding::new(
        "clock_read_cost",
        "Cost of a clock read",
        state,
        format!("{cost_ns:.0} ns"),
    )
    .because("every stamp of a message pays it, several times per hop")
    .fixed_by("use the tsc clocksource; build with optimisation")
    .quiet_when_good()
}

const SYNCHRONISATION: (&str, &str) = ("clock_synchronisation", "Time of day against a reference");
const REFERENCE: (&str, &str) = ("clock_reference", "Reference of the time of day");

/// What the kernel says of the time of day, and what the daemon that keeps it does.
fn steering(found: Result<HostDiscipline, String>) -> (Finding, Finding) {
    match found {
        Ok(found) => (judge_discipline(&found), judge_reference(&found)),
        Err(why) => {
            let unknown = |(id, title)| Finding::unknown(id, title, &why);
            (unknown(SYNCHRONISATION), unknown(REFERENCE))
        }
    }
}

/// What one-way figures to another host could rest on besides clock exchanges.
fn judge_reference(found: &HostDiscipline) -> Finding {
    let (id, title) = REFERENCE;
    if let Some((reference, bound_ns)) = found.reference.as_ref().zip(found.bound_ns) {
        let value = format!("{reference}, within ±{} us", bound_ns.div_ceil(1_000));
        return Finding::good(id, title, value).because(found.basis.clone());
    }
    Finding::note(id, title, found.basis.clone())
        .because(
            "the bound of one-way delays to another host is then half the smallest round trip of \
             the gateways' clock exchanges, plus what the clocks may drift between them",
        )
        .fixed_by(
            "keep both hosts on one reference with chronyd or ptp4l if that is not tight enough, \
             best over a wired link",
        )
}

fn judge_discipline(found: &HostDiscipline) -> Finding {
    let (id, title) = SYNCHRONISATION;
    let value = format!(
        "{}, claimed error {} us, estimate {} us, rate {:+} ppb",
        if found.is_kernel_synchronised {
            "synchronised"
        } else {
            "not synchronised"
        },
        found.kernel_max_error_us,
        found.kernel_estimated_error_us,
        found.frequency_ppb
    );
    if found.is_kernel_synchronised {
        // ptp4l and phc2sys leave maxerror alone or write a constant into it.
        let why = "the claimed error is the daemon's word: chronyd and ntpd keep it, ptp4l and \
                   phc2sys do not, so it is no bound under PTP";
        return Finding::good(id, title, value).because(why);
    }
    Finding::note(id, title, value)
        .because(
            "one-way delays to another host then rest on the runtime's own probe exchange alone, \
             and kernel receive stamps jump if a daemon steps the clock during a run",
        )
        .fixed_by(
            "run chronyd, or ptp4l with phc2sys, on both hosts, and wait until it has settled",
        )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    #[test]
    fn a_slow_counter_is_noted() {
        let path = "/sys/devices/system/clocksource/clocksource0/current_clocksource";
        for (name, expected) in [("tsc", State::Good), ("hpet", State::Note)] {
            let host = FakeHost::with(&[(path, name)]);
            assert_eq!(clocksource(&host.files()).state, expected, "{name}");
        }
    }

    #[test]
    fn the_read_cost_is_judged_by_its_class() {
        for (cost_ns, expected) in [
            (25.0, State::Good),
            (400.0, State::Note),
            (15_000.0, State::Problem),
        ] {
            assert_eq!(read_cost(cost_ns).state, expected);
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
        let (synchronisation, reference) = steering(Err("adjtimex: EPERM".to_owned()));
        for finding in [synchronisation, reference] {
            assert_ne!(finding.state, State::Good);
            assert!(finding.value.contains("EPERM"), "{}", finding.value);
        }
    }

    #[test]
    fn only_a_reference_with_a_bound_is_good() {
        let mut found = kept();
        let finding = judge_reference(&found);
        assert_eq!(finding.state, State::Note);
        assert_eq!(finding.value, found.basis);
        found.reference = Some("ptp 00a069.fffe.0b552d".to_owned());
        found.bound_ns = Some(9_620);
        let finding = judge_reference(&found);
        assert_eq!(finding.state, State::Good);
        assert_eq!(finding.value, "ptp 00a069.fffe.0b552d, within ±10 us");
    }

    #[test]
    fn a_claimed_error_is_never_called_a_bound() {
        let discipline = kept();
        let finding = judge_discipline(&discipline);
        assert_eq!(finding.state, State::Good);
        assert_eq!(
            finding.value,
            "synchronised, claimed error 16 us, estimate 3 us, rate -1200 ppb"
        );
        assert!(finding.why.contains("no bound under PTP"));
        let loose = HostDiscipline {
            is_kernel_synchronised: false,
            ..discipline
        };
        assert_eq!(judge_discipline(&loose).state, State::Note);
    }
}
