//! The robot once more: a finished run's arrivals go into a fresh robot in virtual time, and what
//! it reports is held against what was recorded. Network, processes and their timing play no part,
//! because the robot's motion does not depend on them beyond the arrivals.

use std::collections::VecDeque;

use crate::robot::Robot;
use crate::{
    EGM_EVENT, EGM_LEFT_COMMAND, EGM_LEFT_FEEDBACK, EGM_RECEIVED, EGM_RIGHT_COMMAND,
    EGM_RIGHT_FEEDBACK, MOTION_RECEIVED, MOTION_REQUEST,
};
use hil_arm::egm::messages::{
    EgmArrival, EgmCommand, EgmEvent, EgmEventKind, EgmFeedback, MotionArrival, MotionRequest, Side,
};
use hil_arm::egm::parameters::ControllerSettings;
use hil_core::component::{Emit, Role};
use hil_core::replay::Replay;
use hil_core::run_log::RunLog;
use hil_core::time::Instant;

/// Runs the robot of `settings` again from what `log` says it heard.
pub(crate) fn replay(settings: ControllerSettings, log: &RunLog) -> Replay {
    let mut replay = Replay {
        method: "the robot ran again in virtual time from its recorded start and arrivals; every \
                 recorded feedback was compared bit for bit with that of the same cycle"
            .to_owned(),
        gaps: gaps(log),
        ..Replay::default()
    };
    let Some(start) = starts(log).next() else {
        return replay;
    };
    let mut recorded = Recorded::read(log, start);
    let mut robot = Robot::new(settings).into_role();
    let ports = [EGM_RIGHT_FEEDBACK, EGM_LEFT_FEEDBACK].map(|name| robot.output(name));
    let end = recorded.end();
    let mut compare = |port: usize, payload: &[u8]| {
        if let Some(side) = Side::BOTH
            .into_iter()
            .find(|side| ports[side.index()] == port)
        {
            recorded.compare(side, &bytemuck::pod_read_unaligned(payload), &mut replay);
        }
    };
    robot.start(start);
    let mut input_count = 0;
    for (at, input) in arrivals(log, start) {
        run_until(robot.as_mut(), at, &mut compare);
        match input {
            Input::Command(Side::Right, command) => {
                robot.hear(at, EGM_RIGHT_COMMAND, &command, &mut compare);
            }
            Input::Command(Side::Left, command) => {
                robot.hear(at, EGM_LEFT_COMMAND, &command, &mut compare);
            }
            Input::Request(request) => robot.hear(at, MOTION_REQUEST, &request, &mut compare),
        }
        input_count += 1;
    }
    if let Some(end) = end {
        run_until(robot.as_mut(), end, &mut compare);
    }
    replay.input_count = input_count;
    recorded.note_the_rest(&mut replay);
    replay
}

/// Ticks `robot` at each of its grid points up to and including `until`.
fn run_until(robot: &mut dyn Role, until: Instant, hear: Emit<'_>) {
    while let Some(due) = robot.next_tick().filter(|due| *due <= until) {
        robot.tick(due, hear);
    }
}

/// What a robot hears.
#[derive(Debug)]
enum Input {
    Command(Side, EgmCommand),
    Request(MotionRequest),
}

/// When the robot started; more than one if its process was started anew.
fn starts(log: &RunLog) -> impl Iterator<Item = Instant> {
    let mut newest_ns = None;
    log.messages::<EgmEvent>(EGM_EVENT)
        .filter(|(_, event)| event.kind == EgmEventKind::Started as u32)
        // Each arm tells its start; both are one.
        .filter_map(move |(_, event)| {
            let is_new = newest_ns != Some(event.at_ns);
            newest_ns = Some(event.at_ns);
            is_new.then_some(Instant::from_ns(event.at_ns))
        })
}

/// The instant from which on another robot speaks, if the one started at `start` was replaced.
fn successor(log: &RunLog, start: Instant) -> Option<Instant> {
    starts(log).find(|other| *other > start)
}

/// What the robot started at `start` heard, in the order in which it matters: commands before
/// requests of the same instant, because a request is taken with the next cycle anyway.
fn arrivals(log: &RunLog, start: Instant) -> Vec<(Instant, Input)> {
    let commands = log
        .messages::<EgmArrival>(EGM_RECEIVED)
        .map(|(_, arrival)| {
            let is_right = arrival.side == Side::Right.number();
            let side = if is_right { Side::Right } else { Side::Left };
            let input = Input::Command(side, arrival.command);
            (Instant::from_ns(arrival.at_ns), input)
        });
    let requests = log
        .messages::<MotionArrival>(MOTION_RECEIVED)
        .map(|(_, arrival)| {
            let input = Input::Request(arrival.request);
            (Instant::from_ns(arrival.at_ns), input)
        });
    let until = successor(log, start);
    let mut arrivals: Vec<_> = commands
        .chain(requests)
        .filter(|(at, _)| *at >= start && until.is_none_or(|until| *at < until))
        .collect();
    // Stable: equal instants keep the order of the record.
    arrivals.sort_by_key(|(at, _)| *at);
    arrivals
}

