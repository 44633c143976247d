//! The cells of the tables: which experiments there are, and what each is held against. It runs
//! none of them.

use crate::coordinator::counters::{CoordinatorCounts, SafeCounts};
use crate::coordinator::parameters::CoordinatorMode;
use crate::experiment::driver::{Links, Setup, StatusPath};
use crate::messages::MessageOrder;
use crate::referee::Tally;
use crate::robot::TrackerKind;
use crate::scenario::Scenario;
use hil_core::recorded_run::PublishedNetwork;
use hil_core::time::Instant;
use hil_link::impaired::{DelayLaw, Impairments, LinkCounts};
use hil_link::wifi::WifiPreset;
use hil_stats::comparison::{Scatter, Share};
use hil_stats::statistics::clopper_pearson_at;

/// Scenarios of the paper's tables.
pub(crate) const SCENARIOS: [Scenario; 2] = [Scenario::Harbor, Scenario::Warehouse];

/// The published rows of a scenario.
pub(crate) const fn published_rows(scenario: Scenario) -> &'static [PublishedRow] {
    match scenario {
        Scenario::Harbor => &HARBOR,
        _ => &WAREHOUSE,
    }
}

/// One experiment of the tables.
#[derive(Debug, Clone)]
pub(crate) struct CellSpec {
    pub(crate) id: CellId,
    /// All that sets it apart.
    pub(crate) setup: Setup,
    /// What its figures are held against.
    pub(crate) demand: Demand,
}

/// Which cell: a world and a place in the tables.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CellId {
    pub(crate) scenario: Scenario,
    pub(crate) place: Place,
}

/// A cell's place in the tables.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Place {
    /// Beside a published row, with so many copies of every message.
    Published { row: PublishedRow, copies: u32 },
    /// Below the published rows.
    Variant(Variant),
    /// In the table of mechanisms.
    Mechanism {
        mechanism: Mechanism,
        mode: CoordinatorMode,
    },
}

/// What a probability of collision is held against, per 1000 critical sections.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Demand {
    /// Nothing.
    None,
    /// The interval's upper end lies below.
    Below(f64),
    /// The interval lies within.
    Within(f64, f64),
    /// None at all, by each checker.
    NoneAtAll,
}

impl core::fmt::Display for CellId {
    /// What the cell is called, whatever its position among the others.
    fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let name = self.seed_name();
        match self.place {
            Place::Published { copies: 1, .. } => {
                formatter.write_str(&name.replace("1 copies", "1 copy"))
            }
            _ => formatter.write_str(&name),
        }
    }
}

impl CellId {
    /// What the seeds of its runs are drawn from: equal as long as equal tables are wanted.
    pub(crate) fn seed_name(&self) -> String {
        let scenario = self.scenario;
        match &self.place {
            Place::Published { row, copies } => match row.condition {
                Condition::Static {
                    loss_ratio,
                    delay_ms,
                } => format!("{scenario}, loss {loss_ratio}, {delay_ms} ms, {copies} copies"),
                Condition::HardwareInTheLoop(network) => format!("{scenario}, {}", network.label()),
            },
            Place::Variant(variant) => format!("{scenario}, {variant}"),
            Place::Mechanism { mechanism, mode } => format!("{scenario}, {mechanism}, {mode}"),
        }
    }
}

