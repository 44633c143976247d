//! Tests of [`super`]: the robot alone, message by message.

use bytemuck::Zeroable;

use super::*;
use hil_arm::egm::messages::{
    EgmEventKind, EgmStartParameters, MotionKind, MotionOutcome, MotionRefusal, SessionState,
};
use hil_arm::egm::parameters::{EgmParameters, GuidedArms, Preset, StartMode};
use hil_arm::yumi::Pose;
use hil_arm::yumi::arm::POSITION_MAX_RAD;
use hil_core::component::Role;
use hil_core::message::Message;

const CYCLE_NS: i64 = 4_000_000;

fn settings() -> ControllerSettings {
    EgmParameters {
        preset: Preset::Paper,
        activation_s: Some(0.1),
        control_delay_cycles: Some(2),
        ..EgmParameters::default()
    }
    .settings()
    .unwrap()
}

/// A robot, when it is, and what it said so far.
struct Bench {
    robot: Box<dyn Role>,
    now: Instant,
    responses: Vec<MotionResponse>,
    feedback: [Vec<EgmFeedback>; 2],
    events: Vec<EgmEvent>,
    arrival_count: usize,
}

impl Bench {
    fn new() -> Self {
        Self::with(settings())
    }

    fn with(settings: ControllerSettings) -> Self {
        let mut robot = Robot::new(settings).into_role();
        robot.start(Instant::ZERO);
        Self {
            robot,
            now: Instant::ZERO,
            responses: Vec::new(),
            feedback: [Vec::new(), Vec::new()],
            events: Vec::new(),
            arrival_count: 0,
        }
    }

    fn listen(&mut self, said: &[(usize, Vec<u8>)]) {
        for (port, bytes) in said {
            match self.robot.outputs()[*port].name {
                EGM_RIGHT_FEEDBACK => self.feedback[0].push(bytemuck::pod_read_unaligned(bytes)),
                EGM_LEFT_FEEDBACK => self.feedback[1].push(bytemuck::pod_read_unaligned(bytes)),
                MOTION_RESPONSE => self.responses.push(bytemuck::pod_read_unaligned(bytes)),
                EGM_EVENT => self.events.push(bytemuck::pod_read_unaligned(bytes)),
                _ => self.arrival_count += 1,
            }
        }
    }

    fn hear<M: Message>(&mut self, channel: &str, message: &M) {
        let mut said = Vec::new();
        let mut emit = |port, bytes: &[u8]| said.push((port, bytes.to_vec()));
        self.robot.hear(self.now, channel, message, &mut emit);
        self.listen(&said);
    }

    fn tick(&mut self, at: Instant) {
        let mut said = Vec::new();
        let mut emit = |port, bytes: &[u8]| said.push((port, bytes.to_vec()));
        self.robot.tick(at, &mut emit);
        self.listen(&said);
    }

    /// Punctual ticks for `seconds`.
    fn run(&mut self, seconds: f64) {
        let end = self.now + Duration::from_secs_f64(seconds);
        while let Some(due) = self.robot.next_tick().filter(|due| *due <= end) {
            self.tick(due);
        }
        self.now = end;
    }

    /// The outcome of a request: at once, and, when it began something, within `seconds`.
    fn ask(&mut self, request: &MotionRequest, seconds: f64) -> Vec<MotionResponse> {
        self.responses.clear();
        self.hear(MOTION_REQUEST, request);
        self.run(seconds);
        let mut answers = self.responses.clone();
        answers.retain(|answer| answer.request_id == request.request_id);
        answers
    }

    fn newest(&self, side: Side) -> &EgmFeedback {
        self.feedback[side.index()].last().unwrap()
    }
}

fn request(kind: MotionKind, arms: &[Side]) -> MotionRequest {
    MotionRequest {
        request_id: 7,
        kind: kind as u32,
        arms: arms.iter().map(|side| MotionRequest::bit(*side)).sum(),
        joints_rad: START_RAD,
        poses: [Pose::zeroed(); 2],
        speed: 0.0,
        egm: EgmStartParameters::KEEP,
    }
}

fn is_same(a: &Joints, b: &Joints) -> bool {
    a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}

fn outcomes(answers: &[MotionResponse]) -> Vec<u32> {
    answers.iter().map(|answer| answer.outcome).collect()
}

const ACCEPTED: u32 = MotionOutcome::Accepted as u32;
const DONE: u32 = MotionOutcome::Done as u32;
const REFUSED: u32 = MotionOutcome::Refused as u32;
const INTERRUPTED: u32 = MotionOutcome::Interrupted as u32;

