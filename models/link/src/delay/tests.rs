//! What each delay law promises against a million draws, and what is refused.

use core::time::Duration;

use super::*;

const COUNT: usize = 1_000_000;
/// Standard errors that a figure may be off: a wrong law is off by hundreds.
const ERRORS_MAX: f64 = 5.0;
/// Kolmogorov-Smirnov distance that a million draws exceed once in 1e9 (Massart 1990:
/// P(D > d) <= 2 exp(-2 n d^2)).
const DISTANCE_MAX: f64 = 0.003_28;

pub(super) const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

const fn normal_law(mean: Duration, deviation: Duration) -> Normal {
    Normal {
        mean,
        deviation,
        ..Normal::TEMPLATE
    }
}

const fn log_normal_law(min: Duration, median: Duration, sigma: f64) -> LogNormal {
    LogNormal {
        min,
        median,
        sigma,
        ..LogNormal::TEMPLATE
    }
}

const fn exponential_law(min: Duration, mean_excess: Duration) -> Exponential {
    Exponential {
        min,
        mean_excess,
        ..Exponential::TEMPLATE
    }
}

const fn pareto_law(min: Duration, scale: Duration, shape: f64) -> Pareto {
    Pareto {
        min,
        scale,
        shape,
        ..Pareto::TEMPLATE
    }
}

/// A million draws in seconds, ascending.
fn draws(law: &DelayLaw, seed: u64) -> Vec<f64> {
    let sampler = DelaySampler::new(law).unwrap();
    let mut random = RandomStream::new(seed, "delay law");
    let draw = |_| sampler.draw(&mut random).as_secs_f64();
    let mut drawn: Vec<f64> = (0..COUNT).map(draw).collect();
    drawn.sort_unstable_by(f64::total_cmp);
    drawn
}

fn mean_and_deviation(drawn: &[f64]) -> (f64, f64) {
    let count = drawn.len() as f64;
    let mean = drawn.iter().sum::<f64>() / count;
    let square: f64 = drawn.iter().map(|one| (one - mean).powi(2)).sum();
    (mean, (square / (count - 1.0)).sqrt())
}

/// The largest distance of the empirical distribution of ascending draws from the promised one.
fn distance(law: &DelayLaw, drawn: &[f64]) -> f64 {
    let count = drawn.len() as f64;
    let mut largest: f64 = 0.0;
    for (index, one) in drawn.iter().enumerate() {
        let promised = law.distribution(*one);
        let (below, up_to) = (index as f64 / count, (index + 1) as f64 / count);
        largest = largest.max(promised - below).max(up_to - promised);
    }
    largest
}

/// Checks what `law` states of itself against a million draws, twice; and its fit, where it has one.
pub(super) fn check_law(law: &DelayLaw, seed: u64) {
    check_distribution(law, seed);
    check_quantiles(law, 100 + seed);
    let first = draws(law, 3);
    assert!(first == draws(law, 3), "{law}: one seed gives two series");
    assert!(first != draws(law, 4), "{law}: two seeds give one series");
    if let Some(fit) = law.fit() {
        check_fit(law, fit);
    }
}

fn check_distribution(law: &DelayLaw, seed: u64) {
    let drawn = draws(law, seed);
    let found = distance(law, &drawn);
    assert!(found < DISTANCE_MAX, "{law}: distance {found}");
    let (mean, deviation) = mean_and_deviation(&drawn);
    let errors = (mean - law.mean_s()) / (deviation / (COUNT as f64).sqrt());
    assert!(
        errors.abs() < ERRORS_MAX,
        "{law}: mean {mean}, {errors} standard errors off"
    );
    assert!(drawn[COUNT - 1] <= law.longest().as_secs_f64() && drawn[0] >= 0.0);
}

fn check_quantiles(law: &DelayLaw, seed: u64) {
    let drawn = draws(law, seed);
    for quantile in [0.01, 0.5, 0.9, 0.99, 0.999] {
        let promised_s = law.quantile(quantile).as_secs_f64();
        // To the nanosecond, to which draws are rounded.
        let below = drawn.partition_point(|one| *one <= promised_s + 0.6e-9) as f64;
        let share = below / COUNT as f64;
        let error = (quantile * (1.0 - quantile) / COUNT as f64).sqrt();
        let errors = (share - quantile) / error;
        assert!(
            errors.abs() < ERRORS_MAX,
            "{law}: {share} below the {quantile} quantile"
        );
    }
}

/// The law fitted to draws of the law before it is cut is near it, and a link takes its numbers.
fn check_fit(law: &DelayLaw, fit: LawFit) {
    let density = law.density();
    let mut random = RandomStream::new(5, "fit of a delay law");
    let mut drawn: Vec<f64> = (0..5_000).map(|_| density.draw(&mut random)).collect();
    drawn.sort_unstable_by(f64::total_cmp);
    let fitted = (fit.estimate)(&drawn);
    let taken = law.clone().with_numbers(&*fitted).unwrap().density();
    for x in drawn.iter().filter(|x| **x >= 0.0) {
        let (stated, found) = (density.distribution(*x), fitted.distribution(*x));
        assert!((stated - found).abs() < 0.1, "{law}: {}", fitted.text());
        assert!((taken.distribution(*x) - found).abs() < 1e-4, "{law}");
    }
    assert!(fitted.log_likelihood(&drawn).is_finite());
}