/// The static rows of Tables II and III as the original simulates them, with one and with three
/// copies where packets are lost, and the variants that show where the collisions come from.
pub(crate) fn published_cells(base: &Setup, law: DelayLaw) -> Vec<CellSpec> {
    let mut cells = Vec::new();
    for scenario in SCENARIOS {
        for row in published_rows(scenario) {
            let (loss_ratio, delay_ms) = match row.condition {
                Condition::Static {
                    loss_ratio,
                    delay_ms,
                } => (loss_ratio, delay_ms),
                Condition::HardwareInTheLoop(network) => {
                    cells.extend(wifi_cell(base, scenario, *row, network));
                    continue;
                }
            };
            let copies: &[u32] = if loss_ratio > 0.0 { &[1, 3] } else { &[1] };
            cells.extend(copies.iter().map(|&copies| CellSpec {
                id: CellId {
                    scenario,
                    place: Place::Published { row: *row, copies },
                },
                setup: original(base, delay_ms, law, loss_ratio, copies),
                demand: demand_of(scenario, loss_ratio, delay_ms, copies),
            }));
        }
        if scenario == Scenario::Harbor {
            cells.extend(Variant::ALL.map(|variant| variant.cell(base, law)));
        }
    }
    cells
}

/// The original's mechanisms: believed delivery, stepped tracker whose steps the delay stretches,
/// status read past the network, the delay known to the coordinator.
fn original(base: &Setup, delay_ms: f64, law: DelayLaw, loss_ratio: f64, copies: u32) -> Setup {
    let mut setup = base.clone();
    setup.robot.tracker = TrackerKind::LegacyRk4;
    setup.robot.step_inflation = true;
    setup.robot.inflation_delay_ms = delay_ms;
    setup.coordinator.mode = CoordinatorMode::Legacy;
    setup.coordinator.known_delay_ms = delay_ms;
    let channel = Impairments {
        delay_ms,
        delay_law: law,
        loss_ratio,
        copies,
        ..Impairments::default()
    };
    setup.links = Links {
        status_path: StatusPath::Bypass,
        commands: channel,
        status: channel,
        wifi: None,
        status_keeps_order: true,
    };
    setup
}

/// What a row with hardware in the loop is about: the original's rules, status over the network, steps of nominal
/// length, and a coordinator that knows of no delay.
pub(crate) fn hil_setup(base: &Setup) -> Setup {
    let mut setup = original(base, 0.0, DelayLaw::Constant, 0.0, 1);
    setup.robot.step_inflation = false;
    setup.links.status_path = StatusPath::Network;
    setup
}

/// A row over a radio beside the model of that radio. `None` for a wire.
fn wifi_cell(
    base: &Setup,
    scenario: Scenario,
    row: PublishedRow,
    network: PublishedNetwork,
) -> Option<CellSpec> {
    let preset = match network {
        PublishedNetwork::ShortRange => WifiPreset::ShortRange,
        PublishedNetwork::LongRange => WifiPreset::LongRange,
        PublishedNetwork::Ethernet => return None,
    };
    let mut setup = hil_setup(base);
    setup.links.wifi = Some(preset.spec());
    Some(CellSpec {
        id: CellId {
            scenario,
            place: Place::Published { row, copies: 1 },
        },
        setup,
        demand: Demand::None,
    })
}

/// What our figures must come to, from the published ones and a prototype of the algorithm.
fn demand_of(scenario: Scenario, loss_ratio: f64, delay_ms: f64, copies: u32) -> Demand {
    let is_lossy = loss_ratio > 0.0;
    let is_long = delay_ms > 99.0;
    match (scenario, is_lossy) {
        (Scenario::Harbor, false) if is_long => Demand::Within(0.2, 4.0),
        (Scenario::Harbor, false) if delay_ms > 49.0 => Demand::Below(0.37),
        // The reference gives no band for three copies.
        (Scenario::Harbor, true) if is_long && copies > 1 => Demand::None,
        (Scenario::Harbor, true) if is_long => Demand::Within(0.5, 5.0),
        (Scenario::Harbor, true) => Demand::Below(0.37),
        (_, false) => Demand::Below(0.2),
        (_, true) if copies > 1 => Demand::Below(0.37),
        (_, true) => Demand::None,
    }
}

