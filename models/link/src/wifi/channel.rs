//! The radio channel: path loss over distance, slow shadowing and fast fading, as a
//! signal-to-noise ratio. It decides nothing about frames.
//!
//! Shadowing and fading are functions of a key and of time alone, looked up in any order: all
//! channels of a link, both ways and in whatever process, are in the same fade at the same time.

use crate::wifi::phy::nanoseconds;
use crate::wifi::spec::WifiSpec;
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// Speed of light, m/s.
const LIGHT_M_PER_S: f64 = 299_792_458.0;
/// Thermal noise density at 290 K, dBm/Hz.
const NOISE_DBM_PER_HZ: f64 = -174.0;

/// Path loss, dB: free space to 1 m, then two slopes with a break point as in the models of Erceg
/// et al. (IEEE 802.11-03/940r4, "`TGn` channel models"), and the walls.
pub(crate) fn path_loss_db(spec: &WifiSpec) -> f64 {
    let wavelength_m = LIGHT_M_PER_S / (spec.frequency_mhz * 1e6);
    let at_one_metre_db = 20.0 * (4.0 * core::f64::consts::PI / wavelength_m).log10();
    let near_m = spec.distance_m.min(spec.breakpoint_m);
    let near_db = 10.0 * spec.exponent_near * near_m.log10();
    let far_db = 10.0 * spec.exponent_far * (spec.distance_m / near_m).log10();
    at_one_metre_db + near_db + far_db + f64::from(spec.wall_count) * spec.wall_loss_db
}

/// Noise power in the channel, dBm.
fn noise_dbm(spec: &WifiSpec) -> f64 {
    let bandwidth_hz = f64::from(spec.channel_width_mhz) * 1e6;
    NOISE_DBM_PER_HZ + 10.0 * bandwidth_hz.log10() + spec.noise_figure_db
}

/// Signal-to-noise ratio without shadowing and fading, dB. One antenna's: what several gain is in
/// the milder fading.
pub(crate) fn median_snr_db(spec: &WifiSpec) -> f64 {
    spec.tx_power_dbm - path_loss_db(spec) - noise_dbm(spec)
}

/// Random numbers of the `index`-th step of a process.
fn stream_at(key: u64, index: i64) -> RandomStream {
    RandomStream::new(key.wrapping_add(index.cast_unsigned()), "step")
}

/// Steps per correlation time; the process is constant within one.
const STEPS: u32 = 8;
/// Steps that are remembered: five correlation times.
const MEMORY: u32 = 5 * STEPS;

/// Log-normal shadowing with an exponential autocorrelation (Gudmundson 1991, in time instead of
/// space, as it is people who move here and not the stations): a weighted sum of independent
/// normal numbers, the newest `MEMORY` steps of a first-order autoregression, which makes any
/// instant as cheap as the next.
#[derive(Debug, Clone)]
pub(crate) struct Shadowing {
    key: u64,
    deviation_db: f64,
    step_ns: i64,
    decay: f64,
    newest: Option<(i64, f64)>,
}

impl Shadowing {
    pub(crate) fn new(spec: &WifiSpec, key: u64) -> Self {
        let decay = (-1.0 / f64::from(STEPS)).exp();
        // So that the cut sum has the deviation that was asked for.
        let cut = 1.0 - decay.powf(2.0 * f64::from(MEMORY));
        let innovation = ((1.0 - decay * decay) / cut).sqrt();
        Self {
            key,
            deviation_db: spec.shadowing_db * innovation,
            step_ns: nanoseconds(spec.shadowing_correlation_s * 1e9 / f64::from(STEPS)),
            decay,
            newest: None,
        }
    }

    /// The step that `at` is in, and its shadowing in dB.
    pub(crate) fn at(&mut self, at: Instant) -> (i64, f64) {
        let step = at.as_ns().div_euclid(self.step_ns);
        if let Some(newest) = self.newest.filter(|(known, _)| *known == step) {
            return newest;
        }
        let mut sum = 0.0;
        if self.deviation_db > 0.0 {
            for back in (0..i64::from(MEMORY)).rev() {
                let normal = stream_at(self.key, step.saturating_sub(back)).normal();
                sum = sum * self.decay + normal;
            }
        }
        let newest = (step, self.deviation_db * sum);
        self.newest = Some(newest);
        newest
    }
}

/// Nakagami fading: the power gain is a Gamma variable of shape `m` and mean 1, constant for the
/// coherence time and independent from one to the next.
#[derive(Debug, Clone)]
pub(crate) struct Fading {
    key: u64,
    shape: f64,
    block_ns: i64,
    newest: Option<(i64, f64)>,
}

impl Fading {
    pub(crate) fn new(spec: &WifiSpec, key: u64) -> Self {
        Self {
            key,
            shape: spec.fading_m,
            block_ns: nanoseconds(spec.fading_coherence_ms * 1e6),
            newest: None,
        }
    }

    /// The gain at `at`, dB.
    pub(crate) fn at(&mut self, at: Instant) -> f64 {
        if self.shape <= 0.0 {
            return 0.0;
        }
        let block = at.as_ns().div_euclid(self.block_ns);
        if let Some((_, gain_db)) = self.newest.filter(|(known, _)| *known == block) {
            return gain_db;
        }
        let mut random = stream_at(self.key, block);
        let gain_db = 10.0 * (gamma(&mut random, self.shape) / self.shape).log10();
        self.newest = Some((block, gain_db));
        gain_db
    }
}

