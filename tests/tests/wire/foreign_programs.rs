//! Programs of others at a cable, unchanged, over links that lose nothing, single frames and bursts: what they count
//! themselves beside the account. They take minutes together, and what is missing of them is skipped everywhere.

use std::path::{Path, PathBuf};

use hil_account::flow::FlowMetrics;
use hil_report::summary::RunSummary;

use super::joined_programs::{LIMIT, Place, assert_closed, flow, missing, number_before};

/// Where a Python with the packages of `tests/foreign_programs/requirements-franka.txt` is.
const FRANKA_VARIABLE: &str = "HIL_FRANKA_PYTHON";

/// What is lost on a link, and the words of `join` for it.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Loss {
    Nothing,
    OneInHundred,
    Bursts,
}

impl Loss {
    const ALL: [Self; 3] = [Self::Nothing, Self::OneInHundred, Self::Bursts];

    fn link(self, place: &Place) -> String {
        match self {
            Self::Nothing => "delay 2ms".to_owned(),
            Self::OneInHundred => "delay 2ms loss 1%".to_owned(),
            Self::Bursts => place.copy_of("bursts.toml").display().to_string(),
        }
    }
}

/// Says why nothing is tested.
fn is_skipped(reason: Option<&str>) -> bool {
    if let Some(reason) = reason {
        eprintln!("skipped: {reason}");
    }
    reason.is_some()
}

/// A program that Debian has where only root looks for it.
fn in_sbin(program: &str) -> Option<PathBuf> {
    let folders = ["/usr/sbin", "/usr/local/sbin", "/sbin"];
    let mut paths = folders
        .into_iter()
        .map(|folder| PathBuf::from(folder).join(program));
    paths.find(|path| path.is_file())
}

/// The number behind `words`.
fn number_after(text: &str, words: &str) -> u64 {
    let after = text.split(words).nth(1).unwrap_or_default();
    let digits = after.split(|letter: char| !letter.is_ascii_digit()).next();
    digits
        .unwrap()
        .parse()
        .unwrap_or_else(|_none| panic!("no number after {words}: {text}"))
}

/// What the network lost of these flows; a host lost nothing of them.
fn lost_by_network(flows: &[&FlowMetrics], loss: Loss) -> u64 {
    let harness_count: u64 = flows.iter().map(|one| one.lost_by_harness_count).sum();
    assert_eq!(harness_count, 0, "{flows:#?}");
    let lost_count = flows.iter().map(|one| one.lost_by_network_count).sum();
    assert_eq!(lost_count > 0, loss != Loss::Nothing, "{flows:#?}");
    lost_count
}

/// The flows with these words in their names.
fn flows_of<'a>(summary: &'a RunSummary, words: &str) -> Vec<&'a FlowMetrics> {
    let flows = summary.flows.iter().flat_map(|one| &one.flows);
    flows.filter(|one| one.name.contains(words)).collect()
}

#[test]
#[ignore = "takes half a minute, and sockperf"]
fn sockperf_and_the_account_count_the_same_messages_at_full_length() {
    if is_skipped(missing("sockperf", "sockperf").as_deref()) {
        return;
    }
    for loss in Loss::ALL {
        let place = Place::new("join-sockperf");
        let link = loss.link(&place);
        let client = "sleep 1; exec sockperf under-load -i 10.77.0.2 -p 11111 --mps 1000 --reply-every 1 -t 5";
        let server = ["--", "sockperf", "server", "-i", "10.77.0.2", "-p", "11111"];
        let arguments = [&["--link", &link, "--", "sh", "-c", client], &server[..]].concat();
        place.run(&arguments).assert_success();
        let (summary, said) = (place.summary(), place.said_by("first"));
        assert_closed(&summary);
        let (requests, answers) = (
            flow(&summary, "10.77.0.2:11111"),
            flow(&summary, "udp 10.77.0.2:11111"),
        );
        let total = said.split("[Total Run]").nth(1).unwrap();
        let [sent, received] =
            ["SentMessages=", "ReceivedMessages="].map(|words| number_after(total, words));
        let dropped = number_after(&said, "# dropped messages = ");
        let lost_count = lost_by_network(&[requests, answers], loss);
        println!(
            "sockperf, {loss:?}: {sent} sent, {received} received, {dropped} dropped; account: {} and {} frames, \
             {} taken, {lost_count} lost",
            requests.frame_count, answers.frame_count, answers.taken_count
        );
        assert_eq!(requests.frame_count, sent);
        assert_eq!(answers.frame_count, requests.taken_count);
        // It stops to listen while answers are under way: 4 ms at 1000 a second, and what it took itself.
        assert!(received <= answers.taken_count && received + 50 >= answers.taken_count);
        // It does not count the first 400 ms and the last 50 ms of 5 s.
        assert!(dropped <= lost_count, "{said}");
        assert!(loss == Loss::Nothing || dropped * 2 > lost_count, "{said}");
        for words in ["# duplicated messages = ", "out-of-order messages = "] {
            assert_eq!(number_after(&said, words), 0, "{said}");
        }
        let of = [requests.reordered_count, answers.reordered_count];
        assert_eq!(of, [Some(0), Some(0)]);
        // Half of its round trips.
        assert!(number_after(&said, "avg-latency=") >= 2_000, "{said}");
    }
}

