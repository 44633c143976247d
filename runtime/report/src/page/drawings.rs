//! Which figures a run and its channels get, with the words below them.

use super::charts::bursts::loss_bursts;
use super::charts::cdf::{Curve, delay_cdf};
use super::charts::histogram::delay_histogram;
use super::charts::waterfall::{Bar, waterfall};
use crate::sections::Sources;
use hil_account::ChannelAccount;
use hil_core::plot::name_part;
use hil_platform::text::grouped;
use hil_present::Drawing;

/// The figures of one channel.
pub(super) fn of_channel(key: &str, channel: &str, sources: &Sources<'_>) -> Vec<Drawing> {
    let mut drawings = Vec::new();
    let mut push = |kind: &str, title: &str, caption: &str, svg: Option<String>| {
        if let Some(svg) = svg {
            drawings.push(Drawing {
                name: format!("{key}-{kind}-{}", name_part(channel)),
                title: title.to_owned(),
                caption: caption.to_owned(),
                svg,
                is_wide: false,
            });
        }
    };
    let curves = curves(sources);
    let of = |title: &str| format!("{title}, {channel}");
    let caption = "Share of messages that took at most so long, in steps of nines: the same height for the \
                   slowest tenth as for the slowest hundredth of it.";
    push(
        "delay-cdf",
        "How long it took",
        caption,
        delay_cdf(&of("Distribution of delays"), &curves),
    );
    let (bins, what) = match (sources.account, sources.network) {
        (Some(account), _) if !account.end_to_end.bins.is_empty() => {
            (account.end_to_end.bins.as_slice(), "published to taken")
        }
        (_, Some(network)) => (network.delay_bins.as_slice(), "network, one way"),
        _ => (&[][..], ""),
    };
    let below = bins
        .iter()
        .filter(|bin| bin.until_ns <= 0)
        .map(|bin| bin.count)
        .sum::<u64>();
    let mut caption = format!("Histogram, {what}; 20 bins to a decade, every message counted.");
    if below > 0 {
        let below = grouped(below);
        caption.push_str(&[" ", &below, " at or below zero have no place on this axis."].concat());
    }
    let svg = delay_histogram(&of("Histogram of delays"), bins);
    push(
        "delay-histogram",
        "How often it took so long",
        &caption,
        svg,
    );
    let by_network = sources.network.and_then(|network| network.loss.measured());
    let runs = by_network.map(|loss| loss.runs.as_slice());
    let runs = runs.or_else(|| {
        sources
            .account
            .map(|account| account.loss_bursts.as_slice())
    });
    let svg = loss_bursts(&of("Losses in a row"), runs.unwrap_or_default());
    push(
        "loss-bursts",
        "Losses in a row",
        "From five on, bars hold lengths up to a power of two.",
        svg,
    );
    drawings
}

fn curves<'a>(sources: &Sources<'a>) -> Vec<Curve<'a>> {
    let mut curves = Vec::new();
    if let Some(account) = sources.account {
        let chain = account
            .segments
            .iter()
            .filter(|segment| !segment.is_combined);
        for segment in chain {
            if segment.distribution.measured().is_some() {
                curves.push(Curve {
                    label: segment.name(),
                    bins: &segment.bins,
                    is_whole: false,
                });
            }
        }
        // On a direct channel the only segment is the whole.
        if account.end_to_end.distribution.measured().is_some() {
            if curves.len() == 1 {
                curves.clear();
            }
            curves.push(Curve {
                label: "published → taken".to_owned(),
                bins: &account.end_to_end.bins,
                is_whole: true,
            });
        }
    }
    if let Some(network) = sources.network.filter(|_| sources.account.is_none())
        && !network.delay_bins.is_empty()
    {
        curves.push(Curve {
            label: "network, one way".to_owned(),
            bins: &network.delay_bins,
            is_whole: true,
        });
    }
    curves
}

/// Where the time went on all channels.
pub(super) fn of_accounts<'a>(
    key: &str,
    accounts: impl Iterator<Item = (&'a str, &'a ChannelAccount)>,
) -> Option<Drawing> {
    let bars: Vec<Bar> = accounts.map(|(name, account)| bar(name, account)).collect();
    let title = "Where each microsecond went";
    Some(Drawing {
        name: format!("{key}-waterfall"),
        title: title.to_owned(),
        caption: "Medians of the segments that were measured, each channel to its own scale. Medians \
                  need not add up to the median of the whole; segment by segment, message by message, \
                  the account does (see the channels)."
            .to_owned(),
        svg: waterfall(title, &bars)?,
        is_wide: true,
    })
}

/// The chain of a channel for the waterfall.
fn bar(channel: &str, account: &ChannelAccount) -> Bar {
    let parts = account
        .segments
        .iter()
        .filter(|segment| !segment.is_combined);
    let parts = parts.filter_map(|segment| {
        let summary = segment.distribution.measured()?;
        Some((segment.name(), summary.p50_ns))
    });
    let whole = account.end_to_end.distribution.measured();
    Bar {
        channel: channel.to_owned(),
        parts: parts.collect(),
        whole_ns: whole.map(|one| one.p50_ns),
    }
}
