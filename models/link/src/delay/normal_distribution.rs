//! The standard normal distribution: density and distribution function. It draws nothing.

use core::f64::consts::PI;

/// Density at `z`.
pub(super) fn density(z: f64) -> f64 {
    (-0.5 * z * z).exp() / (2.0 * PI).sqrt()
}

/// Probability of a value up to `z`, to 1e-14, by the series about zero of Marsaglia (2004,
/// "Evaluating the normal distribution", J. Stat. Softw. 11(4), equation 3).
pub(super) fn distribution(z: f64) -> f64 {
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
            return (0.5 + sum * density(z)).clamp(0.0, 1.0);
        }
        sum = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_has_the_values_of_the_tables() {
        // Abramowitz and Stegun, table 26.1.
        for (z, expected) in [
            (0.0, 0.5),
            (0.5, 0.691_462_461_274_013),
            (1.0, 0.841_344_746_068_543),
            (1.96, 0.975_002_104_851_780),
            (3.0, 0.998_650_101_968_370),
        ] {
            assert!((distribution(z) - expected).abs() < 1e-13, "{z}");
            assert!((distribution(-z) - (1.0 - expected)).abs() < 1e-13, "{z}");
        }
        assert!((density(1.0) - 0.241_970_724_519_143_37).abs() < 1e-15);
        assert!(distribution(7.9) > 1.0 - 1e-13 && distribution(f64::INFINITY) > 0.999);
        assert!(distribution(f64::NEG_INFINITY) < 1e-15);
    }
}
