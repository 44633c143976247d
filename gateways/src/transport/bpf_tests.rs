//! The eBPF programs of a tap, run by the kernel for made-up packets. It takes the right to load them;
//! without, the tests say that they were skipped.

use core::sync::atomic::Ordering;
use std::os::fd::{AsRawFd, OwnedFd};

use hil_models::random::RandomStream;
use nix::time::{ClockId, clock_gettime};

use super::bpf_call::{SharedWords, create_map, load_program, run_once};
use super::bpf_code::{Purpose, TCX_NEXT, program};
use super::tap_ring::{Shape, TapReader, at, counts};
use crate::capture::flow::FlowFilter;
use crate::capture::program::compile;
use crate::capture::tests::programs::{FLOW_SETS, is_of, made_up_frame, run};
use crate::capture::{Direction, link_type};

const STACK_STAMP_NS: u64 = 1_795_338_139_876_353_805;
const SNAP_BYTES: usize = 99;

/// Both programs, attached to nothing.
struct Loaded {
    arrivals: OwnedFd,
    departures: OwnedFd,
    shape: Shape,
    shared: SharedWords,
    reader: TapReader,
}

impl Loaded {
    /// `None`, said aloud, where the kernel grants nothing.
    #[allow(clippy::print_stderr, reason = "a test that is skipped must say so")]
    fn new(flows: &[FlowFilter], link: u16) -> Option<Self> {
        let shape = Shape::new(SNAP_BYTES, 1 << 16, 4);
        let map = match create_map(shape.memory_bytes()) {
            Ok(map) => map,
            Err(error) if error.raw_os_error() == Some(libc::EPERM) => {
                eprintln!("skipped: no right to create a map: {error}");
                return None;
            }
            Err(error) => panic!("{error}"),
        };
        let filter = compile(link, flows, 99).unwrap();
        let [arrivals, departures] = [false, true].map(|is_outbound| {
            let code = program(&Purpose {
                filter: &filter,
                shape,
                map: map.as_raw_fd(),
                is_outbound,
            });
            load_program(&code).unwrap()
        });
        Some(Self {
            arrivals,
            departures,
            shape,
            shared: SharedWords::of(&map, shape.memory_bytes()).unwrap(),
            reader: TapReader::new(shape),
        })
    }

    fn arrive(&self, frame: &[u8]) {
        let verdict = run_once(&self.arrivals, frame, STACK_STAMP_NS).unwrap();
        assert_eq!(verdict, TCX_NEXT, "a tap decides nothing");
    }
}

fn flows(set: &[&str]) -> Vec<FlowFilter> {
    set.iter().map(|text| text.parse().unwrap()).collect()
}

#[test]
fn the_kernel_keeps_exactly_the_packets_of_the_flows() {
    let mut random = RandomStream::new(7, "kernel filters");
    for set in FLOW_SETS {
        let flows = flows(set);
        for link in [link_type::ETHERNET, link_type::RAW] {
            let Some(mut loaded) = Loaded::new(&flows, link) else {
                return;
            };
            let filter = compile(link, &flows, 99).unwrap();
            let mut kept_count = 0_u32;
            for case in 0..3_000 {
                let mut frame = made_up_frame(&mut random, case, link);
                if case.is_multiple_of(7) {
                    // Cut within the headers, though not before what the kernel needs for a trial.
                    let least = match frame[12..14] {
                        [0x08, 0x00] => 34,
                        [0x86, 0xdd] => 54,
                        _ => 14,
                    };
                    frame.truncate(least + usize::try_from(case % 20).unwrap());
                }
                loaded.arrive(&frame);
                let record = loaded.reader.take(loaded.shared.words());
                let is_kept = run(&filter, &frame) == 99;
                assert_eq!(record.is_some(), is_kept, "{set:?} {case} {frame:02x?}");
                let Some(record) = record else { continue };
                kept_count += 1;
                assert_eq!(record.data, &frame[..frame.len().min(SNAP_BYTES)]);
                assert_eq!(record.original_bytes as usize, frame.len());
                assert_eq!(record.stamp_ns, STACK_STAMP_NS);
                assert!(record.is_stack_stamp);
                assert_eq!((record.direction, record.vlan), (Direction::Inbound, None));
            }
            assert!(
                (100..2_900).contains(&kept_count),
                "{set:?}: {kept_count} kept"
            );
            assert_eq!(counts(loaded.shared.words()), (kept_count.into(), 0));
        }
    }
}

