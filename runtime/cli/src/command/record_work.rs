//! `tables --record`: runs of this program, one after the other, then the tables with them as rows.

use std::path::Path;

use hil_engine::process::again::run_again;
use hil_platform::console::Console;
use hil_report::study::recording::{self, RecordingError, RunEnd};
use hil_report::study::{self, BatchArgs, RunArgument, Wanted};
use hil_topology::Recording;
use hil_topology::registry::Registry;

use super::case_work::{compute, with_runs};
use super::{Refusal, exit, failed, interrupted, loaded, signals, usage};

/// What is wanted of the tables beside the rows that are recorded.
pub(super) struct TablesWanted {
    /// Of the tables' topology.
    pub(super) overrides: Vec<String>,
    /// Rows that are recorded already.
    pub(super) runs: Vec<RunArgument>,
    pub(super) batch: BatchArgs,
}

/// Records what the rows of `file` lack, and prints the tables with what there is.
pub(super) fn record(
    file: &Path,
    host: Option<&str>,
    wanted: TablesWanted,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    let TablesWanted {
        overrides,
        mut runs,
        batch,
    } = wanted;
    console.set_quiet(batch.quiet);
    let signals = signals()?;
    let recording = loaded(Recording::load(file), console)?;
    let mut settings = recording.set.clone();
    settings.extend_from_slice(&overrides);
    let path = Path::new(&recording.tables);
    let tables = loaded(
        hil_topology::load_case(path, &settings, registry.known()),
        console,
    )?;
    let recorded = recording::record(
        &recording,
        &tables,
        registry,
        host,
        &mut |arguments, output, meanwhile| {
            let code = run_again(arguments, output, &signals, meanwhile)?;
            let code = code.and_then(|code| u8::try_from(code).ok());
            Ok(match code {
                Some(exit::HOST_UNFIT) => RunEnd::HostTooSmall,
                Some(exit::USAGE | exit::PEER_ABSENT | exit::FORBIDDEN) => RunEnd::Hopeless,
                _ => RunEnd::Over,
            })
        },
        &signals,
        console,
    );
    let recorded = recorded.map_err(|error| match error {
        RecordingError::Io { .. } => failed(error),
        RecordingError::Busy(_) => Refusal::new(exit::TRY_AGAIN, error),
        RecordingError::Interrupted => Refusal::new(interrupted(), error),
        other => usage(format!("{}: {other}", file.display())),
    })?;
    for fault in &recorded.faults {
        console.error(fault);
    }
    let given = runs.clone();
    runs.extend(recorded.runs);
    let study = study::batch_of(&tables, registry, Wanted::Tables { runs: &runs });
    let file = file.display().to_string();
    let mut words = vec!["tables", "--record", &file];
    words.extend(host.iter().flat_map(|name| ["--host", name]));
    let mut invocation = with_runs(&words, &given, &overrides);
    invocation.remarks = recorded.remarks;
    let code = compute(study, &batch, &invocation, &signals, console)?;
    Ok(if recorded.faults.is_empty() {
        code
    } else {
        code.max(exit::FAILED)
    })
}
