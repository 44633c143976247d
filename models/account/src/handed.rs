//! What became of each message that a gateway handed to the kernel, as far as a radio is concerned.
//! What the radio said of it is set beside this in [`crate::radio`].

use super::stage::MessageFate;
use super::{AccountContext, ChannelRecords, each_judged};
use hil_core::record::{EgressRecord, stamp};

/// What became of a message behind the sending radio.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum HandedFate {
    /// The receiving gateway has it.
    Arrived,
    /// Never received, while everything worked.
    Lost,
    /// Lost while a process on its way was down, which is no fault of the air.
    Interrupted,
    /// Still under way when the run ended.
    InFlight,
    /// The receiving gateway's records are not at hand.
    Unknown,
}

/// Hands the sending gateway's record of every message that was handed to the kernel to `take`, with what
/// became of it.
pub(super) fn each_handed(
    records: &ChannelRecords<'_>,
    context: &AccountContext<'_>,
    mut take: impl FnMut(&EgressRecord, HandedFate),
) {
    each_judged(records, context, |joined, fate, _| {
        let handed = joined.egress.filter(is_handed);
        let Some(egress) = handed else { return };
        let fate = match fate {
            _ if joined.ingress.is_some() => HandedFate::Arrived,
            MessageFate::Taken | MessageFate::SupersededAtConsumer => HandedFate::Arrived,
            MessageFate::LostInInterruption => HandedFate::Interrupted,
            MessageFate::InFlight => HandedFate::InFlight,
            MessageFate::UnknownPeerRecordsUnavailable | MessageFate::Unexplained => {
                HandedFate::Unknown
            }
            MessageFate::LostOnWire
            | MessageFate::SupersededAtInput
            | MessageFate::RefusedByKernel
            | MessageFate::RefusedAtIngress
            | MessageFate::Late
            | MessageFate::Duplicate => HandedFate::Lost,
        };
        take(&egress, fate);
    });
}

/// True for a message that was handed to the kernel and not refused.
fn is_handed(record: &EgressRecord) -> bool {
    stamp(record.handed_ns).is_some() && record.flags & EgressRecord::REFUSED_BY_KERNEL == 0
}
