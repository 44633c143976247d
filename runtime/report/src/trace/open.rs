//! Reads traces in any form for the command line, whole or not: what could be read is kept, and what
//! is wrong stands beside it.

use std::fs;
use std::path::{Path, PathBuf};

use hil_core::text_file::{TextFile, whole};
use hil_trace::{Trace, csv, opportunities, wire};

use hil_topology::trace_source::{TraceFileError, looks_like_text, read};

/// A trace, and what is wrong with its file.
#[derive(Debug)]
pub(crate) struct Opened {
    pub(crate) path: PathBuf,
    pub(crate) trace: Trace,
    /// With file and offset.
    pub(crate) fault: Option<String>,
    /// What the form of the file leaves open.
    pub(crate) remark: Option<&'static str>,
}

/// Every trace that `names` mean: files, and folders of traces or of a run, in order of names.
///
/// # Errors
/// When a folder has none, or cannot be read.
pub(crate) fn files(names: &[PathBuf]) -> Result<Vec<PathBuf>, String> {
    let mut found = Vec::new();
    for name in names {
        if !name.is_dir() {
            found.push(name.clone());
            continue;
        }
        let of_run = name.join("traces");
        let folder = if of_run.is_dir() { &of_run } else { name };
        let entries =
            fs::read_dir(folder).map_err(|error| format!("{}: {error}", name.display()))?;
        let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
        let is_trace = |path: &PathBuf| path.extension().is_some_and(|end| end == "trace");
        let mut inside: Vec<PathBuf> = paths.filter(is_trace).collect();
        if inside.is_empty() {
            let name = name.display();
            return Err(format!(
                "{name}: no traces here; a run leaves them in traces/ when a channel crossed a link"
            ));
        }
        inside.sort();
        found.append(&mut inside);
    }
    Ok(found)
}

/// Reads one file.
///
/// # Errors
/// When nothing of it can be read.
pub(crate) fn open(path: &Path) -> Result<Opened, TraceFileError> {
    let bytes = read(path)?;
    let named = |what: String| format!("{}: {what}", path.display());
    let path_owned = path.to_owned();
    if looks_like_text(&bytes) {
        let failed = |source| TraceFileError::Csv {
            path: path.to_owned(),
            source,
        };
        let text = TextFile::decode(&bytes).map_err(failed)?;
        if is_opportunities(&text) {
            let (trace, fault) = opportunities::decode(&text);
            return Ok(Opened {
                path: path_owned,
                trace,
                fault: fault.map(|fault| named(fault.to_string())),
                remark: Some(opportunities::DECODE_LOSS),
            });
        }
        let decoded = csv::decode(&text).map_err(failed)?;
        return Ok(Opened {
            path: path_owned,
            trace: decoded.trace,
            fault: decoded.fault.map(|fault| named(fault.to_string())),
            remark: None,
        });
    }
    let decoded = wire::decode(&bytes).map_err(|source| TraceFileError::Foreign {
        path: path.to_owned(),
        source,
    })?;
    Ok(Opened {
        path: path_owned,
        trace: decoded.trace,
        fault: decoded.fault.map(|fault| named(fault.to_string())),
        remark: None,
    })
}

/// One number per line, and nothing else in the first of them.
fn is_opportunities(text: &TextFile) -> bool {
    let mut lines = text
        .lines()
        .map(|line| line.content.trim().trim_matches('"'));
    let first = lines.find(|line| !line.is_empty());
    first.is_some_and(|line| whole::<u64>(line).is_some())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_form_is_found_by_content() {
        let is_form = |text: &str| is_opportunities(&text.into());
        assert!(is_form("\n17\n18\n") && is_form("\"17\"\n") && is_form("17.0\n"));
        assert!(!is_form("published_ns,delay_ns\n0,5\n"));
        assert!(!is_form("# run: x\n1\n"));
    }
}
