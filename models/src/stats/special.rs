//! The special functions behind the intervals of [`super::statistics`]. Cold path: clarity and
//! accuracy before speed; nothing here is a general numerics library.

/// Terms after which a continued fraction or series is taken as converged. Both need about the
/// square root of their largest parameter, so this serves counts far above 10^8.
const ITERATIONS_MAX: u32 = 200_000;

/// Relative change at which an expansion has converged.
const PRECISION: f64 = 1e-15;

/// Keeps a continued fraction away from division by zero (Press et al. 2007, section 5.2).
const TINY: f64 = 1e-300;

/// Coefficients of Lanczos (1964) for g = 7 as published by Godfrey (2001).
const LANCZOS: [f64; 9] = [
    0.999_999_999_999_809_9,
    676.520_368_121_885_1,
    -1_259.139_216_722_402_8,
    771.323_428_777_653_1,
    -176.615_029_162_140_6,
    12.507_343_278_686_905,
    -0.138_571_095_265_720_12,
    9.984_369_578_019_572e-6,
    1.505_632_735_149_311_6e-7,
];

/// Natural logarithm of the gamma function for `x > 0`.
pub fn ln_gamma(x: f64) -> f64 {
    if x < 0.5 {
        let sine = (core::f64::consts::PI * x).sin();
        return (core::f64::consts::PI / sine).ln() - ln_gamma(1.0 - x);
    }
    let shifted = x - 1.0;
    let base = shifted + 7.5;
    let mut sum = LANCZOS[0];
    let mut denominator = shifted;
    for coefficient in &LANCZOS[1..] {
        denominator += 1.0;
        sum += coefficient / denominator;
    }
    0.5 * (2.0 * core::f64::consts::PI).ln() + (shifted + 0.5) * base.ln() - base + sum.ln()
}

/// Regularised incomplete beta function `I_x(a, b)` for `a, b > 0` and `x` in 0..=1, by the
/// continued fraction of Lentz (Press et al. 2007, section 6.4).
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

/// Regularised lower incomplete gamma function P(a, x) for `a > 0`, `x >= 0` (Press et al. 2007,
/// section 6.2): series below the mean, continued fraction above.
pub fn incomplete_gamma(a: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let front = (a * x.ln() - x - ln_gamma(a)).exp();
    if x < a + 1.0 {
        let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
        for _ in 0..ITERATIONS_MAX {
            n += 1.0;
            term *= x / n;
            sum += term;
            if term < sum * PRECISION {
                break;
            }
        }
        return front * sum;
    }
    let mut b = x + 1.0 - a;
    let mut c = 1.0 / TINY;
    let mut d = 1.0 / away_from_zero(b);
    let mut fraction = d;
    for step in 1..ITERATIONS_MAX {
        let i = f64::from(step);
        let numerator = -i * (i - a);
        b += 2.0;
        d = 1.0 / away_from_zero(numerator * d + b);
        c = away_from_zero(b + numerator / c);
        fraction *= d * c;
        if (d * c - 1.0).abs() < PRECISION {
            break;
        }
    }
    1.0 - front * fraction
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
    invert(probability, -40.0, 40.0, |x| {
        let half = 0.5 * incomplete_gamma(0.5, 0.5 * x * x);
        if x < 0.0 { 0.5 - half } else { 0.5 + half }
    })
}

/// P(B <= `successes`) of a binomial distribution over `trials` with `probability` each.
pub fn binomial_cdf(successes: u64, trials: u64, probability: f64) -> f64 {
    if successes >= trials {
        return 1.0;
    }
    incomplete_beta(
        (trials - successes) as f64,
        successes as f64 + 1.0,
        1.0 - probability,
    )
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
    fn gamma_meets_its_factorials_and_its_half() {
        close(ln_gamma(1.0).exp(), 1.0);
        close(ln_gamma(11.0).exp(), 3_628_800.0);
        close(ln_gamma(0.5).exp(), core::f64::consts::PI.sqrt());
        close(ln_gamma(0.25), 1.288_022_524_698_077_5);
    }

    #[test]
    fn normal_quantiles_match_the_tables() {
        close(normal_quantile(0.975), 1.959_963_984_540_054);
        close(normal_quantile(0.995), 2.575_829_303_548_901);
        close(normal_quantile(0.05), -1.644_853_626_951_472_7);
    }

    #[test]
    fn binomial_sums_match_direct_addition() {
        // Direct sum of C(10, k) / 2^10.
        close(binomial_cdf(1, 10, 0.5), 11.0 / 1024.0);
        close(binomial_cdf(7, 10, 0.5), 968.0 / 1024.0);
        close(binomial_cdf(10, 10, 0.3), 1.0);
    }

    #[test]
    fn large_counts_converge() {
        // The median of Binomial(10^8, 0.01) is its mean.
        let share = binomial_cdf(1_000_000, 100_000_000, 0.01);
        assert!((share - 0.5).abs() < 1e-3, "{share}");
    }
}
