//! Tests of whole worlds: well-formed maps, bad input by name, equal worlds from equal input.

use super::*;
use crate::geometry::Bounds;
use crate::scenario::{BayParameters, PathParameters, Scenario};
use hil_core::options::Rows;

fn built_in(scenario: Scenario, robots: u32) -> Scene {
    let parameters = WorldParameters {
        scenario,
        robots,
        ..WorldParameters::default()
    };
    parameters.build().unwrap()
}

fn assert_well_formed(scene: &Scene) {
    let world = &scene.world;
    let radius_m = world.vehicle.footprint.radius_m();
    for route in &world.routes {
        let path = world.path(route.path);
        let (first, last) = (path.poses()[0], path.poses()[path.last_index()]);
        assert_eq!(
            (first, last),
            (world.bays[route.from].pose, world.bays[route.to].pose)
        );
        let far = |pose: &Pose| first.distance_m(pose) > world.vehicle.footprint.length_m;
        let straight = path.poses().iter().take_while(|pose| !far(pose));
        for pose in straight {
            assert!(
                (pose.heading_rad - first.heading_rad).abs() < 1e-12,
                "{route:?}"
            );
        }
        for (bay, parked) in world.bays.iter().enumerate() {
            if bay == route.from || bay == route.to {
                continue;
            }
            let covered = world.guarded_sections.footprint().at(&parked.pose);
            let near = |pose: &&Pose| pose.distance_m(&parked.pose) < 2.2 * radius_m;
            for pose in path.poses().iter().filter(near) {
                let passing = world.guarded_sections.footprint().at(pose);
                assert!(!passing.overlaps(&covered), "{route:?} meets bay {bay}");
            }
        }
    }
}

#[test]
fn harbor_and_warehouse_are_well_formed_with_all_routes() {
    for scenario in [Scenario::Harbor, Scenario::Warehouse] {
        let scene = built_in(scenario, 7);
        assert_eq!(scene.world.bays.len(), 14);
        assert_eq!(scene.world.routes.len(), 2 * 49);
        assert_eq!(scene.planning.planned_count, 49);
        assert_eq!(scene.starts, [0, 1, 2, 3, 4, 5, 6]);
        assert_eq!(scene.partners[3], Some(10));
        assert_well_formed(&scene);
    }
}

#[test]
fn a_larger_fleet_gets_a_larger_hall_with_ways_between_its_tiles() {
    let scene = built_in(Scenario::Warehouse, 20);
    assert_eq!(scene.starts.len(), 20);
    assert_eq!(scene.world.bays.len(), 3 * 14);
    assert_well_formed(&scene);
    let is_across = |route: &&Route| route.from / 14 != route.to / 14;
    let across = scene.world.routes.iter().filter(is_across).count();
    assert!(across >= 2 * 2 * 8, "{across}");
    // Paths of tiles that do not touch have nothing in common.
    let path = |tile: usize| scene.world.routes_from(tile * 14)[0].path;
    assert!(scene.world.sections.between(path(0), path(2)).is_empty());
}

#[test]
fn equal_parameters_give_equal_worlds() {
    let hashes = |scene: &Scene| -> Vec<_> {
        let routes = scene.world.routes.iter();
        routes
            .map(|route| (*route, scene.world.path(route.path).hash()))
            .collect()
    };
    let [once, twice] = [(); 2].map(|()| built_in(Scenario::Warehouse, 7));
    assert_eq!(hashes(&once), hashes(&twice));
    assert_eq!(once.planning, twice.planning);
}

/// A yard of 40 m x 20 m with two bays on each side and a block in the middle.
fn yard() -> WorldParameters {
    let bay = |x_m, y_m, side| BayParameters {
        x_m,
        y_m,
        heading_rad: 0.0,
        side,
    };
    WorldParameters {
        scenario: Scenario::Custom,
        turning_radius_m: Some(3.0),
        bounds: Some(Bounds {
            x_min_m: 0.0,
            x_max_m: 40.0,
            y_min_m: 0.0,
            y_max_m: 20.0,
        }),
        obstacles: Rows(vec![Bounds {
            x_min_m: 18.0,
            x_max_m: 22.0,
            y_min_m: 6.0,
            y_max_m: 14.0,
        }]),
        bays: Rows(vec![
            bay(2.0, 5.0, BaySide::Left),
            bay(2.0, 15.0, BaySide::Left),
            bay(38.0, 5.0, BaySide::Right),
            bay(38.0, 15.0, BaySide::Right),
        ]),
        ..WorldParameters::default()
    }
}

#[test]
fn a_number_in_a_row_is_checked_and_named_with_its_index() {
    let key = |change: fn(&mut WorldParameters)| {
        let mut yard = yard();
        yard.paths.0 = vec![PathParameters {
            from: 0,
            to: 2,
            poses: Rows(vec![Pose::new(2.0, 5.0, 0.0), Pose::new(38.0, 5.0, 0.0)]),
        }];
        change(&mut yard);
        yard.check().err().map(|error| error.key)
    };
    assert_eq!(key(|_| ()), None);
    let refused = |change| key(change).unwrap();
    assert_eq!(refused(|yard| yard.bays.0[3].x_m = f64::NAN), "bays[3].x_m");
    let pose = refused(|yard| yard.paths.0[0].poses.0[1].y_m = f64::INFINITY);
    assert_eq!(pose, "paths[0].poses[1].y_m");
    let obstacle = refused(|yard| yard.obstacles.0[0].x_min_m = f64::NAN);
    assert_eq!(obstacle, "obstacles[0].x_min_m");
}