/// Gamma variable of scale 1 (Marsaglia and Tsang 2000); a shape below 1 by their boost.
fn gamma(random: &mut RandomStream, shape: f64) -> f64 {
    if shape < 1.0 {
        let boost = (1.0 - random.uniform()).powf(1.0 / shape);
        return boost * gamma(random, shape + 1.0);
    }
    let base = shape - 1.0 / 3.0;
    let scale = 1.0 / (9.0 * base).sqrt();
    loop {
        let normal = random.normal();
        let cube = (1.0 + scale * normal).powi(3);
        if cube <= 0.0 {
            continue;
        }
        let uniform = 1.0 - random.uniform();
        if uniform.ln() < 0.5 * normal * normal + base * (1.0 - cube + cube.ln()) {
            return base * cube;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_link_budget_is_the_sum_of_its_parts() {
        let spec = WifiSpec {
            distance_m: 40.0,
            breakpoint_m: 10.0,
            exponent_near: 2.0,
            exponent_far: 3.5,
            wall_count: 2,
            wall_loss_db: 5.0,
            frequency_mhz: 5500.0,
            channel_width_mhz: 80,
            tx_power_dbm: 20.0,
            noise_figure_db: 7.0,
            ..WifiSpec::default()
        };
        // Free space at 5.5 GHz: 47.26 dB at 1 m, 67.26 dB at 10 m.
        let loss = 67.26 + 35.0 * 4.0_f64.log10() + 10.0;
        assert!((path_loss_db(&spec) - loss).abs() < 0.01);
        let noise = -174.0 + 79.03 + 7.0;
        assert!((median_snr_db(&spec) - (20.0 - loss - noise)).abs() < 0.01);
    }

    #[test]
    fn a_million_steps_of_shadowing_have_their_deviation_and_autocorrelation() {
        let spec = WifiSpec {
            shadowing_db: 4.0,
            shadowing_correlation_s: 10.0,
            ..WifiSpec::default()
        };
        let mut shadowing = Shadowing::new(&spec, 11);
        let step_ns = shadowing.step_ns;
        let values: Vec<f64> = (0..1_000_000)
            .map(|step| shadowing.at(Instant::from_ns(step * step_ns + 1)).1)
            .collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let lagged = |lag: usize| {
            let pairs = values.iter().zip(&values[lag..]);
            pairs.map(|(a, b)| a * b).sum::<f64>() / n
        };
        // Five standard errors: of 1e6 values some 6e4 are independent.
        assert!(mean.abs() < 5.0 * 4.0 / 6e4_f64.sqrt(), "{mean}");
        assert!(
            (lagged(0).sqrt() - 4.0).abs() < 0.06,
            "{}",
            lagged(0).sqrt()
        );
        for (lag, expected) in [(8, (-1.0_f64).exp()), (16, (-2.0_f64).exp()), (80, 0.0)] {
            let found = lagged(lag) / lagged(0);
            assert!((found - expected).abs() < 0.02, "{lag}: {found}");
        }
    }

    #[test]
    fn a_million_fades_follow_their_gamma_law() {
        for (shape, below_half) in [
            (1.0, 1.0 - (-0.5_f64).exp()),
            (2.0, 1.0 - 2.0 * (-1.0_f64).exp()),
        ] {
            let spec = WifiSpec {
                fading_m: shape,
                fading_coherence_ms: 20.0,
                ..WifiSpec::default()
            };
            let mut fading = Fading::new(&spec, 7);
            let (mut sum, mut square, mut below, n) = (0.0, 0.0, 0.0, 1e6);
            for block in 0..1_000_000 {
                let gain = 10.0_f64.powf(0.1 * fading.at(Instant::from_ns(block * 20_000_000)));
                sum += gain;
                square += gain * gain;
                below += f64::from(u8::from(gain < 0.5));
            }
            let variance = square / n - (sum / n).powi(2);
            assert!((sum / n - 1.0).abs() < 0.006, "{}", sum / n);
            assert!((variance * shape - 1.0).abs() < 0.02, "{variance}");
            assert!((below / n - below_half).abs() < 0.003, "{}", below / n);
        }
    }

    #[test]
    fn any_order_of_instants_gives_the_same_channel() {
        let spec = WifiSpec::default();
        let (mut one, mut other) = (Shadowing::new(&spec, 5), Shadowing::new(&spec, 5));
        let (mut fade, mut fade_other) = (Fading::new(&spec, 6), Fading::new(&spec, 6));
        let at = |index: i64| Instant::from_ns(index * 7_000_000);
        let forward: Vec<_> = (0..20_000)
            .map(|i| (one.at(at(i)), fade.at(at(i))))
            .collect();
        for i in (0..20_000).rev() {
            let found = (other.at(at(i)), fade_other.at(at(i)));
            assert_eq!(found, forward[usize::try_from(i).unwrap()]);
        }
        let far = Instant::from_ns(i64::MAX);
        assert_eq!(one.at(far), other.at(far));
    }
}
