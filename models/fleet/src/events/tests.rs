//! Tests of the events of a recorded run, on logs made by hand.

use super::*;
use crate::messages::Header;
use crate::referee::Cause;
use hil_core::message::Envelope;

const MS: i64 = 1_000_000;

/// A run in the making: what was published, channel by channel, in order.
#[derive(Default)]
struct Diary {
    log: RunLog,
    counts: BTreeMap<&'static str, u64>,
}

impl Diary {
    fn publish(&mut self, channel: &'static str, at_ms: i64, message: &impl Message) {
        let count = self.counts.entry(channel).or_default();
        let envelope = Envelope {
            sequence: *count,
            published_ns: at_ms * MS,
            epoch: 5,
            ..Envelope::default()
        };
        *count += 1;
        self.log
            .push(channel, envelope, bytemuck::bytes_of(message));
    }

    fn send(&mut self, at_ms: i64, number: u32) -> &mut Self {
        let authority = Authority {
            header: header(),
            sequence: number,
            ..Authority::default()
        };
        self.publish(FLEET_AUTHORITY, at_ms, &authority);
        self
    }

    fn take(&mut self, at_ms: i64, kind: TruthKind, number: u32) -> &mut Self {
        let truth = Truth {
            at_ns: at_ms * MS,
            fleet_id: 1,
            robot_id: 2,
            mission_id: 3,
            caused_by_sequence: number,
            kind: kind as u32,
            ..Truth::default()
        };
        self.publish(FLEET_TRUTH, at_ms, &truth);
        self
    }

    fn told(&self) -> Vec<(String, Vec<u64>)> {
        let events = events(&self.log, &[]);
        let told = events.into_iter().map(|event| {
            let numbers = event.messages.iter().map(|message| message.sequence);
            (event.what, numbers.collect())
        });
        told.collect()
    }
}

fn header() -> Header {
    Header {
        fleet_id: 1,
        robot_id: 2,
        mission_id: 3,
        ..Header::default()
    }
}

use TruthKind::{AuthorityApplied as Applied, AuthorityLate as Late, MessageStale as Stale};

#[test]
fn what_comes_in_time_and_in_turn_is_no_event() {
    let mut diary = Diary::default();
    diary.send(0, 1).take(20, Applied, 1);
    diary.send(1_000, 2).take(1_020, Applied, 2);
    diary.send(2_000, 2).take(2_020, Stale, 2);
    diary.send(3_000, 3).take(3_020, Applied, 3);
    assert_eq!(diary.told(), []);
}

#[test]
fn a_number_never_taken_is_named_with_every_copy_of_it() {
    let mut diary = Diary::default();
    diary.send(0, 1).take(20, Applied, 1);
    diary.send(1_000, 2).send(2_000, 3).send(3_000, 4);
    diary.take(3_020, Applied, 4).send(4_000, 4);
    let what = "robot 2 of fleet 1 took no authorities 2 to 3 of mission 3 before 4";
    assert_eq!(diary.told(), [(what.to_owned(), vec![1, 2, 3])]);
}

#[test]
fn a_repeat_that_had_to_be_waited_for_is_named_with_the_copies_before() {
    let mut diary = Diary::default();
    diary.send(0, 1).send(1_000, 1).send(2_000, 1);
    diary.take(2_020, Applied, 1).send(3_000, 1);
    let what = "robot 2 of fleet 1 took authority 1 of mission 3 2.02 s after it was first \
                sent, 2 copies before";
    assert_eq!(diary.told(), [(what.to_owned(), vec![0, 1, 2])]);
    // Without a common clock nobody can say how long it took.
    diary.log.set_clocks_differ();
    assert_eq!(diary.told(), []);
    // Aligned clocks may show a command as sent after it was taken, by as much as they are known.
    let stamp = |at_ns, bound_ns| {
        Some(hil_core::run_log::ConvertedStamp {
            at_ns,
            bound_ns,
            is_early: false,
        })
    };
    let late = |channel: &str, ns: i64| match channel {
        FLEET_TRUTH => stamp(ns, 0),
        _ => stamp(ns + 50 * MS, 50_000_000),
    };
    let source_of = |channel: &str| Some(channel.to_owned());
    diary.log.bring_to_one_clock(source_of, late).unwrap();
    let told = diary.told();
    assert_eq!(told.len(), 1, "{told:?}");
    assert_eq!(told[0].1, [0, 1, 2], "{told:?}");
}

#[test]
fn what_came_ahead_of_its_mission_was_not_held_up_by_the_network() {
    let mut diary = Diary::default();
    diary.send(0, 1).take(500, TruthKind::MissionStarted, 0);
    diary.send(1_000, 1).take(1_020, Applied, 1);
    assert_eq!(diary.told(), []);
}

#[test]
fn a_mission_that_had_to_be_repeated_is_named() {
    let mut diary = Diary::default();
    let mission = Mission {
        header: header(),
        ..Mission::default()
    };
    diary.publish(FLEET_MISSION, 0, &mission);
    diary.publish(FLEET_MISSION, 1_000, &mission);
    diary.take(1_010, TruthKind::MissionStarted, 0);
    let what = "robot 2 of fleet 1 began mission 3 1.01 s after it was first sent, 1 copy before";
    assert_eq!(diary.told(), [(what.to_owned(), vec![0, 1])]);
}

#[test]
fn an_authority_too_late_to_keep_is_told_with_the_ones_before_that_never_came() {
    let mut diary = Diary::default();
    diary.send(0, 1).take(20, Applied, 1).send(1_000, 2);
    diary.send(2_000, 3).take(2_900, Late, 3);
    let what = "robot 2 of fleet 1 could not stop at authority 3 of mission 3 any more and \
                went past";
    assert_eq!(diary.told(), [(what.to_owned(), vec![1, 2])]);
}

#[test]
fn an_incident_names_what_each_robot_took_last_and_what_it_was_sent_after() {
    let mut diary = Diary::default();
    diary.send(0, 1).take(20, Applied, 1).send(1_000, 2);
    diary.send(2_000, 3).take(2_020, Late, 3);
    diary.send(3_000, 4).send(9_000, 5);
    let seen = Incident {
        at: Instant::from_ns(5_000 * MS),
        kind: IncidentKind::Overlap,
        fleet_id: 1,
        robots: [2, 4],
        mission_ids: [3, 1],
        is_under_way: [true; 2],
        position_m: [1.0, 2.0],
        causes: [
            Cause {
                kind: Applied as u32,
                caused_by_sequence: 3,
                at_ns: 2_020 * MS,
            },
            Cause::default(),
        ],
    };
    let events = events(&diary.log, &[seen]);
    let [late, event] = events.as_slice() else {
        panic!("{events:?}");
    };
    assert_eq!(late.severity, Severity::Hazard);
    assert_eq!(event.severity, Severity::Incident);
    assert_eq!(event.clock_of, FLEET_TRUTH);
    let named: Vec<_> = event.messages.iter().map(|one| one.sequence).collect();
    assert_eq!(named, [1, 2, 3], "the last was sent afterwards");
    assert!(event.messages.iter().all(|one| one.epoch == 5));
    let what = "robots 2 and 4 of fleet 1 overlapped in a critical section, at x 1.0 m, y 2.0 m";
    assert_eq!(event.what, what);
}
