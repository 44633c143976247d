//! A fleet as a scene: what `/live/fleet` and `/live/map` say, drawn by the live page's rules
//! (`page/fleet.js`). Heights are for the eye; no message carries any.

use foxglove::messages::{
    CubePrimitive, SceneEntity, SceneUpdate, Timestamp, TriangleListPrimitive, Vector3,
};
use serde_json::Value;

use super::entire;
use super::shapes::{
    BAD, FAINT, LIGHT, Paint, SERIES, STONE, ball, color, entity, filled, lifted, line, list,
    strokes, text, word,
};
use crate::topics::{UNTURNED, pose};

/// Height of a vehicle, metres.
const HEIGHT_M: f64 = 0.4;
/// Height of what stands in the way, metres.
const OBSTACLE_HEIGHT_M: f64 = 1.0;
/// Above the ground, so that what lies on it does not flicker with it, metres.
const SECTION_M: f64 = 0.01;
const WAY_M: f64 = 0.03;
const MARK_M: f64 = 0.05;
/// So long a collision is shown as new, seconds.
const FRESH_S: f64 = 5.0;

/// Length and width of a vehicle, metres.
type Size = [f64; 2];

/// What moves, from `/live/fleet`; `size` is that of the vehicles.
pub(crate) fn moving(fleet: &Value, size: Size, at: Timestamp) -> SceneUpdate {
    let sections = list(&fleet["sections"]).filter_map(|one| section(one, at));
    let robots = list(&fleet["robots"]).filter_map(|one| robot(one, size, at));
    let mut entities: Vec<SceneEntity> = sections.chain(robots).collect();
    let now_s = fleet["at_s"].as_f64().unwrap_or(0.0);
    for (index, hit) in list(&fleet["collisions"]).enumerate() {
        entities.extend(collision(hit, index, now_s, at));
    }
    entire(entities, at)
}

/// What does not move, from `/live/map`, for each of its fleets.
pub(crate) fn ground(map: &Value, at: Timestamp) -> SceneUpdate {
    let fleets = map["fleet_count"].as_u64().unwrap_or(1).max(1);
    let grounds = (0..fleets).filter_map(|fleet| ground_of(map, fleet, at));
    entire(grounds.collect(), at)
}

/// The frame of a fleet's ground: each fleet has one to itself.
fn frame(fleet: u64) -> String {
    match fleet {
        0 => "map".to_owned(),
        fleet => format!("map_{fleet}"),
    }
}

fn of_fleet(fleet: u64, id: &str, at: Timestamp) -> SceneEntity {
    entity(frame(fleet), format!("fleet {fleet} {id}"), at)
}

fn points(value: &Value) -> Vec<[f64; 2]> {
    let point = |one: &Value| Some([one[0].as_f64()?, one[1].as_f64()?]);
    list(value).filter_map(point).collect()
}

/// The colour of the robot with this number.
fn series(id: u64) -> Paint {
    SERIES[usize::try_from(id % 7).unwrap_or(0)]
}

fn robot(one: &Value, [length, width]: Size, at: Timestamp) -> Option<SceneEntity> {
    let (fleet, id) = (one["fleet"].as_u64()?, one["id"].as_u64()?);
    let (x, y) = (one["x_m"].as_f64()?, one["y_m"].as_f64()?);
    let heading = one["heading_rad"].as_f64()?;
    let is_stale = one["is_stale"].as_bool()?;
    let paint = if is_stale { FAINT } else { series(id) };
    let alpha = if is_stale { 0.35 } else { 1.0 };
    let (half_sine, half_cosine) = (heading / 2.0).sin_cos();
    let turned = [0.0, 0.0, half_sine, half_cosine];
    let mut entity = of_fleet(fleet, &format!("robot {id}"), at);
    entity.cubes = vec![CubePrimitive {
        pose: Some(pose([x, y, HEIGHT_M / 2.0], turned)),
        size: Some(Vector3 {
            x: length,
            y: width,
            z: HEIGHT_M,
        }),
        color: Some(color(paint, alpha)),
    }];
    // The bow: a light wedge at the end that goes first.
    let bow = [[0.44, 0.0], [0.27, 0.3], [0.27, -0.3]].map(|[along, across]| {
        let above = HEIGHT_M + 0.01;
        lifted([along * length, across * width], above)
    });
    entity.triangles = vec![TriangleListPrimitive {
        pose: Some(pose([x, y, 0.0], turned)),
        points: bow.to_vec(),
        color: Some(color(if is_stale { FAINT } else { LIGHT }, 0.85)),
        ..TriangleListPrimitive::default()
    }];
    for (way, thickness, alpha) in [("ahead", 0.05, 0.6), ("granted", 0.14, 0.5)] {
        let way = points(&one[way]);
        if way.len() > 1 {
            let way = way.into_iter().map(|point| lifted(point, WAY_M)).collect();
            let color = color(paint, alpha);
            entity.lines.push(line(way, thickness, false, color));
        }
    }
    let age = one["age_s"].as_f64().filter(|_| is_stale);
    let label = age.map_or_else(|| id.to_string(), |age| format!("{id} · {age:.1} s"));
    let above = [x, y, 2.0 * HEIGHT_M];
    entity.texts = vec![text(label, above, 0.7 * width, color(paint, 1.0))];
    entity.metadata = vec![word("phase", one["phase"].as_str().unwrap_or_default())];
    let waits = one["is_waiting"].as_bool().unwrap_or(false);
    entity.metadata.push(word("waits", waits));
    Some(entity)
}

