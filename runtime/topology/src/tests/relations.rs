//! Faults that several keys make together, and faults of overrides and foreign channels.

use super::faulty::GOOD;
use hil_link::outages::Outages;

use super::*;

#[test]
fn all_faults_of_a_file_are_reported_at_once() {
    let text = GOOD
        .replace("rate_hz = 125.0", "rate_khz = 1.0\nmirored = true")
        .replace(
            "role = \"robot\"",
            "role = \"robto\"\nwiat = \"block\"\ncpu = 5000",
        )
        .replace("via = \"udp\"", "via = \"quic\"\ndscp = 64");
    let errors = parse("faulty.toml", &text, &[], &known()).unwrap_err();
    let keys: Vec<_> = errors
        .errors()
        .iter()
        .map(|error| error.key.as_str())
        .collect();
    assert_eq!(
        keys,
        [
            "case.parameters.rate_khz",
            "case.parameters.mirored",
            "processes.robot.role",
            "processes.robot.wiat",
            "processes.robot.cpu",
            "links.hop.via",
            "links.hop.dscp",
        ]
    );
}

#[test]
fn every_syntax_error_is_reported_at_once() {
    let errors = parse(
        "faulty.toml",
        "a = \nb = 1\nc = [1\nd == 2\n",
        &[],
        &known(),
    )
    .unwrap_err();
    assert!(errors.errors().len() >= 2, "{errors}");
    assert!(
        errors
            .errors()
            .iter()
            .all(|error| matches!(error.fault, Fault::Syntax(_)))
    );
}

#[test]
fn an_override_is_refused_with_its_own_text() {
    for (set, key, says) in [
        (
            "links.hop.dscp=64",
            "links.hop.dscp",
            "64 is outside 0 to 63",
        ),
        ("links.hop.dcsp=6", "links.hop.dcsp", "did you mean `dscp`?"),
        (
            "links.hop.delay=20 ms",
            "links.hop.delay",
            "needs via = \"emulated\"",
        ),
        (
            "nonsense",
            "--set nonsense",
            "is not of the form key.path=value",
        ),
        (
            "[run]=3",
            "--set [run]=3",
            "is not of the form key.path=value",
        ),
        ("a b=3", "", "not valid TOML"),
        ("extends=x.toml", "extends", "read from files only"),
    ] {
        let errors = parse("good.toml", GOOD, &[set.to_owned()], &known()).unwrap_err();
        let error = &errors.errors()[0];
        assert_eq!(error.key, key, "{errors}");
        assert_eq!(error.location.as_ref().unwrap().file, "--set");
        assert!(errors.render(false).contains(says), "{errors}");
    }
}

#[test]
fn foreign_channels_are_checked_like_those_of_a_case() {
    let own = "version = 1\nname = 'own'\nprocesses.a.run = ['a']\nprocesses.b.run = ['b']\n";
    let good = "message = { name = 'x.v1', size_bytes = 8 }\nfrom = 'a'\nto = 'b'\n";
    for (replaced, wrong, key, says) in [
        ("from = 'a'", "", "from", "missing"),
        ("from = 'a'", "from = 'c'", "from", "`c` is not a process"),
        ("to = 'b'", "to = 'a'", "to", "is process `a`, as is `from`"),
        (
            "message = { name = 'x.v1', size_bytes = 8 }",
            "",
            "message",
            "missing",
        ),
        (
            "size_bytes = 8",
            "size_bytes = 0",
            "message.size_bytes",
            "0 is outside",
        ),
        (
            "size_bytes = 8",
            "size_bytes = 9",
            "message.size_bytes",
            "no multiple",
        ),
        (
            "size_bytes = 8",
            "size_bytes = 8, alignment_bytes = 3",
            "message.alignment_bytes",
            "power of two",
        ),
        (", size_bytes = 8", "", "message.size_bytes", "missing"),
    ] {
        let channel = good.replace(replaced, wrong);
        let text = format!("{own}[channels.'a/b']\n{channel}");
        let errors = parse("own.toml", &text, &[], &known()).expect_err(wrong);
        let error = &errors.errors()[0];
        assert_eq!(error.key, format!("channels.\"a/b\".{key}"), "{errors}");
        assert!(errors.to_string().contains(says), "{errors}");
    }
}

