//! Which topics a channel becomes, and what the shipped cases show of themselves in viewers: arms as
//! joints, vehicles as boxes. It reads no file; an unknown message shows as its own topic only.

use std::collections::{BTreeMap, BTreeSet};

use foxglove::Encode;
use foxglove::messages::{
    Color, CubePrimitive, Duration, JointState, JointStates, Log, Pose, PoseInFrame, Quaternion,
    SceneEntity, SceneUpdate, TextPrimitive, Timestamp, Vector3, log,
};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback, Side};
use hil_arm::yumi::description::joint_name;
use hil_core::case_study::Severity;
use hil_core::message::Message;
use hil_fleet::messages::State;
use hil_report::score_event::ExplainedEvent;
use prost::Message as _;

use crate::schema::Schema;
use crate::sink::Topic;

/// How long a vehicle stays in a picture after its last state, seconds.
const VEHICLE_SHOWN_S: i32 = 2;
/// Size of a vehicle in a picture, metres. No message carries the true size.
const VEHICLE_SIZE_M: [f64; 3] = [1.0, 0.6, 0.4];

/// The topic of the score's events.
pub(crate) fn event_topic(names: &mut Names) -> Topic {
    let name = names.claim("/score/events".to_owned());
    Topic::new(name, well_known::<Log>(), &[])
}

/// The names of a recording's topics: each is used once.
#[derive(Debug, Default)]
pub(crate) struct Names {
    taken: BTreeSet<String>,
    /// Names that were not free, as wanted and as given.
    pub(crate) changed: BTreeMap<String, String>,
}

impl Names {
    /// A topic called `wanted`, or that with a number behind it.
    pub(crate) fn claim(&mut self, wanted: String) -> String {
        let mut name = wanted.clone();
        let mut number = 1_u64;
        while !self.taken.insert(name.clone()) {
            number += 1;
            name = format!("{wanted}_{number}");
        }
        if name != wanted {
            self.changed.insert(name.clone(), wanted);
        }
        name
    }
}

/// The topic of a channel: its name behind one `/`, control characters as `_`.
pub(crate) fn topic_of(channel: &str) -> String {
    let name = channel.trim_start_matches('/');
    let name: String = name
        .chars()
        .map(|c| if c.is_control() { '_' } else { c })
        .collect();
    format!("/{name}")
}

/// A topic that is made of a channel's messages for viewers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View {
    /// The topic's name before the channel's.
    pub(crate) prefix: &'static str,
    /// Its schema.
    pub(crate) schema: fn() -> Schema,
    /// A message of this channel, published then, as bytes.
    draw: fn(&str, Timestamp, &[u8]) -> Option<Vec<u8>>,
}

impl View {
    /// Joint positions that an arm is commanded.
    const COMMANDED_JOINTS: Self = Self {
        prefix: "/joints",
        schema: well_known::<JointStates>,
        draw: |channel, at, payload| {
            let command: EgmCommand = read(payload)?;
            let speeds = command.flags & EgmCommand::HAS_SPEED != 0;
            let speeds = speeds.then_some(&command.speed_rad_per_s);
            Some(joints(channel, at, &command.position_rad, speeds).encode_to_vec())
        },
    };
    /// Joint positions that an arm reports.
    const MEASURED_JOINTS: Self = Self {
        prefix: "/joints",
        schema: well_known::<JointStates>,
        draw: |channel, at, payload| {
            let feedback: EgmFeedback = read(payload)?;
            Some(joints(channel, at, &feedback.measured_rad, None).encode_to_vec())
        },
    };
    /// Where an arm reports its tool.
    const TOOL: Self = Self {
        prefix: "/tool",
        schema: well_known::<PoseInFrame>,
        draw: |_channel, at, payload| {
            let feedback: EgmFeedback = read(payload)?;
            let [w, i, j, k] = feedback.tool.quaternion_wxyz;
            let tool = PoseInFrame {
                timestamp: Some(at),
                frame_id: "body".to_owned(),
                pose: Some(pose(feedback.tool.position_m, [i, j, k, w])),
            };
            Some(tool.encode_to_vec())
        },
    };
    /// Vehicles as boxes.
    const VEHICLES: Self = Self {
        prefix: "/scene",
        schema: well_known::<SceneUpdate>,
        draw: |_channel, at, payload| {
            let state = read(payload)?;
            Some(vehicle(&state, at).encode_to_vec())
        },
    };

