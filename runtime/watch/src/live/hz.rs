//! `channel hz`: how regularly the messages of a channel come, window by window.

use serde::Serialize;

use super::channel::{ChannelError, Said, Scope, by_windows};
use super::cli::WindowArgs;
use super::observer::Observer;
use super::pace::{Pace, PaceMetrics};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::signals::Signals;
use hil_platform::words::counted;
use hil_present::units::{JOINT, duration};
use hil_rundir::live_run::Source;

/// One answer.
#[derive(Debug, Serialize)]
struct Answer<'a> {
    channel: &'a str,
    /// `publication` or `arrival`.
    seen_at: &'a str,
    of: Scope,
    window_s: f64,
    #[serde(flatten)]
    figures: &'a PaceMetrics,
}

pub(super) fn run(
    mut observer: Observer,
    args: &WindowArgs,
    signals: &Signals,
    console: &mut Console,
) -> Result<CommandEnd, ChannelError> {
    let name = observer.channel(&args.which.channel)?.name.clone();
    let seen_at = match observer.source(&name) {
        Some(Source::SharedMemory {
            is_forwarded: true, ..
        }) => "arrival",
        _ => "publication",
    };
    observer.count_unrecorded(&name);
    let mut pace = Pace::default();
    let answer = &mut |observer: &mut Observer, of| {
        for arrival in observer.take_arrivals(&name) {
            pace.take(&arrival);
        }
        let figures = match of {
            Scope::Window => pace.turn(),
            Scope::Total => pace.total(),
        };
        let text = if args.json {
            let answer = Answer {
                channel: &name,
                seen_at,
                of,
                window_s: args.window.as_secs_f64(),
                figures: &figures,
            };
            format!("{}\n", serde_json::to_string(&answer)?)
        } else {
            let of = if of == Scope::Total { "in all  " } else { "" };
            format!("{of}{}\n", words(&name, &figures))
        };
        Ok(Said {
            text,
            message_count: figures.message_count,
        })
    };
    let (kept, nothing) = (args.window, "no message came");
    by_windows(observer, args, kept, nothing, signals, console, answer)
}

/// The figures on one line.
fn words(channel: &str, figures: &PaceMetrics) -> String {
    let count = counted(figures.message_count, "message");
    let mut parts = vec![channel.to_owned(), count];
    if let (Some(rate_hz), Some(gap)) = (figures.rate_hz, &figures.gap) {
        let [min, p99, max] = [gap.min_ns, gap.p99_ns, gap.max_ns].map(duration);
        let mean = rounded(gap.mean_ns);
        parts.push(format!("{rate_hz:.2} Hz"));
        parts.push(format!("gaps {min} to {max}, mean {mean}, p99 {p99}"));
        parts.push(format!("jitter {}", rounded(gap.jitter_ns)));
    }
    parts.push(format!("missed {}", figures.missed_count));
    for (count, what) in [
        (figures.reordered_count, "out of order"),
        (figures.restart_count, "restarts"),
    ] {
        if count > 0 {
            parts.push(format!("{count} {what}"));
        }
    }
    parts.join("  ").replace(JOINT, " ")
}

#[allow(
    clippy::cast_possible_truncation,
    reason = "gaps are far below 292 years; beyond, the conversion saturates"
)]
fn rounded(ns: f64) -> String {
    duration(ns.round() as i64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::pace::GapMetrics;

    #[test]
    fn a_line_says_what_is_known_and_no_more() {
        let mut figures = PaceMetrics {
            message_count: 1_250,
            rate_hz: Some(250.0),
            gap: Some(GapMetrics {
                min_ns: 3_900_000,
                mean_ns: 4e6,
                p99_ns: 4_100_000,
                max_ns: 8_200_000,
                jitter_ns: 45_678.0,
            }),
            missed_count: 2,
            reordered_count: 0,
            restart_count: 1,
        };
        assert_eq!(
            words("x/command", &figures),
            "x/command  1,250 messages  250.00 Hz  gaps 3.90 ms to 8.20 ms, mean 4.00 ms, \
             p99 4.10 ms  jitter 45.7 µs  missed 2  1 restarts"
        );
        figures.rate_hz = None;
        figures.gap = None;
        assert_eq!(
            words("x", &figures),
            "x  1,250 messages  missed 2  1 restarts"
        );
    }
}
