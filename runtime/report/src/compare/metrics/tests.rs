//! What repetitions say together, and what they do not when some of them lack a figure.

use super::*;
use crate::answer::{Hurt, Object};
use crate::compare::conditions::{Condition, Verdicts};
use crate::compare::{Comparison, Tested};
use hil_account::network::{Metric, OrderMetrics};
use hil_core::interval::IntervalMethod;

fn p99(base_ms: &[f64], new_ms: &[f64], of: Counts) -> ComparedMetric {
    let side = |all: &[f64]| -> Vec<Estimate> {
        let estimate = |ms: &f64| Estimate {
            value: ms * 1e6,
            interval: Some(Interval::new(
                ms * 0.99e6,
                ms * 1.01e6,
                IntervalMethod::EffectiveRanks,
            )),
        };
        all.iter().map(estimate).collect()
    };
    ComparedMetric {
        channel: Some("a/b".to_owned()),
        part: Some(Part::EndToEnd),
        ..delay_figure("p99", &side(base_ms), &side(new_ms), of)
    }
}

fn loss(base: &[u64], new: &[u64], of: Counts) -> ComparedMetric {
    let side = |all: &[u64]| -> Vec<RunLoss> {
        let share = |count: &u64| Share {
            count: *count,
            of: 1000,
        };
        let run = |count: &u64| RunLoss {
            share: share(count),
            interval: share(count).estimate(1.0).unwrap().interval,
        };
        all.iter().map(run).collect()
    };
    loss_figure("a/b", &side(base), &side(new), of)
}

/// Whether a condition holds, or why it cannot be judged.
fn judged(condition: &str, figure: &ComparedMetric) -> Result<bool, String> {
    let comparison = Comparison {
        harms: Vec::new(),
        measurements: Vec::new(),
        gravest_harm: None,
        object: Object::Robot,
        hurt: Hurt::No,
        headline: Vec::new(),
        base: Vec::new(),
        new: Vec::new(),
        base_tested: Tested::default(),
        new_tested: Tested::default(),
        same: Vec::new(),
        differences: Vec::new(),
        cautions: Vec::new(),
        figures: vec![figure.clone()],
    };
    let condition = Condition::parse(condition).unwrap();
    let mut verdicts = Verdicts::default();
    let found = condition.judge(&comparison, false, &mut verdicts);
    found.map_err(|error| error.to_string())?;
    Ok(verdicts.judged.iter().any(|one| one.holds))
}

#[test]
fn conditions_on_the_new_runs_are_judged_by_how_repetitions_differ() {
    // The mean of the logarithms reaches from 5.36 to 7.86 ms.
    let delay = p99(&[3.0, 3.1, 3.2], &[6.0, 6.5, 7.0], [3, 3]);
    assert_eq!(
        (delay.verdict, delay.method.as_str()),
        (Verdict::Slower, REPETITIONS)
    );
    assert_eq!(judged("p99 > 5ms", &delay), Ok(true));
    assert_eq!(judged("p99 > 6ms", &delay), Ok(false));
    assert_eq!(judged("p99 > 1.5x", &delay), Ok(true));
    // The mean of the shares from 0.70 to 1.70 %; by all 3000 messages alone from 0.87 %.
    let lost = loss(&[1, 2, 3], &[10, 12, 14], [3, 3]);
    assert_eq!(judged("loss > 0.5%", &lost), Ok(true));
    assert_eq!(judged("loss > 0.8%", &lost), Ok(false));
    // Where none was lost, nothing shows how losses would come together; none is not above a limit all the same.
    let none = loss(&[0, 0], &[0, 0], [2, 2]);
    assert_eq!(
        (none.method.as_str(), none.difference_interval),
        (NO_LOSS, None)
    );
    assert_eq!(judged("loss > 0.5%", &none), Ok(false));
    let alike = p99(&[3.0, 3.0], &[6.0, 6.0], [2, 2]);
    let why = judged("p99 > 5ms", &alike).unwrap_err();
    assert!(why.contains(NO_SPREAD), "{why}");
}

#[test]
fn a_figure_that_some_repetitions_lack_is_not_tested_and_told() {
    let whole = p99(&[3.0, 3.1, 3.2], &[6.0, 6.5, 7.0], [3, 3]);
    let delay = p99(&[3.0, 3.1], &[6.0, 6.5, 7.0], [3, 3]);
    let lost = loss(&[1, 2, 3], &[10], [3, 3]);
    for one in [&delay, &lost] {
        assert_eq!(
            (one.verdict, one.method.as_str()),
            (Verdict::NotTested, PARTIAL)
        );
        assert_eq!((one.ratio_interval, one.difference_interval), (None, None));
    }
    // All new runs have the delay; of the loss the one that is left has nothing to say.
    assert_eq!(judged("p99 > 5ms", &delay), Ok(true));
    let why = judged("loss > 0.5%", &lost).unwrap_err();
    assert!(why.contains(PARTIAL), "{why}");
    assert_eq!(
        cautions(&[whole, delay.clone(), delay, lost], [3, 3]),
        [
            "a/b end to end: only 2 of 3 base and 3 of 3 new runs have it",
            "a/b loss: only 3 of 3 base and 1 of 3 new runs have it",
        ]
    );
    let absent = p99(&[], &[6.0, 6.5, 7.0], [3, 3]);
    assert_eq!(absent.method, ABSENT);
    assert!(cautions(&[absent], [3, 3]).is_empty(), "it says so itself");
}

