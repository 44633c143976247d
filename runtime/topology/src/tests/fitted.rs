//! What `trace fit` writes is what a topology reads: every law that a trace is fitted with, with the
//! numbers it was fitted with.

use hil_core::random::RandomStream;
use hil_link::delay::DelayLaw;
use hil_trace::fit::{Fit, TraceFit};
use hil_trace::{Trace, TraceDirection, TraceFate, TraceHeader, TraceRecord};

use super::faulty::GOOD;
use super::*;

const PERIOD_NS: i64 = 10_000_000;

/// A trace of `losses` and of delays in nanoseconds.
fn trace(
    mut is_lost: impl FnMut(u64) -> bool,
    mut delay_ns: impl FnMut(&mut RandomStream) -> f64,
) -> Trace {
    let mut random = RandomStream::new(5, "fitted");
    let mut record = |index: u64| {
        let published_ns = i64::try_from(index).unwrap() * PERIOD_NS;
        let record = TraceRecord::published(published_ns, index, 16);
        #[allow(clippy::cast_possible_truncation, reason = "delays below a minute")]
        let delay_ns = delay_ns(&mut random) as i64;
        if is_lost(index) {
            TraceRecord {
                fate: TraceFate::LostInNetwork,
                ..record
            }
        } else {
            record.delivered(delay_ns, 0)
        }
    };
    Trace {
        header: TraceHeader::new("arm/command"),
        records: (0..600).map(&mut record).collect(),
    }
}

/// The topology of `link`, which stands for `[links.hop]` and its tables.
fn with_link(link: &str) -> Topology {
    let start = GOOD.split("[links.hop]").next().unwrap();
    let text = format!("{start}{link}");
    parse("fitted.toml", &text, &[], &known()).unwrap_or_else(|errors| panic!("{errors}\n{text}"))
}

/// The numbers of the words or lines of a fit, as far as they are printed.
fn check(fit: &Fit, trace: &Trace) {
    let link = format!(
        "[links.hop]\nvia = \"emulated\"\n{}",
        fit.toml.replace("LINK", "hop")
    );
    let topology = with_link(&link);
    let emulation = topology.links()[0].emulation().unwrap();
    let spec = &emulation.forward;
    assert_eq!(spec, &emulation.backward);
    spec.check().unwrap_or_else(|why| panic!("{why}: {link}"));
    // Written out and read again it is the same.
    assert_eq!(
        parse("again.toml", &topology.to_toml(), &[], &known()).unwrap(),
        topology
    );
    if spec.delay == DelayLaw::default() {
        return;
    }
    let delays = trace.delays_ns();
    let mean_s = delays
        .iter()
        .map(|ns| (*ns).max(0) as f64 * 1e-9)
        .sum::<f64>()
        / delays.len() as f64;
    // Laws that do not fit have other means; the one that does is near.
    if fit.is_accepted() && fit.ks_probability.is_some() {
        let found_s = spec.delay.mean_s();
        assert!(
            (found_s / mean_s - 1.0).abs() < 0.1,
            "{found_s} of {mean_s}: {link}"
        );
    }
}

#[test]
fn every_fit_of_a_trace_is_a_valid_link() {
    let exponential = |random: &mut RandomStream| -(1.0 - random.uniform()).ln();
    let bursts = |index: u64| index % 50 > 40;
    let single = |index: u64| index % 11 == 3;
    let traces = [
        trace(bursts, |random| 5e6 + 1e6 * random.normal()),
        trace(single, |random| 2e6 + 3e6 * exponential(random)),
        // Below zero, as clocks within their bound allow.
        trace(bursts, |random| 20_000.0 * random.normal()),
        // A few nanoseconds, all of them alike, and as long as a link may be.
        trace(single, |random| (5.0 * random.uniform()).floor()),
        trace(bursts, |_| 5e6),
        trace(single, |_| 0.0),
        trace(|_| false, |random| 9e9 + 0.99e9 * random.uniform()),
        trace(|_| true, |_| 0.0),
        trace(single, |random| (2.0 + 3.0 * random.normal()).exp() * 1e3),
    ];
    let mut checked_count = 0;
    for trace in &traces {
        let fit = TraceFit::of(trace, 1);
        for one in fit.loss.fits.iter().chain(&fit.delay.fits) {
            check(one, trace);
            checked_count += 1;
        }
        // The best of both together, as the command prints them.
        let topology = with_link(&fit.toml("hop"));
        let spec = &topology.links()[0].emulation().unwrap().forward;
        spec.check().unwrap();
        let lost_ratio = trace.counts().lost_count() as f64 / 600.0;
        let is_outages = spec.outages.is_active();
        let found_ratio = spec.loss.loss_ratio();
        assert!(
            is_outages || (found_ratio - lost_ratio).abs() < 0.05,
            "{}",
            fit.toml("hop")
        );
        assert_eq!(fit.delay.best.is_some(), !trace.delays_ns().is_empty());
        // And as one direction of a link that stands already.
        let backward = fit.toml_of_direction("hop", TraceDirection::Backward);
        let topology = with_link(&format!("[links.hop]\nvia = \"emulated\"\n{backward}"));
        assert_eq!(&topology.links()[0].emulation().unwrap().backward, spec);
    }
    assert!(checked_count > 60, "{checked_count}");
}
