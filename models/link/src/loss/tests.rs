//! What each loss law promises against a million messages and more.

use core::time::Duration;

use super::*;

const COUNT: usize = 2_000_000;
const ERRORS_MAX: f64 = 5.0;

fn process(law: LossLaw, seed: u64, channel: &str) -> Box<dyn Losses> {
    let shared = RandomStream::new(seed, "bursts of the link");
    law.start(RandomStream::new(seed, channel), shared).unwrap()
}

/// The fates of messages one period apart.
fn fates(law: LossLaw, seed: u64, period: Duration) -> Vec<bool> {
    let mut process = process(law, seed, "channel");
    let mut now = Instant::ZERO;
    let next = |_| {
        let is_lost = process.is_lost(now);
        now = now + period;
        is_lost
    };
    (0..COUNT).map(next).collect()
}

fn lost_ratio(fates: &[bool]) -> f64 {
    fates.iter().filter(|is_lost| **is_lost).count() as f64 / fates.len() as f64
}

/// Runs of losses by their length: index 0 counts those of length 1.
fn bursts_by_length(fates: &[bool]) -> Vec<u64> {
    let mut counts = vec![0; 64];
    let mut length = 0;
    for is_lost in fates {
        if *is_lost {
            length += 1;
        } else if length > 0 {
            counts[length.min(64) - 1] += 1;
            length = 0;
        }
    }
    counts
}

/// Standard error of a share of `count` steps of a two-state chain whose neighbours are correlated
/// by `memory`.
fn share_error(share: f64, memory: f64, count: usize) -> f64 {
    (share * (1.0 - share) * (1.0 + memory) / (1.0 - memory) / count as f64).sqrt()
}

#[test]
fn independent_losses_have_their_ratio_and_geometric_bursts() {
    for ratio in [0.01, 0.1, 0.5] {
        let fates = fates(LossLaw::bernoulli(ratio), 1, Duration::from_millis(1));
        let errors = (lost_ratio(&fates) - ratio) / share_error(ratio, 0.0, COUNT);
        assert!(
            errors.abs() < ERRORS_MAX,
            "{ratio}: {errors} standard errors off"
        );
        check_geometric(&bursts_by_length(&fates), 1.0 - ratio);
    }
}

/// Bursts end with probability `ends` after each message: length k has (1 - ends)^(k-1) ends.
fn check_geometric(counts: &[u64], ends: f64) {
    let total = counts.iter().sum::<u64>() as f64;
    for (index, count) in counts.iter().enumerate().take(20) {
        let promised = (1.0 - ends).powf(index as f64) * ends;
        let error = (total * promised * (1.0 - promised)).sqrt();
        if total * promised > 20.0 {
            let errors = (*count as f64 - total * promised) / error;
            assert!(
                errors.abs() < ERRORS_MAX,
                "{count} bursts of {}, {errors}",
                index + 1
            );
        }
    }
}

#[test]
fn the_chain_has_its_ratio_and_its_bursts_are_geometric() {
    for (to_bad, to_good) in [(0.01, 0.25), (0.002, 0.1), (0.3, 0.6)] {
        let law = GilbertElliott {
            to_bad,
            to_good,
            bad_loss_ratio: 1.0,
            good_loss_ratio: 0.0,
        };
        let fates = fates(LossLaw::GilbertElliott(law), 2, Duration::from_millis(1));
        let promised = to_bad / (to_bad + to_good);
        assert!((law.loss_ratio() - promised).abs() < 1e-15);
        let error = share_error(promised, 1.0 - to_bad - to_good, COUNT);
        let errors = (lost_ratio(&fates) - promised) / error;
        assert!(
            errors.abs() < ERRORS_MAX,
            "{law:?}: {errors} standard errors off"
        );
        check_geometric(&bursts_by_length(&fates), to_good);
        // And the good state lasts as it should.
        let good: Vec<bool> = fates.iter().map(|is_lost| !is_lost).collect();
        check_geometric(&bursts_by_length(&good), to_bad);
    }
}

#[test]
fn a_chain_whose_states_lose_a_share_has_the_ratio_of_elliott() {
    let law = GilbertElliott {
        to_bad: 0.02,
        to_good: 0.2,
        bad_loss_ratio: 0.6,
        good_loss_ratio: 0.01,
    };
    let promised = (0.02 * 0.6 + 0.2 * 0.01) / 0.22;
    assert!((law.loss_ratio() - promised).abs() < 1e-15);
    let found = lost_ratio(&fates(LossLaw::GilbertElliott(law), 3, Duration::ZERO));
    // Variance: that of the fates and that of the states they depend on.
    let (bad, memory) = (law.bad_ratio(), 1.0 - 0.22);
    let by_state = 0.59 * share_error(bad, memory, COUNT);
    let by_fate = share_error(promised, 0.0, COUNT);
    let errors = (found - promised) / by_state.hypot(by_fate);
    assert!(errors.abs() < ERRORS_MAX, "{found}, promised {promised}");
}

