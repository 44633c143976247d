//! Messages of megabytes through two gateway processes, beside short ones on the same link: both arrive as they
//! were sent, and one of which a piece is lost is recorded with what came of it.

use std::net::SocketAddr;
use std::thread;
use std::time::Duration;

use hil_core::message::MessageType;
use hil_core::record::{EgressRecord, IngressRecord, UNAVAILABLE};
use hil_link::condition::{LinkChangeRequest, ORDER_TYPE_NAME};
use hil_link::spec::{LinkSpec, Way};
use hil_platform::clock::MonotonicClock;
use hil_rundir::launch::{ChannelLaunch, DirectionLaunch, Side};
use hil_rundir::record::RecordFile;
use hil_shm::{ChannelHolder, ChannelSettings, Domain, OutputSettings, RawInput, ShmOutput};
use hil_tests::ports::own_addresses;
use hil_tests::run_folder::RunFolder;
use hil_tests::worker::{self, Worker};
use hil_topology::SocketOptions;
use hil_topology::emulation::EmulationLaunch;

const LIMIT: Duration = Duration::from_mins(1);
const IMAGE: MessageType = MessageType {
    name: "test.Image.v1",
    size_bytes: 4 << 20,
    alignment_bytes: 8,
    fields: &[],
};
const COMMAND: MessageType = MessageType {
    name: "test.Command.v1",
    size_bytes: 64,
    alignment_bytes: 8,
    fields: &[],
};
/// Orders to the emulated link, which nobody gives.
const ORDER: MessageType = MessageType {
    name: ORDER_TYPE_NAME,
    size_bytes: size_of::<LinkChangeRequest>(),
    alignment_bytes: align_of::<LinkChangeRequest>(),
    fields: &[],
};
/// Name, message and depth of each.
const CHANNELS: [(&str, &MessageType, usize); 2] =
    [("camera/image", &IMAGE, 4), ("arm/command", &COMMAND, 256)];
const IMAGES: u64 = 12;

fn image(number: u64) -> Vec<u8> {
    (0..IMAGE.size_bytes as u64)
        .map(|at| (at.wrapping_mul(31) ^ (at >> 12) ^ number).to_le_bytes()[0])
        .collect()
}

fn direction(side: Side, addresses: [SocketAddr; 2], spec: Option<&LinkSpec>) -> DirectionLaunch {
    let emulation = spec
        .filter(|_| side == Side::Ingress)
        .map(|spec| EmulationLaunch {
            spec: spec.clone(),
            link: "hop".to_owned(),
            way: Way::Forward,
            seed: 3,
            trace: None,
        });
    let channels = (0..)
        .zip(CHANNELS)
        .map(|(id, (name, message, depth))| ChannelLaunch {
            emulation: emulation.clone(),
            ..worker::channel(id, name, message, depth)
        });
    let mut direction = worker::direction(side, addresses, channels.collect());
    direction.socket.common = SocketOptions {
        send_buffer_bytes: 1 << 20,
        receive_buffer_bytes: 8 << 20,
        ..SocketOptions::TEMPLATE
    };
    direction
}

/// What came of a run in which an image was published every 50 ms and a command every millisecond.
struct Outcome {
    images: Vec<(u64, Vec<u8>)>,
    command_count: u64,
    sent: Vec<EgressRecord>,
    received: Vec<IngressRecord>,
}

