//! One run as one stream of events: for each channel the feed decides whether its messages are followed
//! from the records or read from shared memory, and it knows when the run is over.

use std::collections::BTreeMap;
use std::io;
use std::time::{Duration, Instant as WallInstant};

use hil_core::message::Envelope;

use super::event::{Event, Origin, Record};
use super::follow::RecordFollower;
use super::passive::{PassiveCounters, PassiveReader};
use super::shared::Shared;
use super::since::Since;
use hil_platform::clock::MonotonicClock;
use hil_rundir::live_run::{LiveRun, Source};
use hil_rundir::manifest::{ChannelDescription, Manifest};
use hil_shm::{Domain, DomainError};

/// Bytes of records given out per poll, and messages per channel read from shared memory.
const POLL_BYTES_MAX: usize = 4 << 20;
const POLL_MESSAGES_MAX: usize = 4096;
/// How often the feed asks whether a killed supervisor still holds its domains, and tries again to
/// become a reader where it was refused.
const ASK_PERIOD: Duration = Duration::from_millis(500);
/// The processes of a killed supervisor notice its end and empty their rings within this time.
const ORPHANS_WRITE_WITHIN: Duration = Duration::from_millis(500);
/// A supervisor that cannot be seen, in another process namespace, is given this long to draw up
/// the account.
const UNSEEN_ACCOUNT_WITHIN: Duration = Duration::from_secs(5);

/// Why a run cannot be watched.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// The manifest.
    #[error("run {run}: cannot read manifest.json: {source}")]
    Manifest {
        /// The run.
        run: String,
        /// Why.
        source: io::Error,
    },
    /// The shared memory of one of its hosts.
    #[error("run {run}: {source}")]
    Domain {
        /// The run.
        run: String,
        /// Why.
        source: DomainError,
    },
}

/// What a poll came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poll {
    /// Nothing more for now: look again in some milliseconds.
    Idle,
    /// More is waiting: look again at once.
    Busy,
    /// The run is over and [`Event::Ended`] was given out.
    Over,
}

/// A channel of the run.
#[derive(Debug, Clone)]
pub struct WatchedChannel {
    /// Name, message, types and fields, hosts of its ends.
    pub description: ChannelDescription,
    /// Where its messages are read; `None` when it has no end on this host: then its messages can
    /// only come at the end, from another host.
    pub source: Option<Source>,
}

impl WatchedChannel {
    /// True where a program of the user's writes it: it keeps no records of what it publishes.
    pub const fn is_unrecorded(&self) -> bool {
        let source = &self.source;
        matches!(source, Some(Source::SharedMemory { is_forwarded, .. }) if !*is_forwarded)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Running,
    /// The supervisor was killed then.
    Orphaned(WallInstant),
    /// The last records are given out.
    Emptying,
    /// Silent since then.
    Silent(WallInstant),
    Over,
}

/// A run that is watched. Use it in the thread that opened it.
#[derive(Debug)]
pub struct Feed {
    run: LiveRun,
    manifest: Manifest,
    channels: BTreeMap<String, WatchedChannel>,
    // Before the domains: readers go first.
    shared: BTreeMap<String, Shared>,
    domains: BTreeMap<String, Domain>,
    follower: RecordFollower,
    /// `None` when all of the run is to be given out.
    since: Option<Since>,
    stage: Stage,
    asked: WallInstant,
    problems: Vec<String>,
}

impl Feed {
    /// Begins to watch `run`: its records from the beginning, its shared memory from now on.
    ///
    /// # Errors
    /// When the run's manifest cannot be read, or the shared memory of a host not be joined.
    pub fn open(run: LiveRun) -> Result<Self, FeedError> {
        let manifest = run.manifest().map_err(|source| FeedError::Manifest {
            run: run.name.clone(),
            source,
        })?;
        let source_of = |name: &str| {
            let mut announced = run.channels.iter();
            announced
                .find(|one| one.name == name)
                .map(|one| one.source.clone())
        };
        let channels = manifest.channels.iter().map(|description| {
            let channel = WatchedChannel {
                source: source_of(&description.name),
                description: description.clone(),
            };
            (description.name.clone(), channel)
        });
        let channels: BTreeMap<String, WatchedChannel> = channels.collect();
        let shared = channels.iter().filter_map(|(name, channel)| {
            let Some(Source::SharedMemory { host, is_forwarded }) = &channel.source else {
                return None;
            };
            let mut announced = run.channels.iter();
            let comes_again = announced.any(|one| one.name == *name && one.comes_again);
            let size_bytes = channel.description.size_bytes;
            let shared = Shared::new(host.clone(), *is_forwarded, comes_again, size_bytes);
            Some((name.clone(), shared))
        });
        let mut feed = Self {
            shared: shared.collect(),
            domains: BTreeMap::new(),
            follower: RecordFollower::new(&run.run_folder().records()),
            channels,
            manifest,
            run,
            since: None,
            stage: Stage::Running,
            asked: WallInstant::now(),
            problems: Vec::new(),
        };
        feed.join_domains()?;
        feed.open_readers();
        Ok(feed)
    }

