//! Inverse kinematics of one arm: damped least squares within joint limits. It plans no path and
//! avoids no obstacle.
//!
//! The step is Levenberg-Marquardt with error-sized damping (Sugihara 2011, equation 29):
//! `dq = h + J^T (J J^T + l I)^-1 (e - J h)` with `l = |e|^2 / 2 + l_min` and `h` the pull of the
//! redundant joint towards the start posture, which the last factor keeps out of the task.

use crate::random::RandomStream;
use crate::teleoperation::arm::{
    Chain, ChainState, Jacobian, POSITION_MAX_RAD, POSITION_MIN_RAD, SPEED_MAX_RAD_PER_S,
    within_limits,
};
use crate::teleoperation::messages::Joints;
use crate::teleoperation::spatial::{Pose, length, subtract};

/// A target counts as reached within this distance, metres.
pub const TOLERANCE_M: f64 = 1e-5;

/// A target counts as reached within this angle, radians.
pub const TOLERANCE_RAD: f64 = 1e-4;

/// Share of the way to the start posture that the redundant joint is pulled per call.
const POSTURE_GAIN: f64 = 0.02;

const DAMPING_MIN: f64 = 1e-9;
const TRACKING_ITERATIONS_MAX: usize = 3;
const SEARCH_ITERATIONS_MAX: usize = 60;

type Task = [f64; 6];

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
    posture_rad: Joints,
    q_rad: Joints,
}

impl Tracker {
    /// Starts at `q_rad`, which is also the posture the redundant joint is pulled to.
    pub fn new(chain: Chain, q_rad: Joints) -> Self {
        Self {
            chain,
            posture_rad: q_rad,
            q_rad,
        }
    }

    /// The joint positions of the last call.
    pub fn q_rad(&self) -> &Joints {
        &self.q_rad
    }

    /// Moves the joints towards `target` (arm base frame), at most as far as their speed limits
    /// allow in `elapsed_s`.
    pub fn track(&mut self, target: &Pose, elapsed_s: f64) -> Reach {
        let start = self.q_rad;
        let (mut q, mut state) = (start, self.chain.at(&start));
        let mut error = task_error(&state, target);
        let start_cost = cost(&error);
        for iteration in 0..TRACKING_ITERATIONS_MAX {
            // Only the first step is pulled: the later ones correct what the pull disturbed.
            let gain = if iteration == 0 { POSTURE_GAIN } else { 0.0 };
            let pull = combine(&self.posture_rad, &q, |posture, q| gain * (posture - q));
            q = within_limits(&damped_step(&state.jacobian(), &error, &q, &pull)).0;
            state = self.chain.at(&q);
            error = task_error(&state, target);
            if is_within(&error, 0.01) {
                break;
            }
        }
        let share = share_within_speed(&start, &q, elapsed_s);
        if share < 1.0 {
            q = combine(&start, &q, |from, to| from + share * (to - from));
            error = task_error(&self.chain.at(&q), target);
        }
        // A speed limit may leave little of a step; an unlimited one that gains little is stuck.
        let remaining_max = if share < 1.0 { 1.0 } else { 0.25 };
        let reach = if is_within(&error, 1.0) {
            Reach::Reached
        } else if cost(&error) < remaining_max * start_cost {
            Reach::Approaching
        } else {
            // Also where the comparison fails because the target is not a number.
            Reach::Unreachable
        };
        if reach != Reach::Unreachable {
            self.q_rad = q;
        }
        reach
    }
}

/// What a search found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solution {
    /// Joint positions within limits, chain order.
    pub q_rad: Joints,
    /// Random starts it took beyond the first.
    pub restart_count: u32,
}

/// Joint positions that put the tool at `target` (arm base frame) from anywhere: starts at
/// `seed_rad`, then at up to `restarts_max` random postures.
///
/// `None` means not found; with 50 restarts that happened to 10 of 20 000
/// random reachable poses.
pub fn search(
    chain: Chain,
    target: &Pose,
    seed_rad: &Joints,
    restarts_max: u32,
    random: &mut RandomStream,
) -> Option<Solution> {
    let mut q = *seed_rad;
    for restart_count in 0..=restarts_max {
        if let Some(q_rad) = descend(chain, target, q) {
            return Some(Solution {
                q_rad,
                restart_count,
            });
        }
        q = random_posture(random);
    }
    None
}

