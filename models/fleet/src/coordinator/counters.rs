//! What a coordinator counts. It counts only what the coordinator itself can know: collisions
//! are the referee's business.

use serde::Serialize;

/// Figures of one coordinator since its start.
#[derive(Debug, Clone, Default)]
pub struct CoordinatorCounters {
    /// The plain counts.
    pub counts: CoordinatorCounts,
    /// What only the safe rules count.
    pub safe: SafeCounts,
}

macro_rules! counts {
    ($(#[$of:meta])* $type:ident: $($(#[$doc:meta])* $name:ident,)*) => {
        $(#[$of])*
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
        pub struct $type {
            $($(#[$doc])* pub $name: u64,)*
        }

        impl $type {
            /// Adds what another coordinator counted.
            pub fn merge(&mut self, other: &Self) {
                $(self.$name += other.$name;)*
            }
        }
    };
}

counts! {
    /// The plain counts of a coordinator.
    CoordinatorCounts:
    /// States taken over into a robot's view.
    states_accepted,
    /// States of robots without a mission, or of the mission before the present one.
    states_outdated,
    /// States with a number that is not finite, an unknown phase or an index beyond the path.
    states_unsound,
    /// States of a fleet or robot this coordinator does not have, or of a mission it never gave.
    states_unknown,
    /// States that arrived after one with a newer header.
    states_reordered,
    /// States with the header of one that arrived before.
    states_duplicate,
    /// Of the reordered and duplicate states, those that the strict order dropped.
    states_dropped,
    /// Missions whose end a state showed, those ended by a reset included.
    missions_done,
    /// Decisions that changed a robot's authority.
    authority_changes,
    /// Authorities sent again because the robot did not show them in time.
    authority_repeats,
    /// Authority messages sent; each change and each repeat makes one per replica.
    authority_messages,
    /// Critical sections that a robot passed: the "total CS counts" of the seed paper's tables.
    sections_obsolete,
    /// Critical sections that went away because a robot was reset.
    sections_abandoned,
    /// Changes of the order in which two robots go through a section.
    order_reversals,
    /// Dependencies made on purpose because neither robot could get past the other.
    artificial_dependencies,
    /// Cycles of waiting robots that broke up because one order was reversed.
    deadlocks_broken,
    /// Robots put at their goal because they made no way for too long.
    resets,
}

counts! {
    /// Counts of the safe rules.
    SafeCounts:
    /// Extensions not given because no order was found in which all could still finish.
    grants_withheld,
    /// Missions not begun in a cycle because no order with them was found, per cycle.
    admissions_deferred,
    /// Robots that made no way for too long, once per standstill.
    stuck,
    /// States that say what cannot be.
    states_impossible,
    /// States that show an authority that was never given.
    authorities_exceeded,
    /// States that show a robot beyond its authority by more than the stop margin.
    margins_exceeded,
    /// Authorities counted as ended because their lease ran out unanswered.
    leases_expired,
    /// States older than the delay bound a lease rests on.
    delay_bound_violations,
    /// Cycles without grants because the delay bound was violated.
    cycles_frozen,
}
