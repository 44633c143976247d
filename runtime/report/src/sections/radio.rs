//! What a report says of radios. It returns nothing on a wired run whose drivers stamp departures.

use hil_account::radio::{RadioMetrics, Share};
use hil_account::{Coverage, StampCoverage};

use hil_present::units::percent;
use hil_present::{Section, Tone};

use crate::radio::{ChannelRadio, RadioHopSummary, RadioReport, Spread, StationSummary};
use hil_platform::text::grouped;

/// Beside a channel's account: where it was stamped, and what the radio reported.
pub(super) fn channel(
    section: &mut Section,
    stamped: Option<&StampCoverage>,
    radio: Option<&ChannelRadio>,
) {
    if let Some(text) = stamped.and_then(stamp_words) {
        section.fact("TX stamp", Tone::Caution, text);
    }
    if let Some(figures) = radio.and_then(|one| one.acknowledgements.as_ref()) {
        acknowledgements(section, figures);
    }
}

/// Where stamps were taken, unless all are departures.
fn stamp_words(stamped: &StampCoverage) -> Option<String> {
    let Coverage {
        stamped_count,
        eligible_count,
    } = stamped.tx_software?;
    let of = |count: u64| format!("{} of {}", grouped(count), grouped(eligible_count));
    let mut words = Vec::new();
    if stamped.tx_before_queue_count > 0 {
        words.push(format!(
            "before the queue for {} messages: this driver stamps no departures, so \"TX stamp → \
             RX stamp\" holds what they waited in the queue and the driver",
            of(stamped.tx_before_queue_count)
        ));
    }
    if stamped_count < eligible_count {
        words.push(format!(
            "none for {}: the gateway's own, before the send call, stands in",
            of(eligible_count - stamped_count)
        ));
    }
    (!words.is_empty()).then(|| words.join("; "))
}

fn acknowledgements(section: &mut Section, figures: &RadioMetrics) {
    section.fact("radio", Tone::Plain, acknowledgement_words(figures));
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
        section.fact("", Tone::Faint, words.join("; "));
    }
}

/// What the radio said, and what became of the messages of which it said so.
fn acknowledgement_words(figures: &RadioMetrics) -> String {
    let n = grouped;
    let rows = [
        figures.acknowledged,
        figures.unacknowledged,
        figures.unreported,
    ];
    let [Some(heard), Some(unheard), Some(silent)] = rows.map(|row| row.fates) else {
        return format!(
            "{} acknowledged, {} not, {} without a report; what arrived is unavailable: no records \
             of the receiving gateway",
            n(figures.acknowledged.count),
            n(figures.unacknowledged.count),
            n(figures.unreported.count)
        );
    };
    let text = format!(
        "{} acknowledged and arrived, {} acknowledged and lost above the radio, {} not acknowledged \
         and arrived (acknowledgement lost), {} not acknowledged and lost, {} without a report ({} \
         of them lost)",
        n(heard.arrived_count),
        n(heard.lost_count),
        n(unheard.arrived_count),
        n(unheard.lost_count),
        n(figures.unreported.count),
        n(silent.lost_count)
    );
    let all = [heard, unheard, silent];
    let aside = [
        (
            all.iter().map(|one| one.interrupted_count).sum::<u64>(),
            "lost while a process was down",
        ),
        (
            all.iter().map(|one| one.in_flight_count).sum::<u64>(),
            "under way at the end",
        ),
    ];
    let aside = aside.into_iter().filter(|(count, _)| *count > 0);
    let aside: Vec<String> = aside
        .map(|(count, what)| format!("; {} {what}", n(count)))
        .collect();
    text + &aside.concat()
}

fn share_words(share: &Share) -> String {
    format!(
        "{} ({} of {})",
        percent(share.ratio),
        grouped(share.success_count),
        grouped(share.trial_count)
    )
}

/// The associations of the run.
pub(super) fn hops(report: &RadioReport) -> Section {
    let aside = "the association, sampled beside the data";
    let mut section = Section::new("radio", "Radio", aside);
    for hop in &report.hops {
        hop_lines(&mut section, hop);
    }
    section
}

fn hop_lines(section: &mut Section, hop: &RadioHopSummary) {
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
    section.fact("radio", Tone::Plain, text);
    for station in &hop.stations {
        section.fact("", Tone::Faint, station_words(station));
    }
}

fn station_words(station: &StationSummary) -> String {
    let spread = |name: &str, spread: &Option<Spread>, decimals: usize, unit: &str| {
        let words = spread.map_or_else(
            || "unavailable".to_owned(),
            |s| {
                let [median, min, max] =
                    [s.median, s.min, s.max].map(|value| format!("{value:.decimals$}"));
                format!("{median} {unit} ({min} to {max})")
            },
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
        spread("signal", &station.signal_dbm, 0, "dBm"),
        spread("sends at", &station.transmit_mbps, 1, "Mbit/s")
            + &how(&station.transmit_modulation),
        spread("hears at", &station.receive_mbps, 1, "Mbit/s") + &how(&station.receive_modulation),
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
    use hil_account::radio::{RadioFates, RadioRow};

    #[test]
    fn a_wired_channel_stamped_at_departure_needs_no_line() {
        let of = |stamped_count, tx_before_queue_count| StampCoverage {
            tx_software: Some(Coverage {
                stamped_count,
                eligible_count: 9,
            }),
            tx_before_queue_count,
            ..StampCoverage::default()
        };
        assert_eq!(stamp_words(&of(9, 0)), None);
        let words = stamp_words(&of(8, 8)).unwrap();
        assert!(words.contains("before the queue for 8 of 9"), "{words}");
        assert!(words.contains("none for 1 of 9"), "{words}");
    }

    #[test]
    fn messages_that_no_radio_lost_are_told_apart_and_unknown_ones_are_not_zero() {
        let row = |count, interrupted_count, in_flight_count| RadioRow {
            count,
            fates: Some(RadioFates {
                arrived_count: count - interrupted_count - in_flight_count,
                lost_count: 0,
                interrupted_count,
                in_flight_count,
            }),
        };
        let mut figures = RadioMetrics {
            handed_count: 17,
            acknowledged: row(10, 0, 0),
            unacknowledged: row(7, 4, 2),
            unreported: row(0, 0, 0),
            unacknowledged_ratio: None,
            known_loss_ratio: None,
            lost_ratio: None,
        };
        let words = acknowledgement_words(&figures);
        assert!(words.contains("0 not acknowledged and lost"), "{words}");
        let aside = "; 4 lost while a process was down; 2 under way at the end";
        assert!(words.ends_with(aside), "{words}");
        for row in [
            &mut figures.acknowledged,
            &mut figures.unacknowledged,
            &mut figures.unreported,
        ] {
            row.fates = None;
        }
        let words = acknowledgement_words(&figures);
        assert!(
            words.starts_with("10 acknowledged, 7 not, 0 without"),
            "{words}"
        );
        assert!(words.contains("unavailable"), "{words}");
    }
}
