//! Case study 1: safe coordination of a fleet of automated guided vehicles (Lv et al., sections
//! II.B and III.B, Tables I to III).
#![forbid(unsafe_code)]

mod case;
pub mod controller;
pub mod coordinator;
mod events;
pub mod experiment;
mod feasibility;
pub mod geometry;
pub mod map;
pub mod messages;
pub mod mission;
pub mod path;
pub mod planner;
pub mod referee;
pub mod robot;
pub mod robots;
pub mod scenario;
mod scene;
mod score;
pub mod section;
mod standing;
pub mod world;

pub use case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_STATE, FLEET_TRUTH, Fleet, FleetParameters};
