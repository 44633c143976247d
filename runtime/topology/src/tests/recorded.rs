//! A channel without consumer: what a file may say of it, and what its producer is told.

use super::*;

/// A robot that tells its record what nobody else may know.
#[derive(Debug)]
struct Diary;

impl CaseStudy for Diary {
    const NAME: &'static str = "diary";
    const SUMMARY: &'static str = "test";
    const ROLES: &'static [&'static str] = &["controller", "robot"];
    const CHANNELS: &'static [ChannelSpec] = &[
        ChannelSpec::of::<Frame>("arm/command", "controller", "robot"),
        ChannelSpec::recorded::<Frame>("arm/truth", "robot"),
        ChannelSpec::of::<Frame>("arm/status", "robot", "controller"),
    ];
    type Parameters = TeleoperationParameters;

    fn new(_parameters: Self::Parameters, _seed: u64) -> Result<Self, ParameterError> {
        Ok(Self)
    }

    fn role(&self, _name: &str) -> Option<Box<dyn Role>> {
        None
    }

    fn score(&self, _log: &RunLog) -> Score {
        Score::default()
    }
}

const SPLIT: &str = r#"version = 1
name = "diary"
case.name = "diary"
[hosts]
control-pc.address = "10.77.0.1"
robot-pc.address = "10.77.0.2"
[processes.controller]
role = "controller"
host = "control-pc"
[processes.robot]
role = "robot"
host = "robot-pc"
[channels]
"arm/command".link = "hop"
"arm/status".link = "hop"
[links.hop]
via = "udp"
"#;

fn parse_diary(text: &str) -> Result<Topology, TopologyErrors> {
    parse("diary.toml", text, &[], &KnownCases::new().with::<Diary>())
}

#[test]
fn a_recorded_channel_has_its_number_and_neither_queue_nor_port() {
    let topology = parse_diary(SPLIT).unwrap_or_else(|errors| panic!("{errors}"));
    let truth = topology.channel("arm/truth").unwrap();
    assert!(truth.is_recorded_only());
    assert_eq!(
        (truth.channel_id, truth.depth, truth.is_carried),
        (1, 0, false)
    );
    assert_eq!(topology.crossings().count(), 2);
    // Written out, it is not mentioned, and the file means the same.
    assert!(!topology.to_toml().contains("arm/truth"));
    assert_eq!(parse_diary(&topology.to_toml()).unwrap(), topology);
}

#[test]
fn its_producer_is_told_in_port_order_and_nobody_reads_it() {
    let topology = parse_diary(SPLIT).unwrap();
    let card = topology.role_spec("robot").unwrap();
    let outputs: Vec<_> = card
        .outputs
        .iter()
        .map(|output| (output.name.as_str(), output.is_recorded_only))
        .collect();
    assert_eq!(outputs, [("arm/truth", true), ("arm/status", false)]);
    let card = topology.role_spec("controller").unwrap();
    let inputs: Vec<_> = card.inputs.iter().map(|input| &input.name).collect();
    assert_eq!(inputs, ["arm/status"]);
}

#[test]
fn a_link_or_anything_else_for_it_is_refused_at_its_place() {
    for (setting, key, says) in [
        (
            "\"arm/truth\".link = \"hop\"",
            "channels.\"arm/truth\".link",
            "is `hop`, but the messages of this channel only go to the run's record",
        ),
        (
            "\"arm/truth\".depth = 4",
            "channels.\"arm/truth\"",
            "has nothing to set: the messages of this channel only go to the run's record",
        ),
    ] {
        let text = SPLIT.replace("[channels]", &format!("[channels]\n{setting}"));
        let errors = parse_diary(&text).unwrap_err();
        let [error] = errors.errors() else {
            panic!("{errors}");
        };
        assert_eq!(error.key, key);
        assert_eq!(error.location.as_ref().unwrap().line, 14);
        assert!(errors.to_string().contains(says), "{errors}");
    }
}
