//! Processes killed at random moments, start-up included: the channel must stay usable, and the
//! run must leave nothing. The children are this test binary itself.

use std::path::Path;
use std::process::{self, Child, Command, Stdio};
use std::time::{Duration, Instant};
use std::{env, fs, thread};

use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::random::RandomStream;

use super::super::{
    ChannelHolder, ChannelSettings, Domain, OutputSettings, ShmInput, ShmOutput, Waiter,
};
use super::{POSE, assert_nothing_left, pose, root_path, shared_memory_count};
use hil_platform::clock::MonotonicClock;

const ROLE: &str = "HIL_TEST_KILL_ROLE";
const ADDRESS: &str = "HIL_TEST_KILL_ADDRESS";

/// Not a test of its own: what a child runs until it is killed.
#[test]
#[ignore = "entry point of the children of the kill tests"]
fn child() {
    let (Ok(role), Ok(address)) = (env::var(ROLE), env::var(ADDRESS)) else {
        return;
    };
    if role == "launcher" {
        let domain = Domain::create(Path::new(&address)).unwrap();
        let settings = ChannelSettings::of("arm/pose", &POSE);
        let _holder = ChannelHolder::create(&domain, &settings).unwrap();
        loop {
            thread::park();
        }
    }
    let domain = Domain::open(&address.parse().unwrap()).unwrap();
    if role == "writer" {
        let settings = OutputSettings {
            epoch: process::id(),
            ..OutputSettings::default()
        };
        let mut output = ShmOutput::open(&domain, "arm/pose", &POSE, settings).unwrap();
        for index in 0_u64.. {
            let payload = pose(index);
            output
                .send(MonotonicClock::now(), bytemuck::bytes_of(&payload))
                .unwrap();
        }
    }
    let mut input = ShmInput::open(&domain, "arm/pose", &POSE, 1).unwrap();
    let mut waiter = Waiter::open(&domain, &["arm/pose"]).unwrap();
    loop {
        while input
            .receive(MonotonicClock::now(), &mut |_, _| {})
            .unwrap()
        {}
        waiter.wait(Duration::from_millis(1)).unwrap();
    }
}

fn spawn(role: &str, address: &str) -> Child {
    let (_, module) = module_path!().split_once("::").unwrap();
    // Not `current_exe`: a rebuild may have replaced the file since this process started.
    Command::new("/proc/self/exe")
        .args(["--exact", "--ignored", &format!("{module}::child")])
        .env(ROLE, role)
        .env(ADDRESS, address)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

/// A fresh member can take every slot the dead had, and the reader that was there all along
/// hears it.
fn assert_usable(domain: &Domain, witness: &mut ShmInput, seed: u64) {
    let member = Domain::open(domain.address()).unwrap();
    let settings = OutputSettings {
        epoch: 1_000,
        ..OutputSettings::default()
    };
    let mut output = ShmOutput::open(&member, "arm/pose", &POSE, settings)
        .unwrap_or_else(|error| panic!("seed {seed}: {error}"));
    let mut input = ShmInput::open(&member, "arm/pose", &POSE, 1)
        .unwrap_or_else(|error| panic!("seed {seed}: {error}"));
    drop(
        Waiter::open(&member, &["arm/pose"]).unwrap_or_else(|error| panic!("seed {seed}: {error}")),
    );
    let mut last = [None; 2];
    for index in 0..3 {
        output
            .send(MonotonicClock::now(), bytemuck::bytes_of(&pose(index)))
            .unwrap();
        for (reader, last) in [&mut *witness, &mut input].into_iter().zip(&mut last) {
            let mut take = |_: &_, payload: &[u8]| {
                *last = Some(bytemuck::pod_read_unaligned::<super::Pose>(payload).index);
            };
            while reader.receive(MonotonicClock::now(), &mut take).unwrap() {}
        }
        assert_eq!(last, [Some(index); 2], "seed {seed}");
    }
}

#[test]
fn a_file_whose_maker_was_killed_before_it_had_a_length_holds_nothing_up() {
    let domain = Domain::create(&root_path("lengthless")).unwrap();
    let name = format!("{}_0_1.connection", domain.address().prefix());
    let file = Path::new("/dev/shm").join(name);
    fs::write(&file, []).unwrap();
    assert!(domain.cleanup_dead_nodes().is_postponed);
    assert!(file.exists());
    assert!(!domain.cleanup_dead_nodes_now().is_postponed);
    assert!(!file.exists());
    assert_nothing_left(domain);
}

fn kill_at_random_moments(seed: u64) {
    const KILLS: usize = 4;
    // About three times what a start-up takes on an idle machine, so that most kills fall into it
    // and some into the work after.
    const LIFETIME_S: f64 = 0.03;
    let mut random = RandomStream::new(seed, "kill moments");
    let domain = Domain::create(&root_path("kill")).unwrap();
    let settings = ChannelSettings {
        // As tight as it gets: the witness, and whoever is started.
        readers_max: 2,
        ..ChannelSettings::of("arm/pose", &POSE)
    };
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    let mut witness = ShmInput::open(&domain, "arm/pose", &POSE, 1).unwrap();
    for _ in 0..KILLS {
        let address = domain.address().to_string();
        let mut children = [spawn("writer", &address), spawn("reader", &address)];
        let lifetime = Duration::from_secs_f64(LIFETIME_S * random.uniform());
        let started = Instant::now();
        while started.elapsed() < lifetime {
            witness
                .receive(MonotonicClock::now(), &mut |_, _| {})
                .unwrap();
            thread::sleep(Duration::from_micros(200));
        }
        for child in &mut children {
            child.kill().unwrap();
        }
        for child in &mut children {
            child.wait().unwrap();
        }
        domain.cleanup_dead_nodes_now();
        while witness
            .receive(MonotonicClock::now(), &mut |_, _| {})
            .unwrap()
        {}
    }
    assert_usable(&domain, &mut witness, seed);
    drop((witness, holder));
    assert_nothing_left(domain);
}

#[test]
fn killing_writers_and_readers_at_any_moment_leaves_the_channel_usable() {
    for seed in 0..24 {
        kill_at_random_moments(seed);
    }
}

#[test]
fn a_launcher_killed_at_any_moment_is_cleaned_up_by_the_next_run() {
    let root_path = root_path("relaunch");
    let mut random = RandomStream::new(0, "launcher kill moments");
    let mut prefixes = Vec::new();
    for _ in 0..12 {
        let mut launcher = spawn("launcher", root_path.to_str().unwrap());
        thread::sleep(Duration::from_secs_f64(0.016 * random.uniform()));
        launcher.kill().unwrap();
        launcher.wait().unwrap();
        prefixes.extend(fs::read_to_string(root_path.join("hil-domain")));
    }
    let next = Domain::create(&root_path).unwrap();
    drop(ChannelHolder::create(&next, &ChannelSettings::of("arm/pose", &POSE)).unwrap());
    assert_nothing_left(next);
    for prefix in prefixes.iter().filter(|prefix| !prefix.is_empty()) {
        assert_eq!(shared_memory_count(prefix), 0);
    }
}
