//! The command lines of both programs as a person or a script uses them, on one machine.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

mod command_line;
mod compare;
mod demand;
mod doctor;
mod help;
mod inherited;
mod other_users;
mod play;
mod progress;
mod replay;
mod report_hard;
mod report_page;
mod service;
mod several_runs;
mod terminal;
