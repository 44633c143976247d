//! Proof that the loops of a process turn: each counts its turns, and another thread sees whether all
//! of them went on. A process that is stopped, or one loop of it that hangs, has no pulse. It says
//! nothing by itself; what silence means is decided by the supervisor.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// The turns of one loop. No loop of ours waits for more than [`hil_platform::wait::WAIT_MAX`] at once, so
/// that one without a turn in a second hangs, or gets no processor.
#[derive(Debug, Clone, Default)]
pub(crate) struct Heartbeat(Arc<AtomicU64>);

impl Heartbeat {
    /// One more turn; only the loop itself calls this. Costs a store to memory that nobody else
    /// writes.
    pub(crate) fn beat(&self) {
        let turns = self.0.load(Ordering::Relaxed);
        self.0.store(turns.wrapping_add(1), Ordering::Relaxed);
    }

    fn turns(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Looks at the loops of a process.
#[derive(Debug)]
pub(crate) struct Heartbeats {
    loops: Vec<(Heartbeat, u64)>,
}

impl Heartbeats {
    /// Of these loops.
    pub(crate) fn of(loops: impl IntoIterator<Item = Heartbeat>) -> Self {
        let loops = loops.into_iter().map(|one| {
            let turns = one.turns();
            (one, turns)
        });
        Self {
            loops: loops.collect(),
        }
    }

    /// True when every loop has turned since this was last true; always of no loops.
    pub(crate) fn have_all_turned(&mut self) -> bool {
        let have_all = self.loops.iter().all(|(one, seen)| one.turns() != *seen);
        if have_all {
            for (one, seen) in &mut self.loops {
                *seen = one.turns();
            }
        }
        have_all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_has_a_pulse_while_all_its_loops_turn() {
        let loops = [Heartbeat::default(), Heartbeat::default()];
        let mut heartbeats = Heartbeats::of(loops.clone());
        assert!(!heartbeats.have_all_turned());
        loops[0].beat();
        assert!(!heartbeats.have_all_turned(), "one hangs");
        loops[1].beat();
        assert!(
            heartbeats.have_all_turned(),
            "both turned, though not at once"
        );
        assert!(!heartbeats.have_all_turned());
        assert!(Heartbeats::of([]).have_all_turned());
    }
}
