//! Fits of traces whose laws are known: the law is found again, its parameters come out, and a
//! wrong law is refused.

use core::time::Duration;

use super::chain::Chain;
use super::*;
use crate::{TraceFate, TraceHeader, TraceRecord};
use hil_core::random::RandomStream;
use hil_link::delay::{DelayLaw, Exponential, LogNormal, Normal, Pareto, Uniform};

const PERIOD_NS: i64 = 10_000_000;

const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

#[allow(clippy::cast_possible_truncation, reason = "delays below a minute")]
fn trace(losses: &[bool], mut draw: impl FnMut() -> f64) -> Trace {
    let record = |(index, is_lost): (u64, &bool)| {
        let published_ns = i64::try_from(index).unwrap() * PERIOD_NS;
        let mut record = TraceRecord::published(published_ns, index, 16);
        let delay_ns = (draw() * 1e9) as i64;
        if *is_lost {
            record.fate = TraceFate::LostInNetwork;
        } else {
            record = record.delivered(delay_ns, 0);
        }
        record
    };
    Trace {
        header: TraceHeader::new("a/b"),
        records: (0..).zip(losses).map(record).collect(),
    }
}

fn drawn(chain: Chain, count: usize, seed: u64) -> Vec<bool> {
    let mut random = RandomStream::new(seed, "losses");
    let mut is_bad = random.chance(chain.stationary()[1]);
    let step = |_| {
        let is_lost = random.chance(chain.loss[usize::from(is_bad)]);
        let leaves = if is_bad { chain.to_good } else { chain.to_bad };
        is_bad ^= random.chance(leaves);
        is_lost
    };
    (0..count).map(step).collect()
}

fn best(ranking: &Ranking) -> &Fit {
    &ranking.fits[ranking.best.unwrap()]
}

fn find<'a>(ranking: &'a Ranking, law: &str) -> &'a Fit {
    ranking.fits.iter().find(|fit| fit.law == law).unwrap()
}

#[test]
fn independent_losses_are_found_again_and_bursts_refuse_them() {
    let fit = |chain, seed| TraceFit::of(&trace(&drawn(chain, 20_000, seed), || 0.005), 1);
    let single = fit(Chain::independent(0.1), 1);
    assert_eq!(best(&single.loss).law, "bernoulli", "{:#?}", single.loss);
    let bursty = Chain {
        to_bad: 0.02,
        to_good: 0.2,
        loss: [0.0, 1.0],
    };
    let bursty = fit(bursty, 2);
    let refused = find(&bursty.loss, "bernoulli");
    assert!(!refused.is_accepted(), "{refused:?}");
    let taken = best(&bursty.loss);
    assert!(
        taken.law == "gilbert" || taken.law == "outages",
        "{taken:?}"
    );
    let outages = find(&bursty.loss, "outages");
    // Rates of the chain in continuous time: -ln(1 - 0.22) / 10 ms, shared 1 to 10.
    let mean_ms = 10.0 / (-(0.78_f64.ln()) * 10.0 / 11.0);
    let text = &outages.parameters;
    let found: f64 = text.split(' ').next().unwrap().parse().unwrap();
    assert!((found / mean_ms - 1.0).abs() < 0.1, "{text}, {mean_ms}");
    let toml = bursty.toml("hop");
    assert!(
        toml.contains("[links.hop.") && !toml.contains("LINK"),
        "{toml}"
    );
}

#[test]
fn expectation_and_maximisation_finds_all_four_numbers() {
    let chain = Chain {
        to_bad: 0.01,
        to_good: 0.1,
        loss: [0.02, 0.7],
    };
    let losses = drawn(chain, 60_000, 7);
    let fit = TraceFit::of(&trace(&losses, || 0.005), 1);
    let found = best(&fit.loss);
    assert_eq!(found.law, "gilbert-elliott", "{:#?}", fit.loss);
    let numbers: Vec<f64> = found
        .parameters
        .split([' ', ','])
        .filter_map(|word| word.parse().ok())
        .collect();
    for (found, told) in numbers.iter().zip([0.01, 0.1, 0.02, 0.7]) {
        assert!((found / told - 1.0).abs() < 0.2, "{numbers:?}");
    }
    assert!(found.is_accepted(), "{found:?}");
    assert!(!find(&fit.loss, "gilbert").is_accepted());
}

