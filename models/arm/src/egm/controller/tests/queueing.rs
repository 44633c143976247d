//! The queue: what a buffered stall and a fast sender do to the age of the reference, and that it
//! never grows beyond its bound.

use super::rig::{Rig, at_s, open_settings, standing, swing};
use crate::egm::messages::{EgmCommand, EgmEventKind, EgmFeedback, EgmStartParameters};
use crate::egm::parameters::{ControllerSettings, QueuePolicy};

const CYCLE_S: f64 = 0.004;

fn with_queue(queue: QueuePolicy) -> ControllerSettings {
    ControllerSettings {
        queue,
        ..open_settings()
    }
}

/// A coupled client, 1 ms away, that answers every `every`-th cycle; what it sent between 5 and
/// 6 s is buffered on the way and arrives together. Gives the age of the reference at each cycle
/// up to 16 s.
fn ages_after_a_stall(rig: &mut Rig, every: u64) -> Vec<(f64, f64)> {
    let mut ages = Vec::new();
    let mut buffered = Vec::new();
    while rig.next_s() < 16.0 {
        let feedback = rig.step();
        let sent_s = rig.next_s() - CYCLE_S + 0.001;
        if feedback.cycle_index.is_multiple_of(every) {
            let mut command = swing(sent_s, false);
            command.source_time_ns = at_s(sent_s).as_ns();
            buffered.push(command);
        }
        if !(5.0..6.0).contains(&sent_s) {
            for command in buffered.drain(..) {
                rig.receive_at(at_s(sent_s).as_ns(), &command);
            }
        }
        ages.push((sent_s, feedback.reference_age_ns as f64 * 1e-9));
    }
    ages
}

fn age_at(ages: &[(f64, f64)], time_s: f64) -> f64 {
    ages.iter().find(|(at_s, _)| *at_s >= time_s).unwrap().1
}

#[test]
fn a_buffered_stall_lags_a_coupled_client_for_ever_until_the_next_session() {
    let mut rig = Rig::new(with_queue(QueuePolicy::Fifo1));
    let ages = ages_after_a_stall(&mut rig, 1);
    assert!(age_at(&ages, 4.9) < 2.0 * CYCLE_S);
    for time_s in [7.1, 10.0, 15.9] {
        let age = age_at(&ages, time_s);
        assert!((age - 1.0).abs() <= 0.02, "{age} at {time_s} s");
    }
    let waiting = rig.feedback().queue_count;
    assert!((249..=251).contains(&waiting), "{waiting}");

    rig.controller.stop_guided_motion();
    rig.silence(rig.next_s() + 0.5);
    rig.controller
        .start_guided_motion(&EgmStartParameters::KEEP)
        .unwrap();
    let until_s = rig.next_s() + 1.0;
    let feedback = rig.drive(until_s, 1, |time_s| Some(swing(time_s, false)));
    let age_ns = feedback.last().unwrap().reference_age_ns;
    assert!(age_ns <= 8_000_000, "{age_ns}");
    let cleared = rig.controller.command_counters().cleared;
    // One more was on its way when the stop was asked for.
    assert_eq!(cleared, u64::from(waiting) + 1);
}

#[test]
fn taking_the_newest_forgets_a_stall_at_once() {
    let mut rig = Rig::new(with_queue(QueuePolicy::Latest));
    let ages = ages_after_a_stall(&mut rig, 1);
    let highest = ages.iter().filter(|(at_s, _)| *at_s >= 6.008);
    let highest = highest.map(|(_, age)| *age).fold(0.0, f64::max);
    assert!(highest <= 2.0 * CYCLE_S, "{highest}");
    let counters = rig.controller.command_counters();
    assert!((245..=250).contains(&counters.superseded), "{counters:?}");
}

#[test]
fn a_sender_at_half_the_rate_drains_a_stall_by_itself() {
    let mut rig = Rig::new(with_queue(QueuePolicy::Fifo1));
    let ages = ages_after_a_stall(&mut rig, 2);
    let is_late = |(_, age): &&(f64, f64)| *age > 3.0 * CYCLE_S;
    let recovered_s = ages.iter().rfind(is_late).unwrap().0 - 6.0;
    assert!((0.8..=1.2).contains(&recovered_s), "{recovered_s}");
}