const BURSTS: Bursts = Bursts {
    good_mean: Duration::from_millis(90),
    bad_mean: Duration::from_millis(10),
    bad_loss_ratio: 1.0,
    good_loss_ratio: 0.0,
};

#[test]
fn bursts_in_time_have_their_ratio_and_forget_as_they_promise() {
    let period = Duration::from_millis(2);
    let fates = fates(LossLaw::Bursts(BURSTS), 4, period);
    let bad = BURSTS.bad_ratio();
    let memory = |steps: f64| (-steps * 2e-3 * (1.0 / 90e-3 + 1.0 / 10e-3)).exp();
    let errors = (lost_ratio(&fates) - bad) / share_error(bad, memory(1.0), COUNT);
    assert!(
        (bad - 0.1).abs() < 1e-12 && errors.abs() < ERRORS_MAX,
        "{errors}"
    );
    for steps in [1, 2, 5, 10] {
        let pairs = fates.iter().zip(&fates[steps..]);
        let both = pairs.filter(|(one, other)| **one && **other).count() as f64;
        let share = both / (COUNT - steps) as f64;
        let promised = bad * bad + bad * (1.0 - bad) * memory(steps as f64);
        // Pairs overlap: their memory reaches further by so many steps.
        let error = share_error(promised, memory(1.0), COUNT) * (steps as f64).sqrt();
        assert!(
            (share - promised).abs() < ERRORS_MAX * error,
            "{steps} steps apart: {share}, promised {promised}"
        );
    }
}

#[test]
fn channels_of_all_rates_and_both_ways_meet_the_same_bursts() {
    let mut fast = process(LossLaw::Bursts(BURSTS), 5, "fast");
    let mut slow = process(LossLaw::Bursts(BURSTS), 5, "slow");
    let mut lost_count = 0;
    for step in 0..1_000_000_i64 {
        let now = Instant::from_ns(step * 500_000);
        let is_lost = fast.is_lost(now);
        if step % 17 == 0 {
            assert_eq!(slow.is_lost(now), is_lost);
        }
        lost_count += u32::from(is_lost);
    }
    assert!(lost_count > 50_000, "{lost_count}");
}

#[test]
fn equal_seeds_lose_the_same_messages_and_neighbouring_ones_others() {
    let chain = LossLaw::GilbertElliott(GilbertElliott {
        to_bad: 0.02,
        to_good: 0.2,
        bad_loss_ratio: 0.9,
        good_loss_ratio: 0.01,
    });
    for law in [LossLaw::bernoulli(0.1), chain, LossLaw::Bursts(BURSTS)] {
        let of = |seed| fates(law, seed, Duration::from_millis(1));
        assert_eq!(of(6), of(6));
        assert_ne!(of(6), of(7));
    }
}

#[test]
fn numbers_outside_their_range_are_refused_by_name() {
    let chain = |to_bad, to_good, bad_loss_ratio, good_loss_ratio| {
        LossLaw::GilbertElliott(GilbertElliott {
            to_bad,
            to_good,
            bad_loss_ratio,
            good_loss_ratio,
        })
    };
    let bursts = |good_ms, bad_ms, bad_loss_ratio| {
        LossLaw::Bursts(Bursts {
            good_mean: Duration::from_millis(good_ms),
            bad_mean: Duration::from_millis(bad_ms),
            bad_loss_ratio,
            good_loss_ratio: 0.0,
        })
    };
    for (law, key) in [
        (LossLaw::bernoulli(1.1), "ratio"),
        (chain(0.0, 0.5, 1.0, 0.0), "to_bad"),
        (chain(0.5, f64::NAN, 1.0, 0.0), "to_good"),
        (chain(0.5, 0.5, 1.5, 0.0), "bad_loss_ratio"),
        (chain(0.5, 0.5, 1.0, -0.1), "good_loss_ratio"),
        (bursts(0, 10, 1.0), "good_mean"),
        (bursts(10, 3_600_001, 1.0), "bad_mean"),
        (bursts(10, 10, 2.0), "bad_loss_ratio"),
    ] {
        assert_eq!(law.check().unwrap_err().key, key, "{law:?}");
    }
}

#[test]
fn each_law_stands_in_the_table_of_the_documentation_with_all_its_keys() {
    let page = include_str!("../../../../docs/link-models.md");
    for name in LossLaw::NAMES {
        let mut law = LossLaw::named(name).unwrap();
        assert_eq!(law.name(), *name);
        let row = page
            .lines()
            .find(|line| line.starts_with(&format!("| `{name}` |")));
        let row = row.unwrap_or_else(|| panic!("{name} has no row"));
        for field in law.fields() {
            let key = field.key;
            assert!(row.contains(&format!("`{key}`")), "{name}: {key} in {row}");
            assert!(
                field.is_required || field.check().is_ok(),
                "{name}: default of {key}"
            );
        }
    }
}
