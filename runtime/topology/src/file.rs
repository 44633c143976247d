//! What each table of the file says by itself: types, ranges, words, and keys that exclude each
//! other. What the tables say about each other is checked in `check`.
//!
//! The tree is read by hand and not by `serde`'s derives, because those stop at the first fault
//! and lose the place of a key inside tagged tables.

use std::collections::BTreeMap;

use super::adapter::AdapterEntry;
use super::clock_path::{self, ClockEntry};
use super::errors::{Fault, Faults, Place};
use super::file_links::LinkEntry;
use super::limits;
use super::model::{Execution, Host, MessageLayout, OnExit, Run, Scheduling, Wait};
use super::reader::{At, Reader};
use super::security::Security;
use super::tree::Table;

/// The file, table by table.
#[derive(Debug)]
pub(super) struct File<'t> {
    pub name: String,
    pub run: Run,
    pub case: Option<CaseEntry<'t>>,
    pub hosts: Vec<HostEntry>,
    pub processes: Vec<ProcessEntry>,
    pub channels: Vec<ChannelEntry>,
    pub links: Vec<LinkEntry>,
    pub security: Security,
    /// Where a missing table would stand.
    pub place: Place,
}

#[derive(Debug)]
pub(super) struct CaseEntry<'t> {
    pub name: Option<At<String>>,
    pub parameters: Option<&'t Table>,
    pub place: Place,
}

#[derive(Debug)]
pub(super) struct HostEntry {
    pub host: Host,
    pub path: String,
    /// Of its address or, without one, of its key.
    pub place: Place,
    /// Where its clock address stands.
    pub clock: Option<ClockEntry>,
}

#[derive(Debug)]
pub(super) struct ProcessEntry {
    pub name: String,
    pub host: Option<At<String>>,
    pub role: Option<At<String>>,
    pub command: Option<Vec<String>>,
    pub environment: BTreeMap<String, String>,
    pub egm: Option<AdapterEntry>,
    pub execution: Execution,
    pub on_exit: OnExit,
    pub path: String,
    pub place: Place,
}

#[derive(Debug)]
pub(super) struct ChannelEntry {
    pub name: String,
    pub depth: usize,
    pub link: Option<At<String>>,
    pub message: Option<At<MessageLayout>>,
    pub from: Option<At<String>>,
    pub to: Option<At<String>>,
    pub path: String,
    pub place: Place,
}

impl ChannelEntry {
    /// The depth of a channel the file does not mention.
    pub(super) fn default_depth() -> usize {
        let depth = usize::try_from(limits::CHANNEL_DEPTH.default);
        depth.expect("a default depth is not negative")
    }

    /// The link's name, if the channel has one.
    pub(super) fn link_name(&self) -> Option<String> {
        self.link.as_ref().map(|link| link.value.clone())
    }
}

/// Reads the merged tree.
pub(super) fn read<'t>(table: &'t Table, place: Place, faults: &'t Faults) -> File<'t> {
    let mut root = Reader::new(String::new(), place, table, faults);
    if root.text("extends").is_some() {
        // Layers take it out of files, so it can only come from an override.
        let fault = "is read from files only, not from an override".to_owned();
        root.refuse("extends", Fault::Inconsistent(fault));
    }
    let version: Option<i64> = root.integer("version", &limits::VERSION);
    if version.is_none() && !root.has("version") {
        let default = limits::VERSION.default;
        root.refuse(
            "version",
            Fault::Missing(format!("write version = {default}")),
        );
    }
    let name = root.name("name");
    if name.is_none() && !root.has("name") {
        let hint = "it names the run's folder and report".to_owned();
        root.refuse("name", Fault::Missing(hint));
    }
    let file = File {
        name: name.map(|name| name.value).unwrap_or_default(),
        run: read_run(root.table("run")),
        case: root.table("case").map(read_case),
        hosts: each(&mut root, "hosts", read_host),
        processes: each(&mut root, "processes", read_process),
        channels: each(&mut root, "channels", read_channel),
        links: each(&mut root, "links", LinkEntry::read),
        security: Security::read(root.table("security")),
        place,
    };
    root.finish();
    file
}

