//! What a supervisor and the process it started say to each other, one JSON line at a time over
//! the child's standard input and output. Messages of channels never go this way.

use std::io::{self, BufRead, BufReader, Write};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use hil_arm::egm::messages::Side as ArmSide;
use hil_arm::egm::wire::Cause;
use hil_core::link_model::ReplayCounts;
use hil_core::time::Instant;
use nix::errno::Errno;
use serde::{Deserialize, Serialize};
use zeroize::Zeroizing;

use super::launch::Side;
use crate::file_fault::FileFault;
use crate::run_seal::RunSeal;
use hil_platform::realtime::RealtimeGrant;

/// From the supervisor to a process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ToProcess {
    /// The run's secret, the first word to a gateway whose hops are sealed. It goes this way because
    /// a launch file stays behind.
    Seal(RunSeal),
    /// Begin the run.
    Start {
        /// When it began on the host's monotonic clock; earlier than now for a process that was
        /// started again.
        at_ns: i64,
    },
    /// End, leaving everything in order.
    Stop,
}

/// From a process to its supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FromProcess {
    /// Everything is open; waiting for the start.
    Ready,
    /// Every loop of the process has turned since it last said so: a few times a second.
    Alive,
    /// Counts so far of the channels whose changed since they were told last, in an order that is always the
    /// same; a few times a second.
    Progress(Vec<ChannelProgress>),
    /// Grid points of the role's timer that passed without a tick so far; not of a role without one.
    SkippedTicks(u64),
    /// A condition the user should hear about now.
    Warning(String),
    /// A file of the run cannot be written: what the process records from now on is lost, and it ends.
    Unwritable(FileFault),
    /// The last word of an orderly end.
    Finished(Box<ProcessReport>),
    /// The process cannot go on.
    Failed(Failure),
}

/// Why a process or a run cannot go on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// What it means for whoever would try again.
    pub kind: FailureKind,
    /// Why, in words.
    pub text: String,
}

impl Failure {
    /// One that stays until something is changed.
    pub const fn fault(text: String) -> Self {
        let kind = FailureKind::Fault;
        Self { kind, text }
    }
}

/// What a failure means for whoever would try again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FailureKind {
    /// It stays until something is changed.
    Fault,
    /// An address, an interface or a port is not there yet, or in use: it may pass by itself.
    NotThereYet,
    /// This host gives too little: descriptors, threads or memory.
    HostTooSmall,
    /// A program of the user's that it runs ended with a fault, which need not come again.
    ProgramEnded,
}

impl FailureKind {
    /// Of what the system answered.
    pub fn of(error: &io::Error) -> Self {
        match error.raw_os_error().map(Errno::from_raw) {
            Some(
                Errno::EADDRINUSE
                | Errno::EADDRNOTAVAIL
                | Errno::ENODEV
                | Errno::ENETDOWN
                | Errno::ENETUNREACH
                | Errno::EHOSTUNREACH,
            ) => Self::NotThereYet,
            Some(
                Errno::EMFILE
                | Errno::ENFILE
                | Errno::EAGAIN
                | Errno::ENOMEM
                | Errno::ENOBUFS
                | Errno::ENOSPC,
            ) => Self::HostTooSmall,
            _ => Self::Fault,
        }
    }
}

/// Counts of one channel as one process sees it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChannelProgress {
    /// The channel.
    pub channel: String,
    /// What is counted, e.g. `published`, `taken`, `sent`, `received`.
    pub what: String,
    /// How many.
    pub count: u64,
}

/// What a process reports when it ends in order.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ProcessReport {
    /// What the kernel granted or refused, per thread.
    pub realtime: Vec<(String, RealtimeGrant)>,
    /// How long the role took to make: reading its parameters and computing what it needs.
    #[serde(default)]
    pub preparation_s: Option<f64>,
    /// Grid points of the role's timer that passed without a tick.
    pub skipped_ticks: u64,
    /// Ticks that ran.
    pub ticks: u64,
    /// Payloads that were not a message of their port.
    pub malformed_count: u64,
    /// Messages refused by a full outbox.
    pub outbox_dropped: u64,
    /// Readers or writers of its channels it could not connect to: they hear nothing of it.
    #[serde(default)]
    pub connection_failures: u64,
    /// Records dropped by a full ring.
    pub recorder_dropped: u64,
    /// Record files that could not be written any more.
    pub recorder_failures: Vec<FileFault>,
    /// Processor time of the whole process, seconds.
    pub cpu_s: f64,
    /// Context switches the process asked for (it waited).
    pub voluntary_switches: u64,
    /// Context switches forced on it.
    pub involuntary_switches: u64,
    /// Named counters of each way of its link that a gateway carries.
    pub directions: Vec<DirectionReport>,
    /// The arms of an adapter that speaks with a foreign program.
    #[serde(default)]
    pub faces: Vec<AdapterReport>,
    /// What an inlet lost of the frames of each of its channels.
    #[serde(default)]
    pub inlets: Vec<InletReport>,
}

