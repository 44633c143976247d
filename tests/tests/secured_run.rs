//! The real binary between two hosts whose hops are sealed: an ordinary run, keys that do not fit or are
//! not private, and a stranger on the same wire who spoofs a host's address.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::disallowed_methods,
    reason = "tests"
)]

use std::env;
use std::fs::{self, Permissions};
use std::net::SocketAddrV4;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use hil_models::random::RandomStream;
use hil_runtime::report::summary::{DirectionSummary, Outcome, RunSummary};
use hil_runtime::security::PreSharedKey;
use hil_tests::account::{
    account, assert_accounts_close, assert_every_message_is_accounted_for, channel, describe,
};
use hil_tests::attacker::{Attacker, Flood};
use hil_tests::binary::hil_runtime_binary;
use hil_tests::child::{self, ChildGuard, Finished};
use hil_tests::lab::{ADDRESSES, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial, hop_key, wait_until};

const HOSTS: [&str; 2] = ["control-pc", "robot-pc"];
const CHANNELS: [&str; 2] = ["shuttle/command", "shuttle/status"];
const LIMIT: Duration = Duration::from_mins(1);
const RUN_LIMIT: Duration = Duration::from_mins(3);
/// No other file of tests uses these ports.
const PORT: u16 = 7860;
/// Datagrams the stranger sends in a second, if it can.
const RATE: u32 = 100_000;

fn trial(record: &RunFolder) -> Trial {
    Trial::shipped("shuttle-split.toml", record.path()).set(&format!("links.hop.port={PORT}"))
}

struct Split {
    hosts: [ChildGuard; 2],
    files: [RunFiles; 2],
    lab: Lab,
}

impl Split {
    fn start(lab: Lab, trial: &Trial) -> Self {
        let hosts = [0, 1].map(|index| trial.start_on(lab.host(index)));
        let files = HOSTS.map(|host| trial.folder(&format!("-{host}"), LIMIT));
        Self { hosts, files, lab }
    }

    /// Waits until commands flow.
    fn wait_for_messages(&self) {
        wait_until(LIMIT, "commands", || {
            self.files[1].record_bytes("shuttle.command.taken.") > 100 * 32
        });
    }

    fn finish(mut self) -> [RunSummary; 2] {
        for host in &mut self.hosts {
            host.wait_within(RUN_LIMIT).unwrap().assert_success();
        }
        let summaries = [0, 1].map(|index| self.files[index].summary());
        for (index, files) in self.files.iter().enumerate() {
            files.assert_nothing_left_on(self.lab.host(index));
        }
        for summary in &summaries {
            assert_eq!(summary.run.outcome, Outcome::Completed, "{:?}", summary.run);
            assert_every_message_is_accounted_for(summary);
            for name in CHANNELS {
                println!(
                    "{}: {}",
                    summary.run.host,
                    describe(name, account(summary, name))
                );
            }
        }
        summaries
    }
}

fn direction<'a>(summary: &'a RunSummary, name: &str, which: &str) -> &'a DirectionSummary {
    let mut all = channel(summary, name).directions.iter();
    all.find(|one| one.direction.contains(which)).unwrap()
}

fn count(direction: &DirectionSummary, name: &str) -> u64 {
    let counters = direction.counters.iter().filter(|one| one.name == name);
    counters.map(|one| one.count).sum()
}

fn refused(direction: &DirectionSummary) -> u64 {
    let counters = direction.counters.iter();
    let refused = counters.filter(|one| one.name.starts_with("refused: "));
    refused.map(|one| one.count).sum()
}

