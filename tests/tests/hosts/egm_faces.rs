//! Our controller drives our robot as two strangers would: each run knows the other only by the
//! robot maker's datagrams, sensor adapter on one host, robot adapter on the other.

use core::ops::Range;
use std::collections::BTreeSet;
use std::net::{SocketAddrV4, UdpSocket};
use std::path::Path;
use std::thread;
use std::time::Duration;

use hil_arm::egm::messages::{EgmEventKind, Side};
use hil_arm::yumi::Joints;
use hil_arm::yumi::arm::Arm;
use hil_platform::clock::MonotonicClock;
use hil_report::adapter::AdapterSummary;
use hil_report::summary::{Outcome, RunSummary};
use hil_rundir::pipe::{AdapterRefusal, RefusalCount};
use hil_tests::account::assert_account_closes;
use hil_tests::arms::{Arms, of_kind};
use hil_tests::attacker::{Attacker, FOREIGN, Quoted, reports_v4};
use hil_tests::child::ChildGuard;
use hil_tests::lab::{ADDRESSES, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, load_average, wait_until};
use hil_tests::turns::{Bound, Cost, TURN, play, round_count};
use nix::sys::signal::Signal;

const LIMIT: Duration = Duration::from_mins(2);
/// Datagrams that come from an address that is nobody's.
const SPOKEN_COUNT: u64 = 1_500;
/// How long a stranger takes the sensor's address.
const CLAIMED_FOR: Duration = Duration::from_secs(1);
/// How long the runs go on when it has it again.
const AFTERWARDS: Duration = Duration::from_millis(1200);
const SECOND_NS: i64 = 1_000_000_000;
/// Lag of the control law at a gain of 20/s, four cycles until a motion is measured, and one of
/// them until a command is used.
const LAG_NS: i64 = 70_000_000;
/// Joints that swing less say nothing about following.
const SWING_DEG_MIN: f64 = 1.0;

/// Times the tool went to one side and back, by what it did between a quarter and three quarters
/// of its way.
fn loops(arm: &Arm, joints: impl Iterator<Item = Joints>) -> u32 {
    let sides: Vec<f64> = joints.map(|q_rad| arm.tool(&q_rad).translation.y).collect();
    let low = sides.iter().copied().fold(f64::INFINITY, f64::min);
    let high = sides.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let (mut count, mut is_up) = (0, false);
    for side in sides {
        let share = (side - low) / (high - low);
        if is_up && share < 0.25 {
            is_up = false;
        } else if !is_up && share > 0.75 {
            is_up = true;
            count += 1;
        }
    }
    count
}

fn adapter<'a>(summary: &'a RunSummary, arm: &str) -> &'a AdapterSummary {
    let mut faces = summary.faces.iter();
    let found = faces.find(|adapter| adapter.arm.word() == arm);
    found.unwrap_or_else(|| panic!("no adapter of the {arm} arm"))
}

fn count(adapter: &AdapterSummary, name: &str) -> u64 {
    let mut counters = adapter.counters.iter();
    let found = counters.find(|counter| counter.label() == name);
    found
        .unwrap_or_else(|| panic!("{name} is not counted"))
        .count
}

fn p99_us(adapter: &AdapterSummary, name: &str) -> f64 {
    let mut segments = adapter.segments.iter();
    let found = segments.find(|segment| segment.name == name);
    let figures = found.and_then(|segment| segment.distribution.measured());
    figures
        .unwrap_or_else(|| panic!("{name} is unavailable"))
        .p99_ns as f64
        * 1e-3
}

/// What the controller's host and the robot's host must have recorded of one arm.
fn assert_driven(here: &Arms, there: &Arms, side: Side, arm: &Arm) {
    let story = there.history(side);
    println!("{story}");
    // The robot may time out before its sensor is there, and surely when it has gone.
    let arrivals = there.arrivals_ns(side);
    let (first, last) = (arrivals[0], *arrivals.last().unwrap());
    let events = there.events(side);
    let mut ended = of_kind(&events, EgmEventKind::Ended);
    assert!(
        !ended.any(|event| (first..last).contains(&event.at_ns)),
        "{story}"
    );

    // Both hosts read one clock here.
    let window_ns = first + 5 * SECOND_NS..last;
    let is_inside = |at: &i64| window_ns.contains(at);
    let commanded = here
        .commands(side)
        .into_iter()
        .filter(|(at, _)| is_inside(at));
    let commanded = loops(arm, commanded.map(|(_, one)| one.position_rad));
    let moved = here
        .feedbacks(side)
        .into_iter()
        .filter(|(at, _)| is_inside(&(at - LAG_NS)));
    let moved = loops(arm, moved.map(|(_, one)| one.measured_rad));
    println!("{} arm: {moved} of {commanded} loops", side.word());
    assert!(commanded >= 2, "{commanded} loops were asked for");
    assert_eq!(
        moved,
        commanded,
        "{} arm; load {}",
        side.word(),
        load_average()
    );
    for (place, follow) in here.follow(side, window_ns, LAG_NS).iter().enumerate() {
        println!("{} arm, chain place {place}: {follow:?}", side.word());
        if follow.commanded_deg >= SWING_DEG_MIN {
            assert!(
                (follow.gain - 1.0).abs() < 0.05,
                "place {place}: {follow:?}"
            );
        }
    }
}

