//! Tests of the protocol's parts together; nothing here ships.

mod bridges;
mod clock_path;
mod flow;
mod fragments;
mod golden;
mod recovery;
mod sequences;