fn each<'t, T>(
    root: &mut Reader<'t>,
    key: &'static str,
    read: impl Fn(String, Reader<'t>) -> T,
) -> Vec<T> {
    let tables = root.named_tables(key).into_iter();
    tables.map(|(name, reader)| read(name, reader)).collect()
}

fn read_run(reader: Option<Reader<'_>>) -> Run {
    let mut run = Run {
        duration: limits::RUN_DURATION.default,
        seed: limits::RUN_SEED.default.unsigned_abs(),
        record_folder: "runs".to_owned(),
        start_timeout: limits::RUN_START_TIMEOUT.default,
        peer_timeout: limits::RUN_PEER_TIMEOUT.default,
    };
    let Some(mut reader) = reader else {
        return run;
    };
    if let Some(duration) = reader.duration("duration", &limits::RUN_DURATION) {
        run.duration = duration;
    }
    if let Some(seed) = reader.integer("seed", &limits::RUN_SEED) {
        run.seed = seed;
    }
    if let Some(folder) = reader.text("record") {
        if folder.value.is_empty() {
            let fault = Fault::Inconsistent("is empty, expected the path of a folder".to_owned());
            reader.refuse("record", fault);
        }
        run.record_folder = folder.value;
    }
    if let Some(timeout) = reader.duration("start_timeout", &limits::RUN_START_TIMEOUT) {
        run.start_timeout = timeout;
    }
    if let Some(timeout) = reader.duration("peer_timeout", &limits::RUN_PEER_TIMEOUT) {
        run.peer_timeout = timeout;
    }
    reader.finish();
    run
}

