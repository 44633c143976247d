//! One running run as the commands of a terminal need it: its topology, the newest records of each
//! channel, and how the clocks of its hosts stand to each other. It draws nothing.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use hil_account::{AccountContext, ChannelAccount, ChannelPath, WRITING_TIME_MAX, flight_time_max};
use hil_clock::{ClockMap, ClockSettings, Exchange, Requester};
use hil_core::message::Envelope;
use hil_core::record::RoundTripRecord;
use hil_core::time::{Alignment, Instant, duration_ns};
use hil_link::condition::{LinkCondition, LinkConditionRecord};
use hil_link::spec::Way;

use super::conditions::LinkConditions;
use super::pace::Pace;
use super::tail::ChannelTail;
use crate::{PassiveReader, RecordFollower};
use hil_platform::clock::MonotonicClock;
use hil_platform::signals::Signals;
use hil_report::clock_summary::ClockRung;
use hil_rundir::live_run::{LiveRun, Source};
use hil_rundir::manifest::{ChannelDescription, Manifest};
use hil_rundir::record::RecordKind;
use hil_rundir::select::{self, SelectError};
use hil_rundir::status::RunStatus;
use hil_shm::{Domain, DomainError};
use hil_topology::registry::Registry;
use hil_topology::{Process, Topology};

/// How often records and shared memory are read: short against what queues hold.
pub(crate) const POLL_PERIOD: Duration = Duration::from_millis(10);
/// Bytes of records read per poll.
const POLL_BYTES_MAX: usize = 4 << 20;
/// Messages taken from one channel's shared memory per poll.
const POLL_MESSAGES_MAX: usize = 4096;
/// Exchanges older than this say nothing about now.
const EXCHANGES_SPAN_NS: i64 = 30_000_000_000;

/// Why a run cannot be observed.
#[derive(Debug, thiserror::Error)]
pub enum ObserveError {
    /// None, or not one.
    #[error(transparent)]
    Select(#[from] SelectError),
    /// What was run.
    #[error("{run}: cannot read its manifest: {source}")]
    Manifest {
        /// The run.
        run: String,
        /// Why.
        source: std::io::Error,
    },
    /// No such channel.
    #[error("run {run} has no channel {channel:?}; it has {known}")]
    NoChannel {
        /// The run.
        run: String,
        /// What was asked for.
        channel: String,
        /// Its channels.
        known: String,
    },
    /// No end of it is here.
    #[error("channel {channel} has no end on this host; look on {hosts}")]
    Elsewhere {
        /// The channel.
        channel: String,
        /// Where it is.
        hosts: String,
    },
    /// The shared memory of the run.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// The channel in it.
    #[error(transparent)]
    Channel(#[from] hil_shm::ChannelError),
}

/// A run that is being observed.
#[derive(Debug)]
pub(crate) struct Observer {
    run: LiveRun,
    manifest: Manifest,
    topology: Option<Topology>,
    follower: RecordFollower,
    tails: BTreeMap<String, ChannelTail>,
    /// Channels that a program of this host may write before the run begins; empty once it began.
    unbegun: Vec<String>,
    round_trips: BTreeMap<String, Vec<RoundTripRecord>>,
    arrivals: BTreeMap<String, Vec<Arrival>>,
    // Before the domains: readers go first.
    passive: BTreeMap<String, PassiveReader>,
    domains: BTreeMap<String, Domain>,
    conditions: LinkConditions,
    problems: Vec<String>,
}

/// A message as this host first sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Arrival {
    /// When: its publication if its producer is here, else its arrival; this host's monotonic clock.
    pub(crate) at_ns: i64,
    /// The producer's start.
    pub(crate) epoch: u32,
    /// Its number.
    pub(crate) sequence: u64,
}

impl From<&Envelope> for Arrival {
    fn from(envelope: &Envelope) -> Self {
        Self {
            at_ns: envelope.published_ns,
            epoch: envelope.epoch,
            sequence: envelope.sequence,
        }
    }
}

/// How the clocks of two hosts stand to each other, by the exchanges of the last half minute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ClockFigures {
    /// What they rest on. What daemons say of system clocks is asked at the end of a run only, so that rung
    /// is none of these.
    pub(crate) rung: ClockRung,
    /// Exchanges; `None` where none is needed or there was none.
    pub(crate) exchange_count: Option<u64>,
    /// What to add to the first one's monotonic clock to have the second one's, nanoseconds.
    pub(crate) offset_ns: Option<i64>,
    /// Largest error of that, nanoseconds.
    pub(crate) bound_ns: Option<u64>,
}

