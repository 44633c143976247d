//! The process of one component: the same endpoint that virtual time drives, on shared-memory
//! ports and a real clock.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use hil_core::component::Role;
use hil_core::endpoint::{Endpoint, PortCountError};
use hil_core::message::{Envelope, MessageType};
use hil_core::record::{PublishedRecord, TakenRecord};

use super::pulse::{Pulse, Pulses};
use super::recording::{Destination, RecordedInput, RecordedOutput};
use super::usage::add_usage;
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::realtime;
use hil_platform::realtime::SpinAdvice;
use hil_platform::wait::{Pause, WaitMode, WaitStrategy};
use hil_rundir::launch::{ComponentLaunch, LaunchError, read};
use hil_rundir::pipe::{ChannelProgress, FromProcess, Orders, ProcessReport, say};
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder};
use hil_shm::{
    ChannelError, Domain, DomainError, OutputSettings, Sequencer, ShmInput, ShmOutput, Waiter,
};
use hil_topology::registry::{CaseError, Registry};
use hil_topology::{CardChannel, ProcessCard};

/// Records a ring holds: 4 s at 4 kHz, far more than the writer's period needs.
const RING_RECORDS: usize = 16_384;
const PROGRESS_PERIOD: Duration = Duration::from_millis(250);
/// Stands for the skipped ticks of a role that never ticks.
const NO_TIMER: u64 = u64::MAX;