fn read_case(mut reader: Reader<'_>) -> CaseEntry<'_> {
    let name = reader.text("name");
    // The keys below are the case's own; it checks them itself.
    let parameters = reader
        .table("parameters")
        .map(|parameters| parameters.unread());
    let place = reader.place;
    reader.finish();
    CaseEntry {
        name,
        parameters,
        place,
    }
}

fn read_host(name: String, mut reader: Reader<'_>) -> HostEntry {
    let address_text = reader.text("address");
    let place = address_text
        .as_ref()
        .map_or(reader.place, |text| text.place);
    let address =
        address_text.and_then(|text| clock_path::read_address(&reader, "address", &text.value));
    let interface = clock_path::read_interface(&mut reader, "interface");
    let (clock, clock_entry) = clock_path::read(&mut reader);
    let control_port = reader.integer("control_port", &limits::HOST_CONTROL_PORT);
    if !reader.has("address") {
        let why = "needs `address`: without it one supervisor runs this host and its peers";
        reader.refuse_present(&["control_port", "interface"], why);
    }
    let control_port = control_port.unwrap_or_else(|| default_port(&limits::HOST_CONTROL_PORT));
    let path = reader.path.clone();
    reader.finish();
    HostEntry {
        host: Host {
            name,
            address,
            interface,
            control_port,
            clock,
        },
        path,
        place,
        clock: clock_entry,
    }
}

fn default_port(limit: &limits::Limit<i64>) -> u16 {
    u16::try_from(limit.default).expect("a default port is within 1..=65535")
}

fn read_process(name: String, mut reader: Reader<'_>) -> ProcessEntry {
    let host = reader.text("host");
    let role = reader.text("role");
    let command = reader.texts("run").and_then(|command| {
        let words: Vec<_> = command.value.into_iter().map(|word| word.value).collect();
        if words.first().is_none_or(String::is_empty) {
            let fault = "is empty, expected a program and its arguments".to_owned();
            reader.refuse("run", Fault::Inconsistent(fault));
            return None;
        }
        Some(words)
    });
    if !reader.has("role") && !reader.has("run") {
        let hint = "write role = \"…\" for a built-in role of the case, or run = [\"…\"] for \
                    your own program";
        reader.refuse("role", Fault::Missing(hint.to_owned()));
    }
    let environment = reader.text_table("env");
    if !reader.has("run") {
        reader.refuse_present(
            &["env"],
            "needs `run`: a built-in role reads no environment",
        );
    }
    let egm = reader.table("egm").map(AdapterEntry::read);
    if egm.is_some() {
        let why =
            "does not go with `egm`: a foreign program that is not started here plays the role";
        reader.refuse_present(&["run"], why);
    }
    let execution = read_execution(&mut reader);
    let on_exit = read_on_exit(&mut reader, "end-run");
    let (path, place) = (reader.path.clone(), reader.place);
    reader.finish();
    ProcessEntry {
        name,
        host,
        role,
        command,
        environment,
        egm,
        execution,
        on_exit,
        path,
        place,
    }
}

/// The keys that processes and gateways have in common.
pub(super) fn read_execution(reader: &mut Reader<'_>) -> Execution {
    let cpus = reader.integers("cpu", &limits::CPU);
    let is_fifo = reader.word("scheduling", &[("other", false), ("fifo", true)]);
    let priority = reader.integer("priority", &limits::FIFO_PRIORITY);
    let scheduling = if is_fifo == Some(true) {
        let default = limits::FIFO_PRIORITY.default;
        let default = u8::try_from(default).expect("a default priority is within 1..=99");
        Scheduling::Fifo {
            priority: priority.unwrap_or(default),
        }
    } else {
        if is_fifo.is_some() || !reader.has("scheduling") {
            reader.refuse_present(&["priority"], "needs scheduling = \"fifo\"");
        }
        Scheduling::Other
    };
    Execution {
        cpus,
        scheduling,
        locks_memory: reader.boolean("lock_memory").unwrap_or(false),
        timer_slack: reader
            .duration("timer_slack", &limits::TIMER_SLACK)
            .unwrap_or(limits::TIMER_SLACK.default),
        wait: reader.word("wait", Wait::WORDS).unwrap_or(Wait::Block),
    }
}

/// `on_exit` and `restart_limit`.
pub(super) fn read_on_exit(reader: &mut Reader<'_>, default: &'static str) -> OnExit {
    let words = [("end-run", false), ("restart", true)];
    let says = reader.word("on_exit", &words);
    let limit = reader.integer("restart_limit", &limits::RESTART_LIMIT);
    let restarts = says.unwrap_or(default == "restart");
    if !restarts && (says.is_some() || !reader.has("on_exit")) {
        reader.refuse_present(&["restart_limit"], "needs on_exit = \"restart\"");
    }
    if !restarts {
        return OnExit::EndRun;
    }
    let default_limit = u32::try_from(limits::RESTART_LIMIT.default);
    let default_limit = default_limit.expect("a default count is not negative");
    OnExit::Restart {
        limit: limit.unwrap_or(default_limit),
    }
}

fn read_channel(name: String, mut reader: Reader<'_>) -> ChannelEntry {
    let depth = reader.integer("depth", &limits::CHANNEL_DEPTH);
    let entry = ChannelEntry {
        name,
        depth: depth.unwrap_or_else(ChannelEntry::default_depth),
        link: reader.text("link"),
        message: reader.table("message").and_then(read_message),
        from: reader.text("from"),
        to: reader.text("to"),
        path: reader.path.clone(),
        place: reader.place,
    };
    reader.finish();
    entry
}

fn read_message(mut reader: Reader<'_>) -> Option<At<MessageLayout>> {
    let name = reader.name("name");
    let size_bytes: Option<usize> = reader.integer("size_bytes", &limits::MESSAGE_SIZE_BYTES);
    for key in ["name", "size_bytes"] {
        if !reader.has(key) {
            let hint = "a foreign channel states the name and size of its messages";
            reader.refuse(key, Fault::Missing(hint.to_owned()));
        }
    }
    let default = usize::try_from(limits::MESSAGE_ALIGNMENT_BYTES.default);
    let alignment_bytes = reader
        .integer("alignment_bytes", &limits::MESSAGE_ALIGNMENT_BYTES)
        .unwrap_or(default.expect("a default alignment is not negative"));
    if !alignment_bytes.is_power_of_two() {
        let fault = format!("{alignment_bytes} is no power of two");
        reader.refuse("alignment_bytes", Fault::Inconsistent(fault));
    } else if size_bytes.is_some_and(|size| !size.is_multiple_of(alignment_bytes)) {
        let fault = format!("is no multiple of alignment_bytes, which is {alignment_bytes}");
        reader.refuse("size_bytes", Fault::Inconsistent(fault));
    }
    let place = reader.place;
    reader.finish();
    Some(At {
        value: MessageLayout {
            name: name?.value,
            size_bytes: size_bytes?,
            alignment_bytes,
        },
        place,
    })
}
