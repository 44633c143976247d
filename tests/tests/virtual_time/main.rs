//! What runs without a clock: the same figures on every machine, to the last bit.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

mod equivalence;
mod robot_description;
mod static_cells;
mod tables;
mod wifi_presets;
