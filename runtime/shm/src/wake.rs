//! Sleeping until a channel has something: one thread, several channels, an absolute deadline.
//! Spinning readers need none of this.

use core::time::Duration;
use std::array;
use std::os::fd::{AsFd, BorrowedFd};

use hil_core::time::Instant;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::ipc;
use iceoryx2::service::port_factory::event;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;

use super::domain::Domain;
use super::error::{ChannelError, retry};
use super::raw;
use hil_platform::clock::MonotonicClock;

/// Most channels one waiter waits for.
pub const WAITER_CHANNELS_MAX: usize = 16;
/// Looks at one channel's announcements before its writer is taken for faster than they are.
const DRAIN_LOOKS_MAX: usize = 8;

/// Why a wait ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wake {
    /// A writer announced a sample. It may have been taken already: look, and expect nothing.
    Woken,
    /// The deadline came.
    TimedOut,
    /// A signal came; the caller looks at its own stop flag.
    Interrupted,
}

/// Waits for any of several channels.
///
/// A writer publishes before it announces, and an announcement that comes between two waits ends
/// the next one at once, so "drain all inputs, then wait" misses nothing.
#[derive(Debug)]
pub struct Waiter {
    listeners: Vec<(String, Listener<ipc::Service>)>,
}

impl Waiter {
    /// Listens to `channels`, 1..=[`WAITER_CHANNELS_MAX`] of them.
    ///
    /// # Errors
    /// When there are too many, or one does not appear in time or has all its readers.
    pub fn open(domain: &Domain, channels: &[&str]) -> Result<Self, ChannelError> {
        if channels.is_empty() || channels.len() > WAITER_CHANNELS_MAX {
            return Err(ChannelError::WaiterChannelCount {
                given: channels.len(),
                max: WAITER_CHANNELS_MAX,
            });
        }
        let listeners = channels
            .iter()
            .map(|channel| Ok(((*channel).to_owned(), open_listener(domain, channel)?)))
            .collect::<Result<_, ChannelError>>()?;
        Ok(Self { listeners })
    }

    /// Sleeps until a channel is announced or `timeout` has passed.
    ///
    /// # Errors
    /// When the wait itself fails.
    pub fn wait(&mut self, timeout: Duration) -> Result<Wake, ChannelError> {
        self.poll(Some(timeout))
    }

    /// Sleeps until a channel is announced or the monotonic clock reads `deadline`; without one,
    /// for as long as it takes.
    ///
    /// # Errors
    /// When the wait itself fails.
    pub fn wait_until(&mut self, deadline: Option<Instant>) -> Result<Wake, ChannelError> {
        let left =
            deadline.map(|deadline| deadline.saturating_duration_since(MonotonicClock::now()));
        self.poll(left)
    }

    /// The descriptors that become readable on an announcement, in the order of the channels, for
    /// a loop that also waits for a socket; call [`Waiter::drain`] after.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.listeners
            .iter()
            .map(|(_, listener)| raw::descriptor(listener))
    }

    /// Takes back all announcements, so that the descriptors are quiet until the next. False when
    /// there was none.
    ///
    /// # Errors
    /// When a listener is broken.
    pub fn drain(&mut self) -> Result<bool, ChannelError> {
        let mut found = false;
        for (channel, listener) in &self.listeners {
            found |= drain(channel, listener)?;
        }
        Ok(found)
    }

    fn poll(&mut self, timeout: Option<Duration>) -> Result<Wake, ChannelError> {
        let timeout = timeout.map(TimeSpec::from_duration);
        // On the stack: waiting is part of the measured path, which does not allocate.
        let mut entries: [PollFd<'_>; WAITER_CHANNELS_MAX] = array::from_fn(|index| {
            let (_, listener) = &self.listeners[index.min(self.listeners.len() - 1)];
            PollFd::new(raw::descriptor(listener), PollFlags::POLLIN)
        });
        let entries = &mut entries[..self.listeners.len()];
        match ppoll(entries, timeout, None) {
            // Whatever became of the descriptor, what was announced is found here.
            Ok(0) => {
                return Ok(if self.drain()? {
                    Wake::Woken
                } else {
                    Wake::TimedOut
                });
            }
            Ok(_) => {}
            Err(Errno::EINTR) => return Ok(Wake::Interrupted),
            Err(errno) => {
                return Err(ChannelError::Wait {
                    channel: self.listeners[0].0.clone(),
                    source: errno.into(),
                });
            }
        }
        for (entry, (channel, listener)) in entries.iter().zip(&self.listeners) {
            if entry.any().unwrap_or(true) {
                drain(channel, listener)?;
            }
        }
        Ok(Wake::Woken)
    }
}

fn open_listener(domain: &Domain, channel: &str) -> Result<Listener<ipc::Service>, ChannelError> {
    retry(domain.open_within(), || {
        open_event(domain, channel)?
            .listener_builder()
            .create()
            .map_err(|error| ChannelError::refused(channel, "become a listener", &error))
    })
}

/// Opens the wake-up half for a writer.
pub(crate) fn open_notifier(
    domain: &Domain,
    channel: &str,
) -> Result<Notifier<ipc::Service>, ChannelError> {
    open_event(domain, channel)?
        .notifier_builder()
        .create()
        .map_err(|error| ChannelError::refused(channel, "become a notifier", &error))
}

fn open_event(
    domain: &Domain,
    channel: &str,
) -> Result<event::PortFactory<ipc::Service>, ChannelError> {
    let name = raw::service_name(channel)?;
    domain
        .with_node(|node| node.service_builder(&name))
        .event()
        .open()
        .map_err(|error| ChannelError::refused(channel, "open the wake-up service", &error))
}

/// Takes back announcements until a look finds none.
///
/// One look is not enough. iceoryx2 0.10 marks the listener as idle before it empties its socket: an
/// announcement in between is taken with the rest, and leaves the mark "has been told" on a socket
/// with nothing in it. From then on writers tell it nothing, and its descriptor stays quiet for ever
/// while messages pass. Such an announcement is among those that the look finds, so a look that finds
/// none left no such mark.
fn drain(channel: &str, listener: &Listener<ipc::Service>) -> Result<bool, ChannelError> {
    let mut found = false;
    for _ in 0..DRAIN_LOOKS_MAX {
        match listener.try_wait(|_| {}) {
            Ok(0) => break,
            Ok(_) => found = true,
            // The rest stays announced and ends the next wait at once.
            Err(ListenerWaitError::InterruptSignal) => return Ok(true),
            Err(error) => return Err(ChannelError::refused(channel, "take its wake-ups", &error)),
        }
    }
    Ok(found)
}

impl AsFd for Waiter {
    /// The first channel's descriptor, for the common case of one channel.
    fn as_fd(&self) -> BorrowedFd<'_> {
        raw::descriptor(&self.listeners[0].1)
    }
}
