//! How many robot-seconds and critical sections of case study 1 one processor computes in a
//! second, and how that grows with the fleet at constant density: every 7 robots bring a yard or
//! hall of their own. Not a test: it asserts nothing about time.
//!
//! `cargo bench -p hil-benches --bench fleet_throughput [-- --rounds 5 --robot-seconds 20000]`, one
//! thread on processor 0, a few minutes. Processor time of the thread is measured, not time on the wall, and sizes take
//! turns round by round, because neighbours on the machine change by the minute. Before the first
//! round each world is driven until the sections of its paths are known; that time is printed
//! apart.
#![allow(clippy::print_stdout, reason = "a bench prints its result")]
#![allow(
    clippy::unwrap_used,
    reason = "a bench that cannot start may stop with a backtrace"
)]

use hil_benches::{HostFacts, pin_to_cpu};
use hil_core::time::Instant;
use hil_fleet::coordinator::parameters::CoordinatorMode;
use hil_fleet::experiment::{Experiment, Links, Setup, StatusPath};
use hil_fleet::messages::MessageOrder;
use hil_fleet::robot::TrackerKind;
use hil_fleet::scenario::{Scenario, Scene, WorldParameters};
use nix::time::{ClockId, clock_gettime};

const ROBOTS: [u32; 6] = [7, 14, 28, 56, 112, 224];
const SCENARIOS: [Scenario; 2] = [Scenario::Harbor, Scenario::Warehouse];
/// Robot-seconds of one case in one round, whatever the number of robots, unless the command line says.
const ROBOT_SECONDS: i64 = 200_000;
const ROUNDS: usize = 3;

/// What is driven in virtual time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Variant {
    /// As the original's static model: stepped tracker, status past the network.
    Original,
    /// Legacy coordinator, exact tracker, status over the network.
    Legacy,
    /// Safe coordinator, exact tracker, status over the network.
    Safe,
}

const VARIANTS: [Variant; 3] = [Variant::Original, Variant::Legacy, Variant::Safe];

impl Variant {
    const fn name(self) -> &'static str {
        match self {
            Self::Original => "original",
            Self::Legacy => "legacy",
            Self::Safe => "safe",
        }
    }

    fn setup(self, robots: u32) -> Setup {
        let mut setup = Setup::default();
        // One mission per control period would starve a large fleet.
        setup.coordinator.missions_per_cycle = robots.div_ceil(7);
        match self {
            Self::Original => {
                setup.robot.tracker = TrackerKind::LegacyRk4;
                setup.links = Links {
                    status_path: StatusPath::Bypass,
                    ..Links::default()
                };
            }
            Self::Legacy => {}
            Self::Safe => {
                setup.coordinator.mode = CoordinatorMode::Safe;
                setup.coordinator.message_order = MessageOrder::Strict;
            }
        }
        setup
    }
}

/// One fleet size of one variant in one scenario.
struct Case {
    scenario: Scenario,
    variant: Variant,
    robots: u32,
    scene: Scene,
    rounds: Vec<Round>,
}

/// One measurement.
#[derive(Debug, Clone, Copy)]
struct Round {
    processor_s: f64,
    robot_s: f64,
    sections: u64,
}

impl Case {
    /// Drives the fleet for so many robot-seconds.
    fn measure(&self, seed: u64, robot_seconds: i64) -> Round {
        let setup = self.variant.setup(self.robots);
        let mut experiment = Experiment::new(&self.scene, &setup, seed).unwrap();
        let end_ns = robot_seconds * 1_000_000_000 / i64::from(self.robots);
        let before_s = processor_s();
        experiment.run_until(Instant::from_ns(end_ns), &mut ());
        let after_s = processor_s();
        let tally = experiment.tally();
        Round {
            processor_s: after_s - before_s,
            robot_s: tally.robot_s,
            sections: tally.section_count(),
        }
    }

    /// Robot-seconds per processor second: lower quartile, median, upper quartile of the rounds.
    fn robot_seconds_per_s(&self) -> [f64; 3] {
        quartiles(
            self.rounds
                .iter()
                .map(|round| round.robot_s / round.processor_s),
        )
    }

    fn sections_per_s(&self) -> [f64; 3] {
        let rates = self.rounds.iter();
        quartiles(rates.map(|round| round.sections as f64 / round.processor_s))
    }

    fn processor_s_per_s(&self) -> f64 {
        f64::from(self.robots) / self.robot_seconds_per_s()[1]
    }
}

fn quartiles(values: impl Iterator<Item = f64>) -> [f64; 3] {
    let mut values: Vec<_> = values.collect();
    values.sort_by(f64::total_cmp);
    let last = values.len() - 1;
    [last / 4, last / 2, last - last / 4].map(|rank| values[rank])
}

