//! Colours and shapes of a scene, as the viewers' schema has them. What they stand for is decided in
//! the modules beside this one.

use foxglove::messages::{
    Color, CylinderPrimitive, Duration, KeyValuePair, LinePrimitive, Point3, SceneEntity,
    SpherePrimitive, TextPrimitive, Timestamp, TriangleListPrimitive, Vector3, line_primitive,
};
use serde_json::Value;

use crate::topics::{UNTURNED, pose};

/// Red, green, blue.
pub(crate) type Paint = [u8; 3];

/// Colours of robots by number, those of the live page (`page.css`, `--k0` to `--k6`).
pub(crate) const SERIES: [Paint; 7] = [
    [0x00, 0x72, 0xb2],
    [0xd5, 0x5e, 0x00],
    [0x00, 0x9e, 0x73],
    [0xb3, 0x56, 0x8f],
    [0xb0, 0x7d, 0x00],
    [0x3a, 0x9a, 0xd9],
    [0x4b, 0x4f, 0x58],
];
/// What went wrong (`--bad`).
pub(crate) const BAD: Paint = [0xb3, 0x26, 0x1e];
/// What is old, or belongs to nobody (`--faint`).
pub(crate) const FAINT: Paint = [0x5b, 0x64, 0x72];
/// What stands on the ground (`--rule`, darker).
pub(crate) const STONE: Paint = [0xa6, 0xad, 0xb8];
/// Marks on vehicles (`--panel`).
pub(crate) const LIGHT: Paint = [0xff, 0xff, 0xff];

/// The elements of a list, none of anything else.
pub(crate) fn list(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

/// Something to draw that has no shape yet.
pub(crate) fn entity(frame_id: String, id: String, at: Timestamp) -> SceneEntity {
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
pub(crate) fn color(paint: Paint, alpha: f64) -> Color {
    let [r, g, b] = paint.map(|part| f64::from(part) / 255.0);
    Color { r, g, b, a: alpha }
}

/// A point on the ground, lifted by `z`.
pub(crate) const fn lifted([x, y]: [f64; 2], z: f64) -> Point3 {
    Point3 { x, y, z }
}

/// A line through `points`, `thickness` metres thick; closed where `is_closed`.
pub(crate) fn line(
    points: Vec<Point3>,
    thickness: f64,
    is_closed: bool,
    color: Color,
) -> LinePrimitive {
    let kind = if is_closed {
        line_primitive::Type::LineLoop
    } else {
        line_primitive::Type::LineStrip
    };
    LinePrimitive {
        r#type: kind.into(),
        pose: Some(pose([0.0; 3], UNTURNED)),
        thickness,
        points,
        color: Some(color),
        ..LinePrimitive::default()
    }
}

/// Separate strokes, two points each.
pub(crate) fn strokes(points: Vec<Point3>, thickness: f64, color: Color) -> LinePrimitive {
    LinePrimitive {
        r#type: line_primitive::Type::LineList.into(),
        ..line(points, thickness, false, color)
    }
}

/// The inside of a polygon: of a convex one, or of a strip whose corners lie by twos across it, first
/// with last. The ground knows no others.
pub(crate) fn filled(polygon: &[[f64; 2]], z: f64, color: Color) -> Option<TriangleListPrimitive> {
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
fn is_convex(polygon: &[[f64; 2]]) -> bool {
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
pub(crate) fn text(words: String, at: [f64; 3], size_m: f64, color: Color) -> TextPrimitive {
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
pub(crate) fn ball(at: [f64; 3], radius_m: f64, color: Color) -> SpherePrimitive {
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
pub(crate) fn rod(
    from: [f64; 3],
    to: [f64; 3],
    radius_m: f64,
    color: Color,
) -> Option<CylinderPrimitive> {
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

/// What a viewer tells of an entity when it is clicked.
pub(crate) fn word(key: &str, value: impl core::fmt::Display) -> KeyValuePair {
    KeyValuePair {
        key: key.to_owned(),
        value: value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(polygon: &[[f64; 2]]) -> f64 {
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
