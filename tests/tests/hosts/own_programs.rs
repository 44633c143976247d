//! Programs of the user's own on two hosts: the run waits for them, what they publish and are given is recorded, and
//! a network that cannot be reached is a loss of the network with its cause.

use std::thread;
use std::time::Duration;

use hil_account::MessageFate;
use hil_account::network::NetworkEventKind;
use hil_tests::account::{account, describe};
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::split::HOSTS;
use hil_tests::trial::{RunFiles, Trial, processes_mentioning};
use nix::sys::signal::{Signal, kill};

use super::many_channels;

const LIMIT: Duration = Duration::from_mins(2);
const HZ: u32 = 100;

#[test]
fn an_interface_that_is_down_is_a_loss_of_the_network_and_programs_have_whole_accounts() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("own-programs");
    let path = many_channels::topology(&record, 2, HZ, Duration::from_secs(14));
    // One of them takes its time.
    let program = env!("CARGO_BIN_EXE_hil-traffic");
    let slow = format!("processes.b.run=[\"sh\", \"-c\", \"sleep 2; exec {program} {HZ}.0\"]");
    let trial = Trial::of(&path, record.path())
        .set(&slow)
        .set("processes.b.on_exit=\"restart\"");
    let mut supervisors = [0, 1].map(|index| trial.start_on(lab.host(index)));
    let files = [0, 1].map(|index| {
        let located = lab.host(index).locate(record.path());
        RunFiles::find(
            &located,
            record.path(),
            &format!("-{}", HOSTS[index]),
            LIMIT,
        )
    });
    // Progress is printed from the begin of the run on.
    supervisors[0]
        .wait_for_output(" / 14 s", LIMIT)
        .unwrap_or_else(|reason| panic!("{reason}"));
    lab.host(0).set_link("eth0", "down");
    thread::sleep(Duration::from_secs(2));
    lab.host(0).set_link("eth0", "up");
    // It is back after the two seconds that it takes to join.
    let consumers = processes_mentioning(&format!("{program}\0{HZ}.0"));
    assert_eq!(consumers.len(), 1);
    kill(consumers[0], Signal::SIGKILL).unwrap();
    for supervisor in &mut supervisors {
        supervisor.wait_within(LIMIT).unwrap().assert_success();
    }
    for summary in files.each_ref().map(RunFiles::summary) {
        let there = account(&summary, "there/0");
        let said = describe("there/0", there);
        println!("{said}");
        let of = |fate| there.fates.of(fate);
        assert!(
            of(MessageFate::NetworkUnreachable) > u64::from(HZ),
            "{said}"
        );
        assert!(of(MessageFate::Taken) > 4 * u64::from(HZ), "{said}");
        let in_interruption = of(MessageFate::LostInInterruption);
        assert!(in_interruption > 3 * u64::from(HZ) / 2, "{said}");
        assert_eq!(of(MessageFate::UnknownPeerRecordsUnavailable), 0, "{said}");
        let network = summary.network.as_ref().unwrap();
        let channel = network.channels.iter().find(|one| one.channel == "there/0");
        let figures = &channel.unwrap().figures;
        let loss = figures.loss.measured().unwrap();
        assert!(
            figures.lost_count >= of(MessageFate::NetworkUnreachable),
            "{loss:?}"
        );
        assert!(loss.longest.unwrap().length_ns > 1_500_000_000, "{loss:?}");
        let has_cause = network.events.iter().any(|event| {
            event.channel == "there/0"
                && matches!(
                    event.kind,
                    NetworkEventKind::Outage { unreachable_count, .. } if unreachable_count > 100
                )
        });
        assert!(has_cause, "{:?}", network.events);
        // The run began when both were there.
        assert_eq!(of(MessageFate::SupersededAtInput), 0, "{said}");
        for name in ["there/0", "back/1"] {
            let account = account(&summary, name);
            let said = describe(name, account);
            assert!(account.published_count > 9 * u64::from(HZ), "{said}");
        }
    }
}