#[track_caller]
fn check_refused(bench: &mut Bench, request: &MotionRequest, why: MotionRefusal, side: Side) {
    let before = Side::BOTH.map(|side| bench.newest(side).planned_rad);
    let answers = bench.ask(request, 0.5);
    assert_eq!(outcomes(&answers), [REFUSED]);
    assert_eq!(answers[0].refusal, why as u32, "{:?}", answers[0]);
    assert_eq!(answers[0].refused_side, side.number());
    for side in Side::BOTH {
        assert!(is_same(
            &bench.newest(side).planned_rad,
            &before[side.index()]
        ));
        assert_eq!(bench.newest(side).state, SessionState::Idle as u32);
    }
}

#[test]
fn the_state_is_told_at_once_and_only_once() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let answers = bench.ask(&request(MotionKind::GetState, &[]), 0.1);
    assert_eq!(outcomes(&answers), [DONE]);
    assert_eq!(answers[0].states, [SessionState::Idle as u32; 2]);
    for (measured_rad, start_rad) in answers[0].measured_rad.iter().zip(&START_RAD) {
        assert!(is_same(measured_rad, start_rad));
    }
}

#[test]
fn the_arm_that_does_not_start_by_itself_still_serves_requests() {
    let mut bench = Bench::with(ControllerSettings {
        start: StartMode::PowerOn,
        arms: GuidedArms::Right,
        ..settings()
    });
    bench.run(0.5);
    assert_eq!(
        bench.newest(Side::Right).state,
        SessionState::Running as u32
    );
    let left = bench.newest(Side::Left);
    assert_eq!((left.state, left.session), (SessionState::Idle as u32, 0));
    let answers = bench.ask(&request(MotionKind::EgmStart, &[Side::Left]), 0.5);
    assert_eq!(outcomes(&answers), [ACCEPTED, DONE]);
    assert_eq!(bench.newest(Side::Left).state, SessionState::Running as u32);
}

#[test]
fn both_arms_reach_their_joints_together() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let mut both = request(MotionKind::MoveJoints, &Side::BOTH);
    both.joints_rad[0][0] += 0.4;
    both.joints_rad[1][6] -= 0.1;
    let answers = bench.ask(&both, 5.0);
    assert_eq!(outcomes(&answers), [ACCEPTED, DONE]);
    assert_eq!(answers[0].states, [SessionState::Moving as u32; 2]);
    assert_eq!(answers[1].states, [SessionState::Idle as u32; 2]);
    for side in Side::BOTH {
        for (q, target) in bench
            .newest(side)
            .measured_rad
            .iter()
            .zip(&both.joints_rad[side.index()])
        {
            assert!((q - target).abs() < 1e-9, "{q} {target}");
        }
    }
    // The arm with the shorter way took as long.
    let ends = Side::BOTH.map(|side| {
        let moving = SessionState::Moving as u32;
        let all = &bench.feedback[side.index()];
        all.iter()
            .rposition(|feedback| feedback.state == moving)
            .unwrap()
    });
    assert_eq!(ends[0], ends[1]);
}

#[test]
fn the_tool_goes_straight_to_its_pose() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let mut line = request(MotionKind::MoveLinear, &[Side::Right]);
    let tool = arms()[0].tool(&START_RAD[0]);
    let target = nalgebra::Isometry3::translation(0.0, 0.15, 0.05) * tool;
    line.poses[0] = target.into();
    let answers = bench.ask(&line, 3.0);
    assert_eq!(outcomes(&answers), [ACCEPTED, DONE]);
    let reached = nalgebra::Vector3::from(bench.newest(Side::Right).tool.position_m);
    assert!((reached - target.translation.vector).norm() < 1e-4);
    let way = (target.translation.vector - tool.translation.vector).normalize();
    for feedback in &bench.feedback[0] {
        let moved = nalgebra::Vector3::from(feedback.tool.position_m) - tool.translation.vector;
        assert!((moved - moved.dot(&way) * way).norm() < 2e-5);
    }
    assert!(is_same(
        &bench.newest(Side::Left).measured_rad,
        &START_RAD[1]
    ));
}

