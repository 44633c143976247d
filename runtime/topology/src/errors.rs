//! What can be wrong with a topology file, and where: file, line, column, key, value, what is
//! allowed. It finds no fault itself and prints nothing.

use core::cell::RefCell;
use core::fmt;
use core::ops::Range;

use annotate_snippets::{AnnotationKind, Group, Level, Renderer, Snippet};

use super::suggest::{listed, nearest};

/// Errors that are told at once: of a file that is no topology at all, every line would be one.
const TOLD_MAX: usize = 10;

/// Everything wrong with a topology, in the order of files and lines; never empty.
#[derive(Debug)]
pub struct TopologyErrors {
    errors: Vec<TopologyError>,
    sources: Vec<Source>,
}

/// One thing that is wrong.
#[derive(Debug)]
pub struct TopologyError {
    /// Path of the key, e.g. `links.hop.loss_ratio`; empty for the file as a whole.
    pub key: String,
    /// What is wrong with it.
    pub fault: Fault,
    /// Where it stands; `None` when no file could be read.
    pub location: Option<Location>,
}

/// A place in a file, or in an override of the command line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Location {
    /// Path of the file as it was named, or `--set`.
    pub file: String,
    /// Line, from 1.
    pub line: usize,
    /// Column in characters, from 1.
    pub column: usize,
    span: Range<usize>,
    source_index: usize,
}

/// What is wrong with a key. Each text reads on from the key's path.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// The file could not be read.
    #[error("{file} cannot be read")]
    Unreadable {
        /// Its path.
        file: String,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The file is larger than a topology can be.
    #[error("{file} has more than {size_bytes_max} bytes")]
    TooLarge {
        /// Its path.
        file: String,
        /// What is allowed.
        size_bytes_max: u64,
    },
    /// Not TOML.
    #[error("is not valid TOML: {0}")]
    Syntax(String),
    /// A file extends itself.
    #[error("leads back to a file of its own chain: {}", .0.join(" -> "))]
    ExtendsCycle(Vec<String>),
    /// A chain of files is too long.
    #[error("makes a chain of more than {0} files")]
    ExtendsTooDeep(usize),
    /// No key of this name is allowed here.
    #[error("is not a known key")]
    UnknownKey {
        /// The keys that are.
        allowed: Vec<String>,
    },
    /// The key must be there.
    #[error("is missing: {0}")]
    Missing(String),
    /// A value of another type.
    #[error("is {found}, expected {expected}")]
    WrongType {
        /// What it is.
        found: &'static str,
        /// What it must be.
        expected: String,
    },
    /// A text in the place of a number, with a comma where a point is expected.
    #[error("\"{value}\" has a decimal comma, write {point}")]
    DecimalComma {
        /// What it is.
        value: String,
        /// What is meant.
        point: String,
    },
    /// A number beyond its bounds.
    #[error("{value} is outside {allowed}")]
    OutOfRange {
        /// What it is.
        value: String,
        /// `min..=max`.
        allowed: String,
    },
    /// A text that is no duration.
    #[error("\"{value}\" {reason}, expected a number and a unit (h, min, s, ms, us, ns)")]
    Duration {
        /// What it is.
        value: String,
        /// What it lacks.
        reason: String,
    },
    /// A word, or the name of a host, process, role, link or case, that does not exist.
    #[error("`{value}` is not {expected}")]
    UnknownWord {
        /// What it is.
        value: String,
        /// What it should name, e.g. `a host`.
        expected: &'static str,
        /// What it may be.
        allowed: Vec<String>,
    },
    /// Two keys, or a key and a case, that do not go together.
    #[error("{0}")]
    Inconsistent(String),
    /// The case study refuses a parameter.
    #[error("{0}")]
    Parameter(String),
    /// What the key names or asks for is not there.
    #[error("cannot be used: {0}")]
    Unusable(String),
}

impl Fault {
    /// What to do about it, where that can be said.
    pub fn help(&self, key: &str) -> Option<String> {
        let (wrong, allowed) = match self {
            Self::UnknownKey { allowed } => (last_segment(key), allowed),
            Self::UnknownWord { value, allowed, .. } => (value.as_str(), allowed),
            _ => return None,
        };
        if let Some(near) = nearest(wrong, allowed.iter().map(String::as_str)) {
            return Some(format!(
                "did you mean `{near}`? Allowed: {}",
                listed(allowed)
            ));
        }
        (!allowed.is_empty()).then(|| format!("allowed: {}", listed(allowed)))
    }
}

/// The last name of a path, without quotes.
fn last_segment(path: &str) -> &str {
    if let Some(inner) = path.strip_suffix('"') {
        return inner.rsplit_once('"').map_or(inner, |(_, name)| name);
    }
    path.rsplit_once('.').map_or(path, |(_, name)| name)
}

