//! Faulty worlds: whatever is wrong with a map, the error names its key and points at its line,
//! the one marked `#!`.

use super::*;

/// A hall of its own: two bays, one obstacle above the way between them.
const HALL: &str = r#"version = 1
name = "hall"
case.name = "fleet"
processes.controller.role = "controller"
processes.robots.role = "robots"
[case.parameters.world]
scenario = "custom"
robots = 1
speed_max_mps = 2.0
bounds = { x_min_m = 0.0, y_min_m = 0.0, x_max_m = 40.0, y_max_m = 20.0 }
obstacles = [
  { x_min_m = 15.0, y_min_m = 14.0, x_max_m = 25.0, y_max_m = 19.0 },
]
[[case.parameters.world.bays]]
x_m = 3.0
y_m = 5.0
side = "left"
[[case.parameters.world.bays]]
x_m = 37.0
y_m = 5.0
side = "right"
"#;

/// What stands in the hall, what is put in its place, the key of the one error, and its words.
struct Faulty(&'static str, &'static str, &'static str, &'static str);

const FAULTY: &[Faulty] = &[
    Faulty(
        "processes.controller.role = \"controller\"",
        "processes.controller.role = \"controller\"\nprocesses.controller.on_exit = \"restart\" #!",
        "processes.controller.on_exit",
        "started anew",
    ),
    Faulty(
        "robots = 1",
        "robot = 1 #!",
        "case.parameters.world.robot",
        "did you mean `robots`?",
    ),
    Faulty(
        "scenario = \"custom\"",
        "scenario = \"kitchen\" #!",
        "case.parameters.world.scenario",
        "kitchen",
    ),
    Faulty(
        "speed_max_mps = 2.0",
        "speed_max_mps = 0.0 #!",
        "case.parameters.world.speed_max_mps",
        "0 is outside 0.01 to 100",
    ),
    Faulty(
        "[[case.parameters.world.bays]]\nx_m = 3.0",
        "[[case.parameters.world.bays]]\nx_m = nan #!",
        "case.parameters.world.bays[0].x_m",
        "the real numbers",
    ),
    Faulty(
        "[[case.parameters.world.bays]]\nx_m = 37.0",
        "[[case.parameters.world.bays]] #!\nx_m = 3.5\ny_m = 5.2\nside = \"left\"\n\
         [[case.parameters.world.bays]]\nx_m = 37.0",
        "case.parameters.world.bays[1]",
        "overlaps bay 0 when both are taken",
    ),
    Faulty(
        "  { x_min_m = 15.0, y_min_m = 14.0, x_max_m = 25.0, y_max_m = 19.0 },",
        "  { x_min_m = 25.0, y_min_m = 14.0, x_max_m = 15.0, y_max_m = 19.0 }, #!",
        "case.parameters.world.obstacles[0]",
        "",
    ),
    // A wall from edge to edge.
    Faulty(
        "  { x_min_m = 15.0, y_min_m = 14.0, x_max_m = 25.0, y_max_m = 19.0 },\n]\n\
         [[case.parameters.world.bays]]\n",
        "  { x_min_m = 15.0, y_min_m = 0.0, x_max_m = 25.0, y_max_m = 20.0 },\n]\n\
         [[case.parameters.world.bays]] #!\n",
        "case.parameters.world.bays[0]",
        "has no path to bay 1",
    ),
    // A path that someone drew through the obstacle.
    Faulty(
        "scenario = \"custom\"",
        "scenario = \"custom\"\npaths = [\n\
         { from = 0, to = 1, poses = [ #!\n\
         { x_m = 3.0, y_m = 5.0, heading_rad = 0.0 },\n\
         { x_m = 20.0, y_m = 16.0, heading_rad = 0.0 },\n\
         { x_m = 37.0, y_m = 5.0, heading_rad = 0.0 } ] } ]",
        "case.parameters.world.paths[0]",
        "",
    ),
];