impl ClockFigures {
    /// Of hosts that read one clock.
    pub(crate) const ONE_CLOCK: Self = Self {
        rung: ClockRung::OneClock,
        exchange_count: None,
        offset_ns: Some(0),
        bound_ns: Some(0),
    };
}

impl Observer {
    /// Begins to observe the run that `wanted` means, from now on.
    ///
    /// # Errors
    /// When it is none or several, or its manifest cannot be read.
    pub(crate) fn open(wanted: Option<&str>, registry: &Registry) -> Result<Self, ObserveError> {
        let run = select::select(wanted)?;
        let manifest = run.manifest().map_err(|source| ObserveError::Manifest {
            run: run.name.clone(),
            source,
        })?;
        let mut problems = Vec::new();
        let topology = topology_of(&manifest, registry)
            .map_err(|why| problems.push(format!("its topology is not known here: {why}")))
            .ok();
        let records = run.run_folder().records();
        // Before the orders on record are read: none falls between.
        let follower = RecordFollower::from_now(&records);
        let mut conditions = topology
            .as_ref()
            .map(LinkConditions::of)
            .unwrap_or_default();
        problems.extend(conditions.read(&records));
        let mut unbegun = Vec::new();
        let channels = manifest.channels.iter();
        let tails = channels.map(|one| {
            let is_gateway = hosts_of(one, topology.as_ref()).is_some();
            let known = topology.as_ref().and_then(|known| known.channel(&one.name));
            let witnessed = |name: Option<&str>| -> Option<&Process> {
                let process = topology.as_ref()?.process(name?)?;
                Some(process).filter(|process| process.is_witnessed())
            };
            let mut tail = ChannelTail::new(is_gateway, known.map(|channel| channel.depth));
            let consumer = known.and_then(|channel| channel.to.as_deref());
            tail.has_witness = witnessed(consumer).is_some();
            let producer = witnessed(known.map(|channel| channel.from.as_str()));
            if producer.is_some_and(|producer| run.hosts().any(|host| host == producer.host)) {
                tail.await_begin();
                unbegun.push(one.name.clone());
            }
            (one.name.clone(), tail)
        });
        let tails = tails.collect();
        Ok(Self {
            tails,
            unbegun,
            follower,
            conditions,
            run,
            manifest,
            topology,
            round_trips: BTreeMap::new(),
            arrivals: BTreeMap::new(),
            passive: BTreeMap::new(),
            domains: BTreeMap::new(),
            problems,
        })
    }

    /// The run.
    pub(crate) const fn run(&self) -> &LiveRun {
        &self.run
    }

    /// What was run.
    pub(crate) const fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The topology; `None` when this program does not know its case.
    pub(crate) const fn topology(&self) -> Option<&Topology> {
        self.topology.as_ref()
    }

    /// What went wrong so far.
    pub(crate) fn problems(&self) -> &[String] {
        &self.problems
    }

    /// True when the run is over.
    pub(crate) fn is_over(&self) -> bool {
        !self.run.is_announced() || self.run.is_supervisor_gone()
    }

