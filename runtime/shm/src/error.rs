//! What can go wrong with a domain or a channel, in words. Full buffers and absent readers are
//! not errors.

use core::fmt::{Debug, Write as _};
use std::path::PathBuf;
use std::time::{Duration, Instant};
use std::{io, thread};

use super::capacity::Room;
use super::identity::SHARED_MEMORY_DIRECTORY;
use hil_platform::domain_address::DomainAddressError;
use hil_platform::own_folder::OwnFolderError;

/// A domain could not be created, opened or removed.
#[derive(Debug, thiserror::Error)]
pub enum DomainError {
    /// Its address cannot be used.
    #[error(transparent)]
    Address(#[from] DomainAddressError),
    /// The folder of domains, or of this one, is not this user's alone.
    #[error(transparent)]
    Folder(#[from] OwnFolderError),
    /// Another launcher holds the lock.
    #[error(
        "root path {} is in use by a run that is still alive; let it end or name this run differently",
        .root_path.display()
    )]
    Locked {
        /// The path given.
        root_path: PathBuf,
    },
    /// The directory holds files that are not a run's.
    #[error(
        "root path {} is not empty and not left by a run; empty it or name another",
        .root_path.display()
    )]
    ForeignDirectory {
        /// The path given.
        root_path: PathBuf,
    },
    /// The operating system refused.
    #[error("cannot {operation} {}: {source}", .path.display())]
    Io {
        /// What was attempted.
        operation: &'static str,
        /// On which path.
        path: PathBuf,
        /// Why it failed.
        source: io::Error,
    },
    /// iceoryx2 refused to make this process a member.
    #[error("cannot join the domain at {}: {reason}", .root_path.display())]
    Node {
        /// The domain's root path.
        root_path: PathBuf,
        /// iceoryx2's reason in words.
        reason: String,
    },
}

impl DomainError {
    /// For an operation on `path` that the system refused.
    pub fn io(operation: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io {
            operation,
            path,
            source,
        }
    }
}

/// A channel could not be created, opened or used.
#[derive(Debug, thiserror::Error)]
pub enum ChannelError {
    /// iceoryx2 refused.
    #[error("channel {channel}: cannot {operation}: {reason}")]
    Refused {
        /// The channel's name.
        channel: String,
        /// What was attempted, e.g. `open the channel`.
        operation: &'static str,
        /// iceoryx2's reason in words.
        reason: String,
        /// Trying again a little later may help.
        is_transient: bool,
    },
    /// The channel carries another message type.
    #[error("channel {channel} carries {found}, this side wants {wanted}")]
    WrongType {
        /// The channel's name.
        channel: String,
        /// What the channel was created for: name, size, alignment.
        found: String,
        /// What this side uses: name, size, alignment.
        wanted: String,
    },
    /// The channel's samples do not begin with our envelope.
    #[error("channel {channel} has the user header {found}, this side wants {wanted}")]
    ForeignHeader {
        /// The channel's name.
        channel: String,
        /// What the channel was created with.
        found: String,
        /// What this side uses.
        wanted: String,
    },
    /// There is too little memory for it.
    #[error(
        "channel {channel}: {SHARED_MEMORY_DIRECTORY} has {free} free, this side takes {need}; \
         mount -o remount,size=SIZE {SHARED_MEMORY_DIRECTORY}, or end what fills it"
    )]
    NoRoom {
        /// The channel's name.
        channel: String,
        /// What it takes.
        need: Room,
        /// What is free.
        free: Room,
    },
    /// Its memory cannot be taken before it is used.
    #[error("channel {channel}: cannot take its memory: {source}")]
    Reserve {
        /// The channel's name.
        channel: String,
        /// Why the kernel refused.
        source: io::Error,
    },
    /// A payload of another length than the channel's message.
    #[error("channel {channel}: payload has {given} bytes, its messages have {expected}")]
    WrongSize {
        /// The channel's name.
        channel: String,
        /// Bytes given.
        given: usize,
        /// Bytes of one message.
        expected: usize,
    },
    /// A waiter without a channel.
    #[error("a waiter takes at least one channel")]
    NoChannel,
    /// The wait itself failed.
    #[error("cannot wait for channel {channel}")]
    Wait {
        /// The first channel waited for.
        channel: String,
        /// Why the kernel refused.
        source: io::Error,
    },
}

