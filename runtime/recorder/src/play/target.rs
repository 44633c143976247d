//! Where recorded messages go: the channels of a run that goes on this host. A channel is only fed
//! when nobody else writes it: two writers at once would be two truths.

use std::env;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use hil_core::message::Envelope;
use hil_platform::clock::MonotonicClock;
use hil_rundir::live_run::LiveRun;
use hil_rundir::manifest::{ChannelDescription, Manifest};
use hil_rundir::select::SelectError;
use hil_rundir::select::select;
use hil_rundir::status::has_begun;
use hil_shm::{Census, ChannelError, Domain, DomainError, RawOutput};
use serde_json::Value;

/// How long a writer that died may take to lose its place: supervisors look ten times a second.
const DEAD_WRITER_GOES_WITHIN: Duration = Duration::from_secs(1);
/// How long a run may take to appear for the program that it started.
const ANNOUNCED_WITHIN: Duration = Duration::from_secs(5);
/// How often it looks again.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// Why there is no channel to play into.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TargetError {
    /// The run.
    #[error(transparent)]
    Select(#[from] SelectError),
    /// A process of a run that has no folder here.
    #[error(
        "HIL_CARD is {}, which is not in a run's folder: {why}",
        card.display()
    )]
    Card {
        /// The card.
        card: PathBuf,
        /// What is missing.
        why: String,
    },
    /// Its manifest.
    #[error("{run}: cannot read its manifest: {source}")]
    Manifest {
        /// The run.
        run: String,
        /// Why.
        source: io::Error,
    },
    /// Not one of its channels.
    #[error("run {run} has no channel {channel:?} whose producer is on this host; it has {known}")]
    NoChannel {
        /// The run.
        run: String,
        /// What was asked for.
        channel: String,
        /// What could be.
        known: String,
    },
    /// Somebody writes it.
    #[error(
        "channel {channel} of run {run} has a writer, {writer}: two writers at once would be \
         two truths; end that one, or let this program run in its place (docs/terminal.md)"
    )]
    HasWriter {
        /// The channel.
        channel: String,
        /// The run.
        run: String,
        /// Who should be writing it.
        writer: String,
    },
    /// The shared memory.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// The channel in it.
    #[error(transparent)]
    Channel(#[from] ChannelError),
}

/// A run to play into.
#[derive(Debug)]
pub(crate) struct Target {
    /// The run.
    pub(crate) run: LiveRun,
    manifest: Manifest,
    /// It started this program, as one of its processes.
    pub(crate) is_ours: bool,
}

/// One channel that is fed.
#[derive(Debug)]
pub(crate) struct Outlet {
    output: RawOutput,
    epoch: u32,
    next: u64,
}

impl Target {
    /// The run called `into`; without a name the one that started this program, else the only one.
    pub(crate) fn find(into: Option<&str>) -> Result<Self, TargetError> {
        let card = env::var_os("HIL_CARD").map(PathBuf::from);
        let (run, is_ours) = match (into, card) {
            (None, Some(card)) => (run_of_card(&card)?, true),
            (into, _) => (select(into)?, false),
        };
        let manifest = run.manifest().map_err(|source| TargetError::Manifest {
            run: run.name.clone(),
            source,
        })?;
        Ok(Self {
            run,
            manifest,
            is_ours,
        })
    }

    /// The channel called `name`, whose producer must be on this host.
    pub(crate) fn channel(&self, name: &str) -> Result<&ChannelDescription, TargetError> {
        let is_fit = |channel: &&ChannelDescription| {
            let from = channel.from_host.as_deref();
            channel.to_host.is_some() && self.run.hosts().any(|host| Some(host) == from)
        };
        let mut fit = self.manifest.channels.iter().filter(is_fit);
        fit.clone()
            .find(|channel| channel.name == name)
            .ok_or_else(|| TargetError::NoChannel {
                run: self.run.name.clone(),
                channel: name.to_owned(),
                known: fit
                    .by_ref()
                    .map(|channel| channel.name.as_str())
                    .collect::<Vec<_>>()
                    .join(", "),
            })
    }

