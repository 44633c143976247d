//! Case study 1: safe coordination of a fleet of automated guided vehicles (Lv et al., sections
//! II.B and III.B, Tables I to III).

pub mod coordinator;
pub mod geometry;
pub mod messages;
pub mod path;
pub mod section;
pub mod world;
