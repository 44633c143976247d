//! The launcher's hold on a channel: creates both of its services and keeps them alive while
//! writers and readers come, die and come again.

use hil_core::message::{MessageType, TypeInfo};
use iceoryx2::prelude::ipc;
use iceoryx2::service::port_factory::event;

use super::domain::Domain;
use super::error::ChannelError;
use super::raw::{self, ByteService};

/// A channel to be created.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChannelSettings {
    /// Name, e.g. `egm/right/command`; at most 255 characters.
    pub name: String,
    /// Name, size and alignment of its messages.
    pub message: TypeInfo,
    /// Largest number of waiting messages any reader may ask for; 1 = the newest only.
    pub depth_max: usize,
    /// Writers at any one time: 1, plus 1 if a restarted writer may overlap its predecessor.
    pub writers_max: usize,
    /// Readers at any one time, gateways and recorders included.
    pub readers_max: usize,
    /// Messages that its writer puts together from pieces at a time; 0 unless that is a gateway.
    pub assembled_max: usize,
}

impl ChannelSettings {
    /// A channel for one writer and up to eight readers which want the newest message only.
    pub fn of(name: &str, message: &MessageType) -> Self {
        Self {
            name: name.to_owned(),
            message: TypeInfo::of(message),
            depth_max: 1,
            writers_max: 1,
            readers_max: 8,
            assembled_max: 0,
        }
    }

    /// Processes that may have the channel open: each writer and reader in its own, as many again
    /// that died and are not cleaned up yet, the launcher and a few observers.
    pub(crate) const fn nodes_max(&self) -> usize {
        2 * (self.writers_max + self.readers_max) + 4
    }
}

/// Keeps a channel in existence.
///
/// Without it, a process killed while creating the channel would make it unusable for all later
/// ones; with it, processes only ever open, and may be killed at any moment.
#[derive(Debug)]
pub struct ChannelHolder {
    _samples: ByteService,
    _wakeups: event::PortFactory<ipc::Service>,
}

impl ChannelHolder {
    /// Creates the channel in `domain`.
    ///
    /// # Errors
    /// When it exists already, a name or size is out of bounds, or the system refuses memory.
    pub fn create(domain: &Domain, settings: &ChannelSettings) -> Result<Self, ChannelError> {
        let samples = raw::create_samples(domain, settings, settings.nodes_max())?;
        let name = raw::service_name(&settings.name)?;
        let wakeups = domain
            .with_node(|node| node.service_builder(&name))
            .event()
            .max_nodes(settings.nodes_max())
            .max_notifiers(settings.writers_max)
            .max_listeners(settings.readers_max)
            .event_id_max_value(0)
            .create()
            .map_err(|error| {
                ChannelError::refused(&settings.name, "create the wake-up service", &error)
            })?;
        Ok(Self {
            _samples: samples,
            _wakeups: wakeups,
        })
    }
}
