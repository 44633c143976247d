//! From measured lateness to what may be claimed on this host, each by a rule that is printed with it.
//! It judges the host, not a run: a run has links and programs besides.

use serde::{Deserialize, Serialize};

use super::{Gaps, HostActivity, LatencyReport, Quantiles};
use crate::finding::{Answer, Checked, Finding};
use hil_platform::host_facts::Fact;
use hil_platform::words::counted_plainly;

/// Wake-ups beyond a quantile without which it is an anecdote.
const BEYOND_MIN: u64 = 10;
/// What the host adds may be this part of the period at most.
const PERIOD_PARTS: i64 = 10;
/// Deadlines that control loops have: 1 kHz, EGM's 250 Hz, 100 Hz.
const DEADLINES: [(i64, &str); 3] = [(1_000, "1 kHz"), (250, "250 Hz"), (100, "100 Hz")];
/// Milliseconds per second that a busy poller may lose to what is not its work.
const LOST_MS_PER_S_MAX: f64 = 1.0;
/// A wake-up p99 below this leaves room for claims in tens of microseconds.
const P99_NS_OK: i64 = 100_000;

/// Whether a claim can be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Standing {
    /// It can, with the bound that is stated.
    Supportable,
    /// It cannot: the host itself is worse.
    NotSupportable,
    /// Too little was measured to say.
    NotMeasured,
}

/// Something one would like to say of a run, and whether this host allows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Claim {
    /// Stable identifier, for example `p99` or `deadline_1000_hz`.
    pub id: String,
    /// What one would like to say.
    pub claim: String,
    /// Whether.
    pub standing: Standing,
    /// With which bound, or why not.
    pub why: String,
    /// The rule, in words.
    pub rule: String,
}

impl Claim {
    fn new(
        id: impl Into<String>,
        claim: impl Into<String>,
        rule: &str,
        standing: Standing,
        why: impl Into<String>,
    ) -> Self {
        Self {
            id: id.into(),
            claim: claim.into(),
            standing,
            why: why.into(),
            rule: rule.to_owned(),
        }
    }
}

impl HostActivity {
    /// A hypervisor runs below, as far as is known.
    fn is_virtual_machine(&self) -> bool {
        matches!(&self.virtual_machine, Fact::Available(answer) if answer != "no")
    }
}

fn period_ns(report: &LatencyReport) -> i64 {
    i64::try_from(report.period_ns).unwrap_or(i64::MAX)
}

/// Why there are no figures.
fn nothing_measured(report: &LatencyReport) -> &'static str {
    if report.measured_wakeups().next().is_none() {
        "no thread could be put on the CPU to be measured"
    } else {
        "no wake-up fell into the measuring time"
    }
}

/// The finding that a measurement of wake-ups comes to: that of the CPU that was latest at p99.
pub(crate) fn judge(measured: &LatencyReport) -> Checked {
    let id = "wakeup_latency";
    let wakeups = measured.measured_wakeups();
    let with_metrics = wakeups.filter_map(|one| Some((one, one.lateness?)));
    let worst = with_metrics.max_by_key(|(_, lateness)| lateness.p99_ns);
    let worst = worst.ok_or_else(|| nothing_measured(measured));
    let (wakeups, lateness) = worst.told(id)?;
    let [p50, p99, max] =
        [lateness.p50_ns, lateness.p99_ns, lateness.max_ns].map(|ns| ns as f64 / 1000.0);
    let how = if wakeups.scheduling.is_complete() {
        format!("SCHED_FIFO {}", measured.priority)
    } else {
        "not at the priority asked for".to_owned()
    };
    let count = wakeups.count;
    let value = format!("p50 {p50:.0} us, p99 {p99:.0} us, max {max:.0} us of {count} ({how})");
    let below = if measured.surroundings.is_virtual_machine() {
        "; this is a virtual machine, whose tail comes from below and stays when it is idle"
    } else {
        ""
    };
    let why = format!(
        "of blocking operations, medians above about {p50:.0} us and p99 above about {p99:.0} us \
         can be claimed here; single delays up to {max:.0} us may be the host's own{below}"
    );
    Ok(match lateness.p99_ns {
        ..P99_NS_OK => {
            Finding::ok(id, value).fixed_by("hil-runtime doctor --latency 60s for the tail")
        }
        ns if ns < period_ns(measured) => Finding::warning(id, value),
        _ => Finding::error(id, value),
    }
    .because(why))
}

/// The least that is known of all CPUs, and the worst that was seen on one.
#[derive(Debug, Clone, Copy)]
struct Worst {
    /// From one wake-up to the next.
    period_ns: i64,
    count: u64,
    lateness: Quantiles,
}

