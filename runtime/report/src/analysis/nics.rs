//! Which cards the channels of a run passed, and where their stamps lie on the hosts' clocks.

use std::collections::BTreeMap;

use hil_account::nic_clock::NicTimeline;

use super::records::RunRecords;
use crate::nic_metrics::{HardwareStamps, NicSummary, Places, channel_stamps};
use hil_rundir::nic_history::NicHistory;
use hil_rundir::run_result::RunResult;
use hil_topology::{Crossing, Timestamps};

/// What the cards of the run say; `None` when hardware stamps were not asked for.
pub(super) fn hardware_stamps(records: &RunRecords<'_>) -> Option<HardwareStamps> {
    let result = records.result;
    let timelines: BTreeMap<&str, NicTimeline> = result
        .cards
        .iter()
        .filter_map(|card| {
            let timeline = records.nic_timeline(&card.name())?;
            Some((card.host.as_str(), timeline))
        })
        .collect();
    let cards = result.cards.iter().map(|card| NicSummary {
        story: card.clone(),
        clock: timelines
            .get(card.host.as_str())
            .and_then(NicTimeline::metrics),
    });
    let passing = records.topology.crossings().filter(passes_nic);
    let channels = passing.map(|crossing| {
        let name = &crossing.channel.name;
        records.consult(crossing.channel, |files, context| {
            let places = Places {
                sender: timelines.get(crossing.from_host.name.as_str()),
                receiver: timelines.get(crossing.to_host.name.as_str()),
                receiving_nic: nic_of(result, &crossing.to_host.name),
                has_one_clock: share_a_clock(result, &crossing),
            };
            channel_stamps(name, files, context, &places)
        })
    });
    let stamps = HardwareStamps {
        cards: cards.collect(),
        channels: channels.collect(),
    };
    (!stamps.cards.is_empty() || !stamps.channels.is_empty()).then_some(stamps)
}

fn passes_nic(crossing: &Crossing<'_>) -> bool {
    crossing.hop.socket.timestamps == Timestamps::Hardware
}

fn nic_of<'a>(result: &'a RunResult, host: &str) -> Option<&'a NicHistory> {
    result.cards.iter().find(|card| card.host == host)
}

/// True when both ends of a channel take their stamps from one clock: the clocks of the hosts are
/// one, and so is the number of the cards' clock, which a kernel gives once.
fn share_a_clock(result: &RunResult, crossing: &Crossing<'_>) -> bool {
    let index_of = |host: &str| nic_of(result, host).and_then(|card| card.phc_index);
    let from = index_of(&crossing.from_host.name);
    result.has_one_clock && from.is_some() && from == index_of(&crossing.to_host.name)
}
