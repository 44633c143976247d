//! Two programs that speak IP with a link between them: the topology that says so, made of the command line.

use std::env;
use std::fs;
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};

use hil_core::text_file::has_decimal_comma;
use hil_platform::console::Console;
use hil_platform::random::random_bytes;
use hil_topology::registry::Registry;
use hil_topology::{LinkPorts, TopologyError, TopologyErrors};
use toml::{Table, Value};

use super::{Refusal, carry_out, failed, loaded, usage};
use crate::arguments::{JoinArgs, RunArgs};

/// The names of the programs, which are those of their hosts, and their addresses.
const ENDS: [(&str, &str); 2] = [("first", "10.77.0.1"), ("second", "10.77.0.2")];
/// [`Run::LONGEST`](hil_topology::Run::LONGEST).
const LONGEST: &str = "168h";
/// Both hosts are this PC, whose loopback carries a frame whole: a link model meets one datagram a frame.
const PATH_MTU_BYTES: i64 = 9000;

/// Runs two programs until one of them ends.
pub(super) fn join(
    args: &JoinArgs,
    registry: &Registry,
    console: &mut Console,
) -> Result<u8, Refusal> {
    console.set_quiet(args.quiet);
    let Between { mut link, flows } = between(args.link.as_deref(), registry, console)?;
    let port = free_ports().map_err(|error| failed(format!("no free UDP port: {error}")))?;
    link.insert("port".to_owned(), i64::from(port).into());
    let seed = if let Some(seed) = args.seed {
        seed
    } else {
        let bytes = random_bytes().map_err(|error| failed(format!("no seed: {error}")))?;
        u64::from(u32::from_ne_bytes(bytes))
    };
    let mut text = topology(args, seed, link).map_err(usage)?;
    text.extend(flows.map(|flows| ("flows".to_owned(), flows)));
    let text = text.to_string();
    let topology = hil_topology::parse("join", &text, &[], registry.known());
    let topology = topology.map_err(|errors| usage(as_typed(args, &errors)))?;
    let run = RunArgs {
        topology: None,
        host: None,
        on_one_pc: false,
        on_one_pc_as: None,
        probe: None,
        overrides: Vec::new(),
        check: false,
        quiet: args.quiet,
        full: args.full,
        domain_root: None,
    };
    let mut command_line: Vec<String> = env::args().collect();
    if args.seed.is_none()
        && let Some(at) = command_line.iter().skip(1).position(|word| word == "join")
    {
        command_line.insert(at + 2, format!("--seed={seed}"));
    }
    carry_out(
        Path::new("join"),
        &run,
        &topology,
        command_line,
        registry,
        console,
    )
}

/// The faults of the topology that was made of the command line, each by what was typed.
fn as_typed(args: &JoinArgs, errors: &TopologyErrors) -> String {
    let typed = |error: &TopologyError| {
        let TopologyError { key, fault, .. } = error;
        if let Some(key) = key.strip_prefix("links.link.") {
            let link = args.link.as_deref().unwrap_or_default();
            return format!("--link '{link}': {key} {fault}");
        }
        match key.as_str() {
            "run.duration" => format!("--duration {fault}"),
            "run.seed" => format!("--seed {fault}"),
            _ => format!("{key} {fault}"),
        }
    };
    let typed: Vec<String> = errors.errors().iter().map(typed).collect();
    typed.join("\n")
}

/// Where Linux says from which port on it gives those to sockets that ask for none, ip(7), and its default.
const GIVEN_AWAY: (&str, u16) = ("/proc/sys/net/ipv4/ip_local_port_range", 32_768);
/// Above the defaults of our own topologies.
const FIRST_PORT: u16 = 10_000;

/// The first of as many UDP ports in a row as a link takes on one PC, none of which is in use, by lot. The gateways bind
/// them a moment later: another program that asks for any port is not given one of them until then.
fn free_ports() -> io::Result<u16> {
    const ATTEMPTS: u32 = 100;
    let (file, by_default) = GIVEN_AWAY;
    let range = fs::read_to_string(file).unwrap_or_default();
    let first_given = range.split_whitespace().next().map(str::parse);
    let first_given = first_given.and_then(Result::ok).unwrap_or(by_default);
    let count = LinkPorts::count(true);
    // Where the kernel gives nearly all ports away, any will do.
    let is_room = first_given > FIRST_PORT.saturating_add(1_000);
    let end = if is_room { first_given } else { u16::MAX } - count;
    let mut outcome = Err(io::ErrorKind::AddrInUse.into());
    for _ in 0..ATTEMPTS {
        let lot = u16::from_ne_bytes(random_bytes()?);
        let first = FIRST_PORT + lot % (end - FIRST_PORT);
        let link = (first..first + count).map(|port| UdpSocket::bind((Ipv4Addr::LOCALHOST, port)));
        // Held until all are known to be free.
        match link.collect::<io::Result<Vec<_>>>() {
            Ok(_free) => return Ok(first),
            Err(error) => outcome = Err(error),
        }
    }
    outcome
}

