//! Rate and error: which modulation and coding scheme a frame goes out with, how an attempt steps
//! down, and how likely it is to be received. It draws nothing.

use crate::wifi::phy::MCS_COUNT;
use crate::wifi::spec::WifiSpec;

/// Signal-to-noise ratio at which a frame of 4096 bytes is lost with probability 0.1, dB.
///
/// From the receiver minimum input sensitivities for 20 MHz of IEEE Std 802.11ax-2021, 27.3 (-82,
/// -79, -77, -74, -70, -66, -65, -64, -59, -57, -54, -52 dBm), which allow for a noise figure of 10
/// dB and an implementation margin of 5 dB (IEEE Std 802.11-2020, clause 17.3.10): noise in 20 MHz
/// is then at -86 dBm. Real receivers do better; a smaller noise figure stands for that.
const THRESHOLDS_DB: [f64; MCS_COUNT] = [
    4.0, 7.0, 9.0, 12.0, 16.0, 20.0, 21.0, 22.0, 27.0, 29.0, 32.0, 34.0,
];
/// Bytes of the frames that the thresholds are for.
const REFERENCE_BYTES: f64 = 4096.0;

impl WifiSpec {
    /// The scheme that a sender settles on at an average signal-to-noise ratio: the highest whose
    /// threshold lies a margin below. It stands for the steady state of a controller that samples
    /// rates, as Minstrel does in Linux, and not for its learning.
    pub(crate) fn settled(&self, snr_db: f64) -> usize {
        let is_reached = |mcs: &usize| THRESHOLDS_DB[*mcs] + self.rate_margin_db <= snr_db;
        (0..=self.mcs_max as usize)
            .rev()
            .find(is_reached)
            .unwrap_or(0)
    }

    /// The scheme of the `attempt`-th attempt, counted from 0: one lower after so many failures.
    pub(crate) fn stepped_down(&self, settled: usize, attempt: usize) -> usize {
        settled.saturating_sub(attempt / self.attempts_per_rate as usize)
    }

    /// Probability that a PPDU of `air_bytes` at the scheme `mcs` is not received: a logistic curve
    /// over the signal-to-noise ratio through the threshold, and bytes that fail independently.
    /// Both are approximations; link simulations give curves of similar steepness.
    pub(crate) fn error_ratio(&self, mcs: usize, snr_db: f64, air_bytes: u64) -> f64 {
        // 0.1 at the threshold: odds of 1 to 9.
        let odds = (self.error_slope_per_db * (THRESHOLDS_DB[mcs] - snr_db)).exp() / 9.0;
        // (1 - error of the reference) is 1 / (1 + odds).
        let length_ratio = air_bytes as f64 / REFERENCE_BYTES;
        -(-length_ratio * odds.ln_1p()).exp_m1()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates() -> WifiSpec {
        WifiSpec {
            error_slope_per_db: 3.0,
            rate_margin_db: 2.0,
            mcs_max: 11,
            attempts_per_rate: 2,
            ..WifiSpec::default()
        }
    }

    #[test]
    fn the_error_ratio_goes_through_its_threshold_and_grows_with_length() {
        let rates = rates();
        for (mcs, threshold) in THRESHOLDS_DB.iter().enumerate() {
            let at = |offset: f64, bytes| rates.error_ratio(mcs, threshold + offset, bytes);
            assert!((at(0.0, 4096) - 0.1).abs() < 1e-12);
            // Half the bytes: 1 - sqrt(0.9).
            assert!((at(0.0, 2048) - (1.0 - 0.9_f64.sqrt())).abs() < 1e-12);
            assert!(at(-10.0, 4096) > 0.999_999 && at(10.0, 4096) < 1e-12);
            assert!(at(-1.0, 4096) > at(0.0, 4096) && at(1.0, 4096) < at(0.0, 4096));
        }
        // Far out of range: certain, and a number.
        assert!((rates.error_ratio(11, -1000.0, 100) - 1.0).abs() < 1e-12);
        assert!(rates.error_ratio(0, 1000.0, 100).abs() < 1e-12);
    }

    #[test]
    fn a_worse_channel_settles_lower_and_each_pair_of_failures_steps_down() {
        let rates = rates();
        let settled: Vec<_> = [60.0, 31.0, 30.9, 14.0, 6.0, 5.9, -20.0]
            .iter()
            .map(|snr| rates.settled(*snr))
            .collect();
        assert_eq!(settled, [11, 9, 8, 3, 0, 0, 0]);
        let chain: Vec<_> = (0..7)
            .map(|attempt| rates.stepped_down(2, attempt))
            .collect();
        assert_eq!(chain, [2, 2, 1, 1, 0, 0, 0]);
    }
}
