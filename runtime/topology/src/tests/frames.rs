//! Programs with an address inside: their channels carry frames, one each way between two neighbours.

use hil_core::message::ETHERNET_FRAME;

use super::*;

const JOINED: &str = r#"
version = 1
name = "joined"
[hosts.a]
[hosts.b]
[processes.controller]
host = "a"
run = ["./controller", "10.77.0.2"]
inside = "10.77.0.1"
[processes.robot]
host = "b"
run = ["./robot"]
inside = "10.77.0.2"
[channels.out]
from = "controller"
to = "robot"
link = "hop"
[channels.back]
from = "robot"
to = "controller"
link = "hop"
[links.hop]
via = "udp"
"#;

#[test]
fn channels_between_addresses_inside_carry_frames_and_are_written_back() {
    let topology = parse_good(JOINED);
    for channel in topology.channels() {
        assert!(channel.carries_frames() && channel.is_carried);
        assert_eq!(channel.message.hash(), ETHERNET_FRAME.hash());
        assert_eq!(channel.depth, 1024);
    }
    let robot = topology.process("robot").unwrap();
    assert_eq!(robot.inside(), Some("10.77.0.2".parse().unwrap()));
    let again = parse_good(&topology.to_toml());
    assert_eq!(again, topology);
}

#[test]
fn what_is_no_cable_between_two_neighbours_is_refused() {
    let case = "case.name = \"shuttle\"\nprocesses.x.role = \"controller\"\n";
    for (from, to, key, says) in [
        (
            "10.77.0.2\"\n[ch",
            "10.77.0.1\"\n[ch",
            "processes.controller.inside",
            "as is that of",
        ),
        (
            "10.77.0.2\"\n[ch",
            "10.77.1.2\"\n[ch",
            "processes.controller.inside",
            "one network",
        ),
        (
            "10.77.0.2\"\n[ch",
            "fd00::2\"\n[ch",
            "processes.controller.inside",
            "one network",
        ),
        (
            "inside = \"10.77.0.2\"\n",
            "",
            "channels.out.message",
            "is missing",
        ),
        (
            "from = \"robot\"\nto = \"controller\"",
            "from = \"controller\"\nto = \"robot\"",
            "processes.controller.inside",
            "there are 2 and 0",
        ),
        (
            "run = [\"./robot\"]\n",
            "role = \"robot\"\n",
            "processes.robot.inside",
            "needs `run`",
        ),
        (
            "run = [\"./robot\"]\n",
            "run = [\"./robot\"]\nrole = \"robot\"\n",
            "processes.robot.inside",
            "does not go with `role`",
        ),
        (
            "[channels.back]\n",
            "[channels.back]\nmessage = { name = \"a.v1\", size_bytes = 8 }\n",
            "channels.back.message",
            "both ends have `inside`",
        ),
    ] {
        let mut text = JOINED.replace(from, to);
        assert_ne!(text, JOINED, "{from}");
        if says.contains("role") || says.contains("needs `run`") {
            text = text.replace("[hosts.a]", &format!("{case}[hosts.a]"));
            text = text.replace(
                "processes.x.role",
                "processes.x.host = \"a\"\nprocesses.x.role",
            );
        }
        let errors = parse("joined.toml", &text, &[], &known()).unwrap_err();
        let mut found = errors.errors().iter();
        let found = found.any(|one| one.key == key && one.fault.to_string().contains(says));
        assert!(found, "{key} {says}:\n{errors}");
    }
}
