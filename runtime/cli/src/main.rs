//! The `hil-runtime` binary with the shipped case studies.

use std::process::ExitCode;

use hil_fleet::Fleet;
use hil_runtime::Runtime;
use hil_shuttle::Shuttle;
use hil_teleoperation::Teleoperation;

fn main() -> ExitCode {
    Runtime::new()
        .case::<Fleet>()
        .case::<Teleoperation>()
        .case::<Shuttle>()
        .run()
}
