//! Domains: locking, isolation, identity, removal.

use std::fs;
use std::path::Path;
use std::time::Duration;

use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::time::Instant;

use super::super::{
    ChannelHolder, ChannelSettings, Domain, DomainError, OutputSettings, ShmInput, ShmOutput,
    Waiter,
};
use super::{POSE, assert_nothing_left, launch, pose, root_path, shared_memory_count};
use hil_platform::domain_address::{DomainAddress, DomainAddressError, ROOT_PATH_LENGTH_MAX};

#[test]
fn a_clean_run_leaves_nothing() {
    let (domain, holder) = launch("clean", 1);
    assert!(shared_memory_count(domain.address().prefix()) > 0);
    drop(holder);
    assert_nothing_left(domain);
}

#[test]
fn a_launcher_that_forgets_to_remove_leaves_nothing_either() {
    let (domain, holder) = launch("forget", 1);
    let address = domain.address().clone();
    drop((holder, domain));
    assert!(!address.root_path().exists());
    assert_eq!(shared_memory_count(address.prefix()), 0);
}

#[test]
fn a_living_run_locks_its_root_path() {
    let (domain, holder) = launch("lock", 1);
    let second = Domain::create(domain.address().root_path());
    let message = second.unwrap_err().to_string();
    assert!(message.contains(domain.address().root_path().to_str().unwrap()));
    assert!(message.contains("in use"), "{message}");
    drop(holder);
    let root_path = domain.address().root_path().to_owned();
    assert_nothing_left(domain);
    assert_nothing_left(Domain::create(&root_path).unwrap());
}

#[test]
fn a_pipe_in_place_of_a_domains_marker_is_not_waited_for() {
    let root_path = root_path("pipe");
    fs::create_dir_all(&root_path).unwrap();
    let marker = root_path.join("hil-domain");
    nix::unistd::mkfifo(&marker, nix::sys::stat::Mode::S_IRWXU).unwrap();
    let prefix = Domain::prefix_at(&root_path);
    fs::remove_file(&marker).unwrap();
    assert_eq!(prefix, None);
    fs::write(&marker, "h00c0ffee_").unwrap();
    assert_eq!(Domain::prefix_at(&root_path).as_deref(), Some("h00c0ffee_"));
    fs::remove_dir_all(root_path).unwrap();
}

#[test]
fn remains_of_a_dead_run_are_removed_by_the_next() {
    let root_path = root_path("stale");
    fs::create_dir_all(root_path.join("services")).unwrap();
    fs::write(root_path.join("services/half-written"), "x").unwrap();
    fs::write(root_path.join("hil-domain"), "h00c0ffee_").unwrap();
    let stale = Path::new("/dev/shm/h00c0ffee_123.data");
    fs::write(stale, "x").unwrap();
    let domain = Domain::create(&root_path).unwrap();
    assert!(!stale.exists());
    assert!(!root_path.join("services/half-written").exists());
    assert_nothing_left(domain);
}

#[test]
fn a_directory_of_somebody_else_is_not_touched() {
    let root_path = root_path("foreign");
    fs::create_dir_all(&root_path).unwrap();
    let thesis = root_path.join("thesis.tex");
    fs::write(&thesis, "x").unwrap();
    let refused = Domain::create(&root_path);
    assert!(matches!(refused, Err(DomainError::ForeignDirectory { .. })));
    assert!(thesis.exists());
    fs::remove_dir_all(&root_path).unwrap();
}

#[test]
fn a_root_path_is_checked_before_anything_is_made() {
    let refused = |path: &str| Domain::create(Path::new(path)).unwrap_err();
    assert!(matches!(
        refused("relative/path"),
        DomainError::Address(DomainAddressError::UnusableRootPath { .. })
    ));
    assert!(matches!(
        refused("/tmp/with space"),
        DomainError::Address(DomainAddressError::UnusableRootPath { .. })
    ));
    let long = format!("/tmp/{}", "x".repeat(ROOT_PATH_LENGTH_MAX));
    let message = refused(&long).to_string();
    assert!(message.contains(&long.len().to_string()), "{message}");
    assert!(message.contains(&ROOT_PATH_LENGTH_MAX.to_string()));
}

