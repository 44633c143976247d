//! Two hosts: a shared-memory domain each, channels there and back, and for each channel a
//! gateway direction at either end, opened as the gateway process opens it.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use std::{fs, process, thread};

use hil_core::message::MessageType;
use hil_core::record::{EgressRecord, IngressRecord};
use hil_engine::gateway::GatewayContext;
use hil_engine::gateway::direction::{self, Direction, OpenDirection};
use hil_platform::domain_address::DomainAddress;
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::{ChannelLaunch, DirectionLaunch, Side, SocketLaunch};
use hil_rundir::pipe::RunStart;
use hil_rundir::record::{RecordFile, RecordKind, RecordSink, Recorder};
use hil_shm::{
    ChannelHolder, ChannelSettings, Domain, OutputSettings, ShmInput, ShmOutput, Waiter,
};
use hil_topology::{SocketOptions, Timestamps};

use super::network::Network;

/// What goes wrong while setting up; a bench prints it and stops.
pub type SetupError = Box<dyn Error + Send + Sync>;

/// How long the gateways may take to greet each other.
const GREETING_MAX: Duration = Duration::from_secs(10);

/// A pair of channels between the hosts.
#[derive(Debug, Clone, Copy)]
pub struct Plan {
    /// Prefix of the channels' names.
    pub name: &'static str,
    /// Payload.
    pub size_bytes: usize,
    /// How everything that waits for these channels waits.
    pub wait: WaitMode,
    /// Kernel stamps on.
    pub is_stamped: bool,
    /// Messages that may wait in shared memory.
    pub depth: usize,
}

impl Plan {
    /// The identity of its messages.
    pub const fn message(&self) -> MessageType {
        MessageType {
            name: "bench.Bytes.v1",
            size_bytes: self.size_bytes,
            alignment_bytes: 8,
            fields: &[],
        }
    }

    /// The channel that `host` writes: 0 sends `out`, 1 sends `back`.
    pub fn channel_of(&self, host: usize) -> String {
        format!("{}/{}", self.name, ["out", "back"][host])
    }
}

/// One end of a plan's channels, still to be connected by the thread that will use it.
#[derive(Debug)]
pub struct Joint {
    /// The plan.
    pub plan: Plan,
    /// Which host.
    pub host: usize,
    /// The host's shared memory.
    pub address: DomainAddress,
    egress: (DirectionLaunch, OpenDirection),
    ingress: (DirectionLaunch, OpenDirection),
    surroundings: Arc<GatewayContext>,
}

/// A direction not yet connected; it may travel to its thread.
#[derive(Debug)]
pub struct Loose {
    launch: DirectionLaunch,
    opened: OpenDirection,
    surroundings: Arc<GatewayContext>,
}

impl Loose {
    /// Joins the channel; call it in the thread that will carry the messages.
    ///
    /// # Errors
    /// When the channel cannot be opened.
    pub fn connect(self) -> Result<(DirectionLaunch, Direction), SetupError> {
        let direction =
            self.opened
                .connect(&self.launch, &self.surroundings, &RunStart::default())?;
        Ok((self.launch, direction))
    }
}

/// The ports of an application on one host.
#[derive(Debug)]
pub struct Ports {
    /// To the other host.
    pub output: ShmOutput,
    /// From the other host.
    pub input: ShmInput,
    /// Sleeps for the input; `None` for an application that spins or is woken otherwise.
    pub waiter: Option<Waiter>,
    /// Membership in the domain, which must outlive the ports.
    _domain: Domain,
}

impl Ports {
    /// Opens the ports of `host`; with `sleeps` they have a waiter and wake their reader.
    ///
    /// # Errors
    /// When a channel cannot be opened.
    pub fn open(
        address: &DomainAddress,
        plan: &Plan,
        host: usize,
        sleeps: bool,
    ) -> Result<Self, SetupError> {
        let domain = Domain::open(address)?;
        let (outward, homeward) = (plan.channel_of(host), plan.channel_of(1 - host));
        let settings = OutputSettings {
            notifies_readers: sleeps,
            ..OutputSettings::default()
        };
        Ok(Self {
            output: ShmOutput::open(&domain, &outward, &plan.message(), settings)?,
            input: ShmInput::open(&domain, &homeward, &plan.message(), plan.depth)?,
            waiter: sleeps
                .then(|| Waiter::open(&domain, &[homeward.as_str()]))
                .transpose()?,
            _domain: domain,
        })
    }
}

