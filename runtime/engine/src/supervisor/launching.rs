//! What a process of the run is told as it starts: a launch file of its kind.

use std::path::Path;

use super::crew::Member;
use super::plan::ProcessTask;
use hil_rundir::face_launch::FaceLaunch;
use hil_rundir::launch::{ComponentLaunch, GatewayLaunch, LaunchError, write};
use hil_rundir::run_folder::RunFolder;

/// Writes the launch file of `member` at `path`; the word that starts a process of its kind.
///
/// # Errors
/// When the file cannot be written.
pub(super) fn write_launch(
    member: &Member,
    (folder, is_sealed): (&RunFolder, bool),
    path: &Path,
    domain: String,
) -> Result<&'static str, LaunchError> {
    let plan = &member.plan;
    let (process, instance) = (plan.name.clone(), member.restart_count);
    match &plan.task {
        ProcessTask::Component(card) => {
            let card_path = folder.card(&process);
            write(&card_path, card)?;
            let launch = ComponentLaunch {
                process,
                instance,
                card: card_path,
                domain,
                realtime: plan.realtime.clone(),
                wait: plan.wait,
                records: folder.records(),
            };
            write(path, &launch)?;
            Ok("component")
        }
        ProcessTask::Gateway(directions) | ProcessTask::ClockPath { directions, .. } => {
            let ready_within = match &plan.task {
                ProcessTask::ClockPath { ready_within, .. } => Some(*ready_within),
                _ => None,
            };
            let launch = GatewayLaunch {
                process,
                instance,
                domain,
                records: folder.records(),
                directions: directions.clone(),
                ready_within,
                is_sealed,
            };
            write(path, &launch)?;
            Ok("gateway")
        }
        ProcessTask::Face(face) => {
            let launch = FaceLaunch {
                process,
                instance,
                domain,
                records: folder.records(),
                wait: plan.wait,
                face: face.clone(),
            };
            write(path, &launch)?;
            Ok("face")
        }
        ProcessTask::Foreign { .. } => Ok("foreign"),
    }
}