#[test]
fn an_ordinary_run_is_sealed_and_its_account_closes() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("sealed");
    let key = PreSharedKey::read(&hop_key(record.path())).unwrap();
    let split = Split::start(lab, &trial(&record).set("run.duration=\"6 s\""));
    let report = split.files[1].clone();
    for summary in &split.finish() {
        assert_accounts_close(summary);
        let security = summary.run.security.as_deref().unwrap();
        assert!(
            security.starts_with("sealed (") && security.contains(&key.fingerprint()),
            "{security}"
        );
        for name in CHANNELS {
            let (egress, ingress) = (
                direction(summary, name, "egress"),
                direction(summary, name, "ingress"),
            );
            assert!(count(ingress, "seal: opened_count") > 100);
            assert_eq!(
                count(ingress, "seal: opened_count"),
                count(ingress, "datagram_count")
            );
            // A greeting that waits for keys gives way to the next.
            assert!(count(egress, "seal: sealed_count") <= count(egress, "datagram_count"));
            assert_eq!(
                (refused(egress), refused(ingress)),
                (0, 0),
                "{:?}",
                ingress.counters
            );
            assert_eq!(account(summary, name).fates.lost_count(), 0);
        }
    }
    assert!(report.read("report.txt").contains("Security"));
    // The secret of the run is in no file that it left.
    let launches = fs::read_dir(report.root().join("launch")).unwrap();
    for file in launches.map(|file| file.unwrap().path()) {
        let text = fs::read_to_string(&file).unwrap();
        assert!(!text.contains("secret"), "{}", file.display());
    }
}

/// What both hosts of a run end with that cannot come about.
fn ends(lab: &Lab, trials: [&Trial; 2]) -> [Finished; 2] {
    let mut hosts = [0, 1].map(|index| trials[index].start_on(lab.host(index)));
    [0, 1].map(|index| hosts[index].wait_within(LIMIT).unwrap())
}

#[test]
fn hosts_with_other_keys_or_without_one_both_say_so_and_end() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let (record, other) = (RunFolder::new("key-a"), RunFolder::new("key-b"));
    let patience = "run.start_timeout=\"4 s\"";
    let keyed = trial(&record).set(patience);
    let other_key = format!("security.key=\"{}\"", hop_key(other.path()).display());
    let elsewhere = keyed.clone().set(&other_key);
    let plain = keyed.clone().plain();
    for (trials, words) in [
        ([&keyed, &elsewhere], "another key"),
        ([&keyed, &plain], "key"),
        ([&plain, &keyed], "plain"),
    ] {
        for finished in ends(&lab, trials) {
            assert_eq!(finished.status.code(), Some(77), "{}", finished.stderr);
            assert!(
                finished.stderr.contains(words),
                "{words}: {}",
                finished.stderr
            );
            assert!(!finished.stderr.contains("hil-psk-v1"));
        }
    }
}

#[test]
fn a_key_that_others_can_read_is_refused_before_anything_starts() {
    let record = RunFolder::new("key-mode");
    let key = hop_key(record.path());
    fs::set_permissions(&key, Permissions::from_mode(0o644)).unwrap();
    let run = |trial: &Trial| {
        let mut command = trial.command_here();
        command.args(["--host", "robot-pc"]);
        ChildGuard::spawn(&mut command)
            .unwrap()
            .wait_within(LIMIT)
            .unwrap()
    };
    let finished = run(&trial(&record));
    assert_eq!(finished.status.code(), Some(77), "{}", finished.stderr);
    let path = key.display().to_string();
    for words in [path.as_str(), "0644", "chmod 0600"] {
        assert!(finished.stderr.contains(words), "{}", finished.stderr);
    }
    fs::remove_file(&key).unwrap();
    let gone = trial(&record).set(&format!("security.key=\"{}.gone\"", key.display()));
    let finished = run(&gone);
    assert_eq!(finished.status.code(), Some(77), "{}", finished.stderr);
    assert!(
        finished.stderr.contains("hil-runtime key new"),
        "{}",
        finished.stderr
    );
}

#[test]
fn two_hosts_without_a_word_on_security_do_not_start() {
    let record = RunFolder::new("unsaid");
    let shipped =
        fs::read_to_string(hil_tests::trial::shipped_topology("shuttle-split.toml")).unwrap();
    let local = hil_tests::trial::shipped_topology("shuttle-local.toml");
    let unsaid: Vec<&str> = shipped
        .lines()
        .filter(|line| !line.starts_with("key = ") && *line != "[security]")
        .collect();
    let text = unsaid
        .join("\n")
        .replace("shuttle-local.toml", &local.display().to_string());
    let path = record.write("unsaid.toml", &text);
    for arguments in [&["--host", "robot-pc"][..], &["--check"]] {
        let mut command = Command::new(hil_runtime_binary());
        command.arg("--topology").arg(&path).args(arguments);
        let finished = ChildGuard::spawn(&mut command)
            .unwrap()
            .wait_within(LIMIT)
            .unwrap();
        assert_eq!(finished.status.code(), Some(2), "{}", finished.stderr);
        for cure in ["hil-runtime key new", "hops = \"plain\""] {
            assert!(finished.stderr.contains(cure), "{}", finished.stderr);
        }
    }
}

