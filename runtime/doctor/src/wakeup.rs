//! The finding that a measurement of wake-ups comes to. The measurement is in [`super::latency`].

use super::{Finding, finding::Severity, latency::LatencyReport};
use hil_platform::host_facts::Fact;

/// A wake-up p99 below this leaves room for claims in tens of microseconds.
const P99_NS_OK: i64 = 100_000;

pub(super) fn judge(measured: &LatencyReport) -> Finding {
    let id = "wakeup_latency";
    let Some((worst, lateness)) = measured.worst() else {
        return Finding::cannot_tell(id, "no wake-up fell into the measuring time");
    };
    let us = |ns: i64| ns as f64 / 1000.0;
    let (p50, p99, max) = (
        us(lateness.p50_ns),
        us(lateness.p99_ns),
        us(lateness.max_ns),
    );
    let period_ns = i64::try_from(measured.period_ns).unwrap_or(i64::MAX);
    let severity = match lateness.p99_ns {
        ..P99_NS_OK => Severity::Ok,
        ns if ns < period_ns => Severity::Warning,
        _ => Severity::Error,
    };
    let how = if worst.is_as_asked {
        format!("SCHED_FIFO {}", measured.priority)
    } else {
        "not at the priority asked for".to_owned()
    };
    let value = format!(
        "p50 {p50:.0} us, p99 {p99:.0} us, max {max:.0} us of {} ({how})",
        worst.count
    );
    let below = match &measured.surroundings.virtual_machine {
        Fact::Available(answer) if answer != "no" => {
            "; this is a virtual machine, whose tail comes from below and stays when it is idle"
        }
        _ => "",
    };
    let finding = Finding::new(id, severity, value).because(format!(
        "of blocking operations, medians above about {p50:.0} us and p99 above about {p99:.0} us \
         can be claimed here; single delays up to {max:.0} us may be the host's own{below}"
    ));
    if severity == Severity::Ok {
        finding.fixed_by("hil-runtime doctor --latency 60s for the tail")
    } else {
        finding
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::latency::{LatencyRequest, Quantiles, Watch, measure};
    use super::*;
    use hil_platform::host_facts::FakeHost;

    /// A real report, with the figures of this test in it.
    fn measured(p99_ns: Option<i64>) -> LatencyReport {
        let host = FakeHost::with(&[("/proc/cpuinfo", "flags : fpu hypervisor")]);
        let request = LatencyRequest {
            duration: Duration::ZERO,
            ..LatencyRequest::brief(None)
        };
        let watch = Watch {
            is_stopped: &|| false,
            stage: None,
        };
        let mut report = measure(&request, &host.files(), &watch);
        report.wakeups[0].lateness = p99_ns.map(|p99_ns| Quantiles {
            p50_ns: 25_000,
            p99_ns,
            p999_ns: 6_000_000,
            max_ns: 7_000_000,
        });
        report
    }

    #[test]
    fn the_finding_follows_the_measured_noise() {
        let ok = judge(&measured(Some(65_000)));
        assert_eq!(ok.severity, Severity::Ok);
        for words in [
            "p99 above about 65 us",
            "single delays up to 7000 us",
            "virtual machine",
        ] {
            assert!(ok.why.contains(words), "{}", ok.why);
        }
        let loud = judge(&measured(Some(400_000)));
        assert_eq!(loud.severity, Severity::Warning);
        let late = judge(&measured(Some(3_000_000)));
        assert_eq!(late.severity, Severity::Error);
        assert_eq!(judge(&measured(None)).severity, Severity::CannotTell);
    }
}