/// Frames that were lost between a program and its channel: on this host, and in no network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InletReport {
    /// The channel that they would have come to, or came from.
    pub channel: String,
    /// Where they were lost, and how many.
    pub lost: Vec<CountByName>,
}

impl InletReport {
    /// Frames that the interface of the program that sent them dropped, as it counts them.
    pub const DROPPED_SENT: &str = "dropped by the interface of the sender";
    /// Frames that the interface of the program that they were given to dropped, as it counts them.
    pub const DROPPED_GIVEN: &str = "dropped by the interface of the receiver";
    /// Of those given to it, the ones that the kernel did not take: each has a fate of its own, whether or not the
    /// interface counts it.
    pub const REFUSED: &str = "refused by the interface of the program";
}

hil_core::labelled! {
    /// What of a direction or arm counted something.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum CounterGroup, prefix {
        /// The direction or arm itself.
        Own = "",
        /// What it refused, by cause.
        Refused = "refused: ",
        /// Its socket.
        Socket = "socket: ",
        /// Its transport: what only that one counts.
        Transport = "transport: ",
        /// Its seal, where its hop is sealed.
        Seal = "seal: ",
        /// The order of messages.
        Messages = "messages: ",
        /// The pieces of messages.
        Pieces = "pieces: ",
        /// Its replies.
        Replies = "replies: ",
        /// Commands that were not sent, by cause.
        NotSent = "commands not sent: ",
    }
}

/// How often something was counted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CountByName {
    /// By what.
    pub group: CounterGroup,
    /// What was counted.
    pub name: String,
    /// How often.
    pub count: u64,
}

impl CountByName {
    /// Of each of `counts`.
    pub fn all<'a>(
        group: CounterGroup,
        counts: impl IntoIterator<Item = (&'a str, u64)>,
    ) -> impl Iterator<Item = Self> {
        counts.into_iter().map(move |(name, count)| Self {
            group,
            name: name.to_owned(),
            count,
        })
    }

    /// What a report calls it.
    pub fn label(&self) -> String {
        format!("{}{}", self.group.prefix(), self.name)
    }
}

/// Why an adapter could not use a datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AdapterRefusal {
    /// The protocol does not allow it.
    Protocol(Cause),
    /// It came from another address than the robot's.
    ForeignAddress,
}

impl AdapterRefusal {
    /// A few words for a report.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Protocol(cause) => cause.label(),
            Self::ForeignAddress => "another address than the robot's",
        }
    }
}

/// How many datagrams an adapter could not use, and why.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusalCount {
    /// Why.
    pub cause: AdapterRefusal,
    /// How many.
    pub count: u64,
}

/// One arm of an adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdapterReport {
    /// Which arm.
    pub arm: ArmSide,
    /// The channel whose messages went out.
    pub outgoing: String,
    /// The channel that what came in went to.
    pub incoming: String,
    /// How the foreign program stood to it at the end, in words.
    pub peer_state: String,
    /// Everything it counted but what it refused.
    pub counters: Vec<CountByName>,
    /// What it refused; causes that did not occur may be among it.
    pub refusals: Vec<RefusalCount>,
    /// Facts in words: addresses, granted buffers, stamp probe.
    pub facts: Vec<(String, String)>,
}

/// One way of a link through a gateway: its thread and its socket, and each of its channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DirectionReport {
    /// Name of the flow.
    pub flow: String,
    /// Which way.
    pub direction: Side,
    /// The peer's state in words at the end.
    pub peer_state: String,
    /// Everything it counted that is of no one channel; zeros are left out by whoever prints.
    pub counters: Vec<CountByName>,
    /// Facts in words: granted buffers, stamp probe, path MTU.
    pub facts: Vec<(String, String)>,
    /// How often its stream stood still; `None` where it is none, or receives.
    #[serde(default)]
    pub stalls: Option<StallMetrics>,
    /// Its channels.
    pub channels: Vec<ChannelReport>,
}

/// One channel of one way of a link through a gateway.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelReport {
    /// The channel.
    pub channel: String,
    /// Everything counted of it alone.
    pub counters: Vec<CountByName>,
    /// What its link model met of the trace that it replays; `None` where it replays none.
    #[serde(default)]
    pub replay: Option<ReplayCounts>,
}

/// How often a stream stood still.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct StallMetrics {
    /// Times that a byte was not acknowledged within the limit.
    pub count: u64,
    /// All of them together, nanoseconds.
    pub total_ns: u64,
    /// The longest of them, nanoseconds.
    pub longest_ns: u64,
    /// The limit: twice the smallest round trip and 50 ms, nanoseconds.
    pub threshold_ns: u64,
}

/// The supervisor's latest word, readable without a system call.
#[derive(Debug)]
pub struct Orders {
    stop: Arc<AtomicBool>,
    start: RunStart,
    seal: Mutex<Receiver<RunSeal>>,
}

/// When the run began, for whoever counts from there; readable without a system call.
#[derive(Debug, Clone)]
pub struct RunStart(Arc<AtomicI64>);