#[test]
fn every_fault_of_a_world_names_its_key_and_line() {
    let topology = parse_good(HALL);
    assert_eq!(topology.channel("fleet/truth").unwrap().to, None);
    for Faulty(good, wrong, key, says) in FAULTY {
        assert_eq!(HALL.matches(good).count(), 1, "{good}");
        let text = HALL.replacen(good, wrong, 1);
        let errors = parse("hall.toml", &text, &[], &known()).expect_err(wrong);
        let [error] = errors.errors() else {
            panic!("{wrong}: one fault, several errors:\n{errors}");
        };
        assert_eq!(error.key, *key, "{errors}");
        assert!(errors.to_string().contains(says), "{errors}");
        let line = text.lines().position(|line| line.contains("#!")).unwrap() + 1;
        let location = error.location.as_ref().unwrap();
        assert_eq!(location.line, line, "{errors}");
    }
}

#[test]
fn a_safe_coordinator_may_be_restarted_and_robots_may_not() {
    let restarted = |process: &str| {
        let role = format!("processes.{process}.role = ");
        let anew = format!("processes.{process}.on_exit = \"restart\"\n{role}");
        let safe = "case.parameters.coordinator.mode=\"safe\"".to_owned();
        parse(
            "hall.toml",
            &HALL.replacen(&role, &anew, 1),
            &[safe],
            &known(),
        )
    };
    let topology = restarted("controller").unwrap();
    let controller = topology.process("controller").unwrap();
    assert_eq!(controller.restarts.on_exit(), OnExit::Restart { limit: 3 });
    let errors = restarted("robots").unwrap_err();
    assert_eq!(
        errors.errors()[0].key,
        "processes.robots.on_exit",
        "{errors}"
    );
}

/// A shipped file in a world that takes no planning: what it says of the rest is what counts.
fn load_small(name: &str) -> Topology {
    load_shipped(name, &["case.parameters.world.scenario=crossing"])
}

#[test]
fn the_shipped_fleets_mean_the_same_written_out_and_differ_in_their_hosts_alone() {
    let local = load_small("fleet-warehouse.toml");
    let harbor = load_small("fleet-harbor.toml");
    let split = load_small("fleet-split.toml");
    let emulated = load_small("fleet-emulated.toml");
    for topology in [&local, &harbor, &split, &emulated] {
        let again = parse_good(&topology.to_toml());
        assert_eq!(again, *topology);
        let state = topology.channel("fleet/state").unwrap();
        assert!(state.depth >= 128, "{}", state.depth);
    }
    for process in ["controller", "robots"] {
        let card = |topology: &Topology| topology.role_spec(process);
        assert_eq!(card(&split), card(&emulated));
        assert_eq!(card(&local), card(&harbor));
    }
    assert_eq!(local.crossings().count(), 0);
    let links: Vec<_> = split
        .crossings()
        .map(|crossing| (crossing.channel.name.clone(), crossing.link.name.clone()))
        .collect();
    let expected = [
        ("fleet/authority", "commands"),
        ("fleet/mission", "commands"),
        ("fleet/state", "states"),
    ];
    assert_eq!(links, expected.map(|(a, b)| (a.to_owned(), b.to_owned())));
}

#[test]
fn the_emulated_fleet_loses_commands_and_nothing_else() {
    let emulated = load_small("fleet-emulated.toml");
    let ratios: Vec<_> = emulated
        .crossings()
        .map(|crossing| crossing.spec.unwrap().loss.loss_ratio())
        .collect();
    assert_eq!(ratios.len(), 3);
    for (ratio, expected) in ratios.iter().zip([0.1, 0.1, 0.0]) {
        assert!((ratio - expected).abs() < f64::EPSILON);
    }
}

#[test]
fn a_link_for_the_truth_of_the_robots_is_refused() {
    let overrides = [
        "case.parameters.world.scenario=crossing".to_owned(),
        "channels.\"fleet/truth\".link=states".to_owned(),
    ];
    let errors = load(&shipped("fleet-split.toml"), &overrides, &known()).unwrap_err();
    let [error] = errors.errors() else {
        panic!("{errors}");
    };
    assert_eq!(error.key, "channels.\"fleet/truth\".link");
    assert!(
        errors.to_string().contains("only go to the run's record"),
        "{errors}"
    );
}
