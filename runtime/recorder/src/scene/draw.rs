//! What the views of a run show, drawn as the viewers' schema has it, by the live page's rules
//! (`page/fleet.js`, `page/arms.js`). Heights are for the eye; no message carries any.

use foxglove::messages::line_primitive::Type as LineKind;
use foxglove::messages::{
    Color, CylinderPrimitive, Duration, FrameTransform, FrameTransforms, KeyValuePair,
    LinePrimitive, Point3, SceneEntity, SceneEntityDeletion, SceneUpdate, SpherePrimitive,
    TextPrimitive, Timestamp, TriangleListPrimitive, Vector3, scene_entity_deletion,
};
use hil_fleet::geometry::Bounds;
use serde::Serialize;
use serde_json::json;

use crate::topics::{UNTURNED, cube, pose};
use crate::view::arms::{ArmPicture, ArmsPicture, Frame};
use crate::view::collisions::Collision;
use crate::view::fleet::{FleetPicture, RobotPicture};
use crate::view::ground::MapPicture;
use crate::view::sections::{Point, SectionPicture};

/// Red, green, blue.
type Paint = [u8; 3];

/// Colours of robots by number, those of the live page (`page.css`, `--k0` to `--k6`).
const SERIES: [Paint; 7] = [
    [0x00, 0x72, 0xb2],
    [0xd5, 0x5e, 0x00],
    [0x00, 0x9e, 0x73],
    [0xb3, 0x56, 0x8f],
    [0xb0, 0x7d, 0x00],
    [0x3a, 0x9a, 0xd9],
    [0x4b, 0x4f, 0x58],
];
/// What went wrong (`--bad`).
const BAD: Paint = [0xb3, 0x26, 0x1e];
/// What is old, or has no owner (`--faint`).
const FAINT: Paint = [0x5b, 0x64, 0x72];
/// What stands on the ground (`--rule`, darker).
const STONE: Paint = [0xa6, 0xad, 0xb8];
/// Marks on vehicles (`--panel`).
const LIGHT: Paint = [0xff, 0xff, 0xff];

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
/// The frame in which the models place the arms.
const BODY: &str = "body";

/// A whole picture: it takes the place of all that the topic showed before, so that any one message
/// of a file is enough to see the scene.
fn entire(entities: Vec<SceneEntity>, at: Timestamp) -> SceneUpdate {
    SceneUpdate {
        deletions: vec![SceneEntityDeletion {
            timestamp: Some(at),
            r#type: scene_entity_deletion::Type::All.into(),
            id: String::new(),
        }],
        entities,
    }
}

/// What moves of a fleet; `size` is length and width of a vehicle, metres.
pub(super) fn moving(fleet: &FleetPicture, size: [f64; 2], at: Timestamp) -> SceneUpdate {
    let sections = fleet.sections.iter().flatten().map(|one| section(one, at));
    let robots = fleet.robots.iter().map(|one| robot(one, size, at));
    let collisions = fleet.collisions.iter().enumerate();
    let collisions = collisions.map(|(index, hit)| collision(hit, index, fleet.at_s, at));
    entire(sections.chain(robots).chain(collisions).collect(), at)
}

/// What does not move, for each fleet of the map.
pub(super) fn ground(map: &MapPicture, at: Timestamp) -> SceneUpdate {
    let fleets = 0..map.fleet_count.max(1);
    entire(fleets.map(|fleet| ground_of(map, fleet, at)).collect(), at)
}

/// Something of a fleet; the ground of each has a frame to itself.
fn of_fleet(fleet: u32, id: &str, at: Timestamp) -> SceneEntity {
    let frame = match fleet {
        0 => "map".to_owned(),
        fleet => format!("map_{fleet}"),
    };
    entity(frame, format!("fleet {fleet} {id}"), at)
}

/// The colour of the robot with this number.
const fn series(id: u32) -> Paint {
    SERIES[id as usize % SERIES.len()]
}

