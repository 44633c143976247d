//! Sleeping until a channel has something: one thread, several channels, an absolute deadline.
//! Spinning readers need none of this.

use core::time::Duration;
use std::os::fd::{AsFd, BorrowedFd};

use hil_core::time::Instant;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::ipc;
use iceoryx2::service::port_factory::event;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::time::TimeSpec;

use super::domain::Domain;
use super::error::{ChannelError, retry};
use super::raw;
use hil_platform::clock::MonotonicClock;

/// Announced channels that one look finds; more are found by the next.
const ANNOUNCED_PER_LOOK: usize = 32;
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
    /// Of several channels: tells which of them are announced, at a cost that does not grow with those
    /// that are not.
    group: Option<Epoll>,
    /// The channel that is looked at next though nobody announced it.
    swept: usize,
}

impl Waiter {
    /// Listens to `channels`, at least one.
    ///
    /// # Errors
    /// When there is none, or one does not appear in time or has all its readers.
    pub fn open(domain: &Domain, channels: &[&str]) -> Result<Self, ChannelError> {
        let Some(first) = channels.first() else {
            return Err(ChannelError::NoChannel);
        };
        let listeners = channels
            .iter()
            .map(|channel| Ok(((*channel).to_owned(), open_listener(domain, channel)?)))
            .collect::<Result<Vec<_>, ChannelError>>()?;
        let group = (channels.len() > 1)
            .then(|| group_of(&listeners))
            .transpose();
        let group = group.map_err(|errno| wait_error(first, errno))?;
        Ok(Self {
            listeners,
            group,
            swept: 0,
        })
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

    /// The descriptor that is readable while a channel is announced, for a loop that also waits for a
    /// socket; [`Waiter::announced`] says which.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        match &self.group {
            Some(group) => group.0.as_fd(),
            None => raw::descriptor(&self.listeners[0].1),
        }
    }

    /// Which channels are announced, by their index; not all of them at once where they are many:
    /// [`Waiter::descriptor`] stays readable for the rest. A single channel is always told.
    ///
    /// # Errors
    /// When the look itself fails.
    ///
    /// # Panics
    /// Never: what the kernel returns are the indices it was given.
    pub fn announced(&self) -> Result<impl Iterator<Item = usize> + use<>, ChannelError> {
        let mut indices = [0; ANNOUNCED_PER_LOOK];
        let Some(group) = &self.group else {
            return Ok(indices.into_iter().take(1));
        };
        // On the stack: waiting is part of the measured path, which does not allocate.
        let mut events = [EpollEvent::empty(); ANNOUNCED_PER_LOOK];
        let found = match group.wait(&mut events, EpollTimeout::ZERO) {
            Ok(count) => count,
            Err(Errno::EINTR) => 0,
            Err(errno) => return Err(wait_error(&self.listeners[0].0, errno)),
        };
        for (index, event) in indices.iter_mut().zip(&events[..found]) {
            *index = usize::try_from(event.data()).expect("it was an index");
        }
        Ok(indices.into_iter().take(found))
    }

    /// Takes back the announcements of the channel with `index`, so that it is quiet until the next. False
    /// when there was none.
    ///
    /// # Errors
    /// When the listener is broken.
    pub fn drain(&self, index: usize) -> Result<bool, ChannelError> {
        let (channel, listener) = &self.listeners[index];
        drain(channel, listener)
    }

    /// The channel to look at though nobody announced it, each in its turn: whatever became of its descriptor,
    /// what was announced is found then.
    pub fn next_swept(&mut self) -> usize {
        let next = self.swept;
        self.swept = (next + 1) % self.listeners.len();
        next
    }

    fn poll(&mut self, timeout: Option<Duration>) -> Result<Wake, ChannelError> {
        let timeout = timeout.map(TimeSpec::from_duration);
        let mut entries = [PollFd::new(self.descriptor(), PollFlags::POLLIN)];
        match ppoll(&mut entries, timeout, None) {
            Ok(0) => {
                let quiet = self.next_swept();
                let is_woken = self.drain(quiet)?;
                Ok(if is_woken {
                    Wake::Woken
                } else {
                    Wake::TimedOut
                })
            }
            Ok(_) => {
                for index in self.announced()? {
                    self.drain(index)?;
                }
                Ok(Wake::Woken)
            }
            Err(Errno::EINTR) => Ok(Wake::Interrupted),
            Err(errno) => Err(wait_error(&self.listeners[0].0, errno)),
        }
    }
}

fn group_of(listeners: &[(String, Listener<ipc::Service>)]) -> nix::Result<Epoll> {
    let group = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
    for (index, (_, listener)) in (0..).zip(listeners) {
        let event = EpollEvent::new(EpollFlags::EPOLLIN, index);
        group.add(raw::descriptor(listener), event)?;
    }
    Ok(group)
}

fn wait_error(channel: &str, errno: Errno) -> ChannelError {
    ChannelError::Wait {
        channel: channel.to_owned(),
        source: errno.into(),
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
/// while messages pass. Such an announcement is nearly always among those that the look finds, and the
/// next look takes the mark away; [`Waiter::next_swept`] is for the rest.
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