/// What is between the programs.
struct Between {
    link: Table,
    /// Names of flows and their deadlines, of a file.
    flows: Option<Value>,
}

/// The link of a file, with its flows, or of words; without either one that hurts nothing.
fn between(
    said: Option<&str>,
    registry: &Registry,
    console: &mut Console,
) -> Result<Between, Refusal> {
    let only = |link| Between { link, flows: None };
    match said {
        Some(path) if Path::new(path).is_file() => {
            let path = PathBuf::from(path);
            let topology = hil_topology::load_case(&path, &[], registry.known());
            let resolved = loaded(topology, console)?.resolved();
            let link =
                only_link(&resolved).map_err(|why| usage(format!("{}: {why}", path.display())))?;
            Ok(Between {
                link,
                flows: resolved.get("flows").cloned(),
            })
        }
        Some(words) => link_of_words(words).map(only).map_err(usage),
        None => Ok(only(Table::from_iter([via("udp")]))),
    }
}

fn via(word: &str) -> (String, Value) {
    ("via".to_owned(), word.into())
}

/// The one link of a topology.
fn only_link(topology: &Table) -> Result<Table, String> {
    let links = topology.get("links").and_then(Value::as_table);
    let mut links = links.into_iter().flat_map(Table::values);
    match (links.next().and_then(Value::as_table), links.next()) {
        (Some(link), None) => Ok(link.clone()),
        (None, _) => Err("has no link".to_owned()),
        (Some(_), Some(_)) => Err("has several links, and two programs have one".to_owned()),
    }
}

/// `delay 5ms loss 1% rate 10Mbit`, any of them.
fn link_of_words(text: &str) -> Result<Table, String> {
    let mut link = Table::from_iter([via("emulated")]);
    let plain = text.replace(QUOTES, "").replace(['=', ':'], " ");
    let words = plain.split_whitespace();
    let words = words.map(|word| word.trim_end_matches([',', ';']));
    let mut words = words.filter(|word| !word.is_empty()).peekable();
    if words.peek().is_none() {
        return Err("--link is empty: say delay, loss or rate, or name a topology file".to_owned());
    }
    while let Some(word) = words.next() {
        let Some(key) = key(word) else {
            return Err(format!(
                "--link: `{word}` is neither delay, loss nor rate, and `{text}` no file"
            ));
        };
        let Some(number) = words.next_if(|word| self::key(word).is_none()) else {
            return Err(format!("--link: `{key}` has no value"));
        };
        // A blank may stand before the unit.
        let is_number = number.parse::<f64>().is_ok() || has_decimal_comma(number);
        let unit = words.next_if(|word| is_number && self::key(word).is_none());
        let value = [number, unit.unwrap_or_default()].concat();
        let wrong = |expected: &str| {
            let is_of_number = |letter: char| letter.is_ascii_digit() || letter == ',';
            let unit = value.trim_start_matches(is_of_number);
            if has_decimal_comma(&value[..value.len() - unit.len()]) {
                let point = value.replacen(',', ".", 1);
                format!("--link: {key} is `{value}` with a decimal comma, write {point}")
            } else {
                format!("--link: {key} is `{value}`, expected {expected}")
            }
        };
        let (key, value): (&str, Value) = match key {
            "loss" => {
                let ratio = per_cent(&value).ok_or_else(|| wrong("0% to 100%"))?;
                ("loss_ratio", ratio.into())
            }
            "rate" => {
                let bits = bits_per_second(&value).ok_or_else(|| wrong("a rate such as 10Mbit"))?;
                let rate = Table::from_iter([("bits_per_second".to_owned(), bits.into())]);
                ("rate", rate.into())
            }
            delay => (delay, value.into()),
        };
        if link.insert(key.to_owned(), value).is_some() {
            return Err(format!("--link: {key} is said twice"));
        }
    }
    Ok(link)
}

