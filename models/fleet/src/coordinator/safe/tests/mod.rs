//! Claims about the safe rules in closed loop: random worlds, fleets and channels.

mod claims;
mod plan;
mod rig;
mod world;
