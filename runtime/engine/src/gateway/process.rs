//! The process of one link's gateway on one host, or of one end of a clock path: one thread for what goes out
//! and one for what comes in. The process's own thread opens and arms the sockets, because kernel stamps are
//! switched on by a worker that a spinning real-time thread would starve; then it only looks after
//! connections and orders. A gateway that starts with the run says at once what is wrong with its
//! path; one that comes back during the run waits for a path that is away, as one that never
//! left would.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use std::{io, thread};

use hil_core::time::Instant;
use hil_link::condition::flow_label;
use hil_protocol::SettingsError;
use hil_transport::socket::SocketError;

use super::connection::Connection;
use super::direction::{Direction, OpenCable, OpenDirection, egress_bridge};
use super::link_control::LinkControl;
use super::socket::{OpenSocket, SocketEnd};
use super::timestamping::{self, TimestampingSetup};
use super::{GatewayContext, WorkerError};
use crate::process::worker::{Counter, Job, JobWork, Opened, open_domain, warn_of_spinning};
use hil_nic::radio::sampler::Sampler;
use hil_platform::clock::MonotonicClock;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::{DirectionLaunch, GatewayWork, Side, WorkerLaunch};
use hil_rundir::pipe::{FromProcess, Orders, ProcessReport, RunStart, say};
use hil_rundir::record::Recorder;
use hil_rundir::run_seal::RunSeal;

/// How long the run's secret may take, which the supervisor writes as soon as the process is there.
const SEAL_PATIENCE: Duration = Duration::from_secs(5);
/// How often a path that is away is looked for.
const RETRY_PERIOD: Duration = Duration::from_millis(50);

/// Opens the sockets and record files of the gateway of `launch`; call it from a thread of normal
/// priority. Without jobs when told to stop before there was a path.
///
/// # Errors
/// When a socket or file cannot be opened, and at the start of a run also when there is no path.
pub(crate) fn open<'a>(
    launch: &'a WorkerLaunch,
    work: &'a GatewayWork,
    orders: &Orders,
    recorder: &mut Recorder,
) -> Result<Opened<'a>, WorkerError> {
    let seal = launch
        .is_sealed
        .then(|| orders.wait_for_seal(SEAL_PATIENCE));
    if matches!(seal, Some(None)) {
        return Err(WorkerError::SecretMissing);
    }
    let seal = seal.flatten();
    let surroundings = Arc::new(GatewayContext::new(open_domain(launch)?)?);
    warn_of_shared_cpus(work);
    let mut away = Away::default();
    let (mut armed, sockets) = loop {
        let armed = timestamping::arm(work);
        match open_sockets(work, &armed, orders, seal.as_ref(), &surroundings) {
            Ok(sockets) => break (armed, sockets),
            Err(error) if launch.instance > 0 && is_away(&error) => away.note(&error),
            Err(error) => return Err(error),
        }
        if orders.is_stopping() {
            return Ok(Opened::default());
        }
        thread::sleep(RETRY_PERIOD);
    };
    armed.facts.extend(away.fact());
    let mut directions = Vec::new();
    for (direction, socket) in work.directions.iter().zip(sockets) {
        let plan = armed.plan(direction);
        let opened = OpenDirection::new(direction, recorder, socket, plan)?;
        directions.push((direction, opened));
    }
    let switches = directions.iter_mut();
    let switches: Vec<_> = switches
        .filter_map(|(_, one)| one.socket.switch.take())
        .collect();
    let gateway = GatewayWatch {
        work,
        instance: launch.instance,
        established: directions
            .iter()
            .map(|(_, one)| Arc::clone(&one.is_established))
            .collect(),
        given_up: None,
        connections: directions
            .iter()
            .filter_map(|(direction, one)| {
                Some(Connection::new(direction, one.socket.tally.clone()?))
            })
            .collect(),
        control: LinkControl::open(&surroundings.domain, launch, switches)?,
        sampler: armed.start_sampler(&launch.process, recorder, Arc::clone(orders.stop_flag()))?,
    };
    let jobs = directions.into_iter().map(|(direction, opened)| {
        let spinner = format!("{}: ", flow_label(&direction.flow));
        warn_of_spinning(&spinner, direction.wait, direction.realtime.cpu);
        job(
            direction,
            opened,
            Arc::clone(&surroundings),
            orders.run_start(),
        )
    });
    Ok(Opened {
        jobs: jobs.collect(),
        armed: Some(armed),
        gateway: Some(gateway),
        skipped_ticks: None,
    })
}

