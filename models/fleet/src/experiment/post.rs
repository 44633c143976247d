//! Messages under way between coordinator and robots in virtual time, as values, not bytes. What
//! delays or loses them is the link model's business.

use core::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::messages::{Authority, Mission, State};
use hil_core::time::Instant;

/// Header of a datagram between gateways; only a radio's airtime depends on it.
const HEADER_BYTES: usize = 72;

/// A message under way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Letter {
    /// To the coordinator.
    State(State),
    /// To a robot.
    Authority(Authority),
    /// To a robot.
    Mission(Mission),
}

impl Letter {
    /// Bytes of the message behind our datagram's header.
    pub(crate) const fn length_bytes(&self) -> usize {
        HEADER_BYTES
            + match self {
                Self::State(_) => size_of::<State>(),
                Self::Authority(_) => size_of::<Authority>(),
                Self::Mission(_) => size_of::<Mission>(),
            }
    }

    /// At one instant, ports are served in the order in which an endpoint polls them.
    const fn rank(&self) -> Rank {
        match self {
            Self::State(_) => Rank::State,
            Self::Authority(_) => Rank::Authority,
            Self::Mission(_) => Rank::Mission,
        }
    }
}

/// What comes first of several things at one instant: the coordinator takes states and decides,
/// the robots take authorities, then missions, then move; last the referee looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Rank {
    State,
    Cycle,
    Authority,
    Mission,
    Robot,
    Scan,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Flight {
    at: Instant,
    rank: Rank,
    order: u64,
    slot: usize,
}

/// Letters under way, the earliest arrival first; of those at one instant and port, the one
/// posted first.
#[derive(Debug, Default)]
pub(crate) struct Post {
    flights: BinaryHeap<Reverse<Flight>>,
    letters: Vec<Letter>,
    free: Vec<usize>,
    posted_count: u64,
}

impl Post {
    /// Puts a letter under way.
    pub(crate) fn post(&mut self, at: Instant, letter: Letter) {
        let slot = if let Some(slot) = self.free.pop() {
            self.letters[slot] = letter;
            slot
        } else {
            self.letters.push(letter);
            self.letters.len() - 1
        };
        self.flights.push(Reverse(Flight {
            at,
            rank: letter.rank(),
            order: self.posted_count,
            slot,
        }));
        self.posted_count += 1;
    }

    /// When the next letter arrives and at which port.
    pub(crate) fn next(&self) -> Option<(Instant, Rank)> {
        let Reverse(flight) = self.flights.peek()?;
        Some((flight.at, flight.rank))
    }

    /// Takes the next letter, whenever it arrives.
    pub(crate) fn take(&mut self) -> Option<Letter> {
        let Reverse(flight) = self.flights.pop()?;
        self.free.push(flight.slot);
        Some(self.letters[flight.slot])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::Header;

    fn authority(sequence: u32) -> Letter {
        Letter::Authority(Authority {
            sequence,
            ..Authority::default()
        })
    }

    #[test]
    fn letters_arrive_by_time_then_port_then_order() {
        let (early, late) = (Instant::from_ns(1), Instant::from_ns(2));
        let mut post = Post::default();
        let mission = Letter::Mission(Mission::default());
        let state = Letter::State(State {
            header: Header::default(),
            ..State::default()
        });
        post.post(late, authority(1));
        for letter in [mission, authority(2), authority(3), state] {
            post.post(early, letter);
        }
        assert_eq!(post.next(), Some((early, Rank::State)));
        let taken: Vec<_> = core::iter::from_fn(|| post.take()).collect();
        let expected = [state, authority(2), authority(3), mission, authority(1)];
        assert_eq!(taken, expected);
        post.post(late, mission);
        assert_eq!(post.letters.len(), 5, "a slot is used again");
    }
}