#[test]
fn a_sender_of_250_hz_outruns_the_real_controllers_cycle_by_8_ms_each_second() {
    let settings = ControllerSettings {
        cycle: core::time::Duration::from_micros(4032),
        ..with_queue(QueuePolicy::Fifo1)
    };
    let mut rig = Rig::new(settings);
    let mut next_sent_ns = 1_000_000_i64;
    let mut ages = Vec::new();
    while rig.next_s() < 60.0 {
        while next_sent_ns < rig.next_at().as_ns() {
            rig.receive_at(next_sent_ns, &standing());
            next_sent_ns += 4_000_000;
        }
        let at_s = rig.next_s();
        ages.push((at_s, rig.step().reference_age_ns as f64 * 1e-9));
    }
    let slope = (age_at(&ages, 59.0) - age_at(&ages, 9.0)) / 50.0;
    assert!((slope - 0.008).abs() <= 0.0005, "{slope}");
}

#[test]
fn a_command_acts_after_the_cycle_that_took_it_and_only_if_it_came_before() {
    let mut rig = Rig::new(with_queue(QueuePolicy::Fifo1));
    rig.silence(0.1);
    let mut away = standing();
    away.position_rad[0] += 0.1;
    // At the grid point itself: too late for it.
    rig.receive_at(rig.next_at().as_ns(), &away);
    let missed = rig.step();
    let took = rig.step();
    let moved = rig.step();
    assert!(!missed.has(EgmFeedback::TOOK_COMMAND) && took.has(EgmFeedback::TOOK_COMMAND));
    assert_eq!(took.reference_age_ns, 4_000_000);
    assert!(took.planned_rad[0].to_bits() == missed.planned_rad[0].to_bits());
    assert!(moved.planned_rad[0] > took.planned_rad[0]);
}

#[test]
fn the_queue_is_bounded_and_every_command_is_accounted_for() {
    for (queue, queue_capacity) in [
        (QueuePolicy::Fifo1, 7),
        (QueuePolicy::Latest, 7),
        (QueuePolicy::Fifo1, 3000),
    ] {
        let settings = ControllerSettings {
            queue_capacity,
            ..with_queue(queue)
        };
        let mut rig = Rig::new(settings);
        rig.silence(0.1);
        for round in 0..5 {
            let at_ns = rig.next_at().as_ns() - 1;
            for _ in 0..10_000 {
                rig.receive_at(at_ns, &standing());
            }
            for _ in 0..=round {
                let feedback = rig.step();
                assert!(u64::from(feedback.queue_count) <= queue_capacity as u64);
            }
        }
        let counters = rig.controller.command_counters();
        let settled = counters.taken
            + counters.superseded
            + counters.dropped
            + counters.cleared
            + u64::from(rig.feedback().queue_count);
        assert_eq!(counters.received, 50_000);
        assert_eq!(settled, 50_000, "{counters:?}");
        // Once until the queue was half empty again, which 3000 commands take longer for.
        let told = rig.of_kind(EgmEventKind::QueueOverflow).len();
        assert!((1..=5).contains(&told), "{told}");
        assert!(queue_capacity < 3000 || told == 1, "{told}");
    }
}

#[test]
fn silence_is_told_once_as_a_hold_and_once_as_its_end() {
    let mut rig = Rig::new(open_settings());
    rig.drive(1.0, 2, |time_s| Some(swing(time_s, false)));
    assert!(rig.of_kind(EgmEventKind::HoldBegan).is_empty());
    rig.silence(3.0);
    assert!(rig.feedback().has(EgmFeedback::HOLDING));
    rig.drive(4.0, 2, |time_s| Some(swing(time_s, false)));
    assert!(!rig.feedback().has(EgmFeedback::HOLDING));
    let (began, ended) = (
        rig.of_kind(EgmEventKind::HoldBegan),
        rig.of_kind(EgmEventKind::HoldEnded),
    );
    assert_eq!((began.len(), ended.len()), (1, 1));
    assert!((ended[0].value - 2.0).abs() <= 0.012, "{ended:?}");
    // Holding counts from 40 ms on.
    let held = rig.controller.held_cycle_count();
    assert!((485..=495).contains(&held), "{held}");
    let flags = EgmCommand::HAS_SPEED;
    assert_eq!(rig.feedback().flags & flags, EgmFeedback::HAS_REFERENCE);
}
