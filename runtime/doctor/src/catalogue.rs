//! Everything the doctor can find: identifier, where it is read, why it matters and the cure. One
//! table for the report, the JSON and `docs/doctor.md`, so that they cannot differ. It examines
//! nothing.

mod machine;
mod network;

#[cfg(test)]
use super::finding::Severity;

/// One thing that is looked at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    /// Stable identifier. Where there are several of a kind, a finding adds `.<which>`.
    pub(super) id: &'static str,
    /// What is looked at, for people.
    pub(super) title: &'static str,
    /// Where it is read; `{}` stands for which one.
    pub(super) source: &'static str,
    /// What it does to a measurement, in the units of one.
    pub(super) why: &'static str,
    /// The general cure, a command where there is one; `{}` as above.
    pub(super) fix: &'static str,
}

/// All of them, by subject, in the order of the page.
pub(super) const SUBJECTS: [(&str, &[Entry]); 6] = [
    ("Kernel", machine::KERNEL),
    ("Processors", machine::PROCESSORS),
    ("Rights of this user", machine::RIGHTS),
    ("Network", network::NETWORK),
    ("Clocks", network::CLOCKS),
    ("Memory and files", machine::MEMORY),
];

/// The entry called `id`.
pub(super) fn entry(id: &str) -> Option<&'static Entry> {
    let mut all = SUBJECTS.iter().flat_map(|(_, entries)| entries.iter());
    all.find(|entry| entry.id == id)
}

/// The part of `docs/doctor.md` that lists every finding.
#[cfg(test)]
fn page() -> String {
    use core::fmt::Write as _;
    let mut text = String::new();
    let which = |words: &str| words.replace("{}", "NAME").replace('|', "\\|");
    for (subject, entries) in SUBJECTS {
        write!(
            text,
            "\n### {subject}\n\n| Id | What, and where it is read | Why | Fix |\n|---|---|---|---|\n"
        )
        .unwrap();
        for entry in entries {
            let Entry {
                id,
                title,
                source,
                why,
                fix,
            } = entry;
            let is_one_of_several = source.contains("{}") || fix.contains("{}");
            let suffix = if is_one_of_several { ".NAME" } else { "" };
            let (source, fix) = (which(source), which(fix));
            writeln!(
                text,
                "| `{id}{suffix}` | {title}: {source} | {why} | {fix} |"
            )
            .unwrap();
        }
    }
    text
}

/// How much a severity weighs, for the page.
#[cfg(test)]
const fn meaning(severity: Severity) -> &'static str {
    match severity {
        Severity::Ok => "as it should be",
        Severity::Note => "costs something that a careful reader wants to know of",
        Severity::CannotTell => "could not be read; never taken for ok",
        Severity::Warning => "spoils figures in microseconds, or a run as the topology wants it",
        Severity::Error => "prevents a run, or makes its figures wrong",
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;

    const BEGIN: &str = "<!-- findings: begin -->\n";
    const END: &str = "\n<!-- findings: end -->";

    fn document() -> (std::path::PathBuf, String) {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/doctor.md");
        let text = std::fs::read_to_string(&path).unwrap();
        (path, text)
    }

    #[test]
    fn identifiers_are_unique_and_nothing_is_left_unsaid() {
        let mut seen = BTreeSet::new();
        for entry in SUBJECTS.iter().flat_map(|(_, entries)| entries.iter()) {
            assert!(seen.insert(entry.id), "{} twice", entry.id);
            let is_plain = |c: char| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit();
            assert!(entry.id.chars().all(is_plain), "{}", entry.id);
            for words in [entry.title, entry.source, entry.why, entry.fix] {
                assert!(words.len() > 3, "{entry:?}");
                assert!(!words.ends_with('.'), "{entry:?}");
            }
        }
    }

    /// `HIL_WRITE_DOCS=1` writes the table into the page instead.
    #[test]
    fn the_page_lists_every_finding_as_the_program_knows_it() {
        let (path, text) = document();
        let (before, rest) = text.split_once(BEGIN).expect("the page has its mark");
        let (listed, after) = rest.split_once(END).expect("the page has its end mark");
        if std::env::var_os("HIL_WRITE_DOCS").is_some() {
            let written = format!("{before}{BEGIN}{}{END}{after}", page());
            std::fs::write(path, written).unwrap();
        } else {
            assert_eq!(listed, page(), "run this test with HIL_WRITE_DOCS=1");
        }
    }

    #[test]
    fn the_page_explains_the_severities_as_the_program_means_them() {
        let (_, text) = document();
        for severity in Severity::ALL {
            let line = format!("| `{}` | {} |", severity.word(), meaning(severity));
            assert!(text.contains(&line), "{line} is missing");
        }
    }
}
