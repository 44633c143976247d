//! What belongs to a watch that began in the middle of a run, of the records that other hosts send at the
//! end: they come whole, with all that was before.

use std::collections::BTreeMap;

use super::event::Record;

/// The first message of each channel that was heard of here since the watch began. By number and
/// not by time, for the other host's clock may be another one.
#[derive(Debug, Default)]
pub(super) struct Since {
    /// By channel: the lowest number of each start of its producer.
    first: BTreeMap<String, BTreeMap<u32, u64>>,
}

impl Since {
    /// True when message `sequence` of start `epoch` of `channel` belongs to the watch. What this host tells
    /// does, and sets the beginning; another host's does from there on. A start of the producer
    /// of which nothing was heard here does not: it may have ended long before.
    pub(super) fn admits(
        &mut self,
        channel: &str,
        epoch: u32,
        sequence: u64,
        is_of_this_host: bool,
    ) -> bool {
        if is_of_this_host {
            self.note(channel, epoch, sequence);
            return true;
        }
        let first = self.first.get(channel).and_then(|one| one.get(&epoch));
        first.is_some_and(|first| *first <= sequence)
    }

    /// As [`Self::admits`], for what a process noted of a message; what it noted of something else
    /// belongs to the watch.
    pub(super) fn admits_record(
        &mut self,
        channel: &str,
        record: &Record,
        is_of_this_host: bool,
    ) -> bool {
        record
            .message()
            .is_none_or(|one| self.admits(channel, one.epoch, one.sequence, is_of_this_host))
    }

    fn note(&mut self, channel: &str, epoch: u32, sequence: u64) {
        // The name is copied once only: this is asked for every message.
        if let Some(starts) = self.first.get_mut(channel) {
            let first = starts.entry(epoch).or_insert(sequence);
            *first = sequence.min(*first);
            return;
        }
        let starts = BTreeMap::from([(epoch, sequence)]);
        self.first.insert(channel.to_owned(), starts);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_host_is_heard_from_the_first_message_on_that_was_heard_of_here() {
        let mut since = Since::default();
        assert!(!since.admits("c", 1, 7, false));
        for sequence in [6, 5, 8] {
            assert!(since.admits("c", 1, sequence, true));
        }
        let admitted = [4, 5, 7, 9].map(|sequence| since.admits("c", 1, sequence, false));
        assert_eq!(admitted, [false, true, true, true]);
        assert!(!since.admits("c", 2, 9, false) && !since.admits("d", 1, 9, false));
    }
}
