//! Scenes of messages made up here, read back as a viewer reads them.

use std::collections::BTreeMap;

use bytemuck::Zeroable;
use hil_arm::yumi::arm::RIGHT_START_RAD;
use serde_json::json;

use super::*;
use crate::schema::Schema;
use prost::Message as _;

/// Keeps what is written, by topic.
#[derive(Debug, Default)]
struct Kept {
    names: Vec<String>,
    messages: BTreeMap<String, Vec<(u64, Vec<u8>)>>,
}

impl Sink for Kept {
    type Error = core::convert::Infallible;

    fn add_topic(
        &mut self,
        topic: &str,
        _schema: &Schema,
        _metadata: &BTreeMap<String, String>,
    ) -> Result<u16, Self::Error> {
        self.names.push(topic.to_owned());
        Ok(u16::try_from(self.names.len() - 1).unwrap())
    }

    fn write(&mut self, topic: u16, at: Stamp, data: &[u8]) -> Result<(), Self::Error> {
        let name = self.names[usize::from(topic)].clone();
        let message = (at.log_ns, data.to_vec());
        self.messages.entry(name).or_default().push(message);
        Ok(())
    }
}

impl Kept {
    fn scenes(&self) -> Vec<(u64, SceneUpdate)> {
        let messages = self.messages.get("/scene").into_iter().flatten();
        let decode = |(at_ns, data): &(u64, Vec<u8>)| {
            let update = SceneUpdate::decode(data.as_slice()).unwrap();
            (*at_ns, update)
        };
        messages.map(decode).collect()
    }
}

fn crossing() -> Scene {
    let parameters = json!({ "world": { "scenario": "crossing" } });
    let parameters: hil_fleet::FleetParameters =
        serde_json::from_value(parameters).unwrap_or_default();
    let parameters = serde_json::to_value(parameters).unwrap();
    Scene::new(Some("fleet"), &parameters, &mut Names::default())
}

/// A robot that goes along x at 1 m/s, with a state each 20 ms.
fn state(robot: u32, number: u64) -> (State, u64) {
    let mut state = State::zeroed();
    state.header.robot_id = robot;
    state.x_m = 0.02 * number as f64;
    state.y_m = f64::from(robot) * 10.0;
    (state, 1_000_000_000 + 20_000_000 * number)
}

fn told(state: &State, at_ns: u64) -> Heard {
    Heard {
        told: Told::State(*state),
        at_ns,
        published_ns: signed(at_ns),
    }
}

fn x_of(update: &SceneUpdate, id: &str) -> Option<f64> {
    let mut entities = update.entities.iter();
    let robot = entities.find(|entity| entity.id == id)?;
    Some(robot.cubes[0].pose?.position?.x)
}

#[test]
fn robots_move_at_the_pace_of_the_pictures_and_each_picture_is_whole() {
    let (mut scene, mut kept) = (crossing(), Kept::default());
    for number in 0..=50 {
        for robot in 0..2 {
            let (state, at_ns) = state(robot, number);
            scene.take(&told(&state, at_ns), &mut kept).unwrap();
        }
    }
    scene.finish(&mut kept).unwrap();
    let scenes = kept.scenes();
    assert_eq!(scenes.len(), 21, "{:?}", scenes.last());
    for (picture, (at_ns, update)) in scenes.iter().enumerate() {
        assert_eq!(*at_ns, 1_050_000_000 + 50_000_000 * picture as u64);
        let x = x_of(update, "fleet 0 robot 1").unwrap();
        let heard = (at_ns - 1_000_000_000) / 20_000_000 * 20;
        let heard = heard.min(1000) as f64 / 1000.0;
        // What was said at the very time of a picture is on the next one.
        assert!((x - heard).abs() < 0.0201, "{x} {heard}");
        assert_eq!(update.deletions.len(), 1);
        let cube = &update.entities[0].cubes[0];
        let size = cube.size.unwrap();
        let footprint = scene
            .pictures
            .fleet
            .as_ref()
            .unwrap()
            .vehicle_size_m()
            .unwrap();
        assert_eq!(([size.x, size.y], size.z), (footprint, 0.4));
    }
}

