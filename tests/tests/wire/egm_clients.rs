//! Foreign programs drive our robot through its EGM adapter: the packages `ABBRobotEGM` and
//! `abb_robot_client`, a process each, by the scripts in `tests/egm_clients`. Opt-in, because they
//! come from the network: `HIL_EGM_CLIENTS` names a Python that has both (see
//! `tests/egm_clients/requirements.txt`), `HIL_EGM_CLIENT_SECONDS` how long each drives (10;
//! the acceptance asks for 60).

use std::process::Command;
use std::time::Duration;
use std::{env, thread};

use hil_account::MessageFate;
use hil_arm::egm::messages::{EgmEvent, EgmEventKind, EndCause, MotionKind, Side};
use hil_tests::account::{account, assert_account_closes};
use hil_tests::arms::{Arms, of_kind};
use hil_tests::binary::workspace_folder;
use hil_tests::child::ChildGuard;
use hil_tests::ports::own_ports;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, load_average, wait_until};
use nix::sys::signal::Signal;

/// Names the Python to run the clients with.
const PYTHON_VARIABLE: &str = "HIL_EGM_CLIENTS";
/// How long each client drives, seconds.
const SECONDS_VARIABLE: &str = "HIL_EGM_CLIENT_SECONDS";

const LIMIT: Duration = Duration::from_mins(1);
/// How long the second client drives, of a robot that goes on where it stands.
const AGAIN: Duration = Duration::from_secs(4);
const CYCLE_NS: i64 = 4_000_000;
const SECOND_NS: i64 = 1_000_000_000;
/// What the clients swing, degrees in wire order, J1 to J6 and J7: all different, so that no joint
/// can be taken for another.
const AMPLITUDES_DEG: [f64; 7] = [4.0, -6.0, 8.0, -5.0, 7.0, -9.0, 3.0];
/// Where the joints of the wire stand in chain order.
const CHAIN_TO_WIRE: [usize; 7] = [0, 1, 6, 2, 3, 4, 5];
/// Lag of the control law at a gain of 20/s and of four cycles until a motion is measured.
const LAG_NS: i64 = 66_000_000;

/// The Python to use; `None`, with the reason printed, where none is named.
fn python_or_skip() -> Option<String> {
    let python = env::var(PYTHON_VARIABLE)
        .ok()
        .filter(|name| !name.is_empty());
    let Some(python) = python else {
        eprintln!(
            "skipped: {PYTHON_VARIABLE} names no Python with ABBRobotEGM and abb_robot_client"
        );
        return None;
    };
    for package in ["ABBRobotEGM", "abb_robot_client.egm"] {
        let import = format!("import {package}");
        let output = Command::new(&python).args(["-c", &import]).output();
        let output = output.unwrap_or_else(|error| panic!("{PYTHON_VARIABLE} = {python}: {error}"));
        let words = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{python} cannot {import}: {words}");
    }
    Some(python)
}

fn driving_time() -> Duration {
    let seconds = env::var(SECONDS_VARIABLE)
        .ok()
        .and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(10))
}

/// A run of our robot with one arm open to a client.
struct Robot {
    run: ChildGuard,
    files: RunFiles,
    client: Command,
    folder: RunFolder,
}

impl Robot {
    /// Starts the robot, as ought to be done first; then names the client that may come.
    fn start(python: &str, script: &str, restart: &str) -> Self {
        let port = own_ports();
        let folder = RunFolder::new(restart);
        let trial = Trial::shipped("egm-client.toml", folder.path())
            .set(&format!("processes.client.egm.right=\"127.0.0.1:{port}\""))
            .set(&format!("case.parameters.egm.restart=\"{restart}\""))
            .set("case.parameters.egm.preset=\"paper\"")
            .set("run.duration=\"10 min\"");
        let run = trial.start_here();
        let files = trial.folder("", LIMIT);
        let amplitudes: Vec<_> = AMPLITUDES_DEG.iter().map(ToString::to_string).collect();
        let mut client = Command::new(python);
        client
            .current_dir(workspace_folder().join("tests/egm_clients"))
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .args([script, "--port", &port.to_string()])
            .arg(format!("--amplitudes={}", amplitudes.join(",")));
        let robot = Self {
            run,
            files,
            client,
            folder,
        };
        let has_begun = || robot.files.record_bytes("egm.right.feedback.published.") > 10_000;
        wait_until(LIMIT, "the robot's first cycles", has_begun);
        robot
    }