    /// The channel called `name`, which must have an end here.
    ///
    /// # Errors
    /// When there is none, with those there are.
    pub(crate) fn channel(&self, name: &str) -> Result<&ChannelDescription, ObserveError> {
        let description = self.described(name).ok_or_else(|| {
            let channels = self.manifest.channels.iter();
            let known: Vec<&str> = channels.map(|one| one.name.as_str()).collect();
            ObserveError::NoChannel {
                run: self.run.name.clone(),
                channel: name.to_owned(),
                known: known.join(", "),
            }
        })?;
        if self.source(name).is_none() {
            let hosts = [&description.from_host, &description.to_host];
            let mut hosts: Vec<&str> = hosts.into_iter().flatten().map(String::as_str).collect();
            hosts.dedup();
            return Err(ObserveError::Elsewhere {
                channel: name.to_owned(),
                hosts: hosts.join(" or "),
            });
        }
        Ok(description)
    }

    fn described(&self, channel: &str) -> Option<&ChannelDescription> {
        let mut channels = self.manifest.channels.iter();
        channels.find(|one| one.name == channel)
    }

    /// Where the messages of `channel` can be had; `None` when it has no end here.
    pub(crate) fn source(&self, channel: &str) -> Option<&Source> {
        let mut channels = self.run.channels.iter();
        let found = channels.find(|one| one.name == channel)?;
        Some(&found.source)
    }

    /// The shared memory of `host`.
    ///
    /// # Errors
    /// When it cannot be joined.
    pub(crate) fn domain(&mut self, host: &str) -> Result<&Domain, ObserveError> {
        if !self.domains.contains_key(host) {
            let address = self.run.domain(host).map_err(DomainError::Address)?;
            let domain = Domain::observe(&address)?.with_open_within(PassiveReader::OPEN_WITHIN);
            self.domains.insert(host.to_owned(), domain);
        }
        Ok(&self.domains[host])
    }

    /// A reader of the shared memory of `channel` on `host`.
    ///
    /// # Errors
    /// When the channel has all its readers, or is not there.
    pub(crate) fn reader(
        &mut self,
        host: &str,
        channel: &ChannelDescription,
    ) -> Result<PassiveReader, ObserveError> {
        let domain = self.domain(host)?;
        Ok(PassiveReader::open(
            domain,
            &channel.name,
            channel.size_bytes,
        )?)
    }

    /// As [`Self::count_unrecorded`], of every channel.
    pub(crate) fn count_all_unrecorded(&mut self) {
        for channel in self.manifest.channels.clone() {
            self.count_unrecorded(&channel.name);
        }
    }

    /// Also counts the messages of `channel` in shared memory, if nobody here records them: of a
    /// user's own program.
    pub(crate) fn count_unrecorded(&mut self, channel: &str) {
        let Some(Source::SharedMemory {
            host,
            is_forwarded: false,
        }) = self.source(channel).cloned()
        else {
            return;
        };
        let description = self.channel(channel).cloned();
        match description.and_then(|description| self.reader(&host, &description)) {
            Ok(reader) => {
                self.passive.insert(channel.to_owned(), reader);
            }
            Err(error) => self.problems.push(error.to_string()),
        }
    }

