//! What silence costs: motion loops lost per hold and per time-out, counted by prominence.

use super::rig::{AMPLITUDE_RAD, PERIOD_S, Rig, open_settings, swing};
use crate::egm::messages::EndCause;
use crate::egm::parameters::{ControllerSettings, RestartPolicy};
use crate::yumi::arm::RIGHT_START_RAD;
use hil_stats::series::{Sample, peaks};

/// Between two outages: long enough that each is judged by itself.
const SPACING_S: f64 = 6.0 * PERIOD_S;

/// Mean number of loops the measured first joint lacks per outage, when the client sends at
/// 125 Hz but for `duration_s(share)` from the given share of a loop on, for `count` shares evenly
/// over the loop.
fn lost_per_outage(
    settings: ControllerSettings,
    count: u32,
    duration_s: impl Fn(f64) -> f64,
) -> (f64, Rig) {
    let outages: Vec<(f64, f64)> = (0..count)
        .map(|index| {
            let share = (f64::from(index) + 0.5) / f64::from(count);
            // Whole loops apart, so that the phase is the share alone.
            let start_s = 2.0 * SPACING_S * f64::from(index + 1) + share * PERIOD_S;
            (start_s, start_s + duration_s(share))
        })
        .collect();
    let end_s = 2.0 * SPACING_S * f64::from(count + 2);
    let mut rig = Rig::new(settings);
    let (mut sent, mut moved): (Vec<Sample>, Vec<Sample>) = (Vec::new(), Vec::new());
    let mut next_outage = 0;
    while rig.next_s() < end_s {
        for feedback in rig.drive(rig.next_s() + 0.008, 2, |time_s| {
            while next_outage + 1 < outages.len() && time_s >= outages[next_outage].1 {
                next_outage += 1;
            }
            let (from_s, to_s) = outages[next_outage];
            (!(from_s..to_s).contains(&time_s)).then(|| swing(time_s, false))
        }) {
            let at_ns = i64::try_from(feedback.cycle_index).unwrap() * 4_000_000;
            moved.push((at_ns, feedback.measured_rad[0] - RIGHT_START_RAD[0]));
            let position = swing(at_ns as f64 * 1e-9, false).position_rad[0];
            sent.push((at_ns, position - RIGHT_START_RAD[0]));
        }
    }
    // Half of the sent motion from peak to peak.
    let prominence = AMPLITUDE_RAD;
    let (sent, moved) = (peaks(&sent, prominence), peaks(&moved, prominence));
    let lost = sent.len() as f64 - moved.len() as f64;
    (lost / f64::from(count), rig)
}

#[test]
fn a_hold_costs_loops_by_its_length_alone() {
    for (hold_s, expected, tolerance) in [
        (1.0, 0.0, 0.0),
        (2.0, 0.015, 0.015),
        (3.0, 0.56, 0.08),
        (4.03, 1.0, 0.02),
        (8.0, 2.0, 0.02),
    ] {
        let (lost, rig) = lost_per_outage(open_settings(), 60, |_| hold_s);
        assert!(
            (lost - expected).abs() <= tolerance + 1e-9,
            "{lost} for {hold_s} s"
        );
        assert!(rig.ends().is_empty());
    }
}

#[test]
fn a_time_out_costs_loops_by_the_time_to_the_next_session() {
    for (restart_s, expected, tolerance) in
        [(1.0, 0.015, 0.02), (2.0, 0.57, 0.08), (3.0, 1.0, 0.03)]
    {
        let settings = ControllerSettings {
            comm_timeout_s: 1.0,
            restart: RestartPolicy::WaitThenRestart,
            activation_s: 0.5,
            restart_wait_s: restart_s - 0.5,
            ramp_in_s: 0.1,
            ..open_settings()
        };
        // Gaps spread evenly over 1.05..2 s, in an order that is not the phases'.
        let gap_s = |share: f64| 1.05 + 0.95 * (share * 17.3).fract();
        let (lost, rig) = lost_per_outage(settings, 60, gap_s);
        assert!(
            (lost - expected).abs() <= tolerance,
            "{lost} for {restart_s} s"
        );
        let ends = rig.ends();
        assert_eq!(ends.len(), 60);
        assert!(
            ends.iter()
                .all(|(cause, _)| *cause == EndCause::CommTimeout)
        );
    }
}
