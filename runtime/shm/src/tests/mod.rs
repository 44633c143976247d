//! Tests of the channels as a whole: real shared memory, several members, killed processes.

mod capacity;
mod domain;
mod exchange;
mod kill;
mod upgrade;

use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};

use hil_core::message::MessageType;

use super::{ChannelHolder, ChannelSettings, Domain};

hil_core::message! {
    /// Carried by most tests.
    pub(crate) struct Pose = "test.Pose.v1" {
        pub(crate) position_m: [f64; 3],
        pub(crate) index: u64,
    }
}

pub(crate) const POSE: MessageType = MessageType::of::<Pose>();

pub(crate) fn pose(index: u64) -> Pose {
    Pose {
        position_m: [0.5, -1.0, index as f64],
        index,
    }
}

/// A root path no other test uses.
pub(crate) fn root_path(label: &str) -> PathBuf {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    std::env::temp_dir().join(format!("hil-{label}-{}-{count}", std::process::id()))
}

/// A domain with the channel `arm/pose`, `depth_max` deep.
pub(crate) fn launch(label: &str, depth_max: usize) -> (Domain, ChannelHolder) {
    let domain = Domain::create(&root_path(label)).unwrap();
    let settings = ChannelSettings {
        depth_max,
        writers_max: 2,
        ..ChannelSettings::of("arm/pose", &POSE)
    };
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    (domain, holder)
}

/// Nothing of the run is left, neither below its root path nor in `/dev/shm`.
pub(crate) fn assert_nothing_left(domain: Domain) {
    let address = domain.address().clone();
    let removal = domain.remove();
    assert_eq!(removal.remained, Vec::<PathBuf>::new());
    assert!(!address.root_path().exists());
    assert_eq!(shared_memory_count(address.prefix()), 0);
}

pub(crate) fn shared_memory_count(prefix: &str) -> usize {
    fs::read_dir("/dev/shm")
        .unwrap()
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().contains(prefix))
        .count()
}
