//! `hil-recorder`: the runs of `hil-runtime` as MCAP files, for tools that others wrote. It is a
//! program of its own so that the real-time binary carries none of what this needs.
//!
//! Read in this order: `run`, `timeline` and `clocks`, what there is and when it was; `schema` and
//! `codec`, what a message looks like; `topics`, `net` and `run_topics`, what is made of it, for any
//! `sink`, of a folder as of a run that goes; `writer`, the file; `convert`, all of them together. `record`
//! does the same while a run goes; `pace` keeps it out of the run's way. `scan` reads files as far as their `lengths` hold, for `recover`; `play` feeds what `codec`
//! makes of them into a run. `view` is the state of a run that goes on, `serve` shows it.
//!
//! The program is [`run()`]; nothing else is for other crates but [`decoders`], for tests.
#![forbid(unsafe_code)]

mod cli;
mod clocks;
mod codec;
mod command;
mod conditions;
mod convert;
pub mod decoders;
mod disk;
mod facts;
mod failure;
mod joining;
mod lengths;
mod net;
mod newest;
mod pace;
mod play;
mod record;
mod recover;
mod run;
mod run_topics;
mod scan;
mod scene;
mod schema;
mod serve;
mod sink;
mod split;
mod timeline;
mod topics;
mod view;
mod writer;

#[cfg(test)]
mod tests;

pub use command::run;
