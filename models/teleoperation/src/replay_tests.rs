//! Tests of [`super`].

use core::convert::Infallible;
use core::time::Duration;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use super::*;
use crate::{
    EGM_LEFT_COMMAND, EGM_RIGHT_COMMAND, LeftArm, MOTION_REQUEST, SendPolicy, Teleoperation,
    TeleoperationParameters,
};
use hil_arm::egm::parameters::RestartPolicy;
use hil_core::case_study::{CaseStudy, channels_of};
use hil_core::component::Port;
use hil_core::endpoint::{Endpoint, InputPort, OutputPort, PortError};
use hil_core::message::Envelope;
use hil_core::random::RandomStream;
use hil_core::simulation::{Carrier, Simulation};
use hil_core::time::duration_ns;
use hil_link::impaired::{DelayLaw, ImpairedLink, Impairments};

/// A case in which a lot happens: both arms move, and sessions end and come back.
fn case() -> Teleoperation {
    let mut parameters = TeleoperationParameters {
        left_arm: LeftArm::Mirror,
        send: SendPolicy::Coupled,
        feed_forward: true,
        ..TeleoperationParameters::default()
    };
    parameters.egm.comm_timeout_s = Some(0.5);
    parameters.egm.restart = Some(RestartPolicy::AutoRetry);
    Teleoperation::new(parameters, 4).unwrap()
}

/// Commands come late, twice, in bursts and out of order.
fn simulated(case: &Teleoperation, duration_s: f64) -> RunLog {
    let bad = |name: &str| {
        let impairments = Impairments {
            delay_ms: 20.0,
            delay_law: DelayLaw::Uniform,
            loss_ratio: 0.1,
            duplicate_ratio: 0.05,
            duplicate_lag_ms: 30.0,
            stall_mean_s: 0.6,
            stall_gap_mean_s: 2.0,
            ..Impairments::default()
        };
        let stream = |what| RandomStream::new(9, &format!("{name} {what}"));
        let link = ImpairedLink::new(impairments, stream("fate"), stream("stall")).unwrap();
        let link: Box<dyn Carrier> = Box::new(link);
        (name.to_owned(), link)
    };
    let carriers: BTreeMap<_, _> = [EGM_RIGHT_COMMAND, EGM_LEFT_COMMAND].map(bad).into();
    let simulation = Simulation::new(case, carriers).unwrap();
    let duration = Duration::from_secs_f64(duration_s);
    simulation.run(duration).unwrap().log
}

fn count(log: &RunLog, kind: EgmEventKind) -> usize {
    log.messages::<EgmEvent>(EGM_EVENT)
        .filter(|(_, event)| event.kind == kind as u32)
        .count()
}

/// `log` with the messages of `channel` changed, or left out where `change` says `None`.
fn changed<M: hil_core::message::Message>(
    log: &RunLog,
    channel: &str,
    mut change: impl FnMut(usize, M) -> Option<M>,
) -> RunLog {
    let mut copy = RunLog::default();
    for (name, _) in log.counts() {
        for (index, logged) in log.raw(name).iter().enumerate() {
            if name != channel {
                copy.push(name, logged.envelope, &logged.payload);
                continue;
            }
            let message = bytemuck::pod_read_unaligned(&logged.payload);
            if let Some(message) = change(index, message) {
                copy.push(name, logged.envelope, bytemuck::bytes_of(&message));
            }
        }
    }
    copy
}

#[test]
fn a_simulated_run_replays_to_the_last_bit() {
    let case = case();
    let log = simulated(&case, 60.0);
    assert!(count(&log, EgmEventKind::Ended) > 5);
    assert!(count(&log, EgmEventKind::HoldBegan) > 5);
    let replay = case.replay(&log).unwrap();
    assert!(replay.is_identical(), "{replay:?}");
    assert_eq!(replay.compared_count, 2 * 15_001);
    let arrivals = log.raw(EGM_RECEIVED).len() + log.raw(MOTION_RECEIVED).len();
    assert_eq!(replay.input_count, arrivals as u64);
    assert!(arrivals > 20_000, "{arrivals}");
}

