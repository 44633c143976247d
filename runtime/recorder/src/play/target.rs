//! Where recorded messages go: the channels of a run that goes on this host. A channel is only fed
//! when nobody else writes it: two writers at once would be two truths.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant as WallInstant};
use std::{env, fs, thread};

use hil_core::message::Envelope;
use hil_platform::clock::MonotonicClock;
use hil_rundir::live_run::LiveRun;
use hil_rundir::manifest::{ChannelDescription, Manifest};
use hil_rundir::select::select;
use hil_rundir::status::has_begun;
use hil_shm::{Census, Domain, RawOutput};
use serde_json::Value;

use crate::failure::Failure;

/// How long a writer that died may take to lose its place: supervisors look ten times a second.
const DEAD_WRITER_GOES_WITHIN: Duration = Duration::from_secs(1);
/// How long a run may take to appear for the program that it started.
const ANNOUNCED_WITHIN: Duration = Duration::from_secs(5);
/// How often it looks again.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

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
    pub(crate) fn find(into: Option<&str>) -> Result<Self, Failure> {
        let card = env::var_os("HIL_CARD").map(PathBuf::from);
        let (run, is_ours) = match (into, card) {
            (None, Some(card)) => (run_of_card(&card)?, true),
            (into, _) => (select(into).map_err(Failure::usage)?, false),
        };
        let manifest = run.manifest().map_err(|source| {
            let name = &run.name;
            Failure::usage(format!("{name}: cannot read its manifest: {source}"))
        })?;
        Ok(Self {
            run,
            manifest,
            is_ours,
        })
    }

    /// The channel called `name`, whose producer must be on this host.
    pub(crate) fn channel(&self, name: &str) -> Result<&ChannelDescription, Failure> {
        let is_fit = |channel: &&ChannelDescription| {
            let from = channel.from_host.as_deref();
            channel.to_host.is_some() && self.run.hosts().any(|host| Some(host) == from)
        };
        let fit: Vec<_> = self.manifest.channels.iter().filter(is_fit).collect();
        let found = fit.iter().find(|channel| channel.name == name);
        found.copied().ok_or_else(|| {
            let known: Vec<&str> = fit.iter().map(|channel| channel.name.as_str()).collect();
            Failure::usage(format!(
                "run {} has no channel {name:?} whose producer is on this host; it has {}",
                self.run.name,
                known.join(", ")
            ))
        })
    }

    /// The shared memory of the producer's host of `channel`.
    pub(crate) fn domain(&self, channel: &ChannelDescription) -> Result<Domain, Failure> {
        let host = channel.from_host.as_deref().unwrap_or_default();
        let address = self.run.domain(host).map_err(Failure::failed)?;
        let opened = if self.is_ours {
            Domain::open(&address)
        } else {
            Domain::observe(&address)
        };
        opened.map_err(Failure::failed)
    }

    /// Becomes the writer of `channel`.
    pub(crate) fn open(
        &self,
        domain: &Domain,
        channel: &ChannelDescription,
    ) -> Result<Outlet, Failure> {
        let name = &channel.name;
        let writer_count = || Census::of(domain, name).map(|census| census.writer_count);
        let refused = || {
            Failure::usage(format!(
                "channel {name} of run {} has a writer, {}: two writers at once would be two truths; \
                 end that one, or let this program run in its place (docs/terminal.md)",
                self.run.name,
                self.writer(name)
            ))
        };
        let asked = WallInstant::now();
        while writer_count().map_err(Failure::failed)? > 0 {
            if asked.elapsed() > DEAD_WRITER_GOES_WITHIN {
                return Err(refused());
            }
            thread::sleep(LOOK_PERIOD);
        }
        let output = RawOutput::open(domain, name, true).map_err(Failure::failed)?;
        // Another may have come between the question and the answer.
        if writer_count().map_err(Failure::failed)? > 1 {
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
        let cards = fs::read_dir(self.run.folder.join("cards"));
        let mut writers = cards.into_iter().flatten().flatten().filter_map(|card| {
            let text = fs::read_to_string(card.path()).ok()?;
            let card: Value = serde_json::from_str(&text).ok()?;
            let mut outputs = card["outputs"].as_array()?.iter();
            let writes = outputs.any(|output| output["name"] == channel);
            let name = card["process"].as_str().filter(|_| writes)?;
            Some(format!("process {name}"))
        });
        writers
            .next()
            .unwrap_or_else(|| "another program".to_owned())
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
    pub(crate) fn publish(&mut self, payload: &[u8]) -> Result<(), Failure> {
        let (sequence, epoch) = (self.next, self.epoch);
        let envelope = || Envelope {
            sequence,
            published_ns: MonotonicClock::now().as_ns(),
            epoch,
            ..Envelope::default()
        };
        let published = self.output.publish_with(payload, envelope);
        published.map_err(Failure::failed)?;
        self.next += 1;
        Ok(())
    }
}

/// The run in whose folder the card lies: it started this program.
fn run_of_card(card: &Path) -> Result<LiveRun, Failure> {
    let failed = |why: &str| {
        let card = card.display();
        Failure::usage(format!(
            "HIL_CARD is {card}, which is not in a run's folder: {why}"
        ))
    };
    let real = fs::canonicalize(card).map_err(|error| failed(&error.to_string()))?;
    let folder = real.parent().and_then(Path::parent);
    let folder = folder.ok_or_else(|| failed("it has no folder above"))?;
    let asked = WallInstant::now();
    loop {
        match LiveRun::read(folder) {
            Ok(run) => return Ok(run),
            Err(error) if asked.elapsed() > ANNOUNCED_WITHIN => {
                return Err(failed(&error.to_string()));
            }
            Err(_) => thread::sleep(LOOK_PERIOD),
        }
    }
}