hil_core::labelled! {
    /// Harbor, 100 ms, no loss, with one thing changed; the last changes all that the network could
    /// be blamed for, and keeps the nominal steps. In the order of the table, with what that calls it; the
    /// seeds of its cells are drawn from it too.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub(crate) enum Variant, label {
        /// Steps as long as they should be.
        NominalSteps = "100 ms, steps of nominal length",
        /// A tracker without error.
        ExactTracker = "100 ms, exact tracker",
        /// Robots wait 6 poses before a section.
        WideMargin = "100 ms, margin of 6 poses",
        /// Steps as long as they should be, status over the network, the delay unknown.
        DelayedStatus = "100 ms, nominal steps, delayed status, delay unknown",
    }
}

impl Variant {
    fn cell(self, base: &Setup, law: DelayLaw) -> CellSpec {
        let mut setup = original(base, 100.0, law, 0.0, 1);
        match self {
            Self::NominalSteps => setup.robot.step_inflation = false,
            Self::ExactTracker => setup.robot.tracker = TrackerKind::Exact,
            Self::WideMargin => setup.coordinator.trailing_points = 6,
            Self::DelayedStatus => {
                setup.robot.step_inflation = false;
                setup.links.status_path = StatusPath::Network;
                setup.coordinator.known_delay_ms = 0.0;
            }
        }
        CellSpec {
            id: CellId {
                scenario: Scenario::Harbor,
                place: Place::Variant(self),
            },
            setup,
            demand: match self {
                Self::DelayedStatus => Demand::None,
                _ => Demand::Below(0.2),
            },
        }
    }
}

hil_core::labelled! {
    /// What the network, or the controller's host, does in a row of the table of mechanisms. In the order of the
    /// table, with what that calls it; the seeds of its cells are drawn from it too.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub(crate) enum Mechanism, label {
        /// Nothing.
        Clean = "clean",
        /// Every message takes 300 ms.
        Delay300Ms = "delay 300 ms",
        /// Every message takes 1 s.
        Delay1S = "delay 1 s",
        /// Messages take 0 to 1 s.
        DelayTo1S = "delay 0 to 1 s",
        /// A tenth of the commands is lost.
        CommandLoss10 = "loss 10 %, commands",
        /// A tenth of the status is lost.
        StatusLoss10 = "loss 10 %, status",
        /// A tenth of both is lost.
        Loss10 = "loss 10 %, both",
        /// Three tenths of both are lost.
        Loss30 = "loss 30 %, both",
        /// The network stalls for 1 s in 30 s.
        Stall1S = "stalls, mean 1 s in 30 s",
        /// The network stalls for 3 s in 30 s.
        Stall3S = "stalls, mean 3 s in 30 s",
        /// The controller's host overruns.
        Overrun = "overrun to 4 s",
        /// A tenth of the messages comes twice.
        Repeated = "10 % repeated to 3 s late",
        /// A tenth of the messages is held back.
        HeldBack = "10 % held back to 3 s",
    }
}

impl Mechanism {
    fn apply(self, setup: &mut Setup) {
        match self {
            Self::Clean => {}
            Self::Delay300Ms => delay_both(setup, 300.0, DelayLaw::Constant),
            Self::Delay1S => delay_both(setup, 1000.0, DelayLaw::Constant),
            Self::DelayTo1S => delay_both(setup, 1000.0, DelayLaw::Uniform),
            Self::CommandLoss10 => setup.links.commands.loss_ratio = 0.1,
            Self::StatusLoss10 => setup.links.status.loss_ratio = 0.1,
            Self::Loss10 => lose_both(setup, 0.1),
            Self::Loss30 => lose_both(setup, 0.3),
            Self::Stall1S => stall_both(setup, 1.0),
            Self::Stall3S => stall_both(setup, 3.0),
            Self::Overrun => setup.overrun_max_s = 4.0,
            Self::Repeated => both(setup, |channel| {
                channel.duplicate_ratio = 0.1;
                channel.duplicate_lag_ms = 3000.0;
            }),
            Self::HeldBack => both(setup, |channel| {
                channel.hold_ratio = 0.1;
                channel.hold_ms = 3000.0;
            }),
        }
    }
}

