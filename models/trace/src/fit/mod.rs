//! Link models fitted to a trace, ranked, each with its goodness of fit and the lines of
//! `[links.<name>]` that mean it. It says which it would take and by which rule; the choice is the
//! reader's.

mod chain;
mod delay;
mod goodness;
mod loss;

use serde::{Deserialize, Serialize};

use super::metrics::{TraceMetrics, known_losses};
use super::{Trace, TraceDirection};
use hil_stats::goodness::ChiSquare;
use hil_stats::histogram::Distribution;

/// Below this probability of its own data a model is not taken.
pub const REFUSED_BELOW: f64 = 0.05;

/// Delays so near their middle, relative to it, may be those of a fixed delay on busy hosts.
const NEARLY_FIXED: f64 = 0.05;

/// One model of one property.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fit {
    /// Its name.
    pub law: String,
    /// How its parameters were found.
    pub method: String,
    /// Its parameters, in words.
    pub parameters: String,
    /// Numbers it has.
    pub parameter_count: usize,
    /// Natural logarithm of the likelihood of the trace; `None` for a law without a density.
    pub log_likelihood: Option<f64>,
    /// Akaike's criterion, 2 k - 2 ln L: smaller is better.
    pub aic: Option<f64>,
    /// Loss: burst lengths against those of the model.
    pub bursts: Option<ChiSquare>,
    /// Delay: largest difference of the two distribution functions (Kolmogorov and Smirnov).
    pub ks_distance: Option<f64>,
    /// Delay: its probability under the model, by a parametric bootstrap.
    pub ks_probability: Option<f64>,
    /// What to write into `[links.<name>]`.
    pub toml: String,
    /// A fixed delay from which few delays differ by much.
    #[serde(default)]
    pub is_nearly_fixed: bool,
}

impl Fit {
    fn new(law: &str, method: &str, parameter_count: usize, log_likelihood: Option<f64>) -> Self {
        Self {
            law: law.to_owned(),
            method: method.to_owned(),
            parameters: String::new(),
            parameter_count,
            log_likelihood,
            aic: log_likelihood.map(|ln| 2.0 * parameter_count as f64 - 2.0 * ln),
            bursts: None,
            ks_distance: None,
            ks_probability: None,
            toml: String::new(),
            is_nearly_fixed: false,
        }
    }

    /// True when nothing tested speaks against it.
    pub fn is_accepted(&self) -> bool {
        let bursts = self.bursts.as_ref().map(|test| test.probability);
        let tested = [bursts, self.ks_probability];
        tested.into_iter().flatten().all(|p| p >= REFUSED_BELOW)
    }
}

/// All models of one property, best first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ranking {
    /// By Akaike's criterion; laws without one come last.
    pub fits: Vec<Fit>,
    /// The place of the one that would be taken; `None` when there is nothing to fit.
    pub best: Option<usize>,
    /// By which rule, or why there is none.
    pub why: String,
}

impl Ranking {
    /// The rule, and which laws were left out, with the reason of each.
    fn of(fits: Vec<Fit>, best: Option<usize>, mut why: String, left_out: &[String]) -> Self {
        for reason in left_out {
            why.push_str("; left out: ");
            why.push_str(reason);
        }
        Self { fits, best, why }
    }

    fn none(why: &str) -> Self {
        Self {
            fits: Vec::new(),
            best: None,
            why: why.to_owned(),
        }
    }

    /// A remark with a fixed delay in place of a fitted distribution, where nearly all delays are
    /// within [`NEARLY_FIXED`] of their middle: that much may well be the hosts and not the link.
    fn fixed_instead(&self, table: &str) -> String {
        let fixed = self.fits.iter().enumerate().find_map(|(index, fit)| {
            let wanted = fit.is_nearly_fixed && self.best != Some(index);
            wanted.then_some(fit)
        });
        fixed.map_or_else(String::new, |fit| {
            let lines = fit.toml.replace("LINK", table);
            let lines = lines.lines().filter(|line| !line.is_empty());
            let lines: Vec<String> = lines.map(|line| format!("#   {line}")).collect();
            let lines = lines.join("\n");
            format!(
                "\n# 98 % of the delays are within {} % of their middle. If such a spread is the hosts' own:\n{lines}\n",
                NEARLY_FIXED * 100.0
            )
        })
    }

    fn sort(fits: &mut [Fit]) {
        fits.sort_by(|a, b| {
            let key = |fit: &Fit| fit.aic.unwrap_or(f64::INFINITY);
            key(a).total_cmp(&key(b))
        });
    }
}

/// What models fit a trace.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TraceFit {
    /// Of its losses.
    pub loss: Ranking,
    /// Of its delays.
    pub delay: Ranking,
    /// What no model of these keeps.
    pub remarks: Vec<String>,
    /// Messages of known fate that were used.
    pub loss_message_count: usize,
    /// Delays that were used for the test of distribution.
    pub tested_delay_count: usize,
    /// Largest error of any delay from the clocks, 0 on one clock, and so of the place of every law;
    /// `None` without delays, and when that of one of them is not known.
    pub delay_bound_ns: Option<u64>,
    /// Seed of the bootstrap.
    pub seed: u64,
}

