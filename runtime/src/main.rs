//! The `hil-runtime` binary with the shipped case studies.

use std::process::ExitCode;

use hil_models::fleet::Fleet;
use hil_models::shuttle::Shuttle;
use hil_models::teleoperation::Teleoperation;
use hil_runtime::Runtime;

fn main() -> ExitCode {
    Runtime::new()
        .case::<Fleet>()
        .case::<Teleoperation>()
        .case::<Shuttle>()
        .run()
}
