//! The part of a report about network cards that stamp: the cards, their clocks, and what their
//! stamps add to the account of each channel.

use core::fmt::Write as _;

use hil_account::nic_clock::NicClockMetrics;
use hil_stats::histogram::Distribution;

use hil_present::units::{duration, percent, unsigned_duration};
use hil_present::{Section, Tone};

use crate::nic_metrics::{ChannelStamps, HardwareStamps, NicSegment, NicSummary};
use hil_platform::text::grouped;

pub(super) fn hardware_stamps(stamps: &HardwareStamps) -> Section {
    let mut section = Section::new(
        "hardware-stamps",
        "Hardware stamps",
        "taken by the network cards",
    );
    section.children.extend(stamps.cards.iter().map(nic));
    section.children.extend(stamps.channels.iter().map(channel));
    section
}

fn nic(card: &NicSummary) -> Section {
    let story = &card.story;
    let tone = if story.is_armed {
        Tone::Plain
    } else {
        Tone::Caution
    };
    let mut section = Section::new("nic", story.name(), "");
    section.fact("claims", Tone::Plain, &story.claims);
    section.fact("armed", tone, &story.arming);
    section.fact("before, after", Tone::Faint, &story.restoring);
    match &card.clock {
        Some(clock) => section.fact("card clock", Tone::Plain, clock_words(clock)),
        None => section.fact("card clock", Tone::Caution, "no pair of reads"),
    }
    section.fact("", Tone::Faint, &story.clock);
    if story.failed_read_count > 0 {
        let text = format!("{} reads of it failed", grouped(story.failed_read_count));
        section.fact("", Tone::Caution, text);
    }
    section
}

fn clock_words(clock: &NicClockMetrics) -> String {
    let mut text = format!(
        "{} against the system's, ±{} at the end; {} pairs, bound p50 {}, max {}",
        duration(clock.offset_ns),
        unsigned_duration(clock.offset_bound_ns),
        grouped(clock.pair_count),
        unsigned_duration(clock.bound_p50_ns),
        unsigned_duration(clock.bound_max_ns),
    );
    match clock.frequency {
        Some(frequency) => {
            let _infallible = write!(
                text,
                "; runs {:+.3} ppm ± {:.3} ppm fast",
                frequency.offset_ppb / 1e3,
                frequency.bound_ppb / 1e3
            );
        }
        None => text.push_str("; frequency unavailable: too short"),
    }
    if clock.step_count > 0 {
        let _infallible = write!(text, "; stepped {} times", grouped(clock.step_count));
    }
    text
}

fn share(count: u64, of: u64) -> String {
    if of == 0 {
        return "none of 0".to_owned();
    }
    let ratio = count as f64 / of as f64;
    format!("{} of {} ({})", grouped(count), grouped(of), percent(ratio))
}

fn channel(channel: &ChannelStamps) -> Section {
    let sent = share(channel.tx_hardware_count, channel.sent_count);
    let both = grouped(channel.tx_both_count);
    let mut section = Section::new("channel", &channel.channel, "");
    section.fact(
        "hardware TX",
        Tone::Plain,
        format!("{sent}, the software stamp beside it on {both}"),
    );
    let received = share(channel.rx_hardware_count, channel.received_count);
    let reason = if channel.rx_reason.is_empty() {
        String::new()
    } else {
        format!(": {}", channel.rx_reason)
    };
    section.fact("hardware RX", Tone::Plain, format!("{received}{reason}"));
    for segment in &channel.segments {
        let is_measured = segment.distribution.measured().is_some();
        let tone = if is_measured {
            Tone::Plain
        } else {
            Tone::Faint
        };
        section.fact("", tone, segment_words(segment));
    }
    section
}

fn segment_words(segment: &NicSegment) -> String {
    let mut text = match (segment.distribution.measured(), segment.bound.measured()) {
        (Some(time), Some(bound)) => {
            let mut text = format!(
                "{}: p50 {}, p99 {}, max {}, each within ±{} (p50; max ±{})",
                segment.name,
                duration(time.p50_ns),
                duration(time.p99_ns),
                duration(time.max_ns),
                duration(bound.p50_ns),
                duration(bound.max_ns),
            );
            if bound.p50_ns > time.p50_ns.saturating_abs() {
                text.push_str("; the bound is wider than the figure");
            }
            text
        }
        _ => match &segment.distribution {
            Distribution::Unavailable { reason } => {
                format!("{}: unavailable: {reason}", segment.name)
            }
            Distribution::Measured(_) => segment.name.clone(),
        },
    };
    if segment.unplaced_count > 0 {
        let count = grouped(segment.unplaced_count);
        let _infallible = write!(text, "; {count} stamps have no place on the host's clock");
    }
    text
}
