//! Case study 1: safe coordination of a fleet of automated guided vehicles (Lv et al., sections
//! II.B and III.B, Tables I to III).
#![forbid(unsafe_code)]

mod analytic;
mod case;
pub mod controller;
pub mod coordinator;
mod events;
pub mod experiment;
pub mod geometry;
mod layout;
pub mod map;
pub mod messages;
pub mod mission;
mod overlap;
mod parameters;
pub mod path;
pub mod planner;
pub mod referee;
pub mod robot;
pub mod robots;
mod routes;
pub mod scenario;
mod scene;
mod score;
pub mod section;
mod section_library;
pub mod world;

pub use case::{FLEET_AUTHORITY, FLEET_MISSION, FLEET_STATE, FLEET_TRUTH, Fleet};
pub use parameters::FleetParameters;
