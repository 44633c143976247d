//! Loss laws fitted to a trace: independent losses, bursts counted in messages (Gilbert, and
//! Gilbert and Elliott), and outages counted in time.

use std::borrow::Cow;

use super::chain::Chain;
use super::goodness::burst_test;
use super::{Fit, REFUSED_BELOW, Ranking, duration_text};
use crate::{Trace, TraceFate};
use hil_link::loss::{GilbertElliott, LossLaw};
use hil_link::outages::Outages;
use hil_link::spec::LinkSpec;

/// Most messages the ascent to the law of Gilbert and Elliott looks at; every other law, and every
/// likelihood, is of all of them.
pub(super) const ASCENT_MAX: usize = 200_000;
/// Stretches of successive messages that these are, spread evenly over the trace.
const STRETCHES: usize = 20;
/// Fewest losses for laws of bursts.
const LOSSES_MIN: usize = 10;
const HOUR_S: f64 = 3600.0;

/// All laws of loss for `losses`, the messages of known fate of `trace`.
pub(super) fn rank(trace: &Trace, losses: &[bool]) -> Ranking {
    if losses.is_empty() {
        return Ranking::none("no message has a known fate");
    }
    let lost_count = losses.iter().filter(|is_lost| **is_lost).count();
    let mut fits = vec![bernoulli(losses, lost_count)];
    if lost_count == 0 || lost_count == losses.len() {
        let why = "all messages met the same: there is nothing to tell laws apart by";
        return Ranking {
            fits,
            best: Some(0),
            why: why.to_owned(),
        };
    }
    let mut left_out = Vec::new();
    if lost_count >= LOSSES_MIN {
        let gilbert = gilbert_chain(losses);
        let others = [
            gilbert_fit(losses, gilbert),
            elliott_fit(losses, gilbert),
            outages_fit(trace, losses, gilbert),
        ];
        for fit in others {
            match fit {
                Ok(fit) => fits.push(fit),
                Err(why) => left_out.push(why),
            }
        }
    }
    Ranking::sort(&mut fits);
    let accepted = fits.iter().position(Fit::is_accepted);
    let why = match accepted {
        Some(_) => format!(
            "smallest AIC among those whose burst lengths have a probability of {REFUSED_BELOW} \
             or more, or are too few to test"
        ),
        None => format!(
            "smallest AIC; the burst lengths refuse every law (probability below {REFUSED_BELOW}): \
             replay the trace itself where they matter"
        ),
    };
    Ranking::of(fits, Some(accepted.unwrap_or(0)), why, &left_out)
}

fn bernoulli(losses: &[bool], lost_count: usize) -> Fit {
    let ratio = lost_count as f64 / losses.len() as f64;
    let chain = Chain::independent(ratio);
    let mut fit = Fit::new(
        "bernoulli",
        "share of the messages lost",
        1,
        Some(chain.log_likelihood(losses)),
    );
    fit.parameters = format!("ratio {ratio:.6}");
    // The ratio comes from all messages; the lengths of the bursts had next to no share in it.
    fit.bursts = burst_test(losses, &chain, 0);
    fit.toml = format!("loss_ratio = {ratio:?}\n");
    fit
}

/// The two-state chain that loses everything in one state and nothing in the other: counting its
/// steps is its estimate of largest likelihood.
fn gilbert_chain(losses: &[bool]) -> Chain {
    let mut steps = [[0.0_f64; 2]; 2];
    for pair in losses.windows(2) {
        steps[usize::from(pair[0])][usize::from(pair[1])] += 1.0;
    }
    let share =
        |from: usize, to: usize| steps[from][to] / (steps[from][0] + steps[from][1]).max(1.0);
    Chain {
        to_bad: share(0, 1),
        to_good: share(1, 0),
        loss: [0.0, 1.0],
    }
}

fn chain_fit(
    law: &str,
    method: &str,
    losses: &[bool],
    chain: Chain,
    parameter_count: usize,
    fitted_to_bursts_count: usize,
) -> Result<Fit, String> {
    if chain.to_bad <= 0.0 || chain.to_good <= 0.0 {
        return Err(format!(
            "{law}, as the trace never goes back from one state"
        ));
    }
    let spec = LinkSpec {
        loss: LossLaw::GilbertElliott(GilbertElliott {
            to_bad: chain.to_bad,
            to_good: chain.to_good,
            good_loss_ratio: chain.loss[0],
            bad_loss_ratio: chain.loss[1],
        }),
        ..LinkSpec::default()
    };
    spec.check().map_err(|why| format!("{law}: {why}"))?;
    let mut fit = Fit::new(
        law,
        method,
        parameter_count,
        Some(chain.log_likelihood(losses)),
    );
    fit.bursts = burst_test(losses, &chain, fitted_to_bursts_count);
    let [good, bad] = chain.loss;
    fit.parameters = format!(
        "to bad {:.6}, to good {:.6}, lost in good {good:.6}, in bad {bad:.6}",
        chain.to_bad, chain.to_good
    );
    fit.toml = format!(
        "\n[links.LINK.loss]\nlaw = \"gilbert-elliott\"\nto_bad = {:?}\nto_good = {:?}\n\
         good_loss_ratio = {good:?}\nbad_loss_ratio = {bad:?}\n",
        chain.to_bad, chain.to_good
    );
    Ok(fit)
}

