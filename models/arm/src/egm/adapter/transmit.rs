//! When the sensor's side sends. It holds no command and encodes nothing.

use core::time::Duration;

use hil_core::time::{Instant, PeriodicTimer};

/// When a sensor sends, once the robot has opened a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SendPolicy {
    /// One datagram per datagram of the robot, as the maker recommends. It is sent as soon as a
    /// command comes that was not sent yet, and after `patience` (or at the robot's next
    /// datagram) the last one again. Zero answers at once, with the newest command there is.
    Coupled {
        /// Longest wait for a fresh command; `abb_libegm` waits 24 ms.
        patience: Duration,
    },
    /// One datagram per period whatever the robot sends, on a grid that begins with its first
    /// datagram.
    Free {
        /// The period; not zero.
        period: Duration,
    },
}

/// What became of the sending.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TransmitCounts {
    /// Datagrams encoded.
    pub sent_count: u64,
    /// Those of them that repeated the command before.
    pub repeated_count: u64,
    /// Commands never sent, because a newer one came or their session ended first.
    pub superseded_count: u64,
    /// Robot's datagrams left without an answer, for want of a command in their session
    /// ([`SendPolicy::Coupled`]).
    pub unanswered_count: u64,
    /// Grid points without a datagram: the caller was late, or there was no command in the
    /// session ([`SendPolicy::Free`]).
    pub skipped_count: u64,
}

/// The policy at work.
#[derive(Debug, Clone)]
pub(super) enum Schedule {
    Coupled {
        patience: Duration,
        /// When the robot's newest datagram came that still waits for its answer.
        owed_since: Option<Instant>,
        /// An older one waits too: one answer is due at once.
        is_overdue: bool,
    },
    Free(PeriodicTimer),
}

impl Schedule {
    pub(super) fn new(policy: SendPolicy) -> Self {
        match policy {
            SendPolicy::Coupled { patience } => Self::Coupled {
                patience,
                owed_since: None,
                is_overdue: false,
            },
            SendPolicy::Free { period } => Self::Free(PeriodicTimer::new(period)),
        }
    }

    /// The robot's datagram was taken.
    pub(super) fn received(
        &mut self,
        now: Instant,
        has_command: bool,
        counts: &mut TransmitCounts,
    ) {
        match self {
            Self::Coupled {
                owed_since,
                is_overdue,
                ..
            } => {
                if owed_since.replace(now).is_some() {
                    // An answer more than one datagram late would only lengthen the robot's queue.
                    let is_lost = *is_overdue || !has_command;
                    counts.unanswered_count += u64::from(is_lost);
                    *is_overdue = has_command;
                }
            }
            Self::Free(timer) => {
                if timer.next().is_none() {
                    timer.start(now);
                }
            }
        }
    }

    /// A new session began: what the last one still waited for stays unanswered.
    pub(super) fn forget(&mut self, counts: &mut TransmitCounts) {
        if let Self::Coupled {
            owed_since,
            is_overdue,
            ..
        } = self
        {
            let owed = u64::from(owed_since.take().is_some()) + u64::from(*is_overdue);
            counts.unanswered_count += owed;
            *is_overdue = false;
        }
    }

    /// When a datagram is due, given a command that was (`is_fresh`: not yet) sent.
    pub(super) fn due(&self, is_fresh: bool) -> Option<Instant> {
        match self {
            Self::Coupled {
                patience,
                owed_since,
                is_overdue,
            } => {
                let since = (*owed_since)?;
                let is_at_once = is_fresh || *is_overdue;
                Some(if is_at_once { since } else { since + *patience })
            }
            Self::Free(timer) => timer.next(),
        }
    }

    /// Whether a datagram is due at `now`; if so, the caller sends it.
    pub(super) fn take(
        &mut self,
        now: Instant,
        command_is_fresh: Option<bool>,
        counts: &mut TransmitCounts,
    ) -> bool {
        match self {
            Self::Free(timer) => {
                let Some(tick) = timer.poll(now) else {
                    return false;
                };
                counts.skipped_count += tick.skipped_count + u64::from(command_is_fresh.is_none());
                command_is_fresh.is_some()
            }
            Self::Coupled { .. } => {
                let Some(is_fresh) = command_is_fresh else {
                    return false;
                };
                let is_due = self.due(is_fresh).is_some_and(|due| due <= now);
                if let Self::Coupled {
                    owed_since,
                    is_overdue,
                    ..
                } = self
                    && is_due
                {
                    if *is_overdue {
                        *is_overdue = false;
                    } else {
                        *owed_since = None;
                    }
                }
                is_due
            }
        }
    }
}