/// Coloured by who may pass.
fn section(one: &Value, at: Timestamp) -> Option<SceneEntity> {
    let mut entity = of_fleet(
        one["fleet"].as_u64()?,
        &format!("section {}", one["id"].as_str()?),
        at,
    );
    let may_pass: Vec<u64> = list(&one["may_pass"]).filter_map(Value::as_u64).collect();
    let is_contested = one["is_contested"].as_bool()?;
    let paint = match may_pass.first() {
        _ if is_contested => BAD,
        None => FAINT,
        Some(id) => series(*id),
    };
    let [inside_alpha, edge_alpha] = if may_pass.is_empty() {
        [0.08, 0.5]
    } else {
        [0.26, 0.9]
    };
    let is_inside = list(&one["inside"]).next().is_some();
    let edge_m = if is_inside { 0.1 } else { 0.05 };
    let polygon = points(&one["polygon"]);
    entity.triangles = filled(&polygon, SECTION_M, color(paint, inside_alpha))
        .into_iter()
        .collect();
    let corners = polygon
        .into_iter()
        .map(|point| lifted(point, 2.0 * SECTION_M));
    let edge = line(corners.collect(), edge_m, true, color(paint, edge_alpha));
    entity.lines = vec![edge];
    let words = ["robots", "may_pass", "inside"].map(|key| word(key, &one[key]));
    entity.metadata = words.to_vec();
    entity.metadata.push(word("is_contested", is_contested));
    Some(entity)
}

fn collision(hit: &Value, index: usize, now_s: f64, at: Timestamp) -> Option<SceneEntity> {
    let here = [hit["x_m"].as_f64()?, hit["y_m"].as_f64()?];
    let is_fresh = now_s - hit["at_s"].as_f64()? < FRESH_S;
    let (arm_m, alpha) = if is_fresh { (0.8, 1.0) } else { (0.4, 0.45) };
    let mut entity = of_fleet(hit["fleet"].as_u64()?, &format!("collision {index}"), at);
    let corner = |x: f64, y: f64| lifted([here[0] + x * arm_m, here[1] + y * arm_m], MARK_M);
    let cross = vec![
        corner(-1.0, -1.0),
        corner(1.0, 1.0),
        corner(-1.0, 1.0),
        corner(1.0, -1.0),
    ];
    entity.lines = vec![strokes(cross, 0.12, color(BAD, alpha))];
    if is_fresh {
        let above = [here[0], here[1], HEIGHT_M];
        entity.spheres = vec![ball(above, 1.2, color(BAD, 0.25))];
    }
    let words = ["robots", "kind", "basis"].map(|key| word(key, &hit[key]));
    entity.metadata = words.to_vec();
    Some(entity)
}

fn ground_of(map: &Value, fleet: u64, at: Timestamp) -> Option<SceneEntity> {
    let corners = |area: &Value| -> Option<[[f64; 2]; 2]> {
        let number = |key: &str| area[key].as_f64();
        let low = [number("x_min_m")?, number("y_min_m")?];
        Some([low, [number("x_max_m")?, number("y_max_m")?]])
    };
    let mut entity = of_fleet(fleet, "ground", at);
    entity.lifetime = None;
    let [low, high] = corners(&map["bounds"])?;
    let edge = [low, [high[0], low[1]], high, [low[0], high[1]]];
    let edge = edge.map(|point| lifted(point, 0.0)).to_vec();
    entity.lines = vec![line(edge, 0.06, true, color(FAINT, 0.8))];
    for area in list(&map["conflict_areas"]) {
        let area = filled(&points(area), 0.0, color(FAINT, 0.08));
        entity.triangles.extend(area);
    }
    for [low, high] in list(&map["obstacles"]).filter_map(corners) {
        let [x, y] = [0, 1].map(|axis| 0.5 * (low[axis] + high[axis]));
        entity.cubes.push(CubePrimitive {
            pose: Some(pose([x, y, OBSTACLE_HEIGHT_M / 2.0], UNTURNED)),
            size: Some(Vector3 {
                x: high[0] - low[0],
                y: high[1] - low[1],
                z: OBSTACLE_HEIGHT_M,
            }),
            color: Some(color(STONE, 0.7)),
        });
    }
    let vehicle = &map["footprint"];
    let (length, width) = (vehicle["length_m"].as_f64()?, vehicle["width_m"].as_f64()?);
    for bay in list(&map["bays"]) {
        let (x, y) = (bay["x_m"].as_f64()?, bay["y_m"].as_f64()?);
        let (sine, cosine) = bay["heading_rad"].as_f64()?.sin_cos();
        let corner = |along: f64, across: f64| {
            let (along, across) = (along * 0.625 * length, across * 0.675 * width);
            let x = x + along * cosine - across * sine;
            lifted([x, y + along * sine + across * cosine], SECTION_M)
        };
        let corners = vec![
            corner(-1.0, -1.0),
            corner(1.0, -1.0),
            corner(1.0, 1.0),
            corner(-1.0, 1.0),
        ];
        let edge = line(corners, 0.03, true, color(FAINT, 0.55));
        entity.lines.push(edge);
        let name = bay["id"].as_u64()?.to_string();
        let above = [x, y, MARK_M];
        entity
            .texts
            .push(text(name, above, 0.5 * width, color(FAINT, 0.8)));
    }
    Some(entity)
}