impl Joint {
    /// The two directions apart, egress first, for a thread each.
    pub fn split(self) -> [Loose; 2] {
        [self.egress, self.ingress].map(|(launch, opened)| Loose {
            launch,
            opened,
            surroundings: Arc::clone(&self.surroundings),
        })
    }
}

/// Both hosts.
#[derive(Debug)]
pub struct Hosts {
    /// The wire between them.
    pub network: Network,
    domains: [Domain; 2],
    holders: Vec<ChannelHolder>,
    surroundings: [Arc<GatewayContext>; 2],
    recorders: [Option<Recorder>; 2],
    folder: PathBuf,
}

impl Hosts {
    /// Makes both hosts.
    ///
    /// # Errors
    /// When shared memory or a folder cannot be made.
    pub fn create(network: Network) -> Result<Self, SetupError> {
        let temporary = std::env::temp_dir();
        let root = |host: usize| temporary.join(format!("hil-gw-{}-{host}", process::id()));
        let folder = temporary.join(format!("hil-gw-{}-records", process::id()));
        fs::create_dir_all(&folder)?;
        let domains = [Domain::create(&root(0))?, Domain::create(&root(1))?];
        let around = |domain: &Domain| -> Result<_, SetupError> {
            Ok(Arc::new(GatewayContext::new(Domain::open(
                domain.address(),
            )?)?))
        };
        Ok(Self {
            surroundings: [around(&domains[0])?, around(&domains[1])?],
            recorders: [0, 1].map(|host| Some(Recorder::new(&folder, &format!("h{host}"), 0))),
            holders: Vec::new(),
            network,
            domains,
            folder,
        })
    }

    /// How the processes of `host` find its shared memory.
    pub fn address(&self, host: usize) -> &DomainAddress {
        self.domains[host].address()
    }

    /// Creates the channels of `plan` on both hosts, without gateways.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn create_channels(&mut self, plan: &Plan) -> Result<(), SetupError> {
        for domain in &self.domains {
            for host in 0..2 {
                let name = plan.channel_of(host);
                let settings = ChannelSettings {
                    depth_max: plan.depth,
                    ..ChannelSettings::of(&name, &plan.message())
                };
                self.holders.push(ChannelHolder::create(domain, &settings)?);
            }
        }
        Ok(())
    }

    /// Rings for the records of a gateway at either end of the channel that host 0 writes.
    ///
    /// # Errors
    /// When a file cannot be made, or recording has started already.
    pub fn sinks(&mut self, plan: &Plan) -> Result<[RecordSink; 2], SetupError> {
        let channel = plan.channel_of(0);
        let [near, far] = &mut self.recorders;
        let (near, far) = near
            .as_mut()
            .zip(far.as_mut())
            .ok_or("recording has ended")?;
        let capacity = 16_384;
        Ok([
            near.sink(
                RecordKind::Egress,
                &channel,
                size_of::<EgressRecord>(),
                capacity,
            )?,
            far.sink(
                RecordKind::Ingress,
                &channel,
                size_of::<IngressRecord>(),
                capacity,
            )?,
        ])
    }

    /// Creates the channels of `plan` and opens its sockets; call it from a thread of normal
    /// priority, as kernel stamps are switched on by a worker.
    ///
    /// # Errors
    /// When the kernel or iceoryx2 refuses something.
    ///
    /// # Panics
    /// After [`Hosts::start_recording`].
    pub fn add(&mut self, plan: Plan) -> Result<[Joint; 2], SetupError> {
        self.create_channels(&plan)?;
        let mut ends = [[None, None], [None, None]];
        for way in 0..2 {
            let addresses = [self.network.free_address(0)?, self.network.free_address(1)?];
            for host in 0..2 {
                let side = if way == host {
                    Side::Egress
                } else {
                    Side::Ingress
                };
                let mut launch = launch(&plan, way, side);
                (launch.local, launch.peer) = (addresses[host], addresses[1 - host]);
                let recorder = self.recorders[host].as_mut();
                let recorder = recorder.expect("plans are added before recording starts");
                let opened = self.network.on(host, || {
                    direction::open(&launch, recorder, &RunStart::default())
                })?;
                let slot = usize::from(side == Side::Ingress);
                ends[host][slot] = Some((launch, opened));
            }
        }
        let mut host = 0;
        let joints = ends.map(|[egress, ingress]| {
            let joint = Joint {
                plan,
                host,
                address: self.domains[host].address().clone(),
                egress: egress.expect("each host has one egress per plan"),
                ingress: ingress.expect("each host has one ingress per plan"),
                surroundings: Arc::clone(&self.surroundings[host]),
            };
            host += 1;
            joint
        });
        Ok(joints)
    }

    /// Starts the threads that write the records.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start_recording(&mut self) -> Result<(), SetupError> {
        for recorder in self.recorders.iter_mut().flatten() {
            recorder.start()?;
        }
        Ok(())
    }

    /// Ends recording and gives how many records did not fit; all directions must be gone.
    pub fn finish_recording(&mut self) -> u64 {
        let recorders = self.recorders.iter_mut();
        recorders
            .filter_map(Option::take)
            .map(|recorder| recorder.finish().dropped_count)
            .sum()
    }

    /// The record file of `kind` of the channel `host` of `plan` writes, kept by host `keeper`.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn records(
        &self,
        plan: &Plan,
        host: usize,
        kind: &str,
        keeper: usize,
    ) -> Result<RecordFile, SetupError> {
        let channel = plan.channel_of(host).replace('/', ".");
        let name = format!("{channel}.{kind}.h{keeper}.0.rec");
        Ok(RecordFile::read(&self.folder.join(name))?)
    }

    /// Removes both hosts; what could not be removed is returned in words.
    pub fn remove(self) -> Vec<String> {
        let Self {
            domains,
            holders,
            surroundings,
            folder,
            ..
        } = self;
        drop((holders, surroundings));
        let mut remained: Vec<String> = Vec::new();
        for domain in domains {
            let left = domain.remove().remained;
            remained.extend(left.iter().map(|path| path.display().to_string()));
        }
        if let Err(error) = fs::remove_dir_all(&folder) {
            remained.push(format!("{}: {error}", folder.display()));
        }
        remained
    }
}

