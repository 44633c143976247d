//! Where the tables of a file are checked against each other: what is refused is noted at the place
//! of its key in the file.

use super::errors::{Fault, Faults, Place};
use super::tree::{self, Table, join};

/// The tree of the file, and what is wrong with it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Checks<'t> {
    pub tree: &'t Table,
    pub faults: &'t Faults,
    /// Where a missing table would stand.
    pub top: Place,
}

impl Checks<'_> {
    /// Notes a fault of the key at `path`, at its value or, where the file does not have it, at the
    /// table that would.
    pub(super) fn refuse(&self, path: impl Into<String>, fault: Fault) {
        let path = path.into();
        self.refuse_at(path.clone(), &path, fault);
    }

    /// The same at the place of another key.
    pub(super) fn refuse_at(&self, path: String, other: &str, fault: Fault) {
        let place = tree::place_of(self.tree, other).unwrap_or(self.top);
        self.faults.add(path, Some(place), fault);
    }

    /// Notes that keys do not go together.
    pub(super) fn refuse_because(&self, path: impl Into<String>, why: impl Into<String>) {
        self.refuse(path, Fault::Inconsistent(why.into()));
    }

    /// Notes that each of `keys` that the table at `path` has does not belong there, and why.
    pub(super) fn refuse_present(
        &self,
        path: &str,
        keys: impl IntoIterator<Item = &'static str>,
        why: &str,
    ) {
        for key in keys {
            let path = join(path, key);
            if let Some(node) = tree::find(self.tree, &path) {
                let fault = Fault::Inconsistent(why.to_owned());
                self.faults.add(path, Some(node.key_place), fault);
            }
        }
    }

    /// True when the file has the key at `path`.
    pub(super) fn has(&self, path: &str) -> bool {
        tree::find(self.tree, path).is_some()
    }

    /// True while nothing is wrong.
    pub(super) fn is_clean(&self) -> bool {
        self.faults.is_empty()
    }
}
