//! The live page on one host of a split run, in a browser: what it says of the other host.

use std::thread;
use std::time::Duration;

use hil_tests::browser::Browser;
use hil_tests::lab::Lab;
use hil_tests::run_folder::RunFolder;
use hil_tests::shown::{DESKTOP, serve};
use hil_tests::split::HOSTS;
use hil_tests::trial::Trial;
use nix::sys::signal::{Signal, kill};

const LIMIT: Duration = Duration::from_mins(2);

/// True when the head of the page says what matches.
fn says(pattern: &str) -> String {
    format!("/{pattern}/.test(document.getElementById('warnings').innerText)")
}

#[test]
fn the_other_hosts_overruns_are_on_the_page_or_said_to_be_unavailable() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let Some(mut browser) = Browser::start_on_or_skip(lab.host(0)) else {
        return;
    };
    let folder = RunFolder::new("page-split");
    let trial = Trial::shipped("shuttle-split.toml", folder.path())
        .set("run.duration=\"10 min\"")
        .set("run.peer_timeout=\"60 s\"");
    let mut run = [0, 1].map(|index| trial.start_on(lab.host(index)));
    let files = HOSTS.map(|host| trial.folder(&format!("-{host}"), LIMIT));
    let ports = ["--port", "0", "--http-port", "0"];
    let (mut recorder, address) = serve(files[0].root(), lab.host(0), &ports);
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&address);
    page.wait_until("document.getElementById('run-state').textContent === 'running'");
    page.wait_until(
        "(window.hil.snapshot().run.overrun_hosts ?? []) \
         .some((host) => host.host === 'robot-pc' && host.is_heard)",
    );
    page.wait_until(&format!("!{}", says("robot-pc: ticks skipped unavailable")));

    // Its ticks pass without it, as on a host that has no time for it.
    let robot = files[1].process("robot", 0).unwrap();
    kill(robot, Signal::SIGSTOP).unwrap();
    thread::sleep(Duration::from_millis(500));
    kill(robot, Signal::SIGCONT).unwrap();
    page.wait_until(&says(
        "host robot-pc overran, ticks skipped so far: robot [1-9]",
    ));

    // A host that says nothing may have skipped any number by now.
    run[1].signal(Signal::SIGSTOP).unwrap();
    page.wait_until(&says(
        "host robot-pc: ticks skipped unavailable, not heard for [0-9]+ s; last told: robot [1-9]",
    ));
    run[1].signal(Signal::SIGCONT).unwrap();
    page.wait_until(&says(
        "host robot-pc overran, ticks skipped so far: robot [1-9]",
    ));

    recorder.signal(Signal::SIGINT).unwrap();
    recorder.wait_within(LIMIT).unwrap();
    run[0].signal(Signal::SIGINT).unwrap();
    for (index, host) in run.iter_mut().enumerate() {
        host.wait_within(LIMIT).unwrap();
        files[index].assert_nothing_left_on(lab.host(index));
    }
}
