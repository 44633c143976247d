//! The record files of one channel of a finished run, and the last signs of life they give. It does not
//! say what became of a message.

use std::collections::BTreeMap;

use bytemuck::Pod;
use hil_core::record::{
    EgressRecord, IngressRecord, PublishedRecord, RoundTripRecord, TakenRecord,
};

use hil_rundir::record::stored::StoredRecords;

/// All records of one channel.
#[derive(Debug, Default)]
pub(super) struct ChannelFiles {
    pub(super) published: Option<StoredRecords>,
    pub(super) egress: Option<StoredRecords>,
    pub(super) ingress: Option<StoredRecords>,
    pub(super) follow_up: Option<StoredRecords>,
    pub(super) taken: Option<StoredRecords>,
    pub(super) round_trips: BTreeMap<(u32, u64), RoundTripRecord>,
    pub(super) face_sent: Option<StoredRecords>,
    pub(super) face_received: Option<StoredRecords>,
    pub(super) message: Option<StoredRecords>,
    pub(super) signs: Signs,
}

/// The last signs of life that a channel's records give, and the ends of what its gateways noted of the
/// clocks: asked for by other channels, too, so read once.
#[derive(Debug, Default)]
#[allow(clippy::struct_field_names, reason = "the unit, as everywhere")]
pub(super) struct Signs {
    pub(super) published_ns: Option<i64>,
    pub(super) sent_ns: Option<i64>,
    pub(super) received_ns: Option<i64>,
    pub(super) taken_ns: Option<i64>,
    pub(super) sender_realtime_ns: Option<(i64, i64)>,
    pub(super) receiver_realtime_ns: Option<(i64, i64)>,
}

impl Signs {
    pub(super) fn of(files: &ChannelFiles) -> Self {
        let mut signs = Self::default();
        for record in all::<PublishedRecord>(files.published.as_ref()) {
            signs.published_ns = signs.published_ns.max(Some(record.published_ns));
        }
        for record in all::<EgressRecord>(files.egress.as_ref()) {
            signs.sent_ns = signs.sent_ns.max(Some(record.taken_ns));
            widen(&mut signs.sender_realtime_ns, record.realtime_offset_ns);
        }
        for record in all::<IngressRecord>(files.ingress.as_ref()) {
            signs.received_ns = signs.received_ns.max(Some(record.received_ns));
            widen(&mut signs.receiver_realtime_ns, record.realtime_offset_ns);
        }
        for record in all::<TakenRecord>(files.taken.as_ref()) {
            signs.taken_ns = signs.taken_ns.max(Some(record.taken_ns));
        }
        signs
    }
}

/// Lets `ends` take in `ns`.
pub(super) fn widen(ends: &mut Option<(i64, i64)>, ns: i64) {
    let (lowest, highest) = ends.unwrap_or((ns, ns));
    *ends = Some((lowest.min(ns), highest.max(ns)));
}

/// The records of files that may not be there.
pub(super) fn all<R: Pod>(files: Option<&StoredRecords>) -> impl Iterator<Item = R> + '_ {
    files.into_iter().flat_map(StoredRecords::records)
}
