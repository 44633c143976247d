//! One way of a link through a gateway, from its launch description to its final counters: opens the socket
//! in the normal thread, the shared-memory ports in the pinned one.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Duration;

use hil_core::link_model::ReplayTally;
use hil_core::record::{EgressRecord, IngressRecord, NoRoomRecord, RoundTripRecord};
use hil_core::time::duration_ns;
use hil_protocol::ingress::reassembly_slots;
use hil_protocol::{EgressBridge, EgressSettings, IngressBridge, IngressSettings, SettingsError};
use hil_transport::Stalls;

use super::egress::{Attention, Egress};
use super::ingress::{Ingress, NoRoom, Output};
use super::inputs::Inputs;
use super::kernel_clock::KernelClock;
use super::line::Line;
use super::refusal_backoff::RefusalBackoff;
use super::socket::{OpenSocket, SocketEnd, timestamp_mode};
use super::stamp_plan::StampPlan;
use super::{GatewayContext, WorkerError, counters};
use crate::cable::{Inward, OpenInward, OpenOutward, Outward, clear};
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WaitStrategy;
use hil_rundir::launch::{ChannelLaunch, DirectionLaunch, Side};
use hil_rundir::pipe::{
    ChannelReport, CountByName, CounterGroup, DirectionReport, InletReport, RunStart, StallMetrics,
};
use hil_rundir::record::{RecordKind, RecordSink, Recorder, SharedSink};
use hil_shm::RawOutput;

/// Records of one kind that wait for the disk at most: so many for each channel, and of all together.
const RING_RECORDS: usize = 16_384;
const RING_RECORDS_MAX: usize = 65_536;
const ROUND_TRIPS: usize = 4_096;
/// Time between clock exchanges: frequent enough for a round-trip distribution, rare enough to
/// be a fraction of any control channel's traffic.
const SYNC_PERIOD: Duration = Duration::from_millis(100);
/// The same on a clock path, which has nothing else to do: clocks stray by 2 us at most in between,
/// which is less than the fastest exchange leaves open.
const CLOCK_PATH_PERIOD: Duration = Duration::from_millis(10);

/// A direction whose socket and files are open and whose ports are not.
#[derive(Debug)]
pub struct OpenDirection {
    pub(super) socket: OpenSocket,
    sinks: Sinks,
    /// Messages carried so far, by channel.
    pub(super) counts: Vec<Arc<AtomicU64>>,
    /// True while the peer takes this direction's messages.
    pub(super) is_established: Arc<AtomicBool>,
    /// The programs on this host whose frames its messages are, by the index of their channel.
    pub(super) cables: Vec<(usize, OpenCable)>,
    plan: StampPlan,
}

/// What is open for a program whose frames a direction carries.
#[derive(Debug)]
pub(super) enum OpenCable {
    Outward(OpenOutward),
    Inward(OpenInward),
}

/// The record rings of a direction.
#[derive(Debug)]
enum Sinks {
    Egress {
        /// One record for each message, by channel.
        messages: SharedSink,
        round_trips: RecordSink,
    },
    Ingress {
        messages: SharedSink,
        no_room: RecordSink,
    },
}

/// A direction at work.
#[derive(Debug)]
pub struct Direction {
    way: BridgeLoop,
    facts: Vec<(String, String)>,
    /// By channel.
    replays: Vec<Option<ReplayTally>>,
}

#[derive(Debug)]
enum BridgeLoop {
    Egress {
        egress: Box<Egress>,
        /// By the index of their channel.
        cables: Vec<(usize, Outward)>,
    },
    Ingress {
        ingress: Box<Ingress>,
        cables: Vec<Inward>,
    },
}

/// Opens the socket and the record files of `launch`; call it from a thread of normal priority.
/// `start` is told when the run starts, from which an emulated link counts its outages.
///
/// # Errors
/// When the kernel refuses a socket option or a file cannot be made.
pub fn open(
    launch: &DirectionLaunch,
    recorder: &mut Recorder,
    start: &RunStart,
) -> Result<OpenDirection, WorkerError> {
    let plan = StampPlan::asked(timestamp_mode(launch.socket.common.timestamps));
    let socket = OpenSocket::open(launch, plan, start, None)?;
    OpenDirection::new(launch, recorder, socket, plan)
}

