//! What every decoder must keep, whatever the bytes it is given: one [`Target`] per decoder. The
//! tests replay the corpus and all regressions through them; `tests/fuzz` searches for new inputs.
//! It decodes nothing itself and holds no expectation of a particular input.
//!
//! A target panics when a promise is broken. Beyond "no panic" it checks that what was read can be
//! written and read again as the same, that nothing is read beyond the input, that what is refused
//! has a cause, that counters add up, and that memory stays within a bound of the input's length.

mod bridges;
mod capture;
mod egm;
mod gateway;
mod input;
mod motion;
#[cfg(feature = "recorder")]
mod recorder;
#[cfg(feature = "runtime")]
mod runtime;
mod seeds;
#[cfg(feature = "runtime")]
mod topology;
mod trace;

use std::alloc::System;
use std::path::{Path, PathBuf};

use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

/// Counts what every decoder allocates.
#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// What a decoder made of an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// It, or a part of it, meant something.
    Accepted,
    /// Nothing of it did.
    Refused,
}

impl Verdict {
    /// [`Verdict::Accepted`] if `is_accepted`.
    pub const fn of(is_accepted: bool) -> Self {
        if is_accepted {
            Self::Accepted
        } else {
            Self::Refused
        }
    }
}

/// An input of the corpus that ships: its file name and its bytes.
pub type Seed = (String, Vec<u8>);

/// One decoder and what it must keep.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Name of the fuzz target and of its folders.
    pub name: &'static str,
    /// What it decodes, in words.
    pub what: &'static str,
    /// Decodes and checks; panics when a promise is broken.
    run: fn(&[u8]) -> Verdict,
    /// Makes its seeds with the product's own encoders.
    seeds: fn() -> Vec<Seed>,
    /// Bytes it may allocate in all: so many, and so many for each byte of the input. Everything
    /// allocated counts, whether or not it was freed, what the checks themselves need included.
    allocation_bytes: (usize, usize),
}

impl Target {
    /// Decodes `input` and checks what came of it.
    ///
    /// # Panics
    /// When the decoder broke a promise: that is a finding.
    pub fn check(&self, input: &[u8]) -> Verdict {
        let region = Region::new(ALLOCATOR);
        let verdict = (self.run)(input);
        let allocated_bytes = region.change().bytes_allocated;
        let (least, per_byte) = self.allocation_bytes;
        let bound_bytes = least + per_byte * input.len();
        assert!(
            allocated_bytes <= bound_bytes,
            "{}: {allocated_bytes} bytes allocated for {} bytes of input, at most {bound_bytes}",
            self.name,
            input.len()
        );
        verdict
    }

    /// The inputs that the generator makes.
    pub fn seeds(&self) -> Vec<Seed> {
        (self.seeds)()
    }

    /// Where its seeds lie in the source tree.
    pub fn corpus_folder(&self) -> PathBuf {
        package_folder().join("corpus").join(self.name)
    }

    /// Where inputs lie that once broke a promise.
    pub fn regressions_folder(&self) -> PathBuf {
        package_folder().join("regressions").join(self.name)
    }
}

fn package_folder() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The target called `name`.
///
/// # Panics
/// When there is none.
pub fn target(name: &str) -> &'static Target {
    let found = TARGETS.iter().find(|target| target.name == name);
    found.unwrap_or_else(|| panic!("no target is called {name}"))
}

const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;

macro_rules! targets {
    ($($(#[$when:meta])? $name:ident: $what:literal, $run:path, $seeds:path, $allocation:expr;)*) => {
        /// Every decoder of the workspace that reads what others wrote.
        pub const TARGETS: &[Target] = &[$($(#[$when])? Target {
            name: stringify!($name),
            what: $what,
            run: $run,
            seeds: $seeds,
            allocation_bytes: $allocation,
        }),*];
    };
}

targets! {
    datagram: "a datagram between gateways", gateway::datagram, seeds::datagrams, (KIB, 8);
    reassembly: "fragments of messages", gateway::reassembly, seeds::reassembly, (128 * KIB, 64);
    conversation: "a gateway pair over a bad network, and forged datagrams between them",
        bridges::conversation, seeds::conversations, (4 * MIB, 8 * KIB);
    tcp_stream: "datagrams in a TCP stream", gateway::tcp_stream, seeds::tcp_streams, (512 * KIB, 64);
    control_messages: "what the kernel says beside a datagram",
        gateway::control_messages, seeds::control_messages, (KIB, 8);
    capture: "pcap and pcapng files", capture::capture, seeds::captures, (64 * KIB, KIB);
    frame: "a captured frame: ESL header, link layer, IP, UDP, the flow it belongs to",
        capture::frame, seeds::frames, (64 * KIB, 64);
    trace: "a trace file in its binary form", trace::binary, seeds::traces, (64 * KIB, KIB);
    trace_csv: "a trace as text", trace::csv, seeds::trace_texts, (256 * KIB, 4 * KIB);
    opportunities: "a trace of delivery opportunities", trace::opportunities,
        seeds::opportunities, (64 * KIB, 4 * KIB);
    egm: "the maker's datagrams", egm::datagrams, seeds::egm_datagrams, (16 * KIB, 256);
    egm_session: "a session of them with either adapter", egm::session, seeds::egm_sessions,
        (256 * KIB, 256);
    motion: "a motion file", motion::bvh, seeds::motions, (64 * KIB, KIB);
    #[cfg(feature = "runtime")]
    topology: "a topology file", topology::topology, seeds::topologies, (8 * MIB, 64 * KIB);
    #[cfg(feature = "runtime")]
    record_file: "a record file", runtime::record_file, seeds::record_files, (64 * KIB, 64);
    #[cfg(feature = "runtime")]
    peer_frames: "what supervisors tell each other", runtime::peer_frames, seeds::peer_frames,
        (4 * MIB, KIB);
    #[cfg(feature = "runtime")]
    summary: "the summary of a run", runtime::summary, seeds::summaries, (MIB, 4 * KIB);
    #[cfg(feature = "runtime")]
    layout: "the layout of a message, and a message by it", runtime::layout, seeds::layouts,
        (4 * MIB, 16 * KIB);
    #[cfg(feature = "runtime")]
    radio: "what the kernel says of a radio", runtime::radio, seeds::radio_answers, (KIB, 64);
    #[cfg(feature = "runtime")]
    words: "durations, addresses, flows, and what time daemons say", runtime::words, seeds::words,
        (64 * KIB, 256);
    #[cfg(feature = "recorder")]
    viewer_request: "the head of a viewer's request", recorder::viewer_request,
        seeds::viewer_requests, (64 * KIB, 256);
    #[cfg(feature = "recorder")]
    recording: "an MCAP file", recorder::recording, seeds::recordings, (8 * MIB, 64 * KIB);
    #[cfg(feature = "recorder")]
    recorded_message: "a message as a recording has it", recorder::recorded_message,
        seeds::recorded_messages, (4 * MIB, 16 * KIB);
}