#[test]
fn the_longest_root_path_still_has_room_for_listeners() {
    let base = root_path("long").to_str().unwrap().to_owned();
    let path = format!("{base}{}", "x".repeat(ROOT_PATH_LENGTH_MAX - base.len()));
    let domain = Domain::create(Path::new(&path)).unwrap();
    let holder = ChannelHolder::create(&domain, &ChannelSettings::of("c", &POSE)).unwrap();
    drop(Waiter::open(&domain, &["c"]).unwrap());
    drop(holder);
    assert_nothing_left(domain);
}

#[test]
fn an_address_survives_its_text_and_nonsense_is_refused() {
    let address: DomainAddress = "h00c0ffee_@/run/hil/trial".parse().unwrap();
    assert_eq!(
        address.to_string().parse::<DomainAddress>().unwrap(),
        address
    );
    for text in [
        "",
        "h00c0ffee_",
        "../x_@/run",
        "hABCDEF01_@/run",
        "h00c0ffee_@run",
    ] {
        assert!(text.parse::<DomainAddress>().is_err(), "{text}");
    }
}

#[test]
fn opening_a_domain_nobody_created_names_its_path() {
    let address: DomainAddress = "h00c0ffee_@/tmp/hil-nobody".parse().unwrap();
    let message = Domain::open(&address).unwrap_err().to_string();
    assert!(message.contains("/tmp/hil-nobody"), "{message}");
    assert!(!address.root_path().exists());
}

#[test]
fn members_agree_on_the_fingerprint_and_other_runs_differ() {
    let (first, first_holder) = launch("print-a", 1);
    let (second, second_holder) = launch("print-b", 1);
    let member = Domain::open(first.address()).unwrap();
    assert_eq!(first.fingerprint().unwrap(), member.fingerprint().unwrap());
    assert_ne!(first.fingerprint().unwrap(), second.fingerprint().unwrap());
    drop((first_holder, second_holder, member));
    assert_nothing_left(first);
    assert_nothing_left(second);
}

#[test]
fn runs_side_by_side_do_not_see_each_other() {
    let runs: Vec<_> = (0..3).map(|_| launch("side", 4)).collect();
    let mut ports: Vec<_> = runs
        .iter()
        .map(|(domain, _)| {
            let input = ShmInput::open(domain, "arm/pose", &POSE, 4).unwrap();
            let settings = OutputSettings::default();
            (
                input,
                ShmOutput::open(domain, "arm/pose", &POSE, settings).unwrap(),
            )
        })
        .collect();
    for (run, (_, output)) in ports.iter_mut().enumerate() {
        output
            .send(Instant::ZERO, bytemuck::bytes_of(&pose(run as u64)))
            .unwrap();
    }
    for (run, (input, _)) in ports.iter_mut().enumerate() {
        let mut seen = Vec::new();
        let mut take = |_: &_, payload: &[u8]| {
            seen.push(bytemuck::pod_read_unaligned::<super::Pose>(payload).index);
        };
        while input.receive(Instant::ZERO, &mut take).unwrap() {}
        assert_eq!(seen, [run as u64]);
    }
    drop(ports);
    for (domain, holder) in runs {
        drop(holder);
        assert_nothing_left(domain);
    }
}

#[test]
fn removal_reports_members_that_are_still_there() {
    let (domain, holder) = launch("alive", 1);
    let member = Domain::open(domain.address()).unwrap();
    drop(holder);
    let removal = domain.remove();
    assert_eq!(removal.live_member_count, 1);
    drop(member);
}

#[test]
fn waiting_for_a_launcher_ends_at_the_deadline() {
    let (domain, holder) = launch("absent", 1);
    let member = Domain::open(domain.address())
        .unwrap()
        .with_open_within(Duration::from_millis(20));
    let error = ShmInput::open(&member, "arm/absent", &POSE, 1).unwrap_err();
    assert!(error.is_transient());
    let message = error.to_string();
    assert!(
        message.contains("arm/absent") && message.contains("does not exist"),
        "{message}"
    );
    drop((member, holder));
    assert_nothing_left(domain);
}
