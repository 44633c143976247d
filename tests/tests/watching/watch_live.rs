//! Looking on while a real run goes: found by its supervisor's word, followed to its last message, and
//! gone from the list when it is over.

use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

use hil_rundir::live_run::Source;
use hil_rundir::select::{running_runs, select};
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{Trial, wait_until};
use hil_watch::{Event, Feed, Origin, Poll};

const LIMIT: Duration = Duration::from_mins(1);

#[test]
fn a_run_is_found_followed_to_its_last_message_and_gone() {
    let folder = RunFolder::new("watch");
    let trial = Trial::shipped("local.toml", folder.path()).set("run.duration=\"3 s\"");
    let mut child = trial.start_here();
    let files = trial.folder("", LIMIT);
    let name = files.root().file_name().unwrap().to_str().unwrap();
    let mut found = None;
    wait_until(LIMIT, "the run's announcement", || {
        found = select(Some(name)).ok();
        found.is_some()
    });
    let run = found.unwrap();
    assert_eq!(select(files.root().to_str()).unwrap().name, name);
    assert!(run.processes.contains(&"controller".to_owned()), "{run:?}");
    // Everything is recorded here, so nothing is read from shared memory.
    assert!(
        run.channels
            .iter()
            .all(|one| one.source == Source::Records {})
    );
    let mut feed = Feed::open(run).unwrap();
    let (mut counts, mut ended) = (BTreeMap::<String, u64>::new(), None);
    loop {
        let polled = feed.poll(&mut |event| match event {
            Event::Message {
                channel, origin, ..
            } => {
                assert_eq!(origin, Origin::Records);
                *counts.entry(channel.description.name.clone()).or_default() += 1;
            }
            Event::Problem(text) => panic!("{text}"),
            Event::Ended { has_summary } => ended = Some(has_summary),
            Event::Record { .. } | Event::Silent => {}
        });
        match polled {
            Poll::Over => break,
            Poll::Busy => {}
            Poll::Idle => thread::sleep(Duration::from_millis(20)),
        }
    }
    assert_eq!(ended, Some(true));
    child.wait_within(LIMIT).unwrap().assert_success();
    files.assert_nothing_left_here();
    assert!(!files.root().join("live.json").exists());
    assert!(running_runs().iter().all(|run| run.name != name));
    for channel in &files.summary().channels {
        let account = channel
            .account
            .as_ref()
            .map(|account| account.published_count);
        let recorded = channel.recorded.map(|figures| figures.message_count);
        let expected = account.or(recorded).unwrap_or(0);
        let found = counts.get(&channel.name).copied().unwrap_or(0);
        assert_eq!(found, expected, "{}", channel.name);
    }
}