fn both(setup: &mut Setup, change: impl Fn(&mut Impairments)) {
    change(&mut setup.links.commands);
    change(&mut setup.links.status);
}

fn delay_both(setup: &mut Setup, delay_ms: f64, law: DelayLaw) {
    both(setup, |channel| {
        channel.delay_ms = delay_ms;
        channel.delay_law = law;
    });
}

fn lose_both(setup: &mut Setup, loss_ratio: f64) {
    both(setup, |channel| channel.loss_ratio = loss_ratio);
}

fn stall_both(setup: &mut Setup, mean_s: f64) {
    both(setup, |channel| channel.stall_mean_s = mean_s);
}

/// Each mechanism with each coordinator in each scenario: status over the network, robots that
/// stop where they mean to, and a coordinator that knows of no delay.
pub(crate) fn mechanism_cells(base: &Setup) -> Vec<CellSpec> {
    let mut cells = Vec::new();
    for mechanism in Mechanism::ALL {
        for scenario in SCENARIOS {
            for mode in [CoordinatorMode::Legacy, CoordinatorMode::Safe] {
                let mut setup = base.clone();
                setup.robot.tracker = TrackerKind::Exact;
                setup.coordinator.mode = mode;
                setup.coordinator.known_delay_ms = 0.0;
                setup.coordinator.message_order = match mode {
                    CoordinatorMode::Legacy => MessageOrder::Legacy,
                    CoordinatorMode::Safe => MessageOrder::Strict,
                };
                setup.links = Links::default();
                mechanism.apply(&mut setup);
                cells.push(CellSpec {
                    id: CellId {
                        scenario,
                        place: Place::Mechanism { mechanism, mode },
                    },
                    setup,
                    demand: match mode {
                        CoordinatorMode::Legacy => Demand::None,
                        CoordinatorMode::Safe => Demand::NoneAtAll,
                    },
                });
            }
        }
    }
    cells
}

/// Figures of one or more runs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FleetTally {
    /// What the referee saw.
    pub referee: Tally,
    /// What the coordinators counted.
    pub coordinator: CoordinatorCounts,
    /// What the safe mode's rules counted; zeros in the legacy mode.
    pub safe: SafeCounts,
    /// What became of authorities and missions on their way.
    pub commands: LinkCounts,
    /// What became of states on their way.
    pub status: LinkCounts,
    /// States deleted on their way by a newer one.
    pub superseded_count: u64,
    /// Time run, seconds.
    pub run_s: f64,
    /// Time run times robots, seconds.
    pub robot_s: f64,
    /// Farthest a robot may stop past an authority that came in time, metres.
    pub stop_error_bound_m: f64,
    /// Runs that ended because the fleet stood.
    pub stand_count: u64,
    /// Runs with a collision.
    pub collided: Vec<CollidedRun>,
    /// Its runs one by one, for what they differ by among themselves.
    pub runs: Vec<RunFigures>,
    /// Variance of its collisions over that of independent sections; below 1 counts as 1.
    pub scatter: f64,
}

/// One run of a cell.
#[derive(Debug, Clone, PartialEq)]
pub struct RunFigures {
    /// Collisions of critical sections, in parts of the run one after the other.
    pub parts: Vec<Share>,
    /// See [`FleetTally::missions_per_hour`].
    pub missions_per_hour: Option<f64>,
}

/// Where to see a collision again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CollidedRun {
    /// Which of the cell's runs.
    pub replica: u64,
    /// Its seed.
    pub seed: u64,
    /// When the first collision was seen.
    pub first_at: Instant,
}

/// Runs with a collision that a tally remembers.
const COLLIDED_MAX: usize = 8;

