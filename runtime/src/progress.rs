//! One line that says how far a long piece of work is: share, time passed, time left. Every command
//! that can take more than a moment says it in this form.

use std::time::{Duration, Instant};

use crate::console::Console;

/// Work that is done within this time needs no word on how far it is.
const SILENCE: Duration = Duration::from_secs(1);
/// Below this share an estimate of the time left would only be noise.
const SHARE_MIN: f64 = 0.01;

/// Work that was begun.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    since: Instant,
}

impl Progress {
    /// Work that begins now.
    pub fn begin() -> Self {
        let since = Instant::now();
        Self { since }
    }

    /// Shows that `share` of the work is done, 0 to 1, or an unknown part of it; `words` say what is
    /// being done.
    pub fn show(&self, console: &mut Console, share: Option<f64>, words: &str) {
        let elapsed = self.since.elapsed();
        if elapsed >= SILENCE {
            console.progress(&line(share, elapsed, words));
        }
    }
}

/// ` 42 %  0:13, about 0:18 left  words`.
pub(crate) fn line(share: Option<f64>, elapsed: Duration, words: &str) -> String {
    let elapsed_s = elapsed.as_secs_f64();
    let passed = clock_text(elapsed_s);
    let Some(share) = share.map(|share| share.clamp(0.0, 1.0)) else {
        return format!("{passed}  {words}");
    };
    let left = if share >= SHARE_MIN {
        let left_s = elapsed_s * (1.0 - share) / share;
        format!(", about {} left", clock_text(left_s))
    } else {
        String::new()
    };
    format!("{:3.0} %  {passed}{left}  {words}", 100.0 * share)
}

/// Seconds as `m:ss`.
fn clock_text(seconds: f64) -> String {
    format!(
        "{:.0}:{:02.0}",
        (seconds / 60.0).floor(),
        (seconds % 60.0).floor()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_are_minutes_and_seconds() {
        assert_eq!(clock_text(0.0), "0:00");
        assert_eq!(clock_text(59.9), "0:59");
        assert_eq!(clock_text(754.0), "12:34");
    }

    #[test]
    fn a_line_has_the_time_left_once_it_means_something() {
        let after = |share, seconds| line(share, Duration::from_secs(seconds), "reading");
        assert_eq!(
            after(Some(0.25), 30),
            " 25 %  0:30, about 1:30 left  reading"
        );
        assert_eq!(after(Some(0.001), 30), "  0 %  0:30  reading");
        assert_eq!(after(Some(1.5), 3), "100 %  0:03, about 0:00 left  reading");
        assert_eq!(after(None, 61), "1:01  reading");
    }
}
