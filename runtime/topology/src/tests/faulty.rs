//! Faulty files: each error names the key and points at the line marked `#!`.

use super::*;

/// What every faulty file starts from: two hosts, the robot behind a link.
pub(super) const GOOD: &str = r#"version = 1
name = "good"
[case]
name = "teleoperation"
[case.parameters]
rate_hz = 125.0
[hosts.control-pc]
address = "10.77.0.1"
[hosts.robot-pc]
address = "10.77.0.2"
[processes.human]
role = "human"
host = "control-pc"
[processes.controller]
role = "controller"
host = "control-pc"
[processes.robot]
role = "robot"
host = "robot-pc"
[channels."arm/command"]
link = "hop"
[channels."arm/status"]
link = "hop"
[links.hop]
via = "udp"
"#;

/// One line or more of `GOOD`, what stands there instead, the key of the one error, and what the
/// error says.
struct Faulty(
    &'static str,
    &'static str,
    &'static str,
    &'static [&'static str],
);

const FAULTY: &[Faulty] = &[
    // Syntax and the first lines.
    Faulty("name = \"good\"", "name = good #!", "", &["not valid TOML"]),
    Faulty("version = 1", "version = 1,0 #!", "", &["decimal comma"]),
    Faulty(
        "version = 1",
        "version = 2 #!",
        "version",
        &["2 is outside 1"],
    ),
    Faulty("version = 1", "#!", "version", &["missing", "version = 1"]),
    Faulty(
        "name = \"good\"",
        "name = \"a/b\" #!",
        "name",
        &["`a/b` is no name"],
    ),
    Faulty(
        "name = \"good\"",
        "name = 3 #!",
        "name",
        &["an integer", "expected a string"],
    ),
    // Unknown keys.
    Faulty(
        "[case]",
        "[cases] #!\n[case]",
        "cases",
        &["did you mean `case`?"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"udp\"\ndcsp = 3 #!",
        "links.hop.dcsp",
        &["did you mean `dscp`?"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\nloss = 0.1 #!",
        "links.hop.loss",
        &["did you mean `loss_ratio`?"],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\ncolour = 1 #!",
        "processes.robot.colour",
        &["not a known key", "`scheduling`"],
    ),
    // Numbers, durations, words.
    Faulty(
        "via = \"udp\"",
        "via = \"udp\"\ndscp = 64 #!",
        "links.hop.dscp",
        &["64 is outside 0 to 63"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"udp\"\nport = 80 #!",
        "links.hop.port",
        &["80 is outside 1024 to 65534"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\nloss_ratio = 1.5 #!",
        "links.hop.loss_ratio",
        &["1.5 is outside 0 to 1"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\nloss_ratio = nan #!",
        "links.hop.loss_ratio",
        &["NaN is outside 0 to 1"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\nloss_ratio = \"0,1\" #!",
        "links.hop.loss_ratio",
        &["\"0,1\" has a decimal comma, write 0.1"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"udp\"\ndscp = \"46,0\" #!",
        "links.hop.dscp",
        &["\"46,0\" has a decimal comma, write 46"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\n[links.hop.outages]\nper_hour = -1 #!",
        "links.hop.outages.per_hour",
        &["-1 is outside 0 to 100000"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\n[links.hop.outages]\nmean = \"0 s\" #!",
        "links.hop.outages.mean",
        &["\"0 s\" is outside"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\n[links.hop.outages]\nmean = \"60 s\"\nper_hour = 60 #!",
        "links.hop.outages.per_hour",
        &["less than 5 % of the time in service"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\n[links.hop.outages]\nrate = 3 #!",
        "links.hop.outages.rate",
        &[],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\ndelay = 50 #!",
        "links.hop.delay",
        &["an integer", "duration", "20 ms"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\ndelay = \"50\" #!",
        "links.hop.delay",
        &["has no unit"],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"emulated\"\n[links.hop.forward]\ndelay = \"11 s\" #!",
        "links.hop.forward.delay",
        &["\"11 s\" is outside \"0 s\" to \"10 s\""],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"upd\" #!",
        "links.hop.via",
        &["`upd`", "did you mean `udp`?", "`emulated`"],
    ),
    Faulty(
        "[links.hop]\nvia = \"udp\"",
        "[links.hop] #!",
        "links.hop.via",
        &["missing", "\"udp\""],
    ),
    Faulty(
        "[case]",
        "[run]\nduration = \"1 ms\" #!\n[case]",
        "run.duration",
        &["outside", "100 ms"],
    ),
    Faulty(
        "[case]",
        "[run]\nseed = -1 #!\n[case]",
        "run.seed",
        &["-1 is outside 0 to "],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\nscheduling = \"fifo\"\npriority = 100 #!",
        "processes.robot.priority",
        &["100 is outside 1 to 99"],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\npriority = 50 #!",
        "processes.robot.priority",
        &["needs scheduling = \"fifo\""],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\nrestart_limit = 5 #!",
        "processes.robot.restart_limit",
        &["needs on_exit = \"restart\""],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\nwait = \"spinn\" #!",
        "processes.robot.wait",
        &["did you mean `spin`?"],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\nlock_memory = \"yes\" #!",
        "processes.robot.lock_memory",
        &["a string", "true or false"],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\ncpu = [1, -2] #!",
        "processes.robot.cpu",
        &["-2 is outside 0 to 1023"],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"robot\"\nenv = { A = \"b\" } #!",
        "processes.robot.env",
        &["needs `run`"],
    ),
    Faulty(
        "address = \"10.77.0.2\"",
        "address = \"10.77.0\" #!",
        "hosts.robot-pc.address",
        &["no address"],
    ),
    // Keys that do not go together.
    Faulty(
        "via = \"udp\"",
        "via = \"udp\"\ndelay = \"5 ms\" #!",
        "links.hop.delay",
        &["needs via = \"emulated\""],
    ),
    Faulty(
        "via = \"udp\"",
        "via = \"tcp\"\n[links.hop.outages] #!\nper_hour = 3",
        "links.hop.outages",
        &["needs via = \"emulated\""],
    ),
    Faulty(
        "[links.hop]",
        "[links.near]\nvia = \"shared-memory\"\nport = 7000 #!\n[links.hop]",
        "links.near.port",
        &["does not apply to via = \"shared-memory\""],
    ),
    Faulty(
        "address = \"10.77.0.1\"\n[hosts.robot-pc]\naddress = \"10.77.0.2\"",
        "[hosts.robot-pc]\ncontrol_port = 7000 #!",
        "hosts.robot-pc.control_port",
        &["needs `address`"],
    ),
    // The case.
    Faulty(
        "name = \"teleoperation\"",
        "name = \"teleopration\" #!",
        "case.name",
        &["did you mean `teleoperation`?", "`shuttle`"],
    ),
    Faulty(
        "name = \"teleoperation\"",
        "name = \"harbour\" #!",
        "case.name",
        &["allowed: `fleet`, `shuttle`, `teleoperation`"],
    ),
    Faulty(
        "[case]\nname = \"teleoperation\"",
        "[case] #!",
        "case.name",
        &["missing", "`shuttle`"],
    ),
    Faulty(
        "rate_hz = 125.0",
        "rate_hz = 5000 #!",
        "case.parameters.rate_hz",
        &["5000 is outside 0 to 1000"],
    ),
    Faulty(
        "rate_hz = 125.0",
        "rate_hz = \"fast\" #!",
        "case.parameters.rate_hz",
        &["a number"],
    ),
    Faulty(
        "rate_hz = 125.0",
        "rate_khz = 1 #!",
        "case.parameters.rate_khz",
        &["did you mean `rate_hz`?", "`mirrored`"],
    ),
    Faulty(
        "rate_hz = 125.0",
        "servo.gain_per_s = 50.0 #!",
        "case.parameters.servo.gain_per_s",
        &["50 is outside 0 to 20"],
    ),
    Faulty(
        "rate_hz = 125.0",
        "servo.gain = 5.0 #!",
        "case.parameters.servo.gain",
        &["did you mean `gain_per_s`?"],
    ),
    Faulty(
        "rate_hz = 125.0",
        "servo.cycle_us = true #!",
        "case.parameters.servo.cycle_us",
        &["an integer"],
    ),
    // References.
    Faulty(
        "role = \"robot\"",
        "role = \"robt\" #!",
        "processes.robot.role",
        &["did you mean `robot`?", "`human`"],
    ),
    Faulty(
        "role = \"robot\"",
        "role = \"human\" #!",
        "processes.robot.role",
        &["`human` is played by process `human` already"],
    ),
    Faulty(
        "[processes.robot]\nrole = \"robot\"",
        "[processes.robot] #!",
        "processes.robot.role",
        &["missing", "run = "],
    ),
    Faulty(
        "host = \"robot-pc\"",
        "host = \"robotpc\" #!",
        "processes.robot.host",
        &["did you mean `robot-pc`?"],
    ),
    Faulty(
        "[processes.robot]\nrole = \"robot\"\nhost = \"robot-pc\"",
        "[processes.robot] #!\nrole = \"robot\"",
        "processes.robot.host",
        &["missing", "`control-pc`, `robot-pc`"],
    ),
    Faulty(
        "[processes.human]\nrole = \"human\"\nhost = \"control-pc\"\n",
        "",
        "processes",
        &["no process plays role `human`"],
    ),
    Faulty(
        "[channels.\"arm/status\"]\nlink = \"hop\"",
        "[channels.\"arm/status\"] #!",
        "channels.\"arm/status\".link",
        &[
            "`robot` on host `robot-pc`",
            "\"udp\", \"tcp\"",
            " or \"emulated\"",
        ],
    ),
    Faulty(
        "[channels.\"arm/status\"]\nlink = \"hop\"",
        "[channels.\"arm/status\"]\nlink = \"hopp\" #!",
        "channels.\"arm/status\".link",
        &["did you mean `hop`?"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"human/frame\"]\nlink = \"hop\" #!\n[channels.\"arm/status\"]",
        "channels.\"human/frame\".link",
        &["both ends of the channel are on host `control-pc`"],
    ),
    Faulty(
        "[channels.\"arm/status\"]\nlink = \"hop\"",
        "[links.near]\nvia = \"shared-memory\"\n[channels.\"arm/status\"]\nlink = \"near\" #!",
        "channels.\"arm/status\".link",
        &["via \"shared-memory\", but the channel joins"],
    ),
    // Demands.
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/command\".demand]\nlatency_max = \"20 s\" #!\nsurvival_time = \"24 ms\"\ninterval = \"16 ms\"\navailability = 0.9999\n[channels.\"arm/status\"]",
        "channels.\"arm/command\".demand.latency_max",
        &["outside", "10 s"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/command\".demand]\nlatency_max = \"20 ms\"\nsurvival_time = 24 #!\ninterval = \"16 ms\"\navailability = 0.9999\n[channels.\"arm/status\"]",
        "channels.\"arm/command\".demand.survival_time",
        &["expected a string with a duration"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/command\".demand]\nlatency_max = \"20 ms\"\nsurvival_time = \"24 ms\"\ninterval = \"16 ms\"\navailability = 99.99 #!\n[channels.\"arm/status\"]",
        "channels.\"arm/command\".demand.availability",
        &["99.99 is outside 0 to 0.999999999"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/command\".demand]\nlatency_max = \"20 ms\"\nsurvival_time = \"24 ms\"\ninterval = \"16 ms\"\navailability = 0.9999\nsurvivaltime = 1 #!\n[channels.\"arm/status\"]",
        "channels.\"arm/command\".demand.survivaltime",
        &["did you mean `survival_time`?"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/command\".demand] #!\nlatency_max = \"20 ms\"\nsurvival_time = \"24 ms\"\navailability = 0.9999\n[channels.\"arm/status\"]",
        "channels.\"arm/command\".demand.interval",
        &["missing"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/statsu\"] #!\n[channels.\"arm/status\"]",
        "channels.\"arm/statsu\"",
        &["did you mean `arm/status`?"],
    ),
    Faulty(
        "[channels.\"arm/status\"]",
        "[channels.\"arm/status\"]\nfrom = \"robot\" #!",
        "channels.\"arm/status\".from",
        &["is given by case `teleoperation`"],
    ),
    Faulty(
        "[links.hop]",
        "[links.hop]\nbetween = [\"control-pc\"] #!",
        "links.hop.between",
        &["two different hosts"],
    ),
    Faulty(
        "address = \"10.77.0.2\"\n",
        "",
        "hosts.robot-pc.address",
        &["missing", "host `control-pc` has one"],
    ),
    Faulty(
        "address = \"10.77.0.2\"",
        "address = \"10.77.0.1\" #!",
        "hosts.robot-pc.address",
        &["of host `control-pc` already"],
    ),
];

fn line_of_mark(text: &str) -> Option<usize> {
    text.lines()
        .position(|line| line.contains("#!"))
        .map(|index| index + 1)
}

#[test]
fn every_fault_names_its_key_file_and_line() {
    parse_good(GOOD);
    assert!(FAULTY.len() >= 50);
    for Faulty(good, wrong, key, says) in FAULTY {
        assert_eq!(GOOD.matches(good).count(), 1, "{good}");
        let text = GOOD.replacen(good, wrong, 1);
        let errors = parse("faulty.toml", &text, &[], &known()).expect_err(wrong);
        let [error] = errors.errors() else {
            panic!("{wrong}: one fault, several errors:\n{errors}");
        };
        assert_eq!(error.key, *key, "{errors}");
        let location = error.location.as_ref().unwrap();
        assert_eq!(location.file, "faulty.toml");
        if let Some(line) = line_of_mark(&text).filter(|_| *key != "version") {
            assert_eq!(location.line, line, "{errors}");
        }
        let rendered = errors.render(false);
        let place = format!("faulty.toml:{}:{}", location.line, location.column);
        for part in says.iter().copied().chain([*key, &place]) {
            assert!(rendered.contains(part), "`{part}` is not in\n{rendered}");
            assert!(
                errors.to_string().contains(part),
                "`{part}` is not in\n{errors}"
            );
        }
    }
}

#[test]
fn what_only_use_shows_is_told_where_its_key_stands_or_would_stand() {
    let folder = std::env::temp_dir().join(format!("hil-unusable-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("t.toml");
    let text = "version = 1\n[links.hop.trace.files]\n\"arm/command\" = \"x.trace\"\n";
    std::fs::write(&path, text).unwrap();
    let found = [
        ("links.hop.trace.files.\"arm/command\"", "3:17"),
        ("links.hop.port", "2:8"),
        ("run.duration", "1:1"),
        ("hosts.a.address", ""),
    ];
    let overrides = ["run.duration=\"5 s\"".to_owned()];
    let keys = found.map(|(key, _)| (key.to_owned(), "it is not there".to_owned()));
    let told = unusable(&path, &overrides, keys).to_string();
    for (key, place) in found {
        let line = told.lines().find(|line| line.contains(key)).unwrap();
        assert!(line.contains(place), "{line}");
        assert!(line.ends_with("cannot be used: it is not there"), "{line}");
    }
    std::fs::remove_dir_all(folder).unwrap();
}