#[test]
fn the_key_command_makes_checks_and_never_shows_a_key() {
    let folder = RunFolder::new("key-command");
    let path = folder.join("hop.key");
    let run = |word: &str| {
        let mut command = Command::new(hil_runtime_binary());
        command.args(["key", word]).arg(&path);
        ChildGuard::spawn(&mut command)
            .unwrap()
            .wait_within(LIMIT)
            .unwrap()
    };
    let made = run("new");
    made.assert_success();
    let fingerprint = PreSharedKey::read(&path).unwrap().fingerprint();
    let again = run("new");
    assert_eq!(again.status.code(), Some(2), "{}", again.stderr);
    let checked = run("check");
    checked.assert_success();
    let secret = fs::read_to_string(&path).unwrap();
    let secret = secret.trim().strip_prefix("hil-psk-v1:").unwrap();
    for finished in [made, checked] {
        assert!(
            finished.stdout.contains(&fingerprint),
            "{}",
            finished.stdout
        );
        assert!(!finished.stdout.contains(secret));
    }
}

/// Resident bytes of the gateway of host 1.
fn gateway_bytes(files: &RunFiles) -> u64 {
    let process = files.process("gateway-hop-robot-pc", 0).unwrap();
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib: u64 = line
        .unwrap()
        .trim()
        .trim_end_matches(" kB")
        .parse()
        .unwrap();
    kib * 1024
}

/// The hardware address of host 1.
fn hardware_address(lab: &Lab) -> String {
    let namespace = lab.host(1).namespace();
    let mut command = Command::new("ip");
    command.args([
        "netns",
        "exec",
        namespace,
        "cat",
        "/sys/class/net/eth0/address",
    ]);
    child::run(&mut command, LIMIT)
        .unwrap()
        .stdout
        .trim()
        .to_owned()
}

/// One after the other: a recorded datagram, the same with a bit flipped, cut, with another payload, as a
/// plain one, of another channel, of another session, of another version, and noise.
fn attack(recorded: &[Vec<u8>], random: &mut RandomStream, number: u64, out: &mut Vec<u8>) {
    let index = usize::try_from(random.next_u64() % recorded.len() as u64).unwrap();
    out.extend_from_slice(&recorded[index]);
    let byte = random.next_u64().to_le_bytes();
    match number % 9 {
        0 => {}
        1 => {
            let bit = usize::try_from(random.next_u64() % (out.len() as u64 * 8)).unwrap();
            out[bit / 8] ^= 1 << (bit % 8);
        }
        2 => out.truncate(usize::from(byte[0]) % out.len()),
        3 => {
            let end = out.len();
            out[72..end - 16].fill(byte[0]);
            out[68..72].copy_from_slice(&byte[..4]);
        }
        4 => {
            out[6..8].fill(0);
            out[68..72].fill(0);
            out.truncate(out.len() - 16);
        }
        5 => out[12] = !out[12],
        6 => out[8..12].copy_from_slice(&byte[..4]),
        7 => out[4] = 2,
        _ => {
            out.clear();
            out.extend((0..100).map(|_| random.next_u64().to_le_bytes()[0]));
        }
    }
}

fn flood(attacker: &Attacker, recorded: &[Vec<u8>], span: Duration) -> Flood {
    let mut random = RandomStream::new(9, "attack");
    let from = SocketAddrV4::new(ADDRESSES[0], PORT);
    let to = SocketAddrV4::new(ADDRESSES[1], PORT + 1);
    attacker.flood((from, to), (span, RATE), &mut |number, out| {
        attack(recorded, &mut random, number, out);
    })
}