#[test]
fn what_cannot_be_done_is_refused_with_its_reason_and_moves_no_arm() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let both = |kind| request(kind, &Side::BOTH);
    let mut unknown = both(MotionKind::Home);
    unknown.kind = 99;
    check_refused(
        &mut bench,
        &unknown,
        MotionRefusal::UnknownKind,
        Side::Right,
    );
    let nobody = request(MotionKind::Home, &[]);
    check_refused(&mut bench, &nobody, MotionRefusal::NoArm, Side::Right);
    let mut third = both(MotionKind::Home);
    third.arms |= 4;
    check_refused(&mut bench, &third, MotionRefusal::NoArm, Side::Right);
    let mut nonsense = both(MotionKind::MoveJoints);
    nonsense.joints_rad[1][3] = f64::NAN;
    check_refused(&mut bench, &nonsense, MotionRefusal::BadNumber, Side::Left);
    let mut beyond = both(MotionKind::MoveJoints);
    beyond.joints_rad[0][0] += 0.2;
    beyond.joints_rad[1][2] = POSITION_MAX_RAD[2] + 0.01;
    check_refused(
        &mut bench,
        &beyond,
        MotionRefusal::OutsideLimits,
        Side::Left,
    );
    for speed in [-0.1, 1.1, f64::NAN] {
        let mut fast = both(MotionKind::Home);
        fast.speed = speed;
        check_refused(&mut bench, &fast, MotionRefusal::BadNumber, Side::Right);
    }
    // A pose of zeros is none.
    let no_pose = both(MotionKind::MoveLinear);
    check_refused(&mut bench, &no_pose, MotionRefusal::BadNumber, Side::Right);
    let mut far = both(MotionKind::MoveLinear);
    let [right, left] = arms();
    far.poses[0] = right.tool(&START_RAD[0]).into();
    far.poses[1] =
        (nalgebra::Isometry3::translation(0.5, 0.0, 0.0) * left.tool(&START_RAD[1])).into();
    check_refused(&mut bench, &far, MotionRefusal::Unreachable, Side::Left);
    far.poses[1].position_m[0] = 1e5;
    check_refused(&mut bench, &far, MotionRefusal::Unreachable, Side::Left);
    // 0.21 m at 0.01 m/s is 21 s, more than 5000 cycles.
    let mut slow = both(MotionKind::MoveLinear);
    slow.speed = 0.01;
    slow.poses[0] = right.tool(&START_RAD[0]).into();
    slow.poses[1] =
        (nalgebra::Isometry3::translation(0.0, 0.0, 0.21) * left.tool(&START_RAD[1])).into();
    check_refused(&mut bench, &slow, MotionRefusal::BadNumber, Side::Left);
    let mut bad_start = both(MotionKind::EgmStart);
    bad_start.egm.comm_timeout_s = -1.0;
    check_refused(
        &mut bench,
        &bad_start,
        MotionRefusal::BadNumber,
        Side::Right,
    );
}

#[test]
fn guided_motion_starts_and_stops_by_request() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let start = request(MotionKind::EgmStart, &Side::BOTH);
    let answers = bench.ask(&start, 0.5);
    assert_eq!(outcomes(&answers), [ACCEPTED, DONE]);
    assert_eq!(answers[0].states, [SessionState::Activating as u32; 2]);
    assert_eq!(answers[1].states, [SessionState::Running as u32; 2]);

    let refused = bench.ask(&request(MotionKind::Home, &[Side::Left]), 0.1);
    assert_eq!(outcomes(&refused), [REFUSED]);
    assert_eq!(refused[0].refusal, MotionRefusal::GuidedMotionRuns as u32);
    let again = bench.ask(&start, 0.1);
    assert_eq!(outcomes(&again), [REFUSED]);
    assert_eq!(again[0].refusal, MotionRefusal::GuidedMotionRuns as u32);

    let stop = request(MotionKind::EgmStop, &[Side::Left]);
    let stopped = bench.ask(&stop, 1.0);
    assert_eq!(outcomes(&stopped), [ACCEPTED, DONE]);
    assert_eq!(stopped[1].states[1], SessionState::Idle as u32);
    assert_ne!(stopped[1].states[0], SessionState::Idle as u32);
}

#[test]
fn a_stop_interrupts_a_start() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let mut start = request(MotionKind::EgmStart, &[Side::Right]);
    start.request_id = 1;
    bench.hear(MOTION_REQUEST, &start);
    bench.run(0.02);
    let stop = request(MotionKind::EgmStop, &[Side::Right]);
    bench.hear(MOTION_REQUEST, &stop);
    bench.run(0.5);
    let of_start: Vec<_> = bench
        .responses
        .iter()
        .filter(|answer| answer.request_id == 1)
        .map(|answer| answer.outcome)
        .collect();
    assert_eq!(of_start, [ACCEPTED, INTERRUPTED]);
}

