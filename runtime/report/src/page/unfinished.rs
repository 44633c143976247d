//! A run that was begun and never finished.

use super::data::{FactGroup, Run, RunKind, Verdict};
use super::material::Manifest;
use super::words::UNAVAILABLE;
use crate::summary::{Fact, host_words};
use hil_platform::text::grouped;

/// A run without a summary.
pub(super) fn unfinished(key: &str, manifest: &Manifest, folder: &str) -> Run {
    let (files, bytes) = manifest.records;
    let seed = manifest
        .seed
        .map_or_else(|| UNAVAILABLE.to_owned(), |seed| seed.to_string());
    Run {
        key: key.to_owned(),
        name: manifest.name.clone(),
        case: manifest.case.clone(),
        kind: RunKind::Unfinished,
        outcome: Verdict {
            tone: "bad",
            word: "unfinished".to_owned(),
            text: "this run never began or was killed outright, so it left no summary".to_owned(),
        },
        network_verdict: Verdict {
            tone: "caution",
            word: "no verdict".to_owned(),
            text: "no verdict: there are no figures".to_owned(),
        },
        missing: vec![
            "Score, channels, delays, losses and events: unavailable without summary.json."
                .to_owned(),
            format!(
                "{} files of records with {} bytes are whole up to the moment it ended.",
                grouped(files),
                grouped(bytes)
            ),
        ],
        facts: vec![
            FactGroup {
                title: "Run".to_owned(),
                facts: vec![
                    Fact::new("begun", &manifest.created),
                    Fact::new("seed", seed),
                    Fact::new("folder", folder),
                ],
            },
            FactGroup {
                title: "Host".to_owned(),
                facts: host_words(&manifest.host_facts),
            },
        ],
        repeat_command: Some(manifest.command_line.join(" ")).filter(|line| !line.is_empty()),
        ..Run::default()
    }
}
