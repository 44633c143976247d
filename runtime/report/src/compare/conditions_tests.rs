//! Conditions on made-up figures.

use hil_core::interval::IntervalMethod;
use hil_stats::comparison::Estimate;

use super::*;
use crate::answer::{Hurt, Object};
use crate::compare::{Tested, Verdict};

fn figure(metric: &str, kind: ChartKind, [low, value, high]: [f64; 3]) -> ComparedMetric {
    let interval = Some(Interval::new(low, high, IntervalMethod::EffectiveRanks));
    let estimate = |value: f64| Some(Estimate { value, interval });
    ComparedMetric {
        channel: (kind != ChartKind::Score).then(|| "a/b".to_owned()),
        part: match kind {
            ChartKind::Delay => Some(Part::EndToEnd),
            ChartKind::Loss | ChartKind::Count | ChartKind::Score => None,
        },
        metric: metric.to_owned(),
        label: metric.to_owned(),
        kind,
        unit: String::new(),
        base: estimate(1.0),
        new: estimate(value),
        base_count: 1,
        new_count: 1,
        ratio: Some(value),
        ratio_interval: interval,
        difference: Some(value),
        difference_interval: interval,
        verdict: Verdict::Slower,
        method: "why not".to_owned(),
    }
}

fn comparison() -> Comparison {
    let mut maximum = figure("max", ChartKind::Delay, [1.0, 3.0, 4.0]);
    maximum.ratio_interval = None;
    Comparison {
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
        figures: vec![
            figure("p99", ChartKind::Delay, [1.1, 1.3, 1.5]),
            maximum,
            figure("loss", ChartKind::Loss, [0.001, 0.002, 0.004]),
            figure("score_ratio", ChartKind::Score, [0.5, 0.7, 0.9]),
        ],
    }
}

fn holds(text: &str, is_strict: bool) -> Result<bool, ConditionError> {
    let verdicts = verdicts(text, &comparison(), is_strict)?;
    Ok(verdicts.judged.iter().any(|one| one.holds))
}

fn verdicts(
    text: &str,
    comparison: &Comparison,
    is_strict: bool,
) -> Result<Verdicts, ConditionError> {
    let mut verdicts = Verdicts::default();
    Condition::parse(text)?.judge(comparison, is_strict, &mut verdicts)?;
    Ok(verdicts)
}

#[test]
fn a_channel_that_cannot_be_judged_is_named_beside_those_that_can() {
    let mut both = comparison();
    let mut sparse = figure("p99", ChartKind::Delay, [1.0, 3.0, 4.0]);
    sparse.channel = Some("c/d".to_owned());
    sparse.ratio_interval = None;
    both.figures.push(sparse);
    for (condition, first) in [
        (
            "p99 > 1.2x",
            "passes: p99 > 1.2x: a/b:p99 is 1.300x (1.100x to 1.500x)",
        ),
        (
            "p99 > 1.05x",
            "FAILS: p99 > 1.05x: a/b:p99 is 1.300x (1.100x to 1.500x)",
        ),
    ] {
        let lines = verdicts(condition, &both, false).unwrap().lines();
        assert_eq!(lines.len(), 2, "{lines:?}");
        assert_eq!(lines[0], first);
        let unjudged = format!("not judged: {condition}: c/d:p99: why not; --strict");
        assert!(lines[1].starts_with(&unjudged), "{lines:?}");
    }
    // Nothing is left to judge where only that channel is meant.
    let alone = verdicts("c/d:p99 > 1.2x", &both, false).unwrap_err();
    assert!(
        alone.to_string().contains("cannot be judged for c/d:p99"),
        "{alone}"
    );
    let strictly = verdicts("p99 > 1.2x", &both, true).unwrap();
    assert_eq!((strictly.judged.len(), strictly.unjudged.len()), (2, 0));
    let in_ns = verdicts("a/b:p99 > 1 ns", &both, false).unwrap().lines();
    assert!(
        in_ns[0].ends_with("is 1.300 ns (1.100 ns to 1.500 ns)"),
        "{in_ns:?}"
    );
}

#[test]
fn a_condition_holds_beyond_the_interval_or_strictly_by_the_figure() {
    for (text, beyond, strictly) in [
        ("p99 > 1.2x", false, true),
        ("p99 > 1.05x", true, true),
        ("a/b:p99>=1.1x", true, true),
        ("p99 < 1.4x", false, true),
        ("loss > 0.15%", false, true),
        ("loss > 0.05 pp", true, true),
        ("score_ratio < 1", true, true),
        ("score_ratio < 0.8", false, true),
    ] {
        assert_eq!(holds(text, false), Ok(beyond), "{text}");
        assert_eq!(holds(text, true), Ok(strictly), "{text}, strictly");
    }
}

#[test]
fn what_cannot_be_judged_says_what_could() {
    for (text, words) in [
        (
            "p98 > 1x",
            "unknown metric `p98`; these runs have: p99, max, loss, score_ratio",
        ),
        ("c:p99 > 1x", "unknown channel `c`; these runs have: a/b"),
        (
            "p99 > 1%",
            "p99 takes no `%`; allowed: x (new by base); s, ms, us, ns",
        ),
        (
            "p99 > 3",
            "p99 needs a unit; allowed: x (new by base); s, ms",
        ),
        (
            "loss > 1x",
            "loss takes no `x`; allowed: % (of the new runs), pp",
        ),
        ("p99 1.2x", "no operator"),
        ("> 2x", "no metric"),
        ("p99 > fast", "no number"),
        (
            "max > 2x",
            "cannot be judged for a/b:max: why not; --strict",
        ),
    ] {
        let error = holds(text, false).unwrap_err().to_string();
        assert!(error.contains(words), "{text}: {error}");
    }
    assert_eq!(holds("max > 2x", true), Ok(true));
}
