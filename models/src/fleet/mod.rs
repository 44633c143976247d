//! Case study 1: safe coordination of a fleet of automated guided vehicles (Lv et al., sections
//! II.B and III.B, Tables I to III).

mod analytic;
pub mod coordinator;
pub mod geometry;
mod layout;
pub mod map;
pub mod messages;
pub mod mission;
mod overlap;
pub mod path;
pub mod planner;
pub mod referee;
pub mod robot;
pub mod robots;
mod routes;
pub mod scenario;
mod scene;
pub mod section;
mod section_library;
pub mod world;
