//! Who has a channel open: counts of its writers and readers, for people and for programs that must
//! not become a second writer.

use iceoryx2::service::port_factory::PortFactory;

use super::domain::Domain;
use super::error::{ChannelError, retry};
use super::raw::{discover, open_for_reading};

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
        let within = domain.open_within();
        let message = retry(within, || discover(domain, channel))?;
        let service = retry(within, || open_for_reading(domain, channel, &message))?;
        let now = service.dynamic_config();
        Ok(Self {
            writer_count: now.number_of_publishers(),
            reader_count: now.number_of_subscribers(),
        })
    }
}
