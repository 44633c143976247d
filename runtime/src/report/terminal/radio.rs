//! What a report says of radios. It returns nothing on a wired run whose drivers stamp departures.

use hil_models::measure::radio::{RadioFigures, Share, TransmitStampFigures};

use super::canvas::{Canvas, Tone};
use super::units::{grouped, percent};
use crate::report::radio::{ChannelRadio, RadioHopSummary, RadioReport, Spread, StationSummary};

/// Beside a channel's account: where it was stamped, and what the radio reported.
pub(super) fn channel(canvas: &mut Canvas, radio: Option<&ChannelRadio>) {
    let Some(radio) = radio else { return };
    if let Some(text) = radio.transmit_stamps.as_ref().and_then(stamp_words) {
        canvas.field("TX stamp", Tone::Caution, &text);
    }
    if let Some(figures) = &radio.acknowledgements {
        acknowledgements(canvas, figures);
    }
}

/// Where stamps were taken, unless all are departures.
fn stamp_words(figures: &TransmitStampFigures) -> Option<String> {
    let of = |count: u64| format!("{} of {}", grouped(count), grouped(figures.handed_count));
    let mut words = Vec::new();
    if figures.before_queue_count > 0 {
        words.push(format!(
            "before the queue for {} messages: this driver stamps no departures, so \"TX stamp → \
             RX stamp\" holds what they waited in the queue and the driver",
            of(figures.before_queue_count)
        ));
    }
    if figures.application_count > 0 && figures.departure_count < figures.handed_count {
        words.push(format!(
            "none for {}: the gateway's own, before the send call, stands in",
            of(figures.application_count)
        ));
    }
    (!words.is_empty()).then(|| words.join("; "))
}

fn acknowledgements(canvas: &mut Canvas, figures: &RadioFigures) {
    let n = |count: u64| grouped(count);
    let text = if figures.is_arrival_unknown {
        format!(
            "{} acknowledged, {} not, {} without a report; what arrived is not known: no records \
             of the receiving gateway",
            n(figures.acknowledged_unknown_count),
            n(figures.unacknowledged_unknown_count),
            n(figures.unreported_unknown_count)
        )
    } else {
        format!(
            "{} acknowledged and arrived, {} acknowledged and lost above the radio, {} not \
             acknowledged and arrived (acknowledgement lost), {} not acknowledged and lost, {} \
             without a report ({} of them lost)",
            n(figures.acknowledged_arrived_count),
            n(figures.acknowledged_lost_count),
            n(figures.unacknowledged_arrived_count),
            n(figures.unacknowledged_lost_count),
            n(figures.unreported_arrived_count + figures.unreported_lost_count),
            n(figures.unreported_lost_count)
        )
    };
    canvas.field("radio", Tone::Plain, &text);
    let mut words = Vec::new();
    if let Some(share) = &figures.unacknowledged_ratio {
        words.push(format!("not acknowledged {}", share_words(share)));
    }
    if let Some(share) = &figures.known_loss_ratio {
        words.push(format!(
            "of the losses the radio knows {}",
            share_words(share)
        ));
    }
    if !words.is_empty() {
        canvas.field("", Tone::Faint, &words.join("; "));
    }
}

fn share_words(share: &Share) -> String {
    format!(
        "{} (95 % {} to {}, {} of {})",
        percent(share.ratio),
        percent(share.low),
        percent(share.high),
        grouped(share.success_count),
        grouped(share.trial_count)
    )
}

/// The associations of the run.
pub(super) fn hops(canvas: &mut Canvas, report: &RadioReport) {
    if report.hops.is_empty() {
        return;
    }
    canvas.heading("Radio", "the association, sampled beside the data");
    for hop in &report.hops {
        hop_lines(canvas, hop);
    }
}

fn hop_lines(canvas: &mut Canvas, hop: &RadioHopSummary) {
    let events = match hop.event_count {
        0 => "the association did not change".to_owned(),
        count => format!(
            "the association changed {} times, see events",
            grouped(count)
        ),
    };
    let text = format!(
        "{} on {} ({}): {events}",
        hop.interface, hop.host, hop.process
    );
    canvas.field("radio", Tone::Plain, &text);
    for station in &hop.stations {
        canvas.field("", Tone::Faint, &station_words(station));
    }
}

fn station_words(station: &StationSummary) -> String {
    let spread = |name: &str, spread: &Option<Spread>, unit: &str| {
        let words = spread.map_or_else(
            || "unavailable".to_owned(),
            |s| format!("{} {unit} ({} to {})", s.median, s.min, s.max),
        );
        format!("{name} {words}")
    };
    let count = |name: &str, count: Option<u64>| {
        let words = count.map_or_else(|| "unavailable".to_owned(), grouped);
        format!("{name} {words}")
    };
    let how = |modulation: &Option<String>| {
        let words = modulation.as_ref().map(|text| format!(", {text}"));
        words.unwrap_or_default()
    };
    [
        format!(
            "{} in {} samples",
            station.mac,
            grouped(station.sample_count)
        ),
        spread("signal", &station.signal_dbm, "dBm"),
        spread("sends at", &station.transmit_mbps, "Mbit/s") + &how(&station.transmit_modulation),
        spread("hears at", &station.receive_mbps, "Mbit/s") + &how(&station.receive_modulation),
        count("packets sent", station.tx_packet_count),
        count("retries", station.tx_retry_count),
        count("given up", station.tx_failed_count),
        count("beacon losses", station.beacon_loss_count),
        count("longest silence, ms", station.inactive_ms_max),
    ]
    .join(" · ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wired_channel_stamped_at_departure_needs_no_line() {
        let figures = TransmitStampFigures {
            handed_count: 9,
            departure_count: 9,
            ..TransmitStampFigures::default()
        };
        assert_eq!(stamp_words(&figures), None);
        let fallback = TransmitStampFigures {
            handed_count: 9,
            before_queue_count: 8,
            application_count: 1,
            ..TransmitStampFigures::default()
        };
        let words = stamp_words(&fallback).unwrap();
        assert!(words.contains("before the queue for 8 of 9"), "{words}");
        assert!(words.contains("none for 1 of 9"), "{words}");
    }
}
