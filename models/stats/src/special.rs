//! Quantiles and distributions behind the intervals of [`super::statistics`]. Cold path: clarity and
//! accuracy before speed; nothing here is a general numerics library.

use statrs::function::erf::erfc_inv;
use statrs::function::gamma::{gamma_lr, ln_gamma};

/// Terms after which a continued fraction is taken as converged. It needs about the square root of its
/// largest parameter, so this serves counts far above 10^8.
const ITERATIONS_MAX: u32 = 200_000;

/// Relative change at which it has converged.
const PRECISION: f64 = 1e-15;

/// Keeps a continued fraction away from division by zero (Press et al. 2007, section 5.2).
const TINY: f64 = 1e-300;

/// Regularised incomplete beta function `I_x(a, b)` for `a, b > 0` and `x` in 0..=1, by the
/// continued fraction of Lentz (Press et al. 2007, section 6.4). That of `statrs` ends after 140 terms,
/// converged or not, which is wrong for the counts of a long run.
pub fn incomplete_beta(a: f64, b: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    if x >= 1.0 {
        return 1.0;
    }
    let ln_front = ln_gamma(a + b) - ln_gamma(a) - ln_gamma(b) + a * x.ln() + b * (-x).ln_1p();
    // The fraction converges fast only below the mean; the other half follows by symmetry.
    if x < (a + 1.0) / (a + b + 2.0) {
        ln_front.exp() * beta_fraction(a, b, x) / a
    } else {
        1.0 - ln_front.exp() * beta_fraction(b, a, 1.0 - x) / b
    }
}

fn beta_fraction(a: f64, b: f64, x: f64) -> f64 {
    let mut c = 1.0;
    let mut d = 1.0 / away_from_zero(1.0 - (a + b) * x / (a + 1.0));
    let mut fraction = d;
    for step in 1..ITERATIONS_MAX {
        let m = f64::from(step);
        let even = m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m));
        d = 1.0 / away_from_zero(1.0 + even * d);
        c = away_from_zero(1.0 + even / c);
        fraction *= d * c;
        let odd = -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0));
        d = 1.0 / away_from_zero(1.0 + odd * d);
        c = away_from_zero(1.0 + odd / c);
        fraction *= d * c;
        if (d * c - 1.0).abs() < PRECISION {
            break;
        }
    }
    fraction
}

fn away_from_zero(x: f64) -> f64 {
    if x.abs() < TINY { TINY } else { x }
}

/// The `x` in `low..=high` where the non-decreasing `function` reaches `target`, by bisection to
/// the last bit.
pub fn invert(target: f64, low: f64, high: f64, function: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (low, high);
    loop {
        let middle = f64::midpoint(low, high);
        if middle <= low || middle >= high {
            return middle;
        }
        if function(middle) < target {
            low = middle;
        } else {
            high = middle;
        }
    }
}

/// The standard normal quantile: `probability` of the mass lies below it.
pub fn normal_quantile(probability: f64) -> f64 {
    -core::f64::consts::SQRT_2 * erfc_inv(2.0 * probability)
}

/// Probability of a standard normal value up to `z`, to 1e-14, by the series about zero of Marsaglia
/// (2004, "Evaluating the normal distribution", J. Stat. Softw. 11(4), equation 3); the `erfc` of
/// `statrs` is off by more than 1e-13.
pub fn normal_distribution(z: f64) -> f64 {
    if z.is_nan() {
        return z;
    }
    // Beyond, the rest is below 1e-15, the error of the series.
    if z.abs() > 8.0 {
        return if z > 0.0 { 1.0 } else { 0.0 };
    }
    let (mut sum, mut term, mut odd) = (z, z, 1.0);
    loop {
        odd += 2.0;
        term *= z * z / odd;
        let next = sum + term;
        // Until the terms no longer change the sum: the series converges, and a sum has finitely
        // many digits.
        if (next - sum).abs() <= f64::EPSILON * 0.1 * next.abs() {
            let density = (-0.5 * z * z).exp() / (2.0 * core::f64::consts::PI).sqrt();
            return (0.5 + sum * density).clamp(0.0, 1.0);
        }
        sum = next;
    }
}

/// The quantile of Student's distribution above the median. That of `statrs` rests on its incomplete
/// beta function and is off by 1e-4 at a million degrees of freedom.
pub fn student_quantile(probability: f64, freedom: f64) -> f64 {
    let below = |t: f64| {
        let x = freedom / (freedom + t * t);
        1.0 - 0.5 * incomplete_beta(freedom / 2.0, 0.5, x)
    };
    invert(probability, 0.0, 1e4, below)
}

/// The quantile of the gamma distribution with this shape and scale one.
pub fn gamma_quantile(probability: f64, shape: f64) -> f64 {
    // Far beyond any quantile that is asked for.
    let high = shape + 12.0 * shape.sqrt() + 50.0;
    invert(probability, 0.0, high, |x| {
        if x > 0.0 { gamma_lr(shape, x) } else { 0.0 }
    })
}

/// The place, from 0, of the smallest of `count` ascending values that at least `share` of them do not
/// exceed.
///
/// # Panics
/// When there are none.
pub fn place_of(share: f64, count: usize) -> usize {
    ceil_count(share * count as f64).clamp(1, count) - 1
}

/// The smallest whole number at or above `x`; 0 below it, the largest count above it.
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the cast saturates at both ends, which is what the name says"
)]
pub fn ceil_count(x: f64) -> usize {
    x.ceil() as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(actual: f64, expected: f64) {
        let error = (actual - expected).abs() / expected.abs().max(1e-12);
        assert!(error < 1e-11, "{actual} is not {expected}");
    }

    #[test]
    fn the_normal_distribution_has_the_values_of_the_tables() {
        // Abramowitz and Stegun, table 26.1.
        for (z, expected) in [
            (0.0, 0.5),
            (0.5, 0.691_462_461_274_013),
            (1.0, 0.841_344_746_068_543),
            (1.96, 0.975_002_104_851_780),
            (3.0, 0.998_650_101_968_370),
        ] {
            assert!((normal_distribution(z) - expected).abs() < 1e-13, "{z}");
            assert!(
                (normal_distribution(-z) - (1.0 - expected)).abs() < 1e-13,
                "{z}"
            );
        }
        assert!(normal_distribution(7.9) > 1.0 - 1e-13);
        assert!(normal_distribution(f64::INFINITY) > 0.999);
        assert!(normal_distribution(f64::NEG_INFINITY) < 1e-15);
    }

    #[test]
    fn normal_quantiles_match_the_tables() {
        close(normal_quantile(0.975), 1.959_963_984_540_054);
        close(normal_quantile(0.995), 2.575_829_303_548_901);
        close(normal_quantile(0.05), -1.644_853_626_951_472_7);
    }

    #[test]
    fn student_quantiles_are_those_of_the_tables() {
        for (freedom, expected) in [(1.0, 12.7062), (4.0, 2.7764), (10.0, 2.2281), (1e6, 1.96)] {
            let found = student_quantile(0.975, freedom);
            assert!((found - expected).abs() < 1e-4, "{freedom}: {found}");
        }
    }

    #[test]
    fn large_counts_converge() {
        // The median of Binomial(10^8, 0.01) is its mean.
        let share = incomplete_beta(99_000_000.0, 1_000_001.0, 0.99);
        assert!((share - 0.5).abs() < 1e-3, "{share}");
    }
}
