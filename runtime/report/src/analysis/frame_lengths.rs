//! How long the frames of a channel were that arrived: frames are messages of different lengths.

use std::collections::BTreeMap;

use hil_account::MessageHistory;
use hil_core::record::FrameRecord;

/// The lengths of the frames of one channel, by the inlet's start and the frame's number.
pub(super) struct FrameLengths {
    by_epoch: BTreeMap<u32, Vec<u16>>,
    arrived_bytes: u64,
    arrived_count: u64,
}

impl FrameLengths {
    pub(super) fn of(frames: impl Iterator<Item = FrameRecord>) -> Self {
        let mut by_epoch: BTreeMap<u32, Vec<u16>> = BTreeMap::new();
        for frame in frames {
            let Ok(sequence) = usize::try_from(frame.sequence) else {
                continue;
            };
            let lengths = by_epoch.entry(frame.epoch).or_default();
            // Numbers follow one another; a hole is of records that are lost.
            if lengths.len() <= sequence {
                lengths.resize(sequence + 1, 0);
            }
            lengths[sequence] = frame.length_bytes;
        }
        Self {
            by_epoch,
            arrived_bytes: 0,
            arrived_count: 0,
        }
    }

    /// Counts a frame that arrived and whose length is on record.
    pub(super) fn note(&mut self, message: &MessageHistory) {
        let sequence = usize::try_from(message.key.sequence).ok();
        let lengths = self.by_epoch.get(&message.epoch);
        let length = sequence.and_then(|sequence| lengths?.get(sequence).copied());
        if let Some(length) = length.filter(|length| *length > 0 && message.arrived().is_some()) {
            self.arrived_bytes += u64::from(length);
            self.arrived_count += 1;
        }
    }

    /// Bytes; `None` without a frame.
    pub(super) fn arrived_mean(&self) -> Option<f64> {
        let count = Some(self.arrived_count).filter(|count| *count > 0)?;
        Some(self.arrived_bytes as f64 / count as f64)
    }
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable as _;
    use hil_account::{Copies, Key, MessageFate};
    use hil_core::record::IngressRecord;

    use super::*;

    #[test]
    fn the_mean_is_of_the_frames_that_arrived() {
        let frames = [100, 300, 1_400].into_iter().zip(0..);
        let frames =
            frames.map(|(length, sequence)| FrameRecord::new(sequence, 7, &vec![0; length]));
        let mut lengths = FrameLengths::of(frames);
        assert_eq!(lengths.arrived_mean(), None);
        // The second is lost; of the fourth no record tells the length.
        for (sequence, has_arrived) in [(0, true), (1, false), (2, true), (3, true)] {
            lengths.note(&MessageHistory {
                key: Key {
                    epoch_rank: 0,
                    sequence,
                },
                epoch: 7,
                count: 1,
                published: None,
                egress: None,
                ingress: has_arrived.then(IngressRecord::zeroed),
                taken: None,
                handed_to_tx_ns: None,
                copies: Copies::default(),
                fate: MessageFate::Taken,
                interruption_index: None,
            });
        }
        assert_eq!(lengths.arrived_mean(), Some(750.0));
    }
}
