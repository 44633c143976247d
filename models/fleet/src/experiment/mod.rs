//! Case study 1 in virtual time, fast: one fleet at some ten thousand times its own pace, the
//! cells of the published tables, and the table of mechanisms. The machines inside are those that
//! run as processes; only their surroundings differ.

mod cells;
mod costs;
mod driver;
mod recorded;
mod report;
mod study;
#[cfg(test)]
mod tests;

pub use cells::FleetTally;
pub use driver::{
    Experiment, FleetLinks, FleetMessage, FleetModel, FleetRank, Links, Setup, StatusPath,
};
pub use study::{TableParameters, TablePart};

pub(crate) use study::FleetStudy;