    /// Passes over everything that is in the records by now, for those who want to see what happens
    /// and not what happened. What other hosts send at the end is given out from the first message
    /// on that was heard of here.
    pub fn skip_to_now(&mut self) {
        self.since = Some(Since::default());
        self.follower.skip_to_end();
    }

    /// The run.
    pub const fn run(&self) -> &LiveRun {
        &self.run
    }

    /// What was run.
    pub const fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Every channel of the run, by name.
    pub fn channels(&self) -> impl Iterator<Item = &WatchedChannel> {
        self.channels.values()
    }

    /// The channel called `name`.
    pub fn channel(&self, name: &str) -> Option<&WatchedChannel> {
        self.channels.get(name)
    }

    /// True when all hosts of the run read one clock; `None` while nobody knows.
    pub const fn has_one_clock(&self) -> Option<bool> {
        self.run.has_one_clock
    }

    /// Messages of `channel` that were published while it was read from shared memory and did not
    /// come out of it; at the end exact, before it at least so many. 0 for a channel that is
    /// followed from records.
    pub fn missed_count(&self, channel: &str) -> u64 {
        self.shared.get(channel).map_or(0, Shared::missed_count)
    }

    /// What came of a channel that is read from shared memory; `None` for any other.
    pub fn counters(&self, channel: &str) -> Option<PassiveCounters> {
        self.shared.get(channel).map(Shared::counters)
    }

    /// True when nothing is lost by looking late: what is not followed from files comes again at the
    /// end, with the records of another host.
    pub fn waits(&self) -> bool {
        self.shared.values().all(|shared| shared.comes_again)
    }

    /// True when something is read from shared memory, whose room is bounded.
    pub fn reads_memory(&self) -> bool {
        !self.shared.is_empty()
    }

    /// How full the fullest channel in shared memory was found since the last call: a share of the
    /// messages that may wait there.
    pub fn take_fill_ratio(&mut self) -> f64 {
        let ratios = self.shared.values_mut().map(Shared::take_fill_ratio);
        ratios.fold(0.0, f64::max)
    }