impl ChannelError {
    // Cold, so that the paths which may fail stay short where they do not.
    #[cold]
    /// For an operation that iceoryx2 refused.
    pub fn refused(channel: &str, operation: &'static str, reason: &dyn Debug) -> Self {
        let name = format!("{reason:?}");
        Self::Refused {
            channel: channel.to_owned(),
            operation,
            is_transient: TRANSIENT.iter().any(|transient| name.contains(transient)),
            reason: explain(&name),
        }
    }

    /// Trying again a little later may help: the launcher is not that far yet, or a dead process
    /// still occupies a slot.
    pub const fn is_transient(&self) -> bool {
        matches!(
            self,
            Self::Refused {
                is_transient: true,
                ..
            }
        )
    }
}

/// iceoryx2's names for states that pass: service not created yet, half created, going away, or
/// its slots taken by a process that died and is not cleaned up yet.
const TRANSIENT: &[&str] = &[
    "DoesNotExist",
    "HangsInCreation",
    "IsMarkedForDestruction",
    "IsBeingCreatedByAnotherInstance",
    "ExceedsMaxNumberOfNodes",
    "ExceedsMaxSupported",
    "ServiceInInconsistentState",
    "Interrupt",
];

const ADVICE: &[(&str, &str)] = &[
    (
        "DoesNotExist",
        "the launcher has not created it in this domain",
    ),
    (
        "HangsInCreation",
        "a process died while creating it, the domain must be recreated",
    ),
    (
        "ServiceInCorruptedState",
        "another iceoryx2 version or a half-deleted domain",
    ),
    (
        "ExceedsMaxSupported",
        "all slots of the channel are taken, is a second instance running?",
    ),
    (
        "ExceedsMaxNumberOfNodes",
        "more processes than the channel was created for",
    ),
];

/// `HangsInCreation` becomes `hangs in creation`, followed by what usually explains it.
pub(crate) fn explain(variant: &str) -> String {
    let mut words = String::with_capacity(variant.len() + 16);
    let mut is_word_start = true;
    for letter in variant.chars() {
        if letter.is_ascii_uppercase() {
            if !is_word_start {
                words.push(' ');
            }
            words.push(letter.to_ascii_lowercase());
        } else {
            words.push(letter);
        }
        is_word_start = !letter.is_alphanumeric();
    }
    if let Some((_, advice)) = ADVICE.iter().find(|(name, _)| variant.contains(name)) {
        write!(words, " ({advice})").expect("writing to a string cannot fail");
    }
    words
}

/// Repeats `attempt` while it fails for a passing reason, for at most `within`.
pub(crate) fn retry<T>(
    within: Duration,
    mut attempt: impl FnMut() -> Result<T, ChannelError>,
) -> Result<T, ChannelError> {
    const PAUSE: Duration = Duration::from_millis(2);
    let started = Instant::now();
    loop {
        match attempt() {
            Err(error) if error.is_transient() && started.elapsed() < within => {
                thread::sleep(PAUSE);
            }
            outcome => return outcome,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    enum Reason {
        HangsInCreation,
        IncompatibleTypes,
        LoanError(Inner),
    }

    #[derive(Debug)]
    enum Inner {
        ExceedsMaxLoans,
    }

    #[test]
    fn a_reason_becomes_words_with_advice() {
        let error =
            ChannelError::refused("arm/command", "open the channel", &Reason::HangsInCreation);
        assert_eq!(
            error.to_string(),
            "channel arm/command: cannot open the channel: hangs in creation (a process died \
             while creating it, the domain must be recreated)"
        );
        assert!(error.is_transient());
    }

    #[test]
    fn nested_and_lasting_reasons_are_told_apart() {
        assert_eq!(
            explain(&format!("{:?}", Reason::LoanError(Inner::ExceedsMaxLoans))),
            "loan error(exceeds max loans)"
        );
        assert!(!ChannelError::refused("c", "open", &Reason::IncompatibleTypes).is_transient());
    }

    #[test]
    fn retry_gives_up_at_the_deadline_and_never_repeats_a_lasting_failure() {
        let mut attempts = 0;
        let mut fail = |reason: Reason, within| {
            attempts = 0;
            let outcome: Result<(), _> = retry(Duration::from_millis(within), || {
                attempts += 1;
                Err(ChannelError::refused("c", "open", &reason))
            });
            assert!(outcome.is_err());
            attempts
        };
        assert_eq!(fail(Reason::IncompatibleTypes, 50), 1);
        assert!(fail(Reason::HangsInCreation, 20) > 1);
    }
}
