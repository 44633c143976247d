//! The process of one component: the same endpoint that virtual time drives, on shared-memory
//! ports and a real clock.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hil_core::component::{Port, Role};
use hil_core::endpoint::{Endpoint, RoleChannels, StatedChannel};
use hil_core::message::{Envelope, TypeInfo};
use hil_core::record::{PublishedRecord, TakenRecord};

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
    let Opening { counters, parts } = Opening::of(&card, recorder)?;
    let skipped = Arc::new(AtomicU64::new(NO_TIMER));
    let skipped_ticks = Some(Arc::clone(&skipped));
    let job = Job {
        name: "main".to_owned(),
        counters,
        is_watched: true,
        connect: Box::new(move |thread| {
            let asked = MonotonicClock::now();
            let role = make_role(&card, registry)?;
            let prepared_in = MonotonicClock::now().saturating_duration_since(asked);
            let domain = open_domain(launch)?;
            let waiter = open_waiter(&domain, &card, work.wait)?;
            let channels = channels_of(&card, &work.card);
            let endpoint = connect(role, &channels, &domain, work.wait, parts)?;
            warn_of_spinning("", work.wait, work.realtime.cpu);
            thread.claim(&work.realtime);
            Ok(Box::new(Component {
                endpoint,
                waiter,
                wait: WaitStrategy::new(work.wait, work.realtime.cpu),
                skipped,
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
    /// Ticks that passed without the role; [`NO_TIMER`] for one that has none.
    skipped: Arc<AtomicU64>,
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

/// The channels that the card in `file` states for its role.
fn channels_of(card: &RoleSpec, file: &Path) -> RoleChannels {
    let stated = |channels: &[RoleChannel]| {
        let channels = channels.iter().map(|channel| StatedChannel {
            name: channel.name.clone(),
            message: TypeInfo {
                name: channel.message_name.clone(),
                size_bytes: channel.message_size_bytes,
                alignment_bytes: channel.message_alignment_bytes,
            },
        });
        channels.collect()
    };
    RoleChannels {
        role: card.role.clone().unwrap_or_default(),
        stated_by: file.display().to_string(),
        inputs: stated(&card.inputs),
        outputs: stated(&card.outputs),
    }
}

/// What is opened of a component before its thread begins.
struct Opening {
    /// Of its ports, in the card's order.
    counters: Vec<Counter>,
    parts: Parts,
}

/// What ports need beside shared memory, by channel.
#[derive(Default)]
struct Parts {
    inputs: BTreeMap<String, InputParts>,
    outputs: BTreeMap<String, OutputParts>,
}

struct InputParts {
    depth: usize,
    sink: RecordSink,
    taken: Arc<AtomicU64>,
}

struct OutputParts {
    /// The producer's side of the account; `None` when there is nothing to account for.
    published: Option<RecordSink>,
    messages: RecordSink,
    given: Arc<AtomicU64>,
}

impl Opening {
    fn of(card: &RoleSpec, recorder: &mut Recorder) -> Result<Self, RecordFileError> {
        let mut counters = Vec::new();
        let mut counter = |channel: &RoleChannel, what| {
            let count = Arc::default();
            counters.push(Counter::new(&channel.name, what, &count));
            count
        };
        let mut parts = Parts::default();
        for channel in &card.inputs {
            let size = size_of::<TakenRecord>();
            let input = InputParts {
                depth: channel.depth,
                sink: recorder.sink(RecordKind::Taken, &channel.name, size, RING_RECORDS)?,
                taken: counter(channel, "taken"),
            };
            parts.inputs.insert(channel.name.clone(), input);
        }
        for channel in &card.outputs {
            let mut sink = |kind, size| recorder.sink(kind, &channel.name, size, RING_RECORDS);
            let is_accounted = !channel.is_recorded_only;
            let message_size = size_of::<Envelope>() + channel.message_size_bytes;
            let what = if is_accounted {
                "published"
            } else {
                "recorded"
            };
            let output = OutputParts {
                published: is_accounted
                    .then(|| sink(RecordKind::Published, size_of::<PublishedRecord>()))
                    .transpose()?,
                messages: sink(RecordKind::Message, message_size)?,
                given: counter(channel, what),
            };
            parts.outputs.insert(channel.name.clone(), output);
        }
        Ok(Self { counters, parts })
    }
}

fn connect(
    role: Box<dyn Role>,
    channels: &RoleChannels,
    domain: &Domain,
    wait: WaitMode,
    parts: Parts,
) -> Result<ComponentEndpoint, WorkerError> {
    const STATED: &str = "a joined port has a channel of its name";
    let settings = output_settings();
    let Parts {
        mut inputs,
        mut outputs,
    } = parts;
    let open_input = |port: &Port| {
        let InputParts { depth, sink, taken } = inputs.remove(port.name).expect(STATED);
        Ok(RecordedInput {
            port: ShmInput::open(domain, port.name, &port.message, depth)?,
            sink,
            taken,
            wait: WaitStrategy::new(wait, None),
        })
    };
    let open_output = |port: &Port| {
        let output = outputs.remove(port.name).expect(STATED);
        let destination = match output.published {
            Some(sink) => {
                let port = ShmOutput::open(domain, port.name, &port.message, settings)?;
                let port = Box::new(port);
                Destination::Channel { port, sink }
            }
            None => Destination::Record(Sequencer::new(settings)),
        };
        Ok(RecordedOutput {
            destination,
            messages: output.messages,
            given: output.given,
        })
    };
    Endpoint::join(role, channels, open_input, open_output)
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
    fn begin(&mut self, orders: &Orders) -> Result<bool, WorkerError> {
        let has_started = orders.wait_for_start();
        if has_started {
            self.endpoint.start(MonotonicClock::now())?;
        }
        Ok(has_started)
    }

    /// Whatever it did, the endpoint itself says when it is due next.
    fn step(&mut self) -> Result<bool, WorkerError> {
        let activity = self.endpoint.poll(MonotonicClock::now())?;
        self.report.malformed_count += activity.malformed_count;
        self.report.ticks += activity.tick_count;
        if activity.tick_count > 0 {
            let skipped = self.endpoint.role().skipped_ticks();
            self.skipped.store(skipped, Ordering::Relaxed);
        }
        Ok(false)
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        let now = MonotonicClock::now();
        let mut pause = self.wait.pause(now, self.endpoint.role().next_tick());
        for input in self.endpoint.inputs_mut() {
            pause = pause.sooner(input.wait.pause(now, None));
        }
        match (pause, &mut self.waiter) {
            (Pause::Spin, _) => self.wait.spin(),
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

    #[test]
    fn a_role_spec_with_another_message_is_refused_with_both_sides() {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        let mut card = role_spec("shuttle", "controller");
        let channel = |name: &str, message: &str, size| RoleChannel {
            name: name.to_owned(),
            message_name: message.to_owned(),
            message_size_bytes: size,
            message_alignment_bytes: 8,
            depth: 1,
            is_recorded_only: false,
        };
        card.outputs = vec![channel("shuttle/command", "hil.ShuttleCommand.v1", 16)];
        card.inputs = vec![channel("shuttle/status", "hil.ShuttleStatus.v2", 24)];
        let role = make_role(&card, &registry).unwrap();
        let channels = channels_of(&card, Path::new("/run/controller.json"));
        let error = channels.check(role.as_ref()).map_err(WorkerError::from);
        let expected = "input port shuttle/status of role controller takes hil.ShuttleStatus.v1 (8 \
                        bytes aligned to 8), but /run/controller.json states hil.ShuttleStatus.v2 \
                        (24 bytes aligned to 8)";
        assert_eq!(error.unwrap_err().to_string(), expected);
    }
}
