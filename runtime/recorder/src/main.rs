//! The `hil-recorder` binary.

use std::process::ExitCode;

fn main() -> ExitCode {
    hil_recorder::run()
}
