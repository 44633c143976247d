//! Tests of the virtual-time driver.

use core::time::Duration;
use std::collections::BTreeMap;

use super::*;
use crate::case_study::ChannelSpec;
use crate::component::{Component, Output, Role, Timer};
use crate::link_model::PerfectLink;

crate::message! {
    struct Status = "test.Status.v1" { position_m: f64 }
}

/// Tells the record where it is, and nobody listens.
fn diarist() -> Box<dyn Role> {
    let status = |(): &mut (), _, _| Status { position_m: 1.0 };
    Component::of(())
        .input("a/heard", |(), _, _: &Status| {})
        .publish("a/diary", Duration::from_millis(100), status)
        .into_role()
}

const DIARY: &[ChannelSpec] = &[
    ChannelSpec::of::<Status>("a/heard", "other", "diarist"),
    ChannelSpec::recorded::<Status>("a/diary", "diarist"),
];

fn diary(carriers: BTreeMap<String, Box<dyn Carrier>>) -> Result<Simulation, SimulationError> {
    let roles = vec![("diarist", diarist())];
    Simulation::of_roles("diary", DIARY, roles, carriers)
}

#[test]
fn a_recorded_channel_is_logged_and_counted_and_has_no_fate() {
    let result = diary(BTreeMap::new()).unwrap();
    let result = result.run(Duration::from_secs(1)).unwrap();
    let count = result.recorded_counts["a/diary"];
    let logged = result.log.raw("a/diary");
    assert!(count >= 10);
    assert_eq!(logged.len() as u64, count);
    let sequences: Vec<u64> = logged.iter().map(|one| one.envelope.sequence).collect();
    assert_eq!(sequences, (0..count).collect::<Vec<_>>());
    assert!(!result.channels.contains_key("a/diary"));
}

#[test]
fn a_carrier_for_a_recorded_channel_is_refused() {
    let carrier = Box::new(PerfectLink) as Box<dyn Carrier>;
    let error = diary(BTreeMap::from([("a/diary".to_owned(), carrier)])).unwrap_err();
    assert_eq!(
        error.to_string(),
        "channel a/diary of case diary is only recorded; nothing carries it"
    );
}

/// Two clocks: one speaks every 10 ms, the other every 15 ms, and what either says is heard 5 ms
/// later.
#[derive(Debug, Default)]
struct Clocks {
    next_ms: [i64; 2],
    heard: Vec<(i64, usize)>,
}

/// Loses what the second clock says at 30 ms.
#[derive(Debug)]
struct FiveMs;

impl Network<usize> for FiveMs {
    fn offer(&mut self, now: Instant, clock: &usize, mut deliver: impl FnMut(Instant, usize)) {
        if (now, *clock) != (ms(30), 1) {
            deliver(now + Duration::from_millis(5), *clock);
        }
    }
}

fn ms(ms: i64) -> Instant {
    Instant::from_ns(ms * 1_000_000)
}

impl Model for Clocks {
    type Message = usize;
    type Record = ();
    type Network = FiveMs;
    /// Whichever clock it is, with what it says before what it hears.
    type Rank = (bool, usize);

    fn rank(clock: &usize) -> Self::Rank {
        (true, *clock)
    }

    fn start<O: Observe<Self>>(&mut self, _medium: &mut Medium<'_, Self, O>) {}

    fn next(&self) -> Option<Due<Self::Rank>> {
        let due = (0..2).map(|clock| Due {
            at: ms(self.next_ms[clock]),
            rank: (false, clock),
        });
        due.min()
    }

    fn advance<O: Observe<Self>>(&mut self, rank: Self::Rank, medium: &mut Medium<'_, Self, O>) {
        self.next_ms[rank.1] += [10, 15][rank.1];
        medium.send(&rank.1);
    }

    fn receive<O: Observe<Self>>(&mut self, clock: usize, medium: &mut Medium<'_, Self, O>) {
        self.heard.push((medium.now.as_ns() / 1_000_000, clock));
    }
}

/// Ticks every 15 ms.
#[derive(Debug, Default)]
struct Notes(Vec<String>, i64);

impl Observe<Clocks> for Notes {
    fn offered(&mut self, now: Instant, clock: &usize) {
        self.0
            .push(format!("{clock} at {}", now.as_ns() / 1_000_000));
    }

    fn delivered(&mut self, _now: Instant, clock: &usize, at: Instant) {
        self.0
            .push(format!("{clock} for {}", at.as_ns() / 1_000_000));
    }

