//! Case study 2 in virtual time, fast: thousands of motion loops a second over channels that a
//! table names, and the search for the channel behind a given motion loss rate. The controller and
//! the commands are those that run as processes; only their surroundings differ.

mod calibration;
mod conditions;
mod drive;
mod recorded;
mod report;
mod study;
#[cfg(test)]
mod tests;
mod trajectory;

pub(crate) use calibration::Calibration;
pub(crate) use conditions::PUBLISHED_LOOPS;
pub(crate) use study::MotionLossStudy;
pub use study::TableParameters;