/// The robot of a run of its own, whose arms both ask the sensor on the first host.
fn robot_of_both_arms(record: &Path, duration: &str) -> Trial {
    let address = ADDRESSES[0];
    Trial::shipped("egm-client.toml", record)
        .set(duration)
        .set("case.parameters.egm.preset=\"paper\"")
        .set("case.parameters.egm.arms=\"both\"")
        .set(&format!("processes.client.egm.right=\"{address}:6510\""))
        .set(&format!("processes.client.egm.left=\"{address}:6511\""))
}

/// Ends a run that goes on until then.
fn interrupt(run: &mut ChildGuard) {
    assert!(run.is_running(), "{}", run.stderr_so_far());
    run.signal(Signal::SIGINT).unwrap();
    run.wait_within(LIMIT).unwrap().assert_code(130);
}

#[test]
fn our_controller_drives_our_robot_over_nothing_but_the_makers_datagrams() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let folder = RunFolder::new("faces");
    let (here, there) = (folder.join("sensor"), folder.join("robot"));
    let sensor = Trial::shipped("egm-robot.toml", &here)
        .set("run.duration=\"10 min\"")
        .set("case.parameters.left_arm=\"mirror\"");
    let robot = robot_of_both_arms(&there, "run.duration=\"16 s\"");
    let mut sensor_run = sensor.start_on(lab.host(0));
    let sensor_files = sensor.folder("", LIMIT);
    let mut robot_run = robot.start_on(lab.host(1));
    let robot_files = robot.folder("", LIMIT);
    wait_until(LIMIT, "the robot at the sensor", || {
        sensor_files.record_bytes("egm.right.feedback.published.") > 10_000
    });
    let (spoken_count, answer_count) = speak_as_a_stranger(&lab);
    println!("a stranger: {spoken_count} datagrams, {answer_count} answers");
    assert_eq!(answer_count, 0);
    robot_run.wait_within(LIMIT).unwrap().assert_success();
    interrupt(&mut sensor_run);
    println!(
        "{}\n{}",
        sensor_files.read("report-full.txt"),
        robot_files.read("report-full.txt")
    );

    let (here, there) = (Arms::of(&sensor_files), Arms::of(&robot_files));
    for (side, arm) in [(Side::Right, Arm::right()), (Side::Left, Arm::left())] {
        assert_driven(&here, &there, side, &arm);
    }
    judge(
        [&sensor_files.summary(), &robot_files.summary()],
        spoken_count,
    );
    sensor_files.assert_nothing_left_on(lab.host(0));
    robot_files.assert_nothing_left_on(lab.host(1));
}

/// Messages of the robot's run that the sensor's run has, by the robot's clock, with when the robot published them.
fn feedbacks_over(here: &Arms, there: &Arms) -> Vec<(i64, bool)> {
    [Side::Right, Side::Left]
        .into_iter()
        .flat_map(|side| {
            let came = here.feedbacks(side).into_iter();
            let came: BTreeSet<_> = came.map(|(_, one)| one.clock_ms).collect();
            let sent = there.feedbacks(side).into_iter();
            sent.map(move |(at_ns, one)| (at_ns, came.contains(&one.clock_ms)))
                .collect::<Vec<_>>()
        })
        .collect()
}