#[test]
fn deviations_are_those_of_the_closed_forms() {
    let sigma_square: f64 = 0.6 * 0.6;
    let log_normal_s = 4e-3 * ((sigma_square.exp() - 1.0) * sigma_square.exp()).sqrt();
    let cases = [
        (
            DelayLaw::Uniform(Uniform {
                min: ms(10),
                max: ms(60),
            }),
            50e-3 / 12_f64.sqrt(),
        ),
        // Cut at five deviations, which takes nothing.
        (DelayLaw::Normal(normal_law(ms(50), ms(10))), 10e-3),
        (
            DelayLaw::LogNormal(log_normal_law(ms(2), ms(4), 0.6)),
            log_normal_s,
        ),
        (DelayLaw::Exponential(exponential_law(ms(1), ms(3))), 3e-3),
    ];
    for (law, promised_s) in cases {
        let drawn = draws(&law, 7);
        let (mean, found_s) = mean_and_deviation(&drawn);
        // The standard error of a variance, from the fourth moment of the draws themselves.
        let fourth: f64 = drawn.iter().map(|one| (one - mean).powi(4)).sum();
        let variance_error = (fourth / COUNT as f64 - found_s.powi(4)).sqrt() / 1e3;
        let errors = (found_s.powi(2) - promised_s.powi(2)) / variance_error;
        assert!(
            errors.abs() < ERRORS_MAX,
            "{law}: {found_s} s, promised {promised_s} s"
        );
    }
}

#[test]
fn the_normal_law_says_what_its_cut_does_to_the_mean() {
    let mean_of = |mean, deviation| DelayLaw::Normal(normal_law(mean, deviation)).mean_s();
    // As the file's head says, and the half-normal: deviation sqrt(2 / pi).
    assert!((mean_of(ms(20), ms(10)) / 20e-3 - 1.0276).abs() < 1e-4);
    assert!((mean_of(ms(30), ms(10)) / 30e-3 - 1.001_479).abs() < 1e-6);
    let half = mean_of(Duration::ZERO, ms(10));
    assert!((half - 10e-3 * (2.0 / core::f64::consts::PI).sqrt()).abs() < 1e-9);
}

#[test]
fn a_fixed_law_takes_no_random_number() {
    let fixed = DelayLaw::fixed(ms(50));
    let sampler = DelaySampler::new(&fixed).unwrap();
    let mut random = RandomStream::new(1, "x");
    assert_eq!(sampler.draw(&mut random), ms(50));
    assert_eq!(random.next_u64(), RandomStream::new(1, "x").next_u64());
}

#[test]
fn numbers_outside_their_range_are_refused_by_name() {
    let histogram = |edges: &[u64], weights: &[f64]| {
        DelayLaw::Histogram(Histogram {
            edges: edges.iter().copied().map(ms).collect(),
            weights: weights.to_vec(),
        })
    };
    let log_normal = |sigma| DelayLaw::LogNormal(log_normal_law(ms(1), ms(1), sigma));
    let pareto = |shape| DelayLaw::Pareto(pareto_law(ms(1), ms(1), shape));
    let cases = [
        (DelayLaw::fixed(ms(10_001)), "delay"),
        (
            DelayLaw::Uniform(Uniform {
                min: ms(2),
                max: ms(1),
            }),
            "max",
        ),
        (
            DelayLaw::Normal(normal_law(ms(1), Duration::ZERO)),
            "deviation",
        ),
        (
            DelayLaw::Normal(Normal {
                max: ms(40),
                ..normal_law(ms(50), ms(10))
            }),
            "max",
        ),
        (log_normal(f64::NAN), "sigma"),
        (log_normal(3.1), "sigma"),
        (pareto(1.0), "shape"),
        (pareto(f64::INFINITY), "shape"),
        (
            DelayLaw::Exponential(Exponential {
                max: ms(2),
                ..exponential_law(ms(3), ms(1))
            }),
            "max",
        ),
        (histogram(&[1, 2], &[]), "weights"),
        (histogram(&[1, 2], &[1.0, 1.0]), "edges"),
        (histogram(&[1, 3, 3], &[1.0, 1.0]), "edges"),
        (histogram(&[1, 2], &[-1.0]), "weights"),
        (histogram(&[1, 2], &[f64::NAN]), "weights"),
        (histogram(&[1, 2, 3], &[0.0, 0.0]), "weights"),
    ];
    for (law, key) in cases {
        assert_eq!(law.check().unwrap_err().key, key, "{law:?}");
        assert!(DelaySampler::new(&law).is_err());
    }
}

#[test]
fn each_law_stands_in_the_table_of_the_documentation_with_all_its_keys() {
    let page = include_str!("../../../../docs/link-models.md");
    for name in DelayLaw::NAMES {
        let mut law = DelayLaw::named(name).unwrap();
        assert_eq!(law.name(), *name);
        let row = page
            .lines()
            .find(|line| line.starts_with(&format!("| `{name}` |")));
        let row = row.unwrap_or_else(|| panic!("{name} has no row"));
        for field in law.fields() {
            // The limit of a law without an end of its own is told once for all.
            let is_told = row.contains(&format!("`{}`", field.key));
            assert!(
                is_told || field.key == "max",
                "{name}: {} in {row}",
                field.key
            );
            let key = field.key;
            assert!(
                field.is_required || field.check().is_ok(),
                "{name}: default of {key}"
            );
        }
    }
}