/// A posture with every joint uniform within its limits.
pub fn random_posture(random: &mut RandomStream) -> Joints {
    combine(&POSITION_MIN_RAD, &POSITION_MAX_RAD, |min, max| {
        min + (max - min) * random.uniform()
    })
}

fn descend(chain: Chain, target: &Pose, mut q: Joints) -> Option<Joints> {
    let mut best_cost = f64::INFINITY;
    let mut stalled_count = 0;
    for _ in 0..SEARCH_ITERATIONS_MAX {
        let state = chain.at(&q);
        let error = task_error(&state, target);
        if is_within(&error, 1.0) {
            return Some(q);
        }
        let cost = cost(&error);
        if cost < 0.98 * best_cost {
            best_cost = cost;
            stalled_count = 0;
        } else {
            stalled_count += 1;
            if stalled_count > 8 {
                return None;
            }
        }
        q = within_limits(&damped_step(&state.jacobian(), &error, &q, &[0.0; 7])).0;
    }
    None
}

fn task_error(state: &ChainState, target: &Pose) -> Task {
    let tool = state.tool();
    let [x, y, z] = subtract(target.position_m, tool.position_m);
    let turn = target.orientation.after(tool.orientation.inverse());
    let [rx, ry, rz] = turn.rotation_vector();
    [x, y, z, rx, ry, rz]
}

fn is_within(error: &Task, factor: f64) -> bool {
    let [x, y, z, rx, ry, rz] = *error;
    length([x, y, z]) <= factor * TOLERANCE_M && length([rx, ry, rz]) <= factor * TOLERANCE_RAD
}

fn cost(error: &Task) -> f64 {
    0.5 * error.iter().map(|part| part * part).sum::<f64>()
}

fn combine(a: &Joints, b: &Joints, mut f: impl FnMut(f64, f64) -> f64) -> Joints {
    core::array::from_fn(|joint| f(a[joint], b[joint]))
}

/// The joints after one step; see the module's formula.
fn damped_step(jacobian: &Jacobian, error: &Task, q: &Joints, pull: &Joints) -> Joints {
    let mut rest = *error;
    let mut gram = [[0.0; 6]; 6];
    for (column, pull) in jacobian.iter().zip(pull) {
        for row in 0..6 {
            rest[row] -= column[row] * pull;
            for other in 0..=row {
                gram[row][other] += column[row] * column[other];
            }
        }
    }
    let damping = cost(error) + DAMPING_MIN;
    for (row, line) in gram.iter_mut().enumerate() {
        line[row] += damping;
    }
    let weights = solve_positive(gram, rest);
    let mut stepped = combine(q, pull, |q, pull| q + pull);
    for (q, column) in stepped.iter_mut().zip(jacobian) {
        for (part, weight) in column.iter().zip(&weights) {
            *q += part * weight;
        }
    }
    stepped
}

/// Solves `matrix x = right` for a symmetric positive definite matrix given by its lower
/// triangle (Cholesky).
#[allow(
    clippy::needless_range_loop,
    reason = "three coupled indices read better as in the textbook"
)]
fn solve_positive(mut matrix: [[f64; 6]; 6], mut right: Task) -> Task {
    for column in 0..6 {
        for inner in 0..column {
            let factor = matrix[column][inner];
            for row in column..6 {
                matrix[row][column] -= matrix[row][inner] * factor;
            }
        }
        let pivot = matrix[column][column].sqrt();
        for row in column..6 {
            matrix[row][column] /= pivot;
        }
    }
    for row in 0..6 {
        for inner in 0..row {
            right[row] -= matrix[row][inner] * right[inner];
        }
        right[row] /= matrix[row][row];
    }
    for row in (0..6).rev() {
        for inner in row + 1..6 {
            right[row] -= matrix[inner][row] * right[inner];
        }
        right[row] /= matrix[row][row];
    }
    right
}

/// The largest share of the way from `start` to `goal`, at most 1, that every joint's speed limit
/// allows in `elapsed_s`.
fn share_within_speed(start: &Joints, goal: &Joints, elapsed_s: f64) -> f64 {
    let steps = combine(start, goal, |from, to| (to - from).abs());
    steps
        .iter()
        .zip(&SPEED_MAX_RAD_PER_S)
        .map(|(step, speed_max)| speed_max * elapsed_s / step)
        .fold(1.0, f64::min)
}

#[cfg(test)]
#[path = "inverse_tests.rs"]
mod tests;
