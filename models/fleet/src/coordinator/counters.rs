//! What a coordinator counts. It counts only what the coordinator itself can know: collisions
//! are the referee's business.

/// Figures of one coordinator since its start.
#[derive(Debug, Clone, Default)]
pub struct CoordinatorCounters {
    /// The plain counts.
    pub counts: CoordinatorCounts,
    /// What only the safe rules count.
    pub safe: SafeCounts,
}

hil_core::counts! {
    /// The plain counts of a coordinator.
    #[derive(Eq)]
    pub struct CoordinatorCounts {
        /// States taken over into a robot's view.
        states_accepted: u64;
        /// States of robots without a mission, or of the mission before the present one.
        states_outdated: u64;
        /// States with a number that is not finite, an unknown phase or an index beyond the path.
        states_unsound: u64;
        /// States of a fleet or robot this coordinator does not have, or of a mission it never gave.
        states_unknown: u64;
        /// States that arrived after one with a newer header.
        states_reordered: u64;
        /// States with the header of one that arrived before.
        states_duplicate: u64;
        /// Of the reordered and duplicate states, those that the strict order dropped.
        states_dropped: u64;
        /// Missions whose end a state showed, those ended by a reset included.
        missions_done: u64;
        /// Decisions that changed a robot's authority.
        authority_changes: u64;
        /// Authorities sent again because the robot did not show them in time.
        authority_repeats: u64;
        /// Authority messages sent; each change and each repeat makes one per replica.
        authority_messages: u64;
        /// Critical sections that a robot passed: the "total CS counts" of the seed paper's tables.
        sections_obsolete: u64;
        /// Critical sections that went away because a robot was reset.
        sections_abandoned: u64;
        /// Changes of the order in which two robots go through a section.
        order_reversals: u64;
        /// Dependencies made on purpose because neither robot could get past the other.
        artificial_dependencies: u64;
        /// Cycles of waiting robots that broke up because one order was reversed.
        deadlocks_broken: u64;
        /// Robots put at their goal because they made no way for too long.
        resets: u64;
    }
}

hil_core::counts! {
    /// Counts of the safe rules.
    #[derive(Eq)]
    pub struct SafeCounts {
        /// Extensions not given because no order was found in which all could still finish.
        grants_withheld: u64;
        /// Missions not begun in a cycle because no order with them was found, per cycle.
        admissions_deferred: u64;
        /// Robots that made no way for too long, once per standstill.
        stuck: u64;
        /// States that say what cannot be.
        states_impossible: u64;
        /// Robots that have forgotten what they had told: they restarted, and stand.
        robots_restarted: u64;
        /// Answers of robots that stand outside every bay without a mission, or name none they could be on.
        answers_unplaced: u64;
        /// States that show an authority that was never given.
        authorities_exceeded: u64;
        /// States that show a robot beyond its authority by more than the stop margin.
        margins_exceeded: u64;
    }
}