fn open_sinks(launch: &DirectionLaunch, recorder: &mut Recorder) -> Result<Sinks, WorkerError> {
    let capacity = (RING_RECORDS * launch.channels.len()).min(RING_RECORDS_MAX);
    let mut of_channels = |kind, size| {
        let names = launch.channels.iter().map(|one| one.channel.as_str());
        recorder.shared_sink(kind, names, size, capacity)
    };
    Ok(match launch.side {
        Side::Egress => Sinks::Egress {
            messages: of_channels(RecordKind::Egress, size_of::<EgressRecord>())?,
            round_trips: recorder.sink(
                RecordKind::RoundTrip,
                &launch.flow,
                size_of::<RoundTripRecord>(),
                ROUND_TRIPS,
            )?,
        },
        Side::Ingress => Sinks::Ingress {
            messages: of_channels(RecordKind::Ingress, size_of::<IngressRecord>())?,
            no_room: recorder.sink(
                RecordKind::NoRoom,
                &launch.flow,
                size_of::<NoRoomRecord>(),
                ROUND_TRIPS,
            )?,
        },
    })
}

fn open_cables(
    launch: &DirectionLaunch,
    recorder: &mut Recorder,
) -> Result<Vec<(usize, OpenCable)>, WorkerError> {
    let channels = launch.channels.iter().enumerate();
    let mut open = |one: &ChannelLaunch| -> Result<OpenCable, WorkerError> {
        Ok(match launch.side {
            Side::Egress => OpenCable::Outward(OpenOutward::new(recorder, &one.channel)?),
            Side::Ingress => OpenCable::Inward(OpenInward::new(recorder, &one.channel)?),
        })
    };
    channels
        .filter(|(_, one)| one.cable_socket.is_some())
        .map(|(index, one)| Ok((index, open(one)?)))
        .collect()
}

impl OpenDirection {
    /// The direction of an open socket, with its record files.
    ///
    /// # Errors
    /// When a file cannot be made.
    pub(super) fn new(
        launch: &DirectionLaunch,
        recorder: &mut Recorder,
        socket: OpenSocket,
        plan: StampPlan,
    ) -> Result<Self, WorkerError> {
        Ok(Self {
            socket,
            sinks: open_sinks(launch, recorder)?,
            cables: open_cables(launch, recorder)?,
            plan,
            counts: launch.channels.iter().map(|_| Arc::default()).collect(),
            // A receiver has nobody to wait for: it takes what comes.
            is_established: Arc::new(AtomicBool::new(launch.side == Side::Ingress)),
        })
    }

