//! What `[links.<name>.trace]` says, read and written back; see `file_links`. It opens no trace.

use hil_core::link_model::TraceMatch;
use hil_link::trace::{TraceEnd, TraceReplay};
use toml::{Table, Value};

use super::errors::Fault;
use super::limits;
use super::reader::Reader;
use super::resolved::{duration, put};
use crate::trace_source::{BaseFolder, NotedDelays, TraceSource};

const MATCHES: &[(&str, TraceMatch)] = &[
    ("index", TraceMatch::Index),
    ("time", TraceMatch::Time),
    ("tick", TraceMatch::Tick),
];

const ENDS: &[(&str, TraceEnd)] = &[
    ("wrap", TraceEnd::Wrap),
    ("perfect", TraceEnd::Perfect),
    ("lost", TraceEnd::Lost),
];

/// The traces of a link: a table, or the folder alone.
pub(super) fn read_trace(reader: &mut Reader<'_>) -> Option<TraceSource> {
    if !reader.has("trace") {
        return None;
    }
    if !reader.is_table("trace") {
        let folder = reader.text("trace")?.value;
        return Some(TraceSource {
            folder: Some(folder),
            files: std::collections::BTreeMap::new(),
            replay: TraceReplay::default(),
            base: BaseFolder::default(),
            noted: NotedDelays::default(),
        });
    }
    let mut table = reader.table("trace")?;
    let folder = table.text("folder").map(|folder| folder.value);
    let files = table.text_table("files");
    if !table.has("folder") && !table.has("files") {
        let hint = "name a folder of traces, e.g. \"runs/NAME/traces\", or files = { \"CHANNEL\" = \
                    \"FILE\" }";
        table.refuse("folder", Fault::Missing(hint.to_owned()));
    }
    let replay = TraceReplay {
        matching: table.word("match", MATCHES).unwrap_or_default(),
        end: table.word("end", ENDS).unwrap_or_default(),
        delay_otherwise: table.duration("delay", &limits::LINK_DELAY),
    };
    table.finish();
    Some(TraceSource {
        folder,
        files,
        replay,
        base: BaseFolder::default(),
        noted: NotedDelays::default(),
    })
}

/// The word of `value` in `words`.
fn word_of<T: PartialEq>(words: &[(&'static str, T)], value: &T) -> &'static str {
    let found = words.iter().find(|(_, known)| known == value);
    found.map_or("", |(word, _)| word)
}

/// The same in the shape of the file.
pub(super) fn resolved_trace(trace: &TraceSource) -> Table {
    let mut table = Table::new();
    if let Some(folder) = &trace.folder {
        put(&mut table, "folder", folder.clone());
    }
    if !trace.files.is_empty() {
        let files = trace.files.iter();
        let files = files.map(|(channel, file)| (channel.clone(), Value::String(file.clone())));
        put(&mut table, "files", files.collect::<Table>());
    }
    put(
        &mut table,
        "match",
        word_of(MATCHES, &trace.replay.matching),
    );
    put(&mut table, "end", word_of(ENDS, &trace.replay.end));
    if let Some(delay) = trace.replay.delay_otherwise {
        put(&mut table, "delay", duration(delay));
    }
    table
}