/// A start that has not come.
const NOT_STARTED: i64 = i64::MIN;

impl Default for RunStart {
    /// Not yet.
    fn default() -> Self {
        Self(Arc::new(AtomicI64::new(NOT_STARTED)))
    }
}

impl RunStart {
    /// The run began at `at`.
    pub fn set(&self, at: Instant) {
        self.0.store(at.as_ns(), Ordering::Release);
    }

    /// When the run began; `None` before.
    pub fn get(&self) -> Option<Instant> {
        let at_ns = self.0.load(Ordering::Acquire);
        (at_ns != NOT_STARTED).then(|| Instant::from_ns(at_ns))
    }
}

impl Orders {
    /// Listens on standard input, as [`Orders::from_input`].
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn listen() -> io::Result<Self> {
        Self::from_input(BufReader::new(io::stdin()))
    }

    /// Listens in a thread of its own. An end of input means that the supervisor is gone, and counts
    /// as [`ToProcess::Stop`].
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn from_input(input: impl BufRead + Send + 'static) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let start = RunStart::default();
        let (sealed, seal) = channel();
        let (stopped, began) = (Arc::clone(&stop), start.clone());
        thread::Builder::new()
            .name("orders".to_owned())
            .spawn(move || {
                for line in input.lines() {
                    let line = line.ok().map(Zeroizing::new);
                    match line.and_then(|line| serde_json::from_str(&line).ok()) {
                        Some(ToProcess::Seal(seal)) => {
                            // A gateway of plain hops asks for none.
                            let _unasked = sealed.send(seal).is_err();
                        }
                        Some(ToProcess::Start { at_ns }) => began.set(Instant::from_ns(at_ns)),
                        Some(ToProcess::Stop) | None => break,
                    }
                }
                stopped.store(true, Ordering::Release);
            })?;
        let seal = Mutex::new(seal);
        Ok(Self { stop, start, seal })
    }

    /// When the run began.
    pub fn run_start(&self) -> RunStart {
        self.start.clone()
    }

    /// Set once the process should end, by an order or by whichever thread sets it.
    pub fn stop_flag(&self) -> &Arc<AtomicBool> {
        &self.stop
    }

    /// Waits up to `limit` for the run's secret; once.
    pub fn wait_for_seal(&self, limit: Duration) -> Option<RunSeal> {
        let seal = self.seal.lock().unwrap_or_else(PoisonError::into_inner);
        seal.recv_timeout(limit).ok()
    }

    /// True once the process should end.
    pub fn is_stopping(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }

    /// Waits for the start; false when told to stop before.
    pub fn wait_for_start(&self) -> bool {
        while !self.is_stopping() {
            if self.start.get().is_some() {
                return true;
            }
            thread::sleep(Duration::from_micros(200));
        }
        false
    }
}

/// Says `message` to the supervisor. A supervisor that is gone is noticed by [`Orders`].
///
/// # Panics
/// Never: these types always serialise.
pub fn say(message: &FromProcess) {
    let mut line = serde_json::to_string(message).expect("these types always serialise");
    line.push('\n');
    let mut out = io::stdout().lock();
    // Nothing useful can be done about a closed pipe: the supervisor that would read the
    // complaint is the one that left.
    let _closed = out
        .write_all(line.as_bytes())
        .and_then(|()| out.flush())
        .is_err();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_is_of_the_kind_that_its_cause_may_pass_by_itself() {
        let of = |errno: Errno| FailureKind::of(&errno.into());
        for errno in [Errno::EADDRINUSE, Errno::EADDRNOTAVAIL, Errno::ENODEV] {
            assert_eq!(of(errno), FailureKind::NotThereYet, "{errno}");
        }
        for errno in [Errno::EMFILE, Errno::ENFILE, Errno::EAGAIN, Errno::ENOSPC] {
            assert_eq!(of(errno), FailureKind::HostTooSmall, "{errno}");
        }
        for errno in [Errno::EPERM, Errno::EINVAL, Errno::ECONNREFUSED] {
            assert_eq!(of(errno), FailureKind::Fault, "{errno}");
        }
    }

    #[test]
    fn every_message_survives_the_pipe() {
        let report = ProcessReport {
            skipped_ticks: 3,
            ..ProcessReport::default()
        };
        for message in [
            FromProcess::Ready,
            FromProcess::Alive,
            FromProcess::Warning("spin on a shared CPU".to_owned()),
            FromProcess::Failed(Failure {
                kind: FailureKind::NotThereYet,
                text: "the port is taken".to_owned(),
            }),
            FromProcess::Finished(Box::new(report)),
        ] {
            let line = serde_json::to_string(&message).unwrap();
            assert!(!line.contains('\n'));
            assert_eq!(serde_json::from_str::<FromProcess>(&line).unwrap(), message);
        }
        assert_eq!(
            serde_json::to_string(&ToProcess::Start { at_ns: 5 }).unwrap(),
            "{\"start\":{\"at_ns\":5}}"
        );
    }
}
