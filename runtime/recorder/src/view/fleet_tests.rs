//! Tests of [`super`]: two robots of the smallest world, told of by their messages alone.

use super::*;
use bytemuck::Zeroable;
use hil_core::message::Message;
use hil_fleet::messages::{Header, Mission, Truth, TruthKind};
use serde_json::json;
use std::thread::sleep;
use std::time::{Duration, Instant};

const S: i64 = 1_000_000_000;

/// A view of the scenario with its ground made.
fn view() -> (FleetView, Value) {
    let mut view = FleetView::new(&json!({ "world": { "scenario": "crossing" } }));
    let deadline = Instant::now() + Duration::from_mins(1);
    loop {
        if let Some(map) = view.new_map().map(|map| json!(map)) {
            return (view, map);
        }
        assert!(view.problem.is_none() && Instant::now() < deadline);
        sleep(Duration::from_millis(5));
    }
}

fn header(robot_id: u32) -> Header {
    Header {
        robot_id,
        mission_id: 1,
        ..Header::default()
    }
}

fn hear(view: &mut FleetView, message: &str, payload: &[u8], at_ns: i64) {
    if let Some(told) = Told::of("fleet/any", message, payload) {
        view.take(&told, at_ns, 0);
    }
}

fn tell(view: &mut FleetView, robot: u32, [x_m, y_m]: [f64; 2], index: i32, at_ns: i64) {
    let mission = Mission {
        header: header(robot),
        path_id: 2 * robot,
        ..Mission::default()
    };
    let state = State {
        header: header(robot),
        x_m,
        y_m,
        heading_rad: f64::from(robot) * core::f64::consts::FRAC_PI_2,
        path_index: index,
        authority_index: index.saturating_add(10),
        phase: Phase::Driving as u8,
        ..State::default()
    };
    hear(view, Mission::NAME, bytemuck::bytes_of(&mission), at_ns);
    hear(view, State::NAME, bytemuck::bytes_of(&state), at_ns);
}

#[test]
fn a_robot_is_shown_on_its_path_with_what_it_was_granted() {
    let (mut view, map) = view();
    assert_eq!(map["footprint"], json!({ "length_m": 2.0, "width_m": 0.5 }));
    assert_eq!(
        (&map["robot_count"], &map["scenario"]),
        (&json!(2), &json!("crossing"))
    );
    assert_eq!(map["conflict_areas"].as_array().map(Vec::len), Some(1));
    tell(&mut view, 0, [-20.0, 0.0], 3, 5 * S);
    let picture = json!(view.picture(7 * S, 4 * S));
    let robot = &picture["robots"][0];
    assert_eq!(
        (&picture["at_s"], &robot["age_s"]),
        (&json!(3.0), &json!(2.0))
    );
    assert_eq!(
        (&robot["is_stale"], &robot["is_waiting"]),
        (&json!(true), &json!(true))
    );
    assert_eq!(
        (&robot["path_index"], &robot["granted_index"]),
        (&json!(3), &json!(13))
    );
    assert_eq!(
        (&robot["path"], &robot["phase"]),
        (&json!(0), &json!("driving"))
    );
    let (ahead, granted) = (&robot["ahead"], &robot["granted"]);
    assert_eq!(ahead[0], granted[0]);
    assert!(ahead.as_array().unwrap().len() > 2 && granted.as_array().unwrap().len() > 2);
    assert_eq!(
        (&picture["basis"], &picture["collision_count"]),
        (&json!("states"), &json!(0))
    );
}

#[test]
fn robots_that_report_the_same_place_collide_once_until_they_part() {
    let (mut view, _) = view();
    let meet = |view: &mut FleetView, x_m: f64, at_ns: i64| {
        tell(view, 0, [x_m, 0.0], 66, at_ns);
        tell(view, 1, [0.0, 0.0], 66, at_ns);
        json!(view.picture(at_ns, 0))["collision_count"].clone()
    };
    let counts = [0.0, 0.1, 9.0, 0.0].map(|x_m| meet(&mut view, x_m, S));
    assert_eq!(counts, [1, 1, 1, 2]);
    let picture = json!(view.picture(S, 0));
    assert_eq!(picture["collisions"][0]["robots"], json!([0, 1]));
    assert_eq!(picture["collisions"][0]["basis"], "states");
    assert_eq!(picture["sections"][0]["inside"], json!([0, 1]));
}

#[test]
fn the_referee_judges_where_the_truth_is_recorded() {
    let (mut view, _) = view();
    for robot in [0, 1] {
        let truth = Truth {
            at_ns: 0,
            robot_id: robot,
            mission_id: 1,
            path_id: 2 * robot,
            // 20 m from the start is where the two ways cross.
            travelled_m: 16.0,
            speed_mps: 2.0,
            kind: TruthKind::MissionStarted as u32,
            ..Truth::zeroed()
        };
        hear(&mut view, Truth::NAME, bytemuck::bytes_of(&truth), 0);
    }
    let early = json!(view.picture(S / 2, 0));
    assert_eq!(
        (&early["basis"], &early["collision_count"]),
        (&json!("truth"), &json!(0))
    );
    let late = json!(view.picture(3 * S, 0));
    assert_ne!(late["collision_count"], 0);
    let at_s = late["collisions"][0]["at_s"].as_f64().unwrap();
    // Both reach the other's side after 2.75 m of 4 m, at 2 m/s.
    assert!((1.3..1.5).contains(&at_s), "{at_s}");
}

#[test]
fn nonsense_is_not_shown() {
    let (mut view, _) = view();
    tell(&mut view, 0, [f64::NAN, 0.0], 3, 0);
    hear(&mut view, State::NAME, &[1, 2, 3], 0);
    assert_eq!(json!(view.picture(0, 0))["robots"], json!([]));
    tell(&mut view, 0, [0.0, 0.0], i32::MAX, 0);
    assert_eq!(
        json!(view.picture(0, 0))["robots"].as_array().map(Vec::len),
        Some(1)
    );
}