#[test]
fn a_custom_map_is_planned_and_given_paths_are_taken_as_they_are() {
    let scene = yard().build().unwrap();
    assert_eq!(scene.world.routes.len(), 8);
    assert_eq!(scene.starts, [0, 1]);
    assert_well_formed(&scene);
    let mut given = yard();
    given.paths.0 = vec![PathParameters {
        from: 0,
        to: 2,
        poses: Rows(vec![Pose::new(2.0, 5.0, 0.0), Pose::new(38.0, 5.0, 0.0)]),
    }];
    let scene = given.build().unwrap();
    assert_eq!(scene.world.routes.len(), 2);
    assert!((scene.world.path(scene.world.routes[0].path).length_m() - 36.0).abs() < 1e-9);
}

fn check(change: &dyn Fn(&mut WorldParameters), key: &str, words: &str) {
    let mut parameters = yard();
    change(&mut parameters);
    let error = parameters.build().unwrap_err();
    assert_eq!(error.key, key, "{error}");
    assert!(error.problem.contains(words), "{error}");
}

#[test]
fn bays_and_obstacles_that_make_no_world_are_refused_by_name() {
    let wall = Bounds {
        x_min_m: 18.0,
        x_max_m: 22.0,
        y_min_m: 0.0,
        y_max_m: 20.0,
    };
    let bay = "world.bays[1]";
    check(
        &|p| p.obstacles.0[0] = wall,
        "world.bays[0]",
        "no path to bay 2: no path from",
    );
    check(&|p| p.bays.0[1].y_m = 5.5, bay, "overlaps bay 0");
    check(
        &|p| (p.bays.0[1].x_m, p.bays.0[1].y_m) = (20.0, 10.0),
        bay,
        "obstacle 0",
    );
    check(&|p| p.bays.0[1].y_m = 25.0, bay, "edge of the ground");
    check(
        &|p| p.bays.0[1].y_m = f64::NAN,
        "world.bays[1].y_m",
        "not finite",
    );
    check(
        &|p| p.bays.0[0].side = BaySide::Right,
        "world.bays[1]",
        "no path to bay 0",
    );
    check(&|p| p.bays.0.truncate(2), "world.bays", "no right one");
    check(&|p| p.bounds = None, "world.bounds", "missing");
    check(
        &|p| p.obstacles.0[0].x_max_m = f64::NAN,
        "world.obstacles[0].x_max_m",
        "not finite",
    );
    check(
        &|p| p.obstacles.0[0].x_max_m = 10.0,
        "world.obstacles[0]",
        "no area",
    );
}

#[test]
fn numbers_out_of_range_are_refused_by_name() {
    check(
        &|p| p.speed_max_mps = Some(0.0),
        "world.speed_max_mps",
        "0 is outside",
    );
    check(
        &|p| p.acceleration_mps2 = Some(f64::NAN),
        "world.acceleration_mps2",
        "NaN is outside",
    );
    check(
        &|p| p.width_m = Some(-1.0),
        "world.width_m",
        "-1 is outside",
    );
    check(
        &|p| p.length_m = Some(f64::INFINITY),
        "world.length_m",
        "inf is outside",
    );
    check(
        &|p| p.turning_radius_m = Some(0.0),
        "world.turning_radius_m",
        "0 is outside",
    );
    check(
        &|p| p.clearance_m = Some(-0.1),
        "world.clearance_m",
        "-0.1 is outside",
    );
    check(
        &|p| p.path_spacing_m = 0.0,
        "world.path_spacing_m",
        "0 is outside",
    );
    check(&|p| p.robots = 0, "world.robots", "0 is outside");
    check(&|p| p.scenario = Scenario::Harbor, "world.bounds", "custom");
}

#[test]
fn given_paths_that_do_not_fit_the_map_are_refused_by_name() {
    let straight = |from: u32, to: u32, y_m: f64| PathParameters {
        from,
        to,
        poses: Rows(vec![Pose::new(2.0, y_m, 0.0), Pose::new(38.0, y_m, 0.0)]),
    };
    let by = |pose: Pose| {
        let mut path = straight(0, 2, 5.0);
        path.poses.0.insert(1, pose);
        vec![path]
    };
    let path = "world.paths[0]";
    check(
        &|p| p.paths.0 = by(Pose::new(20.0, 7.0, 0.0)),
        path,
        "to obstacle 0",
    );
    check(
        &|p| p.paths.0 = by(Pose::new(f64::NAN, 5.0, 0.0)),
        "world.paths[0].poses[1].x_m",
        "not finite",
    );
    check(
        &|p| p.paths.0 = vec![straight(0, 2, 6.0)],
        path,
        "does not end in bay 0",
    );
    check(
        &|p| p.paths.0 = vec![straight(2, 0, 5.0)],
        path,
        "no left bay",
    );
    check(
        &|p| p.paths.0 = vec![straight(0, 9, 5.0)],
        path,
        "no right bay",
    );
    check(
        &|p| p.paths.0 = vec![straight(0, 2, 5.0); 2],
        "world.paths[1]",
        "again",
    );
}