fn robot(one: &RobotPicture, [length, width]: [f64; 2], at: Timestamp) -> SceneEntity {
    let (x, y) = (one.x_m, one.y_m);
    let (paint, alpha) = if one.is_stale {
        (FAINT, 0.35)
    } else {
        (series(one.id), 1.0)
    };
    let (half_sine, half_cosine) = (one.heading_rad / 2.0).sin_cos();
    let turned = [0.0, 0.0, half_sine, half_cosine];
    let mut entity = of_fleet(one.fleet, &format!("robot {}", one.id), at);
    let color_of_body = color(paint, alpha);
    let size = [length, width, HEIGHT_M];
    entity.cubes = vec![cube([x, y, HEIGHT_M / 2.0], turned, size, color_of_body)];
    // The bow: a light wedge at the end that goes first.
    let bow = [[0.44, 0.0], [0.27, 0.3], [0.27, -0.3]].map(|[along, across]| {
        let above = HEIGHT_M + 0.01;
        lifted([along * length, across * width], above)
    });
    entity.triangles = vec![TriangleListPrimitive {
        pose: Some(pose([x, y, 0.0], turned)),
        points: bow.to_vec(),
        color: Some(color(if one.is_stale { FAINT } else { LIGHT }, 0.85)),
        ..TriangleListPrimitive::default()
    }];
    for (way, thickness, alpha) in [(&one.ahead, 0.05, 0.6), (&one.granted, 0.14, 0.5)] {
        if way.len() > 1 {
            let way = way.iter().map(|point| lifted(*point, WAY_M)).collect();
            let color = color(paint, alpha);
            entity
                .lines
                .push(line(LineKind::LineStrip, way, thickness, color));
        }
    }
    let label = if one.is_stale {
        format!("{} · {:.1} s", one.id, one.age_s)
    } else {
        one.id.to_string()
    };
    let above = [x, y, 2.0 * HEIGHT_M];
    entity.texts = vec![text(label, above, 0.7 * width, color(paint, 1.0))];
    entity.metadata = vec![
        KeyValuePair {
            key: "phase".to_owned(),
            value: one.phase.to_owned(),
        },
        word("waits", one.is_waiting),
    ];
    entity
}

/// Coloured by who may pass.
fn section(one: &SectionPicture, at: Timestamp) -> SceneEntity {
    let mut entity = of_fleet(one.fleet, &format!("section {}", one.id), at);
    let paint = match one.may_pass.first() {
        _ if one.is_contested => BAD,
        None => FAINT,
        Some(id) => series(*id),
    };
    let [inside_alpha, edge_alpha] = if one.may_pass.is_empty() {
        [0.08, 0.5]
    } else {
        [0.26, 0.9]
    };
    let edge_m = if one.inside.is_empty() { 0.05 } else { 0.1 };
    let inside = filled(&one.polygon, SECTION_M, color(paint, inside_alpha));
    entity.triangles = inside.into_iter().collect();
    let corners = one.polygon.iter();
    let corners = corners.map(|point| lifted(*point, 2.0 * SECTION_M));
    let color = color(paint, edge_alpha);
    let edge = line(LineKind::LineLoop, corners.collect(), edge_m, color);
    entity.lines = vec![edge];
    entity.metadata = vec![
        word("robots", one.robots),
        word("may_pass", &one.may_pass),
        word("inside", &one.inside),
        word("is_contested", one.is_contested),
    ];
    entity
}

fn collision(hit: &Collision, index: usize, now_s: f64, at: Timestamp) -> SceneEntity {
    let (x, y) = (hit.x_m, hit.y_m);
    let is_fresh = now_s - hit.at_s < FRESH_S;
    let (arm_m, alpha) = if is_fresh { (0.8, 1.0) } else { (0.4, 0.45) };
    let mut entity = of_fleet(hit.fleet, &format!("collision {index}"), at);
    let cross = [[-1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]]
        .map(|[along, across]| lifted([x + along * arm_m, y + across * arm_m], MARK_M));
    entity.lines = vec![line(
        LineKind::LineList,
        cross.to_vec(),
        0.12,
        color(BAD, alpha),
    )];
    if is_fresh {
        entity.spheres = vec![ball([x, y, HEIGHT_M], 1.2, color(BAD, 0.25))];
    }
    entity.metadata = vec![
        word("robots", hit.robots),
        word("kind", hit.kind),
        word("basis", hit.basis),
    ];
    entity
}