    /// The views of a message; none of one whose size is not that of our type of that name.
    pub(crate) fn of(message: &str, size_bytes: usize) -> &'static [Self] {
        match message {
            EgmCommand::NAME if size_bytes == size_of::<EgmCommand>() => &[Self::COMMANDED_JOINTS],
            EgmFeedback::NAME if size_bytes == size_of::<EgmFeedback>() => {
                &[Self::MEASURED_JOINTS, Self::TOOL]
            }
            State::NAME if size_bytes == size_of::<State>() => &[Self::VEHICLES],
            _ => &[],
        }
    }

    /// What `payload`, a message of `channel` published at `at_ns`, looks like; nothing when it has
    /// another size.
    pub(crate) fn show(self, channel: &str, at_ns: u64, payload: &[u8]) -> Option<Vec<u8>> {
        (self.draw)(channel, timestamp(at_ns)?, payload)
    }
}

/// The message that `payload` is, if it has its size.
pub(crate) fn read<M: Message>(payload: &[u8]) -> Option<M> {
    bytemuck::try_pod_read_unaligned(payload).ok()
}

pub(crate) fn well_known<M: Encode>() -> Schema {
    let schema = M::get_schema().expect("every message of the SDK states its schema");
    Schema {
        name: schema.name,
        data: schema.data.into_owned(),
    }
}

/// `None` after the year 2106, where the viewers' clock ends.
pub(crate) fn timestamp(at_ns: u64) -> Option<Timestamp> {
    let seconds = u32::try_from(at_ns / 1_000_000_000).ok()?;
    Timestamp::new_checked(seconds, (at_ns % 1_000_000_000) as u32)
}

/// Which arm the messages of a channel are about: the channel's name tells.
pub(crate) fn side_of(channel: &str) -> Option<Side> {
    let mut parts = channel.split('/');
    parts.find_map(|part| Side::BOTH.into_iter().find(|side| side.word() == part))
}

fn joints(
    channel: &str,
    at: Timestamp,
    positions_rad: &[f64; 7],
    speeds_rad_per_s: Option<&[f64; 7]>,
) -> JointStates {
    let side = side_of(channel).map_or("", Side::word);
    let joints = positions_rad.iter().enumerate();
    let joints = joints.map(|(index, position_rad)| JointState {
        name: joint_name(side, index),
        position: Some(*position_rad),
        velocity: speeds_rad_per_s.map(|speeds| speeds[index]),
        ..JointState::default()
    });
    JointStates {
        timestamp: Some(at),
        joints: joints.collect(),
    }
}

/// The quaternion of no turn.
pub(crate) const UNTURNED: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

/// A place x, y, z, and the quaternion x, y, z, w.
pub(crate) fn pose([x, y, z]: [f64; 3], [i, j, k, w]: [f64; 4]) -> Pose {
    let turn = Quaternion {
        x: i,
        y: j,
        z: k,
        w,
    };
    Pose {
        position: Some(Vector3 { x, y, z }),
        orientation: Some(turn),
    }
}

/// A box of this size, metres, around a place.
pub(crate) fn cube(
    place: [f64; 3],
    turned: [f64; 4],
    size: [f64; 3],
    color: Color,
) -> CubePrimitive {
    let [x, y, z] = size;
    CubePrimitive {
        pose: Some(pose(place, turned)),
        size: Some(Vector3 { x, y, z }),
        color: Some(color),
    }
}