    /// Reads what came since the last poll. Call it every few milliseconds, so that no queue of
    /// shared memory overflows.
    pub(crate) fn poll(&mut self) {
        let Self {
            run,
            follower,
            topology,
            tails,
            unbegun,
            round_trips,
            arrivals,
            passive,
            conditions,
            problems,
            ..
        } = self;
        follower.poll(POLL_BYTES_MAX, &mut |batch| {
            let channel = batch.header.channel.as_str();
            match batch.header.kind {
                RecordKind::RoundTrip => {
                    let known = round_trips.entry(channel.to_owned()).or_default();
                    known.extend(batch.records::<RoundTripRecord>());
                }
                RecordKind::Message => {
                    let known = arrivals.entry(channel.to_owned()).or_default();
                    let each = batch.messages();
                    known.extend(each.map(|(envelope, _)| Arrival::from(&envelope)));
                }
                RecordKind::NoRoom => {
                    let crossings = topology.iter().flat_map(Topology::crossings);
                    for crossing in crossings.filter(|one| one.flow_name() == channel) {
                        if let Some(tail) = tails.get_mut(&crossing.channel.name) {
                            tail.add_no_room(batch.records());
                        }
                    }
                }
                RecordKind::LinkCondition => {
                    conditions.add(channel, batch.records::<LinkConditionRecord>());
                }
                _ => {
                    if let Some(tail) = tails.get_mut(channel) {
                        tail.add(batch);
                    }
                }
            }
        });
        // A link that lets nothing through leaves its far end's records as they are: they are at hand.
        for header in follower.headers() {
            if let Some(tail) = tails.get_mut(&header.channel) {
                tail.expect(header.kind);
            }
        }
        if !unbegun.is_empty() {
            // A status that cannot be read says nothing: the next poll asks again.
            let status = RunStatus::read(&run.folder).ok();
            if let Some(start_ns) = status.and_then(|one| one.start_ns) {
                for channel in unbegun.drain(..) {
                    if let Some(tail) = tails.get_mut(&channel) {
                        tail.begin(Instant::from_ns(start_ns));
                    }
                }
            }
        }
        let now_ns = MonotonicClock::now().as_ns();
        for (channel, tail) in tails {
            let settling = settling(conditions.flight_time(channel));
            tail.settle(now_ns, duration_ns(settling));
            if tail.notes_late_record() {
                problems.push(format!(
                    "{channel}: records came after their messages had been counted without them; the run's \
                     report will have them"
                ));
            }
        }
        problems.extend(follower.take_problems());
        passive.retain(|channel, reader| {
            let known = arrivals.entry(channel.clone()).or_default();
            let polled = reader.poll(POLL_MESSAGES_MAX, &mut |envelope, _| {
                known.push(envelope.into());
            });
            polled
                .map_err(|error| problems.push(error.to_string()))
                .is_ok()
        });
    }

    /// Polls for `window`; false when a signal came before it was over.
    pub(crate) fn poll_for(&mut self, window: Duration, signals: &Signals) -> bool {
        self.poll_for_beside(window, signals, &mut || {})
    }

    /// The same, and does `work` after each poll: a part of it that is short against [`POLL_PERIOD`].
    pub(crate) fn poll_for_beside(
        &mut self,
        window: Duration,
        signals: &Signals,
        work: &mut dyn FnMut(),
    ) -> bool {
        let began = WallInstant::now();
        let mut is_whole = true;
        while is_whole && began.elapsed() < window {
            self.poll();
            work();
            thread::sleep(POLL_PERIOD.min(window.saturating_sub(began.elapsed())));
            is_whole = signals.received().is_none();
        }
        self.poll();
        is_whole
    }

    /// Forgets what lies further back than `window`.
    pub(crate) fn trim(&mut self, window: Duration) {
        let now_ns = MonotonicClock::now().as_ns();
        let span_ns = duration_ns(window + self.longest_settling());
        for tail in self.tails.values_mut() {
            tail.trim(span_ns, now_ns);
        }
        for arrivals in self.arrivals.values_mut() {
            let oldest_ns = now_ns.saturating_sub(span_ns);
            arrivals.retain(|one| one.at_ns >= oldest_ns);
        }
        for round_trips in self.round_trips.values_mut() {
            let newest_ns = round_trips.iter().map(|one| one.t1_ns).max();
            let oldest_ns = newest_ns.unwrap_or(0).saturating_sub(EXCHANGES_SPAN_NS);
            round_trips.retain(|one| one.t1_ns >= oldest_ns);
        }
    }

    /// The messages of `channel` as this host first sees them, in the order in which they came.
    /// `None` when nothing tells of it.
    fn arrivals(&self, channel: &str) -> Option<Vec<Arrival>> {
        if let Some(Source::SharedMemory {
            is_forwarded: true, ..
        }) = self.source(channel)
        {
            let tail = self.tails.get(channel).filter(|tail| !tail.is_empty())?;
            return Some(tail.arrivals().iter().copied().collect());
        }
        self.arrivals.get(channel).cloned()
    }