impl FleetTally {
    /// Adds another run.
    pub fn merge(&mut self, other: &Self) {
        self.referee.merge(&other.referee);
        self.coordinator.merge(&other.coordinator);
        self.safe.merge(&other.safe);
        self.commands.merge(&other.commands);
        self.status.merge(&other.status);
        self.superseded_count += other.superseded_count;
        self.run_s += other.run_s;
        self.robot_s += other.robot_s;
        self.stop_error_bound_m = self.stop_error_bound_m.max(other.stop_error_bound_m);
        self.stand_count += other.stand_count;
        let room = COLLIDED_MAX.saturating_sub(self.collided.len());
        self.collided.extend(other.collided.iter().take(room));
        self.runs.extend_from_slice(&other.runs);
    }

    /// Critical sections that a robot passed.
    pub fn section_count(&self) -> u64 {
        self.referee.sections_passed_count
    }

    /// Collisions by the original's checker: the count the tables' probability is of.
    pub fn collision_count(&self) -> u64 {
        self.referee.section_collisions_count
    }

    /// Collisions by any of the three checkers. The true overlaps include those outside every
    /// section.
    pub fn any_collision_count(&self) -> u64 {
        self.referee.section_collisions_count + self.referee.overlaps_count
    }

    /// Collisions per critical section; `None` without sections.
    pub fn collision_ratio(&self) -> Option<f64> {
        let sections = self.section_count();
        (sections > 0).then(|| self.collision_count() as f64 / sections as f64)
    }

    /// How much more its collisions vary from part to part than those of independent sections.
    pub(crate) fn own_scatter(&self) -> Scatter {
        let parts: Vec<Share> = self
            .runs
            .iter()
            .flat_map(|run| &run.parts)
            .copied()
            .collect();
        Scatter::of(&parts)
    }

    /// The interval of collisions per 1000 critical sections; `None` without sections, and where there are more
    /// collisions than sections.
    pub fn per_1000_interval(&self, confidence: f64) -> Option<(f64, f64)> {
        let scatter = self.scatter.max(1.0);
        per_1000_interval(
            self.collision_count(),
            self.section_count(),
            scatter,
            confidence,
        )
    }

    /// Missions driven to their end per hour of the fleet; `None` before it ran.
    pub fn missions_per_hour(&self) -> Option<f64> {
        missions_per_hour(self.referee.missions_done_count, self.run_s)
    }
}

/// Missions done per hour of a fleet that ran for so long.
pub(crate) fn missions_per_hour(done_count: u64, fleet_s: f64) -> Option<f64> {
    (fleet_s > 0.0).then(|| 3600.0 * done_count as f64 / fleet_s)
}

/// The exact interval of collisions per 1000 critical sections, both counts divided by `scatter` (Korn and Graubard 1998).
pub(crate) fn per_1000_interval(
    collisions: u64,
    sections: u64,
    scatter: f64,
    confidence: f64,
) -> Option<(f64, f64)> {
    // One section can see two collisions; more collisions than sections are no proportion.
    if collisions > sections {
        return None;
    }
    let interval = clopper_pearson_at(collisions, sections, scatter, confidence)?;
    Some((1e3 * interval.low, 1e3 * interval.high))
}

/// One row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PublishedRow {
    /// What the paper's first columns say.
    pub(crate) condition: Condition,
    /// "Total CS counts".
    pub(crate) sections: u64,
    /// "Collision counts".
    pub(crate) collisions: u64,
}

impl PublishedRow {
    /// Collisions of critical sections.
    pub(crate) const fn share(&self) -> Share {
        Share {
            count: self.collisions,
            of: self.sections,
        }
    }
}

/// Under what a row was obtained.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Condition {
    /// Static modelling: packet loss ratio and packet delay.
    Static {
        /// Packet loss ratio.
        loss_ratio: f64,
        /// Packet delay.
        delay_ms: f64,
    },
    /// Hardware in the loop, over this network.
    HardwareInTheLoop(PublishedNetwork),
}