#[test]
#[ignore = "takes half a minute, and mosquitto"]
fn every_message_of_mosquitto_arrives_and_what_its_kernel_sent_again_is_seen_at_full_length() {
    const MESSAGE_COUNT: u64 = 10_000;
    let Some(broker) = in_sbin("mosquitto") else {
        eprintln!("skipped: `mosquitto` is in no sbin (Debian: apt-get install mosquitto)");
        return;
    };
    if is_skipped(missing("mosquitto_pub", "mosquitto-clients").as_deref()) {
        return;
    }
    for loss in Loss::ALL {
        let place = Place::new("join-mosquitto");
        let link = loss.link(&place);
        let script = place.copy_of("mosquitto.sh");
        let settings = "listener 1883 10.77.0.2\nallow_anonymous true\nlog_dest stderr\n";
        let settings = place.folder.write("mosquitto.conf", settings);
        let [script, settings, broker] =
            [&script, &settings, &broker].map(|path| path.to_str().unwrap());
        let count = MESSAGE_COUNT.to_string();
        let clients = ["--link", &link, "--", "sh", script, "10.77.0.2", &count];
        let finished = place.run(&[&clients[..], &["--", broker, "-c", settings]].concat());
        finished.assert_success();
        let (summary, said) = (place.summary(), place.said_by("first"));
        assert_closed(&summary);
        assert_eq!(
            number_before(&said, " messages received in order"),
            MESSAGE_COUNT
        );
        let [of_clients, of_broker] =
            ["tcp 10.77.0.1", "tcp 10.77.0.2"].map(|part| flows_of(&summary, part));
        let again = |flows: &[&FlowMetrics]| -> u64 {
            flows.iter().filter_map(|one| one.retransmitted_count).sum()
        };
        let [again_count, again_of_broker_count] = [again(&of_clients), again(&of_broker)];
        let kernel_count = number_before(&said, " segments sent again");
        let lost_count = lost_by_network(&[&of_clients[..], &of_broker].concat(), loss);
        println!(
            "mosquitto, {loss:?}: {MESSAGE_COUNT} received in order, {kernel_count} sent again by the clients' kernel; \
             account: {again_count} and by the broker {again_of_broker_count}, {lost_count} lost"
        );
        // Segments without data are none of ours: the first and the last of a connection.
        assert!(
            (again_count..=again_count + 5).contains(&kernel_count),
            "{of_clients:#?}"
        );
        assert_eq!(of_clients.len(), 2);
        if loss != Loss::Nothing {
            assert!(again_count > 0 && again_of_broker_count > 0);
        }
    }
}

#[test]
#[ignore = "takes a minute, and ddsperf of Cyclone DDS"]
fn ddsperf_finds_itself_by_multicast_and_loses_what_the_account_says_at_full_length() {
    if is_skipped(missing("ddsperf", "cyclonedds-tools").as_deref()) {
        return;
    }
    for (loss, is_reliable) in [
        (Loss::Nothing, false),
        (Loss::OneInHundred, false),
        (Loss::Bursts, false),
        (Loss::OneInHundred, true),
        (Loss::Bursts, true),
    ] {
        let place = Place::new("join-ddsperf");
        let link = loss.link(&place);
        let effort: &[&str] = if is_reliable { &[] } else { &["-u"] };
        let publisher = ["--link", &link, "--", "ddsperf", "-D", "8"];
        let subscriber = ["--", "ddsperf", "-D", "60"];
        let arguments = [
            &publisher[..],
            effort,
            &["pub", "500Hz", "size", "64"],
            &subscriber,
            effort,
            &["sub"],
        ];
        place.run(&arguments.concat()).assert_success();
        let (summary, said) = (place.summary(), place.said_by("second"));
        assert_closed(&summary);
        let mut discovery = flows_of(&summary, "→ 239.255.0.1:7400").into_iter();
        assert!(discovery.any(|one| one.taken_count > 0));
        // Its samples are the most by far; heartbeats and what it found itself by go the same way.
        let samples = flow(&summary, "udp 10.77.0.1");
        let lost_count = lost_by_network(&[samples], loss);
        // Said every second, so what went in the last one may be missing.
        let figures = said.lines().rfind(|line| line.contains(" total "));
        let figures = figures.unwrap_or_else(|| panic!("{said}"));
        let [received, lost] = [" total ", " lost "].map(|words| number_after(figures, words));
        println!(
            "ddsperf, {loss:?}, reliable {is_reliable}: {received} received, {lost} lost; account: {} frames, {} taken, \
             {lost_count} lost",
            samples.frame_count, samples.taken_count
        );
        assert!(received + 600 >= samples.frame_count - lost_count, "{said}");
        if is_reliable {
            // What was lost it sent again, several samples a frame.
            assert_eq!(lost, 0, "{said}");
            assert!(received + 600 >= samples.frame_count, "{said}");
        } else {
            assert!(received <= samples.taken_count, "{said}");
            assert!(lost <= lost_count && lost_count <= lost + 60, "{said}");
        }
    }
}

