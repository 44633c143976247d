//! Commands that read what others left say how far they are when that takes longer than a moment, and
//! say it beside their result. What they read comes through a pipe that keeps them waiting, so the
//! test does not depend on how fast the machine is.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{ChildGuard, Finished};
use hil_trace::{
    Trace, TraceArrival, TraceDirection, TraceFate, TraceHeader, TraceRecord, UNAVAILABLE_NS, wire,
};
use nix::errno::Errno;
use nix::fcntl::OFlag;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;

/// Longer than a command is silent, by more than two of its lines' periods.
const KEPT_WAITING: Duration = Duration::from_millis(2500);
/// No command here takes a tenth of this on an overloaded machine.
const LIMIT: Duration = Duration::from_mins(1);

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let folder =
            std::env::temp_dir().join(format!("hil-progress-{name}-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _is_gone = fs::remove_dir_all(&self.0).is_ok();
    }
}

/// Runs the command while `bytes` come through a pipe at `pipe`, the first of them late.
fn kept_waiting(pipe: &Path, bytes: &[u8], arguments: &[&str]) -> Finished {
    mkfifo(pipe, Mode::S_IRUSR | Mode::S_IWUSR).unwrap();
    let mut command = Command::new(hil_runtime_binary());
    let mut child = ChildGuard::spawn(command.args(arguments)).unwrap();
    if let Some(mut writer) = opened(pipe, &mut child) {
        thread::sleep(KEPT_WAITING);
        // Fails when the command has ended meanwhile; what it said is looked at below.
        let _is_taken = writer.write_all(bytes).is_ok();
    }
    child.wait_within(LIMIT).unwrap()
}

/// The writing end of `pipe` once the command reads; `None` when it ends without doing so. Opened in the
/// usual way it would wait for a reader for ever.
fn opened(pipe: &Path, child: &mut ChildGuard) -> Option<File> {
    let deadline = Instant::now() + LIMIT;
    let mut options = OpenOptions::new();
    options.write(true).custom_flags(OFlag::O_NONBLOCK.bits());
    while child.is_running() {
        match options.open(pipe) {
            Ok(file) => return Some(file),
            Err(error) => assert_eq!(error.raw_os_error(), Some(Errno::ENXIO as i32)),
        }
        assert!(Instant::now() < deadline, "{}", child.stderr_so_far());
        thread::sleep(Duration::from_millis(10));
    }
    None
}

/// The command said what it does and for how long on standard error, and only there.
fn assert_shown(output: &Finished, words: &str) {
    let (stdout, stderr) = (&output.stdout, &output.stderr);
    let told = stderr.lines().find(|line| line.contains(words));
    let line = told.unwrap_or_else(|| panic!("no line says {words:?}\n{stderr}"));
    assert!(
        line.starts_with("0:0"),
        "{line:?} does not begin with the time passed"
    );
    assert!(!stdout.contains(words), "{stdout}");
    // No terminal is there, so there is nothing to redraw.
    assert!(
        !stderr.contains('\r') && !stderr.contains('\x1b'),
        "{stderr:?}"
    );
}

fn trace() -> Vec<u8> {
    let record = |sequence: u64| {
        let published_ns = i64::try_from(sequence).unwrap() * 10_000_000;
        TraceRecord {
            published_ns,
            departure_ns: published_ns,
            delay_ns: 1_000_000,
            bound_ns: 0,
            second_delay_ns: UNAVAILABLE_NS,
            sequence,
            size_bytes: 64,
            start: 0,
            fate: TraceFate::Delivered,
            flags: 0,
        }
    };
    let header = TraceHeader {
        run: "slow".to_owned(),
        channel: "shuttle/state".to_owned(),
        link: "hop".to_owned(),
        clock: "one clock".to_owned(),
        direction: TraceDirection::Forward,
        arrival: TraceArrival::Received,
        link_change_count: 0,
        origin_ns: 0,
        duration_ns: 1_000_000_000,
    };
    let trace = Trace {
        header,
        records: (0..100).map(record).collect(),
    };
    wire::encode(&trace).unwrap()
}

#[test]
fn a_trace_that_takes_long_to_read_says_so() {
    let folder = Folder::new("trace");
    let pipe = folder.path("slow.trace");
    let output = kept_waiting(&pipe, &trace(), &["trace", "info", pipe.to_str().unwrap()]);
    assert_shown(&output, "reading ");
    output.assert_success();
    assert!(output.stdout.contains("shuttle/state"));
}

#[test]
fn a_conversion_that_takes_long_says_so_and_is_whole() {
    let folder = Folder::new("convert");
    let (pipe, into) = (folder.path("slow.trace"), folder.path("made.csv"));
    let arguments = [
        "trace",
        "convert",
        pipe.to_str().unwrap(),
        into.to_str().unwrap(),
    ];
    let output = kept_waiting(&pipe, &trace(), &arguments);
    assert_shown(&output, "reading ");
    output.assert_success();
    assert!(fs::read_to_string(into).unwrap().lines().count() > 100);
}

#[test]
fn packets_that_take_long_to_read_say_so() {
    let folder = Folder::new("probe");
    let pipe = folder.path("slow.pcap");
    // The header of an empty capture: little-endian, microseconds, Ethernet.
    let words: [u32; 6] = [0xa1b2_c3d4, 0x0004_0002, 0, 0, 65_535, 1];
    let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    let output = kept_waiting(&pipe, &bytes, &["probe", "analyse", pipe.to_str().unwrap()]);
    assert_shown(&output, "reading packets");
    assert!(output.stdout.contains("0 packets"), "{output:?}");
}

#[test]
fn runs_that_take_long_to_read_say_so() {
    for (command, words) in [
        (&["report"][..], "reading the summary"),
        (&["report", "--format", "md"], "reading "),
        (&["compare"], "reading runs"),
    ] {
        let folder = Folder::new(&format!("{}-{}", command[0], command.len()));
        let pipe = folder.path("summary.json");
        let run = folder.0.to_str().unwrap();
        let mut arguments = command.to_vec();
        arguments.push(run);
        if command[0] == "compare" {
            arguments.push(run);
        }
        // What comes is no summary: that it is refused is said as ever.
        let output = kept_waiting(&pipe, b"{}", &arguments);
        assert_shown(&output, words);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        assert!(output.stderr.contains("summary.json"));
    }
}