#[test]
fn what_leaves_has_the_programs_own_stamp() {
    let Some(mut loaded) = Loaded::new(&flows(&["hil"]), link_type::ETHERNET) else {
        return;
    };
    let mut random = RandomStream::new(8, "departures");
    let atomic_ns = || {
        let time = clock_gettime(ClockId::CLOCK_TAI).unwrap();
        time.tv_sec() * 1_000_000_000 + time.tv_nsec()
    };
    let before_ns = atomic_ns();
    let ours = flows(&["hil"]);
    let frame = (1..100)
        .map(|case| made_up_frame(&mut random, case, link_type::ETHERNET))
        .find(|frame| is_of(&ours, link_type::ETHERNET, frame));
    let frame = frame.expect("one of a hundred is ours");
    let verdict = run_once(&loaded.departures, &frame, STACK_STAMP_NS).unwrap();
    assert_eq!(verdict, TCX_NEXT);
    // An arrival that the stack did not stamp is stamped by the program as well.
    run_once(&loaded.arrivals, &frame, 0).unwrap();
    let after_ns = atomic_ns();
    for direction in [Direction::Outbound, Direction::Inbound] {
        let record = loaded.reader.take(loaded.shared.words()).unwrap();
        assert_eq!(
            (record.direction, record.is_stack_stamp),
            (direction, false)
        );
        let stamp = i64::try_from(record.stamp_ns).unwrap();
        assert!((before_ns..=after_ns).contains(&stamp));
    }
}

#[test]
fn what_the_ring_has_no_room_for_is_counted() {
    let Some(mut loaded) = Loaded::new(&flows(&["udp:dst=10.77.0.2"]), link_type::ETHERNET) else {
        return;
    };
    let mut random = RandomStream::new(9, "overflow");
    let mut frame = Vec::new();
    while !is_of(&flows(&["udp:dst=10.77.0.2"]), link_type::ETHERNET, &frame) {
        frame = made_up_frame(&mut random, 0, link_type::ETHERNET);
    }
    let room = loaded.shape.room();
    for lap in 1..=3_u64 {
        for _ in 0..room + 5 {
            loaded.arrive(&frame);
        }
        let mut read_count = 0;
        while loaded.reader.take(loaded.shared.words()).is_some() {
            read_count += 1;
        }
        assert_eq!(read_count, room);
        assert_eq!(counts(loaded.shared.words()), (lap * room as u64, lap * 5));
    }
}

#[test]
fn a_reader_that_is_ahead_of_what_a_program_knows_is_no_full_ring() {
    let Some(mut loaded) = Loaded::new(&flows(&["hil"]), link_type::ETHERNET) else {
        return;
    };
    let mut random = RandomStream::new(10, "passed");
    let ours = flows(&["hil"]);
    let frame = (1..100)
        .map(|case| made_up_frame(&mut random, case, link_type::ETHERNET))
        .find(|frame| is_of(&ours, link_type::ETHERNET, frame));
    let frame = frame.expect("one of a hundred is ours");
    // What a program finds that was held between its two loads.
    loaded.shared.words()[usize::from(at::TAIL) / 8].store(5, Ordering::SeqCst);
    loaded.arrive(&frame);
    assert!(loaded.reader.take(loaded.shared.words()).is_some());
    assert_eq!(counts(loaded.shared.words()), (1, 0));
}

#[test]
fn the_kernel_takes_the_longest_filter_there_can_be() {
    let six = "udp:sport=1,dport=2,src=fd00::1,dst=fd00::2";
    let all = flows(&[six; crate::capture::flow::FLOW_COUNT_MAX]);
    for link in [link_type::ETHERNET, link_type::RAW] {
        if Loaded::new(&all, link).is_none() {
            return;
        }
    }
}

#[test]
fn what_the_kernel_refuses_is_told_in_its_words() {
    if Loaded::new(&flows(&["hil"]), link_type::ETHERNET).is_none() {
        return;
    }
    // A map that is none.
    let shape = Shape::new(SNAP_BYTES, 1 << 16, 4);
    let filter = compile(link_type::ETHERNET, &flows(&["hil"]), 99).unwrap();
    let code = program(&Purpose {
        filter: &filter,
        shape,
        map: 0x7fff,
        is_outbound: false,
    });
    assert!(load_program(&code).is_err());
    // A program that reads behind its slot.
    let error = load_program(&code[..3]).unwrap_err().to_string();
    assert!(error.contains("last insn"), "{error}");
}
