//! Puts a sequence in order that is almost in order already, such as the records of a run: it holds a
//! window of it and what strays further, never the whole.

use std::collections::VecDeque;
use std::iter::Peekable;
use std::vec;

/// Entries held while those that belong before them may still come. A second of messages at 2 kHz.
const WINDOW: usize = 2_048;

/// The entries of a sequence in the order of their keys; equal keys keep the order of the sequence.
#[derive(Debug)]
pub struct InOrder<K, T, I: Iterator<Item = (K, T)>> {
    source: I,
    window: VecDeque<(K, T)>,
    /// What came so late that the window was past its place, in order.
    strays: Peekable<vec::IntoIter<(K, T)>>,
    /// Key of the last entry that left the window.
    floor: Option<K>,
}

/// Reads the sequence twice: once for what strays, which is kept, and once while it is asked for.
pub fn in_order<K: Ord + Copy, T, I: Iterator<Item = (K, T)>>(
    read: impl Fn() -> I,
) -> InOrder<K, T, I> {
    let mut strays = Vec::new();
    let mut window: VecDeque<(K, ())> = VecDeque::new();
    let mut floor = None;
    for (key, value) in read() {
        if floor.is_some_and(|floor| key < floor) {
            strays.push((key, value));
            continue;
        }
        insert(&mut window, key, ());
        if window.len() > WINDOW {
            floor = window.pop_front().map(|first| first.0);
        }
    }
    strays.sort_by_key(|stray| stray.0);
    InOrder {
        source: read(),
        window: VecDeque::new(),
        strays: strays.into_iter().peekable(),
        floor: None,
    }
}

/// Puts `entry` behind those whose keys are not above its own.
fn insert<K: Ord + Copy, T>(window: &mut VecDeque<(K, T)>, key: K, value: T) {
    if window.back().is_none_or(|last| last.0 <= key) {
        window.push_back((key, value));
    } else {
        let place = window.partition_point(|one| one.0 <= key);
        window.insert(place, (key, value));
    }
}

impl<K: Ord + Copy, T, I: Iterator<Item = (K, T)>> InOrder<K, T, I> {
    /// Key of the next entry.
    pub fn head(&mut self) -> Option<K> {
        while self.window.len() <= WINDOW
            && let Some((key, value)) = self.source.next()
        {
            // The strays are at hand.
            if self.floor.is_none_or(|floor| key >= floor) {
                insert(&mut self.window, key, value);
            }
        }
        let held = self.window.front().map(|entry| entry.0);
        let stray = self.strays.peek().map(|entry| entry.0);
        match (held, stray) {
            (Some(held), Some(stray)) => Some(held.min(stray)),
            (held, stray) => held.or(stray),
        }
    }
}

impl<K: Ord + Copy, T, I: Iterator<Item = (K, T)>> Iterator for InOrder<K, T, I> {
    type Item = (K, T);

    fn next(&mut self) -> Option<(K, T)> {
        let key = self.head()?;
        // A stray came after whatever the window held of its key.
        if self.window.front().is_some_and(|held| held.0 == key) {
            self.floor = Some(key);
            return self.window.pop_front();
        }
        self.strays.next()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    /// What sorting all of it gives.
    fn sorted(entries: &[(u64, usize)]) -> Vec<(u64, usize)> {
        let mut all = entries.to_vec();
        all.sort_by_key(|entry| entry.0);
        all
    }

    fn ordered(entries: &[(u64, usize)]) -> Vec<(u64, usize)> {
        in_order(|| entries.iter().copied()).collect()
    }

    #[test]
    fn every_disorder_is_put_right_and_equal_keys_stay_as_they_came() {
        let count = 5 * WINDOW as u64;
        for (seed, reach) in [(1, 1), (2, 5), (3, 900), (4, 30_000), (5, 3)] {
            let mut random = RandomStream::new(seed, "measure.in_order");
            let entries: Vec<(u64, usize)> = (0..count)
                .zip(0..)
                .map(|(place, index)| {
                    let key = (place + random.next_u64() % reach) / seed;
                    // A few go back to the beginning, as after a restart.
                    let is_stray = random.chance(0.001);
                    (if is_stray { key / 7 } else { key }, index)
                })
                .collect();
            assert!(ordered(&entries) == sorted(&entries), "seed {seed}");
        }
        assert_eq!(ordered(&[]), []);
    }

    #[test]
    fn what_is_in_order_is_never_held_whole() {
        let read = || (0..10 * WINDOW as u64).map(|key| (key, ()));
        let mut order = in_order(read);
        let mut count = 0;
        while order.next().is_some() {
            count += 1;
            assert!(order.window.len() <= WINDOW + 1);
        }
        assert_eq!((count, order.strays.len()), (10 * WINDOW, 0));
    }
}