/// What a shell or a page of text puts around words.
const QUOTES: [char; 8] = [
    '"', '\'', '\u{2018}', '\u{2019}', '\u{201c}', '\u{201d}', '\u{201e}', '\u{feff}',
];

/// What a word of `--link` is about, in letters of any size.
fn key(word: &str) -> Option<&'static str> {
    let keys = ["delay", "loss", "rate"];
    keys.into_iter().find(|key| word.eq_ignore_ascii_case(key))
}

fn per_cent(text: &str) -> Option<f64> {
    let share: f64 = text.strip_suffix('%')?.parse().ok()?;
    (0.0..=100.0).contains(&share).then_some(share / 100.0)
}

/// `10Mbit`, `1.5mbit`, `1gbit/s`: bits, in letters of any size as `tc` has them.
fn bits_per_second(text: &str) -> Option<i64> {
    let text = text.to_ascii_lowercase();
    let number = text
        .strip_suffix("/s")
        .unwrap_or(&text)
        .strip_suffix("bit")?;
    let units = [
        ("k", 1_000),
        ("m", 1_000_000),
        ("g", 1_000_000_000),
        ("", 1),
    ];
    let mut units = units.into_iter();
    let (number, unit) = units.find_map(|(end, unit)| Some((number.strip_suffix(end)?, unit)))?;
    let (whole, decimals) = number.split_once('.').unwrap_or((number, ""));
    let scale = 10_i64.checked_pow(u32::try_from(decimals.len()).ok()?)?;
    let digits: i64 = [whole, decimals].concat().parse().ok()?;
    let bits = digits.checked_mul(unit)?;
    (bits % scale == 0).then_some(bits / scale)
}

/// The file that runs both programs with `link` between them.
fn topology(args: &JoinArgs, seed: u64, mut link: Table) -> Result<Table, String> {
    let programs: Vec<&[String]> = args.programs.splitn(2, |word| word == "--").collect();
    let [first, second] = programs[..] else {
        return Err("one program only: say -- FIRST -- SECOND".to_owned());
    };
    if first.is_empty() || second.is_empty() {
        return Err("a program is missing: say -- FIRST -- SECOND".to_owned());
    }
    let text = |text: &str| Value::from(text);
    let table = |pairs: Vec<(&str, Value)>| -> Value {
        let pairs = pairs
            .into_iter()
            .map(|(key, value)| (key.to_owned(), value));
        Value::Table(pairs.collect())
    };
    let process = |(name, address): (&str, &str), command: &[String]| {
        let command = command.iter().map(|word| text(word)).collect::<Vec<_>>();
        table(vec![
            ("host", text(name)),
            ("run", command.into()),
            ("inside", text(address)),
        ])
    };
    let channel = |from: &str, to: &str| {
        let value = table(vec![
            ("from", text(from)),
            ("to", text(to)),
            ("link", text("link")),
        ]);
        (format!("{from}/{to}"), value)
    };
    let [(one, _), (other, _)] = ENDS;
    let hosts = [text(one), text(other)];
    link.insert("between".to_owned(), Value::Array(hosts.to_vec()));
    link.insert("path_mtu_bytes".to_owned(), PATH_MTU_BYTES.into());
    let seed = i64::try_from(seed).map_err(|_large| format!("--seed {seed} is too large"))?;
    let whole = table(vec![
        ("version", 1.into()),
        ("name", text("join")),
        (
            "run",
            table(vec![
                (
                    "duration",
                    text(args.duration.as_deref().unwrap_or(LONGEST)),
                ),
                ("seed", seed.into()),
            ]),
        ),
        (
            "hosts",
            table(vec![(one, table(Vec::new())), (other, table(Vec::new()))]),
        ),
        (
            "processes",
            table(vec![
                (one, process(ENDS[0], first)),
                (other, process(ENDS[1], second)),
            ]),
        ),
        (
            "channels",
            Value::Table(
                [channel(one, other), channel(other, one)]
                    .into_iter()
                    .collect(),
            ),
        ),
        ("links", table(vec![("link", link.into())])),
    ]);
    match whole {
        Value::Table(whole) => Ok(whole),
        _ => unreachable!("made as a table just above"),
    }
}

#[cfg(test)]
mod tests {
    use hil_topology::Process;

    use super::*;

    fn args(programs: &[&str]) -> JoinArgs {
        JoinArgs {
            link: None,
            duration: None,
            seed: None,
            quiet: true,
            full: false,
            programs: programs.iter().map(|&word| word.to_owned()).collect(),
        }
    }

