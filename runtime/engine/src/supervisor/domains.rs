//! The shared-memory domains a supervisor owns: one per host that runs here, with every channel
//! created and held, so that the processes it starts only ever open.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use hil_core::message::TypeInfo;
use hil_link::condition::{LinkChangeRequest, ORDER_TYPE_NAME};

use super::plan::{HostPlan, domain_base, domain_root};
use crate::gateway::link_control::ORDERS_MAX;
use hil_platform::domain_address::checked_root_path;
use hil_platform::own_folder::{OwnFolder, OwnFolderError};
use hil_protocol::ingress::reassembly_slots;
use hil_rundir::announcement::withdraw_abandoned;
use hil_rundir::live_run::LiveRun;
use hil_shm::{ChannelError, ChannelHolder, ChannelSettings, Domain, DomainError, observer_depth};
use hil_topology::Channel;

/// Writers at a time: one, and its successor while the dead one is not cleaned up yet.
const WRITERS_MAX: usize = 2;
/// Readers at a time: consumer or gateway, its successor, and room for four observers, of which one records for a
/// program of the user's.
const READERS_MAX: usize = 6;
/// Observers look about fifty times a second and leave when they see that the run is over; one that
/// does not has its memory taken from under it.
const OBSERVERS_LEAVE_WITHIN: Duration = Duration::from_millis(500);
const OBSERVERS_PAUSE: Duration = Duration::from_millis(5);

/// Why a domain could not be made.
#[derive(Debug, thiserror::Error)]
pub enum DomainsError {
    /// The domain itself.
    #[error("shared memory of host {host}: {source}")]
    Domain {
        /// The host.
        host: String,
        /// Why.
        source: DomainError,
    },
    /// Another run has its folder, as one in a container that shares only that.
    #[error(
        "shared memory of host {host} would be that of the run in {}, process {pid}; end that one, or name \
         another folder with --domain-root",
        .folder.display()
    )]
    Taken {
        /// The host.
        host: String,
        /// Folder of the other run.
        folder: PathBuf,
        /// Its supervisor.
        pid: u32,
    },
    /// One of its channels.
    #[error("shared memory of host {host}: {source}")]
    Channel {
        /// The host.
        host: String,
        /// Why.
        source: ChannelError,
    },
}

impl DomainsError {
    /// The given path is invalid.
    pub const fn is_of_path(&self) -> bool {
        matches!(
            self,
            Self::Domain {
                source: DomainError::Address(_),
                ..
            }
        )
    }

    /// The folder is another user's, or others may change it.
    pub const fn is_of_others(&self) -> bool {
        matches!(
            self,
            Self::Domain {
                source: DomainError::Folder(
                    OwnFolderError::Foreign { .. }
                        | OwnFolderError::NoFolder { .. }
                        | OwnFolderError::Shared { .. }
                ),
                ..
            }
        )
    }
}

#[derive(Debug)]
struct HostDomain {
    host: String,
    // Before the domain: channels go first.
    holders: Vec<ChannelHolder>,
    domain: Domain,
}

/// All domains of one supervisor.
#[derive(Debug)]
pub(crate) struct Domains {
    hosts: Vec<HostDomain>,
}

/// Checks that the domain of `host` can lie below `base` or the default folder; the length of its path does
/// not depend on the run.
///
/// # Errors
/// When the path is too long or unusable.
pub(crate) fn check_path(base: Option<&PathBuf>, host: &str) -> Result<(), DomainsError> {
    let checked = checked_root_path(&domain_root(base, "", host));
    checked.map(drop).map_err(|error| DomainsError::Domain {
        host: host.to_owned(),
        source: error.into(),
    })
}

impl Domains {
    /// Creates a domain per host, below `base` or the default folder.
    pub(crate) fn create(
        plans: &[HostPlan],
        base: Option<&PathBuf>,
        run: &str,
    ) -> Result<Self, DomainsError> {
        let hosts = plans.iter().map(|plan| create_host(plan, base, run));
        Ok(Self {
            hosts: hosts.collect::<Result<_, _>>()?,
        })
    }

    /// Address of each host's domain.
    pub(crate) fn addresses(&self) -> BTreeMap<String, String> {
        self.hosts
            .iter()
            .map(|host| (host.host.clone(), host.domain.address().to_string()))
            .collect()
    }

    /// Fingerprint of the first host's domain: what peers compare with theirs.
    pub(crate) fn fingerprint(&self) -> Result<[u8; 16], DomainsError> {
        let host = self.hosts.first().expect("a plan has at least one host");
        let named = |source| DomainsError::Domain {
            host: host.host.clone(),
            source,
        };
        host.domain.fingerprint().map_err(named)
    }

    /// Frees what processes that died had in use, so that their successors find room.
    pub(crate) fn free_what_the_dead_held(&self) {
        for host in &self.hosts {
            host.domain.cleanup_dead_nodes();
        }
    }