/// What is missing for an exact replay.
fn gaps(log: &RunLog) -> Vec<String> {
    let mut gaps = Vec::new();
    match starts(log).count() {
        0 => gaps.push(format!("{EGM_EVENT} tells no start of the robot")),
        1 => {}
        count => gaps.push(format!(
            "the robot was started {count} times; only the first life was replayed"
        )),
    }
    for channel in [EGM_EVENT, EGM_RECEIVED, MOTION_RECEIVED] {
        let missing_count = missing_count(log, channel);
        if missing_count > 0 {
            gaps.push(format!("{missing_count} messages of {channel} are missing"));
        }
    }
    gaps
}

/// Messages that the sequence numbers of `channel` say there were, and the record has not.
fn missing_count(log: &RunLog, channel: &str) -> u64 {
    let (mut missing_count, mut epoch, mut expected) = (0, None, 0);
    for logged in log.raw(channel) {
        let envelope = &logged.envelope;
        if epoch != Some(envelope.epoch) {
            (epoch, expected) = (Some(envelope.epoch), 0);
        }
        missing_count += envelope.sequence.saturating_sub(expected);
        expected = envelope.sequence + 1;
    }
    missing_count
}

/// What one life of the robot reported, by arm, oldest first.
#[derive(Debug)]
struct Recorded([VecDeque<(Instant, EgmFeedback)>; 2]);

impl Recorded {
    fn read(log: &RunLog, start: Instant) -> Self {
        let until = successor(log, start);
        let read = |channel| {
            log.messages::<EgmFeedback>(channel)
                .take_while(|(at, _)| until.is_none_or(|until| *at < until))
                .collect()
        };
        Self([EGM_RIGHT_FEEDBACK, EGM_LEFT_FEEDBACK].map(read))
    }

    /// When the last one was published; all its cycles were due by then.
    fn end(&self) -> Option<Instant> {
        let last = self.0.iter().filter_map(VecDeque::back);
        last.map(|(at, _)| *at).max()
    }

    fn compare(&mut self, side: Side, replayed: &EgmFeedback, replay: &mut Replay) {
        let queue = &mut self.0[side.index()];
        // A robot that came late left cycles out of the record.
        let is_due = |next: &mut (Instant, EgmFeedback)| next.1.cycle_index <= replayed.cycle_index;
        while let Some((_, recorded)) = queue.pop_front_if(is_due) {
            replay.compared_count += 1;
            if let Some(difference) = difference(&recorded, replayed) {
                note(replay, side, recorded.cycle_index, &difference);
            }
        }
    }

    fn note_the_rest(&self, replay: &mut Replay) {
        for side in Side::BOTH {
            for (_, recorded) in &self.0[side.index()] {
                replay.compared_count += 1;
                let difference = "recorded, but the replay did not get there";
                note(replay, side, recorded.cycle_index, difference);
            }
        }
    }
}

fn note(replay: &mut Replay, side: Side, cycle_index: u64, difference: &str) {
    replay.different_count += 1;
    replay
        .first_difference
        .get_or_insert_with(|| format!("{} arm, cycle {cycle_index}: {difference}", side.word()));
}

/// The first thing in which two feedbacks differ, in words; joints first.
fn difference(recorded: &EgmFeedback, replayed: &EgmFeedback) -> Option<String> {
    let joints = [
        ("measured", &recorded.measured_rad, &replayed.measured_rad),
        ("planned", &recorded.planned_rad, &replayed.planned_rad),
    ];
    for (what, recorded, replayed) in joints {
        for (joint, (recorded, replayed)) in recorded.iter().zip(replayed).enumerate() {
            if recorded.to_bits() != replayed.to_bits() {
                return Some(format!(
                    "joint {joint} {what} as {recorded} rad, replayed as {replayed} rad"
                ));
            }
        }
    }
    let same = bytemuck::bytes_of(recorded) == bytemuck::bytes_of(replayed);
    (!same).then(|| {
        format!(
            "equal joints, but session {}, state {}, reference {} and {} queued became {}, {}, {} \
             and {}",
            recorded.session,
            recorded.state,
            recorded.reference_frame_index,
            recorded.queue_count,
            replayed.session,
            replayed.state,
            replayed.reference_frame_index,
            replayed.queue_count,
        )
    })
}

#[cfg(test)]
#[path = "replay_tests.rs"]
mod tests;
