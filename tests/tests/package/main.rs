//! What is shipped beside the programs: the Debian package and the schema of topology files.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "tests")]

mod package;
mod schema;
