//! The network of a run in virtual time: the link models' fates as passages, for the same report as
//! of a live run. What a model delays counts from publication, as no gateway stands between.

use hil_account::ChannelPath;
use hil_account::network::{Moment, NetworkContext};
use hil_core::case_study::ErrorSeries;
use hil_core::plot::PlotSeries;
use hil_core::run_log::RunLog;
use hil_core::time::{Instant, duration_ns};

use super::watched::Watch;
use crate::analysis::network::{AxisClocks, ChannelPassages, NetworkBuilder, RobotSeries};
use crate::network::NetworkReport;
use crate::score_event::ScoreEvents;
use hil_topology::Topology;

/// The report and the series of every channel that a link model carried; `None` when none did.
pub(super) fn of_simulation(
    topology: &Topology,
    watches: Vec<(String, Watch)>,
    log: &RunLog,
    errors: Vec<ErrorSeries>,
    events: &mut ScoreEvents,
) -> Option<(NetworkReport, Vec<PlotSeries>)> {
    let seed = topology.run().seed;
    let length_ns = duration_ns(topology.run().duration);
    let mut builder = NetworkBuilder::default();
    for (name, watch) in watches {
        let crossing = topology.crossings().find(|one| one.channel.name == name)?;
        let (passages, duplicated_count) = watch.passages();
        let passages = passages.into_iter().collect();
        let payload = log.raw(&name).first();
        builder.add(ChannelPassages {
            channel: &name,
            hosts: [&crossing.from_host.name, &crossing.to_host.name],
            passages: &passages,
            other_events: Vec::new(),
            duration_ns: length_ns,
            // Virtual time begins with the run, for all hosts alike.
            place: &|at: Moment| Some(at.ns),
            context: NetworkContext {
                path: ChannelPath::SharedMemory,
                run_ns: Some((0, length_ns)),
                payload_bytes: payload.map(|message| message.payload.len() as u64),
                duplicated_count: Some(duplicated_count),
                round_trips_ns: &[],
                seed,
            },
        });
    }
    let errors = errors.into_iter();
    let errors = errors.map(|one| RobotSeries::of(one, |at| Some(at.seconds_since(Instant::ZERO))));
    builder.finish(events, errors.collect(), seed, AxisClocks::ONE)
}
