//! Who has a channel open: counts of its writers and readers, for people and for programs that must
//! not become a second writer.

use std::path::Path;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::{CallbackProgression, ipc};
use iceoryx2::service::port_factory::PortFactory;

use super::domain::Domain;
use super::error::{ChannelError, retry};
use super::members;
use super::raw::{ReadService, discover, open_for_reading};

/// Who has a channel open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Census {
    /// Writers; one that died counts until its supervisor has freed its place.
    pub writer_count: usize,
    /// Readers: consumer or gateway, and observers.
    pub reader_count: usize,
}

impl Census {
    /// Counts those of `channel`.
    ///
    /// # Errors
    /// When the channel does not appear in time.
    pub fn of(domain: &Domain, channel: &str) -> Result<Self, ChannelError> {
        Attendance::of(domain, channel).map(|channel| channel.census())
    }
}

/// Whether the process of `node` was not waited for yet; who cannot be asked counts as living.
fn lives(node: &UniqueNodeId) -> bool {
    let process = node.pid::<ipc::Service>();
    process.map_or(true, |id| {
        Path::new(&format!("/proc/{}", id.value())).exists()
    })
}

/// A channel whose ends are looked at again and again, at the cost of a look into shared memory.
#[derive(Debug)]
pub struct Attendance {
    service: ReadService,
    own_node: UniqueNodeId,
}

impl Attendance {
    /// Looks at `channel`, whatever it carries.
    ///
    /// # Errors
    /// When it does not appear in time.
    pub fn of(domain: &Domain, channel: &str) -> Result<Self, ChannelError> {
        let within = domain.open_within();
        let message = retry(within, || discover(domain, channel))?;
        Ok(Self {
            service: retry(within, || open_for_reading(domain, channel, &message))?,
            own_node: domain.with_node(|node| *node.id()),
        })
    }

    /// Who has it open now.
    pub fn census(&self) -> Census {
        let now = self.service.dynamic_config();
        Census {
            writer_count: now.number_of_publishers(),
            reader_count: now.number_of_subscribers(),
        }
    }

    /// True while a process of the run that lives reads it: neither this one nor an observer.
    pub fn has_consumer(&self) -> bool {
        let mut has_consumer = false;
        self.service.dynamic_config().list_subscribers(|reader| {
            has_consumer = reader.node_id != self.own_node
                && reader.subscriber_name != members::observer_port_name()
                && lives(&reader.node_id);
            if has_consumer {
                CallbackProgression::Stop
            } else {
                CallbackProgression::Continue
            }
        });
        has_consumer
    }

    /// Samples that a reader may have waiting.
    pub fn depth_max(&self) -> usize {
        self.service.static_config().subscriber_max_buffer_size()
    }
}
