//! How far the cart went, and by how much it missed its commands, from the messages of a run.

use hil_core::case_study::{ErrorSeries, Metric, Score};
use hil_core::interval::Spread;
use hil_core::run_log::RunLog;
use hil_core::time::Instant;
use hil_stats::series::Estimate;
use hil_stats::special::ceil_count;

use crate::{HALF_WAVE_S, ShuttleCommand, ShuttleStatus};

/// By how much the cart missed what was commanded.
pub(crate) fn errors(log: &RunLog) -> Vec<ErrorSeries> {
    // Stamps of two clocks cannot be told apart from an error.
    if log.has_one_clock() {
        vec![speed_error(log)]
    } else {
        Vec::new()
    }
}

/// How far the cart went.
pub(crate) fn score(log: &RunLog) -> Score {
    let command_count = log.messages::<ShuttleCommand>("shuttle/command").count();
    let travel = travel(log);
    Score {
        metrics: vec![Metric {
            name: "travelled_m",
            label: "distance travelled",
            value: travel.map(|travel| travel.whole_m),
            interval: travel.map(|travel| travel.interval),
            unit: "m",
            method: format!(
                "sum of status steps; {command_count} commands sent; interval from the half waves of the run"
            ),
        }],
        ..Score::default()
    }
}

/// By how much the cart's speed from status to status misses the newest command sent by the former:
/// what a command that comes later than a period, or not at all, leaves undone.
fn speed_error(log: &RunLog) -> ErrorSeries {
    let mut commands = log.messages::<ShuttleCommand>("shuttle/command").peekable();
    let mut newest: Option<ShuttleCommand> = None;
    let mut before: Option<(Instant, f64)> = None;
    let mut samples = Vec::new();
    for (at, status) in log.messages::<ShuttleStatus>("shuttle/status") {
        let passed_s = before.map_or(0.0, |before| at.seconds_since(before.0));
        if let (Some(command), Some((_, from_m))) = (newest, before)
            && passed_s > 0.0
        {
            let driven_mps = (status.position_m - from_m) / passed_s;
            samples.push((at, (command.speed_mps - driven_mps).abs()));
        }
        while let Some((_, command)) = commands.next_if(|next| next.0 <= at) {
            newest = Some(command);
        }
        before = Some((at, status.position_m));
    }
    ErrorSeries {
        label: "error of the cart's speed",
        unit: "m/s",
        clock_of: "shuttle/status",
        samples,
    }
}

/// How far the cart went.
#[derive(Debug, Clone, Copy)]
struct Travel {
    whole_m: f64,
    interval: Spread,
}

/// The whole way, and what the scatter of the half waves says of it; `None` without a status.
fn travel(log: &RunLog) -> Option<Travel> {
    let mut statuses = log.messages::<ShuttleStatus>("shuttle/status");
    let first = statuses.next()?;
    let start = first.0;
    let mut last = first;
    let (mut blocks, mut whole_m): (Vec<f64>, f64) = (Vec::new(), 0.0);
    for after in statuses {
        let before = core::mem::replace(&mut last, after);
        let step_m = (after.1.position_m - before.1.position_m).abs();
        whole_m += step_m;
        let half_waves = before.0.seconds_since(start) / HALF_WAVE_S;
        let index = ceil_count(half_waves.floor());
        if blocks.len() <= index {
            blocks.resize(index + 1, 0.0);
        }
        blocks[index] += step_m;
    }
    // The cart rests at the end of a half wave, so one that is all but over counts as whole.
    let half_waves = (last.0.seconds_since(start) / HALF_WAVE_S).round();
    blocks.truncate(ceil_count(half_waves));
    let mean = Estimate::of_mean(&blocks)?;
    Some(Travel {
        whole_m,
        interval: mean
            .interval
            .map(|end| whole_m + (end - mean.value) * half_waves),
    })
}