    /// Gives out what happened since the last poll, a bounded part of it.
    pub fn poll(&mut self, take: &mut dyn FnMut(Event<'_>)) -> Poll {
        if self.stage == Stage::Over {
            return Poll::Over;
        }
        self.watch_supervisor();
        let mut is_busy = self.poll_shared(take);
        if self.stage == Stage::Emptying {
            // Whatever is still in shared memory has been given out: the run may take it down.
            if !is_busy {
                self.leave_domains();
            }
            self.follower.look_again();
        }
        is_busy |= self.poll_records(take);
        self.problems.extend(self.follower.take_problems());
        for problem in core::mem::take(&mut self.problems) {
            take(Event::Problem(&problem));
        }
        if is_busy {
            return Poll::Busy;
        }
        self.conclude(take)
    }

    fn join_domains(&mut self) -> Result<(), FeedError> {
        for shared in self.shared.values() {
            if self.domains.contains_key(&shared.host) {
                continue;
            }
            let address = self.run.domain(&shared.host);
            let domain = address
                .map_err(DomainError::Address)
                .and_then(|address| Domain::observe(&address));
            let domain = domain.map_err(|source| FeedError::Domain {
                run: self.run.name.clone(),
                source,
            })?;
            let domain = domain.with_open_within(PassiveReader::OPEN_WITHIN);
            self.domains.insert(shared.host.clone(), domain);
        }
        Ok(())
    }

    fn open_readers(&mut self) {
        for (name, shared) in &mut self.shared {
            let Some(domain) = self.domains.get(&shared.host) else {
                continue;
            };
            if shared.reader.is_some() {
                continue;
            }
            let size_bytes = self.channels[name].description.size_bytes;
            let joined_ns = MonotonicClock::now().as_ns();
            match PassiveReader::open(domain, name, size_bytes) {
                Ok(reader) => {
                    shared.reader = Some(reader);
                    shared.joined_ns = shared.joined_ns.min(joined_ns);
                }
                Err(error) => shared.complain(&error, &mut self.problems),
            }
        }
    }

    fn leave_domains(&mut self) {
        for shared in self.shared.values_mut() {
            shared.give_up_reader();
        }
        self.domains.clear();
    }

    /// Notices that the supervisor took its announcement back, or was killed.
    fn watch_supervisor(&mut self) {
        match self.stage {
            Stage::Running if !self.run.is_announced() => self.stage = Stage::Emptying,
            Stage::Running if self.asked.elapsed() >= ASK_PERIOD => {
                self.asked = WallInstant::now();
                if !self.run.is_held() && self.run.is_announced() {
                    self.stage = Stage::Orphaned(WallInstant::now());
                    return;
                }
                // How the clocks stand is said when all hosts have met.
                if let Ok(said) = LiveRun::read(&self.run.folder) {
                    self.run.has_one_clock = said.has_one_clock;
                }
                self.open_readers();
            }
            Stage::Orphaned(since) if since.elapsed() >= ORPHANS_WRITE_WITHIN => {
                self.stage = Stage::Emptying;
            }
            _ => {}
        }
    }

    fn poll_shared(&mut self, take: &mut dyn FnMut(Event<'_>)) -> bool {
        let mut is_busy = false;
        for (name, shared) in &mut self.shared {
            let channel = &self.channels[name];
            shared.note_read();
            let Shared { reader, seen, .. } = shared;
            let Some(open) = reader else { continue };
            let mut found_count = 0;
            let polled = open.poll(POLL_MESSAGES_MAX, &mut |envelope, payload| {
                found_count += 1;
                if seen.insert(envelope.epoch, envelope.sequence) {
                    if let Some(since) = &mut self.since {
                        since.admits(name, envelope.epoch, envelope.sequence, true);
                    }
                    take(Event::Message {
                        channel,
                        origin: Origin::SharedMemory,
                        envelope,
                        payload,
                    });
                }
            });
            shared.note_found(found_count);
            match polled {
                Ok(more) => is_busy |= more,
                Err(error) => {
                    shared.give_up_reader();
                    shared.complain(&error, &mut self.problems);
                }
            }
        }
        is_busy
    }

    fn poll_records(&mut self, take: &mut dyn FnMut(Event<'_>)) -> bool {
        let Self {
            run,
            channels,
            shared,
            follower,
            since,
            problems,
            ..
        } = self;
        follower.poll(POLL_BYTES_MAX, &mut |batch| {
            let name = batch.header.channel.as_str();
            let is_of_this_host = run.processes.iter().any(|one| one == batch.writer);
            let mut shared = shared.get_mut(name);
            Record::each(batch, &mut |record| {
                if let Some(since) = since.as_mut()
                    && !since.admits_record(name, &record, is_of_this_host)
                {
                    return;
                }
                if let (Record::Ingress(one), Some(shared), true) =
                    (&record, shared.as_deref_mut(), is_of_this_host)
                {
                    shared.note_forwarded(one);
                }
                take(Event::Record {
                    channel: name,
                    is_of_this_host,
                    record,
                });
            });
            match channels.get(name) {
                Some(channel) => {
                    let origin = match channel.source {
                        Some(Source::Records {}) => Origin::Records,
                        Some(Source::SharedMemory { .. }) | None => Origin::OtherHost,
                    };
                    for (envelope, payload) in batch.messages() {
                        let Envelope {
                            epoch, sequence, ..
                        } = envelope;
                        let is_admitted = since.as_mut().is_none_or(|since| {
                            since.admits(name, epoch, sequence, is_of_this_host)
                        });
                        let mut is_new = || {
                            let shared = shared.as_deref_mut();
                            shared.is_none_or(|shared| shared.seen.insert(epoch, sequence))
                        };
                        if is_admitted && is_new() {
                            take(Event::Message {
                                channel,
                                origin,
                                envelope: &envelope,
                                payload,
                            });
                        }
                    }
                }
                None if batch.messages().next().is_some() => {
                    problems.push(format!("{name}: no channel of the manifest; left out"));
                }
                None => {}
            }
        })
    }

    /// Says what is over, when nothing more waits.
    fn conclude(&mut self, take: &mut dyn FnMut(Event<'_>)) -> Poll {
        match self.stage {
            Stage::Emptying => {
                for shared in self.shared.values_mut() {
                    shared.note_read();
                }
                self.stage = Stage::Silent(WallInstant::now());
                take(Event::Silent);
                Poll::Idle
            }
            Stage::Silent(since) => {
                let folder = self.run.run_folder();
                let has_summary = folder.summary().is_file();
                // The report is written after the summary: with it, both are whole.
                let is_whole = has_summary && folder.report().is_file();
                let is_gone = self.run.is_supervisor_gone();
                let is_late = since.elapsed() >= UNSEEN_ACCOUNT_WITHIN;
                if !is_whole && !(is_gone && (has_summary || is_late)) {
                    return Poll::Idle;
                }
                self.stage = Stage::Over;
                take(Event::Ended { has_summary });
                Poll::Over
            }
            Stage::Running | Stage::Orphaned(_) | Stage::Over => Poll::Idle,
        }
    }
}