#[test]
fn each_delay_law_is_found_again() {
    let laws = [
        DelayLaw::Normal(Normal {
            mean: ms(20),
            deviation: ms(2),
            ..Normal::TEMPLATE
        }),
        DelayLaw::Exponential(Exponential {
            min: ms(4),
            mean_excess: ms(3),
            ..Exponential::TEMPLATE
        }),
        DelayLaw::LogNormal(LogNormal {
            min: ms(1),
            median: Duration::from_secs_f64((-5.5_f64).exp()),
            sigma: 0.5,
            ..LogNormal::TEMPLATE
        }),
        DelayLaw::Uniform(Uniform {
            min: ms(1),
            max: ms(9),
        }),
    ];
    for law in laws {
        let (name, density) = (law.name(), law.density());
        let mut random = RandomStream::new(11, name);
        let trace = trace(&[false; 1_500], || density.draw(&mut random));
        let fit = TraceFit::of(&trace, 5);
        let own = find(&fit.delay, name);
        assert!(
            own.ks_probability.unwrap() > 0.01,
            "{name}: {:#?}",
            fit.delay
        );
        let least = fit.delay.fits[0].aic.unwrap();
        assert!(own.aic.unwrap() < least + 10.0, "{name}: {:#?}", fit.delay);
    }
    let pareto = DelayLaw::Pareto(Pareto {
        min: ms(2),
        scale: ms(4),
        shape: 3.0,
        ..Pareto::TEMPLATE
    });
    let pareto = pareto.density();
    let mut random = RandomStream::new(12, "pareto");
    let heavy = TraceFit::of(&trace(&[false; 3_000], || pareto.draw(&mut random)), 5);
    assert_eq!(heavy.delay.fits[0].law, "pareto", "{:#?}", heavy.delay);
    let refused = find(&heavy.delay, "normal");
    assert!(refused.ks_probability.unwrap() < 0.02, "{refused:?}");
}

#[test]
fn what_has_no_formula_falls_to_the_histogram_and_what_is_constant_to_fixed() {
    let mut random = RandomStream::new(3, "two humps");
    let mut humps = || {
        let middle = if random.chance(0.4) { 0.002 } else { 0.02 };
        middle + 0.0003 * random.normal()
    };
    let fit = TraceFit::of(&trace(&[false; 2_000], &mut humps), 1);
    assert_eq!(best(&fit.delay).law, "histogram", "{:#?}", fit.delay);
    assert!(best(&fit.delay).toml.contains("edges = ["));
    let same = TraceFit::of(&trace(&[false; 100], || 0.005), 1);
    assert_eq!(best(&same.delay).law, "fixed");
    assert!(same.toml("hop").contains("delay = \"5 ms\""));
    assert!(!same.toml("hop").contains("# 98 %"));
    // A host's jitter on a fixed delay is fitted as it is, and the fixed delay said beside it.
    let mut jitter = RandomStream::new(4, "jitter");
    let host = TraceFit::of(
        &trace(&[false; 500], || 0.02 + 3e-4 * jitter.uniform().powi(3)),
        1,
    );
    assert_ne!(best(&host.delay).law, "fixed");
    assert!(
        host.toml("hop").contains("#   law = \"fixed\""),
        "{}",
        host.toml("hop")
    );
    let few = TraceFit::of(&trace(&[true; 100], || 0.005), 1);
    assert_eq!(few.delay.best, None);
    assert!(
        few.toml("hop").contains("# no delay: "),
        "{}",
        few.toml("hop")
    );
    assert_eq!(best(&few.loss).law, "bernoulli");
}

#[test]
fn equal_seeds_give_equal_fits() {
    let mut random = RandomStream::new(3, "equal");
    let one = trace(&[false; 300], || 0.01 + 0.001 * random.normal());
    assert_eq!(TraceFit::of(&one, 9), TraceFit::of(&one, 9));
}