    /// Joins the local channels; call it in the thread that will carry the messages.
    ///
    /// # Errors
    /// When a channel does not appear or is of another type.
    pub fn connect(
        self,
        launch: &DirectionLaunch,
        around: &GatewayContext,
        start: &RunStart,
    ) -> Result<Direction, WorkerError> {
        let (domain, mut outward, mut inward) = (&around.domain, Vec::new(), Vec::new());
        for (index, open) in self.cables {
            let one = &launch.channels[index];
            let Some(socket) = &one.cable_socket else {
                continue;
            };
            match open {
                // The thread that publishes is the one that takes: nobody is to be woken.
                OpenCable::Outward(open) => {
                    let start = start.clone();
                    let cable = Outward::join(domain, &one.channel, socket, false, open, start)?;
                    outward.push((index, cable));
                }
                OpenCable::Inward(open) => {
                    inward.push(Inward::join(domain, &one.channel, socket, one.depth, open)?);
                }
            }
        }
        let way = match (self.socket.ends, self.sinks) {
            (
                SocketEnd::Sender(sender, datagram_max_bytes),
                Sinks::Egress {
                    messages,
                    round_trips,
                },
            ) => BridgeLoop::Egress {
                cables: outward,
                egress: Box::new(Egress {
                    inputs: Inputs::open(&around.domain, &launch.channels, launch.wait)?,
                    long: None,
                    bridge: egress_bridge(datagram_max_bytes, launch, around)?,
                    line: Line::new(sender, messages, round_trips, around.session, self.plan)?,
                    wait: WaitStrategy::new(launch.wait, launch.realtime.cpu),
                    sent: self.counts.into_boxed_slice(),
                    attention: Attention::default(),
                    refusal_backoff: RefusalBackoff::of_replies(),
                    path_bytes: None,
                    is_established: self.is_established,
                }),
            },
            (SocketEnd::Receiver(receiver), Sinks::Ingress { messages, no_room }) => {
                let settings = IngressSettings::new(
                    GatewayContext::identity(launch),
                    around.session,
                    around.fingerprint,
                    around.clock_id,
                );
                let channels = launch.channels.iter().zip(self.counts);
                let outputs = channels.map(|(one, received)| {
                    let (name, slots) = (&one.channel, reassembly_slots(one.size_bytes));
                    let notifies_readers = one.cable_socket.is_none();
                    Ok(Output {
                        port: RawOutput::open_assembling(domain, name, notifies_readers, slots)?,
                        received,
                    })
                });
                BridgeLoop::Ingress {
                    cables: inward,
                    ingress: Box::new(Ingress {
                        receiver,
                        is_emulated: launch.channels.iter().any(|one| one.emulation.is_some()),
                        bridge: IngressBridge::new(settings)?,
                        outputs: outputs.collect::<Result<_, WorkerError>>()?,
                        records: messages,
                        no_room: NoRoom::new(),
                        no_room_records: no_room,
                        wait: WaitStrategy::new(launch.wait, launch.realtime.cpu),
                        peer: launch.peer,
                        foreign_count: 0,
                        refusal_backoff: RefusalBackoff::of_messages(),
                        clock: KernelClock::read()?,
                        response: None,
                        buffer: vec![0; usize::from(u16::MAX)].into_boxed_slice(),
                    }),
                }
            }
            _ => unreachable!("sinks and socket are opened for one side"),
        };
        Ok(Direction {
            way,
            facts: self.socket.facts,
            replays: self.socket.replays,
        })
    }
}

/// A bridge over a path that takes datagrams of so many bytes.
pub(super) fn egress_bridge(
    datagram_max_bytes: usize,
    launch: &DirectionLaunch,
    around: &GatewayContext,
) -> Result<EgressBridge, SettingsError> {
    EgressBridge::new(EgressSettings {
        flow: GatewayContext::identity(launch),
        session: around.session,
        domain: around.fingerprint,
        clock_id: around.clock_id,
        datagram_max_bytes,
        sync_period: if launch.is_clock_path() {
            CLOCK_PATH_PERIOD
        } else {
            SYNC_PERIOD
        },
    })
}

/// Publishes one frame of each program whose last one was sent, and sends one message. What is not published yet
/// waits in the ring, which has more room than a channel.
fn step_outward(egress: &mut Egress, cables: &mut [(usize, Outward)]) -> Result<bool, WorkerError> {
    let mut has_moved = false;
    for (index, cable) in cables {
        if !egress.inputs.has_own(Some(*index)) && cable.step()? {
            egress.inputs.note_published(*index);
            has_moved = true;
        }
    }
    Ok(egress.step()? || has_moved || egress.inputs.has_own(None))
}

