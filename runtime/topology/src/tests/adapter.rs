//! `[processes.<name>.egm]`: what it becomes, what it makes unnecessary, and what it may not say.

use hil_arm::egm::messages::{EgmCommand, EgmEvent, EgmFeedback, Side};
use hil_arm::egm::parameters::EgmParameters;

use super::*;

/// A case with the channels of guided motion, without its models.
#[derive(Debug)]
struct Guided;

hil_core::options! {
    struct GuidedParameters {
        egm: EgmParameters;
    }
}

impl CaseStudy for Guided {
    const NAME: &'static str = "guided";
    const SUMMARY: &'static str = "test";
    const ROLES: &'static [&'static str] = &["human", "controller", "robot"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<Frame>("human/frame", "human", "controller"),
        ChannelSpec::of::<EgmCommand>("egm/right/command", "controller", "robot"),
        ChannelSpec::of::<EgmCommand>("egm/left/command", "controller", "robot"),
        ChannelSpec::of::<EgmFeedback>("egm/right/feedback", "robot", "controller"),
        ChannelSpec::of::<EgmFeedback>("egm/left/feedback", "robot", "controller"),
        ChannelSpec::recorded::<EgmEvent>("egm/event", "robot"),
    ];
    type Parameters = GuidedParameters;

    fn new(_parameters: Self::Parameters, _seed: u64) -> Result<Self, ParameterError> {
        Ok(Self)
    }

    fn may_restart(_parameters: &GuidedParameters, _role: &str) -> bool {
        false
    }

    fn role(&self, _name: &str) -> Option<Box<dyn Role>> {
        None
    }

    fn score(&self, _log: &RunLog) -> Score {
        Score::default()
    }
}

const CLIENT: &str = r#"version = 1
name = "client"
[case]
name = "guided"
parameters.egm.start = "power-on"
[processes.client]
role = "controller"
egm = { right = "127.0.0.1:6510" }
[processes.robot]
role = "robot"
"#;

const ROBOT: &str = r#"version = 1
name = "robot"
[case]
name = "guided"
[processes.human]
role = "human"
[processes.controller]
role = "controller"
[processes.yumi]
role = "robot"
egm = { right = "0.0.0.0:6510", left = "0.0.0.0:6511", send = "free", send_hz = 125 }
"#;

fn parse_guided(text: &str) -> Result<Topology, TopologyErrors> {
    parse("face.toml", text, &[], &KnownCases::new().with::<Guided>())
}

fn good(text: &str) -> Topology {
    parse_guided(text).unwrap_or_else(|errors| panic!("{errors}"))
}

fn adapter<'a>(topology: &'a Topology, process: &str) -> &'a EgmAdapter {
    match &topology.process(process).unwrap().program {
        Program::Egm { adapter, .. } => adapter,
        other => panic!("{other:?} is no adapter"),
    }
}

fn names(topology: &Topology) -> Vec<&str> {
    let channels = topology.channels().iter();
    channels.map(|channel| channel.name.as_str()).collect()
}

#[test]
fn who_stands_in_for_the_controller_sees_a_robot_and_needs_no_human() {
    let topology = good(CLIENT);
    let adapter = adapter(&topology, "client");
    assert_eq!(
        (adapter.kind, adapter.axes, adapter.robotware),
        (AdapterKind::Robot, 7, 7)
    );
    assert_eq!(adapter.timestamps, Timestamps::Software);
    assert_eq!(adapter.address(Side::Right), "127.0.0.1:6510".parse().ok());
    assert_eq!(adapter.address(Side::Left), None);
    let expected = [
        "egm/right/command",
        "egm/left/command",
        "egm/right/feedback",
        "egm/left/feedback",
        "egm/event",
    ];
    assert_eq!(names(&topology), expected);
    assert_eq!(
        topology.process("client").unwrap().role(),
        Some("controller")
    );
    // A human may still be there.
    let with_human = CLIENT.replace(
        "[processes.robot]",
        "[processes.human]\nrole = \"human\"\n[processes.robot]",
    );
    assert_eq!(names(&good(&with_human)).len(), 6);
}

#[test]
fn who_stands_in_for_the_robot_sees_a_sensor_and_leaves_no_record() {
    let topology = good(ROBOT);
    let adapter = adapter(&topology, "yumi");
    assert_eq!(adapter.kind, AdapterKind::Sensor);
    assert_eq!(adapter.send(), AdapterSend::Free { rate_hz: 125.0 });
    assert!(!names(&topology).contains(&"egm/event"));
    assert!(names(&topology).contains(&"human/frame"));
}

#[test]
fn an_adapter_survives_being_written_back() {
    for text in [CLIENT, ROBOT] {
        let topology = good(text);
        let written = topology.to_toml();
        let again = parse_guided(&written).unwrap_or_else(|errors| panic!("{errors}\n{written}"));
        assert_eq!(again, topology);
    }
    assert!(!good(CLIENT).to_toml().contains("send"));
}

#[test]
fn an_adapter_may_be_started_again_although_the_case_remembers() {
    let text = CLIENT.replace(
        "role = \"controller\"",
        "role = \"controller\"\non_exit = \"restart\"",
    );
    assert_eq!(
        good(&text).process("client").unwrap().restarts.on_exit(),
        OnExit::Restart { limit: 3 }
    );
}