fn wait_for(is_ready: &mut dyn FnMut() -> bool) {
    while !is_ready() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

#[test]
fn a_live_file_has_the_pictures_of_one_made_in_order() {
    let (mut ordered, mut kept) = (crossing(), Kept::default());
    let mut live = crossing();
    let mut kept_live = Kept::default();
    wait_for(&mut || ordered.is_ready());
    for number in 0..200 {
        for robot in 0..2 {
            let (state, at_ns) = state(robot, number);
            ordered.take(&told(&state, at_ns), &mut kept).unwrap();
        }
    }
    ordered.finish(&mut kept).unwrap();
    // A recorder reads one robot's file first, then the other's, ten messages at a time.
    for piece in 0..20 {
        for robot in 0..2 {
            for number in 10 * piece..10 * piece + 10 {
                let (state, at_ns) = state(robot, number);
                live.hold(&told(&state, at_ns), &mut kept_live).unwrap();
            }
        }
        live.settle(&mut kept_live).unwrap();
        if piece == 9 {
            wait_for(&mut || live.is_ready());
        }
    }
    assert!(kept_live.scenes().len() > 70);
    live.finish(&mut kept_live).unwrap();
    assert!(kept.messages == kept_live.messages);
    assert_eq!(live.problems(), [""; 0]);
    assert!(!kept.messages["/scene/ground"].is_empty());
}

#[test]
fn one_damaged_time_does_not_hurry_a_live_scene() {
    let mut live = crossing();
    let mut kept = Kept::default();
    for number in 0..20 {
        let (state, at_ns) = state(0, number);
        let at_ns = if number == 10 { at_ns << 20 } else { at_ns };
        live.hold(&told(&state, at_ns), &mut kept).unwrap();
    }
    wait_for(&mut || live.is_ready());
    live.settle(&mut kept).unwrap();
    // The second robot's file is read after the first one's.
    for number in 0..20 {
        let (state, at_ns) = state(1, number);
        live.hold(&told(&state, at_ns), &mut kept).unwrap();
    }
    live.finish(&mut kept).unwrap();
    let scenes = kept.scenes();
    let both = scenes.iter().filter(|(_, update)| {
        ["fleet 0 robot 0", "fleet 0 robot 1"]
            .iter()
            .all(|id| x_of(update, id).is_some())
    });
    assert!(both.count() > 2, "{}", scenes.len());
}

#[test]
fn a_scene_that_is_finished_before_its_ground_says_what_it_lacks() {
    // Which of the two happens depends on how fast the ground is made; each is said.
    let mut live = crossing();
    let mut kept = Kept::default();
    assert!(!live.awaits_ground(), "nothing waits for a ground");
    for number in 0..20 {
        let (state, at_ns) = state(0, number);
        live.hold(&told(&state, at_ns), &mut kept).unwrap();
    }
    live.settle(&mut kept).unwrap();
    live.finish(&mut kept).unwrap();
    let has_ground = kept.messages.contains_key("/scene/ground");
    assert!(has_ground || !live.problems().is_empty());
    assert_eq!(kept.scenes().len(), 8);
}

#[test]
fn a_silence_is_not_drawn_and_a_silent_robot_fades() {
    let (mut scene, mut kept) = (crossing(), Kept::default());
    for number in [0, 1, 500_000, 500_100] {
        let (state, at_ns) = state(0, number);
        scene.take(&told(&state, at_ns), &mut kept).unwrap();
    }
    let (other, at_ns) = state(1, 500_100);
    scene.take(&told(&other, at_ns), &mut kept).unwrap();
    scene.finish(&mut kept).unwrap();
    let scenes = kept.scenes();
    assert!(scenes.len() < 50, "{}", scenes.len());
    let alpha = |update: &SceneUpdate| update.entities[0].cubes[0].color.unwrap().a;
    let faded = scenes.iter().filter(|(_, update)| alpha(update) < 1.0);
    assert!(faded.count() > 10);
}

#[test]
fn the_ground_comes_once_it_is_known_and_again_after_ten_seconds() {
    let (mut scene, mut kept) = (crossing(), Kept::default());
    wait_for(&mut || scene.is_ready());
    assert_eq!(scene.problems(), [""; 0]);
    for number in 0..=1050 {
        let (state, at_ns) = state(0, number);
        scene.take(&told(&state, at_ns), &mut kept).unwrap();
    }
    let grounds = &kept.messages["/scene/ground"];
    assert_eq!(grounds.len(), 3);
    let ground = SceneUpdate::decode(grounds[0].1.as_slice()).unwrap();
    assert_eq!(ground.entities[0].frame_id, "map");
    assert!(!ground.entities[0].lines.is_empty());
}

#[test]
fn arms_are_shapes_and_frames_commanded_and_measured() {
    let mut names = Names::default();
    names.claim("/scene".to_owned());
    let mut scene = Scene::new(Some("teleoperation"), &Value::Null, &mut names);
    let mut kept = Kept::default();
    let messages = [EgmCommand::NAME, EgmFeedback::NAME];
    scene.declare(messages.into_iter(), &mut kept).unwrap();
    // A channel of that name keeps it.
    assert_eq!(kept.names, ["/scene_2", "/tf"]);
    let (mut command, mut feedback) = (EgmCommand::zeroed(), EgmFeedback::zeroed());
    command.position_rad = RIGHT_START_RAD;
    feedback.measured_rad = RIGHT_START_RAD;
    for number in 0..100_u64 {
        command.position_rad[0] = 0.01 * number as f64;
        let at_ns = 1_000_000_000 + 4_000_000 * number;
        for (message, payload) in [
            (EgmCommand::NAME, bytemuck::bytes_of(&command)),
            (EgmFeedback::NAME, bytemuck::bytes_of(&feedback)),
        ] {
            let heard = Heard {
                told: Told::of("egm/right/any", message, payload).unwrap(),
                at_ns,
                published_ns: signed(at_ns),
            };
            scene.take(&heard, &mut kept).unwrap();
        }
    }
    scene.finish(&mut kept).unwrap();
    let pictures = &kept.messages["/scene_2"];
    assert_eq!(pictures.len(), 8);
    let last = SceneUpdate::decode(pictures[7].1.as_slice()).unwrap();
    let ids: Vec<&str> = last.entities.iter().map(|one| one.id.as_str()).collect();
    assert_eq!(
        ids,
        [
            "right arm desired",
            "right arm measured",
            "right tool error"
        ]
    );
    assert!(last.entities[1].cylinders.len() >= 5);
    let frames = FrameTransforms::decode(kept.messages["/tf"][7].1.as_slice()).unwrap();
    assert_eq!(frames.transforms.len(), 16);
    let tool = |motion: &str| {
        let mut all = frames.transforms.iter();
        let name = format!("right/{motion}/tool");
        let tool = all.find(|one| one.child_frame_id == name);
        tool.unwrap().translation.unwrap()
    };
    let (desired, measured) = (tool("desired"), tool("measured"));
    assert!((desired.x - measured.x).hypot(desired.y - measured.y) > 0.01);
}
