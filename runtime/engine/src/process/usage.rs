//! What a process cost: processor time and context switches, as the kernel counted them.

use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;

use hil_rundir::pipe::ProcessReport;

/// Fills the usage figures of `report` for the calling process; leaves them zero if the kernel
/// does not tell, which Linux never does for one's own process.
pub(crate) fn add_usage(report: &mut ProcessReport) {
    if let Ok(usage) = getrusage(UsageWho::RUSAGE_SELF) {
        let cpu_us = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
        report.cpu_s = cpu_us as f64 * 1e-6;
        report.voluntary_switches = usage.voluntary_context_switches().unsigned_abs();
        report.involuntary_switches = usage.involuntary_context_switches().unsigned_abs();
    }
}