#[test]
fn a_changed_command_is_found_where_it_acts() {
    let case = case();
    let log = simulated(&case, 10.0);
    let mut acted_on = None;
    let tampered = changed::<EgmArrival>(&log, EGM_RECEIVED, |index, mut arrival| {
        if index >= 2000 {
            acted_on.get_or_insert(arrival.at_ns / 4_000_000);
            arrival.command.position_rad[2] += 1e-12;
        }
        Some(arrival)
    });
    let replay = case.replay(&tampered).unwrap();
    assert!(!replay.is_identical());
    assert!(replay.different_count > 1, "{replay:?}");
    assert!(replay.gaps.is_empty());
    let said = replay.first_difference.unwrap();
    let cycle = acted_on.unwrap();
    let number = said
        .split([' ', ':', ','])
        .find_map(|word| word.parse().ok());
    let late = number.map(|found: i64| found - cycle);
    // In the queue behind others first, it may act a little later.
    assert!(late.is_some_and(|late| (1..400).contains(&late)), "{said}");
    assert!(said.contains("joint"), "{said}");
}

#[test]
fn a_command_that_came_a_cycle_later_is_found() {
    let case = case();
    let log = simulated(&case, 10.0);
    let mut shifted = changed::<EgmArrival>(&log, EGM_RECEIVED, |index, mut arrival| {
        if index >= 2000 {
            arrival.at_ns += 4_000_000;
        }
        Some(arrival)
    });
    let replay = case.replay(&shifted).unwrap();
    assert!(replay.different_count > 0);
    shifted = changed::<EgmArrival>(&log, EGM_RECEIVED, |_, arrival| Some(arrival));
    assert!(case.replay(&shifted).unwrap().is_identical());
}

#[test]
fn records_that_are_missing_are_named() {
    let case = case();
    let log = simulated(&case, 4.0);
    let holed = changed::<EgmArrival>(&log, EGM_RECEIVED, |index, arrival| {
        (index != 30 && index != 50).then_some(arrival)
    });
    let replay = case.replay(&holed).unwrap();
    assert_eq!(replay.gaps, ["2 messages of egm/received are missing"]);
    assert!(!replay.is_identical());

    let without_start = changed::<EgmEvent>(&log, EGM_EVENT, |_, _| None);
    let replay = case.replay(&without_start).unwrap();
    assert_eq!(replay.gaps, ["egm/event tells no start of the robot"]);
    assert_eq!(replay.compared_count, 0);
    assert!(!case.replay(&RunLog::default()).unwrap().is_identical());

    // Another robot after the first: its feedback is not that of the first.
    let mut twice = log.clone();
    for name in [EGM_EVENT, EGM_RIGHT_FEEDBACK] {
        for logged in log.raw(name) {
            let mut envelope = logged.envelope;
            envelope.epoch += 1;
            envelope.published_ns += 5_000_000_000;
            let mut payload = logged.payload.clone();
            if name == EGM_EVENT {
                let mut event: EgmEvent = bytemuck::pod_read_unaligned(&payload);
                event.at_ns += 5_000_000_000;
                payload = bytemuck::bytes_of(&event).to_vec();
            }
            twice.push(name, envelope, &payload);
        }
    }
    let replay = case.replay(&twice).unwrap();
    assert_eq!(replay.different_count, 0, "{replay:?}");
    assert_eq!(replay.compared_count, 2 * 1001);
    let gap = "the robot was started 2 times; only the first life was replayed";
    assert_eq!(replay.gaps, [gap]);
}

#[test]
fn another_setting_is_another_robot() {
    let case = case();
    let log = simulated(&case, 6.0);
    let mut other = case.parameters.clone();
    other.egm.position_gain_per_s = Some(19.9);
    let other = Teleoperation::new(other, 4).unwrap();
    let replay = other.replay(&log).unwrap();
    assert!(replay.different_count > 100, "{replay:?}");
}

/// Messages on their way to the robot, oldest first.
#[derive(Debug, Default)]
struct Waiting(VecDeque<(Instant, Vec<u8>)>);

impl InputPort for Waiting {
    type Error = Infallible;