#[test]
#[ignore = "takes a minute, and a Python with franky-sim and franky-control"]
fn a_franka_robot_and_its_controller_count_the_states_and_commands_of_the_account_at_full_length() {
    let python = std::env::var(FRANKA_VARIABLE).unwrap_or_default();
    if python.is_empty() {
        eprintln!("skipped: {FRANKA_VARIABLE} names no Python with franky-sim and franky-control");
        return;
    }
    for loss in Loss::ALL {
        let place = Place::new("join-franka");
        let packages = ["-c", "import franky, franky_sim"];
        let packages = place.start(&[&python], &packages).wait_within(LIMIT);
        if !packages.unwrap().status.success() {
            eprintln!("skipped: a user without rights cannot use {python} and its packages");
            return;
        }
        let script = place.copy_of("franka.py");
        let topology = place
            .folder
            .write("franka.toml", &franka_topology(&python, &script, loss));
        let program = [place.binary.to_str().unwrap(), "--quiet", "--topology"];
        let mut run = place.start(&program, &[topology.to_str().unwrap()]);
        run.wait_within(LIMIT).unwrap().assert_success();
        place.assert_nothing_left();
        let summary = place.summary();
        assert_closed(&summary);
        let (states, commands) = (flow(&summary, "state"), flow(&summary, "command"));
        let lost_count = lost_by_network(&[states, commands], loss);
        let (controller, robot) = (place.said_by("controller"), place.said_by("robot"));
        let robot = robot.lines().last().unwrap();
        println!(
            "{loss:?}\n{controller}{robot}\n{states:?}\n{commands:?}\n{:?}",
            summary.deadlines
        );
        let [given, cycles] = [" states given", " cycles by the robot's time"]
            .map(|words| number_before(&controller, words));
        assert!(given > 1_000, "{controller}");
        assert_eq!(states.frame_count, number_before(robot, " states sent"));
        assert_eq!(
            commands.taken_count,
            number_before(robot, " commands received")
        );
        // It answers each state that it is given; as it leaves, some need not be counted.
        assert!(
            (given..=given + 5).contains(&commands.frame_count),
            "{controller}"
        );
        // By the robot's time it missed those that were lost, but for what went before its motion. Of states that wait
        // it takes the newest, so on a busy host it misses more.
        let missed = cycles.saturating_sub(given);
        let lost_states_count = states.lost_by_network_count;
        println!("{missed} states missed, {lost_states_count} lost");
        assert!(missed >= lost_states_count * 3 / 4, "{controller}");
        assert!(missed <= lost_states_count + given / 5, "{controller}");
        // The robot's own: cycles in a motion to which no command came. Ours: states without an answer in time.
        let [cycles, served] = [" cycles in motion", " of them with a command"]
            .map(|words| number_before(robot, words));
        let state = &summary.deadlines[0];
        let missing_count = state.missing_by_network_count;
        println!(
            "{served} of {cycles} cycles with a command; {missing_count} without by the network"
        );
        assert_eq!(state.request_count, states.frame_count);
        assert!(missing_count <= lost_count, "{state:?}");
        assert_eq!(missing_count > 0, loss != Loss::Nothing, "{state:?}");
        assert!(cycles - served >= missing_count * 3 / 4, "{robot}{state:?}");
    }
}

fn franka_topology(python: &str, script: &Path, loss: Loss) -> String {
    let script = script.display();
    let loss = match loss {
        Loss::Nothing => "",
        Loss::OneInHundred => "loss_ratio = 0.01",
        Loss::Bursts => r#"loss = { law = "bursts", good_mean = "250 ms", bad_mean = "5 ms" }"#,
    };
    format!(
        r#"version = 1
name = "franka"
[run]
duration = "90 s"
[hosts]
control-pc = {{}}
robot-pc = {{}}
[processes]
controller = {{ host = "control-pc", run = ["{python}", "{script}", "controller", "10.77.0.2", "8"], inside = "10.77.0.1" }}
robot = {{ host = "robot-pc", run = ["{python}", "{script}", "robot"], inside = "10.77.0.2" }}
[channels]
out = {{ from = "controller", to = "robot", link = "hop" }}
back = {{ from = "robot", to = "controller", link = "hop" }}
[links.hop]
via = "emulated"
between = ["control-pc", "robot-pc"]
delay = "0.1 ms"
{loss}
[flows.command]
match = "udp src host 10.77.0.1"
[flows.state]
match = "udp src host 10.77.0.2"
deadline = "2 ms"
"#
    )
}
