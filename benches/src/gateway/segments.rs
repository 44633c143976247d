//! Where the time of a hop went, from the records the gateways kept: the same stamps the report of
//! a run is made of. Both ends must read one clock.

use std::collections::BTreeMap;

use hil_core::record::{EgressRecord, IngressRecord, UNAVAILABLE};

use super::hosts::{Hosts, Plan, SetupError};
use crate::quantiles::Quantiles;

/// Names of the segments, in the order of the way; the three that hold a wake-up say so.
pub const SEGMENTS: [&str; 7] = [
    "published -> taken by gateway (wake-up)",
    "taken -> handed to the kernel",
    "handed -> TX stamp",
    "TX stamp -> RX stamp",
    "RX stamp -> received by gateway (wake-up)",
    "received -> published",
    "published -> taken by application (wake-up)",
];

/// Which of [`SEGMENTS`] hold a wake-up.
pub const WAKE_UPS: [usize; 3] = [0, 4, 6];

/// Quantiles of each segment over both ways of `plan`; `None` for a segment no message has.
///
/// # Errors
/// When a record file cannot be read.
pub fn segments(
    hosts: &Hosts,
    plan: &Plan,
    applications: &[Vec<u64>; 2],
) -> Result<[Option<Quantiles>; 7], SetupError> {
    let mut samples: [Vec<u64>; 7] = Default::default();
    for host in 0..2 {
        let sent = hosts.records(plan, host, "egress", host)?;
        let sent: BTreeMap<(u32, u64), EgressRecord> = sent
            .records()
            .map(|record: EgressRecord| ((record.epoch, record.sequence), record))
            .collect();
        let received = hosts.records(plan, host, "ingress", 1 - host)?;
        for arrival in received.records::<IngressRecord>() {
            if let Some(departure) = sent.get(&(arrival.epoch, arrival.sequence)) {
                split(departure, &arrival, &mut samples);
            }
        }
    }
    samples[6] = applications.concat();
    Ok(samples.map(|mut samples| Quantiles::of(&mut samples)))
}

fn split(departure: &EgressRecord, arrival: &IngressRecord, samples: &mut [Vec<u64>; 7]) {
    let monotonic = |stamp: i64, offset: i64| {
        let is_there = stamp != UNAVAILABLE;
        is_there.then(|| stamp - offset)
    };
    let stamps = [
        Some(departure.published_ns),
        Some(departure.taken_ns),
        Some(departure.handed_ns),
        monotonic(departure.tx_software_ns, departure.realtime_offset_ns),
        monotonic(arrival.rx_software_ns, arrival.realtime_offset_ns),
        Some(arrival.received_ns),
        Some(arrival.forwarded_ns),
    ];
    for ((samples, from), to) in samples.iter_mut().zip(stamps).zip(&stamps[1..]) {
        // Clock pairs have an error of some 20 ns, by which a short segment may come out negative.
        if let (Some(from), Some(to)) = (from, to)
            && let Ok(elapsed) = u64::try_from((to - from).max(0))
        {
            samples.push(elapsed);
        }
    }
}