    /// Waits until all observers have left, a little while at most: what leaves in order leaves
    /// nothing behind.
    pub(crate) fn let_observers_leave(&self) {
        let deadline = WallInstant::now() + OBSERVERS_LEAVE_WITHIN;
        let is_observed = || {
            self.hosts
                .iter()
                .any(|host| host.domain.observer_count() > 0)
        };
        while is_observed() && WallInstant::now() < deadline {
            thread::sleep(OBSERVERS_PAUSE);
        }
    }

    /// Deletes everything; says what could not be deleted.
    pub(crate) fn remove(self) -> Vec<String> {
        let mut left = Vec::new();
        for HostDomain {
            host,
            holders,
            domain,
        } in self.hosts
        {
            drop(holders);
            // Members that were killed a moment ago must not count as alive.
            domain.cleanup_dead_nodes_now();
            let removal = domain.remove();
            left.extend(
                removal
                    .remained
                    .iter()
                    .map(|path| path.display().to_string()),
            );
            if removal.live_member_count > 0 {
                let count = removal.live_member_count;
                left.push(format!(
                    "{count} processes still used the shared memory of {host}"
                ));
            }
        }
        left
    }
}

/// Removes what runs of this user whose supervisor was killed left in shared memory, where runs have it
/// by default. Those that go on are left alone. The next run does so as well; this is for when there
/// is none.
pub fn sweep() {
    sweep_below(&domain_base(None));
}

/// Removes the domains of supervisors that were killed: nobody holds their lock any more. A run
/// that is just starting has taken the lock before its folder can be told for a domain's. Of folders that
/// others could change nothing is removed.
pub(super) fn sweep_below(base: &Path) {
    let Ok(base) = OwnFolder::open(base) else {
        return;
    };
    let names = base.names().unwrap_or_default().into_iter();
    let roots = names.filter_map(|name| base.enter(&name).ok());
    let roots: Vec<OwnFolder> = roots.filter(Domain::is_in).collect();
    // All of them first: a run is announced in the domain of each of its hosts, and goes on for
    // observers while any of these is locked.
    for root in &roots {
        withdraw_abandoned(root);
    }
    for root in roots {
        // One in use is locked and refuses.
        let _is_gone = Domain::clear(root.path()).is_ok();
    }
}

/// What the channel allows, not what its consumer asks for: observers of messages that nobody
/// records come by less often than a consumer.
fn depth_max(channel: &Channel, observed: &BTreeSet<String>) -> usize {
    if observed.contains(&channel.name) {
        channel
            .depth
            .max(observer_depth(channel.message.size_bytes))
    } else {
        channel.depth
    }
}

fn create_host(
    plan: &HostPlan,
    base: Option<&PathBuf>,
    run: &str,
) -> Result<HostDomain, DomainsError> {
    let host = plan.name.clone();
    let root = domain_root(base, run, &host);
    let domain = Domain::create(&root).map_err(|source| {
        let host = host.clone();
        match (source, LiveRun::read(&root)) {
            (DomainError::Locked { .. }, Ok(LiveRun { folder, pid, .. })) => {
                DomainsError::Taken { host, folder, pid }
            }
            (source, _) => DomainsError::Domain { host, source },
        }
    })?;
    let mut holders = Vec::new();
    for settings in channel_settings(plan) {
        let holder =
            ChannelHolder::create(&domain, &settings).map_err(|source| DomainsError::Channel {
                host: host.clone(),
                source,
            })?;
        holders.push(holder);
    }
    Ok(HostDomain {
        host,
        holders,
        domain,
    })
}

/// The channels that a host's domain has.
pub(super) fn channel_settings(plan: &HostPlan) -> impl Iterator<Item = ChannelSettings> {
    let of_messages = plan.channels.iter().map(|channel| ChannelSettings {
        name: channel.name.clone(),
        message: TypeInfo {
            name: channel.message.name.clone(),
            size_bytes: channel.message.size_bytes,
            alignment_bytes: channel.message.alignment_bytes,
        },
        depth_max: depth_max(channel, &plan.observed),
        writers_max: WRITERS_MAX,
        readers_max: READERS_MAX,
        assembled_max: if plan.arriving.contains(&channel.name) {
            reassembly_slots(channel.message.size_bytes)
        } else {
            0
        },
    });
    let of_orders = plan.orders.iter().map(|name| order_settings(name));
    of_messages.chain(of_orders)
}

/// A channel for orders to an emulated link: one gives them at a time, the gateway takes them.
fn order_settings(name: &str) -> ChannelSettings {
    ChannelSettings {
        name: name.to_owned(),
        message: TypeInfo {
            name: ORDER_TYPE_NAME.to_owned(),
            size_bytes: size_of::<LinkChangeRequest>(),
            alignment_bytes: align_of::<LinkChangeRequest>(),
        },
        depth_max: ORDERS_MAX,
        writers_max: WRITERS_MAX,
        readers_max: WRITERS_MAX,
        assembled_max: 0,
    }
}