/// The socket of every direction, in their order.
fn open_sockets(
    work: &GatewayWork,
    armed: &TimestampingSetup,
    orders: &Orders,
    seal: Option<&RunSeal>,
    around: &GatewayContext,
) -> Result<Vec<OpenSocket>, WorkerError> {
    let open = |direction: &DirectionLaunch| {
        let plan = armed.plan(direction);
        let socket = OpenSocket::open(direction, plan, &orders.run_start(), seal)?;
        if let SocketEnd::Sender(_, longest) = &socket.ends {
            // A path may be too narrow for the gateways' own exchanges; the thread would only end.
            egress_bridge(*longest, direction, around)?;
        }
        Ok(socket)
    };
    work.directions.iter().map(open).collect()
}

/// The job of one direction.
fn job(
    launch: &DirectionLaunch,
    opened: OpenDirection,
    around: Arc<GatewayContext>,
    start: RunStart,
) -> Job<'_> {
    let (way, what) = match launch.side {
        Side::Egress => ("out", "sent"),
        Side::Ingress => ("in", "received"),
    };
    let counters = launch.channels.iter().zip(&opened.counts);
    let counters = counters.map(|(one, count)| Counter::new(&one.channel, what, count));
    let of_programs = opened.cables.iter().map(|(index, cable)| {
        let name = &launch.channels[*index].channel;
        match cable {
            OpenCable::Outward(open) => Counter::new(name, "published", &open.given),
            OpenCable::Inward(open) => Counter::new(name, "taken", &open.count),
        }
    });
    let counters = counters.chain(of_programs);
    Job {
        name: format!("{way} {}", flow_label(&launch.flow)),
        counters: counters.collect(),
        is_watched: true,
        connect: Box::new(move |thread| {
            thread.claim(&launch.realtime);
            let direction = opened.connect(launch, &around, &start)?;
            Ok(Box::new(DirectionWork {
                launch,
                direction,
                _around: around,
            }))
        }),
    }
}

/// A direction at work, with what it was told.
struct DirectionWork<'a> {
    launch: &'a DirectionLaunch,
    direction: Direction,
    /// Dropped after the ports.
    _around: Arc<GatewayContext>,
}

impl JobWork for DirectionWork<'_> {
    /// The peers greet each other before the run starts.
    fn begin(&mut self, _orders: &Orders) -> Result<bool, WorkerError> {
        Ok(true)
    }

    fn step(&mut self) -> Result<bool, WorkerError> {
        self.direction.step()
    }

    fn rest(&mut self) -> Result<(), WorkerError> {
        self.direction.rest()
    }

    fn finish(&mut self, stepped: Result<(), WorkerError>) -> Result<(), WorkerError> {
        self.direction.finish(stepped)
    }

    fn report(&mut self) -> ProcessReport {
        let (inlets, connection_failures) = self.direction.cables();
        ProcessReport {
            directions: vec![self.direction.report(self.launch)],
            inlets,
            connection_failures,
            ..ProcessReport::default()
        }
    }
}

/// What a gateway looks after beside its directions, from the thread of the process.
#[derive(Debug)]
pub(crate) struct GatewayWatch<'a> {
    work: &'a GatewayWork,
    instance: u32,
    established: Vec<Arc<AtomicBool>>,
    /// When it is ready without its peer, once it has asked.
    given_up: Option<Instant>,
    connections: Vec<Connection>,
    control: LinkControl,
    sampler: Option<Sampler>,
}

impl GatewayWatch<'_> {
    /// True once the peer takes messages, which would be refused before, or has been waited for long
    /// enough. Asked until it is, once every direction is connected.
    pub(crate) fn is_ready(&mut self, now: Instant) -> bool {
        let mut flags = self.established.iter();
        if flags.all(|one| one.load(Ordering::Acquire)) {
            return true;
        }
        let Some(within) = self.work.ready_within else {
            return false;
        };
        if now < *self.given_up.get_or_insert(now + within) {
            return false;
        }
        let peers = self.work.directions.iter();
        let peers: Vec<String> = peers.map(|one| one.peer.to_string()).collect();
        let then = match self.instance {
            0 => "the run begins without it",
            _ => "it goes on asking",
        };
        say(&FromProcess::Warning(format!(
            "no answer from {} within {:.1} s: {then}",
            peers.join(", "),
            within.as_secs_f64()
        )));
        true
    }

    /// Tells of connections that come and go, and does what was ordered.
    pub(crate) fn look_after(&mut self, now: Instant, is_ready: bool) {
        if is_ready {
            for connection in &mut self.connections {
                connection.tell(now);
            }
        }
        self.control.attend();
    }

    /// Waits for the end of the radio's sampler; says what it did.
    pub(crate) fn finish(self) -> Option<(String, String)> {
        self.sampler.map(Sampler::finish)
    }
}