#[test]
fn requests_of_one_instant_are_carried_out_one_per_cycle_and_a_flood_is_refused() {
    let mut bench = Bench::new();
    bench.run(0.1);
    let mut away = request(MotionKind::MoveJoints, &[Side::Right]);
    away.joints_rad[0][0] += 0.3;
    bench.hear(MOTION_REQUEST, &away);
    for _ in 0..200 {
        bench.hear(MOTION_REQUEST, &request(MotionKind::Home, &Side::BOTH));
    }
    bench.run(0.5);
    assert_eq!(bench.arrival_count, 201);
    let refused = bench
        .responses
        .iter()
        .filter(|answer| answer.outcome == REFUSED);
    assert_eq!(refused.clone().count(), 200);
    assert!(
        refused
            .clone()
            .all(|answer| answer.refusal == MotionRefusal::Busy as u32)
    );
    // The home of the left arm was not begun while the right was on its way.
    assert!(is_same(
        &bench.newest(Side::Left).measured_rad,
        &START_RAD[1]
    ));
}

#[test]
fn a_late_robot_moves_as_a_punctual_one_and_reports_its_newest_cycle_only() {
    let run = |ticks_ns: &[i64]| {
        let mut bench = Bench::new();
        let mut ticks = ticks_ns.iter().copied().peekable();
        let mut arrivals = vec![(6_100_000, None)];
        // Commands every 8 ms, with the arm on its way to running at first.
        arrivals.extend((1..300).map(|index| (index * 8_000_000 + 1_234_567, Some(index))));
        for (at_ns, index) in arrivals {
            while let Some(tick_ns) = ticks.next_if(|tick_ns| *tick_ns <= at_ns) {
                bench.tick(Instant::from_ns(tick_ns));
            }
            bench.now = Instant::from_ns(at_ns);
            let Some(index) = index else {
                let start = request(MotionKind::EgmStart, &Side::BOTH);
                bench.hear(MOTION_REQUEST, &start);
                continue;
            };
            let mut command = EgmCommand::zeroed();
            command.position_rad = START_RAD[0];
            command.position_rad[0] += 1e-3 * index as f64;
            bench.hear(EGM_RIGHT_COMMAND, &command);
        }
        for tick_ns in ticks {
            bench.tick(Instant::from_ns(tick_ns));
        }
        bench
    };
    let punctual: Vec<i64> = (0..700).map(|index| index * CYCLE_NS).collect();
    let mut stream = hil_core::random::RandomStream::new(5, "late ticks");
    let mut at_ns = 0;
    let mut late = vec![0];
    while at_ns < 699 * CYCLE_NS {
        // Up to 100 ms late, sometimes just in time.
        at_ns += i64::try_from(stream.next_u64() % 100_000_000).unwrap();
        late.push(at_ns);
    }
    let (punctual, late) = (run(&punctual), run(&late));
    assert!(late.robot.skipped_ticks() > 100);
    assert!(late.feedback[0].len() < punctual.feedback[0].len() / 2);
    let moved = |bench: &Bench| bench.newest(Side::Right).measured_rad[0] - START_RAD[0][0];
    assert!(moved(&punctual) > 0.2, "{}", moved(&punctual));
    for side in 0..2 {
        for feedback in &late.feedback[side] {
            let index = usize::try_from(feedback.cycle_index).unwrap();
            if let Some(other) = punctual.feedback[side].get(index) {
                assert_eq!(bytemuck::bytes_of(feedback), bytemuck::bytes_of(other));
            }
        }
    }
    // What happened to the sessions is told of every cycle, late or not.
    let count = |bench: &Bench| bench.events.len();
    assert!(count(&punctual) > 0);
    let started = EgmEventKind::Started as u32;
    assert!(late.events.iter().any(|event| event.kind == started));
    let until = late.newest(Side::Right).cycle_index;
    let early = punctual
        .events
        .iter()
        .filter(|event| event.cycle_index <= until);
    assert_eq!(
        early.count(),
        late.events
            .iter()
            .filter(|event| event.cycle_index < 700)
            .count()
    );
}

#[test]
fn a_command_acts_only_from_the_first_grid_point_later_than_its_arrival() {
    // On the very grid point of cycle 50, and a nanosecond before it.
    let first_taken = |arrived_ns: i64| {
        let mut bench = Bench::new();
        bench.ask(&request(MotionKind::EgmStart, &[Side::Right]), 0.199);
        let tick = Instant::from_ns(arrived_ns);
        while let Some(due) = bench.robot.next_tick().filter(|due| *due < tick) {
            bench.tick(due);
        }
        bench.now = tick;
        let mut command = EgmCommand::zeroed();
        command.position_rad = START_RAD[0];
        bench.hear(EGM_RIGHT_COMMAND, &command);
        bench.run(0.1);
        let took = |feedback: &&EgmFeedback| feedback.has(EgmFeedback::HAS_REFERENCE);
        bench.feedback[0].iter().find(took).unwrap().cycle_index
    };
    let at_ns = 50 * CYCLE_NS;
    assert_eq!(first_taken(at_ns), first_taken(at_ns - 1) + 1);
}
