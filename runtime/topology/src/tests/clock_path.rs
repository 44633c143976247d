//! Clock paths: which hosts have one, on which ports, and every way to get one wrong.

use super::faulty::GOOD;
use super::*;

const CLOCKS: [(&str, &str); 2] = [
    (
        "address = \"10.77.0.1\"",
        "address = \"10.77.0.1\"\nclock_address = \"10.78.0.1\"\nclock_interface = \"eth1\"",
    ),
    (
        "address = \"10.77.0.2\"",
        "address = \"10.77.0.2\"\nclock_address = \"10.78.0.2\"",
    ),
];

/// `GOOD` with a clock address on both hosts.
fn good() -> String {
    CLOCKS
        .iter()
        .fold(GOOD.to_owned(), |text, (old, new)| text.replace(old, new))
}

/// The one fault of `text`, which must be of `key`.
fn fault_of(text: &str, key: &str) -> String {
    let errors = parse("clock.toml", text, &[], &known()).expect_err(key);
    let keys: Vec<&str> = errors
        .errors()
        .iter()
        .map(|error| error.key.as_str())
        .collect();
    assert_eq!(keys, [key], "{errors}");
    let error = &errors.errors()[0];
    assert!(error.location.is_some(), "{errors}");
    error.to_string()
}

#[test]
fn two_linked_hosts_with_a_clock_address_have_a_clock_path() {
    let topology = parse_good(&good());
    let paths: Vec<ClockPath<'_>> = topology.clock_paths().collect();
    let [path] = &paths[..] else {
        panic!("{paths:?}");
    };
    assert_eq!(path.name(), "clock/control-pc-robot-pc");
    assert_eq!(path.describe(), "clock path 10.78.0.1 (eth1) <-> 10.78.0.2");
    assert_eq!(path.asking.to_string(), "10.78.0.1:7390");
    assert_eq!(path.answering.to_string(), "10.78.0.2:7390");
    assert_eq!(path.flow_number(), u16::MAX);
    assert_eq!(path.from.name, "control-pc");
    let found = |one, other| topology.clock_path_between(one, other).is_some();
    assert!(found("robot-pc", "control-pc") && found("control-pc", "robot-pc"));
    assert!(!found("robot-pc", "robot-pc"));
    assert_eq!(parse_good(GOOD).clock_paths().count(), 0);
}

#[test]
fn clock_paths_are_written_back_and_part_of_what_two_hosts_compare() {
    let topology = parse_good(&good());
    let again = parse_good(&topology.to_toml());
    assert_eq!(again, topology);
    assert!(topology.to_toml().contains("clock_port = 7390"));
    assert_ne!(topology.hash(), parse_good(GOOD).hash());
}

#[test]
fn each_further_path_of_a_host_takes_the_next_port() {
    let third = "[hosts.third]\naddress = \"10.77.0.3\"\nclock_address = \"10.78.0.3\"\n\
                 clock_port = 7000\n[processes.human]";
    let text = good().replace("[processes.human]", third).replace(
        "role = \"robot\"\nhost = \"robot-pc\"",
        "role = \"robot\"\nhost = \"third\"",
    );
    let programs = "[processes.camera]\nrun = ['camera']\nhost = \"robot-pc\"\n\
                    [processes.viewer]\nrun = ['viewer']\nhost = \"control-pc\"\n\
                    [processes.store]\nrun = ['store']\nhost = \"third\"\n\
                    [channels.\"a/1\"]\nmessage = { name = 'x.v1', size_bytes = 8 }\n\
                    from = 'camera'\nto = 'viewer'\nlink = 'wire'\n\
                    [channels.\"a/2\"]\nmessage = { name = 'x.v1', size_bytes = 8 }\n\
                    from = 'camera'\nto = 'store'\nlink = 'third'\n\
                    [links.wire]\nvia = 'tcp'\nport = 8000\n[links.third]\nvia = 'udp'\nport = 8010\n";
    let topology = parse_good(&format!("{text}{programs}"));
    let ends: Vec<_> = topology
        .clock_paths()
        .map(|path| {
            (
                path.name(),
                path.asking.port(),
                path.answering.port(),
                path.flow_number(),
            )
        })
        .collect();
    let expected = [
        ("clock/control-pc-robot-pc", 7390, 7390, 65_535),
        ("clock/control-pc-third", 7391, 7000, 65_534),
        ("clock/robot-pc-third", 7391, 7001, 65_533),
    ];
    let expected =
        expected.map(|(name, asking, answering, id)| (name.to_owned(), asking, answering, id));
    assert_eq!(ends, expected);
    // A host without a way over the clock path's network is left out where others have one.
    let text = format!("{text}{programs}")
        .replace("clock_address = \"10.78.0.3\"\nclock_port = 7000\n", "");
    let topology = parse_good(&text);
    let names: Vec<String> = topology.clock_paths().map(|path| path.name()).collect();
    assert_eq!(names, ["clock/control-pc-robot-pc"]);
}