fn play(label: &str, spec: Option<&LinkSpec>) -> Outcome {
    let folder = RunFolder::new(label);
    let domains = ["a", "b"].map(|name| Domain::create(&folder.join(name)).unwrap());
    let mut holders = Vec::new();
    for domain in &domains {
        for (name, message, depth) in CHANNELS {
            let settings = ChannelSettings {
                depth_max: depth,
                ..ChannelSettings::of(name, message)
            };
            holders.push(ChannelHolder::create(domain, &settings).unwrap());
        }
    }
    let orders = ChannelSettings {
        depth_max: 8,
        ..ChannelSettings::of("hil/link/hop/forward", &ORDER)
    };
    holders.push(ChannelHolder::create(&domains[1], &orders).unwrap());
    let addresses = own_addresses();
    let mut workers = [(0, Side::Egress), (1, Side::Ingress)].map(|(host, side)| {
        let name = format!("gateway-{host}");
        let direction = direction(side, addresses, spec);
        let path = worker::gateway(folder.path(), &name, &domains[host], direction);
        Worker::start(&path)
    });
    let output = |name: &str, message: &MessageType| {
        ShmOutput::open(&domains[0], name, message, OutputSettings::default()).unwrap()
    };
    let mut cameras = output(CHANNELS[0].0, &IMAGE);
    let mut commands = output(CHANNELS[1].0, &COMMAND);
    let mut inputs =
        CHANNELS.map(|(name, _, depth)| RawInput::open(&domains[1], name, depth).unwrap());
    for worker in &mut workers {
        worker.wait_until_ready(LIMIT);
    }
    let mut images = Vec::new();
    let mut command_count = 0;
    let mut published = 0;
    for step in 0..IMAGES * 50 + 400 {
        if step % 50 == 0 && published < IMAGES {
            cameras
                .publish(MonotonicClock::now(), &image(published))
                .unwrap();
            published += 1;
        }
        if step < IMAGES * 50 {
            commands.publish(MonotonicClock::now(), &[3; 64]).unwrap();
        }
        thread::sleep(Duration::from_millis(1));
        let [from_camera, from_arm] = &mut inputs;
        let mut take = |envelope: &hil_core::message::Envelope, payload: &[u8]| {
            images.push((envelope.sequence, payload.to_vec()));
        };
        while from_camera.receive(&mut take).unwrap() {}
        while from_arm.receive(&mut |_, _| command_count += 1).unwrap() {}
    }
    drop((cameras, commands, inputs));
    for worker in workers {
        let (code, words) = worker.end(LIMIT);
        assert_eq!(code, Some(0), "{words}");
    }
    let file = |host: u8, kind: &str| {
        let name = format!("records-gateway-{host}/camera.image.{kind}.gateway-{host}.0.rec");
        RecordFile::read(&folder.join(name)).unwrap()
    };
    let sent = file(0, "egress").records().collect();
    let received = file(1, "ingress").records().collect();
    drop(holders);
    for domain in domains {
        assert!(domain.remove().remained.is_empty());
    }
    Outcome {
        images,
        command_count,
        sent,
        received,
    }
}

#[test]
fn images_of_four_megabytes_arrive_beside_commands() {
    let outcome = play("long", None);
    let left = outcome
        .sent
        .iter()
        .filter(|one| one.flags & EgressRecord::REFUSED_BY_KERNEL == 0);
    let whole = outcome.received.iter();
    let whole = whole.filter(|one| one.forwarded_ns != UNAVAILABLE);
    let mut until_published: Vec<i64> = whole
        .map(|one| (one.forwarded_ns - one.received_ns) / 1_000)
        .collect();
    until_published.sort_unstable();
    println!(
        "{} images left, {} came, each published {until_published:?} us after its last piece; {} commands came",
        left.count(),
        outcome.images.len(),
        outcome.command_count
    );
    assert!(outcome.images.len() as u64 >= IMAGES / 2);
    for (number, bytes) in &outcome.images {
        assert!(*bytes == image(*number), "image {number}");
    }
    let pieces = u32::try_from(IMAGE.size_bytes.div_ceil(1384)).unwrap();
    assert!(
        outcome.sent.iter().all(|one| one.fragment_count == pieces),
        "{:?}",
        outcome.sent
    );
    assert!(
        outcome.command_count >= IMAGES * 50 * 9 / 10,
        "{}",
        outcome.command_count
    );
}

#[test]
fn an_image_of_which_a_piece_is_lost_is_recorded_as_incomplete() {
    // One piece of ten thousand: of 3,031 pieces one is lost in a quarter of the images.
    let outcome = play(
        "long-lossy",
        Some(&LinkSpec::fixed(Duration::from_millis(1), 1e-4)),
    );
    let incomplete: Vec<_> = outcome
        .received
        .iter()
        .filter(|one| one.flags & IngressRecord::INCOMPLETE != 0)
        .collect();
    let pieces = u32::try_from(IMAGE.size_bytes.div_ceil(1384)).unwrap();
    println!(
        "{} images whole, {} incomplete",
        outcome.images.len(),
        incomplete.len()
    );
    for one in &incomplete {
        assert!(
            (pieces - 50..pieces).contains(&one.fragment_count),
            "{one:?}"
        );
        assert!(one.handed_ns > 0 && one.published_ns > 0 && one.received_ns > 0);
        assert!(
            outcome
                .images
                .iter()
                .all(|(number, _)| *number != one.sequence)
        );
    }
    // Whatever was sent came whole, or some of it did.
    let told = outcome.images.len() + incomplete.len();
    assert_eq!(told, outcome.sent.len());
    assert!(!incomplete.is_empty() && !outcome.images.is_empty());
}
