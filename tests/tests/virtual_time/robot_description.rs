//! The robot's description says the same as the models: read back as XML, with kinematics of its own as the
//! URDF specification has it, it puts both tools where the models put them.

use std::fs;
use std::process::Command;
use std::time::Duration;

use hil_arm::yumi::arm::{Arm, POSITION_MAX_RAD, POSITION_MIN_RAD, SPEED_MAX_RAD_PER_S};
use hil_arm::yumi::description::{Urdf, joint_name};
use hil_arm::yumi::{JOINT_COUNT, Joints};
use hil_core::random::RandomStream;
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child;
use hil_tests::run_folder::RunFolder;
use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};
use roxmltree::{Document, Node};

const SEED: u64 = 4711;
const POSTURES: usize = 1_000;
/// A nanometre and a nanoradian: what twelve digits of each origin leave is far below.
const ALLOWED: f64 = 1e-9;

fn child_of<'a>(node: &Node<'a, 'a>, name: &str) -> Node<'a, 'a> {
    node.children().find(|one| one.has_tag_name(name)).unwrap()
}

fn numbers(text: &str) -> [f64; 3] {
    let numbers: Vec<f64> = text.split(' ').map(|one| one.parse().unwrap()).collect();
    numbers.try_into().unwrap()
}

/// `xyz` and `rpy` of an origin: about the fixed axes, roll first.
fn origin(joint: &Node<'_, '_>) -> Isometry3<f64> {
    let element = joint.children().find(|one| one.has_tag_name("origin"));
    let element = element.unwrap();
    let [x, y, z] = numbers(element.attribute("xyz").unwrap());
    let [roll, pitch, yaw] = numbers(element.attribute("rpy").unwrap());
    let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
    let turn = about(Vector3::z_axis(), yaw)
        * about(Vector3::y_axis(), pitch)
        * about(Vector3::x_axis(), roll);
    Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_rotation_matrix(&turn),
    )
}

/// The joints from the root to the link called `tip`, and their names.
fn chain<'a>(robot: &Node<'a, 'a>, tip: &str) -> Vec<Node<'a, 'a>> {
    let joints = || robot.children().filter(|one| one.has_tag_name("joint"));
    let mut found = Vec::new();
    let mut link = tip.to_owned();
    while let Some(joint) =
        joints().find(|one| child_of(one, "child").attribute("link") == Some(&link))
    {
        child_of(&joint, "parent")
            .attribute("link")
            .unwrap()
            .clone_into(&mut link);
        found.push(joint);
    }
    assert_eq!(link, "body", "the root");
    found.reverse();
    found
}

fn tool(chain: &[Node<'_, '_>], q_rad: &Joints) -> Isometry3<f64> {
    let mut angles = q_rad.iter();
    let mut frame = Isometry3::identity();
    for joint in chain {
        frame *= origin(joint);
        if joint.attribute("type") == Some("revolute") {
            let axis = joint
                .children()
                .find(|one| one.has_tag_name("axis"))
                .unwrap();
            let axis = Vector3::from(numbers(axis.attribute("xyz").unwrap()));
            frame *= UnitQuaternion::from_scaled_axis(axis * *angles.next().unwrap());
        }
    }
    assert!(angles.next().is_none(), "seven joints");
    frame
}

fn assert_limits(joint: &Node<'_, '_>, place: usize) {
    let limit = joint
        .children()
        .find(|one| one.has_tag_name("limit"))
        .unwrap();
    let number = |key: &str| limit.attribute(key).unwrap().parse::<f64>().unwrap();
    let told = ["lower", "upper", "velocity"].map(|key| number(key).to_bits());
    let meant = [
        POSITION_MIN_RAD[place],
        POSITION_MAX_RAD[place],
        SPEED_MAX_RAD_PER_S[place],
    ];
    assert_eq!(told, meant.map(f64::to_bits), "joint {place}");
}

#[test]
fn the_description_puts_the_tools_where_the_models_do() {
    let folder = RunFolder::new("documents");
    let mut command = Command::new(hil_runtime_binary());
    let written = command.arg("documents").arg(folder.path());
    child::run(written, Duration::from_mins(1)).unwrap();
    let text = fs::read_to_string(folder.path().join("robots/yumi.urdf")).unwrap();
    let document = Document::parse(&text).unwrap();
    let robot = document.root_element();
    assert!(robot.has_tag_name("robot"));
    let mut random = RandomStream::new(SEED, "postures");
    let (mut largest_m, mut largest_rad) = (0.0_f64, 0.0_f64);
    for (side, arm) in [("right", Arm::right()), ("left", Arm::left())] {
        let chain = chain(&robot, &format!("{side}_tool"));
        let turning = chain
            .iter()
            .filter(|one| one.attribute("type") == Some("revolute"));
        for (place, joint) in turning.enumerate() {
            assert_eq!(
                joint.attribute("name"),
                Some(joint_name(side, place).as_str())
            );
            assert_limits(joint, place);
        }
        for _ in 0..POSTURES {
            let q_rad: Joints = core::array::from_fn(|place| {
                let share = random.next_u64() as f64 / u64::MAX as f64;
                POSITION_MIN_RAD[place]
                    + share * (POSITION_MAX_RAD[place] - POSITION_MIN_RAD[place])
            });
            let (told, meant) = (tool(&chain, &q_rad), arm.tool(&q_rad));
            let apart_m = (told.translation.vector - meant.translation.vector).norm();
            largest_m = largest_m.max(apart_m);
            largest_rad = largest_rad.max(told.rotation.angle_to(&meant.rotation));
        }
    }
    println!(
        "{POSTURES} postures of each arm, seed {SEED}: at most {largest_m:.1e} m and {largest_rad:.1e} rad apart"
    );
    assert!(largest_m < ALLOWED && largest_rad < ALLOWED);
}

#[test]
fn every_link_has_a_shape_with_a_size_and_one_joint_above_it() {
    let text = Urdf.to_string();
    let document = Document::parse(&text).unwrap();
    let robot = document.root_element();
    let links = robot.children().filter(|one| one.has_tag_name("link"));
    let mut link_count = 0;
    for link in links {
        let name = link.attribute("name").unwrap();
        let shapes = link.descendants().filter(|one| {
            ["cylinder", "sphere"]
                .iter()
                .any(|shape| one.has_tag_name(*shape))
        });
        let sizes = shapes.flat_map(|one| one.attributes().map(|size| size.value().to_owned()));
        let sizes: Vec<f64> = sizes.map(|size| size.parse().unwrap()).collect();
        assert!(
            sizes.len() >= 3 && sizes.iter().all(|size| *size > 0.0),
            "{name}"
        );
        let above = robot.children().filter(|one| {
            one.has_tag_name("joint") && child_of(one, "child").attribute("link") == Some(name)
        });
        assert_eq!(above.count(), usize::from(name != "body"), "{name}");
        link_count += 1;
    }
    assert_eq!(link_count, 1 + 2 * (JOINT_COUNT + 1));
}
