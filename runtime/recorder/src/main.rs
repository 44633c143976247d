//! `hil-recorder`: the runs of `hil-runtime` as MCAP files, for tools that others wrote. It is a
//! program of its own so that the real-time binary carries none of what this needs.
//!
//! Read in this order: [`run`] and [`clocks`], what there is and when it was; [`schema`] and
//! [`encode`], what a message looks like; [`topics`] and [`net`], what is made of it; [`writer`],
//! the file; [`convert`], all of them together. [`scan`] reads files, for [`recover`] and [`info`], and
//! [`play`] feeds what [`decode`] makes of them into a run.

mod cli;
mod clocks;
mod command;
mod convert;
mod decode;
mod encode;
mod facts;
mod info;
mod net;
mod play;
mod recover;
mod run;
mod scan;
mod schema;
mod topics;
mod writer;

#[cfg(test)]
mod tests;

use std::process::ExitCode;

fn main() -> ExitCode {
    command::run()
}
