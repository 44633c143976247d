//! The file of a recording: which rows of a case's tables are to be made of runs in real time, and of how many. It
//! runs nothing; the topologies that it names are read by whoever runs them.

use std::path::{Path, PathBuf};

use hil_core::case_study::ParameterError;
use hil_core::options;
use hil_core::options::{Named, TextRule};
use hil_core::recorded_run::PublishedNetwork;

use crate::errors::{Place, TopologyErrors};
use crate::layers::Layers;
use crate::reader;
use crate::tables::FOLDER;

/// A path that is not empty.
const TOPOLOGY_FILE: TextRule = TextRule {
    what: "the path of a topology file",
    check: |path| match path {
        "" => Err("is empty, expected the path of a topology file".to_owned()),
        _ => Ok(()),
    },
    pattern: None,
};

options! {
    /// The whole file. Its paths start from its own folder.
    pub struct Recording {
        /// Folder in which the runs are kept.
        folder: String, in FOLDER, hint "it is where the runs are kept";
        /// Topology of the tables that the rows stand in.
        tables: String, in TOPOLOGY_FILE, hint "it names the topology of the tables, e.g. \"tables.toml\"";
        /// Values of that topology that are others here, `KEY=VALUE` each.
        set: Vec<String> = Vec::new();
        /// The rows, by name.
        rows: Named<RecordingRow>, in false;
    }
    check Recording::check_rows;
}

options! {
    /// A row that is made of runs.
    pub struct RecordingRow {
        /// The published network that it stands for; without it the row stands for itself.
        network: Option<PublishedNetwork>;
        /// Topology of its runs.
        topology: String, in TOPOLOGY_FILE, hint "it names the topology of the row's runs";
        /// Values of that topology that are others here, `KEY=VALUE` each.
        set: Vec<String> = Vec::new();
        /// As many are enough of what the case counts.
        enough: Option<u64>, in 1..=i64::MAX.unsigned_abs();
        /// Seed of the first run; each further run has the next one.
        seed: u64 = 1, in 0..=u64::from(u32::MAX);
        /// Whether a passive probe captures at both hosts of a run on one PC, for loss and delay beside the account's.
        probe: bool = false;
        /// Share of their ticks that the processes of a run together may have skipped: a run that skipped more is refused.
        skipped_ratio_max: f64 = 0.0, in 0.0..=0.001, hint "a measurement of which more was skipped is not valid";
    }
    check RecordingRow::check_set;
}

/// What each run of a row has for itself.
const OF_EACH_RUN: [&str; 2] = ["run.seed", "run.record"];

/// The key of `KEY=VALUE`.
fn key_of(setting: &str) -> &str {
    setting.split('=').next().unwrap_or_default().trim()
}

impl RecordingRow {
    fn check_set(&self) -> Result<(), ParameterError> {
        let mut settings = self.set.iter();
        let found = settings.find(|one| OF_EACH_RUN.contains(&key_of(one)));
        found.map_or(Ok(()), |one| {
            let problem = format!(
                "has `{one}`, and each run of the row has a seed and a folder of its own; `seed` says the first"
            );
            Err(ParameterError::new("set", problem))
        })
    }

    /// True where the file says the value of `key`.
    pub fn sets(&self, key: &str) -> bool {
        self.set.iter().any(|one| key_of(one) == key)
    }
}

impl Recording {
    /// Reads the file at `path`; its paths then start from where this program runs.
    ///
    /// # Errors
    /// Everything that is wrong, each with file, line, column and key.
    pub fn load(path: &Path) -> Result<Self, TopologyErrors> {
        let mut layers = Layers::default();
        let mut recording = Self::TEMPLATE;
        if let Some(table) = layers.read(path, None) {
            let top = Place {
                source_index: 0,
                start: 0,
                end: 0,
            };
            reader::read(&mut recording, "", &table, top, &layers.faults);
        }
        if !layers.faults.is_empty() {
            return Err(layers.faults.into_errors(layers.sources));
        }
        let below = |named: &mut String| {
            let found: PathBuf = path.parent().unwrap_or(Path::new("")).join(&*named);
            *named = found.display().to_string();
        };
        below(&mut recording.folder);
        below(&mut recording.tables);
        let rows = recording.rows.0.values_mut();
        rows.for_each(|row| below(&mut row.topology));
        Ok(recording)
    }

    fn check_rows(&self) -> Result<(), ParameterError> {
        if self.rows.0.is_empty() {
            let problem = "is empty, expected a row, e.g. [rows.harbor-ethernet]";
            return Err(ParameterError::new("rows", problem));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn read(label: &str, text: &str) -> Result<Recording, String> {
        let path = std::env::temp_dir().join(format!("hil-{label}-{}.toml", std::process::id()));
        fs::write(&path, text).unwrap();
        let found = Recording::load(&path).map_err(|errors| errors.to_string());
        fs::remove_file(path).unwrap();
        found
    }

    #[test]
    fn paths_start_from_the_folder_of_the_file() {
        let text = "folder = \"runs\"\ntables = \"/etc/tables.toml\"\n[rows.a]\nnetwork = \"short\"\n\
                    topology = \"../a.toml\"\nset = [\"case.parameters.fleets = 4\"]\n";
        let found = read("recording", text).unwrap();
        let folder = std::env::temp_dir();
        assert_eq!(found.folder, folder.join("runs").display().to_string());
        assert_eq!(found.tables, "/etc/tables.toml");
        let row = &found.rows.0["a"];
        assert_eq!(row.topology, folder.join("../a.toml").display().to_string());
        assert_eq!(row.network, Some(PublishedNetwork::ShortRange));
        assert_eq!((row.enough, row.seed), (None, 1));
        assert!(row.sets("case.parameters.fleets") && !row.sets("case.parameters"));
    }

    #[test]
    fn what_is_wrong_is_named_with_file_line_key_value_and_what_may_be() {
        const HEAD: &str = "folder = \"runs\"\ntables = \"tables.toml\"\n";
        let row = "[rows.a]\ntopology = \"a.toml\"\n";
        for (text, expected) in [
            (String::new(), "folder is missing"),
            (
                format!("folder = \"\"\ntables = \"t\"\n{row}"),
                "folder is empty",
            ),
            (HEAD.to_owned(), "rows is empty"),
            (format!("{HEAD}[rows.a]\n"), "rows.a.topology is missing"),
            (
                format!("{HEAD}{row}enough = 0\n"),
                "rows.a.enough 0 is outside 1",
            ),
            (
                format!("{HEAD}{row}seed = -1\n"),
                "rows.a.seed -1 is outside 0",
            ),
            (format!("{HEAD}{row}network = \"lte\"\n"), "`lte` is not"),
            (
                format!("{HEAD}{row}skipped_ratio_max = 0.01\n"),
                "rows.a.skipped_ratio_max 0.01 is outside 0",
            ),
            (
                format!("{HEAD}{row}netwrok = \"short\"\n"),
                "did you mean `network`",
            ),
            (format!("{HEAD}{row}set = \"a=1\"\n"), "rows.a.set is"),
            (
                format!("{HEAD}{row}set = [\"run.seed=3\"]\n"),
                "rows.a.set has `run.seed=3`",
            ),
        ] {
            let error = read("recording-fault", &text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
            assert!(error.contains(".toml:"), "{error}");
        }
    }
}
