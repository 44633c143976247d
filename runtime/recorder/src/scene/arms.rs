//! The arms as a scene and as frames: what `/live/arms` says, drawn by the live page's rules
//! (`page/arms.js`): measured solid, commanded as a ghost, simple shapes from frame to frame.

use foxglove::messages::{
    Color, FrameTransform, FrameTransforms, Quaternion, SceneEntity, SceneUpdate, Timestamp,
    Vector3,
};
use serde_json::Value;

use super::entire;
use super::shapes::{BAD, Paint, SERIES, ball, color, entity, lifted, list, rod, strokes, word};

/// The frame in which the models place the arms.
const BODY: &str = "body";
/// Motions of an arm: their key in `/live/arms`, their name, and how much they cover.
const MOTIONS: [(&str, &str, f64); 2] = [
    ("desired_frames", "desired", 0.25),
    ("measured_frames", "measured", 1.0),
];

/// The colour of what was commanded.
const DESIRED: Paint = SERIES[1];

/// Position, and the quaternion w, x, y, z.
type Frame = [f64; 7];

/// The arms, from `/live/arms`.
pub(crate) fn shapes(arms: &Value, at: Timestamp) -> SceneUpdate {
    let mut entities = Vec::new();
    for arm in list(&arms["arms"]) {
        let side = arm["side"].as_str().unwrap_or_default();
        for (key, motion, alpha) in MOTIONS {
            let frames = frames(&arm[key]);
            if frames.is_empty() {
                continue;
            }
            let mut entity = entity(BODY.to_owned(), format!("{side} arm {motion}"), at);
            let paint = match (motion, side) {
                ("desired", _) => DESIRED,
                (_, "left") => SERIES[2],
                _ => SERIES[0],
            };
            links(&mut entity, &frames, &arms["shapes"], color(paint, alpha));
            entity.metadata = ["state", "session", "tool_error_mm"]
                .map(|key| word(key, &arm[key]))
                .to_vec();
            entities.push(entity);
        }
        let [desired, measured] = MOTIONS.map(|(key, _, _)| frames(&arm[key]).pop());
        if let Some((desired, measured)) = desired.zip(measured) {
            let mut entity = entity(BODY.to_owned(), format!("{side} tool error"), at);
            let ends = [desired, measured].map(|[x, y, z, ..]| lifted([x, y], z));
            entity.lines = vec![strokes(ends.to_vec(), 0.006, color(BAD, 1.0))];
            entities.push(entity);
        }
    }
    entire(entities, at)
}

/// The same frames, below the one of the body: `right/measured/link_1` to `right/measured/tool`.
pub(crate) fn transforms(arms: &Value, at: Timestamp) -> FrameTransforms {
    let mut transforms = Vec::new();
    for arm in list(&arms["arms"]) {
        let side = arm["side"].as_str().unwrap_or_default();
        for (key, motion, _) in MOTIONS {
            let frames = frames(&arm[key]);
            let last = frames.len().saturating_sub(1);
            for (index, [x, y, z, w, i, j, k]) in frames.into_iter().enumerate() {
                let link = match index {
                    0 => "mount".to_owned(),
                    index if index == last => "tool".to_owned(),
                    index => format!("link_{index}"),
                };
                transforms.push(FrameTransform {
                    timestamp: Some(at),
                    parent_frame_id: BODY.to_owned(),
                    child_frame_id: format!("{side}/{motion}/{link}"),
                    translation: Some(Vector3 { x, y, z }),
                    rotation: Some(Quaternion {
                        x: i,
                        y: j,
                        z: k,
                        w,
                    }),
                });
            }
        }
    }
    FrameTransforms { transforms }
}

/// All frames of an arm, or none.
fn frames(value: &Value) -> Vec<Frame> {
    let frame = |one: &Value| -> Option<Frame> {
        let numbers: Option<Vec<f64>> = list(one).map(Value::as_f64).collect();
        numbers?.try_into().ok()
    };
    let all: Option<Vec<Frame>> = list(value).map(frame).collect();
    all.unwrap_or_default()
}

/// Rods with round ends, as `shapes` names their frames.
fn links(entity: &mut SceneEntity, frames: &[Frame], shapes: &Value, color: Color) {
    let position = |index: &Value| {
        let index = usize::try_from(index.as_u64()?).ok()?;
        let [x, y, z, ..] = *frames.get(index)?;
        Some([x, y, z])
    };
    for shape in list(shapes) {
        let ends = position(&shape["from"]).zip(position(&shape["to"]));
        let Some(((from, to), radius_m)) = ends.zip(shape["radius_m"].as_f64()) else {
            continue;
        };
        entity.cylinders.extend(rod(from, to, radius_m, color));
        entity.spheres.push(ball(to, radius_m, color));
    }
}