    /// Messages per second of `channel` as this host first sees them; `None` of fewer than two.
    pub(crate) fn rate_hz(&self, channel: &str) -> Option<f64> {
        let mut pace = Pace::default();
        for arrival in self.arrivals(channel)? {
            pace.take(&arrival);
        }
        pace.turn().rate_hz
    }

    /// How many messages of `channel` a gateway of this host brought. `None` when none is here that
    /// could have.
    pub(crate) fn brought_count(&self, channel: &str) -> Option<usize> {
        let to_host = self.described(channel)?.to_host.as_ref()?;
        let is_here = self.run.hosts().any(|here| here == to_host);
        let tail = self.tails.get(channel);
        let tail = tail.filter(|tail| is_here && !tail.is_empty())?;
        Some(tail.arrivals().len())
    }

    /// True when the records of `channel` are kept here, whatever is in them.
    pub(crate) fn is_recorded(&self, channel: &str) -> bool {
        self.follower.headers().any(|one| one.channel == channel)
    }

    /// As [`Self::arrivals`], and forgets them.
    pub(crate) fn take_arrivals(&mut self, channel: &str) -> Vec<Arrival> {
        let arrivals = self.arrivals(channel).unwrap_or_default();
        self.arrivals.remove(channel);
        if let Some(tail) = self.tails.get_mut(channel) {
            tail.take_arrivals();
        }
        arrivals
    }

    /// The account of the messages of `channel` of the last `window` that have settled; `None` when no
    /// record tells of them. The fates are those of the report, but for interruptions, which nobody knows
    /// yet; the bounds are wider, as only past exchanges tell of the clocks.
    pub(crate) fn account(&self, channel: &str, window: Duration) -> Option<ChannelAccount> {
        let tail = self.tails.get(channel).filter(|tail| !tail.is_empty())?;
        let hosts = self.hosts_of(channel);
        let map = hosts
            .as_ref()
            .and_then(|(from, to)| self.clock_map(from, to));
        let path = match (&hosts, &map) {
            (None, _) => ChannelPath::SharedMemory,
            (Some(_), _) if self.has_one_clock() => ChannelPath::Gateway {
                alignment: Some(Alignment::SAME_CLOCK),
            },
            (Some(_), Some(map)) => ChannelPath::Mapped { map },
            (Some(_), None) => ChannelPath::Gateway { alignment: None },
        };
        let context = AccountContext::new(path);
        Some(tail.account(duration_ns(window), &context))
    }

    /// True when all hosts of the run read one clock.
    pub(crate) fn has_one_clock(&self) -> bool {
        let is_whole = self
            .topology
            .as_ref()
            .is_some_and(|topology| topology.hosts().len() == self.run.domains.len());
        is_whole || self.run.has_one_clock == Some(true)
    }

    /// Both hosts of a channel that crosses a link; without a topology, of one between two hosts.
    pub(crate) fn hosts_of(&self, channel: &str) -> Option<(String, String)> {
        hosts_of(self.described(channel)?, self.topology.as_ref())
    }

    /// What the direction `way` of `link` was ordered to do, as far as this host knows.
    pub(crate) fn link_condition(&self, link: &str, way: Way) -> LinkCondition {
        self.conditions.now(link, way)
    }

    /// How long the first messages of the first window need to be written down by all who meet them.
    pub(crate) fn longest_settling(&self) -> Duration {
        settling(self.conditions.longest_flight_time())
    }

    /// How the clock of `from` relates to that of `to` by the exchanges of the last half minute;
    /// `None` without any.
    fn clock_map(&self, from: &str, to: &str) -> Option<ClockMap> {
        let exchanges = self.exchanges(from, to);
        let map = ClockMap::new(&exchanges, ClockSettings::default());
        map.metrics().offset.is_some().then_some(map)
    }