    #[test]
    fn words_become_a_link_and_wrong_ones_are_named() {
        let link = link_of_words("delay 5ms loss 1% rate 10Mbit").unwrap();
        assert_eq!(link["delay"].as_str(), Some("5ms"));
        assert_eq!(link["loss_ratio"].as_float(), Some(0.01));
        assert_eq!(
            link["rate"]["bits_per_second"].as_integer(),
            Some(10_000_000)
        );
        for other in [
            "Delay 5 ms, loss 1 % rate 10 Mbit",
            "\u{feff}delay 5ms; LOSS 1.0%; rate 10mbit/s",
            "\"delay 5ms\" loss=1% rate: 0.01Gbit",
            "\u{201c}delay 5ms loss 1% rate 10000.0kbit\u{201d}",
        ] {
            assert_eq!(link_of_words(other), Ok(link.clone()), "{other}");
        }
        let bits = |text| bits_per_second(text);
        assert_eq!(bits("1.5Mbit"), Some(1_500_000));
        assert_eq!(bits("1gbit"), Some(1_000_000_000));
        assert_eq!(bits("700bit"), Some(700));
        assert_eq!(
            [bits("0.5bit"), bits("1.Xbit"), bits("bit"), bits("1mbps")],
            [None; 4]
        );
        for (words, says) in [
            ("", "empty"),
            ("nosuch.toml", "`nosuch.toml` no file"),
            ("loss rate 1Mbit", "`loss` has no value"),
            ("loss 0,1%", "decimal comma, write 0.1%"),
            ("loss 0,1 %", "decimal comma, write 0.1%"),
            ("rate 1,5Mbit", "decimal comma, write 1.5Mbit"),
            ("delay", "no value"),
            ("loss 2", "0% to 100%"),
            ("loss 101%", "0% to 100%"),
            ("rate 10M", "such as 10Mbit"),
            ("jitter 1ms", "no file"),
            ("loss 1% loss 2%", "twice"),
        ] {
            let why = link_of_words(words).unwrap_err();
            assert!(why.contains(says), "{words}: {why}");
        }
    }

    #[test]
    fn two_programs_become_a_topology_with_a_channel_each_way() {
        let registry = Registry::default();
        let link = link_of_words("delay 5ms loss 1%").unwrap();
        let table = topology(&args(&["sh", "-c", "true", "--", "sleep", "1"]), 7, link).unwrap();
        let text = table.to_string();
        let parsed = hil_topology::parse("join", &text, &[], registry.known()).unwrap();
        let addresses: Vec<_> = parsed.processes().iter().map(Process::inside).collect();
        let expected = ENDS.map(|(_, address)| Some(address.parse().unwrap()));
        assert_eq!(addresses, expected);
        assert_eq!(parsed.crossings().count(), 2);
        // Where no duration was given, none is shown.
        assert_eq!(parsed.run().planned(), None);
        assert!(parsed.is_all_local());
    }

    #[test]
    fn a_fault_points_at_what_was_typed() {
        let registry = Registry::default();
        for (words, duration, says) in [
            ("delay 5", None, "--link 'delay 5': delay \"5\" "),
            (
                "delay 2,5ms",
                None,
                "--link 'delay 2,5ms': delay \"2,5ms\" has a decimal comma; write 2.5ms",
            ),
            (
                "rate 1bit",
                None,
                "--link 'rate 1bit': rate.bits_per_second ",
            ),
            ("delay 5ms", Some("9"), "--duration \"9\" "),
        ] {
            let args = JoinArgs {
                link: Some(words.to_owned()),
                duration: duration.map(str::to_owned),
                ..args(&["sleep", "1", "--", "sleep", "1"])
            };
            let link = link_of_words(words).unwrap();
            let text = topology(&args, 7, link).unwrap().to_string();
            let errors = hil_topology::parse("join", &text, &[], registry.known()).unwrap_err();
            let typed = as_typed(&args, &errors);
            assert!(
                typed.starts_with(says) && typed.contains("expected")
                    || typed.starts_with(says) && typed.contains("outside"),
                "{typed}"
            );
        }
    }

    #[test]
    fn a_program_too_few_is_refused() {
        let link = || Table::from_iter([via("udp")]);
        for programs in [&["sleep", "1"][..], &["sleep", "--"], &["--", "sleep"]] {
            let why = topology(&args(programs), 7, link()).unwrap_err();
            assert!(why.contains("-- FIRST -- SECOND"), "{why}");
        }
    }
}