impl Worst {
    fn of(report: &LatencyReport) -> Option<Self> {
        let (mut count, mut lateness) = (u64::MAX, None::<Quantiles>);
        for one in report.measured_wakeups() {
            // A CPU without figures leaves nothing to claim of all.
            let (own, worst) = (one.lateness?, lateness.get_or_insert_default());
            count = count.min(one.count);
            worst.p50_ns = worst.p50_ns.max(own.p50_ns);
            worst.p99_ns = worst.p99_ns.max(own.p99_ns);
            worst.p999_ns = worst.p999_ns.max(own.p999_ns);
            worst.max_ns = worst.max_ns.max(own.max_ns);
        }
        Some(Self {
            period_ns: period_ns(report),
            count,
            lateness: lateness?,
        })
    }

    /// The complaint, where too few wake-ups lie beyond the quantile.
    fn too_few(&self, permille: u64) -> Option<String> {
        let (count, needed) = (self.count, needed_count(permille));
        let is_short = count < needed;
        is_short.then(|| format!("{count} wake-ups, and {needed} are needed: measure longer"))
    }

    /// The rule of `permille` of delays that end in a blocking receive.
    fn quantile(&self, id: &str, claim: &str, permille: u64, late_ns: i64) -> Claim {
        let (late, tenth_ns) = (us_up(late_ns), self.period_ns / PERIOD_PARTS);
        let (standing, why) = if let Some(why) = self.too_few(permille) {
            (Standing::NotMeasured, why)
        } else if late_ns <= tenth_ns {
            (Standing::Supportable, format!("to ±{late} us"))
        } else {
            let tenth = us_up(tenth_ns);
            let why = format!("the host's own wake-up is {late} us there, more than {tenth} us");
            (Standing::NotSupportable, why)
        };
        Claim::new(id, claim, QUANTILE_RULE, standing, why)
    }

    fn variation(&self) -> Claim {
        let spread = us_up(self.lateness.p99_ns - self.lateness.p50_ns);
        let (standing, why) = if self.count < needed_count(990) {
            let why = format!("{} wake-ups are too few for a p99", self.count);
            (Standing::NotMeasured, why)
        } else {
            let why = format!("from {spread} us up; less is the host's own");
            (Standing::Supportable, why)
        };
        let rule =
            "what differs by less than p99 minus p50 of the host's own wake-up may be the host's";
        Claim::new("variation", "delay variation", rule, standing, why)
    }

    fn deadline(&self, rate_hz: i64, rate: &str) -> Claim {
        let period_ns = 1_000_000_000 / rate_hz;
        let tenth_ns = period_ns / PERIOD_PARTS;
        let (p999_ns, max_ns) = (self.lateness.p999_ns, self.lateness.max_ns);
        let (tail, max, tenth) = (us_up(p999_ns), us_up(max_ns), us_up(tenth_ns));
        // One miss is enough to know; that there is none takes many wake-ups.
        let (standing, why) = if max_ns >= period_ns {
            let why = format!("the host alone missed one: a wake-up was {max} us late");
            (Standing::NotSupportable, why)
        } else if let Some(why) = self.too_few(999) {
            (Standing::NotMeasured, why)
        } else if p999_ns > tenth_ns {
            let why = format!("99.9 % wake-up is {tail} us, more than {tenth} us");
            (Standing::NotSupportable, why)
        } else {
            let why = format!("99.9 % wake-up is {tail} us, the latest {max} us");
            (Standing::Supportable, why)
        };
        Claim::new(
            format!("deadline_{rate_hz}_hz"),
            format!("deadline misses at {rate}"),
            "supportable if the host's own wake-up stays within a tenth of the period at 99.9 % (at least 10 \
         wake-ups beyond) and never misses one itself",
            standing,
            why,
        )
    }
}

/// All claims, from the easiest to the hardest.
pub(super) fn derive(report: &LatencyReport) -> Vec<Claim> {
    let Some(worst) = Worst::of(report) else {
        return vec![Claim::new(
            "median",
            "medians of delays",
            QUANTILE_RULE,
            Standing::NotMeasured,
            nothing_measured(report),
        )];
    };
    let of = worst.lateness;
    let (latest, count) = (us_up(of.max_ns), worst.count);
    let mut claims = vec![
        worst.quantile("median", "medians of delays", 500, of.p50_ns),
        worst.quantile("p99", "99 % quantiles of delays", 990, of.p99_ns),
        worst.quantile("p999", "99.9 % quantiles of delays", 999, of.p999_ns),
        worst.variation(),
        Claim::new(
            "largest",
            "largest delays",
            "the largest of any number of wake-ups bounds nothing but itself",
            Standing::NotSupportable,
            format!("the host alone was {latest} us late once in {count}, and may be later"),
        ),
    ];
    claims.extend(DEADLINES.map(|(rate_hz, rate)| worst.deadline(rate_hz, rate)));
    let gaps = report.measured_gaps();
    claims.extend(gaps.map(|gaps| busy_polling(gaps, worst.period_ns)));
    if report.surroundings.is_virtual_machine() {
        claims.push(Claim::new(
            "tail_cause",
            "tails as this system's own",
            "below a hypervisor the tail is not this system's alone, whatever steal time says",
            Standing::NotSupportable,
            "a virtual machine: long wake-ups may come from below, also when nothing runs here",
        ));
    }
    claims
}

