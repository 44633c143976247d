//! Motion along a way in time: speed up, cruise, slow down, from rest to rest. Other robots are
//! none of its business.

/// The fastest motion over a way within limits of speed and acceleration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trajectory {
    length_m: f64,
    acceleration_mps2: f64,
    /// Largest speed reached.
    top_mps: f64,
    /// While speeding up, and again while slowing down.
    ramp_s: f64,
    cruise_s: f64,
}

/// Where along the way and how fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrajectoryPoint {
    /// Way travelled, metres.
    pub travelled_m: f64,
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Acceleration, m/s^2.
    pub acceleration_mps2: f64,
}

impl Trajectory {
    /// The motion over `length_m`, from rest to rest.
    ///
    /// # Panics
    /// When the length is below 0 or a limit is no positive number.
    pub fn new(length_m: f64, speed_max_mps: f64, acceleration_mps2: f64) -> Self {
        assert!(
            length_m >= 0.0 && speed_max_mps > 0.0 && acceleration_mps2 > 0.0,
            "{length_m} m at {speed_max_mps} m/s and {acceleration_mps2} m/s^2 is no motion"
        );
        let top_mps = speed_max_mps.min((length_m * acceleration_mps2).sqrt());
        let ramp_s = top_mps / acceleration_mps2;
        let cruise_s = if top_mps > 0.0 {
            (length_m - top_mps * ramp_s).max(0.0) / top_mps
        } else {
            0.0
        };
        Self {
            length_m,
            acceleration_mps2,
            top_mps,
            ramp_s,
            cruise_s,
        }
    }

    /// From start to standstill at the goal, seconds.
    pub fn duration_s(&self) -> f64 {
        2.0 * self.ramp_s + self.cruise_s
    }

    /// The motion `time_s` after the start; at rest before it and after the end.
    pub fn at(&self, time_s: f64) -> TrajectoryPoint {
        let left_s = self.duration_s() - time_s;
        let (travelled_m, speed_mps, acceleration_mps2) = if time_s < 0.0 {
            (0.0, 0.0, 0.0)
        } else if time_s < self.ramp_s {
            let acceleration = self.acceleration_mps2;
            let way_m = 0.5 * acceleration * time_s * time_s;
            (way_m, acceleration * time_s, acceleration)
        } else if left_s > self.ramp_s {
            let way_m = self.top_mps * (time_s - 0.5 * self.ramp_s);
            (way_m, self.top_mps, 0.0)
        } else if left_s > 0.0 {
            let acceleration = self.acceleration_mps2;
            let way_m = self.length_m - 0.5 * acceleration * left_s * left_s;
            (way_m, acceleration * left_s, -acceleration)
        } else {
            (self.length_m, 0.0, 0.0)
        };
        TrajectoryPoint {
            travelled_m,
            speed_mps,
            acceleration_mps2,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_way_is_a_trapezoid_of_speed_and_a_short_one_a_triangle() {
        let long = Trajectory::new(80.0, 2.0, 1.0);
        assert!((long.duration_s() - 42.0).abs() < 1e-12);
        assert!((long.at(2.0).travelled_m - 2.0).abs() < 1e-12);
        assert!((long.at(21.0).travelled_m - 40.0).abs() < 1e-12);
        assert!((long.at(41.0).speed_mps - 1.0).abs() < 1e-12);
        assert!((long.at(50.0).travelled_m - 80.0).abs() < 1e-12);
        let short = Trajectory::new(1.0, 2.0, 1.0);
        assert!((short.duration_s() - 2.0).abs() < 1e-12);
        assert!((short.at(1.0).speed_mps - 1.0).abs() < 1e-12);
        assert!(Trajectory::new(0.0, 2.0, 1.0).duration_s().abs() < 1e-12);
    }
}
