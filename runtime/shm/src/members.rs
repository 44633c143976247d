//! Who is a member of a domain: the processes of its run, and observers, which only look on and
//! whose leaving nobody has to wait for.

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, LogLevel, NodeName, PortName, ipc, set_log_level};

/// What the nodes of observers are called.
const OBSERVER: &str = "hil-observer";

/// Living members of a domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Members {
    /// Processes of the run.
    pub(super) process_count: u64,
    /// Observers.
    pub(super) observer_count: u64,
}

/// The name under which an observer joins.
pub(super) fn observer_name() -> NodeName {
    NodeName::new(OBSERVER).expect("a short plain name is a node's name")
}

/// The name of the ports with which an observer reads.
pub(super) fn observer_port_name() -> PortName {
    PortName::new(OBSERVER).expect("a short plain name is a port's name")
}

/// Whether `node` is an observer's.
pub(super) fn is_observer(node: &Node<ipc::Service>) -> bool {
    node.name().as_str() == OBSERVER
}

/// Counts the living members of the domain that `config` describes.
pub(super) fn living(config: &Config) -> Members {
    let mut members = Members::default();
    let listed = Node::<ipc::Service>::list(config, |state| {
        if let NodeState::Alive(view) = state {
            let is_observer = view
                .details()
                .as_ref()
                .map(|details| details.name().as_str() == OBSERVER);
            // One that is just leaving still lives and has no name any more: it is waited for as observers are.
            let count = if is_observer.unwrap_or(true) {
                &mut members.observer_count
            } else {
                &mut members.process_count
            };
            *count += 1;
        }
        CallbackProgression::Continue
    });
    // An unreadable list means a deleted directory, hence no members.
    listed.map_or_else(|_unreadable| Members::default(), |()| members)
}

/// Nodes of iceoryx2's default domain, which runs do not use: those of other programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ForeignNodes {
    /// Living programs.
    pub living: u64,
    /// Programs that ended without leaving.
    pub dead: u64,
    /// Those of other users, of which nothing can be said.
    pub hidden: u64,
}

impl ForeignNodes {
    /// Looks; cleans nothing up.
    ///
    /// # Errors
    /// When the list cannot be read.
    pub fn list() -> Result<Self, String> {
        set_log_level(LogLevel::Warn);
        let mut found = Self::default();
        let listed = Node::<ipc::Service>::list(&Config::default(), |state| {
            match state {
                NodeState::Alive(_) => found.living += 1,
                NodeState::Dead(_) => found.dead += 1,
                NodeState::Inaccessible(_) | NodeState::Undefined(_) => found.hidden += 1,
            }
            CallbackProgression::Continue
        });
        match listed {
            Ok(()) => Ok(found),
            Err(error) => Err(format!("iceoryx2 cannot list its nodes: {error:?}")),
        }
    }
}
