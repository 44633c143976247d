//! Events in words.

use bytemuck::Zeroable;

use crate::egm::messages::{CommandRefusal, EgmEvent, EgmEventKind, EndCause, MotionKind};

fn check(kind: EgmEventKind, cause: u32, value: f64, limit: f64, count: u64, expected: &str) {
    let event = EgmEvent {
        kind: kind as u32,
        cause,
        value,
        limit,
        count,
        session: 3,
        side: 1,
        ..EgmEvent::zeroed()
    };
    assert_eq!(event.describe(), expected);
}

#[test]
fn every_kind_of_event_says_what_happened() {
    use EgmEventKind as Kind;
    check(Kind::Started, 0, 0.0, 0.0, 0, "left arm: robot started");
    check(
        Kind::Activating,
        0,
        0.5,
        0.0,
        0,
        "left arm: EGM session 3: guided motion is being set up for 0.5 s",
    );
    check(
        Kind::Running,
        0,
        2.0,
        0.0,
        0,
        "left arm: EGM session 3: guided motion runs, 2 s after the last session ended",
    );
    check(
        Kind::SpeedThrottled,
        0,
        34.2,
        1.0,
        0,
        "left arm: EGM session 3: all joints are slowed: 34.2 deg/s asked (MaxSpeedDeviation = 1 deg/s)",
    );
    check(
        Kind::SpeedFree,
        0,
        31.25,
        1.0,
        12_000_000_000,
        "left arm: EGM session 3: joints are slowed no more, after 12 s with up to 31.25 deg/s asked \
         (MaxSpeedDeviation = 1 deg/s)",
    );
    check(
        Kind::HoldBegan,
        0,
        0.044,
        0.04,
        0,
        "left arm: EGM session 3: no command for 0.044 s: the last one goes on acting",
    );
    check(
        Kind::HoldEnded,
        0,
        1.25,
        0.0,
        0,
        "left arm: EGM session 3: commands are back after 1.25 s without",
    );
    check(
        Kind::QueueOverflow,
        0,
        0.0,
        1000.0,
        7,
        "left arm: EGM session 3: the queue is full (1000 commands): 7 dropped so far",
    );
    check(
        Kind::MotionBegan,
        MotionKind::Home as u32,
        0.0,
        0.0,
        0,
        "left arm: motion to the home posture began",
    );
    check(
        Kind::MotionEnded,
        MotionKind::MoveLinear as u32,
        2.5,
        0.0,
        0,
        "left arm: linear motion ended after 2.5 s",
    );
}

#[test]
fn every_end_names_the_makers_parameter() {
    for (cause, value, limit, count, expected) in [
        (
            EndCause::CommTimeout,
            1.004,
            1.0,
            0,
            "no message for 1.004 s (CommTimeout = 1 s)",
        ),
        (
            EndCause::ConditionTime,
            1.0,
            1.0,
            0,
            "every joint stayed within the convergence window of its order for 1 s (CondTime = 1 s)",
        ),
        (
            EndCause::PositionDeviation,
            -30.25,
            30.0,
            2,
            "joint 7 is -30.25 deg from where the session started (MaxPosDeviation = 30 deg)",
        ),
        (
            EndCause::Requested,
            0.052,
            0.0,
            0,
            "stopped by request, within 0.052 s",
        ),
    ] {
        let expected = format!("left arm: EGM session 3 ended: {expected}");
        check(
            EgmEventKind::Ended,
            cause as u32,
            value,
            limit,
            count,
            &expected,
        );
    }
}

#[test]
fn numbers_of_another_version_are_told_as_numbers() {
    check(
        EgmEventKind::Ended,
        77,
        0.0,
        0.0,
        0,
        "left arm: EGM session 3 ended: unknown cause 77",
    );
    check(
        EgmEventKind::CommandRefused,
        CommandRefusal::NotFinite as u32,
        f64::NAN,
        0.0,
        99,
        "left arm: EGM session 3: command refused: joint ? of it is NaN, no finite number",
    );
    let mut event = EgmEvent {
        kind: 77,
        side: 9,
        ..EgmEvent::zeroed()
    };
    assert_eq!(event.describe(), "unknown arm: event of unknown kind 77");
    event.kind = EgmEventKind::MotionBegan as u32;
    event.cause = 77;
    assert_eq!(event.describe(), "unknown arm: unknown motion began");
}
