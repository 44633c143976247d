//! What all models share: instants, messages, components, records and the virtual-time driver.
//!
//! Nothing here reads a clock, blocks, or touches a file, a socket or a thread: time enters as
//! `now`, randomness as a seeded [`random::RandomStream`]. Read in this order:
//!
//! 1. [`time`] and [`mod@message`]: instants, periodic timers, fixed-size messages.
//! 2. [`component`] and [`case_study`]: what a user writes.
//! 3. [`endpoint`] and [`simulation`]: what drives it, in real and in virtual time.
//! 4. [`link_model`]: what the driver asks of a link.
//! 5. [`record`]: what each process notes of a message.
//! 6. [`mod@layout`]: the fields of a message, for programs that do not know its type.
//! 7. [`mod@options`]: keys of tables with their types, defaults and ranges, declared once.
//! 8. [`study`]: batches of virtual-time runs that end in tables.
#![forbid(unsafe_code)]

// The macros name this crate as their users do.
extern crate self as hil_core;

#[doc(hidden)]
pub use {bytemuck, serde};

pub mod arrival;
pub mod case_study;
pub mod component;
pub mod counts;
pub mod endpoint;
pub mod interval;
pub mod label;
pub mod layout;
pub mod link_model;
pub mod message;
pub mod options;
pub mod packed;
pub mod plot;
pub mod prelude;
pub mod random;
pub mod record;
pub mod recorded_run;
pub mod replay;
pub mod run_log;
pub mod score;
pub mod simulation;
pub mod study;
pub mod text_file;
pub mod time;