    fn dropped(&mut self, _now: Instant, clock: &usize) {
        self.0.push(format!("{clock} lost"));
    }

    fn next_tick(&self) -> Option<Instant> {
        Some(ms(self.1))
    }

    fn ticked(&mut self, now: Instant) {
        assert_eq!(now, ms(self.1));
        self.0.push(format!("tick {}", self.1));
        self.1 += 15;
    }
}

#[test]
fn what_is_due_comes_by_time_then_rank_and_ticks_come_last() {
    let mut simulation = Simulation::of(Clocks::default(), FiveMs);
    let (mut notes, mut other) = (Notes::default(), Notes::default());
    for end_ms in [0, 15, 16, 36] {
        simulation.run_until(ms(end_ms), &mut (&mut notes, &mut other));
        assert_eq!(simulation.now(), ms(end_ms));
    }
    let heard = [(5, 0), (5, 1), (15, 0), (20, 1), (25, 0), (35, 0)];
    assert_eq!(simulation.model().heard, heard);
    let expected = "0 at 0|0 for 5|1 at 0|1 for 5|tick 0|0 at 10|0 for 15|1 at 15|1 for 20|tick 15|\
                    0 at 20|0 for 25|0 at 30|0 for 35|1 at 30|1 lost|tick 30";
    assert_eq!(notes.0.join("|"), expected);
    assert_eq!(other.0, notes.0);
}

#[test]
fn messages_arrive_by_time_then_rank_then_order_and_their_slots_are_used_again() {
    let mut queue = MessageQueue::default();
    let due = |ms_: i64, rank: u8| Due { at: ms(ms_), rank };
    queue.push(due(2, 1), "late");
    for (rank, message) in [(2, "low"), (1, "first"), (1, "second"), (0, "high")] {
        queue.push(due(1, rank), message);
    }
    assert_eq!(queue.next(), Some(due(1, 0)));
    let taken: Vec<_> = core::iter::from_fn(|| queue.pop()).collect();
    assert_eq!(taken, ["high", "first", "second", "low", "late"]);
    queue.push(due(3, 0), "again");
    assert_eq!(queue.messages.len(), 5);
    assert_eq!(queue.iter().count(), 1);
}

/// Answers at once; one that begins speaks first.
#[derive(Debug)]
struct Echo {
    begins: bool,
    said: Output<Status>,
}

impl Echo {
    fn role([heard, said]: [&'static str; 2], begins: bool) -> Box<dyn Role> {
        let echo = Self {
            begins,
            said: Output::default(),
        };
        Component::of(echo)
            .input(heard, |own, _, heard: &Status| own.said.send(*heard))
            .output(said, |own| &mut own.said)
            .timer(Timer {
                next: |own| own.begins.then_some(Instant::ZERO),
                tick: Self::tick,
                skipped: |_| 0,
            })
            .into_role()
    }

    fn tick(&mut self, _: Instant) {
        if core::mem::take(&mut self.begins) {
            self.said.send(Status { position_m: 0.0 });
        }
    }
}

#[test]
fn roles_that_answer_each_other_without_delay_are_refused() {
    const ECHOES: &[ChannelSpec] = &[
        ChannelSpec::of::<Status>("a/there", "one", "other"),
        ChannelSpec::of::<Status>("a/back", "other", "one"),
    ];
    let run = |begins| {
        let roles = vec![
            ("one", Echo::role(["a/back", "a/there"], begins)),
            ("other", Echo::role(["a/there", "a/back"], false)),
        ];
        let simulation = Simulation::of_roles("echo", ECHOES, roles, BTreeMap::new()).unwrap();
        simulation.run(Duration::from_secs(1))
    };
    assert!(run(false).is_ok());
    let at = Instant::ZERO;
    assert_eq!(
        run(true).unwrap_err(),
        SimulationError::ZeroDelayLoop { at }
    );
}

#[test]
fn a_role_that_does_not_fit_its_case_does_not_start() {
    const MISSPELT: &[ChannelSpec] = &[
        ChannelSpec::of::<Status>("a/herd", "other", "diarist"),
        ChannelSpec::recorded::<Status>("a/diary", "diarist"),
    ];
    let roles = vec![("diarist", diarist())];
    let error = Simulation::of_roles("diary", MISSPELT, roles, BTreeMap::new()).unwrap_err();
    let expected = "input port a/heard of role diarist takes test.Status.v1 (8 bytes aligned to 8), \
                    but case diary states no such channel";
    assert_eq!(error.to_string(), expected);
}