impl TraceFit {
    /// Fits every law to `trace`; `seed` is that of the bootstrap.
    pub fn of(trace: &Trace, seed: u64) -> Self {
        let figures = TraceMetrics::of(trace);
        let losses = known_losses(trace);
        let measured = trace.delays_ns();
        let delays_s = measured.iter().map(|ns| (*ns).max(0) as f64 * 1e-9);
        let delays_s: Vec<f64> = delays_s.collect();
        let tested = delay::thinned(&delays_s);
        let mut remarks = Vec::new();
        let negative_count = measured.iter().filter(|ns| **ns < 0).count();
        if negative_count > 0 {
            remarks.push(format!(
                "{negative_count} of {} delays are below zero, as two clocks within their bound allow; \
                 the delay laws take them as zero, and so does a replay.",
                measured.len()
            ));
        }
        if let Some(memory) = &figures.delay_memory {
            let first = memory.coefficients.first().copied().unwrap_or(0.0);
            if first.abs() > memory.independent_within {
                remarks.push(format!(
                    "successive delays are correlated ({first:.2} at lag 1, independent ones stay \
                     within {:.2}); the delay laws draw each by itself. The trace keeps it.",
                    memory.independent_within
                ));
            }
        }
        remarks.extend(bound_remark(&figures));
        if let Distribution::Measured(late) = &figures.late_delay {
            remarks.push(format!(
                "{} messages arrived and were not published, the slowest after {:.3} ms; the delay \
                 laws leave them out.",
                late.count,
                late.max_ns as f64 * 1e-6
            ));
        }
        if figures.counts.lost_before_link_count + figures.counts.lost_after_link_count > 0 {
            remarks.push(format!(
                "{} messages were lost on the hosts, before or after the link; the loss laws count \
                 them as lost.",
                figures.counts.lost_before_link_count + figures.counts.lost_after_link_count
            ));
        }
        let order = figures.order.measured();
        let reordered_count = order.map_or(0, |order| order.reordered_count);
        if reordered_count + figures.counts.duplicated_count > 0 {
            remarks.push(format!(
                "{reordered_count} messages came after later ones and {} twice; no law here draws copies, and \
                 the order follows from the delays it draws. The trace keeps both.",
                figures.counts.duplicated_count
            ));
        }
        if losses.len() > loss::ASCENT_MAX {
            remarks.push(format!(
                "the law of Gilbert and Elliott was sought in {} of {} messages, in stretches spread \
                 over the run; its likelihood, and all of the other loss laws, is of all.",
                loss::ASCENT_MAX,
                losses.len()
            ));
        }
        Self {
            loss: loss::rank(trace, &losses),
            delay: delay::rank(&delays_s, &tested, seed),
            remarks,
            loss_message_count: losses.len(),
            tested_delay_count: tested.len(),
            delay_bound_ns: figures.bound_max_ns,
            seed,
        }
    }

    /// `[links.<name>]` with the best laws, for both directions.
    pub fn toml(&self, link: &str) -> String {
        self.toml_of(link, "via = \"emulated\"\n")
    }

    /// The same as `[links.<name>.<direction>]`, for a file in which `[links.<name>]` stands already;
    /// as [`TraceFit::toml`] where the direction is not known.
    pub fn toml_of_direction(&self, link: &str, direction: TraceDirection) -> String {
        match direction {
            TraceDirection::Unknown => self.toml(link),
            known => self.toml_of(&format!("{link}.{}", known.word()), ""),
        }
    }

    fn toml_of(&self, table: &str, via: &str) -> String {
        let best = |what: &str, ranking: &Ranking| {
            let fit = ranking.best.map(|index| &ranking.fits[index]);
            // What is missing is said: without its key a link loses nothing and takes no time.
            fit.map_or_else(
                || format!("# no {what}: {}\n", ranking.why),
                |fit| fit.toml.replace("LINK", table),
            )
        };
        let (loss, delay) = (best("loss", &self.loss), best("delay", &self.delay));
        let bound = match (self.tested_delay_count, self.delay_bound_ns) {
            (0, _) | (_, Some(0)) => String::new(),
            (_, Some(ns)) => format!(
                "# delays are known to +-{:.3} us, the error of the clocks' alignment\n",
                ns as f64 * 1e-3
            ),
            (_, None) => {
                "# how far the clocks may have led the delays astray is unknown\n".to_owned()
            }
        };
        format!(
            // A ratio of losses is a key of the link and no table: it goes before them.
            "{bound}[links.{table}]\n{via}{loss}{}{delay}",
            self.delay.fixed_instead(table)
        )
    }
}

/// How far the clocks may have led the delays astray, where that is more than nothing.
fn bound_remark(figures: &TraceMetrics) -> Option<String> {
    let delay = figures.delay.measured()?;
    let Some(bound_ns) = figures.bound_max_ns else {
        return Some(
            "how far the clocks may have led the delays astray is unknown, and so it is of the laws."
                .to_owned(),
        );
    };
    let wide = if i128::from(bound_ns) > i128::from(delay.p50_ns) {
        ", wider than their median: the laws say little of the link"
    } else {
        ""
    };
    (bound_ns > 0).then(|| {
        format!(
            "each delay is known to +-{:.3} us by the clocks' alignment{wide}; the place of a law \
             may be off by that much, and its width by twice that.",
            bound_ns as f64 * 1e-3
        )
    })
}

/// A time as a topology writes it, to the nanosecond.
fn duration_text(seconds: f64) -> String {
    let ns = (seconds.max(0.0) * 1e9).round();
    if ns >= 1e6 {
        format!("\"{} ms\"", ns / 1e6)
    } else if ns >= 1e3 {
        format!("\"{} us\"", ns / 1e3)
    } else {
        format!("\"{ns} ns\"")
    }
}

#[cfg(test)]
mod tests;
