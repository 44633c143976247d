//! What happens to the arms while a run goes: what their sessions tell, and holds.

use super::lost::severity_of;
use crate::{EGM_EVENT, EGM_LEFT_FEEDBACK, EGM_RIGHT_FEEDBACK};
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EgmFeedback};
use hil_core::score::{LiveEvents, ScoreEvent, Severity};
use hil_core::time::Instant;

/// The events of both arms.
#[derive(Debug, Default)]
pub(crate) struct ArmEvents {
    /// Since when the right and the left arm hold.
    holds: [Option<Instant>; 2],
    found: Vec<ScoreEvent>,
}

impl ArmEvents {
    fn feedback(&mut self, index: usize, at: Instant, feedback: &EgmFeedback) {
        let (arm, channel) = [("right", EGM_RIGHT_FEEDBACK), ("left", EGM_LEFT_FEEDBACK)][index];
        let hold = &mut self.holds[index];
        let (severity, what) = match (*hold, feedback.has(EgmFeedback::HOLDING)) {
            (None, true) => {
                *hold = Some(at);
                let what = format!("{arm} arm holds for want of commands");
                (Severity::Hazard, what)
            }
            (Some(since), false) => {
                *hold = None;
                let held_s = at.seconds_since(since);
                let what = format!("{arm} arm goes on after a hold of {held_s:.3} s");
                (Severity::Notice, what)
            }
            (None, false) | (Some(_), true) => return,
        };
        self.found
            .push(ScoreEvent::new(severity, at, channel, what));
    }
}

impl LiveEvents for ArmEvents {
    fn channels(&self) -> &'static [&'static str] {
        &[EGM_EVENT, EGM_RIGHT_FEEDBACK, EGM_LEFT_FEEDBACK]
    }

    fn hear(&mut self, channel: &str, at: Instant, payload: &[u8]) {
        if channel != EGM_EVENT {
            if let Ok(feedback) = bytemuck::try_pod_read_unaligned(payload) {
                self.feedback(usize::from(channel == EGM_LEFT_FEEDBACK), at, &feedback);
            }
        } else if let Ok(told) = bytemuck::try_pod_read_unaligned::<EgmEvent>(payload) {
            let kind = EgmEventKind::from_number(told.kind);
            // The feedback tells of holds, also of an arm behind an adapter.
            if let Some(EgmEventKind::HoldBegan | EgmEventKind::HoldEnded) = kind {
                return;
            }
            let (at, what) = (Instant::from_ns(told.at_ns), told.describe());
            let event = ScoreEvent::new(severity_of(&told), at, EGM_EVENT, what);
            self.found.push(event);
        }
    }

    fn take(&mut self, _now: Instant) -> Vec<ScoreEvent> {
        core::mem::take(&mut self.found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_arm::egm::messages::EndCause;

    #[test]
    fn holds_are_told_when_they_begin_and_end_and_sessions_as_their_events_say() {
        let mut events = ArmEvents::default();
        let ms = |at_ms: i64| Instant::from_ns(at_ms * 1_000_000);
        let mut feedback: EgmFeedback = bytemuck::Zeroable::zeroed();
        for (at_ms, flags) in [
            (0, 0),
            (4, EgmFeedback::HOLDING),
            (8, EgmFeedback::HOLDING),
            (16, 0),
        ] {
            feedback.flags = flags;
            events.hear(EGM_LEFT_FEEDBACK, ms(at_ms), bytemuck::bytes_of(&feedback));
        }
        let mut ended: EgmEvent = bytemuck::Zeroable::zeroed();
        for (at_ms, kind) in [(4, EgmEventKind::HoldBegan), (16, EgmEventKind::HoldEnded)] {
            ended.kind = kind as u32;
            ended.at_ns = ms(at_ms).as_ns();
            events.hear(EGM_EVENT, ms(at_ms), bytemuck::bytes_of(&ended));
        }
        ended.kind = EgmEventKind::Ended as u32;
        ended.cause = EndCause::CommTimeout as u32;
        ended.at_ns = 20_000_000;
        events.hear(EGM_EVENT, ms(21), bytemuck::bytes_of(&ended));
        let found = events.take(ms(30));
        let told: Vec<_> = found.iter().map(|one| (one.severity, one.at)).collect();
        let expected = [
            (Severity::Hazard, ms(4)),
            (Severity::Notice, ms(16)),
            (Severity::Hazard, ms(20)),
        ];
        assert_eq!(told, expected);
        assert_eq!(found[1].what, "left arm goes on after a hold of 0.012 s");
        assert!(events.take(ms(40)).is_empty());
    }
}