    /// Starts the client, lets it drive for `span` from its first command on, and kills it as
    /// nothing else can.
    fn drive(&mut self, span: Duration) {
        let mut client = ChildGuard::spawn(&mut self.client).unwrap();
        let commands = || self.files.record_bytes("egm.right.command.published.");
        let before = commands();
        wait_until(LIMIT, "the client's commands", || {
            commands() > before + 2_000
        });
        thread::sleep(span);
        assert!(client.is_running(), "{}", client.stderr_so_far());
        client.signal(Signal::SIGKILL).unwrap();
        client.wait_within(LIMIT).unwrap();
    }

    /// Ends the run.
    fn finish(mut self) -> (RunFiles, RunFolder) {
        self.run.signal(Signal::SIGINT).unwrap();
        let finished = self.run.wait_within(LIMIT).unwrap();
        assert_eq!(finished.status.code(), Some(130), "{}", finished.stderr);
        let Self { files, folder, .. } = self;
        (files, folder)
    }
}

/// Arrivals of one client, from its first to its last.
fn visits(arrivals_ns: &[i64]) -> Vec<(i64, i64)> {
    let mut visits: Vec<(i64, i64)> = Vec::new();
    for at in arrivals_ns {
        match visits.last_mut() {
            Some((_, last)) if at - *last < SECOND_NS * 9 / 10 => *last = *at,
            _ => visits.push((*at, *at)),
        }
    }
    visits
}

/// Checks what must hold while a client is there.
fn assert_driven(arms: &Arms, first: i64, last: i64) {
    let story = arms.history(Side::Right);
    let events = arms.events(Side::Right);
    let ended = of_kind(&events, EgmEventKind::Ended);
    let during: Vec<_> = ended
        .filter(|event| (first..=last).contains(&event.at_ns))
        .collect();
    assert!(
        during.is_empty(),
        "a session ended while the client was there:\n{story}"
    );

    let arrivals = arms.arrivals_ns(Side::Right);
    let cycles = arms.feedbacks(Side::Right);
    let cycles: Vec<i64> = cycles.iter().map(|(at, _)| *at).collect();
    let cycles: Vec<_> = cycles
        .windows(2)
        .filter(|pair| first <= pair[0] && pair[1] <= last)
        .collect();
    let is_in_time = |pair: &&&[i64]| {
        let next = arrivals.partition_point(|at| *at < pair[0]);
        arrivals.get(next).is_some_and(|at| *at < pair[1])
    };
    // In time or not depends on this machine's load; whether the client answers does not.
    let in_time = cycles.iter().filter(is_in_time).count();
    let answered = arrivals
        .iter()
        .filter(|at| (first..last).contains(*at))
        .count();
    let ratio = answered as f64 / cycles.len() as f64;
    let load = load_average();
    println!(
        "{} cycles, {answered} answers, {in_time} before the next cycle; load {load}",
        cycles.len()
    );
    assert!(
        (0.95..1.01).contains(&ratio),
        "{ratio} answers per cycle; load {load}"
    );

    // The ramps of client and robot are over by then.
    let follows = arms.follow(Side::Right, first + 3 * SECOND_NS..last, LAG_NS);
    let senses = arms.sense(Side::Right, first + 3 * SECOND_NS..last);
    for (place, follow) in follows.iter().enumerate() {
        let asked_deg = AMPLITUDES_DEG[CHAIN_TO_WIRE[place]];
        println!("chain place {place}: {follow:?}, {asked_deg} deg asked");
        let sense = senses[place] * asked_deg.signum();
        assert!(sense > 0.99, "place {place} goes the wrong way: {sense}");
        let amplitude_deg = asked_deg.abs();
        let error_deg = (follow.commanded_deg - amplitude_deg).abs();
        assert!(
            error_deg < 0.02 * amplitude_deg,
            "place {place}: {follow:?}"
        );
        assert!(
            (follow.gain - 1.0).abs() < 0.05,
            "place {place}: {follow:?}"
        );
    }
}

/// Checks that the session ended a second after `last`, and why; gives the event.
fn assert_timed_out(arms: &Arms, last: i64) -> EgmEvent {
    let story = arms.history(Side::Right);
    let events = arms.events(Side::Right);
    let mut ended = of_kind(&events, EgmEventKind::Ended);
    let ended = *ended.find(|event| event.at_ns > last).unwrap();
    assert_eq!(ended.cause, EndCause::CommTimeout as u32, "{story}");
    let silence_ns = ended.at_ns - last;
    println!(
        "timed out {} ms after the last command",
        silence_ns as f64 * 1e-6
    );
    assert!(
        (silence_ns - SECOND_NS).abs() <= CYCLE_NS,
        "{silence_ns} ns\n{story}"
    );
    assert!(
        ended.describe().contains("(CommTimeout = 1 s)"),
        "{}",
        ended.describe()
    );
    ended
}