/// Processor time of this thread.
fn processor_s() -> f64 {
    let time = clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).unwrap();
    time.tv_sec() as f64 + time.tv_nsec() as f64 * 1e-9
}

/// The exponent `k` of `time = c n^k`, by least squares on logarithms.
fn exponent(points: &[(f64, f64)]) -> f64 {
    let logs: Vec<_> = points.iter().map(|(n, time)| (n.ln(), time.ln())).collect();
    let count = logs.len() as f64;
    let mean = |pick: fn(&(f64, f64)) -> f64| logs.iter().map(pick).sum::<f64>() / count;
    let (x_mean, y_mean) = (mean(|log| log.0), mean(|log| log.1));
    let product = |(x, y): &(f64, f64)| (x - x_mean) * (y - y_mean);
    let square = |(x, _): &(f64, f64)| (x - x_mean).powi(2);
    logs.iter().map(product).sum::<f64>() / logs.iter().map(square).sum::<f64>()
}

fn name_of(scenario: Scenario) -> &'static str {
    if scenario == Scenario::Harbor {
        "harbor"
    } else {
        "warehouse"
    }
}

/// Builds the worlds and drives each once, so that no round pays for planning or sections.
fn cases(robot_seconds: i64) -> Vec<Case> {
    let mut cases = Vec::new();
    for scenario in SCENARIOS {
        for robots in ROBOTS {
            let before_s = processor_s();
            let world = WorldParameters {
                scenario,
                robots,
                ..WorldParameters::default()
            };
            let scene = world.build().unwrap();
            let built_s = processor_s() - before_s;
            let start = cases.len();
            cases.extend(VARIANTS.map(|variant| Case {
                scenario,
                variant,
                robots,
                scene: scene.clone(),
                rounds: Vec::new(),
            }));
            let warm_up: f64 = cases[start..]
                .iter()
                .map(|case| case.measure(1_000, robot_seconds).processor_s)
                .sum();
            println!(
                "{} with {robots} robots: planned in {built_s:.2} s, first drives {warm_up:.2} s",
                name_of(scenario)
            );
        }
    }
    cases
}

fn main() {
    let given = |name: &str| {
        let mut arguments = std::env::args().skip_while(|argument| argument != name);
        arguments.nth(1).map(|text| text.parse::<i64>().unwrap())
    };
    let rounds = given("--rounds").map_or(ROUNDS, |rounds| usize::try_from(rounds).unwrap());
    let robot_seconds = given("--robot-seconds").unwrap_or(ROBOT_SECONDS);
    // Read first: a pinned process may use one processor only.
    let mut host = HostFacts::read("");
    host.pinning = match pin_to_cpu(0) {
        Ok(()) => "one thread on cpu 0".to_owned(),
        Err(error) => format!("one thread, not pinned: {error}"),
    };
    println!(
        "{}",
        serde_json::json!({"bench": "fleet_throughput", "host": host.to_json()})
    );
    let mut cases = cases(robot_seconds);
    for round in 0..rounds {
        for case in &mut cases {
            let measured = case.measure(round as u64, robot_seconds);
            case.rounds.push(measured);
        }
    }
    print(&cases, &host);
}

fn print(cases: &[Case], host: &HostFacts) {
    for case in cases {
        println!(
            "{}",
            serde_json::json!({
                "bench": "fleet_throughput",
                "scenario": name_of(case.scenario),
                "variant": case.variant.name(),
                "robots": case.robots,
                "rounds": case.rounds.len(),
                "robot_seconds_per_s": case.robot_seconds_per_s(),
                "sections_per_s": case.sections_per_s(),
            })
        );
    }
    println!(
        "\nper processor second, median (quartiles); load {} at the start",
        host.load_average
    );
    println!(
        "{:<10} {:<9} {:>6}  {:>28}  {:>22}",
        "scenario", "variant", "robots", "robot-seconds", "critical sections"
    );
    for scenario in SCENARIOS {
        for variant in VARIANTS {
            let of = |case: &&Case| case.scenario == scenario && case.variant == variant;
            let mut points = Vec::new();
            for case in cases.iter().filter(of) {
                let [low, median, high] = case.robot_seconds_per_s();
                let [sections_low, sections, sections_high] = case.sections_per_s();
                println!(
                    "{:<10} {:<9} {:>6}  {:>28}  {:>22}",
                    name_of(scenario),
                    variant.name(),
                    case.robots,
                    format!("{median:.0} ({low:.0}..{high:.0})"),
                    format!("{sections:.0} ({sections_low:.0}..{sections_high:.0})"),
                );
                points.push((f64::from(case.robots), case.processor_s_per_s()));
            }
            println!(
                "{:<10} {:<9} time grows as n^{:.2}",
                name_of(scenario),
                variant.name(),
                exponent(&points)
            );
        }
    }
}
