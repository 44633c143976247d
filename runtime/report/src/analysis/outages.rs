//! The outages of each channel of a finished run, and which of them went before an event. They are
//! found in the records of the messages alone; no link is asked what it did.

use std::collections::BTreeMap;

use hil_account::{EventTime, Outage, OutageMetrics, Side, Standing, preceding};
use hil_core::time::Instant;

use super::axis::RunAxis;
use super::records::RunRecords;
use crate::score_event::EventOutage;
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::units::{duration_s, seconds};
use hil_topology::Channel;

/// The outages of one channel, with what gives their times a meaning.
#[derive(Debug)]
pub(crate) struct OutageHistory {
    /// The channel.
    pub(crate) channel: String,
    /// In the order of its messages.
    pub(crate) outages: Vec<Outage>,
    /// Instants of the producer's clock at which outages begin and end, nanoseconds, and when they were
    /// after the start of the run.
    pub(crate) placed_ns: BTreeMap<i64, i64>,
    /// End of the run on the producer's clock.
    pub(crate) end: Option<Instant>,
    /// Processes that were down, by [`Outage::interruption_index`].
    pub(crate) interrupted: Vec<String>,
    /// True when some messages' fate is unknown, so that outages may be missing here.
    pub(crate) is_partial: bool,
}

impl OutageHistory {
    /// The `outages` of `channel`; `None` when it has no known producer.
    pub(super) fn of(
        records: &RunRecords<'_>,
        axis: &RunAxis<'_>,
        channel: &Channel,
        outages: Vec<Outage>,
        is_partial: bool,
    ) -> Option<Self> {
        let host = &records.topology.process(&channel.from)?.host;
        Some(Self {
            channel: channel.name.clone(),
            placed_ns: placed(&outages, |ns| axis.place_ns(host, ns)),
            outages,
            end: records.result.spans.get(host).map(|span| span.1),
            interrupted: records.consult(channel, |_, context| {
                let interruptions = context.interruptions.iter();
                interruptions.map(|one| one.process.clone()).collect()
            }),
            is_partial,
        })
    }

    /// In figures; `None` when none was found and some may be missing.
    pub(crate) fn metrics(&self) -> Option<OutageMetrics> {
        let is_unknown = self.is_partial && self.outages.is_empty();
        (!is_unknown).then(|| {
            let mut figures = OutageMetrics::of(&self.outages, self.end);
            if let Some(longest) = &mut figures.longest {
                let placed_ns = self.placed_ns.get(&longest.start_ns);
                longest.start_ns = placed_ns.copied().unwrap_or(longest.start_ns);
            }
            figures
        })
    }

    /// What has most to do with something that happened.
    pub(crate) fn before(&self, event: &EventTime<'_>) -> Option<EventOutage> {
        let found = preceding(&self.outages, event)?;
        let outage = found.outage;
        let since_start_s = |ns: i64| Some(*self.placed_ns.get(&ns)? as f64 * 1e-9);
        let mut event_outage = EventOutage {
            channel: self.channel.clone(),
            from_s: outage.from_ns.and_then(since_start_s),
            until_s: outage.until_ns.and_then(since_start_s),
            length_s: outage.length_ns(self.end).map(|ns| ns as f64 * 1e-9),
            lost_count: outage.lost_count,
            lost_by_network_count: outage.lost_by_network_count,
            standing: found.standing,
            clock_bound_s: 0.0,
            other_count: found.other_count,
            words: String::new(),
        };
        let interrupted = outage
            .interruption_index
            .and_then(|index| self.interrupted.get(index));
        let later_ns = event.at.and_then(|(at, side)| {
            let from_ns = match side {
                Side::Producer => outage.from_ns,
                Side::Consumer => outage.silent_from_ns,
            };
            Some(from_ns?.saturating_sub(at.as_ns()))
        });
        let interrupted = interrupted.map(String::as_str);
        event_outage.words = words(&event_outage, interrupted, later_ns);
        Some(event_outage)
    }
}

/// Puts the ends of outages on the run's axis, as far as `place` can.
pub(crate) fn placed(outages: &[Outage], place: impl Fn(i64) -> Option<i64>) -> BTreeMap<i64, i64> {
    let ends = outages.iter().flat_map(|one| [one.from_ns, one.until_ns]);
    let placed = ends.flatten().filter_map(|ns| Some((ns, place(ns)?)));
    placed.collect()
}

