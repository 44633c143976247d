//! What a run's records say of an arm: its sessions, when commands arrived, whether each joint
//! followed. It starts nothing.

use core::ops::Range;
use std::fs;

use hil_arm::egm::messages::{EgmArrival, EgmCommand, EgmEvent, EgmEventKind, EgmFeedback, Side};
use hil_arm::yumi::JOINT_COUNT;
use hil_core::run_log::RunLog;
use hil_rundir::record::{RecordFile, RecordKind};

use crate::trial::RunFiles;

/// The messages of a run.
#[derive(Debug)]
pub struct Arms {
    log: RunLog,
}

/// How one joint answered its commands over a while.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Follow {
    /// Half the way between the extremes of what was commanded, degrees.
    pub commanded_deg: f64,
    /// What was measured over what was commanded a moment before, by least squares: 1 for a joint
    /// that follows, negative for one that goes the other way.
    pub gain: f64,
}

impl Arms {
    /// Reads the messages in the record files of `files`.
    ///
    /// # Panics
    /// When the folder cannot be listed, or a file of messages is damaged.
    pub fn of(files: &RunFiles) -> Self {
        let folder = files.root().join("records");
        let entries = fs::read_dir(&folder);
        let entries = entries.unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
        let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
        paths.sort();
        let mut log = RunLog::default();
        for path in paths {
            match RecordFile::read(&path) {
                Ok(file) if file.header.kind == RecordKind::Message => {
                    file.append_messages(&mut log);
                }
                Ok(_) => {}
                Err(error) => panic!("{error}"),
            }
        }
        Self { log }
    }

    /// What happened to the sessions of `side`, in order.
    pub fn events(&self, side: Side) -> Vec<EgmEvent> {
        let events = self.log.messages::<EgmEvent>("egm/event");
        let events = events.map(|(_, event)| event);
        events
            .filter(|event| event.side as usize == side.index())
            .collect()
    }

    /// The events of `side` as a log says them, for the output of a test.
    pub fn history(&self, side: Side) -> String {
        let events = self.events(side);
        let lines = events.iter().map(|event| {
            let at_s = event.at_ns as f64 * 1e-9;
            format!("{at_s:.3} s  {}\n", event.describe())
        });
        lines.collect()
    }

    /// When commands for `side` arrived at the robot, nanoseconds of its clock.
    pub fn arrivals_ns(&self, side: Side) -> Vec<i64> {
        let arrivals = self.log.messages::<EgmArrival>("egm/received");
        let arrivals = arrivals.map(|(_, arrival)| arrival);
        let of_side = arrivals.filter(|arrival| arrival.side as usize == side.index());
        of_side.map(|arrival| arrival.at_ns).collect()
    }

    /// The commands of `side` with when they were published.
    pub fn commands(&self, side: Side) -> Vec<(i64, EgmCommand)> {
        let channel = format!("egm/{}/command", side.word());
        let messages = self.log.messages::<EgmCommand>(&channel);
        messages.map(|(at, one)| (at.as_ns(), one)).collect()
    }

    /// The feedback of `side` with when it was published.
    pub fn feedbacks(&self, side: Side) -> Vec<(i64, EgmFeedback)> {
        let channel = format!("egm/{}/feedback", side.word());
        let messages = self.log.messages::<EgmFeedback>(&channel);
        messages.map(|(at, one)| (at.as_ns(), one)).collect()
    }

    /// Which way each joint of `side` was commanded to go while the first one went up: its
    /// correlation with it, between -1 and 1.
    pub fn sense(&self, side: Side, window_ns: Range<i64>) -> [f64; JOINT_COUNT] {
        let commands = self.commands(side);
        let inside = commands.iter().filter(|(at, _)| window_ns.contains(at));
        let joints: Vec<_> = inside.map(|(_, command)| command.position_rad).collect();
        core::array::from_fn(|joint| {
            let pairs = |a: usize, b: usize| joints.iter().map(|q| (q[a], q[b])).collect();
            let (there, back) = (follow_of(pairs(0, joint)), follow_of(pairs(joint, 0)));
            there.gain.signum() * (there.gain * back.gain).sqrt()
        })
    }

    /// How each joint of `side` followed in `window_ns`, chain order. A joint
    /// is compared with its command `lag_ns` before.
    pub fn follow(&self, side: Side, window_ns: Range<i64>, lag_ns: i64) -> [Follow; JOINT_COUNT] {
        let commands = self.commands(side);
        let mut pairs: Vec<(EgmCommand, EgmFeedback)> = Vec::new();
        for (at_ns, feedback) in self.feedbacks(side) {
            let next = commands.partition_point(|(sent_ns, _)| *sent_ns <= at_ns - lag_ns);
            if window_ns.contains(&at_ns) && next > 0 {
                pairs.push((commands[next - 1].1, feedback));
            }
        }
        core::array::from_fn(|joint| {
            let values = pairs.iter().map(|(command, feedback)| {
                (command.position_rad[joint], feedback.measured_rad[joint])
            });
            follow_of(values.collect())
        })
    }
}

fn follow_of(pairs: Vec<(f64, f64)>) -> Follow {
    let count = pairs.len().max(1) as f64;
    let mean = |pick: fn(&(f64, f64)) -> f64| pairs.iter().map(pick).sum::<f64>() / count;
    let (mean_commanded, mean_measured) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let (mut variance, mut covariance) = (0.0, 0.0);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for (commanded, measured) in pairs {
        variance += (commanded - mean_commanded).powi(2);
        covariance += (commanded - mean_commanded) * (measured - mean_measured);
        (low, high) = (low.min(commanded), high.max(commanded));
    }
    Follow {
        commanded_deg: ((high - low) / 2.0).to_degrees(),
        gain: covariance / variance,
    }
}

/// The events of one kind.
pub fn of_kind(events: &[EgmEvent], kind: EgmEventKind) -> impl Iterator<Item = &EgmEvent> {
    events.iter().filter(move |event| event.kind == kind as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_joint_that_goes_the_other_way_has_a_negative_gain() {
        let wave = |step: i32| f64::from(step).sin();
        let pairs = (0..100)
            .map(|step| (0.1 * wave(step) + 1.0, -0.1 * wave(step)))
            .collect();
        let follow = follow_of(pairs);
        assert!((follow.gain + 1.0).abs() < 1e-9, "{follow:?}");
        assert!((follow.commanded_deg - 5.73).abs() < 0.02, "{follow:?}");
    }
}