fn ground_of(map: &MapPicture, fleet: u32, at: Timestamp) -> SceneEntity {
    let corners = |area: &Bounds| ([area.x_min_m, area.y_min_m], [area.x_max_m, area.y_max_m]);
    let mut entity = of_fleet(fleet, "ground", at);
    entity.lifetime = None;
    let (low, high) = corners(&map.bounds);
    let edge = [low, [high[0], low[1]], high, [low[0], high[1]]];
    let edge = edge.map(|point| lifted(point, 0.0)).to_vec();
    entity.lines = vec![line(LineKind::LineLoop, edge, 0.06, color(FAINT, 0.8))];
    for area in &map.conflict_areas {
        let area = filled(area, 0.0, color(FAINT, 0.08));
        entity.triangles.extend(area);
    }
    for (low, high) in map.obstacles.iter().map(corners) {
        let [x, y] = [0, 1].map(|axis| 0.5 * (low[axis] + high[axis]));
        let size = [high[0] - low[0], high[1] - low[1], OBSTACLE_HEIGHT_M];
        let place = [x, y, OBSTACLE_HEIGHT_M / 2.0];
        let obstacle = cube(place, UNTURNED, size, color(STONE, 0.7));
        entity.cubes.push(obstacle);
    }
    let (length, width) = (map.footprint.length_m, map.footprint.width_m);
    for bay in &map.bays {
        let (sine, cosine) = bay.heading_rad.sin_cos();
        let corners =
            [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[along, across]| {
                let (along, across) = (along * 0.625 * length, across * 0.675 * width);
                let x = bay.x_m + along * cosine - across * sine;
                lifted([x, bay.y_m + along * sine + across * cosine], SECTION_M)
            });
        let color_of_edge = color(FAINT, 0.55);
        let edge = line(LineKind::LineLoop, corners.to_vec(), 0.03, color_of_edge);
        entity.lines.push(edge);
        let above = [bay.x_m, bay.y_m, MARK_M];
        let name = text(bay.id.to_string(), above, 0.5 * width, color(FAINT, 0.8));
        entity.texts.push(name);
    }
    entity
}

