//! What a sleeping thread does about datagrams that it refused: it looks away from its socket for a
//! moment, so that the next ones are met together. A flood would otherwise wake it for each, and a
//! wake-up costs its processor, and the sender's on this machine, more than the refusal itself.
//!
//! An honest datagram that comes meanwhile waits for at most [`GATHERING`]. Nothing is gathered for
//! before the first refusal, nor by a thread that spins, which is woken by nobody.

use core::time::Duration;

use hil_gateways::transport::sealed::REFUSED_PER_LOOK_MAX;
use hil_models::time::Instant;

/// How long a thread looks away: about the wake-up that it saves, and less than the usual way over a
/// hop, so that a flood does not double a message's delay.
pub(super) const GATHERING: Duration = Duration::from_micros(50);

/// The refusals of one socket, as its thread last saw them.
#[derive(Debug, Default)]
pub(super) struct Gathering {
    refused_count: u64,
}

impl Gathering {
    /// Until when to look away, at `now`, when `refused_count` datagrams were refused so far; `None` when
    /// nothing was refused since the last call, or so much that more may wait already.
    pub(super) fn until(&mut self, now: Instant, refused_count: u64) -> Option<Instant> {
        let new_count = refused_count.saturating_sub(self.refused_count);
        self.refused_count = refused_count;
        let is_emptied = new_count < REFUSED_PER_LOOK_MAX as u64;
        (new_count > 0 && is_emptied).then(|| now + GATHERING)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_new_refusals_and_only_of_an_emptied_socket_are_gathered_for() {
        let mut gathering = Gathering::default();
        let now = Instant::from_ns(5);
        assert_eq!(
            gathering.until(now, 0),
            None,
            "an honest line is never left"
        );
        let away = Some(Instant::from_ns(50_005));
        assert_eq!(gathering.until(now, 1), away);
        assert_eq!(gathering.until(now, 1), None, "the same one");
        assert_eq!(gathering.until(now, 16), away);
        assert_eq!(gathering.until(now, 32), None, "more may wait");
        assert_eq!(gathering.until(now, 32), None);
    }
}
