//! Seeded random streams: one per name, so that adding a stream never disturbs another.

use rand_core::{RngCore, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::message::{FNV_OFFSET, fnv1a};

/// A reproducible stream of random numbers (xoshiro256++, Blackman and Vigna 2021).
#[derive(Debug, Clone)]
pub struct RandomStream {
    generator: Xoshiro256PlusPlus,
}

impl RandomStream {
    /// The stream `name` of the run's `seed`; equal arguments give equal streams.
    pub fn new(seed: u64, name: &str) -> Self {
        let mixed = fnv1a(fnv1a(FNV_OFFSET, &seed.to_le_bytes()), name.as_bytes());
        // seed_from_u64 runs SplitMix64, so close seeds give unrelated states.
        Self {
            generator: Xoshiro256PlusPlus::seed_from_u64(mixed),
        }
    }

    /// Uniform bits.
    pub fn next_u64(&mut self) -> u64 {
        self.generator.next_u64()
    }

    /// Uniform in 0..1 with 53 random bits.
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }

    /// True with probability `probability`, 0..=1.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.uniform() < probability
    }

    /// Standard normal, by the polar method (Marsaglia and Bray 1964).
    pub fn normal(&mut self) -> f64 {
        loop {
            let x = 2.0 * self.uniform() - 1.0;
            let y = 2.0 * self.uniform() - 1.0;
            let square = x * x + y * y;
            if square > 0.0 && square < 1.0 {
                return x * (-2.0 * square.ln() / square).sqrt();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn first(seed: u64, name: &str) -> [u64; 4] {
        let mut stream = RandomStream::new(seed, name);
        core::array::from_fn(|_| stream.next_u64())
    }

    #[test]
    fn equal_seeds_agree_and_neighbouring_seeds_differ() {
        for seed in 0..100 {
            assert_eq!(first(seed, "link"), first(seed, "link"));
            assert_ne!(first(seed, "link"), first(seed + 1, "link"));
            assert_ne!(first(seed, "link"), first(seed, "robot"));
        }
    }

    #[test]
    fn uniform_and_normal_have_their_moments() {
        let mut stream = RandomStream::new(1, "moments");
        let count = 200_000;
        let (mut sum, mut normal_sum, mut normal_square) = (0.0, 0.0, 0.0);
        for _ in 0..count {
            sum += stream.uniform();
            let value = stream.normal();
            normal_sum += value;
            normal_square += value * value;
        }
        let n = f64::from(count);
        // Five standard errors each.
        assert!((sum / n - 0.5).abs() < 5.0 * 0.289 / n.sqrt());
        assert!((normal_sum / n).abs() < 5.0 / n.sqrt());
        assert!((normal_square / n - 1.0).abs() < 5.0 * 1.414 / n.sqrt());
    }
}
