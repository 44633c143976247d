//! The process of one component: the same endpoint that virtual time drives, on shared-memory
//! ports and a real clock.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_core::component::Role;
use hil_core::endpoint::Endpoint;
use hil_core::message::{Envelope, MessageType};
use hil_core::record::{PublishedRecord, TakenRecord};

use super::heartbeat::Heartbeat;
use super::recording::{Destination, RecordedInput, RecordedOutput, output_settings};
use super::worker::{
    Counter, Job, JobWork, NO_TIMER, Opened, WorkerError, open_domain, warn_of_spinning,
};
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::wait::{Pause, WaitMode, WaitStrategy};
use hil_rundir::launch::{ComponentWork, WorkerLaunch, read};
use hil_rundir::pipe::{Orders, ProcessReport};
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder};
use hil_shm::{ChannelError, Domain, Sequencer, ShmInput, ShmOutput, Waiter};
use hil_topology::registry::Registry;
use hil_topology::{RoleChannel, RoleSpec};

/// Records a ring holds: 4 s at 4 kHz, far more than the writer's period needs.
const RING_RECORDS: usize = 16_384;

type ComponentEndpoint = Endpoint<RecordedInput, RecordedOutput>;

/// Opens the record files of the component of `launch`; the rest is made in its thread, which is the
/// measured one.
///
/// # Errors
/// When a file cannot be read or made.
pub(super) fn open<'a>(
    launch: &'a WorkerLaunch,
    work: &'a ComponentWork,
    registry: &'a Registry,
    recorder: &mut Recorder,
) -> Result<Opened<'a>, WorkerError> {
    let card: RoleSpec = read(&work.card)?;
    let counts = Counts::of(&card);
    let sinks = Sinks::open(&card, recorder)?;
    let skipped_ticks = Some(Arc::clone(&counts.skipped));
    let job = Job {
        name: "main".to_owned(),
        counters: counts.taken.iter().chain(&counts.given).cloned().collect(),
        heartbeat: Some(counts.heartbeat.clone()),
        connect: Box::new(move |thread| {
            let asked = MonotonicClock::now();
            let role = make_role(&card, registry)?;
            let prepared_in = MonotonicClock::now().saturating_duration_since(asked);
            let domain = open_domain(launch)?;
            let waiter = open_waiter(&domain, &card, work.wait)?;
            let endpoint = connect(role, &domain, &card, work.wait, sinks, &counts)?;
            warn_of_spinning("", work.wait, work.realtime.cpu);
            thread.claim(&work.realtime);
            Ok(Box::new(Component {
                endpoint,
                waiter,
                wait: WaitStrategy::new(work.wait),
                counts,
                report: ProcessReport {
                    preparation_s: Some(prepared_in.as_secs_f64()),
                    ..ProcessReport::default()
                },
                _domain: domain,
            }))
        }),
    };
    Ok(Opened {
        jobs: vec![job],
        skipped_ticks,
        ..Opened::default()
    })
}

/// A component at work.
struct Component {
    endpoint: ComponentEndpoint,
    waiter: Option<Waiter>,
    wait: WaitStrategy,
    counts: Counts,
    report: ProcessReport,
    /// Outlives the ports.
    _domain: Domain,
}

fn make_role(card: &RoleSpec, registry: &Registry) -> Result<Box<dyn Role>, WorkerError> {
    let name = card.case.clone().unwrap_or_default();
    let entry = registry.find(&name).ok_or(WorkerError::UnknownCase(name))?;
    let parameters = serde_json::to_value(&card.parameters).unwrap_or_default();
    let case = entry.make(parameters, card.seed)?;
    let role = card.role.clone().unwrap_or_default();
    case.role(&role).ok_or(WorkerError::UnknownRole {
        case: entry.name.to_owned(),
        role,
    })
}