/// Threads that spin on one CPU wait for each other, and the wait shows as delay.
fn warn_of_shared_cpus(work: &GatewayWork) {
    let mut spinning: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
    for direction in work
        .directions
        .iter()
        .filter(|one| one.wait == WaitMode::Spin)
    {
        if let Some(cpu) = direction.realtime.cpu {
            spinning
                .entry(cpu)
                .or_default()
                .push(flow_label(&direction.flow));
        }
    }
    for (cpu, flows) in spinning.into_iter().filter(|(_, flows)| flows.len() > 1) {
        let text = format!(
            "wait = spin: the threads of {} share CPU {cpu}; list one CPU for each in \
             gateway.cpu",
            flows.join(" and ")
        );
        say(&FromProcess::Warning(text));
    }
}

/// Whether `error` is the path's, which may come back: no route, no interface that is up, no address, or a
/// path too narrow for now.
fn is_away(error: &WorkerError) -> bool {
    match error {
        WorkerError::Open(SocketError::Refused { source, .. }) => matches!(
            source.kind(),
            io::ErrorKind::NetworkUnreachable
                | io::ErrorKind::HostUnreachable
                | io::ErrorKind::NetworkDown
                | io::ErrorKind::AddrNotAvailable
        ),
        WorkerError::Settings(error) => matches!(
            error,
            SettingsError::DatagramTooSmall { .. } | SettingsError::TooManyFragments { .. }
        ),
        _ => false,
    }
}

/// A path that is not there.
#[derive(Debug, Default)]
struct Away {
    attempt_count: u64,
    since: Option<Instant>,
}

impl Away {
    /// Counts an attempt in vain; the first is told at once.
    fn note(&mut self, error: &WorkerError) {
        self.attempt_count += 1;
        if self.since.is_none() {
            self.since = Some(MonotonicClock::now());
            let text = format!("{error}: waiting for the link");
            say(&FromProcess::Warning(text));
        }
    }

    /// How long it was away, for the report.
    fn fact(&self) -> Option<(String, String)> {
        let waited = MonotonicClock::now().saturating_duration_since(self.since?);
        let (seconds, count) = (waited.as_secs_f64(), self.attempt_count);
        let text = format!("{seconds:.3} s before this start, {count} attempts in vain");
        Some(("waited for the link".to_owned(), text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_that_is_away_is_waited_for_and_a_wrong_setting_is_not() {
        let refused = |errno: i32| {
            WorkerError::Open(SocketError::Refused {
                option: "connect",
                value: String::new(),
                source: io::Error::from_raw_os_error(errno),
            })
        };
        let away = [
            libc::ENETUNREACH,
            libc::EHOSTUNREACH,
            libc::ENETDOWN,
            libc::EADDRNOTAVAIL,
        ];
        assert!(away.into_iter().all(|errno| is_away(&refused(errno))));
        let wrong = [libc::ENODEV, libc::EADDRINUSE, libc::EPERM, libc::EINVAL];
        assert!(!wrong.into_iter().any(|errno| is_away(&refused(errno))));
        let narrow = SettingsError::DatagramTooSmall {
            value: 72,
            bound: 132,
        };
        assert!(is_away(&narrow.into()));
        assert!(!is_away(&SettingsError::Zero { key: "sync_period" }.into()));
    }

    #[test]
    fn how_long_a_path_was_away_is_told_and_one_that_was_there_is_not() {
        let mut away = Away::default();
        assert_eq!(away.fact(), None);
        away.note(&WorkerError::SecretMissing);
        away.note(&WorkerError::SecretMissing);
        let (label, text) = away.fact().unwrap();
        assert_eq!(label, "waited for the link");
        assert!(text.ends_with("2 attempts in vain"), "{text}");
    }
}
