//! Samples through a channel: order, overflow, types, late joiners, wake-ups.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, Ordering};
use std::thread;
use std::time::Duration;

use hil_core::endpoint::{InputPort, OutputPort};
use hil_core::message::{ETHERNET_FRAME, Envelope, MessageType};
use hil_core::time::Instant;
use hil_shuttle::ShuttleStatus;

use super::super::{
    ChannelError, ChannelHolder, ChannelSettings, Domain, OutputSettings, RawInput, RawOutput,
    ShmInput, ShmOutput, TypedInput, TypedOutput, Waiter, Wake,
};
use super::{POSE, Pose, assert_nothing_left, launch, pose, root_path};
use hil_platform::clock::MonotonicClock;

fn output(domain: &Domain, epoch: u32) -> ShmOutput {
    let settings = OutputSettings {
        epoch,
        ..OutputSettings::default()
    };
    ShmOutput::open(domain, "arm/pose", &POSE, settings).unwrap()
}

fn send(
    output: &mut impl OutputPort<Error = ChannelError>,
    indices: impl IntoIterator<Item = u64>,
) {
    for index in indices {
        output
            .send(MonotonicClock::now(), bytemuck::bytes_of(&pose(index)))
            .unwrap();
    }
}

fn drain(input: &mut impl InputPort<Error = ChannelError>) -> Vec<(Envelope, Pose)> {
    let mut seen = Vec::new();
    let mut take = |envelope: &Envelope, payload: &[u8]| {
        seen.push((*envelope, bytemuck::pod_read_unaligned(payload)));
    };
    while input.receive(MonotonicClock::now(), &mut take).unwrap() {}
    seen
}

fn indices(seen: &[(Envelope, Pose)]) -> Vec<u64> {
    seen.iter().map(|(_, pose)| pose.index).collect()
}

/// What every pair of ports owes: order, content, sequence numbers from 0, refusal of a wrong
/// size, and nothing when nothing was sent. `capacity` messages may wait.
fn conforms<O, I>(output: &mut O, input: &mut I, capacity: u64)
where
    O: OutputPort<Error = ChannelError>,
    I: InputPort<Error = ChannelError>,
{
    assert!(drain(input).is_empty());
    assert_eq!(input.next_arrival(), None);
    for round in 0..10 {
        let sent: Vec<_> = (round * capacity..(round + 1) * capacity).collect();
        send(output, sent.clone());
        let seen = drain(input);
        assert_eq!(indices(&seen), sent);
        for (envelope, seen) in seen {
            assert_eq!(envelope.sequence, seen.index);
            assert_eq!(seen, pose(seen.index));
            assert!(!envelope.is_forwarded());
        }
    }
    assert!(output.send(Instant::ZERO, &[0; 3]).is_err());
    assert!(drain(input).is_empty());
    send(output, [10 * capacity]);
    assert_eq!(drain(input)[0].0.sequence, 10 * capacity);
}

