//! Inverse kinematics of one arm: damped least squares within joint limits. It plans no path and
//! avoids no obstacle.
//!
//! The step is Levenberg-Marquardt with error-sized damping (Sugihara 2011, equation 29):
//! `dq = h + J^T (J J^T + l I)^-1 (e - J h)` with `l = |e|^2 / 2 + l_min` and `h` the pull of the
//! redundant joint towards the start posture, which the last factor keeps out of the task.

use nalgebra::{Isometry3, Matrix6, Vector6};

use crate::yumi::Joints;
use crate::yumi::arm::{
    Chain, ChainState, Jacobian, JointVector, SPEED_MAX_RAD_PER_S, stacked, within_limits,
};

/// A target counts as reached within this distance, metres.
pub const TOLERANCE_M: f64 = 1e-5;

/// A target counts as reached within this angle, radians.
pub const TOLERANCE_RAD: f64 = 1e-4;

/// Share of the way to the start posture that the redundant joint is pulled per call.
const POSTURE_GAIN: f64 = 0.02;

const DAMPING_MIN: f64 = 1e-9;
const TRACKING_ITERATIONS_MAX: usize = 3;

/// What is left to go: metres (rows 0..3) and radians (rows 3..6), in the arm's base frame.
type Task = Vector6<f64>;

/// How a target was met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// Within tolerance.
    Reached,
    /// On the way: a joint's speed or position limit binds, or the target is farther than a few
    /// iterations lead.
    Approaching,
    /// No step of the joints brings the tool nearer: the arm holds.
    Unreachable,
}

/// Follows a moving target from wherever the joints are.
#[derive(Debug, Clone)]
pub struct Tracker {
    chain: Chain,
    posture_rad: JointVector,
    q_rad: JointVector,
}

impl Tracker {
    /// Starts at `q_rad`, which is also the posture the redundant joint is pulled to. A joint
    /// beyond its limits, as a real arm may report it, counts as at its limit.
    pub fn new(chain: Chain, q_rad: Joints) -> Self {
        let (q_rad, _) = within_limits(&q_rad.into());
        Self {
            chain,
            posture_rad: q_rad,
            q_rad,
        }
    }

    /// Goes on from `q_rad`, or the limits it is beyond; the posture the redundant joint is pulled
    /// to stays.
    pub fn restart_at(&mut self, q_rad: Joints) {
        self.q_rad = within_limits(&q_rad.into()).0;
    }

    /// The joint positions of the last call.
    pub fn q_rad(&self) -> &Joints {
        self.q_rad.as_ref()
    }

    /// Moves the joints towards `target` (arm base frame), at most as far as their speed limits
    /// allow in `elapsed_s`.
    pub fn track(&mut self, target: &Isometry3<f64>, elapsed_s: f64) -> Reach {
        let start = self.q_rad;
        let (mut q, mut state) = (start, self.chain.at(start.as_ref()));
        let mut error = task_error(&state, target);
        let start_cost = cost(&error);
        for iteration in 0..TRACKING_ITERATIONS_MAX {
            // Only the first step is pulled: the later ones correct what the pull disturbed.
            let gain = if iteration == 0 { POSTURE_GAIN } else { 0.0 };
            let pull = gain * (self.posture_rad - q);
            let Some(step) = damped_step(&state.jacobian(), &error, &pull) else {
                return Reach::Unreachable;
            };
            q = within_limits(&(q + step)).0;
            state = self.chain.at(q.as_ref());
            error = task_error(&state, target);
            if is_within(&error, 0.01) {
                break;
            }
        }
        let share = share_within_speed(&start, &q, elapsed_s);
        if share < 1.0 {
            q = start + share * (q - start);
            error = task_error(&self.chain.at(q.as_ref()), target);
        }
        // A speed limit may leave little of a step; an unlimited one that gains little is stuck.
        let remaining_max = if share < 1.0 { 1.0 } else { 0.25 };
        let reach = if is_within(&error, 1.0) {
            Reach::Reached
        } else if cost(&error) < remaining_max * start_cost {
            Reach::Approaching
        } else {
            // Also where a comparison fails because the target is beyond arithmetic.
            Reach::Unreachable
        };
        if reach != Reach::Unreachable {
            self.q_rad = q;
        }
        reach
    }
}

fn task_error(state: &ChainState, target: &Isometry3<f64>) -> Task {
    let tool = state.tool();
    let linear = target.translation.vector - tool.translation.vector;
    let turn = target.rotation * tool.rotation.inverse();
    stacked(&linear, &turn.scaled_axis())
}

fn is_within(error: &Task, factor: f64) -> bool {
    error.fixed_rows::<3>(0).norm() <= factor * TOLERANCE_M
        && error.fixed_rows::<3>(3).norm() <= factor * TOLERANCE_RAD
}

fn cost(error: &Task) -> f64 {
    0.5 * error.norm_squared()
}

/// How far one step moves the joints; see the module's formula. `None` when the target is not a
/// pose of numbers.
fn damped_step(jacobian: &Jacobian, error: &Task, pull: &JointVector) -> Option<JointVector> {
    let damping = Matrix6::from_diagonal_element(cost(error) + DAMPING_MIN);
    let gram = jacobian * jacobian.transpose() + damping;
    let weights = gram.cholesky()?.solve(&(error - jacobian * pull));
    Some(pull + jacobian.tr_mul(&weights))
}

/// The largest share of the way from `start` to `goal`, at most 1, that every joint's speed limit
/// allows in `elapsed_s`.
fn share_within_speed(start: &JointVector, goal: &JointVector, elapsed_s: f64) -> f64 {
    let steps = goal - start;
    steps
        .iter()
        .zip(&SPEED_MAX_RAD_PER_S)
        .map(|(step, speed_max)| speed_max * elapsed_s / step.abs())
        .fold(1.0, f64::min)
}

#[cfg(test)]
#[path = "inverse_tests.rs"]
mod tests;