/// Seconds of the attack: `HIL_ATTACK_SECONDS`, else 5.
fn attack_span() -> Duration {
    let asked = env::var("HIL_ATTACK_SECONDS").ok();
    let seconds = asked.and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(5))
}

fn assert_refused_by_cause(ingress: &DirectionSummary) {
    for cause in [
        "replayed",
        "forged or damaged",
        "too short",
        "not sealed",
        "foreign channel",
        "foreign session",
        "wrong version",
        "foreign protocol",
    ] {
        let counted = count(ingress, &format!("refused: {cause}"));
        println!("refused, {cause}: {counted}");
        assert!(counted > 0, "{cause}: {:?}", ingress.counters);
    }
}

fn run_attacked(record: &Path, span: Duration) -> Option<([RunSummary; 2], Flood, [u64; 2])> {
    let lab = Lab::two_hosts_or_skip()?;
    lab.put_bridge_between();
    let first = lab.host(0).namespace().to_owned();
    // The name of the lab with another host number, so that the next lab sweeps what a kill leaves.
    let name = format!("{}2", first.strip_suffix('0').unwrap());
    let hardware = hardware_address(&lab);
    let attacker = Attacker::join(&first, &name, ADDRESSES[0], (ADDRESSES[1], &hardware));
    let duration = format!("run.duration=\"{} s\"", span.as_secs() + 6);
    let trial = Trial::shipped("shuttle-split.toml", record)
        .set(&format!("links.hop.port={PORT}"))
        .set(&duration);
    let split = Split::start(lab, &trial);
    split.wait_for_messages();
    let recorded = attacker.overhear(PORT + 1, 200, LIMIT);
    assert!(recorded.len() >= 200, "the stranger hears the wire");
    let before = gateway_bytes(&split.files[1]);
    let flood = flood(&attacker, &recorded, span);
    let after = gateway_bytes(&split.files[1]);
    Some((split.finish(), flood, [before, after]))
}

#[test]
fn a_stranger_with_a_hosts_address_gets_nothing_in_and_stops_nothing() {
    let quiet = RunFolder::new("quiet");
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    lab.put_bridge_between();
    println!("quiet run:");
    let calm = Split::start(lab, &trial(&quiet).set("run.duration=\"6 s\"")).finish();
    assert_eq!(account(&calm[1], CHANNELS[0]).fates.lost_count(), 0);
    let record = RunFolder::new("attacked");
    let span = attack_span();
    println!("attacked run:");
    let Some((summaries, flood, [before, after])) = run_attacked(record.path(), span) else {
        return;
    };
    let ingress = direction(&summaries[1], CHANNELS[0], "ingress");
    let received = count(ingress, "socket: received_count");
    let dropped = count(ingress, "socket: kernel_drop_count");
    let opened = count(ingress, "seal: opened_count");
    println!(
        "{} datagrams of the stranger in {:?}, {:.0} a second; {received} reached the gateway, {dropped} \
         its full buffer; {} refused, {opened} opened; memory {before} to {after} bytes",
        flood.sent_count,
        flood.took,
        flood.rate(),
        refused(ingress)
    );
    assert_refused_by_cause(ingress);
    // Whatever reached the gateway was opened, answered or refused, and opened was what was sealed.
    let exchanged = count(ingress, "seal: key_exchange_count");
    assert_eq!(
        received,
        opened + exchanged + refused(ingress),
        "{:?}",
        ingress.counters
    );
    assert_eq!(opened, count(ingress, "datagram_count"));
    let egress = direction(&summaries[1], CHANNELS[0], "egress");
    assert!(
        opened <= count(egress, "seal: sealed_count"),
        "more opened than sealed"
    );
    assert_eq!(count(ingress, "messages: duplicate_count"), 0);
    assert!(flood.sent_count > 1_000 && refused(ingress) > flood.sent_count / 4);
    assert!(
        after < before + (8 << 20),
        "memory grew from {before} to {after}"
    );
    for summary in &summaries {
        assert_accounts_close(summary);
    }
}
