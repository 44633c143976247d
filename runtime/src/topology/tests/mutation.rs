//! Damaged files: whatever the damage, there is an answer and no panic.

use hil_models::random::RandomStream;

use super::*;

/// Pieces that are likely to make a file differently wrong.
const TOKENS: &[&str] = &[
    "[",
    "]",
    "{",
    "}",
    "=",
    ".",
    "\"",
    "'",
    "\n",
    ",",
    "#",
    "0",
    "-1",
    "1e999",
    "nan",
    "true",
    "\"9999999999 h\"",
    "\"µs\"",
    "[links.hop]",
    "via = \"udp\"",
    "via = \"tcp\"",
    "[links.hop.outages]",
    "extends = \"/dev/null\"",
    "99999999999999999999",
    "1979-05-27",
    "\u{1F916}",
    "\t",
    "\r\n",
    "\u{0}",
    "port = 65534",
    "between = []",
    "host = \"robot-pc\"",
];

/// One table of each kind, short enough to be read 100 000 times.
const SHORT: &str = r#"
version = 1
name = "short"
run = { duration = "2 min", seed = 7 }
case = { name = "shuttle", parameters = { rate_hz = 125 } }
hosts = { a = { address = "10.77.0.1", interface = "eth0" }, b = { address = "::1" } }
[processes.controller]
host = "a"
role = "controller"
cpu = [1, 2]
scheduling = "fifo"
priority = 41
[processes.robot]
host = "b"
role = "robot"
run = ["./robot", "--fast"]
env = { RUST_LOG = "debug" }
on_exit = "restart"
[channels."shuttle/command"]
depth = 4
link = "hop"
[channels."shuttle/status"]
link = "hop"
[links.hop]
via = "emulated"
between = ["b", "a"]
delay = "50 ms"
backward.loss_ratio = 0.1
outages = { mean = "500 ms", per_hour = 100, buffered = true }
gateway.wait = "hybrid"
"#;

fn index(random: &mut RandomStream, length: usize) -> usize {
    usize::try_from(random.next_u64() % length.max(1) as u64).unwrap()
}

fn mutate(text: &mut Vec<char>, random: &mut RandomStream) {
    if text.is_empty() {
        return;
    }
    let at = index(random, text.len());
    match random.next_u64() % 6 {
        0 => {
            text.remove(at);
        }
        1 => text[at] = char::from(32 + u8::try_from(random.next_u64() % 95).unwrap()),
        2 => {
            let token = TOKENS[index(random, TOKENS.len())];
            text.splice(at..at, token.chars());
        }
        3 => {
            let end = (at + index(random, 40)).min(text.len());
            text.drain(at..end);
        }
        4 => {
            let end = (at + index(random, 60)).min(text.len());
            let copy = text[at..end].to_vec();
            let to = index(random, text.len());
            text.splice(to..to, copy);
        }
        _ => {
            let other = index(random, text.len());
            text.swap(at, other);
        }
    }
}

/// Damages `SHORT` so often; the number of files that were good all the same.
fn good_after_damage(seed: u64, count: usize) -> usize {
    let known = known();
    let good: Vec<char> = SHORT.chars().collect();
    let mut random = RandomStream::new(seed, "topology mutations");
    let mut good_count = 0;
    for round in 0..count {
        let mut text = good.clone();
        for _ in 0..=random.next_u64() % 3 {
            mutate(&mut text, &mut random);
        }
        let text: String = text.into_iter().collect();
        let writes_back = round % 16 == 0;
        match parse("damaged.toml", &text, &[], &known) {
            Ok(topology) => {
                good_count += 1;
                if writes_back {
                    assert_eq!(parse_good(&topology.to_toml()), topology, "{text}");
                }
            }
            Err(errors) => {
                assert!(!errors.errors().is_empty());
                if writes_back {
                    assert!(errors.render(false).contains("error"));
                }
            }
        }
    }
    good_count
}

#[test]
fn no_damage_makes_the_reader_panic() {
    let good_count: usize = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..4)
            .map(|seed| scope.spawn(move || good_after_damage(seed, 25_000)))
            .collect();
        let counts = threads.into_iter().map(|thread| thread.join().unwrap());
        counts.sum()
    });
    // Comments, blanks and new numbers are harmless, most else is not.
    assert!((1_000..50_000).contains(&good_count), "{good_count}");
}

#[test]
fn no_damaged_override_makes_the_reader_panic() {
    let known = known();
    let mut random = RandomStream::new(2, "topology mutations");
    for _ in 0..5_000 {
        let mut text: Vec<char> = "links.hop.delay=20 ms".chars().collect();
        for _ in 0..=random.next_u64() % 4 {
            mutate(&mut text, &mut random);
        }
        let text: String = text.into_iter().collect();
        if let Err(errors) = parse("good.toml", EVERYTHING, &[text], &known) {
            assert!(errors.render(false).contains("error"));
        }
    }
}