#[test]
fn losses_late_in_a_long_trace_are_seen_by_every_law() {
    let mut losses = vec![false; 600_000];
    for burst in 0..60 {
        losses[450_000 + burst * 2_000..][..25].fill(true);
    }
    let fit = TraceFit::of(&trace(&losses, || 0.005), 1);
    assert_eq!(fit.loss_message_count, 600_000);
    let bernoulli = find(&fit.loss, "bernoulli");
    assert_eq!(bernoulli.parameters, "ratio 0.002500");
    assert!(
        fit.remarks
            .iter()
            .any(|remark| remark.contains("200000 of 600000"))
    );
    let gilbert = &find(&fit.loss, "gilbert").parameters;
    assert!(gilbert.contains("to good 0.040000"), "{gilbert}");
    let outages = &find(&fit.loss, "outages").parameters;
    assert!(outages.starts_with("24"), "{outages}");
    find(&fit.loss, "gilbert-elliott");
}

#[test]
fn a_trace_that_never_recovers_or_cannot_be_written_down_drops_the_law_and_says_why() {
    let mut losses = vec![false; 5_000];
    losses[4_000..].fill(true);
    let fit = TraceFit::of(&trace(&losses, || 0.005), 1);
    let laws: Vec<&str> = fit.loss.fits.iter().map(|fit| fit.law.as_str()).collect();
    assert!(
        !laws.contains(&"gilbert") && !laws.contains(&"outages"),
        "{laws:?}"
    );
    let why = &fit.loss.why;
    assert!(
        why.contains("left out: gilbert,") && why.contains("left out: outages,"),
        "{why}"
    );
    let finite = fit.loss.fits.iter().filter_map(|fit| fit.log_likelihood);
    assert!(
        finite.into_iter().all(|ln| ln > -10_000.0),
        "{:?}",
        fit.loss
    );
    // A failure every 2 ms: more per hour than a link takes.
    let chain = Chain {
        to_bad: 0.2,
        to_good: 0.3,
        loss: [0.0, 1.0],
    };
    let mut fast = trace(&drawn(chain, 20_000, 3), || 0.005);
    for record in &mut fast.records {
        record.published_ns /= 10;
    }
    let loss = TraceFit::of(&fast, 1).loss;
    assert!(loss.fits.iter().all(|fit| fit.law != "outages"));
    assert!(loss.why.contains("per_hour"), "{}", loss.why);
}

#[test]
fn delays_below_zero_are_taken_as_zero_and_counted() {
    let mut random = RandomStream::new(3, "negative");
    let made = trace(&[false; 400], || 0.0002 * random.uniform() - 0.00002);
    let negative_count = made.delays_ns().iter().filter(|ns| **ns < 0).count();
    assert!(negative_count > 10);
    let fit = TraceFit::of(&made, 1);
    let said = format!("{negative_count} of 400 delays are below zero");
    assert!(fit.remarks.iter().any(|one| one.contains(&said)), "{fit:?}");
    let uniform = find(&fit.delay, "uniform");
    assert!(
        uniform.parameters.starts_with("0.0000 ms to"),
        "{uniform:?}"
    );
}

#[test]
fn what_no_link_takes_is_no_fit_and_the_reason_is_said() {
    let mut random = RandomStream::new(3, "long");
    let long = trace(&[false; 400], || 9.0 + 4.0 * random.uniform());
    let ranking = TraceFit::of(&long, 1).delay;
    let laws: Vec<_> = ranking.fits.iter().map(|fit| fit.law.as_str()).collect();
    assert!(
        !laws.contains(&"uniform") && !laws.contains(&"histogram"),
        "{laws:?}"
    );
    assert!(
        ranking
            .why
            .contains("left out: uniform, as a link refuses it: max")
            && ranking
                .why
                .contains("left out: histogram, as a link refuses it: edges"),
        "{}",
        ranking.why
    );
    // A tail that has no mean beside a sharp edge: the deviation of its logarithm is no link's.
    let wild = trace(&[false; 400], || 1e-9 * (20.0 * random.uniform()).exp());
    for fit in &TraceFit::of(&wild, 1).delay.fits {
        assert!(!fit.toml.is_empty(), "{fit:?}");
    }
}
