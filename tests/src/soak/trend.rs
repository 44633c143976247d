//! Whether a quantity grows: the slope of a straight line through the means of ten equal blocks of
//! its samples, with the 95 % interval of Student's t on eight degrees of freedom.
//!
//! Block means, because samples seconds apart are alike and would make an interval too narrow; a
//! line through ten of them has an interval that is honest as long as blocks are longer than what
//! the quantity remembers. A quantity *grows* when even the low end of the interval exceeds what is
//! allowed, is *flat* when even the high end does not, and otherwise the time was too short to tell.

/// Blocks of one judgement.
pub const BLOCK_COUNT: usize = 10;
/// Student's t, two-sided 95 %, eight degrees of freedom.
const T_95: f64 = 2.306;

/// A slope per second with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slope {
    /// Best guess.
    pub per_s: f64,
    /// Low end.
    pub low_per_s: f64,
    /// High end.
    pub high_per_s: f64,
}

/// What a slope says of growth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Growth {
    /// Not more than is allowed.
    Flat,
    /// More than is allowed.
    Grows,
    /// The samples do not tell.
    Unclear,
}

impl Slope {
    /// The slope of samples of (seconds, value) at about equal distances; `None` with fewer than two
    /// a block, or all at one time.
    pub fn of(samples: &[(f64, f64)]) -> Option<Self> {
        if samples.len() < 2 * BLOCK_COUNT {
            return None;
        }
        let bounds = |block: usize| block * samples.len() / BLOCK_COUNT;
        let blocks = (0..BLOCK_COUNT).map(|block| {
            let of_block = &samples[bounds(block)..bounds(block + 1)];
            let n = of_block.len() as f64;
            let sum = |pick: fn(&(f64, f64)) -> f64| of_block.iter().map(pick).sum::<f64>();
            (sum(|one| one.0) / n, sum(|one| one.1) / n)
        });
        let blocks: Vec<(f64, f64)> = blocks.collect();
        let n = BLOCK_COUNT as f64;
        let mean_x = blocks.iter().map(|one| one.0).sum::<f64>() / n;
        let mean_y = blocks.iter().map(|one| one.1).sum::<f64>() / n;
        let sxx: f64 = blocks.iter().map(|one| (one.0 - mean_x).powi(2)).sum();
        let sxy: f64 = blocks
            .iter()
            .map(|one| (one.0 - mean_x) * (one.1 - mean_y))
            .sum();
        if sxx <= 0.0 {
            return None;
        }
        let per_s = sxy / sxx;
        let rest: f64 = blocks
            .iter()
            .map(|one| (one.1 - mean_y - per_s * (one.0 - mean_x)).powi(2))
            .sum();
        let half = T_95 * (rest / (n - 2.0) / sxx).sqrt();
        Some(Self {
            per_s,
            low_per_s: per_s - half,
            high_per_s: per_s + half,
        })
    }

    /// Whether this is more than `allowed_per_s`.
    pub fn judge(&self, allowed_per_s: f64) -> Growth {
        if self.low_per_s > allowed_per_s {
            Growth::Grows
        } else if self.high_per_s <= allowed_per_s {
            Growth::Flat
        } else {
            Growth::Unclear
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    fn samples(seed: u64, per_s: f64, noise: f64) -> Vec<(f64, f64)> {
        let mut random = RandomStream::new(seed, "trend");
        let mut one = move |index: u32| {
            let at_s = f64::from(index);
            // Between -1 and 1.
            let draw = (random.next_u64() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0;
            (at_s, 1000.0 + per_s * at_s + noise * draw)
        };
        (0..200).map(&mut one).collect()
    }

    #[test]
    fn a_leak_grows_and_noise_does_not() {
        for seed in 0..20 {
            let leak = Slope::of(&samples(seed, 2.0, 20.0)).unwrap();
            assert_eq!(leak.judge(1.0), Growth::Grows, "{leak:?}");
            let noise = Slope::of(&samples(seed, 0.0, 20.0)).unwrap();
            assert_eq!(noise.judge(1.0), Growth::Flat, "{noise:?}");
            let unclear = Slope::of(&samples(seed, 0.2, 400.0)).unwrap();
            assert_ne!(unclear.judge(1.0), Growth::Grows, "{unclear:?}");
        }
    }

    #[test]
    fn the_interval_holds_the_slope_about_as_often_as_it_says() {
        let held = (0..400).filter(|seed| {
            let slope = Slope::of(&samples(*seed, 0.5, 30.0)).unwrap();
            (slope.low_per_s..=slope.high_per_s).contains(&0.5)
        });
        let count = held.count();
        assert!((360..=395).contains(&count), "{count} of 400");
    }

    #[test]
    fn a_constant_has_no_slope_and_too_few_samples_none_either() {
        let constant: Vec<(f64, f64)> = (0..40).map(|at| (f64::from(at), 7.0)).collect();
        let slope = Slope::of(&constant).unwrap();
        assert!(slope.per_s.abs() < 1e-12 && slope.high_per_s.abs() < 1e-12);
        assert_eq!(Slope::of(&constant[..19]), None);
        assert_eq!(Slope::of(&[(1.0, 1.0); 40]), None);
    }
}
