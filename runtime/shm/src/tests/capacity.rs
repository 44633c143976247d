//! What a domain takes of `/dev/shm` against what it was reckoned to take.

use std::fs;
use std::os::unix::fs::MetadataExt;

use super::super::capacity::Room;
use super::super::raw::{RawInput, RawOutput};
use super::super::{ChannelHolder, ChannelSettings, Domain, Waiter};
use super::{assert_nothing_left, root_path};
use hil_core::message::TypeInfo;

const PAGE_BYTES: u64 = 4096;
const CHANNEL: &str = "arm/pose";

fn settings(
    size_bytes: usize,
    alignment_bytes: usize,
    depth_max: usize,
    assembled_max: usize,
) -> ChannelSettings {
    ChannelSettings {
        name: CHANNEL.to_owned(),
        message: TypeInfo {
            name: "test.Bytes.v1".to_owned(),
            size_bytes,
            alignment_bytes,
        },
        depth_max,
        writers_max: 2,
        readers_max: 6,
        assembled_max,
    }
}

/// The files of a domain that a channel has: lengths in whole pages, and what of them is taken.
fn files(domain: &Domain) -> Vec<(u64, u64)> {
    let entries = fs::read_dir("/dev/shm").unwrap().flatten();
    let own = entries.filter(|entry| {
        let name = entry.file_name().to_string_lossy().into_owned();
        // What a domain has once.
        name.starts_with(domain.address().prefix()) && !name.ends_with(".global_mgmt")
    });
    let sizes = own.map(|entry| entry.metadata().unwrap());
    sizes
        .map(|file| (file.len().next_multiple_of(PAGE_BYTES), file.blocks() * 512))
        .collect()
}

fn room(domain: &Domain) -> Room {
    let files = files(domain);
    Room {
        bytes: files.iter().map(|(length, _)| length).sum(),
        files: files.len() as u64,
    }
}

#[test]
fn a_channel_takes_what_it_was_reckoned_to_take_and_all_of_it_before_it_is_used() {
    for (size, alignment, depth, assembled) in [
        (1, 1, 1, 0),
        (60, 4, 8, 4),
        (60, 64, 1024, 0),
        (4096, 8, 16, 4),
        (65_536, 64, 40, 0),
        (1 << 20, 8, 1, 2),
    ] {
        let settings = settings(size, alignment, depth, assembled);
        let domain = Domain::create(&root_path("capacity")).unwrap();
        let holder = ChannelHolder::create(&domain, &settings).unwrap();
        assert_eq!(room(&domain), settings.own_room(), "{settings:?}");
        let output = RawOutput::open_assembling(&domain, CHANNEL, true, assembled).unwrap();
        let with_writer = settings.own_room().and(settings.writer_room());
        let found = room(&domain);
        let slack = Room {
            bytes: PAGE_BYTES,
            files: 0,
        };
        assert!(
            with_writer.holds(found) && found.and(slack).holds(with_writer),
            "{settings:?}: {found}"
        );
        let readers: Vec<_> = (0..2)
            .map(|_| {
                let input = RawInput::open(&domain, CHANNEL, depth).unwrap();
                (input, Waiter::open(&domain, &[CHANNEL]).unwrap())
            })
            .collect();
        let whole = with_writer.and(settings.reader_room().times(2));
        let found = room(&domain);
        let slack = slack.times(3);
        assert!(
            whole.holds(found) && found.and(slack).holds(whole),
            "{settings:?}: {found}"
        );
        for (length, taken) in files(&domain) {
            assert!(taken >= length, "{taken} of {length}");
        }
        drop((readers, output, holder));
        assert_nothing_left(domain);
    }
}

#[test]
fn a_port_that_finds_no_room_says_what_it_takes_and_what_there_is() {
    let free = Room::free().unwrap();
    let depth = usize::try_from(free.bytes / (6 * 65_536)).unwrap() + 1;
    let settings = settings(65_536, 64, depth, 0);
    let domain = Domain::create(&root_path("no-room")).unwrap();
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    let error = RawOutput::open(&domain, CHANNEL, true)
        .unwrap_err()
        .to_string();
    assert!(error.contains("/dev/shm has"), "{error}");
    assert!(error.contains("remount,size="), "{error}");
    drop(holder);
    assert_nothing_left(domain);
}
