//! Authorities that end by themselves: with a measured bound on delays, way can be taken back
//! from a robot that does not answer. Off unless a lease is set; without one nothing here acts.
//!
//! Let the retraction be first sent at `t`, the lease be `L`, the bound `D`. What was sent before
//! arrives by `t + D` and ends by `t + D + L`; from then the robot brakes. A state received at `r`
//! was sampled at `r - D` or later, so the robot's way is at most
//! `s + v max(0, t + D + L - (r - D)) + v^2 / 2a`, where `s` is the way in that state and `v`, `a`
//! its largest speed and deceleration. Beyond that, and beyond what the retraction leaves, it
//! will not come; so after `t + D + L + v/a` that is the bound on its authority.
//!
//! The bound is an assumption about the network. Where both ends share a clock each state's age
//! checks it; one above the bound freezes all grants for as long as a lease may run on it. Only
//! states are watched: a command that takes longer than the bound while states do not is not seen,
//! and the lease is then no safer than the assumption. Without a lease nothing rests on it.

use crate::coordinator::counters::SafeCounts;
use crate::coordinator::safe::SafeRules;
use crate::coordinator::safe::ledger::Ledger;
use crate::coordinator::safe::parameters::SafeParameters;
use crate::geometry::floor_index;
use crate::messages::State;
use hil_core::time::Instant;

/// The lease and what watches its assumption.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LeaseWatch {
    lease_ns: i64,
    delay_max_ns: i64,
    clock_is_shared: bool,
    frozen_until: Instant,
}

impl LeaseWatch {
    pub(crate) fn new(parameters: &SafeParameters, clock_is_shared: bool) -> Self {
        Self {
            lease_ns: nanoseconds(parameters.lease_ms),
            delay_max_ns: nanoseconds(parameters.delay_bound_ms),
            clock_is_shared,
            frozen_until: Instant::ZERO,
        }
    }

    /// 0 without lease.
    pub(crate) fn lease_ns(&self) -> i64 {
        self.lease_ns
    }

    /// True when the robot's authority has to be sent anew so that it does not end.
    pub(crate) fn renews(&self, ledger: &Ledger) -> bool {
        self.lease_ns > 0 && ledger.newest().0 > 0 && !ledger.is_done()
    }

    /// Checks the age of a state against the bound.
    pub(crate) fn on_state(&mut self, now: Instant, state: &State, counts: &mut SafeCounts) {
        if self.lease_ns == 0 || !self.clock_is_shared {
            return;
        }
        if now.as_ns().saturating_sub(state.sampled_ns) > self.delay_max_ns {
            counts.delay_bound_violations += 1;
            let pause_ns = self.lease_ns.saturating_add(self.delay_max_ns);
            self.frozen_until = Instant::from_ns(now.as_ns().saturating_add(pause_ns));
        }
    }

    pub(crate) fn is_frozen(&self, now: Instant) -> bool {
        now < self.frozen_until
    }
}

impl SafeRules {
    /// Lowers the bounds of robots whose retracted authority has ended by itself.
    pub(crate) fn expire_leases(&mut self, now: Instant) {
        if self.lease.lease_ns == 0 || self.lease.is_frozen(now) {
            return;
        }
        let vehicle = self.world.vehicle;
        let braking_s = vehicle.speed_max_mps / vehicle.acceleration_mps2;
        for robot in 0..self.robots.len() {
            let view = &self.robots[robot];
            let Some(path) = self
                .traffic
                .path(robot)
                .filter(|_| view.ledger.is_shrinking())
            else {
                continue;
            };
            let ended_ns = view
                .retracted
                .as_ns()
                .saturating_add(self.lease.delay_max_ns)
                .saturating_add(self.lease.lease_ns);
            let since_ended_s = now.seconds_since(Instant::from_ns(ended_ns));
            if since_ended_s < braking_s {
                continue;
            }
            let sampled_ns = view.heard.as_ns().saturating_sub(self.lease.delay_max_ns);
            let driving_s = Instant::from_ns(ended_ns)
                .seconds_since(Instant::from_ns(sampled_ns))
                .max(0.0);
            let spacing_m = self.world.path(path).spacing_m();
            let way_m = spacing_m * (view.ledger.lower() + 1) as f64
                + vehicle.speed_max_mps * driving_s
                + 0.5 * vehicle.speed_max_mps * braking_s;
            let furthest = floor_index((way_m / spacing_m).ceil());
            let (_, asked) = view.ledger.newest();
            let bound = furthest.max(asked);
            if bound < view.ledger.bound() {
                self.robots[robot].ledger.expire_to(bound);
                self.counts.leases_expired += 1;
                self.update_span(robot);
            }
        }
    }
}

fn nanoseconds(milliseconds: f64) -> i64 {
    let duration = core::time::Duration::from_secs_f64(milliseconds * 1e-3);
    hil_core::time::duration_ns(duration)
}