const QUANTILE_RULE: &str = "supportable to what the host's own wake-up takes at that quantile, if at least 10 \
                             wake-ups lie beyond it and it stays within a tenth of the period";

/// Wake-ups of which enough lie beyond the quantile.
fn needed_count(permille: u64) -> u64 {
    BEYOND_MIN * 1000 / (1000 - permille).max(1)
}

fn busy_polling(gaps: &Gaps, period_ns: i64) -> Claim {
    let lost = gaps.lost_ms_per_s();
    let longest_ns = gaps.length.map_or(0, |length| length.max_ns);
    let throttled = match gaps.throttle_like_count {
        None | Some(0) => String::new(),
        Some(count) => {
            let gaps = counted_plainly(count, "gap");
            format!("; {gaps} as long as what sched_rt_runtime_us keeps back")
        }
    };
    let longest = us_up(longest_ns);
    let why = format!("it loses {lost:.1} ms per s, {longest} us at most at a time{throttled}");
    let standing = if gaps.measured_ns == 0 {
        Standing::NotMeasured
    } else if lost < LOST_MS_PER_S_MAX && longest_ns <= period_ns / PERIOD_PARTS {
        Standing::Supportable
    } else {
        Standing::NotSupportable
    };
    let [id, on] = match gaps.cpu {
        Some(cpu) => [format!("_cpu{cpu}"), format!(" on CPU {cpu}")],
        None => [String::new(), String::new()],
    };
    Claim::new(
        format!("busy_polling{id}"),
        format!("busy polling{on}"),
        "supportable if gaps over 10 us take less than 1 ms per second and none a tenth of the period",
        standing,
        why,
    )
}

/// Microseconds, rounded up: a bound is not rounded in its own favour.
pub(crate) fn us_up(ns: i64) -> i64 {
    ns.max(0).unsigned_abs().div_ceil(1000).cast_signed()
}

#[cfg(test)]
mod tests {
    use hil_platform::realtime::{GrantOutcome, RealtimeGrant, RealtimeGrantItem, RealtimeItem};

    use super::*;
    use crate::finding::{Severity, settled};
    use crate::latency::Wakeups;

    fn report(count: u64, lateness_us: [i64; 4]) -> LatencyReport {
        let [p50, p99, p999, max] = lateness_us.map(|us| us * 1000);
        let unknown = || Fact::Unavailable("not in this test".to_owned());
        LatencyReport {
            duration_ns: 30_000_000_000,
            period_ns: 1_000_000,
            priority: 80,
            is_thorough: true,
            is_interrupted: false,
            wakeups: vec![Wakeups {
                cpu: Some(1),
                scheduling: RealtimeGrant::default(),
                measured_ns: 30_000_000_000,
                count,
                skipped_count: 0,
                preempted_count: None,
                lateness: Some(Quantiles {
                    p50_ns: p50,
                    p99_ns: p99,
                    p999_ns: p999,
                    max_ns: max,
                }),
            }],
            gaps: Vec::new(),
            surroundings: HostActivity {
                load_before: unknown(),
                load_after: unknown(),
                ticks: Fact::Unavailable("not in this test".to_owned()),
                virtual_machine: unknown(),
            },
            claims: Vec::new(),
        }
    }

    fn found(report: &LatencyReport, id: &str) -> Claim {
        let claims = derive(report);
        claims.into_iter().find(|claim| claim.id == id).unwrap()
    }

    #[test]
    fn a_virtual_machine_supports_medians_and_no_deadlines() {
        // The figures of a real one: p99.9 far off, single wake-ups of several milliseconds.
        let report = report(30_000, [26, 66, 1279, 7201]);
        for (id, standing, words) in [
            ("median", Standing::Supportable, "to ±26 us"),
            ("p99", Standing::Supportable, "to ±66 us"),
            (
                "p999",
                Standing::NotSupportable,
                "1279 us there, more than 100 us",
            ),
            ("variation", Standing::Supportable, "from 40 us up"),
            (
                "largest",
                Standing::NotSupportable,
                "7201 us late once in 30000",
            ),
            (
                "deadline_1000_hz",
                Standing::NotSupportable,
                "missed one: a wake-up was 7201 us",
            ),
            (
                "deadline_100_hz",
                Standing::NotSupportable,
                "1279 us, more than 1000 us",
            ),
        ] {
            let claim = found(&report, id);
            assert_eq!(claim.standing, standing, "{claim:?}");
            assert!(claim.why.contains(words), "{claim:?}");
            assert!(!claim.rule.is_empty());
        }
    }