fn vehicle(state: &State, at: Timestamp) -> SceneUpdate {
    let (fleet, robot) = (state.header.fleet_id, state.header.robot_id);
    let (sine, cosine) = (state.heading_rad / 2.0).sin_cos();
    let turned = [0.0, 0.0, sine, cosine];
    let height = VEHICLE_SIZE_M[2];
    // Neighbours in number get colours far apart: steps of the golden section around the circle.
    let hue = f64::from(robot) * 0.618_033_988_75 % 1.0;
    let part = |shift: f64| 0.55 + 0.4 * (core::f64::consts::TAU * (hue + shift)).cos();
    let color = Color {
        r: part(0.0),
        g: part(1.0 / 3.0),
        b: part(2.0 / 3.0),
        a: 1.0,
    };
    let place = [state.x_m, state.y_m, height / 2.0];
    let body = cube(place, turned, VEHICLE_SIZE_M, color);
    let name = TextPrimitive {
        pose: Some(pose([state.x_m, state.y_m, 2.0 * height], turned)),
        billboard: true,
        font_size: 0.5,
        text: format!("{robot}"),
        color: Some(color),
        ..TextPrimitive::default()
    };
    let entity = SceneEntity {
        timestamp: Some(at),
        frame_id: "map".to_owned(),
        id: format!("fleet {fleet} robot {robot}"),
        lifetime: Some(Duration::new(VEHICLE_SHOWN_S, 0)),
        cubes: vec![body],
        texts: vec![name],
        ..SceneEntity::default()
    };
    SceneUpdate {
        deletions: Vec::new(),
        entities: vec![entity],
    }
}

/// An event of the score as a line of a log.
pub(crate) fn event_line(event: &ExplainedEvent, at_ns: u64) -> Option<Log> {
    let level = match event.severity {
        Severity::Notice => log::Level::Info,
        Severity::Hazard => log::Level::Warning,
        Severity::Incident => log::Level::Error,
    };
    let outages = event.outages.iter();
    let outages = outages.map(|outage| format!(" | {}: {}", outage.channel, outage.words));
    Some(Log {
        timestamp: Some(timestamp(at_ns)?),
        level: level.into(),
        message: format!("{}{}", event.what, outages.collect::<String>()),
        name: "score".to_owned(),
        ..Log::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn no_two_channels_share_a_topic() {
        let mut names = Names::default();
        let mut claim = |channel| names.claim(topic_of(channel));
        assert_eq!(claim("a/b"), "/a/b");
        assert_eq!(claim("/a/b"), "/a/b_2");
        assert_eq!(claim("a/b_2"), "/a/b_2_2");
        assert_eq!(claim("tab\there \u{1f916}"), "/tab_here \u{1f916}");
        assert_eq!(claim(""), "/");
        assert_eq!(names.changed.len(), 2);
    }

    #[test]
    fn an_arm_shows_its_joints_under_the_makers_names() {
        let mut command = EgmCommand::zeroed();
        command.position_rad = [0.1, 0.2, 0.7, 0.3, 0.4, 0.5, 0.6];
        let payload = bytemuck::bytes_of(&command);
        let show = |payload| View::COMMANDED_JOINTS.show("egm/left/command", 5, payload);
        let joints = JointStates::decode(show(payload).unwrap().as_slice()).unwrap();
        let joint = &joints.joints[2];
        assert_eq!(
            (joint.name.as_str(), joint.position),
            ("yumi_joint_7_l", Some(0.7))
        );
        assert_eq!(joint.velocity, None);
        assert!(show(&payload[1..]).is_none());
        assert!(View::of("hil.EgmCommand.v1", 143).is_empty());
    }

    #[test]
    fn a_vehicle_stands_where_it_says() {
        let mut state = State::zeroed();
        (state.x_m, state.y_m, state.heading_rad) = (3.0, -4.0, core::f64::consts::PI);
        let shown = View::VEHICLES.show("fleet/state", 5, bytemuck::bytes_of(&state));
        let update = SceneUpdate::decode(shown.unwrap().as_slice()).unwrap();
        let pose = update.entities[0].cubes[0].pose.unwrap();
        assert_eq!(pose.position.map(|at| (at.x, at.y)), Some((3.0, -4.0)));
        assert!((pose.orientation.unwrap().z - 1.0).abs() < 1e-12);
    }
}