fn gilbert_fit(losses: &[bool], chain: Chain) -> Result<Fit, String> {
    let method = "shares of the steps between loss and delivery (largest likelihood)";
    chain_fit("gilbert", method, losses, chain, 2, 1)
}

/// Stretches of `losses` one after another; all of them when they are few. The joints are steps that
/// never were, one in [`ASCENT_MAX`] / [`STRETCHES`].
fn stretches(losses: &[bool]) -> Cow<'_, [bool]> {
    if losses.len() <= ASCENT_MAX {
        return Cow::Borrowed(losses);
    }
    let length = ASCENT_MAX / STRETCHES;
    let free = losses.len() - length;
    let begins = (0..STRETCHES).map(|stretch| free / (STRETCHES - 1) * stretch);
    let parts = begins.flat_map(|begin| &losses[begin..begin + length]);
    Cow::Owned(parts.copied().collect())
}

/// From several beginnings, as an ascent finds the next hill only.
fn elliott_fit(all: &[bool], gilbert: Chain) -> Result<Fit, String> {
    let stretches = stretches(all);
    let losses: &[bool] = &stretches;
    let lost_count = losses.iter().filter(|is_lost| **is_lost).count();
    if lost_count < LOSSES_MIN {
        return Err(format!(
            "gilbert-elliott, as {lost_count} of the {} messages looked at were lost",
            losses.len()
        ));
    }
    let ratio = losses.iter().filter(|is_lost| **is_lost).count() as f64 / losses.len() as f64;
    let begun = |to_bad: f64, to_good: f64, loss| Chain {
        to_bad: to_bad.clamp(1e-6, 0.5),
        to_good: to_good.clamp(1e-6, 0.9),
        loss,
    };
    let begins = [
        begun(gilbert.to_bad, gilbert.to_good, [0.1 * ratio, 0.95]),
        begun(
            0.1 * gilbert.to_bad,
            0.2 * gilbert.to_good,
            [0.5 * ratio, 0.8],
        ),
        begun(0.01, 0.1, [0.5 * ratio, (2.0 * ratio).min(0.9)]),
        begun(0.001, 0.02, [0.8 * ratio, (5.0 * ratio).min(0.9)]),
    ];
    let found = begins.into_iter().map(|begin| begin.improved(losses));
    let best = found.reduce(|a, b| if b.1 > a.1 { b } else { a });
    let chain = best.map_or(gilbert, |(chain, _)| chain.good_first());
    let method = "expectation and maximisation (Baum and Welch), best of 4 beginnings";
    chain_fit("gilbert-elliott", method, all, chain, 4, 2)
}

/// A link that fails and recovers in continuous time, asked at the times of publication: the
/// Gilbert chain at the middle period gives its rates, the likelihood takes the real times.
fn outages_fit(trace: &Trace, losses: &[bool], gilbert: Chain) -> Result<Fit, String> {
    let period_s = trace.period_ns().unwrap_or(0) as f64 * 1e-9;
    let kept = 1.0 - gilbert.to_bad - gilbert.to_good;
    if period_s <= 0.0 || kept <= 0.0 {
        return Err("outages, as losses have no memory in time".to_owned());
    }
    if gilbert.to_bad <= 0.0 || gilbert.to_good <= 0.0 {
        return Err("outages, as the trace never goes back from one state".to_owned());
    }
    // What two states at rates a and b are after a time T: a/(a+b) (1 - exp(-(a+b) T)).
    let both = -kept.ln() / period_s;
    let sum = gilbert.to_bad + gilbert.to_good;
    let (fails, recovers) = (both * gilbert.to_bad / sum, both * gilbert.to_good / sum);
    let mean_s = 1.0 / recovers;
    let per_hour = HOUR_S / (1.0 / fails + mean_s);
    let spec = LinkSpec {
        outages: Outages {
            mean_s,
            per_hour,
            buffered: false,
        },
        ..LinkSpec::default()
    };
    spec.check().map_err(|why| format!("outages: {why}"))?;
    let known = trace.records.iter();
    let known = known.filter(|record| record.fate != TraceFate::Unknown);
    let times: Vec<i64> = known.map(|record| record.published_ns).collect();
    let bad_share = fails / (fails + recovers);
    let mut log_likelihood = if losses[0] {
        bad_share
    } else {
        1.0 - bad_share
    }
    .ln();
    for (index, pair) in losses.windows(2).enumerate() {
        let gap_s = times[index + 1].saturating_sub(times[index]) as f64 * 1e-9;
        let changed = 1.0 - (-both * gap_s).exp();
        let (from_good, from_bad) = (bad_share * changed, (1.0 - bad_share) * changed);
        let probability = match (pair[0], pair[1]) {
            (false, true) => from_good,
            (false, false) => 1.0 - from_good,
            (true, false) => from_bad,
            (true, true) => 1.0 - from_bad,
        };
        log_likelihood += probability.max(f64::MIN_POSITIVE).ln();
    }
    let method = "rates from the steps between loss and delivery at the middle period";
    let mut fit = Fit::new("outages", method, 2, Some(log_likelihood));
    fit.parameters = format!("{:.3} ms on average, {per_hour:.2} per hour", mean_s * 1e3);
    fit.bursts = burst_test(losses, &gilbert, 1);
    fit.toml = format!(
        "\n[links.LINK.outages]   # on all channels of the link, both ways at once\nmean = {}\n\
         per_hour = {per_hour:?}\n",
        duration_text(mean_s)
    );
    Ok(fit)
}
