//! A run of a row once more in virtual time, over the traces that it left: they are too large to be kept.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::Path;

use hil_rundir::manifest::Manifest;
use hil_rundir::run_folder::RunFolder;
use hil_topology::registry::Registry;
use serde_json::{Value, json};

use crate::simulate::simulate;
use crate::summary::ScoreMetric;

/// The folder of the scores in that of a run.
pub(super) const FOLDER: &str = "replays";
/// In it: why there are none.
const CAUSE: &str = "cause.txt";
/// How often each run is replayed: robots that do other things meet the same network.
const COUNT: u64 = 4;
/// Runs of a recording have seeds below it.
const SEED_STEP: u64 = 1 << 32;

/// Writes the scores beside what the run in `folder` left, or why there are none; calls `watch` now and then.
///
/// # Errors
/// When a file cannot be written.
pub(super) fn write(folder: &Path, registry: &Registry, watch: &mut dyn FnMut()) -> io::Result<()> {
    let manifest = Manifest::read(&RunFolder::existing(folder))?;
    let place = folder.join(FOLDER);
    fs::create_dir_all(&place)?;
    for index in 1..=COUNT {
        let seed = manifest.seed + index * SEED_STEP;
        match score(&manifest, folder, seed, registry, watch) {
            Ok(score) => {
                let text = serde_json::to_vec(&score).map_err(io::Error::other)?;
                put(&place.join(format!("{seed}.json")), &text)?;
            }
            Err(why) => {
                put(&place.join(CAUSE), why.as_bytes())?;
                break;
            }
        }
    }
    File::open(&place)?.sync_all()
}

/// The score of robots with `seed` over the traces in `folder`.
fn score(
    manifest: &Manifest,
    folder: &Path,
    seed: u64,
    registry: &Registry,
    watch: &mut dyn FnMut(),
) -> Result<Vec<ScoreMetric>, String> {
    let traces = fs::canonicalize(folder.join("traces"));
    let traces = traces.map_err(|error| format!("it left no traces: {error}"))?;
    let over_traces = |topology: &mut Value| {
        topology["run"]["seed"] = json!(seed);
        let links = topology["links"].as_object_mut();
        for link in links.into_iter().flat_map(|links| links.values_mut()) {
            let mut replayed = json!({
                "via": "emulated",
                "between": link["between"].take(),
                "trace": traces.display().to_string(),
            });
            // Two links may not have the same.
            if let Some(port) = link.get("port") {
                replayed["port"] = port.clone();
            }
            *link = replayed;
        }
    };
    let topology = manifest.read_changed_topology(over_traces, registry.known());
    let topology = topology.map_err(|error| error.to_string())?;
    let file = Path::new(&manifest.topology_file);
    let simulated = simulate(&topology, file, registry, &mut |_| watch());
    Ok(simulated.map_err(|error| error.to_string())?.summary.score)
}

fn put(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// The scores that [`write`] left in `folder`, in the order of their seeds, or why there are none; nothing where it
/// was not asked for.
///
/// # Errors
/// When a file cannot be read.
pub(in crate::study) fn read(folder: &Path) -> io::Result<Result<Vec<Vec<ScoreMetric>>, String>> {
    let entries = match fs::read_dir(folder.join(FOLDER)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Ok(Vec::new())),
        entries => entries?,
    };
    let paths = entries.map(|entry| Ok(entry?.path()));
    let mut paths = paths.collect::<io::Result<Vec<_>>>()?;
    if let Some(cause) = paths.iter().find(|path| path.ends_with(CAUSE)) {
        return Ok(Err(fs::read_to_string(cause)?));
    }
    let seed = |path: &Path| path.file_stem()?.to_str()?.parse::<u64>().ok();
    paths.retain(|path| seed(path).is_some());
    paths.sort_by_key(|path| seed(path));
    let scores = paths.iter().map(|path| {
        let score = serde_json::from_slice(&fs::read(path)?);
        score.map_err(|error| io::Error::other(format!("{}: {error}", path.display())))
    });
    Ok(Ok(scores.collect::<io::Result<Vec<_>>>()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    use hil_shuttle::Shuttle;

    #[test]
    fn a_run_without_traces_says_so_and_one_of_which_none_was_asked_for_has_none() {
        let folder = std::env::temp_dir().join(format!("hil-replay-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        assert_eq!(read(&folder).unwrap(), Ok(Vec::new()));
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let manifest =
            json!({ "schema_version": 1, "program": { "name": "hil-runtime", "version": "0" } });
        fs::write(folder.join("manifest.json"), manifest.to_string()).unwrap();
        write(&folder, &registry, &mut || {}).unwrap();
        let why = read(&folder).unwrap().unwrap_err();
        assert!(why.starts_with("it left no traces: "), "{why}");
        // Neither can what is there be used.
        fs::create_dir(folder.join("traces")).unwrap();
        write(&folder, &registry, &mut || {}).unwrap();
        let why = read(&folder).unwrap().unwrap_err();
        assert!(why.starts_with("its topology cannot be read: "), "{why}");
        fs::remove_dir_all(folder).unwrap();
    }
}