/// Live counters of a component's ports, in port order.
struct Counts {
    taken: Vec<Counter>,
    given: Vec<Counter>,
    /// Ticks that passed without the role; [`NO_TIMER`] for one that has none.
    skipped: Arc<AtomicU64>,
    heartbeat: Heartbeat,
}

impl Counts {
    fn of(card: &RoleSpec) -> Self {
        let counter = |channel: &RoleChannel, what| Counter {
            channel: channel.name.clone(),
            what,
            count: Arc::default(),
        };
        let given = |channel: &RoleChannel| {
            let what = if channel.is_recorded_only {
                "recorded"
            } else {
                "published"
            };
            counter(channel, what)
        };
        Self {
            taken: card
                .inputs
                .iter()
                .map(|one| counter(one, "taken"))
                .collect(),
            given: card.outputs.iter().map(given).collect(),
            skipped: Arc::new(AtomicU64::new(NO_TIMER)),
            heartbeat: Heartbeat::default(),
        }
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
    fn open(card: &RoleSpec, recorder: &mut Recorder) -> Result<Self, RecordFileError> {
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
    card: &RoleSpec,
    wait: WaitMode,
    sinks: Sinks,
    counts: &Counts,
) -> Result<ComponentEndpoint, WorkerError> {
    let settings = output_settings();
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
            taken: Arc::clone(&taken.count),
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
            given: Arc::clone(&given.count),
        });
    }
    Ok(Endpoint::new(role, inputs, outputs)?)
}

/// A component without inputs, or one that spins, listens for no wake-ups.
fn open_waiter(
    domain: &Domain,
    card: &RoleSpec,
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

impl JobWork for Component {
    fn run(&mut self, orders: &Orders) -> Result<(), WorkerError> {
        if !orders.wait_for_start() {
            return Ok(());
        }
        self.endpoint.start(MonotonicClock::now());
        while !orders.is_stopping() {
            let ticks = self.report.ticks;
            self.turn()?;
            self.counts.heartbeat.beat();
            if self.report.ticks != ticks {
                let skipped = self.endpoint.role().skipped_ticks();
                self.counts.skipped.store(skipped, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    fn report(&mut self) -> ProcessReport {
        let inputs = self.endpoint.inputs_mut().iter();
        let deaf = inputs.map(|one| one.port.counters().connection_failure_count);
        let deaf: u64 = deaf.sum();
        let outputs = self.endpoint.outputs_mut().iter();
        let unheard = outputs.map(RecordedOutput::connection_failure_count);
        let unheard: u64 = unheard.sum();
        ProcessReport {
            skipped_ticks: self.endpoint.role().skipped_ticks(),
            outbox_dropped: self.endpoint.role().outbox_dropped(),
            connection_failures: deaf + unheard,
            ..self.report.clone()
        }
    }
}

impl Component {
    /// Does what there is to do, then waits for more.
    fn turn(&mut self) -> Result<(), ChannelError> {
        let activity = self.endpoint.poll(MonotonicClock::now())?;
        self.report.malformed_count += activity.malformed_count;
        self.report.ticks += activity.tick_count;
        let now = MonotonicClock::now();
        let mut pause = self.wait.pause(now, self.endpoint.role().next_tick());
        for input in self.endpoint.inputs_mut() {
            pause = pause.sooner(input.wait.pause(now, None));
        }
        match (pause, &mut self.waiter) {
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_shuttle::Shuttle;

    fn role_spec(case: &str, role: &str) -> RoleSpec {
        RoleSpec {
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
    fn a_role_spec_that_fits_no_case_or_role_is_refused_by_name() {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let error = make_role(&role_spec("fleet", "robot"), &registry).unwrap_err();
        assert!(error.to_string().contains("no case fleet"), "{error}");
        let error = make_role(&role_spec("shuttle", "pilot"), &registry).unwrap_err();
        assert_eq!(error.to_string(), "case shuttle has no role pilot");
        assert!(make_role(&role_spec("shuttle", "robot"), &registry).is_ok());
    }
}
