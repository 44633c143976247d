//! One controller on its grid, a list of arrivals, and what came out.

use bytemuck::Zeroable;

use crate::egm::controller::Controller;
use crate::egm::messages::{
    EgmCommand, EgmEvent, EgmEventKind, EgmFeedback, EndCause, SessionState, Side,
};
use crate::egm::parameters::{ControllerSettings, Preset, StartMode};
use crate::yumi::arm::RIGHT_START_RAD;
use crate::yumi::{Joints, Pose};
use hil_core::time::{Instant, duration_ns};

/// Length of the seed paper's motion loop.
pub(super) const PERIOD_S: f64 = 4.033;
/// Of the first joint's swing.
pub(super) const AMPLITUDE_RAD: f64 = 0.3;

/// Nothing trips, nothing throttles, nothing delays, and the session starts at once.
pub(super) fn open_settings() -> ControllerSettings {
    ControllerSettings {
        start: StartMode::PowerOn,
        activation_s: 0.0,
        ramp_in_s: 0.0,
        control_delay_cycles: 0,
        condition_time_s: 1e6,
        comm_timeout_s: 1e6,
        ..ControllerSettings::of(Preset::Paper)
    }
}

/// Where the human is at `time_s`: the first joint swings.
pub(super) fn swing(time_s: f64, has_speed: bool) -> EgmCommand {
    let omega = core::f64::consts::TAU / PERIOD_S;
    let mut command = standing();
    command.position_rad[0] += AMPLITUDE_RAD * (omega * time_s).sin();
    if has_speed {
        command.speed_rad_per_s[0] = AMPLITUDE_RAD * omega * (omega * time_s).cos();
        command.flags = EgmCommand::HAS_SPEED;
    }
    command
}

/// Stay at the start.
pub(super) fn standing() -> EgmCommand {
    EgmCommand {
        position_rad: RIGHT_START_RAD,
        ..EgmCommand::zeroed()
    }
}

pub(super) fn at_s(seconds: f64) -> Instant {
    #[allow(clippy::cast_possible_truncation, reason = "seconds of a test")]
    Instant::from_ns((seconds * 1e9).round() as i64)
}

#[derive(Debug, Clone)]
pub(super) struct Rig {
    pub(super) controller: Controller,
    pub(super) events: Vec<EgmEvent>,
    cycle_ns: i64,
    next_ns: i64,
}

impl Rig {
    pub(super) fn new(settings: ControllerSettings) -> Self {
        Self {
            controller: Controller::new(Side::Right, settings, RIGHT_START_RAD),
            events: Vec::new(),
            cycle_ns: duration_ns(settings.cycle),
            next_ns: 0,
        }
    }

    /// Grid time of the next cycle.
    pub(super) fn next_at(&self) -> Instant {
        Instant::from_ns(self.next_ns)
    }

    pub(super) fn next_s(&self) -> f64 {
        self.next_ns as f64 * 1e-9
    }

    pub(super) fn step(&mut self) -> EgmFeedback {
        let at = self.next_at();
        self.controller
            .cycle(at, &mut |event| self.events.push(event));
        self.next_ns += self.cycle_ns;
        self.feedback()
    }

    pub(super) fn feedback(&self) -> EgmFeedback {
        self.controller.feedback(&Pose::zeroed())
    }

    pub(super) fn receive_at(&mut self, ns: i64, command: &EgmCommand) {
        assert_eq!(
            self.controller.receive(Instant::from_ns(ns), command),
            Ok(())
        );
    }

    /// Goes on up to `until_s`, commanding `source` at the middle of every `every`-th cycle as
    /// long as it gives something.
    pub(super) fn drive(
        &mut self,
        until_s: f64,
        every: i64,
        mut source: impl FnMut(f64) -> Option<EgmCommand>,
    ) -> Vec<EgmFeedback> {
        let mut feedback = Vec::new();
        while self.next_s() < until_s {
            let sent_ns = self.next_ns - self.cycle_ns / 2;
            let is_due = sent_ns > 0 && (self.next_ns / self.cycle_ns) % every == 0;
            if let Some(command) = is_due.then(|| source(sent_ns as f64 * 1e-9)).flatten() {
                self.receive_at(sent_ns, &command);
            }
            feedback.push(self.step());
        }
        feedback
    }

    /// Goes on without commands up to `until_s`.
    pub(super) fn silence(&mut self, until_s: f64) -> Vec<EgmFeedback> {
        self.drive(until_s, 1, |_| None)
    }

    pub(super) fn state(&self) -> SessionState {
        self.controller.state()
    }

    pub(super) fn of_kind(&self, kind: EgmEventKind) -> Vec<EgmEvent> {
        let events = self.events.iter();
        events
            .filter(|event| event.kind == kind as u32)
            .copied()
            .collect()
    }

    pub(super) fn ends(&self) -> Vec<(EndCause, EgmEvent)> {
        let ended = self.of_kind(EgmEventKind::Ended).into_iter();
        ended
            .map(|event| (EndCause::from_number(event.cause).unwrap(), event))
            .collect()
    }

    pub(super) fn lines(&self) -> Vec<String> {
        self.events.iter().map(EgmEvent::describe).collect()
    }
}

/// True when the joints do not move from one to the next.
pub(super) fn is_still(a: &Joints, b: &Joints) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
}