#[test]
fn one_run_against_repetitions_has_an_interval_of_both_kinds() {
    let delay = p99(&[3.0], &[6.0, 6.5, 7.0], [1, 3]);
    assert_eq!(
        (delay.verdict, delay.method.as_str()),
        (Verdict::Slower, MIXED)
    );
    let lost = loss(&[1], &[10, 12, 14], [1, 3]);
    assert_eq!(lost.method, MIXED);
    assert_eq!(loss(&[1], &[10], [1, 1]).method, EFFECTIVE);
    assert_eq!(loss(&[5, 5], &[10, 10], [2, 2]).method, NO_SPREAD);
    assert_eq!(p99(&[3.0], &[6.0], [1, 1]).method, RANKS);
}

#[test]
fn what_repetitions_are_worth_is_not_read_from_an_interval_cut_at_no_loss() {
    // Runs of 1000 that lost 0 and 10: Student's interval of their mean reaches from -0.06 to 0.07.
    let runs = [0, 10].map(|count| RunLoss {
        share: Share { count, of: 1000 },
        interval: None,
    });
    let clean = [0].map(|count| RunLoss {
        share: Share { count, of: 1000 },
        interval: None,
    });
    let like = observed_share(&runs).unwrap();
    assert!(like.interval.unwrap().low < 0.0);
    let shown = mean_share(&runs, &clean).unwrap().interval.unwrap();
    assert!(shown.low >= 0.0);
    let none = mean_share(&clean, &runs).unwrap().interval.unwrap();
    let cut = Estimate {
        interval: Some(shown),
        ..like
    };
    let narrower = none_of(1000, cut, 2000).unwrap();
    // Half as wide would be worth four times as much.
    assert!(none.high > 2.0 * narrower.high, "{none:?} {narrower:?}");
}

#[test]
fn what_the_network_did_beside_losing_is_compared_by_the_accounts_definitions() {
    let run = |reordered_count: u64| {
        let mut summary = crate::tests::sample::full();
        let channel = &mut summary.network.as_mut().unwrap().channels[0];
        let figures = &mut channel.figures;
        let count = figures.arrived_count;
        figures.order = Metric::Measured(OrderMetrics {
            count,
            reordered_count,
            ratio: reordered_count as f64 / count as f64,
            extent_p50: Some(1),
            extent_max: Some(4),
            n_max: Some(1),
        });
        let name = channel.channel.clone();
        let run = ComparedRun {
            folder: "run".into(),
            topology: serde_json::Value::Null,
            summary,
        };
        (name, run, count)
    };
    let (name, base, count) = run(10);
    let base = [base];
    let of = |metric: &str, base: &[ComparedRun], new: &[ComparedRun]| {
        let all = network(base, new);
        let mut all = all.into_iter();
        let is_it = |one: &ComparedMetric| {
            one.metric == metric && one.channel.as_deref() == Some(name.as_str())
        };
        all.find(is_it).unwrap()
    };
    let new = [run(30).1];
    let one = of("reordered", &base, &new);
    let share = |count_of: u64| count_of as f64 / count as f64;
    assert_eq!(one.base.unwrap().value.to_bits(), share(10).to_bits());
    assert_eq!(one.new.unwrap().value.to_bits(), share(30).to_bits());
    assert_eq!(
        (one.verdict, one.method.as_str()),
        (Verdict::NotTested, NO_NETWORK)
    );
    // Repetitions have Welch's interval.
    let several = |counts: [u64; 3]| counts.map(|reordered| run(reordered).1);
    let many = of("reordered", &several([10, 11, 12]), &several([30, 31, 32]));
    assert_eq!(
        (many.verdict, many.method.as_str()),
        (Verdict::Higher, REPETITIONS)
    );
    let run_max = of("loss_run_max", &base, &new);
    assert_eq!(
        (run_max.kind, run_max.unit.as_str()),
        (ChartKind::Count, "messages")
    );
    let variation = of("ipdv_p99", &base, &new);
    assert_eq!(
        (variation.part, variation.ratio),
        (Some(Part::Network), Some(1.0))
    );
}

#[test]
fn channels_with_a_demand_are_compared_by_what_it_is_judged_by() {
    let run = |availability| {
        let mut summary = crate::tests::sample::full();
        let mut demand = crate::tests::sample::demand(0.9);
        let Metric::Measured(service) = &mut demand.service else {
            panic!("it is judged: {demand:?}");
        };
        service.availability = availability;
        summary.channels[0].demand = Some(demand);
        ComparedRun {
            folder: "run".into(),
            topology: serde_json::Value::Null,
            summary,
        }
    };
    let runs = [0.9, 0.99].map(|availability| [run(availability)]);
    let figures = network(&runs[0], &runs[1]);
    let down: Vec<_> = figures
        .iter()
        .filter(|one| one.metric == "unavailability")
        .collect();
    let [down] = down.as_slice() else {
        panic!("one channel has a demand: {down:?}");
    };
    let [base, new] = [down.base, down.new].map(|one| one.unwrap().value);
    assert!((base - 0.1).abs() < 1e-9 && (new - 0.01).abs() < 1e-9);
    assert!(figures.iter().any(|one| one.metric == "not_in_time"));
}