#[test]
fn a_clock_address_needs_an_address_and_its_own_keys_need_it() {
    let local = GOOD
        .replace("address = \"10.77.0.1\"", "clock_address = \"10.78.0.1\"")
        .replace("address = \"10.77.0.2\"", "");
    let text = fault_of(&local, "hosts.control-pc.clock_address");
    assert!(text.contains("needs `address`"), "{text}");
    for (line, key) in [
        ("clock_interface = \"eth1\"", "clock_interface"),
        ("clock_port = 7500", "clock_port"),
    ] {
        let new = format!("address = \"10.77.0.1\"\n{line}");
        let alone = GOOD.replace("address = \"10.77.0.1\"", &new);
        let text = fault_of(&alone, &format!("hosts.control-pc.{key}"));
        assert!(text.contains("needs `clock_address`"), "{text}");
    }
}

#[test]
fn a_clock_path_needs_an_address_at_both_ends() {
    let one_sided = good().replace("\nclock_address = \"10.78.0.2\"", "");
    let text = fault_of(&one_sided, "hosts.control-pc.clock_address");
    assert!(
        text.contains("`robot-pc`, which a link joins with `control-pc`"),
        "{text}"
    );
    // Everything on one host: nothing crosses, so there are no clocks to compare.
    let together = good()
        .replace("host = \"robot-pc\"", "host = \"control-pc\"")
        .replace("link = \"hop\"", "depth = 4");
    let errors = parse("clock.toml", &together, &[], &known()).unwrap_err();
    assert_eq!(errors.errors().len(), 2, "{errors}");
    assert!(
        errors.to_string().contains("has no use: no channel leaves"),
        "{errors}"
    );
}

#[test]
fn an_address_belongs_to_one_host_and_names_one_interface_of_it() {
    let key = "hosts.robot-pc.clock_address";
    for (address, words) in [
        (
            "10.78.0.1",
            "is the clock_address of host `control-pc` already",
        ),
        ("10.77.0.1", "is the address of host `control-pc` already"),
        ("0.0.0.0", "is no address of one host"),
        ("224.0.0.1", "is no address of one host"),
        ("ff02::1", "is no address of one host"),
        ("fe80::1", "is link-local"),
        ("eth1", "is no address of one host"),
        ("fd00::2", "are of different IP versions"),
    ] {
        let text = good().replace("10.78.0.2", address);
        let errors = parse("clock.toml", &text, &[], &known()).expect_err(address);
        let error = errors.errors().iter().find(|error| error.key == key);
        let error = error.unwrap_or_else(|| panic!("{errors}"));
        assert!(error.to_string().contains(words), "{error}");
    }
    // Its own address will do: an emulated link, or TCP, is no part of that way.
    let same = good().replace("10.78.0.2", "10.77.0.2");
    assert_eq!(parse_good(&same).clock_paths().count(), 1);
    for interface in ["", "a b", "a/b", "longer-than-fifteen"] {
        let text = good().replace("\"eth1\"", &format!("\"{interface}\""));
        let text = fault_of(&text, "hosts.control-pc.clock_interface");
        assert!(text.contains("is no interface name"), "{text}");
    }
}