    /// The shared memory of the producer's host of `channel`.
    pub(crate) fn domain(&self, channel: &ChannelDescription) -> Result<Domain, TargetError> {
        let host = channel.from_host.as_deref().unwrap_or_default();
        let address = self.run.domain(host).map_err(DomainError::Address)?;
        Ok(if self.is_ours {
            Domain::open(&address)?
        } else {
            Domain::observe(&address)?
        })
    }

    /// Becomes the writer of `channel`.
    pub(crate) fn open(
        &self,
        domain: &Domain,
        channel: &ChannelDescription,
    ) -> Result<Outlet, TargetError> {
        let name = &channel.name;
        let refused = || TargetError::HasWriter {
            channel: name.clone(),
            run: self.run.name.clone(),
            writer: self.writer(name),
        };
        let asked = WallInstant::now();
        while Census::of(domain, name)?.writer_count > 0 {
            if asked.elapsed() > DEAD_WRITER_GOES_WITHIN {
                return Err(refused());
            }
            thread::sleep(LOOK_PERIOD);
        }
        let output = RawOutput::open(domain, name, true)?;
        // Another may have come between the question and the answer.
        if Census::of(domain, name)?.writer_count > 1 {
            return Err(refused());
        }
        // Producers of one channel never start twice within a microsecond on one host.
        let epoch = MonotonicClock::now().as_ns() / 1000 % i64::from(u32::MAX);
        Ok(Outlet {
            output,
            epoch: u32::try_from(epoch).expect("the remainder is below u32::MAX"),
            next: 0,
        })
    }

    /// The process whose card has `channel` among its outputs.
    fn writer(&self, channel: &str) -> String {
        let cards = self.run.folder.join("cards");
        let cards = fs::read_dir(cards).into_iter().flatten().flatten();
        let mut writers = cards.filter_map(|card| {
            let text = fs::read_to_string(card.path()).ok()?;
            let card: Value = serde_json::from_str(&text).ok()?;
            let mut outputs = card["outputs"].as_array()?.iter();
            outputs
                .any(|output| output["name"] == channel)
                .then(|| card["process"].as_str().map(str::to_owned))?
        });
        let writer = writers.next();
        writer.map_or_else(
            || "another program".to_owned(),
            |name| format!("process {name}"),
        )
    }

    /// True once the run has begun: what is published before nobody counts.
    pub(crate) fn has_begun(&self) -> bool {
        has_begun(&self.run.folder)
    }

    /// True when there is nobody left to play for.
    pub(crate) fn is_over(&self) -> bool {
        !self.run.is_announced() || self.run.is_supervisor_gone()
    }
}

impl Outlet {
    /// Publishes `payload` with the next number.
    pub(crate) fn publish(&mut self, payload: &[u8]) -> Result<(), TargetError> {
        let (sequence, epoch) = (self.next, self.epoch);
        self.output.publish_with(payload, || Envelope {
            sequence,
            published_ns: MonotonicClock::now().as_ns(),
            epoch,
            ..Envelope::default()
        })?;
        self.next += 1;
        Ok(())
    }
}

/// The run in whose folder the card lies: it started this program.
fn run_of_card(card: &Path) -> Result<LiveRun, TargetError> {
    let failed = |why: String| TargetError::Card {
        card: card.to_owned(),
        why,
    };
    let folder = fs::canonicalize(card)
        .map_err(|error| failed(error.to_string()))?
        .parent()
        .and_then(Path::parent)
        .map(Path::to_owned)
        .ok_or_else(|| failed("it has no folder above".to_owned()))?;
    let asked = WallInstant::now();
    loop {
        match LiveRun::read(&folder) {
            Ok(run) => return Ok(run),
            Err(error) if asked.elapsed() > ANNOUNCED_WITHIN => {
                return Err(failed(error.to_string()));
            }
            Err(_) => thread::sleep(LOOK_PERIOD),
        }
    }
}
