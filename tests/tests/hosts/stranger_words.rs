//! What a stranger can say to the supervisors and gateways of a sealed run in a host's place, and what it costs.

use std::io::Write;
use std::net::TcpListener;
use std::thread;
use std::time::Duration;

use hil_tests::account::assert_accounts_close;
use hil_tests::knocker::CONTROL_PORT;
use hil_tests::lab::{ADDRESSES, Lab};
use hil_tests::run_folder::RunFolder;
use hil_tests::split::Split;
use hil_tests::trial::Trial;

const LIMIT: Duration = Duration::from_mins(1);
/// No other file of tests uses these ports.
const PORT: u16 = 7860;
/// A refusal as the listening end of a handshake words it: nine bytes that anybody can send.
const REFUSAL: [u8; 9] = [b'H', b'I', b'L', b'K', 1, 3, 1, 0, 1];
/// Connections that the stranger at the first host's address answers with it.
const REFUSED_COUNT: usize = 5;

#[test]
fn made_up_refusals_at_a_hosts_address_end_no_waiting_and_are_told() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let record = RunFolder::new("refused");
    let trial = Trial::shipped("shuttle-split.toml", record.path())
        .set(&format!("links.hop.port={PORT}"))
        .set("run.duration=\"3 s\"");
    let (mut joining, listener) = lab.host(0).on_network(|| {
        let listener = TcpListener::bind((ADDRESSES[0], CONTROL_PORT)).unwrap();
        (trial.start_on(lab.host(1)), listener)
    });
    for _ in 0..REFUSED_COUNT {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(&REFUSAL).unwrap();
    }
    drop(listener);
    // Longer than it takes to end: before, it ended within a tenth of this.
    thread::sleep(Duration::from_millis(700));
    assert!(joining.is_running(), "{}", joining.stderr_so_far());
    joining.wait_for_output("came to nothing", LIMIT).unwrap();
    let split = Split::of(&lab, &trial, [trial.start_on(lab.host(0)), joining]);
    let summaries = split.finish();
    let security = summaries[1].run.security.as_ref().unwrap().to_string();
    println!("{security}");
    let told = format!("{REFUSED_COUNT} to control-pc (10.77.0.1) which answered without proof");
    assert!(security.contains(&told), "{security}");
    for summary in &summaries {
        assert_accounts_close(summary);
    }
}