#[test]
fn ports_conform() {
    let (domain, holder) = launch("conform", 8);
    let mut input = ShmInput::open(&domain, "arm/pose", &POSE, 8).unwrap();
    let mut output = output(&domain, 1);
    conforms(&mut output, &mut input, 8);
    assert_eq!(input.counters().missed_count, 0);
    drop((input, output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_slow_reader_gets_the_newest_and_counts_the_rest() {
    let (domain, holder) = launch("latest", 4);
    let mut newest = ShmInput::open(&domain, "arm/pose", &POSE, 1).unwrap();
    let mut deep = ShmInput::open(&domain, "arm/pose", &POSE, 4).unwrap();
    let mut output = output(&domain, 1);
    send(&mut output, 0..1);
    drain(&mut newest);
    drain(&mut deep);
    send(&mut output, 1..11);
    assert_eq!(indices(&drain(&mut newest)), [10]);
    assert_eq!(indices(&drain(&mut deep)), [7, 8, 9, 10]);
    assert_eq!(newest.counters().missed_count, 9);
    assert_eq!(deep.counters().missed_count, 6);
    drop((newest, deep, output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_late_joiner_sees_what_is_sent_from_then_on() {
    let (domain, holder) = launch("late", 4);
    let mut output = output(&domain, 1);
    send(&mut output, 0..5);
    let mut input = ShmInput::open(&domain, "arm/pose", &POSE, 4).unwrap();
    assert!(drain(&mut input).is_empty());
    send(&mut output, 5..7);
    assert_eq!(indices(&drain(&mut input)), [5, 6]);
    assert_eq!(input.counters().missed_count, 0);
    drop((input, output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_restarted_writer_is_a_restart_and_not_a_loss() {
    let (domain, holder) = launch("restart", 4);
    let mut input = ShmInput::open(&domain, "arm/pose", &POSE, 4).unwrap();
    let mut first = output(&domain, 1);
    send(&mut first, 0..1);
    assert_eq!(indices(&drain(&mut input)), [0]);
    // What waits in the buffer of a reader that knew the writer survives the writer.
    send(&mut first, 1..3);
    drop(first);
    let mut second = output(&domain, 2);
    assert_eq!(indices(&drain(&mut input)), [1, 2]);
    send(&mut second, 0..2);
    assert_eq!(indices(&drain(&mut input)), [0, 1]);
    let counters = input.counters();
    assert_eq!((counters.restart_count, counters.missed_count), (1, 0));
    drop((input, second, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_typed_sample_crosses_two_untyped_ports_into_another_domain_and_back_to_its_type() {
    let (near, near_holder) = launch("near", 4);
    let (far, far_holder) = launch("far", 4);
    let mut gateway_in =
        RawInput::open(&Domain::open(near.address()).unwrap(), "arm/pose", 4).unwrap();
    let mut gateway_out = RawOutput::open(&far, "arm/pose", true).unwrap();
    let far_member = Domain::open(far.address()).unwrap();
    let mut typed_in = TypedInput::<Pose>::open(&far_member, "arm/pose", 4).unwrap();
    let mut role_in = ShmInput::open(&far_member, "arm/pose", &POSE, 4).unwrap();
    let mut echo_in = RawInput::open(&far, "arm/pose", 4).unwrap();
    let settings = OutputSettings {
        epoch: 7,
        stamp: None,
        notifies_readers: true,
    };
    let mut typed_out = TypedOutput::<Pose>::open(&near, "arm/pose", settings).unwrap();
    assert_eq!(gateway_in.message().name, "test.Pose.v1");
    assert_eq!(gateway_in.message(), gateway_out.message());

    for index in 0..3 {
        typed_out
            .send(Instant::from_ns(100 + index), pose(index.unsigned_abs()))
            .unwrap();
    }
    let mut carry = |envelope: &Envelope, payload: &[u8]| {
        let forwarded = Envelope {
            forwarded_ns: 9,
            flags: Envelope::FORWARDED,
            ..*envelope
        };
        gateway_out.publish(&forwarded, payload).unwrap();
    };
    while gateway_in.receive(&mut carry).unwrap() {}

    for index in 0..3 {
        let (envelope, seen) = typed_in.receive().unwrap().unwrap();
        assert_eq!(seen, pose(index));
        assert_eq!((envelope.sequence, envelope.epoch), (index, 7));
        assert_eq!(envelope.published_ns, 100 + i64::try_from(index).unwrap());
        assert!(envelope.is_forwarded());
    }
    assert!(typed_in.receive().unwrap().is_none());
    assert_eq!(indices(&drain(&mut role_in)), [0, 1, 2]);
    // What a gateway published says so, whoever hears it.
    let mut is_forwarded = |envelope: &Envelope, _: &[u8]| assert!(envelope.is_forwarded());
    assert!(echo_in.receive(&mut is_forwarded).unwrap());
    drop((gateway_in, typed_out, near_holder));
    drop((
        gateway_out,
        typed_in,
        role_in,
        echo_in,
        far_member,
        far_holder,
    ));
    assert_nothing_left(near);
    assert_nothing_left(far);
}

#[test]
fn another_type_is_refused_and_both_are_named() {
    let (domain, holder) = launch("types", 1);
    let status = MessageType::of::<ShuttleStatus>();
    let messages = [
        ShmInput::open(&domain, "arm/pose", &status, 1).unwrap_err(),
        ShmOutput::open(&domain, "arm/pose", &status, OutputSettings::default()).unwrap_err(),
        TypedInput::<ShuttleStatus>::open(&domain, "arm/pose", 1).unwrap_err(),
    ];
    for error in messages {
        assert!(matches!(error, ChannelError::WrongType { .. }));
        let message = error.to_string();
        for part in [
            "arm/pose",
            "test.Pose.v1",
            "32",
            "hil.ShuttleStatus.v1",
            "8 bytes",
        ] {
            assert!(message.contains(part), "{message} lacks {part}");
        }
    }
    drop(holder);
    assert_nothing_left(domain);
}

#[test]
fn the_same_name_with_another_size_is_refused() {
    let (domain, holder) = launch("size", 1);
    let grown = MessageType {
        size_bytes: POSE.size_bytes + 8,
        ..POSE
    };
    let error = ShmInput::open(&domain, "arm/pose", &grown, 1).unwrap_err();
    assert!(error.to_string().contains("40 bytes"), "{error}");
    drop(holder);
    assert_nothing_left(domain);
}

#[test]
fn a_foreign_user_header_is_refused_by_name() {
    let (domain, holder) = launch("header", 1);
    let foreign = domain.with_node(|node| {
        let name = "foreign".try_into().unwrap();
        let builder = node.service_builder(&name).publish_subscribe::<u64>();
        builder.user_header::<u32>().create().unwrap()
    });
    let error = RawInput::open(&domain, "foreign", 1).unwrap_err();
    assert!(matches!(error, ChannelError::ForeignHeader { .. }));
    let message = error.to_string();
    assert!(
        message.contains("u32") && message.contains("hil.Envelope.v1"),
        "{message}"
    );
    assert!(RawOutput::open(&domain, "foreign", false).is_err());
    drop((foreign, holder));
    assert_nothing_left(domain);
}

#[test]
fn the_stamp_is_read_at_publication() {
    static CLOCK_NS: AtomicI64 = AtomicI64::new(5_000);
    let (domain, holder) = launch("stamp", 1);
    let mut input = ShmInput::open(&domain, "arm/pose", &POSE, 1).unwrap();
    let settings = OutputSettings {
        stamp: Some(|| Instant::from_ns(CLOCK_NS.fetch_add(1, Ordering::Relaxed))),
        ..OutputSettings::default()
    };
    let mut output = ShmOutput::open(&domain, "arm/pose", &POSE, settings).unwrap();
    output
        .send(Instant::from_ns(1), bytemuck::bytes_of(&pose(0)))
        .unwrap();
    assert_eq!(drain(&mut input)[0].0.published_ns, 5_000);
    drop((input, output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_second_writer_beyond_the_limit_is_refused_in_words() {
    let domain = Domain::create(&root_path("writers")).unwrap();
    let holder = ChannelHolder::create(&domain, &ChannelSettings::of("arm/pose", &POSE)).unwrap();
    let first = output(&domain, 1);
    let member = Domain::open(domain.address())
        .unwrap()
        .with_open_within(Duration::ZERO);
    let second = ShmOutput::open(&member, "arm/pose", &POSE, OutputSettings::default());
    let message = second.unwrap_err().to_string();
    assert!(
        message.contains("become a writer") && message.contains("second instance"),
        "{message}"
    );
    drop((first, member, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_waiter_wakes_on_either_channel_and_drains() {
    let (domain, holder) = launch("wake", 1);
    let other = ChannelHolder::create(&domain, &ChannelSettings::of("arm/other", &POSE)).unwrap();
    let mut waiter = Waiter::open(&domain, &["arm/pose", "arm/other"]).unwrap();
    assert_eq!(waiter.wait(Duration::ZERO).unwrap(), Wake::TimedOut);
    for channel in ["arm/other", "arm/pose"] {
        let mut output =
            ShmOutput::open(&domain, channel, &POSE, OutputSettings::default()).unwrap();
        send(&mut output, 0..1000);
        assert_eq!(waiter.wait_until(None).unwrap(), Wake::Woken, "{channel}");
        assert_eq!(
            waiter.wait(Duration::ZERO).unwrap(),
            Wake::TimedOut,
            "{channel}"
        );
    }
    let past = Instant::from_ns(MonotonicClock::now().as_ns() - 1);
    assert_eq!(waiter.wait_until(Some(past)).unwrap(), Wake::TimedOut);
    assert!(!waiter.drain(0).unwrap() && !waiter.drain(1).unwrap());
    drop((waiter, other, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_sleeping_reader_is_woken_by_a_sample_that_is_already_there() {
    let (domain, holder) = launch("sleep", 1);
    let address = domain.address().clone();
    let reader = thread::spawn(move || {
        let member = Domain::open(&address).unwrap();
        let mut input = ShmInput::open(&member, "arm/pose", &POSE, 1).unwrap();
        let mut waiter = Waiter::open(&member, &["arm/pose"]).unwrap();
        let mut seen = Vec::new();
        while seen.last() != Some(&200) {
            while waiter.wait_until(None).unwrap() != Wake::Woken {}
            seen.extend(indices(&drain(&mut input)));
        }
        seen
    });
    let mut output = output(&domain, 1);
    for index in 0.. {
        send(&mut output, [index.min(200)]);
        if reader.is_finished() {
            break;
        }
        thread::yield_now();
    }
    let seen = reader.join().unwrap();
    assert!(seen.is_sorted() && seen.ends_with(&[200]));
    drop((output, holder));
    assert_nothing_left(domain);
}

#[test]
fn no_announcement_means_no_wake() {
    let (domain, holder) = launch("quiet", 1);
    let mut waiter = Waiter::open(&domain, &["arm/pose"]).unwrap();
    let settings = OutputSettings {
        notifies_readers: false,
        ..OutputSettings::default()
    };
    let mut output = ShmOutput::open(&domain, "arm/pose", &POSE, settings).unwrap();
    send(&mut output, 0..3);
    assert_eq!(waiter.wait(Duration::ZERO).unwrap(), Wake::TimedOut);
    drop((waiter, output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_waiter_of_many_channels_says_which_are_announced() {
    const COUNT: usize = 70;
    let (domain, holder) = launch("many", 1);
    let names: Vec<String> = (0..COUNT).map(|index| format!("arm/{index}")).collect();
    let holders: Vec<_> = names
        .iter()
        .map(|name| ChannelHolder::create(&domain, &ChannelSettings::of(name, &POSE)).unwrap())
        .collect();
    assert!(matches!(
        Waiter::open(&domain, &[]),
        Err(ChannelError::NoChannel)
    ));
    let listed: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut waiter = Waiter::open(&domain, &listed).unwrap();
    let mut outputs: Vec<_> = names
        .iter()
        .map(|name| {
            let settings = OutputSettings::default();
            TypedOutput::<Pose>::open(&domain, name, settings).unwrap()
        })
        .collect();
    assert_eq!(waiter.wait(Duration::ZERO).unwrap(), Wake::TimedOut);
    let announced = |waiter: &Waiter| waiter.announced().unwrap().collect::<Vec<_>>();
    for index in [3, 69] {
        let now = MonotonicClock::now();
        outputs[index].send(now, pose(0)).unwrap();
    }
    let mut found = announced(&waiter);
    found.sort_unstable();
    assert_eq!(found, [3, 69]);
    assert!(waiter.drain(3).unwrap());
    assert_eq!(announced(&waiter), [69]);
    assert_eq!(waiter.wait(Duration::ZERO).unwrap(), Wake::Woken);
    assert_eq!(announced(&waiter), Vec::<usize>::new());
    // All of them at once are found by looking again.
    for output in &mut outputs {
        output.send(MonotonicClock::now(), pose(0)).unwrap();
    }
    let mut seen = [false; COUNT];
    while seen.contains(&false) {
        let found = announced(&waiter);
        assert!(!found.is_empty());
        for index in found {
            assert!(waiter.drain(index).unwrap() && !seen[index]);
            seen[index] = true;
        }
    }
    drop((waiter, outputs, holders, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_writer_whose_memory_cannot_be_mapped_is_counted() {
    let (domain, holder) = launch("unmapped", 1);
    let mut output = output(&domain, 1);
    let prefix = domain.address().prefix();
    for file in std::fs::read_dir("/dev/shm").unwrap().flatten() {
        let name = file.file_name().into_string().unwrap();
        if name.starts_with(prefix) && name.trim_end_matches(".data") != name {
            std::fs::remove_file(file.path()).unwrap();
        }
    }
    let mut input = ShmInput::open(&domain, "arm/pose", &POSE, 1).unwrap();
    send(&mut output, 0..1);
    assert!(drain(&mut input).is_empty());
    assert!(input.counters().connection_failure_count > 0);
    drop((input, output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_frame_is_read_as_long_as_it_was_written() {
    let domain = Domain::create(&root_path("frames")).unwrap();
    let settings = ChannelSettings {
        depth_max: 8,
        ..ChannelSettings::of("a/b", &ETHERNET_FRAME)
    };
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    let mut input = ShmInput::open(&domain, "a/b", &ETHERNET_FRAME, 8).unwrap();
    let mut output =
        ShmOutput::open(&domain, "a/b", &ETHERNET_FRAME, OutputSettings::default()).unwrap();
    for length in [1522, 14, 1522, 1000] {
        output.publish(Instant::ZERO, &vec![7; length]).unwrap();
        let read = input.take(|_, frame| (frame.len(), frame.iter().all(|byte| *byte == 7)));
        assert_eq!(read.unwrap(), Some((length, true)));
    }
    for length in [0, 1523] {
        let refused = output.publish(Instant::ZERO, &vec![7; length]);
        assert!(
            matches!(refused, Err(ChannelError::WrongSize { .. })),
            "{length}"
        );
    }
    drop((input, output, holder));
    assert_nothing_left(domain);
}

/// A channel of frames, and its writer, which puts two at a time together from pieces.
fn assembling(label: &str, depth_max: usize) -> (Domain, ChannelHolder, RawOutput) {
    let domain = Domain::create(&root_path(label)).unwrap();
    let settings = ChannelSettings {
        depth_max,
        readers_max: 1,
        ..ChannelSettings::of("a/b", &ETHERNET_FRAME)
    };
    let holder = ChannelHolder::create(&domain, &settings).unwrap();
    let output = RawOutput::open_assembling(&domain, "a/b", false, 2).unwrap();
    (domain, holder, output)
}

fn numbered(sequence: u64) -> impl FnOnce() -> Envelope {
    move || Envelope {
        sequence,
        ..Envelope::default()
    }
}

#[test]
fn a_message_in_pieces_is_published_when_every_byte_was_written_once() {
    let (domain, holder, mut output) = assembling("pieces", 8);
    let reader = Domain::open(domain.address()).unwrap();
    let mut input = RawInput::open(&reader, "a/b", 8).unwrap();
    let mut read = || {
        let mut all = Vec::new();
        let mut take = |envelope: &Envelope, payload: &[u8]| {
            all.push((envelope.sequence, payload.to_vec()));
        };
        while input.receive(&mut take).unwrap() {}
        all
    };
    let written = |output: &mut RawOutput, slot, length| {
        let published = output.publish_pieces(slot, length, || panic!("is not asked"));
        match published.unwrap_err() {
            ChannelError::Incomplete { written, .. } => written,
            other => panic!("{other}"),
        }
    };
    assert_eq!(written(&mut output, 0, 1_522), 0);
    assert_eq!(written(&mut output, 2, 1_522), 0);
    // Two messages at a time, and a third which comes whole in between.
    output.write_piece(0, 1_000, &[1; 522]).unwrap();
    output.write_piece(1, 0, &[2; 60]).unwrap();
    assert_eq!(written(&mut output, 0, 1_522), 522);
    output.publish_with(&[3; 14], numbered(3)).unwrap();
    output.write_piece(0, 0, &[1; 1_000]).unwrap();
    output.publish_pieces(0, 1_522, numbered(1)).unwrap();
    output.publish_pieces(1, 60, numbered(2)).unwrap();
    let expected = [(3, vec![3; 14]), (1, vec![1; 1_522]), (2, vec![2; 60])];
    assert_eq!(read(), expected);
    // What was begun and given up counts for nothing.
    output.write_piece(1, 0, &[9; 1_000]).unwrap();
    output.discard_pieces(1);
    output.write_piece(1, 0, &[4; 522]).unwrap();
    assert_eq!(written(&mut output, 1, 1_522), 522);
    output.write_piece(1, 522, &[4; 1_000]).unwrap();
    output.publish_pieces(1, 1_522, numbered(4)).unwrap();
    assert_eq!(read(), [(4, vec![4; 1_522])]);
    drop((output, holder));
    drop(reader);
    assert_nothing_left(domain);
}

#[test]
fn a_piece_that_has_no_place_is_an_error_and_writes_nothing() {
    let (domain, holder, mut output) = assembling("no-place", 1);
    for (offset, length) in [(0, 1_523), (1_522, 1), (1_523, 0), (usize::MAX, 1)] {
        let refused = output.write_piece(0, offset, &vec![7; length]);
        assert!(
            matches!(refused, Err(ChannelError::WrongSize { .. })),
            "{offset} {length}"
        );
    }
    let refused = output.write_piece(2, 0, &[7]).unwrap_err().to_string();
    assert_eq!(refused, "channel a/b: cannot get memory: exceeds max loans");
    output.write_piece(0, 1_522, &[]).unwrap();
    let refused = output.publish_pieces(0, 1_523, Envelope::default);
    assert!(matches!(refused, Err(ChannelError::WrongSize { .. })));
    let refused = output.publish_pieces(0, 60, Envelope::default);
    let told = refused.unwrap_err().to_string();
    assert_eq!(
        told,
        "channel a/b: 0 of the 60 bytes of a message were written"
    );
    drop((output, holder));
    assert_nothing_left(domain);
}

#[test]
fn a_writer_with_all_slots_begun_has_memory_for_whatever_its_reader_holds() {
    let (domain, holder, mut output) = assembling("slots", 4);
    let reader = Domain::open(domain.address()).unwrap();
    let mut input = RawInput::open(&reader, "a/b", 4).unwrap();
    let mut held = VecDeque::new();
    for round in 0..200_u64 {
        let slot = usize::from(round % 2 == 1);
        for slot in 0..2 {
            output.discard_pieces(slot);
            output.write_piece(slot, 0, &[7; 700]).unwrap();
        }
        output.publish_with(&[7; 60], numbered(round)).unwrap();
        output.write_piece(slot, 700, &[7; 822]).unwrap();
        output.publish_pieces(slot, 1_522, numbered(round)).unwrap();
        if round % 5 == 4 {
            held.extend(input.hold().unwrap());
            if held.len() > 1 {
                held.pop_front();
            }
        }
    }
    assert!(!held.is_empty());
    drop((held, input, output, holder));
    drop(reader);
    assert_nothing_left(domain);
}
