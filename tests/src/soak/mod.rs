//! Watching processes for a long time: what each holds of the machine, and whether that grows. It
//! starts nothing and reads `/proc`.

pub mod held;
pub mod trend;