/// Words about the makers' datagrams, which no seal protects, at both ends. Then the robot's address is taken.
#[test]
fn forged_reports_cost_the_makers_datagrams_nothing_and_a_taken_address_what_is_sent_there() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let stranger = Attacker::join(&lab, FOREIGN);
    let rounds = round_count(4);
    let folder = RunFolder::new("forged-egm");
    let (here, there) = (folder.join("sensor"), folder.join("robot"));
    let sensor = Trial::shipped("egm-robot.toml", &here)
        .set("run.duration=\"10 min\"")
        .set("case.parameters.left_arm=\"mirror\"");
    let robot = robot_of_both_arms(&there, "run.duration=\"10 min\"");
    let mut sensor_run = sensor.start_on(lab.host(0));
    let sensor_files = sensor.folder("", LIMIT);
    let mut robot_run = robot.start_on(lab.host(1));
    let robot_files = robot.folder("", LIMIT);
    wait_until(LIMIT, "the robot at the sensor", || {
        sensor_files.record_bytes("egm.right.feedback.published.") > 10_000
    });
    let ways = [6510, 6511].map(|port| {
        let from = stranger.overhear_sender(port, LIMIT);
        let to = SocketAddrV4::new(ADDRESSES[0], port);
        [[from, to], [to, from]]
    });
    let reports = reports_v4(Quoted::Udp, &ways.concat());
    let all = play(
        &[("ICMP of every type on the makers' datagrams", &|| {
            stranger.send_repeatedly(&reports, TURN).sent_count
        })],
        rounds,
    );
    let now_ns = || MonotonicClock::now().as_ns();
    stranger.claim(ADDRESSES[0], "02:00:00:00:00:70");
    let began_ns = now_ns();
    thread::sleep(CLAIMED_FOR);
    lab.host(1)
        .pin_neighbour(ADDRESSES[0], &lab.host(0).hardware_address());
    let claimed_ns = began_ns..now_ns();
    // More than the second after it.
    thread::sleep(AFTERWARDS);
    for run in [&mut robot_run, &mut sensor_run] {
        interrupt(run);
    }
    let feedbacks = feedbacks_over(&Arms::of(&sensor_files), &Arms::of(&robot_files));
    let cost = |windows_ns: &[Range<i64>]| Cost::of(feedbacks.iter().copied(), windows_ns);
    let bound = Bound {
        sent_min: 500,
        ..Bound::MESSAGES
    };
    all[0].judge("messages of the robot", cost, bound);
    let ends = claimed_ns.end..claimed_ns.end + SECOND_NS;
    let [taken, after] = [claimed_ns, ends].map(|window_ns| cost(&[window_ns]));
    println!(
        "while the sensor's address is taken: {taken:?}; in the second after it is pinned: {after:?}"
    );
    assert!(taken.lost * 2 > taken.sent && after.lost < after.sent);
    for files in [&sensor_files, &robot_files] {
        let summary = files.summary();
        assert_eq!(summary.run.outcome, Outcome::Stopped);
        for face in &summary.faces {
            let ignored = count(face, "socket: ignored_report_count");
            println!(
                "{} {}: {ignored} reports ignored",
                face.kind,
                face.arm.word()
            );
            assert!(ignored > 0, "{:?}", face.counters);
        }
    }
    sensor_files.assert_nothing_left_on(lab.host(0));
    robot_files.assert_nothing_left_on(lab.host(1));
}

/// Datagrams to the sensor of the right arm from an address that is not the robot's, beside those of the robot, for
/// some seconds; gives how many, and the answers.
fn speak_as_a_stranger(lab: &Lab) -> (u64, usize) {
    lab.host(1).add_address(FOREIGN);
    lab.host(1).on_network(|| {
        let socket = UdpSocket::bind((FOREIGN, 0)).unwrap();
        socket.set_nonblocking(true).unwrap();
        let (mut spoken_count, mut answer_count) = (0, 0);
        for number in 0..SPOKEN_COUNT {
            let words = number.to_le_bytes().repeat(12);
            spoken_count += u64::from(socket.send_to(&words, (ADDRESSES[0], 6510)).is_ok());
            thread::sleep(Duration::from_millis(2));
            answer_count += usize::from(socket.recv(&mut [0; 2048]).is_ok());
        }
        (spoken_count, answer_count)
    })
}

/// What both reports must say of their adapters, to one of which a stranger spoke.
fn judge([sensor, robot]: [&RunSummary; 2], spoken_count: u64) {
    for (summary, kind, way, outcome) in [
        (
            sensor,
            "EGM sensor adapter",
            ["feedback", "command"],
            Outcome::Stopped,
        ),
        (
            robot,
            "EGM robot adapter",
            ["command", "feedback"],
            Outcome::Completed,
        ),
    ] {
        assert_eq!(summary.run.outcome, outcome);
        for arm in ["right", "left"] {
            for what in ["command", "feedback"] {
                assert_account_closes(summary, &format!("egm/{arm}/{what}"));
            }
            let adapter = adapter(summary, arm);
            assert_eq!(adapter.kind.to_string(), kind);
            let ratio = adapter.answers.ratio().unwrap();
            println!("{kind}, {arm} arm: {ratio} answered within the cycle");
            let [back, out] = way;
            let inward = p99_us(adapter, &format!("{back} in all: RX stamp → published"));
            let outward = p99_us(adapter, &format!("{out} in all: published → TX stamp"));
            println!("{kind}, {arm} arm: p99 {inward:.0} us in, {outward:.0} us out");
            assert!(
                adapter
                    .cycle_ns
                    .is_some_and(|cycle_ns| (3_900_000..4_100_000).contains(&cycle_ns))
            );
            let is_spoken_to = kind == "EGM sensor adapter" && arm == "right";
            let refused = [RefusalCount {
                cause: AdapterRefusal::ForeignAddress,
                count: spoken_count,
            }];
            let refused = &refused[..usize::from(is_spoken_to)];
            assert_eq!(adapter.refusals, refused, "{arm}");
            assert_eq!(count(adapter, "socket: kernel_drop_count"), 0);
        }
    }
    let right = adapter(sensor, "right");
    let sent = count(right, "datagrams encoded") as f64;
    let attended = right.answers.attended_count as f64;
    assert!(
        sent >= 0.95 * attended,
        "{sent} answers to {attended} messages"
    );
    assert_eq!(count(right, "changes of the robot's address"), 0);
    assert!(
        right.peer_state.contains(&ADDRESSES[1].to_string()),
        "{}",
        right.peer_state
    );
}
