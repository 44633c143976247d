//! Pure models of robots, links and measures, and the virtual-time driver.
//!
//! Nothing here reads a clock, blocks, or touches a file, a socket or a thread: time enters as
//! `now`, randomness as a seeded [`random::RandomStream`]. Read in this order:
//!
//! 1. [`time`] and [`message`]: instants, periodic timers, fixed-size messages.
//! 2. [`component`] and [`case_study`]: what a user writes.
//! 3. [`endpoint`] and [`simulation`]: what drives it, in real and in virtual time.
//! 4. [`shuttle`]: a whole case study in one short file.
//! 5. [`link`]: what a network does to a message; [`account`]: how that is accounted; [`stats`]:
//!    samples, histograms and intervals.
//! 6. [`egm`], [`yumi`] and [`teleoperation`]: the dual-arm robot of the seed paper, its guided
//!    motion and the person who guides it; [`fleet`]: its seven vehicles.
//! 7. [`trace`]: what a link did to every message of a run, as data.
//! 8. [`mod@layout`]: the fields of a message, for programs that do not know its type.
//! 9. [`study`]: batches of virtual-time runs that end in tables.
#![forbid(unsafe_code)]

pub mod account;
pub mod arrival;
pub mod case_study;
pub mod clock;
pub mod component;
pub mod egm;
pub mod endpoint;
pub mod fleet;
pub mod layout;
pub mod link;
pub mod link_model;
pub mod message;
pub mod packed;
pub mod plot;
pub mod random;
pub mod record;
pub mod replay;
pub mod run_log;
mod score;
pub mod shuttle;
pub mod simulation;
pub mod stats;
pub mod study;
pub mod teleoperation;
pub mod time;
pub mod trace;
pub mod yumi;