    /// The same in figures.
    pub(crate) fn clock(&self, from: &str, to: &str) -> ClockFigures {
        if self.has_one_clock() {
            return ClockFigures::ONE_CLOCK;
        }
        let map = self.clock_map(from, to);
        let metrics = map.as_ref().map(ClockMap::metrics);
        ClockFigures {
            rung: metrics.map_or(ClockRung::None, |_| ClockRung::Exchanges),
            exchange_count: metrics.map(|one| one.exchange_count),
            offset_ns: metrics.and_then(|one| Some(one.offset?.estimate_ns)),
            bound_ns: metrics.and_then(|one| Some(one.bound?.median_ns)),
        }
    }

    /// True when some of the exchanges between the two hosts came over a clock path.
    pub(crate) fn has_clock_path_exchanges(&self, from: &str, to: &str) -> bool {
        let paths = self.topology().into_iter().flat_map(Topology::clock_paths);
        let mut of_pair = paths.filter(|path| {
            let ends = (path.from.name.as_str(), path.to.name.as_str());
            ends == (from, to) || ends == (to, from)
        });
        of_pair.any(|path| {
            let round_trips = self.round_trips.get(&path.name());
            round_trips.is_some_and(|found| !found.is_empty())
        })
    }

    fn exchanges(&self, from: &str, to: &str) -> Vec<Exchange> {
        let mut found = Vec::new();
        for (name, round_trips) in &self.round_trips {
            let Some((asks, answers)) = self.exchanging_hosts(name) else {
                continue;
            };
            // The host that is converted to is the local one.
            let requester = match (asks.as_str(), answers.as_str()) {
                pair if pair == (to, from) => Requester::Local,
                pair if pair == (from, to) => Requester::Remote,
                _ => continue,
            };
            // An exchange whose stamps were bettered later is there twice; the last one counts.
            let last: BTreeMap<(u32, u64), &RoundTripRecord> = round_trips
                .iter()
                .map(|one| ((one.session, one.sequence), one))
                .collect();
            found.extend(
                last.into_values()
                    .filter_map(|one| Exchange::of(one, requester)),
            );
        }
        found
    }

    /// The host that asks and the host that answers in the exchanges recorded as `name`: of one way of a
    /// link, whose sending gateway asks, or of a clock path.
    fn exchanging_hosts(&self, name: &str) -> Option<(String, String)> {
        let topology = self.topology.as_ref()?;
        let clock_path = topology.clock_paths().find(|path| path.name() == name);
        if let Some(path) = clock_path {
            return Some((path.from.name.clone(), path.to.name.clone()));
        }
        let mut crossings = topology.crossings();
        let crossing = crossings.find(|one| one.flow_name() == name)?;
        let (from, to) = (crossing.from_host, crossing.to_host);
        Some((from.name.clone(), to.name.clone()))
    }
}

/// Both hosts of a channel that crosses a link; without a topology, of one between two hosts.
fn hosts_of(channel: &ChannelDescription, topology: Option<&Topology>) -> Option<(String, String)> {
    let (from, to) = (channel.from_host.as_ref()?, channel.to_host.as_ref()?);
    let is_between = match topology {
        Some(topology) => topology
            .crossing(topology.channel(&channel.name)?)
            .is_some(),
        // Two hosts may have two clocks: they are one only where that is known.
        None => from != to,
    };
    is_between.then(|| (from.clone(), to.clone()))
}

/// How long after its publication a message may still be on its way, or that to a file, over a link that
/// delays messages by up to `link_delay` on purpose.
fn settling(link_delay: Duration) -> Duration {
    flight_time_max(link_delay) + WRITING_TIME_MAX
}

/// The topology that a run wrote into its manifest.
fn topology_of(manifest: &Manifest, registry: &Registry) -> Result<Topology, String> {
    let table = toml::Table::try_from(&manifest.topology).map_err(|error| error.to_string())?;
    let text = toml::to_string(&table).map_err(|error| error.to_string())?;
    hil_topology::parse("manifest.json", &text, &[], registry.known())
        .map_err(|errors| errors.to_string())
}
