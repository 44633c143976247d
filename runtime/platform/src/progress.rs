//! One line that says how far a long piece of work is: share, time passed, time left. Every command
//! that can take more than a moment says it in this form.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use crate::console::Console;

/// Work that is done within this time needs no word on how far it is.
const SILENCE: Duration = Duration::from_secs(1);
/// How often the line of work in one piece is drawn.
const PERIOD: Duration = Duration::from_millis(250);
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

    /// Does `work` and shows meanwhile how far it is, however seldom it says so itself. The line goes
    /// when the work is done.
    pub fn during<T>(
        &self,
        console: &mut Console,
        words: &str,
        work: impl FnOnce(&Stage) -> T,
    ) -> T {
        let stage = Stage::new(words);
        thread::scope(|scope| {
            // It only draws lines; where no thread can be had, the work is done without them.
            let drawn = thread::Builder::new()
                .name("progress".to_owned())
                .spawn_scoped(scope, || self.show_until_over(&stage, console));
            let done = {
                let _over = OverOnDrop(&stage);
                work(&stage)
            };
            drop(drawn);
            done
        })
    }

    fn show_until_over(&self, stage: &Stage, console: &mut Console) {
        while let Some((share, words)) = stage.after(PERIOD) {
            self.show(console, share, &words);
        }
        console.end_progress();
    }
}

/// How far a piece of work is, as it says itself.
#[derive(Debug)]
pub struct Stage {
    standing: Mutex<Standing>,
    ended: Condvar,
}

#[derive(Debug)]
struct Standing {
    share: Option<f64>,
    words: String,
    is_over: bool,
}

impl Stage {
    fn new(words: &str) -> Self {
        let standing = Standing {
            share: None,
            words: words.to_owned(),
            is_over: false,
        };
        Self {
            standing: Mutex::new(standing),
            ended: Condvar::new(),
        }
    }

    /// `share` of the work is done, 0 to 1.
    pub fn reach(&self, share: f64) {
        self.standing().share = Some(share);
    }

    /// What is being done from now on, and the share that is done, where it is known.
    pub fn tell(&self, share: Option<f64>, words: &str) {
        let mut standing = self.standing();
        standing.share = share;
        words.clone_into(&mut standing.words);
    }

    /// How it stands in `period`; `None` as soon as the work is over.
    fn after(&self, period: Duration) -> Option<(Option<f64>, String)> {
        let is_going = |standing: &mut Standing| !standing.is_over;
        let waited = self
            .ended
            .wait_timeout_while(self.standing(), period, is_going);
        let standing = waited.unwrap_or_else(PoisonError::into_inner).0;
        (!standing.is_over).then(|| (standing.share, standing.words.clone()))
    }

    fn standing(&self) -> MutexGuard<'_, Standing> {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Ends the line even where the work panics: its thread is waited for.
struct OverOnDrop<'a>(&'a Stage);

impl Drop for OverOnDrop<'_> {
    fn drop(&mut self) {
        self.0.standing().is_over = true;
        self.0.ended.notify_all();
    }
}

/// ` 42 %  0:13, about 0:18 left  words`.
pub fn line(share: Option<f64>, elapsed: Duration, words: &str) -> String {
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
    fn work_in_one_piece_says_how_far_it_is_and_gives_its_result() {
        let mut console = Console::new(true);
        let progress = Progress::begin();
        let done = progress.during(&mut console, "reading", |stage| {
            stage.reach(0.5);
            let standing = stage.standing();
            assert_eq!(
                (standing.share, standing.words.as_str()),
                (Some(0.5), "reading")
            );
            drop(standing);
            stage.tell(None, "drawing");
            assert_eq!(stage.standing().words, "drawing");
            assert_eq!(stage.standing().share, None);
            7
        });
        assert_eq!(done, 7);
    }

    #[test]
    fn work_that_panics_leaves_no_thread_waiting() {
        let mut console = Console::new(true);
        let outcome = std::panic::catch_unwind(core::panic::AssertUnwindSafe(|| {
            Progress::begin().during(&mut console, "reading", |_| panic!("wanted by this test"));
        }));
        assert!(outcome.is_err());
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
