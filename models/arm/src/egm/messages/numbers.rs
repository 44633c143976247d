//! The numbers of the messages' enumerations, read back. Writing needs nothing: `as u32`.

use crate::egm::messages::{
    CommandRefusal, EgmEventKind, EndCause, MotionKind, MotionOutcome, MotionRefusal, Side,
};

impl Side {
    /// The side with this number, see [`Side::index`].
    pub fn from_index(index: u32) -> Option<Self> {
        Self::BOTH
            .into_iter()
            .find(|side| side.index() as u64 == u64::from(index))
    }
}

macro_rules! read_back {
    ($($kind:ident: $what:literal, [$($variant:ident),+ $(,)?];)+) => {$(
        impl $kind {
            #[doc = concat!("The ", $what, " with this number.")]
            pub fn from_number(number: u32) -> Option<Self> {
                [$(Self::$variant),+].into_iter().find(|known| *known as u32 == number)
            }
        }
    )+};
}

read_back! {
    EgmEventKind: "kind of event", [
        Started, Activating, Running, Ended, SpeedThrottled, SpeedFree, HoldBegan, HoldEnded,
        CommandRefused, QueueOverflow, MotionBegan, MotionEnded,
    ];
    EndCause: "cause", [CommTimeout, ConditionTime, PositionDeviation, Requested];
    CommandRefusal: "refusal", [NotFinite, OutsideLimits, NoSession];
    MotionKind: "kind of request", [
        GetState, MoveJoints, MoveLinear, EgmStart, EgmStop, Home,
    ];
    MotionOutcome: "outcome", [Accepted, Done, Refused, Interrupted];
    MotionRefusal: "refusal", [
        UnknownKind, NoArm, BadNumber, OutsideLimits, Unreachable, Busy, GuidedMotionRuns,
    ];
}

impl MotionKind {
    /// A few words for a log line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::GetState => "state",
            Self::MoveJoints => "joint motion",
            Self::MoveLinear => "linear motion",
            Self::EgmStart => "start of guided motion",
            Self::EgmStop => "stop of guided motion",
            Self::Home => "motion to the home posture",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::egm::messages::SessionState;

    /// Numbers `from..to` must read back as themselves, those around as nothing.
    fn check<T>(from: u32, to: u32, read: fn(u32) -> Option<T>, number: fn(T) -> u32) {
        for candidate in 0..50 {
            let known = (from..to).contains(&candidate).then_some(candidate);
            assert_eq!(read(candidate).map(number), known);
        }
        assert!(read(u32::MAX).is_none());
    }

    #[test]
    fn every_number_reads_back_as_the_one_written() {
        check(0, 12, EgmEventKind::from_number, |kind| kind as u32);
        check(1, 5, EndCause::from_number, |cause| cause as u32);
        check(1, 4, CommandRefusal::from_number, |refusal| refusal as u32);
        check(0, 6, MotionKind::from_number, |kind| kind as u32);
        check(1, 5, MotionOutcome::from_number, |outcome| outcome as u32);
        check(1, 8, MotionRefusal::from_number, |refusal| refusal as u32);
        check(0, 6, SessionState::from_number, |state| state as u32);
        check(0, 2, Side::from_index, |side| match side {
            Side::Right => 0,
            Side::Left => 1,
        });
    }
}