    #[test]
    fn a_tuned_host_supports_deadlines_too() {
        let report = report(30_000, [3, 8, 12, 40]);
        for id in ["p999", "deadline_1000_hz", "deadline_250_hz"] {
            assert_eq!(found(&report, id).standing, Standing::Supportable, "{id}");
        }
    }

    #[test]
    fn too_few_wake_ups_say_nothing_of_tails() {
        let short = report(900, [3, 8, 12, 40]);
        assert_eq!(found(&short, "median").standing, Standing::Supportable);
        for id in ["p99", "p999", "variation", "deadline_1000_hz"] {
            assert_eq!(found(&short, id).standing, Standing::NotMeasured, "{id}");
        }
        assert_eq!(needed_count(990), 1000);
        assert_eq!(needed_count(999), 10_000);
        let mut silent = report(0, [0; 4]);
        silent.wakeups[0].lateness = None;
        assert_eq!(found(&silent, "median").standing, Standing::NotMeasured);
    }

    #[test]
    fn a_cpu_that_could_not_be_used_has_no_part_in_what_is_claimed() {
        let refused = |report: &mut LatencyReport, index: usize| {
            report.wakeups[index].scheduling.items = vec![RealtimeGrantItem {
                item: RealtimeItem::CpuPinning,
                asked: "cpu 1".to_owned(),
                outcome: GrantOutcome::Refused {
                    error: "EINVAL: Invalid argument".to_owned(),
                    reason: String::new(),
                    fix: String::new(),
                },
            }];
            report.wakeups[index].lateness = None;
            report.wakeups[index].count = 0;
        };
        let whole = report(30_000, [3, 8, 12, 40]);
        let mut partial = whole.clone();
        partial.wakeups.push(whole.wakeups[0].clone());
        refused(&mut partial, 1);
        assert_eq!(derive(&partial), derive(&whole));
        refused(&mut partial, 0);
        let claims = derive(&partial);
        assert_eq!(
            claims[0].why,
            "no thread could be put on the CPU to be measured"
        );
    }

    #[test]
    fn a_poller_is_judged_by_what_it_loses() {
        let mut report = report(30_000, [3, 8, 12, 40]);
        report.gaps = vec![Gaps {
            cpu: Some(1),
            scheduling: RealtimeGrant::default(),
            measured_ns: 10_000_000_000,
            look_count: 100_000_000,
            count: 3_500,
            lost_ns: 570_000_000,
            throttle_like_count: Some(10),
            length: Some(Quantiles {
                p50_ns: 23_000,
                p99_ns: 80_000,
                p999_ns: 50_000_000,
                max_ns: 50_100_000,
            }),
        }];
        let claim = found(&report, "busy_polling_cpu1");
        assert_eq!(claim.standing, Standing::NotSupportable);
        let words = "it loses 57.0 ms per s, 50100 us at most at a time; 10 gaps as long as what \
                     sched_rt_runtime_us keeps back";
        assert_eq!(claim.why, words);
        report.gaps[0].lost_ns = 1_000_000;
        report.gaps[0].length = None;
        let claim = found(&report, "busy_polling_cpu1");
        assert_eq!(claim.standing, Standing::Supportable);
    }

    #[test]
    fn a_hypervisor_shares_the_blame() {
        let mut report = report(30_000, [3, 8, 12, 40]);
        assert!(derive(&report).iter().all(|claim| claim.id != "tail_cause"));
        report.surroundings.virtual_machine = Fact::Available("yes".to_owned());
        let claim = found(&report, "tail_cause");
        assert_eq!(claim.standing, Standing::NotSupportable);
    }

    #[test]
    fn the_finding_follows_the_measured_noise() {
        let measured = |p99_us, max_us| {
            let mut report = report(1000, [25, p99_us, 6000, max_us]);
            report.surroundings.virtual_machine = Fact::Available("yes".to_owned());
            report
        };
        let ok = settled(judge(&measured(65, 7000)));
        assert_eq!(ok.severity, Severity::Ok);
        for words in [
            "p99 above about 65 us",
            "single delays up to 7000 us",
            "virtual machine",
        ] {
            assert!(ok.why.contains(words), "{}", ok.why);
        }
        let loud = settled(judge(&measured(400, 7000)));
        assert_eq!(loud.severity, Severity::Warning);
        let mut late = measured(3000, 7000);
        assert_eq!(settled(judge(&late)).severity, Severity::Error);
        late.wakeups[0].lateness = None;
        assert_eq!(settled(judge(&late)).severity, Severity::CannotTell);
    }
}