#[test]
fn ports_of_two_links_may_not_meet() {
    let text = EVERYTHING.replace("port = 9000", "port = 8001");
    let errors = parse("ports.toml", &text, &[], &known()).unwrap_err();
    assert_eq!(errors.errors()[0].key, "links.wire.port");
    assert!(
        errors
            .to_string()
            .contains("8001 to 8002 overlaps with the ports of link `hop`")
    );
    let text = EVERYTHING.replace("port = 8000", "port = 65534");
    assert!(parse("ports.toml", &text, &[], &known()).is_ok());
    // At one address what sends needs ports of its own.
    let there = "address = \"10.77.0.2\"";
    let here = "address = \"10.77.0.1\", control_port = 7500";
    let text = text.replace(there, here);
    let errors = parse("ports.toml", &text, &[], &known()).unwrap_err();
    assert!(
        errors.to_string().contains("leaves no ports below 65536"),
        "{errors}"
    );
}

#[test]
fn one_link_joins_one_pair_of_hosts() {
    let text = EVERYTHING.replace(
        "[processes.camera]\nhost = \"robot-pc\"",
        "[hosts.third]\naddress = \"10.77.0.3\"\n[processes.camera]\nhost = \"third\"",
    );
    let text = text.replace("link = \"wire\"", "link = \"hop\"");
    let errors = parse("pairs.toml", &text, &[], &known()).unwrap_err();
    let text = errors.to_string();
    assert!(
        text.contains("`hop`, which joins `control-pc` and `robot-pc`"),
        "{text}"
    );
    assert!(text.contains("between `control-pc` and `third`"), "{text}");
}

#[test]
fn a_link_over_tcp_has_ports_and_a_hop_and_no_model() {
    let text = EVERYTHING.replace("via = \"udp\"", "via = \"tcp\"");
    let topology = parse("tcp.toml", &text, &[], &known()).unwrap();
    let mut crossings = topology.crossings();
    let image = crossings
        .find(|crossing| crossing.channel.name == "camera/image")
        .unwrap();
    assert!(matches!(image.link.via, Via::Network(_)));
    assert_eq!(image.hop.transport.name, "tcp");
    assert_eq!((image.ports.sender, image.ports.receiver), (9001, 9001));
    assert_eq!(image.spec, None);
    assert_eq!(image.hop.socket.timestamps, Timestamps::Off);
    let written = topology.to_toml();
    let again = parse("again.toml", &written, &[], &known()).unwrap();
    assert_eq!(again, topology);
    let stamped = text.replace("via = \"tcp\"", "via = \"tcp\"\ntimestamps = \"software\"");
    let refused = parse("tcp.toml", &stamped, &[], &known()).unwrap_err();
    let words = refused.to_string();
    let expected =
        "links.wire.timestamps needs via = \"udp\" or \"emulated\": over TCP the kernel stamps";
    assert!(words.contains(expected), "{words}");
}

#[test]
fn the_outages_of_a_link_are_those_of_both_ways() {
    let topology = parse_good(EVERYTHING);
    let expected = Outages {
        mean_s: 1.5,
        per_hour: 12.5,
        buffered: true,
    };
    for crossing in topology.crossings().take(2) {
        assert_eq!(crossing.spec.unwrap().outages, expected);
    }
    let quiet = EVERYTHING.replace("outages = {", "# outages = {");
    let quiet = parse_good(&quiet);
    let spec = quiet.crossings().next().and_then(|crossing| crossing.spec);
    assert!(spec.is_some_and(|spec| !spec.outages.is_active()));
}

fn check_with_refusal(
    read: ReadParameters<'_>,
    seed: u64,
) -> Result<Option<toml::Table>, ParameterError> {
    let mut refuse =
        |_: &mut Shuttle| ParameterError::check("gain_per_s", 1.0, 2.0..=3.0, "2 to 3");
    check_parameters_with::<Shuttle>(read, seed, &mut refuse)
}

#[test]
fn a_callers_own_parameter_check_points_at_the_line_too() {
    let case = KnownCase {
        check_parameters: check_with_refusal,
        ..KnownCase::of::<Shuttle>()
    };
    let text = "version = 1\nname = 'x'\n[processes]\ncontroller.role = 'controller'\n\
                robot.role = 'robot'\n[case]\nname = 'shuttle'\nparameters.gain_per_s = 1.0\n";
    let known = KnownCases::new().with_case(case);
    let errors = parse("own.toml", text, &[], &known).unwrap_err();
    let says = "own.toml:8:25: case.parameters.gain_per_s 1 is outside 2 to 3";
    assert_eq!(errors.to_string(), says);
}
