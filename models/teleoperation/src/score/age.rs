//! How old the reference in use was, and whether it grew older and older: the mark of a queue that
//! never drains.

use crate::score::record::{Feedback, Record};
use hil_arm::egm::messages::EgmFeedback;
use hil_core::score::Metric;
use hil_stats::metric::label;

/// Median, tail and greatest age, and its slope.
pub(crate) fn metrics(record: &Record) -> [Metric; 4] {
    let has_age = |known: &&Feedback| known.is_running() && known.has(EgmFeedback::HAS_REFERENCE);
    let with_age = || record.feedback.iter().filter(has_age);
    let mut ages_ns: Vec<i64> = with_age().map(|known| known.reference_age_ns).collect();
    let missing = "no feedback of a running session with a reference";
    let method = format!(
        "time since the command in use arrived, its wait in the queue included, in {} messages",
        ages_ns.len()
    );
    let age = |name, text, value: Option<i64>| {
        let value_ms = value.map(|age_ns| age_ns as f64 * 1e-6);
        label(name, text, "ms").measured(value_ms, method.clone(), missing)
    };
    let mut quantile = |share: f64| {
        let last = ages_ns.len().checked_sub(1)?;
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a share of a length"
        )]
        let rank = (share * last as f64).round() as usize;
        Some(*ages_ns.select_nth_unstable(rank).1)
    };
    let [median, tail, greatest] = [0.5, 0.99, 1.0].map(&mut quantile);
    let slope = slope_ms_per_s(with_age().filter(|known| !known.has(EgmFeedback::HOLDING)));
    [
        age(
            "reference_age_ms_p50",
            "age of the reference in use, median",
            median,
        ),
        age(
            "reference_age_ms_p99",
            "age of the reference in use, 99 %",
            tail,
        ),
        age(
            "reference_age_ms_max",
            "age of the reference in use, greatest",
            greatest,
        ),
        label(
            "reference_age_ms_per_s",
            "growth of the reference's age",
            "ms/s",
        )
        .measured(
            slope,
            "least squares within each session, holds left out; above zero the queue grows for \
             ever",
            "no session long enough for a slope",
        ),
    ]
}

/// Shortest time over which a slope means anything.
const SLOPE_SPAN_MIN_NS: i64 = 1_000_000_000;

/// One slope for all sessions, each with a level of its own.
fn slope_ms_per_s<'a>(feedback: impl Iterator<Item = &'a Feedback>) -> Option<f64> {
    let (mut moment, mut square) = (0.0, 0.0);
    let mut session: Option<Line> = None;
    let mut close = |line: Option<Line>| {
        if let Some(line) = line.filter(|line| line.newest_ns >= SLOPE_SPAN_MIN_NS) {
            moment += line.moment;
            square += line.square;
        }
    };
    for known in feedback {
        if session
            .as_ref()
            .is_none_or(|line| line.session != known.session)
        {
            close(session.take());
            session = Some(Line {
                session: known.session,
                begin_ns: known.at_ns,
                ..Line::default()
            });
        }
        if let Some(line) = &mut session {
            line.add(known.at_ns, known.reference_age_ns);
        }
    }
    close(session);
    (square > 0.0).then(|| moment / square)
}

/// Sums about the means of one session, by Welford's update.
#[derive(Debug, Default)]
struct Line {
    session: u32,
    begin_ns: i64,
    newest_ns: i64,
    count: f64,
    time_mean_s: f64,
    age_mean_ms: f64,
    moment: f64,
    square: f64,
}

impl Line {
    fn add(&mut self, at_ns: i64, age_ns: i64) {
        self.newest_ns = at_ns - self.begin_ns;
        let (time_s, age) = (self.newest_ns as f64 * 1e-9, age_ns as f64 * 1e-6);
        self.count += 1.0;
        let time_off = time_s - self.time_mean_s;
        self.time_mean_s += time_off / self.count;
        self.age_mean_ms += (age - self.age_mean_ms) / self.count;
        self.moment += time_off * (age - self.age_mean_ms);
        self.square += time_off * (time_s - self.time_mean_s);
    }
}