/// An outage that began after the event did so `later_ns` later.
fn words(outage: &EventOutage, interrupted: Option<&str>, later_ns: Option<i64>) -> String {
    // One message lost is over with the next: the time between the two is no outage's length.
    let is_single = outage.lost_count == 1 && interrupted.is_none();
    let time = match (outage.from_s, outage.until_s) {
        (Some(from_s), Some(until_s)) => format!("{} to {}", seconds(from_s), seconds(until_s)),
        (Some(from_s), None) => format!("from {} on", seconds(from_s)),
        (None, Some(until_s)) => format!("until {}", seconds(until_s)),
        (None, None) => "at an unknown time".to_owned(),
    };
    let mut text = if is_single {
        let at = match (outage.from_s, outage.until_s) {
            (Some(at_s), _) => format!("at {}", seconds(at_s)),
            (None, _) => time,
        };
        format!("single message lost on {}, {at}", outage.channel)
    } else {
        let length = match outage.length_s {
            Some(length_s) => format!("outage of {}", duration_s(length_s)),
            None => "outage of unknown length".to_owned(),
        };
        let lost = counted(outage.lost_count, "message");
        let by_network = match outage.lost_by_network_count {
            count if count == outage.lost_count => String::new(),
            0 if interrupted.is_some() => String::new(),
            0 => ", none of them by the network for certain".to_owned(),
            count => format!(", {} of them by the network", grouped(count)),
        };
        let channel = &outage.channel;
        format!("{length} on {channel}, {time}, {lost} lost{by_network}")
    };
    if let Some(process) = interrupted {
        text.push_str(&[", while ", process, " was down"].concat());
    }
    match outage.standing {
        Standing::UnderWay => text.push_str(", under way then"),
        Standing::OverFor(ns) => {
            let over = duration_s(ns as f64 * 1e-9);
            text.push_str(&[", over for ", &over].concat());
        }
        Standing::BegunLater => {
            let later = later_ns.map_or_else(String::new, |ns| {
                [duration_s(ns as f64 * 1e-9).as_str(), " "].concat()
            });
            text.push_str(&[", begins ", &later, "later"].concat());
        }
        Standing::Unknown => {}
    }
    if outage.other_count > 0 {
        let others = counted(outage.other_count, "other");
        text.push_str(&[" (", &others, " about then)"].concat());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_present::units::JOINT;

    const MS: i64 = 1_000_000;

    fn history(outages: Vec<Outage>) -> OutageHistory {
        OutageHistory {
            channel: "egm/right/command".to_owned(),
            placed_ns: placed(&outages, |ns| Some(ns - 1_000 * MS)),
            outages,
            end: Some(Instant::from_ns(61_000 * MS)),
            interrupted: vec!["gateway".to_owned()],
            is_partial: false,
        }
    }

    fn outage(from_ms: i64, until_ms: Option<i64>, lost_count: u64) -> Outage {
        Outage {
            lost_count,
            lost_by_network_count: lost_count,
            first_sequence: 0,
            from_ns: Some(from_ms * MS),
            until_ns: until_ms.map(|ms| ms * MS),
            silent_from_ns: None,
            silent_until_ns: None,
            interruption_index: None,
        }
    }

    fn words_at(story: &OutageHistory, at_ms: i64) -> Option<String> {
        let found = story.before(&EventTime {
            at: Some((Instant::from_ns(at_ms * MS), Side::Producer)),
            lost_published_ns: &[],
        })?;
        Some(found.words.replace(JOINT, " "))
    }

    #[test]
    fn an_outage_beside_an_event_is_told_with_its_time_and_its_losses() {
        let mut broken = outage(50_000, Some(50_008), 1);
        broken.interruption_index = Some(0);
        broken.lost_by_network_count = 0;
        let story = history(vec![
            outage(42_200, Some(44_040), 230),
            outage(44_100, Some(44_108), 1),
            broken,
            outage(55_000, Some(55_008), 1),
            outage(60_000, None, 125),
        ]);
        for (at_ms, expected) in [
            (
                43_204,
                Some(
                    "outage of 1.84 s on egm/right/command, 41.200 s to 43.040 s, 230 messages \
                     lost, under way then",
                ),
            ),
            (
                44_540,
                Some(
                    "outage of 1.84 s on egm/right/command, 41.200 s to 43.040 s, 230 messages \
                     lost, over for 500 ms (1 other about then)",
                ),
            ),
            (
                50_108,
                Some(
                    "outage of 8.00 ms on egm/right/command, 49.000 s to 49.008 s, 1 message \
                     lost, while gateway was down, over for 100 ms",
                ),
            ),
            (
                55_108,
                Some("single message lost on egm/right/command, at 54.000 s, over for 100 ms"),
            ),
            (
                60_900,
                Some(
                    "outage of 1.00 s on egm/right/command, from 59.000 s on, 125 messages lost, \
                     under way then",
                ),
            ),
            (42_000, None),
        ] {
            assert_eq!(words_at(&story, at_ms).as_deref(), expected, "{at_ms} ms");
        }
    }

    #[test]
    fn an_outage_that_begins_after_the_event_says_so() {
        let story = history(vec![outage(42_500, Some(43_000), 62)]);
        let found = story.before(&EventTime {
            at: Some((Instant::from_ns(42_000 * MS), Side::Producer)),
            lost_published_ns: &[42_600 * MS],
        });
        let words = found.unwrap().words.replace(JOINT, " ");
        assert!(
            words.ends_with("62 messages lost, begins 500 ms later"),
            "{words}"
        );
    }

    #[test]
    fn no_outage_found_among_unknown_fates_is_no_figure() {
        let mut story = history(Vec::new());
        assert_eq!(story.metrics().unwrap().outage_count, 0);
        story.is_partial = true;
        assert_eq!(story.metrics(), None);
        story.outages.push(outage(2_000, Some(2_100), 12));
        story.placed_ns = placed(&story.outages, |ns| Some(ns - 1_000 * MS));
        let figures = story.metrics().unwrap();
        assert_eq!(figures.outage_count, 1);
        assert_eq!(figures.longest.unwrap().start_ns, 1_000 * MS);
    }
}
