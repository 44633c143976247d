//! How long the frames of a channel were that arrived: frames are messages of different lengths.

use std::collections::BTreeMap;

use hil_account::MessageHistory;
use hil_core::record::FrameRecord;

/// Numbers of a block: numbers follow one another, and one out of the way costs no more than its block.
const BLOCK: usize = 256;

/// The lengths of the frames of one channel, by the inlet's start and the frame's number.
pub(super) struct FrameLengths {
    /// By start and block; 0 where no record tells.
    blocks: BTreeMap<(u32, u64), Box<[u16]>>,
    arrived_bytes: u64,
    arrived_count: u64,
}

fn place(sequence: u64) -> (u64, usize) {
    let within = usize::try_from(sequence % BLOCK as u64).expect("it is below 256");
    (sequence / BLOCK as u64, within)
}

impl FrameLengths {
    pub(super) fn of(frames: impl Iterator<Item = FrameRecord>) -> Self {
        let mut blocks: BTreeMap<(u32, u64), Box<[u16]>> = BTreeMap::new();
        for frame in frames {
            let (block, within) = place(frame.sequence);
            let lengths = blocks.entry((frame.epoch, block));
            lengths.or_insert_with(|| vec![0; BLOCK].into())[within] = frame.length_bytes;
        }
        Self {
            blocks,
            arrived_bytes: 0,
            arrived_count: 0,
        }
    }

    /// Counts a frame that arrived and whose length is on record.
    pub(super) fn note(&mut self, message: &MessageHistory) {
        let (block, within) = place(message.key.sequence);
        let lengths = self.blocks.get(&(message.epoch, block));
        let length = lengths.map(|lengths| lengths[within]);
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
        // One number is what only a damaged file has.
        let frames = frames.chain([(60, u64::MAX)]);
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
