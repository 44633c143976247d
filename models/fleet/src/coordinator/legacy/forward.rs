//! How far a robot goes before an order given now could stop it, as the original's forward model
//! reckons: in closed form, with the period and delay the coordinator believes in.

use core::time::Duration;

use crate::coordinator::parameters::CoordinatorParameters;
use crate::coordinator::roster::RobotView;
use crate::world::Vehicle;

/// The forward model of one kind of vehicle.
#[derive(Debug, Clone)]
pub(crate) struct ForwardModel {
    lookahead_s: f64,
    speed_max_mps: f64,
    speeding_up_mps2: f64,
    braking_mps2: f64,
}

/// Vehicles may speed up this much better, and brake as much worse, than they should.
const PESSIMISM_RATIO: f64 = 0.1;

impl ForwardModel {
    pub(crate) fn new(vehicle: &Vehicle, parameters: &CoordinatorParameters) -> Self {
        Self {
            lookahead_s: lookahead(parameters).as_secs_f64(),
            speed_max_mps: vehicle.speed_max_mps,
            speeding_up_mps2: (1.0 + PESSIMISM_RATIO) * vehicle.acceleration_mps2,
            braking_mps2: (1.0 - PESSIMISM_RATIO) * vehicle.acceleration_mps2,
        }
    }

    /// Way a vehicle at `speed_mps` still makes when it first speeds up for the lookahead and
    /// then brakes, metres.
    pub(crate) fn stopping_way_m(&self, speed_mps: f64) -> f64 {
        let speed_mps = speed_mps.max(0.0);
        let to_full_s = ((self.speed_max_mps - speed_mps) / self.speeding_up_mps2).max(0.0);
        let speeding_up_s = to_full_s.min(self.lookahead_s);
        let fast_mps = speed_mps + self.speeding_up_mps2 * speeding_up_s;
        0.5 * (speed_mps + fast_mps) * speeding_up_s
            + fast_mps * (self.lookahead_s - speeding_up_s)
            + fast_mps * fast_mps / (2.0 * self.braking_mps2)
    }

    /// The pose at which the robot of `view` could stop at the earliest.
    pub(crate) fn earliest_stop(&self, view: &RobotView) -> usize {
        let (Some(mission), Some(state)) = (&view.mission, &view.state) else {
            return 0;
        };
        let way_m = state.travelled_m + self.stopping_way_m(f64::from(state.speed_mps));
        mission.path.index_at(way_m)
    }
}

/// The worst age of what the decision rests on when its order takes effect: a state up to a
/// tracking period and a delay old, an order that waits for the next cycle, takes a delay and
/// waits for a tracking period: Tc + 2 (D + TT).
fn lookahead(parameters: &CoordinatorParameters) -> Duration {
    parameters.control_period() + 2 * (parameters.known_delay() + parameters.tracking_period())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Footprint;

    #[test]
    fn the_closed_form_agrees_with_small_steps() {
        let vehicle = Vehicle {
            footprint: Footprint {
                length_m: 2.0,
                width_m: 0.5,
            },
            speed_max_mps: 2.0,
            acceleration_mps2: 1.0,
        };
        let parameters = CoordinatorParameters {
            known_delay_ms: 70.0,
            ..CoordinatorParameters::default()
        };
        let model = ForwardModel::new(&vehicle, &parameters);
        assert!((model.lookahead_s - 1.2).abs() < 1e-12);
        for start_mps in [0.0, 0.5, 1.3, 1.99, 2.0, 2.3] {
            let (mut way_m, mut speed_mps, mut time_s) = (0.0, start_mps, 0.0);
            let step_s = 1e-5;
            while time_s < 1.2 {
                way_m += speed_mps * step_s;
                if speed_mps < 2.0 {
                    speed_mps += 1.1 * step_s;
                }
                time_s += step_s;
            }
            while speed_mps > 0.0 {
                way_m += speed_mps * step_s;
                speed_mps -= 0.9 * step_s;
            }
            let difference_m: f64 = model.stopping_way_m(start_mps) - way_m;
            assert!(difference_m.abs() < 1e-3, "{start_mps}: {difference_m}");
        }
    }
}
