//! The local channels of a sending thread and the order in which they are looked at: each that may have a
//! message in its turn, and an idle one not at all. What becomes of a message is not its business.

use std::collections::VecDeque;
use std::os::fd::BorrowedFd;

use hil_core::message::Envelope;
use hil_platform::wait::WaitMode;
use hil_protocol::egress::STAGED_BYTES_MAX;
use hil_rundir::launch::ChannelLaunch;
use hil_shm::{ChannelError, Domain, HeldMessage, RawInput, Waiter};

/// The channels of one sending thread, by their index in its flow.
#[derive(Debug)]
pub(super) struct Inputs {
    channels: Vec<Input>,
    /// `None` for a thread that spins, and without channels.
    waiter: Option<Waiter>,
    /// Those that may have a message, each once, the next one first.
    due: VecDeque<usize>,
    /// Channels with long messages that wait for the one under way.
    waiting: Vec<usize>,
}

/// What a look at the next channel found.
#[derive(Debug)]
pub(super) enum Look {
    /// Nothing.
    Empty,
    /// A message, which was handed over.
    Message,
    /// A long message of the channel with this index.
    Long(usize, HeldMessage),
}

#[derive(Debug)]
struct Input {
    port: RawInput,
    /// Its messages are too long to be sent in one go.
    is_long: bool,
    is_due: bool,
    /// Its announcements are to be taken back.
    is_announced: bool,
}

impl Inputs {
    /// Joins `channels`.
    ///
    /// # Errors
    /// When one does not appear.
    pub(super) fn open(
        domain: &Domain,
        channels: &[ChannelLaunch],
        wait: WaitMode,
    ) -> Result<Self, ChannelError> {
        let open = |one: &ChannelLaunch| {
            Ok(Input {
                port: RawInput::open(domain, &one.channel, one.depth)?,
                is_long: one.size_bytes > STAGED_BYTES_MAX,
                is_due: true,
                is_announced: false,
            })
        };
        let names: Vec<&str> = channels.iter().map(|one| one.channel.as_str()).collect();
        Ok(Self {
            channels: channels
                .iter()
                .map(open)
                .collect::<Result<_, ChannelError>>()?,
            waiter: (wait != WaitMode::Spin && !names.is_empty())
                .then(|| Waiter::open(domain, &names))
                .transpose()?,
            due: (0..channels.len()).collect(),
            waiting: Vec::with_capacity(channels.len()),
        })
    }

    /// True without channels.
    pub(super) fn is_empty(&self) -> bool {
        self.channels.is_empty()
    }

    /// True while a channel is to be looked at that was not found empty.
    pub(super) fn is_any_due(&self) -> bool {
        !self.is_always_looked_at() && !self.due.is_empty()
    }

    /// A thread that spins is told by nobody; and one channel is not worth the asking.
    fn is_always_looked_at(&self) -> bool {
        self.waiter.is_none() || self.channels.len() == 1
    }

    /// Looks at the next channel and hands its oldest message to `take`, or gives it where it is long and
    /// `takes_long`; without that, the channel waits for [`Inputs::resume_long`].
    ///
    /// # Errors
    /// When the channel is broken.
    pub(super) fn receive(
        &mut self,
        takes_long: bool,
        mut take: impl FnMut(usize, &Envelope, &[u8]),
    ) -> Result<Look, ChannelError> {
        let Some(index) = self.due.pop_front() else {
            return Ok(Look::Empty);
        };
        let is_always_looked_at = self.is_always_looked_at();
        let input = &mut self.channels[index];
        if input.is_long && !takes_long {
            self.waiting.push(index);
            return Ok(Look::Empty);
        }
        let look = if input.is_long {
            let held = input.port.hold()?;
            held.map_or(Look::Empty, |held| Look::Long(index, held))
        } else {
            let has_moved = input
                .port
                .receive(&mut |envelope, payload| take(index, envelope, payload))?;
            if has_moved {
                Look::Message
            } else {
                Look::Empty
            }
        };
        // A message may follow, or come before its announcement is taken back.
        let has_moved = !matches!(look, Look::Empty);
        input.is_due = has_moved || input.is_announced || is_always_looked_at;
        if input.is_due {
            self.due.push_back(index);
        }
        Ok(look)
    }

    /// The long message is no longer under way: those that waited for it are looked at again.
    pub(super) fn resume_long(&mut self) {
        self.due.extend(self.waiting.drain(..));
    }

    /// Takes back the announcements of the channel that was found empty last; false when it had none. A
    /// message published before they were is seen by the look that follows.
    ///
    /// # Errors
    /// When its listener is broken.
    pub(super) fn settle(&mut self) -> Result<bool, ChannelError> {
        let Some((waiter, &index)) = self.waiter.as_mut().zip(self.due.back()) else {
            return Ok(false);
        };
        let input = &mut self.channels[index];
        if !core::mem::take(&mut input.is_announced) {
            return Ok(false);
        }
        waiter.drain(index)?;
        Ok(true)
    }

    /// What is readable while a channel is announced.
    pub(super) fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.waiter.as_ref().map(Waiter::descriptor)
    }

    /// Notes which channels are announced.
    ///
    /// # Errors
    /// When that cannot be asked.
    pub(super) fn note_announced(&mut self) -> Result<(), ChannelError> {
        let Self {
            channels,
            waiter,
            due,
            ..
        } = self;
        let Some(waiter) = waiter else {
            return Ok(());
        };
        waiter.announced(|index| note(channels, due, index))
    }

    /// After a quiet wait: looks at one channel all the same, each in its turn.
    pub(super) fn note_quiet(&mut self) {
        if let Some(waiter) = &mut self.waiter {
            let index = waiter.next_swept();
            note(&mut self.channels, &mut self.due, index);
        }
    }
}

fn note(channels: &mut [Input], due: &mut VecDeque<usize>, index: usize) {
    let input = &mut channels[index];
    input.is_announced = true;
    if !core::mem::replace(&mut input.is_due, true) {
        due.push_back(index);
    }
}
