//! From a path and a list of overrides to one merged tree: the chain of `extends`, then each
//! `--set key.path=value`. It knows no key but `extends`.

use std::fs;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use hil_core::text_file::TextFile;

use super::errors::{Fault, Faults, Place, Source};
use super::tree::{self, Node, Table, Value};

/// Longest chain of files that extend each other.
const EXTENDS_DEPTH_MAX: usize = 16;
/// Largest topology file.
const FILE_BYTES_MAX: u64 = 1_048_576;

/// Reads layers; keeps their texts for the error messages.
#[derive(Debug, Default)]
pub(super) struct Layers {
    pub sources: Vec<Source>,
    pub faults: Faults,
}

impl Layers {
    /// The tree of `path` and all it extends; its text is read from disk unless given.
    pub(super) fn read(&mut self, path: &Path, text: Option<String>) -> Option<Table> {
        let text = match text {
            Some(text) => text,
            None => self.read_file(path, None)?,
        };
        let mut chain = vec![identity(path)];
        self.read_layer(path, text, &mut chain)
    }

    fn read_layer(&mut self, path: &Path, text: String, chain: &mut Vec<PathBuf>) -> Option<Table> {
        let source_index = self.sources.len();
        self.sources.push(Source {
            name: path.display().to_string(),
            text,
        });
        let mut table = tree::parse(&self.sources, source_index, &self.faults)?;
        let Some(extends) = table.remove("extends") else {
            return Some(table);
        };
        let base_path = self.base_path(path, &extends, chain)?;
        let text = self.read_file(&base_path, Some(extends.place))?;
        chain.push(identity(&base_path));
        let mut base = self.read_layer(&base_path, text, chain)?;
        tree::merge(&mut base, table);
        Some(base)
    }

    /// The file that `extends` names, relative to the file it stands in.
    fn base_path(&self, path: &Path, extends: &Node, chain: &[PathBuf]) -> Option<PathBuf> {
        let fault = match &extends.value {
            Value::Text(name) => {
                let base_path = path.parent().unwrap_or(Path::new("")).join(name);
                let base_identity = identity(&base_path);
                if chain.contains(&base_identity) {
                    let steps = chain.iter().chain([&base_identity]);
                    Fault::ExtendsCycle(steps.map(|step| step.display().to_string()).collect())
                } else if chain.len() >= EXTENDS_DEPTH_MAX {
                    Fault::ExtendsTooDeep(EXTENDS_DEPTH_MAX)
                } else {
                    return Some(base_path);
                }
            }
            other => Fault::WrongType {
                found: other.type_name(),
                expected: "a string with the path of a file".to_owned(),
            },
        };
        self.faults.add("extends", Some(extends.place), fault);
        None
    }

    fn read_file(&self, path: &Path, named_at: Option<Place>) -> Option<String> {
        let key = if named_at.is_some() { "extends" } else { "" };
        let file = path.display().to_string();
        match read_bounded(path) {
            Ok(text) if text.len() as u64 > FILE_BYTES_MAX => {
                let fault = Fault::TooLarge {
                    file,
                    size_bytes_max: FILE_BYTES_MAX,
                };
                self.faults.add(key, named_at, fault);
                None
            }
            Ok(text) => Some(text),
            Err(source) => {
                self.faults
                    .add(key, named_at, Fault::Unreadable { file, source });
                None
            }
        }
    }

    /// Lays `key.path=value` over `table`. A value that is no TOML is taken as a string, so
    /// that `links.hop.delay=20 ms` needs no quotes inside quotes.
    pub(super) fn lay_override(&mut self, table: &mut Table, text: &str) {
        let source_index = self.sources.len();
        let mut push = |text: String| {
            self.sources.truncate(source_index);
            self.sources.push(Source {
                name: "--set".to_owned(),
                text,
            });
        };
        push(text.to_owned());
        let whole = Place {
            source_index,
            start: 0,
            end: text.len(),
        };
        let Some((key, value)) = text.split_once('=').filter(|_| is_assignment(text)) else {
            let fault = Fault::Inconsistent(format!("`{text}` is not of the form key.path=value"));
            self.faults.add(format!("--set {text}"), Some(whole), fault);
            return;
        };
        if toml::de::DeTable::parse(text).is_err() {
            let quoted = toml::Value::String(value.trim().to_owned());
            push(format!("{key}={quoted}"));
        }
        if let Some(overlay) = tree::parse(&self.sources, source_index, &self.faults) {
            tree::merge(table, overlay);
        }
    }
}

/// One line that starts with a key.
fn is_assignment(text: &str) -> bool {
    !text.contains(char::is_control) && !text.trim_start().starts_with(['[', '#', '='])
}

/// At most one byte more than allowed, so that a device file cannot fill the memory.
fn read_bounded(path: &Path) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    let file = fs::File::open(path)?;
    file.take(FILE_BYTES_MAX + 1).read_to_end(&mut bytes)?;
    let file = TextFile::decode(&bytes).map_err(std::io::Error::other)?;
    Ok(file.text().to_owned())
}

/// One name per file, whatever the path that leads to it.
fn identity(path: &Path) -> PathBuf {
    fs::canonicalize(path).unwrap_or_else(|_absent| path.to_path_buf())
}