impl Direction {
    /// Ends what is under way once told to stop, or after a step that failed.
    pub(super) fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        match &mut self.way {
            BridgeLoop::Egress { egress, cables } => {
                let stepped = stepped.and_then(|()| clear(|| step_outward(egress, cables)));
                egress.finish(stepped)
            }
            BridgeLoop::Ingress { ingress, cables } => {
                ingress.finish();
                stepped?;
                cables.iter_mut().try_for_each(|one| clear(|| one.step()))
            }
        }
    }

    /// Does what there is to do now, without waiting; false when there was nothing.
    ///
    /// # Errors
    /// When a channel or the socket itself breaks, or the peer refuses the flow for good.
    pub fn step(&mut self) -> Result<bool, WorkerError> {
        match &mut self.way {
            BridgeLoop::Egress { egress, cables } => step_outward(egress, cables),
            BridgeLoop::Ingress { ingress, cables } => {
                let mut has_moved = ingress.step()?;
                for one in cables {
                    has_moved |= one.step()?;
                }
                Ok(has_moved)
            }
        }
    }

    /// Waits for the next thing to do, as its waiting strategy says.
    ///
    /// # Errors
    /// When waiting itself fails.
    pub fn rest(&mut self) -> Result<(), WorkerError> {
        match &mut self.way {
            BridgeLoop::Egress { egress, cables } => egress.rest(cables),
            BridgeLoop::Ingress { ingress, cables } => {
                ingress.rest(cables.iter().filter_map(Inward::next_look).min())
            }
        }
    }

    /// What the inlets of programs lost and their interfaces did not take, and how often a port of theirs failed to connect.
    pub(super) fn cables(&mut self) -> (Vec<InletReport>, u64) {
        match &mut self.way {
            BridgeLoop::Egress { cables, .. } => {
                let failures = cables.iter().map(|one| one.1.connection_failure_count());
                let failure_count = failures.sum();
                let reports = cables.iter_mut().map(|one| one.1.report());
                (reports.collect(), failure_count)
            }
            BridgeLoop::Ingress { cables, .. } => {
                let failures = cables.iter().map(Inward::connection_failure_count);
                let reports = cables.iter().map(Inward::report);
                (reports.collect(), failures.sum())
            }
        }
    }

    /// Every counter of the direction.
    pub fn report(&self, launch: &DirectionLaunch) -> DirectionReport {
        let now = MonotonicClock::now();
        let mut facts = self.facts.clone();
        let (peer_state, mut counters, transport, seal) = match &self.way {
            BridgeLoop::Egress { egress, .. } => {
                let sender = egress.line.sender();
                let found = egress.path_bytes.map(|bytes| {
                    let text = format!("{bytes} bytes a datagram, less than the link asks for");
                    ("path as found by greetings".to_owned(), text)
                });
                facts.extend(found);
                (
                    counters::egress_state(egress),
                    counters::of_egress(egress),
                    sender.report(now),
                    sender.seal_counts(),
                )
            }
            BridgeLoop::Ingress { ingress, .. } => {
                if launch.socket.common.dscp > 0 {
                    let counters = ingress.receiver.counters();
                    facts.extend(counters::mark_fact(launch.socket.common.dscp, &counters));
                }
                (
                    counters::ingress_state(ingress),
                    counters::of_ingress(ingress),
                    ingress.receiver.report(now),
                    ingress.receiver.seal_counts(),
                )
            }
        };
        counters.extend(seal.iter().flat_map(counters::of_seal));
        let own = CountByName::all(CounterGroup::Transport, transport.counters);
        counters.extend(own);
        let own = transport.facts.into_iter();
        facts.extend(own.map(|(label, text)| (label.to_owned(), text)));
        let channels = launch.channels.iter().enumerate().map(|(index, one)| {
            let replay = self.replays.get(index).and_then(Option::as_ref);
            ChannelReport {
                channel: one.channel.clone(),
                counters: match &self.way {
                    BridgeLoop::Egress { egress, .. } => counters::of_sent(egress, index),
                    BridgeLoop::Ingress { ingress, .. } => {
                        counters::of_received(ingress, index, one.channel_id)
                    }
                },
                replay: replay.map(ReplayTally::counts),
            }
        });
        DirectionReport {
            flow: launch.flow.clone(),
            direction: launch.side,
            peer_state,
            counters,
            facts,
            stalls: transport.stalls.map(stall_metrics),
            channels: channels.collect(),
        }
    }
}

fn stall_metrics(stalls: Stalls) -> StallMetrics {
    let nanoseconds = |time| duration_ns(time).unsigned_abs();
    StallMetrics {
        count: stalls.count,
        total_ns: nanoseconds(stalls.total),
        longest_ns: nanoseconds(stalls.longest),
        threshold_ns: nanoseconds(stalls.threshold),
    }
}
