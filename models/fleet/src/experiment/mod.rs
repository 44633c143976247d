//! Case study 1 in virtual time, fast: one fleet at some ten thousand times its own pace, the
//! cells of the published tables, and the table of mechanisms. The machines inside are those that
//! run as processes; only their surroundings differ.

mod agenda;
mod cells;
mod driver;
mod judgement;
mod path;
mod post;
pub mod published;
mod report;
mod setup;
mod study;
mod tally;
#[cfg(test)]
mod tests;

pub use driver::{Experiment, Observer};
pub use setup::{Links, Setup, StatusPath};
pub use study::{TableParameters, TablePart};
pub use tally::FleetTally;

pub(crate) use study::FleetStudy;
pub(crate) use tally::collision_interval;