fn launch(plan: &Plan, way: usize, side: Side) -> DirectionLaunch {
    let unset = "0.0.0.0:0".parse().expect("an address");
    DirectionLaunch {
        flow: plan.channel_of(way),
        flow_number: u16::MAX - u16::try_from(way).expect("0 or 1"),
        side,
        local: unset,
        peer: unset,
        socket: SocketLaunch {
            transport: "udp".to_owned(),
            options: BTreeMap::new(),
            interface: None,
            common: SocketOptions {
                timestamps: if plan.is_stamped {
                    Timestamps::Software
                } else {
                    Timestamps::Off
                },
                ..SocketOptions::TEMPLATE
            },
        },
        wait: plan.wait,
        realtime: RealtimeRequest::default(),
        channels: vec![ChannelLaunch {
            channel: plan.channel_of(way),
            channel_id: 1 + u16::try_from(way).expect("0 or 1"),
            message: plan.message().name.to_owned(),
            size_bytes: plan.size_bytes,
            alignment_bytes: plan.message().alignment_bytes,
            depth: plan.depth,
            emulation: None,
            cable_socket: None,
        }],
    }
}

/// Steps `directions` until `remaining` egress directions, here and in other threads, have been
/// accepted by their peers.
///
/// # Errors
/// When a direction breaks or a peer does not answer in time.
pub fn greet(
    directions: &mut [(&DirectionLaunch, &mut Direction)],
    remaining: &AtomicUsize,
) -> Result<(), SetupError> {
    let started = Instant::now();
    let mut is_greeted: Vec<bool> = directions
        .iter()
        .map(|(launch, _)| launch.side == Side::Ingress)
        .collect();
    while remaining.load(Ordering::Acquire) > 0 {
        for ((launch, direction), is_greeted) in directions.iter_mut().zip(&mut is_greeted) {
            while direction.step()? {}
            if !*is_greeted && direction.report(launch).peer_state == "established" {
                *is_greeted = true;
                remaining.fetch_sub(1, Ordering::AcqRel);
            }
        }
        if started.elapsed() > GREETING_MAX {
            return Err("the gateways did not greet each other".into());
        }
        thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}
