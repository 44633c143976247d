//! How the foreign program stands to an adapter, in words and counts. It sends and judges nothing.

use hil_arm::egm::wire::DatagramCounts;
use hil_core::time::Instant;

use hil_platform::clock::MonotonicClock;
use hil_rundir::pipe::{AdapterRefusal, RefusalCount};

/// A program that was silent for longer when the run ended is reported as such.
const SILENCE_S: f64 = 0.5;

/// When something last went each way.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Peer {
    spoken_to: Option<Instant>,
    heard: Option<Instant>,
}

impl Peer {
    /// Something was sent.
    pub(super) fn spoken_to(&mut self, at: Instant) {
        self.spoken_to = Some(at);
    }

    /// Something came, whatever it was.
    pub(super) fn heard(&mut self, at: Instant) {
        self.heard = Some(at);
    }

    /// When something last came.
    pub(super) const fn last_heard(&self) -> Option<Instant> {
        self.heard
    }

    /// In words.
    pub(super) fn state(&self) -> String {
        match (self.spoken_to, self.heard) {
            (None, None) => "nothing was sent and nothing came".to_owned(),
            (Some(_), None) => "never answered".to_owned(),
            (_, Some(heard)) => {
                let silence_s = MonotonicClock::now().seconds_since(heard);
                if silence_s > SILENCE_S {
                    format!("silent for {silence_s:.1} s")
                } else {
                    "speaking".to_owned()
                }
            }
        }
    }
}

/// Refused datagrams by cause.
pub(super) fn refusals(counts: &DatagramCounts) -> impl Iterator<Item = RefusalCount> {
    counts.causes().map(|(cause, count)| RefusalCount {
        cause: AdapterRefusal::Protocol(cause),
        count,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_is_described_by_what_came_of_it() {
        let mut peer = Peer::default();
        assert_eq!(peer.state(), "nothing was sent and nothing came");
        let now = MonotonicClock::now();
        peer.spoken_to(now);
        assert_eq!(peer.state(), "never answered");
        peer.heard(Instant::from_ns(now.as_ns() - 2_000_000_000));
        assert!(
            peer.state().starts_with("silent for 2."),
            "{}",
            peer.state()
        );
    }
}