    fn receive(
        &mut self,
        now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, Infallible> {
        let next = self.0.pop_front_if(|(at, _)| *at <= now);
        if let Some((_, payload)) = &next {
            take(&Envelope::default(), payload);
        }
        Ok(next.is_some())
    }

    fn next_arrival(&self) -> Option<Instant> {
        self.0.front().map(|(at, _)| *at)
    }
}

/// Writes to a log, as a process does.
#[derive(Debug)]
struct Recorder {
    name: &'static str,
    log: Rc<RefCell<RunLog>>,
}

impl OutputPort for Recorder {
    type Error = Infallible;

    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), Infallible> {
        let mut log = self.log.borrow_mut();
        let envelope = Envelope {
            sequence: log.raw(self.name).len() as u64,
            published_ns: now.as_ns(),
            ..Envelope::default()
        };
        log.push(self.name, envelope, payload);
        Ok(())
    }
}

/// The robot of `case` as a process on a busy machine: it hears what the simulated one of `heard`
/// was sent, looks up when it gets round to it, and starts at a time of its own.
fn live(case: &Teleoperation, heard: &RunLog, begin: Instant, end: Instant) -> (RunLog, u64) {
    let shift = Duration::from_nanos(begin.as_ns().unsigned_abs());
    let waiting = |port: &Port| {
        let sent = heard.raw(port.name).iter();
        let sent = sent.map(|logged| {
            let at = Instant::from_ns(logged.envelope.published_ns) + shift;
            (at, logged.payload.clone())
        });
        Ok::<_, PortError>(Waiting(sent.collect()))
    };
    let log = Rc::new(RefCell::new(RunLog::default()));
    let recorder = |port: &Port| {
        Ok(Recorder {
            name: port.name,
            log: Rc::clone(&log),
        })
    };
    let role = Robot::new(case.settings).into_role();
    let stated = channels_of(Teleoperation::NAME, Teleoperation::CHANNELS, "robot");
    let mut endpoint = Endpoint::join(role, &stated, waiting, recorder).unwrap();
    match endpoint.start(begin) {
        Ok(_) => {}
        Err(never) => match never {},
    }
    let mut random = RandomStream::new(2, "busy machine");
    let mut now = begin;
    while now <= end {
        match endpoint.poll(now) {
            Ok(_) => {}
            Err(never) => match never {},
        }
        // Mostly a little late, now and then by many cycles.
        let pause_ns = if random.chance(0.01) {
            random.next_u64() % 150_000_000
        } else {
            random.next_u64() % 5_000_000
        };
        now = now + Duration::from_nanos(1 + pause_ns);
    }
    let skipped_count = endpoint.role().skipped_ticks();
    drop(endpoint);
    let log = Rc::into_inner(log).unwrap().into_inner();
    (log, skipped_count)
}

#[test]
fn a_live_run_on_a_busy_machine_replays_to_the_last_bit() {
    let case = case();
    let heard = simulated(&case, 30.0);
    let begin = Instant::from_ns(1_234_567_891);
    let end = begin + Duration::from_secs(31);
    let (log, skipped_count) = live(&case, &heard, begin, end);
    assert!(skipped_count > 500, "{skipped_count} cycles skipped");
    let cycle_count = duration_ns(Duration::from_secs(31)) / duration_ns(case.settings.cycle);
    let reported_count = i64::try_from(log.raw(EGM_RIGHT_FEEDBACK).len()).unwrap();
    assert!(reported_count < cycle_count - 500);
    assert!(count(&log, EgmEventKind::Running) >= 2);
    let sent_count = heard.raw(EGM_RIGHT_COMMAND).len() + heard.raw(EGM_LEFT_COMMAND).len();
    assert_eq!(log.raw(EGM_RECEIVED).len(), sent_count);
    assert_eq!(
        log.raw(MOTION_RECEIVED).len(),
        heard.raw(MOTION_REQUEST).len()
    );
    let replay = case.replay(&log).unwrap();
    assert!(replay.is_identical(), "{replay:?}");
    assert_eq!(
        replay.compared_count,
        2 * log.raw(EGM_RIGHT_FEEDBACK).len() as u64
    );
}