/// Why a component cannot run.
#[derive(Debug, thiserror::Error)]
pub enum ComponentError {
    /// The launch file.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// A case that this program does not know.
    #[error("this binary has no case {0}; it was built without the case the supervisor knows")]
    UnknownCase(String),
    /// A role that the case does not have.
    #[error("case {case} has no role {role}")]
    UnknownRole {
        /// The case.
        case: String,
        /// The role asked for.
        role: String,
    },
    /// The case refused its parameters.
    #[error(transparent)]
    Case(#[from] CaseError),
    /// A record file.
    #[error(transparent)]
    Record(#[from] RecordFileError),
    /// The shared-memory domain.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// A channel.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The number of its channels.
    #[error(transparent)]
    Ports(#[from] PortCountError),
    /// No thread.
    #[error("cannot start a thread: {0}")]
    Thread(#[from] std::io::Error),
    /// A record file could not be written any more.
    #[error("{0}")]
    Unrecorded(String),
}

type ComponentEndpoint = Endpoint<RecordedInput, RecordedOutput>;

/// Runs the component described by the launch file until told to stop.
///
/// # Errors
/// When the component cannot be made or a channel breaks; the supervisor is told as well.
pub fn run(launch: &Path, registry: &Registry) -> Result<(), ComponentError> {
    let outcome = prepare_and_live(launch, registry);
    if let Err(error) = &outcome {
        say(&FromProcess::Failed(error.to_string()));
    }
    outcome
}

fn prepare_and_live(path: &Path, registry: &Registry) -> Result<(), ComponentError> {
    let orders = Orders::listen()?;
    let launch: ComponentLaunch = read(path)?;
    let card: ProcessCard = read(&launch.card)?;
    let asked = MonotonicClock::now();
    let role = make_role(&card, registry)?;
    let prepared_in = MonotonicClock::now().saturating_duration_since(asked);
    let counts = Counts::of(&card);
    let mut recorder = Recorder::new(&launch.records, &launch.process, launch.instance);
    let sinks = Sinks::open(&card, &mut recorder)?;
    recorder.start_and_tell(orders.stopper())?;
    let progress = counts.report_progress()?;

    // Everything below runs on this thread, which from here on is the measured one.
    let domain = Domain::open(&launch.domain.parse().map_err(DomainError::Address)?)?;
    let mut waiter = open_waiter(&domain, &card, launch.wait)?;
    let endpoint = connect(role, &domain, &card, launch.wait, (sinks, &counts))?;
    warn_of_spinning(&launch);
    let grant = realtime::apply(&launch.realtime);
    say(&FromProcess::Ready);
    let mut report = ProcessReport {
        realtime: vec![("main".to_owned(), grant)],
        preparation_s: Some(prepared_in.as_secs_f64()),
        ..ProcessReport::default()
    };
    let mut lived = Ok(());
    if orders.wait_for_start() {
        let how = (launch.wait, &counts);
        lived = live(endpoint, waiter.as_mut(), &orders, how, &mut report);
        progress.store(false, Ordering::Release);
    }
    drop(waiter);
    let outcome = recorder.finish();
    let problem = outcome.problem();
    report.recorder_dropped = outcome.dropped_count;
    report.recorder_failures = outcome.failures;
    add_usage(&mut report);
    say(&FromProcess::Finished(Box::new(report)));
    lived?;
    problem.map_or(Ok(()), |text| Err(ComponentError::Unrecorded(text)))
}

fn make_role(card: &ProcessCard, registry: &Registry) -> Result<Box<dyn Role>, ComponentError> {
    let name = card.case.clone().unwrap_or_default();
    let entry = registry
        .find(&name)
        .ok_or(ComponentError::UnknownCase(name))?;
    let parameters = serde_json::to_value(&card.parameters).unwrap_or_default();
    let case = entry.make(parameters, card.seed)?;
    let role = card.role.clone().unwrap_or_default();
    case.role(&role).ok_or(ComponentError::UnknownRole {
        case: entry.name.to_owned(),
        role,
    })
}

/// Live counters of a component's ports, in port order.
struct Counts {
    taken: Vec<Count>,
    given: Vec<Count>,
    /// Ticks that passed without the role; [`NO_TIMER`] for one that has none.
    skipped: Arc<AtomicU64>,
    pulse: Pulse,
}

/// How many messages of a channel went which way.
struct Count {
    channel: String,
    what: &'static str,
    so_far: Arc<AtomicU64>,
}

impl Counts {
    fn of(card: &ProcessCard) -> Self {
        let count = |channel: &CardChannel, what| Count {
            channel: channel.name.clone(),
            what,
            so_far: Arc::default(),
        };
        let given = |channel: &CardChannel| {
            let is_recorded_only = channel.is_recorded_only;
            count(
                channel,
                if is_recorded_only {
                    "recorded"
                } else {
                    "published"
                },
            )
        };
        Self {
            taken: card.inputs.iter().map(|one| count(one, "taken")).collect(),
            given: card.outputs.iter().map(given).collect(),
            skipped: Arc::new(AtomicU64::new(NO_TIMER)),
            pulse: Pulse::default(),
        }
    }

    /// Tells the supervisor the counts a few times a second, from a thread of its own.
    fn report_progress(&self) -> Result<Arc<AtomicBool>, std::io::Error> {
        let all: Vec<(ChannelProgress, Arc<AtomicU64>)> = self
            .taken
            .iter()
            .chain(&self.given)
            .map(|one| {
                let progress = ChannelProgress {
                    channel: one.channel.clone(),
                    what: one.what.to_owned(),
                    count: 0,
                };
                (progress, Arc::clone(&one.so_far))
            })
            .collect();
        let skipped = Arc::clone(&self.skipped);
        let mut pulses = Pulses::of([self.pulse.clone()]);
        let is_running = Arc::new(AtomicBool::new(true));
        let running = Arc::clone(&is_running);
        thread::Builder::new()
            .name("progress".to_owned())
            .spawn(move || {
                while running.load(Ordering::Acquire) {
                    thread::sleep(PROGRESS_PERIOD);
                    if pulses.have_all_beaten() {
                        say(&FromProcess::Alive);
                    }
                    let counts = all.iter().map(|(progress, count)| ChannelProgress {
                        count: count.load(Ordering::Relaxed),
                        ..progress.clone()
                    });
                    say(&FromProcess::Progress(counts.collect()));
                    let skipped = skipped.load(Ordering::Relaxed);
                    if skipped != NO_TIMER {
                        say(&FromProcess::SkippedTicks(skipped));
                    }
                }
            })?;
        Ok(is_running)
    }
}

/// The record rings of a component, in port order.
struct Sinks {
    taken: Vec<RecordSink>,
    given: Vec<GivenSinks>,
}

/// The record rings of one output.
struct GivenSinks {
    /// The producer's side of the account; `None` when there is nothing to account for.
    published: Option<RecordSink>,
    messages: RecordSink,
}

impl Sinks {
    fn open(card: &ProcessCard, recorder: &mut Recorder) -> Result<Self, RecordFileError> {
        let mut taken = Vec::new();
        for channel in &card.inputs {
            let size = size_of::<TakenRecord>();
            taken.push(recorder.sink(RecordKind::Taken, &channel.name, size, RING_RECORDS)?);
        }
        let mut given = Vec::new();
        for channel in &card.outputs {
            let mut sink = |kind, size| recorder.sink(kind, &channel.name, size, RING_RECORDS);
            let is_accounted = !channel.is_recorded_only;
            let message_size = size_of::<Envelope>() + channel.message_size_bytes;
            given.push(GivenSinks {
                published: is_accounted
                    .then(|| sink(RecordKind::Published, size_of::<PublishedRecord>()))
                    .transpose()?,
                messages: sink(RecordKind::Message, message_size)?,
            });
        }
        Ok(Self { taken, given })
    }
}

fn connect(
    role: Box<dyn Role>,
    domain: &Domain,
    card: &ProcessCard,
    wait: WaitMode,
    (sinks, counts): (Sinks, &Counts),
) -> Result<ComponentEndpoint, ComponentError> {
    // Producers of one channel never start twice within a microsecond on one host.
    let epoch = u32::try_from(MonotonicClock::now().as_ns() / 1000 % i64::from(u32::MAX))
        .expect("the remainder is below u32::MAX");
    let settings = OutputSettings {
        epoch,
        ..OutputSettings::default()
    };
    let mut inputs = Vec::new();
    let declared: Vec<MessageType> = role.inputs().to_vec();
    for (((channel, message), sink), taken) in card
        .inputs
        .iter()
        .zip(declared)
        .zip(sinks.taken)
        .zip(&counts.taken)
    {
        inputs.push(RecordedInput {
            port: ShmInput::open(domain, &channel.name, &message, channel.depth)?,
            sink,
            taken: Arc::clone(&taken.so_far),
            wait: WaitStrategy::new(wait),
        });
    }
    let mut outputs = Vec::new();
    let declared: Vec<MessageType> = role.outputs().to_vec();
    for (((channel, message), sinks), given) in card
        .outputs
        .iter()
        .zip(declared)
        .zip(sinks.given)
        .zip(&counts.given)
    {
        let destination = match sinks.published {
            Some(sink) => {
                let port = ShmOutput::open(domain, &channel.name, &message, settings)?;
                let port = Box::new(port);
                Destination::Channel { port, sink }
            }
            None => Destination::Record(Sequencer::new(settings)),
        };
        outputs.push(RecordedOutput {
            destination,
            messages: sinks.messages,
            given: Arc::clone(&given.so_far),
        });
    }
    Ok(Endpoint::new(role, inputs, outputs)?)
}

/// A component without inputs, or one that spins, listens for no wake-ups.
fn open_waiter(
    domain: &Domain,
    card: &ProcessCard,
    mode: WaitMode,
) -> Result<Option<Waiter>, ChannelError> {
    if card.inputs.is_empty() || mode == WaitMode::Spin {
        return Ok(None);
    }
    let names: Vec<&str> = card
        .inputs
        .iter()
        .map(|channel| channel.name.as_str())
        .collect();
    Waiter::open(domain, &names).map(Some)
}

fn warn_of_spinning(launch: &ComponentLaunch) {
    if launch.wait != WaitMode::Spin {
        return;
    }
    match launch.realtime.cpu.map(realtime::spin_advice) {
        Some(SpinAdvice::Fine) => {}
        Some(SpinAdvice::Warn(why)) => say(&FromProcess::Warning(format!("wait = spin: {why}"))),
        None => say(&FromProcess::Warning(
            "wait = spin without a cpu of its own".to_owned(),
        )),
    }
}

fn live(
    mut endpoint: ComponentEndpoint,
    mut waiter: Option<&mut Waiter>,
    orders: &Orders,
    (mode, counts): (WaitMode, &Counts),
    report: &mut ProcessReport,
) -> Result<(), ChannelError> {
    let own_wait = WaitStrategy::new(mode);
    endpoint.start(MonotonicClock::now());
    let mut outcome = Ok(());
    while outcome.is_ok() && !orders.is_stopping() {
        let ticks = report.ticks;
        outcome = turn(&mut endpoint, &mut waiter, &own_wait, report);
        counts.pulse.beat();
        if report.ticks != ticks {
            let skipped = &counts.skipped;
            skipped.store(endpoint.role().skipped_ticks(), Ordering::Relaxed);
        }
    }
    report.skipped_ticks = endpoint.role().skipped_ticks();
    report.outbox_dropped = endpoint.role().outbox_dropped();
    let inputs = endpoint.inputs_mut().iter();
    report.connection_failures = inputs
        .map(|one| one.port.counters().connection_failure_count)
        .sum();
    let outputs = endpoint.outputs_mut().iter();
    report.connection_failures += outputs
        .map(RecordedOutput::connection_failure_count)
        .sum::<u64>();
    outcome
}

/// Does what there is to do, then waits for more.
fn turn(
    endpoint: &mut ComponentEndpoint,
    waiter: &mut Option<&mut Waiter>,
    own_wait: &WaitStrategy,
    report: &mut ProcessReport,
) -> Result<(), ChannelError> {
    let activity = endpoint.poll(MonotonicClock::now())?;
    report.malformed_count += activity.malformed_count;
    report.ticks += activity.tick_count;
    let now = MonotonicClock::now();
    let mut pause = own_wait.pause(now, endpoint.role().next_tick());
    for input in endpoint.inputs_mut() {
        pause = pause.sooner(input.wait.pause(now, None));
    }
    match (pause, waiter) {
        (Pause::Spin, _) => core::hint::spin_loop(),
        (Pause::Sleep(until), Some(waiter)) => {
            waiter.wait_until(Some(until))?;
        }
        (Pause::Sleep(until), None) => {
            // An interrupted sleep only means looking again a little early.
            let (Wake::Due | Wake::Interrupted) = MonotonicClock::sleep_until(until);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_shuttle::Shuttle;

    fn card(case: &str, role: &str) -> ProcessCard {
        ProcessCard {
            process: "test".to_owned(),
            case: Some(case.to_owned()),
            role: Some(role.to_owned()),
            seed: 1,
            inputs: Vec::new(),
            outputs: Vec::new(),
            parameters: toml::Table::new(),
        }
    }

    #[test]
    fn a_card_that_fits_no_case_or_role_is_refused_by_name() {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let error = make_role(&card("fleet", "robot"), &registry).unwrap_err();
        assert!(error.to_string().contains("no case fleet"), "{error}");
        let error = make_role(&card("shuttle", "pilot"), &registry).unwrap_err();
        assert_eq!(error.to_string(), "case shuttle has no role pilot");
        assert!(make_role(&card("shuttle", "robot"), &registry).is_ok());
    }
}
