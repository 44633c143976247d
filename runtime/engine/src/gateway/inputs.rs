//! The local channels of a sending thread and the order in which they are looked at: each that may have a
//! message in its turn, and an idle one not at all. What becomes of a message is not its business.

use std::collections::VecDeque;
use std::os::fd::BorrowedFd;

use hil_core::message::Envelope;
use hil_core::time::Instant;
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
    /// Messages since it was asked last which channels are announced.
    unasked_count: usize,
    swept: Instant,
}

/// Messages of channels that are looked at already, after which it is asked whether others are announced.
const UNASKED_MAX: usize = 8;
/// How often some channels are looked at that nobody announced: an announcement can be lost.
const SWEEP_PERIOD_NS: i64 = 50_000_000;
const SWEEP_COUNT: usize = 16;

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
    place: Place,
    /// Its announcements are to be taken back.
    is_announced: bool,
    /// Messages that the reading thread itself published and has not taken yet.
    own_count: usize,
}

/// Where a channel is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Idle,
    Due,
    /// Among those that wait for the long message under way.
    Waiting,
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
                place: Place::Due,
                is_announced: false,
                own_count: 0,
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
            unasked_count: 0,
            swept: Instant::ZERO,
        })
    }

    /// True without channels.
    pub(super) fn is_empty(&self) -> bool {
        self.channels.is_empty()
    }

    /// How many channels are to be looked at.
    pub(super) fn due_count(&self) -> usize {
        self.due.len()
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
            input.place = Place::Waiting;
            self.waiting.push(index);
            // It is looked at when its turn comes; until then its announcements would end every wait.
            if core::mem::take(&mut input.is_announced)
                && let Some(waiter) = &self.waiter
            {
                waiter.drain(index)?;
            }
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
        input.own_count = if has_moved {
            input.own_count.saturating_sub(1)
        } else {
            0
        };
        input.place = if has_moved || input.is_announced || is_always_looked_at {
            self.due.push_back(index);
            Place::Due
        } else {
            Place::Idle
        };
        Ok(look)
    }

    /// The long message is no longer under way: those that waited for it are looked at again.
    pub(super) fn resume_long(&mut self) {
        for index in self.waiting.drain(..) {
            self.channels[index].place = Place::Due;
            self.due.push_back(index);
        }
    }

    /// Takes back the announcements of the channel that was found empty last; false when it had none. A
    /// message published before they were is seen by the look that follows.
    ///
    /// # Errors
    /// When its listener is broken.
    pub(super) fn settle(&mut self) -> Result<bool, ChannelError> {
        let Some((waiter, &index)) = self.waiter.as_ref().zip(self.due.back()) else {
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

    /// A message was sent: after some of them, and not before every channel that is due had its turn, looks
    /// whether others are announced, so that busy channels do not hide them.
    ///
    /// # Errors
    /// When that cannot be asked.
    pub(super) fn note_moved(&mut self) -> Result<(), ChannelError> {
        self.unasked_count += 1;
        if self.is_always_looked_at() || self.unasked_count < self.due.len().max(UNASKED_MAX) {
            return Ok(());
        }
        self.note_announced()
    }

    /// True while a message of [`Inputs::note_published`] waits: on the channel with `index`, or on any.
    pub(super) fn has_own(&self, index: Option<usize>) -> bool {
        let channels = match index {
            Some(index) => core::slice::from_ref(&self.channels[index]),
            None => &self.channels,
        };
        channels.iter().any(|one| one.own_count > 0)
    }

    /// Notes that the channel with `index` has a message of which nobody was told.
    pub(super) fn note_published(&mut self, index: usize) {
        self.channels[index].own_count += 1;
        if self.channels[index].place == Place::Idle {
            self.channels[index].place = Place::Due;
            self.due.push_back(index);
        }
    }

    /// Notes which channels are announced.
    ///
    /// # Errors
    /// When that cannot be asked.
    pub(super) fn note_announced(&mut self) -> Result<(), ChannelError> {
        self.unasked_count = 0;
        let Some(waiter) = &self.waiter else {
            return Ok(());
        };
        for index in waiter.announced()? {
            if self.channels[index].place == Place::Waiting {
                waiter.drain(index)?;
            } else {
                note(&mut self.channels, &mut self.due, index);
            }
        }
        Ok(())
    }

    /// Looks now and then at some channels that nobody announced, each in its turn.
    pub(super) fn sweep(&mut self, now: Instant) {
        let Some(waiter) = &mut self.waiter else {
            return;
        };
        if now.ns_since(self.swept) < SWEEP_PERIOD_NS {
            return;
        }
        self.swept = now;
        for _ in 0..SWEEP_COUNT.min(self.channels.len()) {
            let index = waiter.next_swept();
            if self.channels[index].place != Place::Waiting {
                note(&mut self.channels, &mut self.due, index);
            }
        }
    }
}

fn note(channels: &mut [Input], due: &mut VecDeque<usize>, index: usize) {
    let input = &mut channels[index];
    input.is_announced = true;
    if input.place == Place::Idle {
        input.place = Place::Due;
        due.push_back(index);
    }
}
