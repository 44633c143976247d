//! The robot maker's datagrams, and sessions of them with our adapters.

use std::time::Duration;

use hil_arm::egm::adapter::{
    Axes, RobotAdapter, RobotAdapterSettings, RobotWare, SendPolicy, SensorAdapter,
    SensorAdapterSettings,
};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback, SessionState, Side};
use hil_arm::egm::wire::{
    DATAGRAM_BYTES_MAX, decode_path_correction, decode_robot, decode_sensor, encode, message_type,
};
use hil_arm::yumi::arm::{POSITION_MAX_RAD, POSITION_MIN_RAD, RIGHT_START_RAD};
use hil_core::time::Instant;

use crate::Verdict;
use crate::input::Input;

/// What was decoded is encoded as bytes that decode to the same bytes, and no longer ones than the
/// decoder takes wherever the input had no more.
pub(crate) fn datagrams(bytes: &[u8]) -> Verdict {
    let mut buffer = Vec::new();
    let mut accepted_count = 0;
    macro_rules! check {
        ($decode:path) => {
            if let Ok(message) = $decode(bytes) {
                accepted_count += 1;
                assert!(bytes.len() <= DATAGRAM_BYTES_MAX);
                encode(&message, &mut buffer);
                // Numbers that are required and were missing are there now.
                if let Ok(again) = $decode(&buffer) {
                    let mut second = Vec::new();
                    encode(&again, &mut second);
                    assert_eq!(second, buffer, "decoding and encoding changes the bytes");
                } else {
                    assert!(buffer.len() > DATAGRAM_BYTES_MAX, "own bytes are refused");
                }
            }
        };
    }
    check!(decode_sensor);
    check!(decode_robot);
    check!(decode_path_correction);
    if message_type(bytes).is_some() {
        assert!(bytes.len() <= DATAGRAM_BYTES_MAX);
    }
    Verdict::of(accepted_count > 0)
}

/// Datagrams in a row, each with its length before it: the first byte says to which adapter. What is
/// taken is finite and within what the arm can be, and every datagram is counted once.
pub(crate) fn session(bytes: &[u8]) -> Verdict {
    let mut input = Input::new(bytes);
    let mode = input.byte();
    let axes = if mode & 1 == 0 {
        Axes::Six
    } else {
        Axes::Seven
    };
    if mode & 2 == 0 {
        to_the_robot(axes, input)
    } else {
        to_the_sensor(axes, mode & 4 != 0, input)
    }
}

fn to_the_robot(axes: Axes, mut input: Input<'_>) -> Verdict {
    let mut adapter = RobotAdapter::new(RobotAdapterSettings {
        side: Side::Right,
        axes,
        robotware: RobotWare::Six,
        cycle: Duration::from_millis(4),
        planned_lead: Duration::from_millis(16),
    });
    let (mut count, mut taken_count, mut buffer) = (0, 0, Vec::new());
    let mut cycle_index = 0_u32;
    while !input.is_empty() {
        let length = usize::from(input.short());
        if length & 0x8000 != 0 {
            cycle_index += 1;
            let session = u32::from(length & 0x4000 != 0) + 1;
            let _is_told =
                adapter.encode(&feedback(cycle_index, session), Duration::ZERO, &mut buffer);
            continue;
        }
        let datagram = input.take(length);
        count += 1;
        if let Ok(command) = adapter.decode(datagram) {
            taken_count += 1;
            let EgmCommand {
                position_rad,
                speed_rad_per_s,
                ..
            } = command;
            let numbers = position_rad.iter().chain(&speed_rad_per_s);
            assert!(
                numbers.clone().all(|number| number.is_finite()),
                "{command:?}"
            );
            let limits = POSITION_MIN_RAD.iter().zip(&POSITION_MAX_RAD);
            let mut places = position_rad.iter().zip(limits);
            assert!(
                places.all(|(place, (min, max))| (min..=max).contains(&place)),
                "no arm gets there: {command:?}"
            );
        }
    }
    assert_eq!(adapter.received().total(), count);
    assert_eq!(adapter.received().accepted(), taken_count);
    let refused: u64 = adapter.received().causes().map(|(_, count)| count).sum();
    assert_eq!(refused + taken_count, count, "a refusal without a cause");
    Verdict::of(taken_count > 0)
}

fn to_the_sensor(axes: Axes, is_free: bool, mut input: Input<'_>) -> Verdict {
    let policy = if is_free {
        SendPolicy::Free {
            period: Duration::from_millis(4),
        }
    } else {
        SendPolicy::Coupled {
            patience: Duration::from_millis(24),
        }
    };
    let mut adapter = SensorAdapter::new(SensorAdapterSettings {
        axes,
        held_rad: 0.0,
        policy,
    });
    let mut now = Instant::from_ns(1_000_000_000);
    let (mut count, mut taken_count, mut buffer) = (0, 0, Vec::new());
    while !input.is_empty() {
        let length = usize::from(input.short());
        now = now + Duration::from_millis(4);
        let datagram = input.take(length);
        count += 1;
        if let Ok(feedback) = adapter.decode(now, datagram) {
            taken_count += 1;
            let EgmFeedback {
                measured_rad,
                planned_rad,
                ..
            } = feedback;
            let numbers = measured_rad.iter().chain(&planned_rad);
            assert!(
                numbers.clone().all(|number| number.is_finite()),
                "{feedback:?}"
            );
            assert!(feedback.session_state().is_some());
        }
        while adapter.poll_transmit(now, &mut buffer) {
            decode_sensor(&buffer).expect("our own datagram is one");
        }
    }
    assert_eq!(adapter.received().total(), count);
    assert_eq!(adapter.received().accepted(), taken_count);
    Verdict::of(taken_count > 0)
}

/// A feedback of a session under way.
pub(crate) fn feedback(cycle_index: u32, session: u32) -> EgmFeedback {
    EgmFeedback {
        cycle_index: u64::from(cycle_index),
        reference_frame_index: 0,
        reference_age_ns: 0,
        measured_rad: RIGHT_START_RAD,
        planned_rad: RIGHT_START_RAD,
        tool: hil_arm::yumi::arm::Arm::right()
            .tool(&RIGHT_START_RAD)
            .into(),
        clock_ms: 4 * cycle_index,
        seqno: cycle_index,
        session,
        state: SessionState::Running as u32,
        queue_count: 0,
        flags: 0,
    }
}