/// The motions of an arm, their names, and how much they cover: commanded as a ghost, measured solid.
fn motions(arm: &ArmPicture) -> [(&[Frame], &'static str, f64); 2] {
    [
        (arm.desired_frames.as_deref(), "desired", 0.25),
        (arm.measured_frames.as_deref(), "measured", 1.0),
    ]
    .map(|(frames, motion, alpha)| (frames.unwrap_or_default(), motion, alpha))
}

/// The arms: simple shapes from frame to frame.
pub(super) fn arms(picture: &ArmsPicture, at: Timestamp) -> SceneUpdate {
    let mut entities = Vec::new();
    for arm in &picture.arms {
        let side = arm.side;
        for (frames, motion, alpha) in motions(arm) {
            if frames.is_empty() {
                continue;
            }
            let mut entity = entity(BODY.to_owned(), format!("{side} arm {motion}"), at);
            let paint = match (motion, side) {
                ("desired", _) => SERIES[1],
                (_, "left") => SERIES[2],
                _ => SERIES[0],
            };
            let color = color(paint, alpha);
            for shape in &picture.shapes {
                let [from, to] = [shape.from, shape.to].map(|index| {
                    let [x, y, z, ..] = frames[index];
                    [x, y, z]
                });
                let rod = rod(from, to, shape.radius_m, color);
                entity.cylinders.extend(rod);
                entity.spheres.push(ball(to, shape.radius_m, color));
            }
            entity.metadata = vec![
                word("state", arm.state),
                word("session", arm.session),
                word("tool_error_mm", arm.tool_error_mm),
            ];
            entities.push(entity);
        }
        let [desired, measured] = motions(arm).map(|(frames, _, _)| frames.last());
        if let Some((desired, measured)) = desired.zip(measured) {
            let mut entity = entity(BODY.to_owned(), format!("{side} tool error"), at);
            let ends = [desired, measured].map(|[x, y, z, ..]| lifted([*x, *y], *z));
            entity.lines = vec![line(
                LineKind::LineList,
                ends.to_vec(),
                0.006,
                color(BAD, 1.0),
            )];
            entities.push(entity);
        }
    }
    entire(entities, at)
}

/// The same frames, below the one of the body: `right/measured/link_1` to `right/measured/tool`.
pub(super) fn transforms(picture: &ArmsPicture, at: Timestamp) -> FrameTransforms {
    let mut transforms = Vec::new();
    for arm in &picture.arms {
        for (frames, motion, _) in motions(arm) {
            for (index, [x, y, z, w, i, j, k]) in frames.iter().copied().enumerate() {
                let link = match index {
                    0 => "mount".to_owned(),
                    index if index + 1 == frames.len() => "tool".to_owned(),
                    index => format!("link_{index}"),
                };
                transforms.push(FrameTransform {
                    timestamp: Some(at),
                    parent_frame_id: BODY.to_owned(),
                    child_frame_id: format!("{}/{motion}/{link}", arm.side),
                    translation: Some(Vector3 { x, y, z }),
                    rotation: pose([0.0; 3], [i, j, k, w]).orientation,
                });
            }
        }
    }
    FrameTransforms { transforms }
}

/// Something to draw that has no shape yet.
fn entity(frame_id: String, id: String, at: Timestamp) -> SceneEntity {
    SceneEntity {
        timestamp: Some(at),
        frame_id,
        id,
        // Where a viewer does not know what replaces what, old shapes go by themselves.
        lifetime: Some(Duration::new(1, 0)),
        ..SceneEntity::default()
    }
}

/// A colour that covers by `alpha`, 0 to 1.
fn color(paint: Paint, alpha: f64) -> Color {
    let [r, g, b] = paint.map(|part| f64::from(part) / 255.0);
    Color { r, g, b, a: alpha }
}

/// A point on the ground, lifted by `z`.
const fn lifted([x, y]: Point, z: f64) -> Point3 {
    Point3 { x, y, z }
}

/// A line, or separate strokes of two points each, through `points`, `thickness` metres thick.
fn line(kind: LineKind, points: Vec<Point3>, thickness: f64, color: Color) -> LinePrimitive {
    LinePrimitive {
        r#type: kind.into(),
        pose: Some(pose([0.0; 3], UNTURNED)),
        thickness,
        points,
        color: Some(color),
        ..LinePrimitive::default()
    }
}

/// The inside of a polygon: of a convex one, or of a strip whose corners lie by twos across it, first
/// with last. The ground knows no others.
fn filled(polygon: &[Point], z: f64, color: Color) -> Option<TriangleListPrimitive> {
    let count = u32::try_from(polygon.len())
        .ok()
        .filter(|count| *count >= 3)?;
    let indices: Vec<u32> = if is_convex(polygon) {
        (1..count - 1).flat_map(|at| [0, at, at + 1]).collect()
    } else if count % 2 == 0 {
        let across = |at: u32| {
            [
                at,
                at + 1,
                count - 2 - at,
                at,
                count - 2 - at,
                count - 1 - at,
            ]
        };
        (0..count / 2 - 1).flat_map(across).collect()
    } else {
        return None;
    };
    Some(TriangleListPrimitive {
        pose: Some(pose([0.0; 3], UNTURNED)),
        points: polygon.iter().map(|point| lifted(*point, z)).collect(),
        color: Some(color),
        indices,
        ..TriangleListPrimitive::default()
    })
}

/// True when the polygon turns one way at every corner.
fn is_convex(polygon: &[Point]) -> bool {
    let count = polygon.len();
    let turn = |at: usize| {
        let [a, b, c] = [0, 1, 2].map(|step| polygon[(at + step) % count]);
        (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
    };
    // Corners are rounded to the millimetre, so a straight edge may seem to turn a little.
    let turns: Vec<f64> = (0..count).map(turn).collect();
    let most = turns
        .iter()
        .fold(0.0_f64, |most, turn| most.max(turn.abs()));
    let slack = 0.01 * most;
    turns.iter().all(|turn| *turn >= -slack) || turns.iter().all(|turn| *turn <= slack)
}

/// A word that always faces the viewer.
fn text(words: String, at: [f64; 3], size_m: f64, color: Color) -> TextPrimitive {
    TextPrimitive {
        pose: Some(pose(at, UNTURNED)),
        billboard: true,
        font_size: size_m,
        text: words,
        color: Some(color),
        ..TextPrimitive::default()
    }
}

/// A ball of this radius, metres.
fn ball(at: [f64; 3], radius_m: f64, color: Color) -> SpherePrimitive {
    let side = 2.0 * radius_m;
    SpherePrimitive {
        pose: Some(pose(at, UNTURNED)),
        size: Some(Vector3 {
            x: side,
            y: side,
            z: side,
        }),
        color: Some(color),
    }
}

/// A rod from one point to another; `None` where they are the same.
fn rod(from: [f64; 3], to: [f64; 3], radius_m: f64, color: Color) -> Option<CylinderPrimitive> {
    let along = [0, 1, 2].map(|axis| to[axis] - from[axis]);
    let length_m = along.iter().map(|part| part * part).sum::<f64>().sqrt();
    if length_m < 1e-4 {
        return None;
    }
    let [x, y, z] = along.map(|part| part / length_m);
    // A cylinder stands along z: the turn that leads z to the rod's direction, by half its angle.
    let (i, j, w) = if z > -0.999_999 {
        let norm = (2.0 * (1.0 + z)).sqrt();
        (-y / norm, x / norm, 0.5 * norm)
    } else {
        (1.0, 0.0, 0.0)
    };
    let middle = [0, 1, 2].map(|axis| 0.5 * (from[axis] + to[axis]));
    Some(CylinderPrimitive {
        pose: Some(pose(middle, [i, j, 0.0, w])),
        size: Some(Vector3 {
            x: 2.0 * radius_m,
            y: 2.0 * radius_m,
            z: length_m,
        }),
        bottom_scale: 1.0,
        top_scale: 1.0,
        color: Some(color),
    })
}

/// What a viewer tells of an entity when it is clicked, as JSON.
fn word(key: &str, value: impl Serialize) -> KeyValuePair {
    KeyValuePair {
        key: key.to_owned(),
        value: json!(value).to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(polygon: &[Point]) -> f64 {
        let filled = filled(polygon, 0.0, color(BAD, 1.0)).unwrap();
        let corner = |index: u32| &filled.points[index as usize];
        let triangles = filled.indices.chunks(3);
        let areas = triangles.map(|three| {
            let [a, b, c] = [0, 1, 2].map(|at| corner(three[at]));
            0.5 * ((b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)).abs()
        });
        areas.sum()
    }

    #[test]
    fn a_square_and_a_bent_strip_are_filled_once() {
        let square = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
        assert!((area(&square) - 4.0).abs() < 1e-12);
        // An L of width 1: its corners go up one side and back the other.
        let bent = [
            [0.0, 0.0],
            [3.0, 0.0],
            [3.0, 3.0],
            [2.0, 3.0],
            [2.0, 1.0],
            [0.0, 1.0],
        ];
        assert!((area(&bent) - 5.0).abs() < 1e-12);
        assert!(filled(&square[..2], 0.0, color(BAD, 1.0)).is_none());
    }

    #[test]
    fn a_rod_leads_from_one_point_to_the_other() {
        for to in [
            [1.0, 2.0, 3.5],
            [1.0, 2.0, 1.0],
            [-4.0, 0.5, 3.0],
            [1.0, 5.0, 3.0],
        ] {
            let from = [1.0, 2.0, 3.0];
            let rod = rod(from, to, 0.1, color(BAD, 1.0)).unwrap();
            let (pose, size) = (rod.pose.unwrap(), rod.size.unwrap());
            let (q, middle) = (pose.orientation.unwrap(), pose.position.unwrap());
            // The z axis, turned by the quaternion.
            let axis = [
                2.0 * (q.x * q.z + q.w * q.y),
                2.0 * (q.y * q.z - q.w * q.x),
                1.0 - 2.0 * (q.x * q.x + q.y * q.y),
            ];
            let end = [middle.x, middle.y, middle.z];
            for at in 0..3 {
                let reached = end[at] + 0.5 * size.z * axis[at];
                assert!((reached - to[at]).abs() < 1e-9, "{reached} {to:?}");
            }
        }
        assert!(rod([1.0; 3], [1.0; 3], 0.1, color(BAD, 1.0)).is_none());
    }
}