/// The first event of `kind` after `at`, seconds later.
fn after(arms: &Arms, kind: EgmEventKind, at: i64) -> Option<(EgmEvent, f64)> {
    let events = arms.events(Side::Right);
    let found = of_kind(&events, kind)
        .find(|event| event.at_ns >= at)
        .copied();
    found.map(|event| (event, (event.at_ns - at) as f64 * 1e-9))
}

/// One client from start to kill after the first of `spans`, and once more for the second, with `restart` in
/// between; 1.5 s at least is how long the robot takes to go on.
fn driven_twice(script: &str, restart: &str, spans: [Duration; 2]) -> Option<(Arms, EgmEvent)> {
    let python = python_or_skip()?;
    let mut robot = Robot::start(&python, script, restart);
    robot.drive(spans[0]);
    thread::sleep(Duration::from_millis(1_500));
    robot.drive(spans[1]);
    let (files, _folder) = robot.finish();
    let arms = Arms::of(&files);
    println!("{script}, {restart}:\n{}", arms.history(Side::Right));
    let visits = visits(&arms.arrivals_ns(Side::Right));
    let [first, second] = visits[..] else {
        panic!("two visits, not {visits:?}");
    };
    assert_driven(&arms, first.0, first.1);
    let ended = assert_timed_out(&arms, first.1);
    // The second client may find a session under way or wait for the next; then it stays.
    let events = arms.events(Side::Right);
    let ended_again = of_kind(&events, EgmEventKind::Ended);
    let mut during = ended_again.filter(|event| (second.0..second.1).contains(&event.at_ns));
    assert_eq!(during.next(), None, "{}", arms.history(Side::Right));

    let summary = files.summary();
    for channel in ["egm/right/command", "egm/right/feedback"] {
        assert_account_closes(&summary, channel);
        let account = account(&summary, channel);
        assert_eq!(account.fates.of(MessageFate::Unexplained), 0, "{channel}");
    }
    let report = files.read("report-full.txt");
    let adapter = report.split("EGM robot adapter").nth(1).unwrap();
    println!(
        "EGM robot adapter{}",
        adapter.split("Processes").next().unwrap()
    );
    Some((arms, ended))
}

#[test]
fn abb_robot_egm_drives_every_joint_and_the_robot_restarts_after_a_wait() {
    let script = "abb_robot_egm_client.py";
    if let Some((arms, ended)) = driven_twice(script, "wait_then_restart", [driving_time(), AGAIN])
    {
        let (_, waited_s) = after(&arms, EgmEventKind::Activating, ended.at_ns).unwrap();
        assert!((waited_s - 1.5).abs() <= 0.008, "{waited_s} s");
    }
}

#[test]
fn abb_robot_client_drives_every_joint_and_the_robot_restarts_at_once() {
    let script = "abb_robot_client_client.py";
    if let Some((arms, ended)) = driven_twice(script, "auto_retry", [driving_time(), AGAIN]) {
        let (_, waited_s) = after(&arms, EgmEventKind::Activating, ended.at_ns).unwrap();
        assert!(waited_s <= 0.008, "{waited_s} s");
    }
}

#[test]
fn after_a_time_out_the_robot_goes_home_before_it_takes_the_next_client() {
    let script = "abb_robot_egm_client.py";
    // The robot goes home while the second client is there.
    let spans = [Duration::from_secs(10), Duration::from_secs(6)];
    let spans = [driving_time().min(spans[0]), spans[1]];
    if let Some((arms, ended)) = driven_twice(script, "go_home_first", spans) {
        let (began, _) = after(&arms, EgmEventKind::MotionBegan, ended.at_ns).unwrap();
        assert_eq!(began.cause, MotionKind::Home as u32);
        let (home, _) = after(&arms, EgmEventKind::MotionEnded, began.at_ns).unwrap();
        let (_, waited_s) = after(&arms, EgmEventKind::Activating, home.at_ns).unwrap();
        assert!(waited_s <= 0.1, "{waited_s} s");
    }
}