impl fmt::Display for TopologyError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(Location {
            file, line, column, ..
        }) = &self.location
        {
            write!(formatter, "{file}:{line}:{column}: ")?;
        }
        formatter.write_str(&self.statement())?;
        if let Some(help) = self.fault.help(&self.key) {
            write!(formatter, "; {help}")?;
        }
        Ok(())
    }
}

impl std::error::Error for TopologyError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        std::error::Error::source(&self.fault)
    }
}

impl TopologyError {
    /// Key, fault and cause in one line, without the location.
    fn statement(&self) -> String {
        let gap = if self.key.is_empty() { "" } else { " " };
        let cause = match &self.fault {
            Fault::Unreadable { source, .. } => format!(": {source}"),
            _ => String::new(),
        };
        format!("{}{gap}{}{cause}", self.key, self.fault)
    }
}

impl TopologyErrors {
    /// The errors, in the order of files and lines.
    pub fn errors(&self) -> &[TopologyError] {
        &self.errors
    }

    /// The first errors as annotated snippets of the files, with terminal colours if wanted.
    pub fn render(&self, with_colours: bool) -> String {
        let renderer = if with_colours {
            Renderer::styled()
        } else {
            Renderer::plain()
        };
        let told = self.errors.iter().take(TOLD_MAX);
        let blocks = told.map(|error| renderer.render(&[self.report(error)]));
        let blocks: Vec<_> = blocks.chain(self.untold()).collect();
        blocks.join("\n\n")
    }

    /// Words for the errors that are not told.
    fn untold(&self) -> Option<String> {
        let count = self.errors.len().saturating_sub(TOLD_MAX);
        (count > 0).then(|| format!("and {count} more"))
    }

    fn report<'a>(&'a self, error: &'a TopologyError) -> Group<'a> {
        let mut group =
            Level::ERROR
                .primary_title(error.statement())
                .elements(core::iter::empty::<
                    Snippet<'_, annotate_snippets::Annotation<'_>>,
                >());
        if let Some(location) = &error.location {
            let source = &self.sources[location.source_index];
            let here = AnnotationKind::Primary.span(location.span.clone());
            let snippet = Snippet::source(source.text.as_str())
                .path(source.name.as_str())
                .annotation(here);
            group = group.element(snippet);
        }
        if let Some(help) = error.fault.help(&error.key) {
            group = group.element(Level::HELP.message(help));
        }
        group
    }
}

impl fmt::Display for TopologyErrors {
    /// One line for each of the first errors.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let told = self.errors.iter().take(TOLD_MAX).map(ToString::to_string);
        let lines: Vec<String> = told.chain(self.untold()).collect();
        formatter.write_str(&lines.join("\n"))
    }
}

impl std::error::Error for TopologyErrors {}

/// A text that keys can stand in: a file, or one override.
#[derive(Debug)]
pub(super) struct Source {
    pub name: String,
    pub text: String,
}

/// A range of bytes in one source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Place {
    pub source_index: usize,
    pub start: usize,
    pub end: usize,
}

/// Collects faults while reading and checking, the first one per key.
#[derive(Debug, Default)]
pub(super) struct Faults {
    found: RefCell<Vec<(String, Fault, Option<Place>)>>,
}

impl Faults {
    /// Notes a fault, unless its key has one already, or is said to be missing because something
    /// below it is faulty: what follows from a fault is noise.
    pub(super) fn add(&self, key: impl Into<String>, place: Option<Place>, fault: Fault) {
        let key = key.into();
        let mut found = self.found.borrow_mut();
        let below = format!("{key}.");
        let is_missing = matches!(fault, Fault::Missing(_));
        let says_it_already = |known: &String| {
            *known == key || (is_missing && !key.is_empty() && known.starts_with(&below))
        };
        let is_syntax = matches!(fault, Fault::Syntax(_));
        if is_syntax || !found.iter().any(|(known, ..)| says_it_already(known)) {
            found.push((key, fault, place));
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.count() == 0
    }

    pub(super) fn count(&self) -> usize {
        self.found.borrow().len()
    }

    /// Turns places into lines and columns of `sources`.
    pub(super) fn into_errors(self, sources: Vec<Source>) -> TopologyErrors {
        let mut found = self.found.into_inner();
        found.sort_by_key(|(_, _, place)| *place);
        let errors = found
            .into_iter()
            .map(|(key, fault, place)| TopologyError {
                key,
                fault,
                location: place.map(|place| locate(place, &sources)),
            })
            .collect();
        TopologyErrors { errors, sources }
    }
}

fn locate(place: Place, sources: &[Source]) -> Location {
    let source = &sources[place.source_index];
    let start = source.text.floor_char_boundary(place.start);
    let end = source.text.floor_char_boundary(place.end).max(start);
    let before = &source.text[..start];
    let line_start = before.rfind('\n').map_or(0, |index| index + 1);
    Location {
        file: source.name.clone(),
        line: before.matches('\n').count() + 1,
        column: before[line_start..].chars().count() + 1,
        span: start..end,
        source_index: place.source_index,
    }
}
