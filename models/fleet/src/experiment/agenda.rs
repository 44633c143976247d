//! When each of many robots next has something to do, and which is first. It holds times only.

use hil_core::time::Instant;

/// No event.
pub(crate) const NEVER: Instant = Instant::from_ns(i64::MAX);

/// A tournament over a fixed number of entries: the first is known at once, a change costs the
/// logarithm of their number. Of entries at one instant, the lowest index wins.
#[derive(Debug, Clone)]
pub(crate) struct Agenda {
    /// Node `i` has the children `2 i` and `2 i + 1`; the leaves begin at `leaf_start`. A node
    /// holds the winner's index.
    winners: Vec<u32>,
    due: Vec<Instant>,
    leaf_start: usize,
}

impl Agenda {
    /// An agenda of `count` entries without events.
    pub(crate) fn new(count: usize) -> Self {
        let leaf_start = count.max(1).next_power_of_two();
        let index = |leaf: usize| u32::try_from(leaf).expect("fewer than 2^32 robots");
        let mut winners = vec![0; 2 * leaf_start];
        for leaf in 0..leaf_start {
            winners[leaf_start + leaf] = index(leaf);
        }
        let mut agenda = Self {
            winners,
            due: vec![NEVER; leaf_start],
            leaf_start,
        };
        for node in (1..leaf_start).rev() {
            agenda.play(node);
        }
        agenda
    }

    /// The earliest event and whose it is.
    pub(crate) fn first(&self) -> (Instant, usize) {
        let winner = self.winners[1] as usize;
        (self.due[winner], winner)
    }

    /// Sets the next event of `entry`.
    pub(crate) fn set(&mut self, entry: usize, due: Instant) {
        self.due[entry] = due;
        let mut node = (self.leaf_start + entry) >> 1;
        while node > 0 {
            self.play(node);
            node /= 2;
        }
    }

    fn play(&mut self, node: usize) {
        let (left, right) = (self.winners[2 * node], self.winners[2 * node + 1]);
        let is_right = self.due[right as usize] < self.due[left as usize];
        self.winners[node] = if is_right { right } else { left };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::random::RandomStream;

    #[test]
    fn the_first_entry_is_the_earliest_whatever_changed() {
        for count in [1, 2, 3, 7, 8, 100] {
            let mut agenda = Agenda::new(count);
            let mut plain = vec![NEVER; count];
            assert_eq!(agenda.first(), (NEVER, 0));
            let mut random = RandomStream::new(count as u64, "agenda");
            for _ in 0..2_000 {
                let entry = usize::try_from(random.next_u64() % count as u64).unwrap();
                let at = Instant::from_ns(i64::try_from(random.next_u64() % 50).unwrap());
                agenda.set(entry, at);
                plain[entry] = at;
                let expected = (0..count).min_by_key(|&entry| plain[entry]).unwrap();
                assert_eq!(agenda.first(), (plain[expected], expected));
            }
        }
    }
}