const fn fixed(loss_ratio: f64, delay_ms: f64, sections: u64, collisions: u64) -> PublishedRow {
    PublishedRow {
        condition: Condition::Static {
            loss_ratio,
            delay_ms,
        },
        sections,
        collisions,
    }
}

const fn measured(network: PublishedNetwork, sections: u64, collisions: u64) -> PublishedRow {
    PublishedRow {
        condition: Condition::HardwareInTheLoop(network),
        sections,
        collisions,
    }
}

/// Table II, harbor.
pub(crate) const HARBOR: [PublishedRow; 11] = [
    fixed(0.0, 0.0, 10_018, 0),
    fixed(0.0, 10.0, 10_001, 0),
    fixed(0.0, 50.0, 10_003, 0),
    fixed(0.0, 100.0, 10_018, 5),
    fixed(0.1, 0.0, 10_003, 0),
    fixed(0.1, 10.0, 10_007, 0),
    fixed(0.1, 50.0, 10_092, 0),
    fixed(0.1, 100.0, 10_061, 18),
    measured(PublishedNetwork::Ethernet, 10_819, 0),
    measured(PublishedNetwork::ShortRange, 15_489, 14),
    measured(PublishedNetwork::LongRange, 10_004, 23),
];

/// Table III, warehouse.
pub(crate) const WAREHOUSE: [PublishedRow; 11] = [
    fixed(0.0, 0.0, 13_859, 0),
    fixed(0.0, 10.0, 10_001, 0),
    fixed(0.0, 50.0, 10_001, 0),
    fixed(0.0, 100.0, 10_015, 0),
    fixed(0.1, 0.0, 10_002, 0),
    fixed(0.1, 10.0, 10_001, 0),
    fixed(0.1, 50.0, 10_037, 0),
    fixed(0.1, 100.0, 21_645, 0),
    measured(PublishedNetwork::Ethernet, 10_004, 1),
    measured(PublishedNetwork::ShortRange, 10_155, 15),
    measured(PublishedNetwork::LongRange, 17_394, 40),
];

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_static_row_of_both_tables_has_its_cells_and_every_name_is_its_own() {
        let base = Setup::default();
        let published = published_cells(&base, DelayLaw::Constant);
        // Per scenario 4 rows without loss and 4 with, the latter twice, and 2 over a radio; then the
        // variants.
        assert_eq!(published.len(), 2 * (4 + 8 + 2) + 4);
        let mechanisms = mechanism_cells(&base);
        assert_eq!(mechanisms.len(), 13 * 4);
        let cells = published.iter().chain(&mechanisms);
        let names: BTreeSet<String> = cells.clone().map(|cell| cell.id.to_string()).collect();
        assert_eq!(names.len(), published.len() + mechanisms.len());
        for cell in cells {
            assert_eq!(cell.setup.check(), Ok(()), "{}", cell.id);
        }
    }

    #[test]
    fn each_safe_cell_demands_no_collision_at_all() {
        for cell in mechanism_cells(&Setup::default()) {
            let is_safe = cell.setup.coordinator.mode == CoordinatorMode::Safe;
            assert_eq!(cell.demand == Demand::NoneAtAll, is_safe);
        }
    }
}

#[cfg(test)]
mod published_tests {
    use super::*;

    #[test]
    fn the_counts_give_the_printed_probabilities() {
        // The paper's last column, per 1000, where it is not zero.
        let printed = [
            (&HARBOR[3], 0.499_102),
            (&HARBOR[7], 1.789_087),
            (&HARBOR[9], 0.903_867),
            (&HARBOR[10], 2.299_080),
            (&WAREHOUSE[8], 0.099_960),
            (&WAREHOUSE[9], 1.477_105),
            (&WAREHOUSE[10], 2.299_644),
        ];
        for (row, expected) in printed {
            let ratio = 1e3 * row.collisions as f64 / row.sections as f64;
            assert!((ratio - expected).abs() < 1e-6, "{row:?}: {ratio}");
        }
    }
}