/// A good file, what of it is replaced by what, the key of the error, and words of it.
struct Faulty(
    &'static str,
    &'static str,
    &'static str,
    &'static str,
    &'static str,
);

const FAULTY: &[Faulty] = &[
    Faulty(
        CLIENT,
        "127.0.0.1:6510",
        "localhost:6510",
        "egm.right",
        "no address of the form",
    ),
    Faulty(
        CLIENT,
        "127.0.0.1:6510",
        "127.0.0.1:80",
        "egm.right",
        "1024 to 65535",
    ),
    Faulty(
        CLIENT,
        "127.0.0.1:6510",
        "0.0.0.0:6510",
        "egm.right",
        "no address to send to",
    ),
    Faulty(
        CLIENT,
        "right = \"127.0.0.1:6510\"",
        "",
        "egm.right",
        "missing: write right =",
    ),
    Faulty(
        CLIENT,
        "right =",
        "axes = 8, right =",
        "egm.axes",
        "8 is outside 6 to 7",
    ),
    Faulty(
        ROBOT,
        "right =",
        "axes = 6, right =",
        "egm.axes",
        "would not follow J7",
    ),
    Faulty(
        CLIENT,
        "right =",
        "robotware = 5, right =",
        "egm.robotware",
        "5 is outside 6 to 7",
    ),
    Faulty(
        CLIENT,
        "right =",
        "send = \"free\", right =",
        "egm.send",
        "does not apply to a robot adapter",
    ),
    Faulty(
        CLIENT,
        "right =",
        "timestamps = \"hardware\", right =",
        "egm.timestamps",
        "allowed: `off`, `software`",
    ),
    Faulty(
        CLIENT,
        "right =",
        "rihgt =",
        "egm.rihgt",
        "did you mean `right`?",
    ),
    Faulty(
        CLIENT,
        "\"power-on\"",
        "\"request\"",
        "case.parameters.egm.start",
        "allowed beside a robot adapter: \"power-on\"",
    ),
    Faulty(
        CLIENT,
        "parameters.egm.start = \"power-on\"",
        "",
        "case.parameters.egm.start",
        "is \"request\" by default",
    ),
    Faulty(
        CLIENT,
        "\"power-on\"",
        "\"power-on\"\nparameters.egm.restart = \"external_trigger\"",
        "case.parameters.egm.restart",
        "allowed beside a robot adapter: \"auto_retry\"",
    ),
    Faulty(
        CLIENT,
        "role = \"controller\"",
        "role = \"human\"",
        "processes.client.egm",
        "only `controller` or `robot` does",
    ),
    Faulty(
        CLIENT,
        "role = \"controller\"",
        "role = \"controller\"\nrun = [\"x\"]",
        "processes.client.run",
        "does not go with `egm`",
    ),
    Faulty(
        CLIENT,
        "[processes.robot]",
        "[channels.\"human/frame\"]\ndepth = 4\n[processes.robot]",
        "channels.\"human/frame\"",
        "no process of this file plays role `human`",
    ),
    Faulty(
        ROBOT,
        "0.0.0.0:6511",
        "0.0.0.0:6510",
        "egm.left",
        "address of the right arm too",
    ),
    Faulty(
        ROBOT,
        "send_hz = 125",
        "send_hz = 0.5",
        "egm.send_hz",
        "0.5 is outside 1 to 1000",
    ),
    Faulty(
        ROBOT,
        "send = \"free\", ",
        "",
        "egm.send_hz",
        "needs send = \"free\"",
    ),
    Faulty(
        ROBOT,
        "[processes.human]\nrole = \"human\"\n",
        "",
        "processes",
        "no process plays role `human`",
    ),
];

#[test]
fn what_an_adapter_may_not_say_is_named_with_what_it_may() {
    for Faulty(text, from, to, key, words) in FAULTY {
        let faulty = text.replace(from, to);
        assert_ne!(faulty, *text, "{from} is not there");
        let errors = match parse_guided(&faulty) {
            Ok(topology) => panic!("{to} passed as {topology:?}"),
            Err(errors) => errors,
        };
        let found = errors
            .errors()
            .iter()
            .any(|error| error.key.ends_with(key) && error.to_string().contains(words));
        assert!(found, "{key} with {words}: {errors}");
    }
}

#[test]
fn a_session_nobody_could_ask_for_is_refused_where_it_is_written() {
    let line_of = |text: &str| {
        let errors = parse_guided(text).unwrap_err();
        let location = errors.errors()[0].location.clone();
        let line = location.map_or(0, |location| location.line);
        text.lines().nth(line - 1).unwrap_or_default().to_owned()
    };
    let start = CLIENT.replace("power-on", "request");
    assert_eq!(line_of(&start), "parameters.egm.start = \"request\"");
    let restart = "parameters.egm.restart = \"external_trigger\"";
    let text = CLIENT.replace(
        "[processes.client]",
        &[restart, "[processes.client]"].join("\n"),
    );
    assert_eq!(line_of(&text), restart);
    let unwritten = CLIENT.replace("parameters.egm.start = \"power-on\"", "");
    assert!(line_of(&unwritten).starts_with("egm = {"));
}