#[test]
fn no_port_of_a_clock_path_is_one_of_a_link() {
    let with_port = |port: u16| {
        good().replace(
            "clock_interface = \"eth1\"",
            &format!("clock_port = {port}"),
        )
    };
    let key = "hosts.control-pc.clock_port";
    for port in [7400, 7401] {
        let text = fault_of(&with_port(port), key);
        let words = format!("{port} to {port} overlaps with the ports of link `hop`");
        assert!(text.contains(&words), "{text}");
        let line = with_port(port)
            .lines()
            .position(|line| line.starts_with("clock_port"));
        let place = format!("clock.toml:{}:", line.unwrap() + 1);
        assert!(text.contains(&place), "{text}");
    }
    for port in [7399, 7402, 65_535] {
        assert_eq!(parse_good(&with_port(port)).clock_paths().count(), 1);
    }
    let text = fault_of(&with_port(1_000), key);
    assert!(text.contains("1000 is outside 1024 to 65535"), "{text}");
    let text = good().replace(
        "[links.hop]\nvia = \"udp\"",
        "[links.hop]\nvia = \"udp\"\nport = 7389",
    );
    let errors = parse("clock.toml", &text, &[], &known()).unwrap_err();
    assert!(
        errors.to_string().contains("7390 to 7390 overlaps"),
        "{errors}"
    );
}

#[test]
fn a_path_has_a_name_of_its_own_that_fits_a_record_file() {
    let long = "r".repeat(60);
    let text = good()
        .replace("control-pc", &"c".repeat(60))
        .replace("robot-pc", &long);
    let errors = parse("clock.toml", &text, &[], &known()).unwrap_err();
    assert!(
        errors
            .to_string()
            .contains("127 bytes are more than the 96"),
        "{errors}"
    );
    let channel = "[processes.a]\nrun = ['a']\nhost = \"control-pc\"\n\
                   [processes.b]\nrun = ['b']\nhost = \"control-pc\"\n\
                   [channels.\"clock/control-pc-robot-pc\"]\n\
                   message = { name = 'x.v1', size_bytes = 8 }\nfrom = 'a'\nto = 'b'\n";
    let errors = parse("clock.toml", &format!("{}{channel}", good()), &[], &known()).unwrap_err();
    assert!(
        errors.to_string().contains("and a channel has that name"),
        "{errors}"
    );
}

#[test]
fn what_would_share_a_name_with_a_clock_path_is_refused() {
    let text = format!(
        "{}[processes.clock-robot-pc-control-pc]\nrun = ['x']\nhost = \"control-pc\"\n",
        good()
    );
    let fault = fault_of(&text, "hosts.control-pc.clock_address");
    assert!(fault.contains("another has that name"), "{fault}");

    // `control-pc` with `robot-pc`, and `control` with `pc-robot-pc`.
    let hosts = "[hosts.control]\naddress = \"10.77.0.3\"\nclock_address = \"10.78.0.3\"\n\
                 [hosts.pc-robot-pc]\naddress = \"10.77.0.4\"\nclock_address = \"10.78.0.4\"\n\
                 [processes.human]";
    let programs = "[processes.camera]\nrun = ['camera']\nhost = \"control\"\n\
                    [processes.viewer]\nrun = ['viewer']\nhost = \"pc-robot-pc\"\n\
                    [channels.\"a/1\"]\nmessage = { name = 'x.v1', size_bytes = 8 }\n\
                    from = 'camera'\nto = 'viewer'\nlink = 'wire'\n\
                    [links.wire]\nvia = 'tcp'\nport = 8000\n";
    let text = format!("{}{programs}", good().replace("[processes.human]", hosts));
    let errors = parse("clock.toml", &text, &[], &known()).expect_err("one name for two paths");
    let text = errors.to_string();
    assert!(text.contains("rename one"), "{text}");
}
