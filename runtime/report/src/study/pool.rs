//! Threads that take the tasks of a study one after the other, and the progress line above them.
//! Which thread runs which task is chance; nothing that is reported depends on it.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread;
use std::time::{Duration, Instant};

use hil_core::study::{Batch, TaskOutcome};

use crate::study::Cost;
use hil_platform::console::Console;
use hil_platform::progress::line;
use hil_platform::signals::Signals;

/// How often the progress line and the user's wish to end are looked at.
const LOOK_PERIOD: Duration = Duration::from_millis(200);
/// Parts per this of a task are what a thread notes as done.
const SHARE_UNIT: f64 = 1_000_000.0;

/// The threads' common ground.
#[derive(Debug)]
pub(super) struct Pool<'a> {
    batch: &'a dyn Batch,
    next_task: AtomicUsize,
    is_stopping: AtomicBool,
    workers: Vec<Worker>,
}

/// What one thread is at.
#[derive(Debug)]
struct Worker {
    task: AtomicUsize,
    share: AtomicU64,
}

impl<'a> Pool<'a> {
    /// A pool of `jobs` threads, none of them started.
    pub(super) fn new(batch: &'a dyn Batch, jobs: usize) -> Self {
        let worker = |_| Worker {
            task: AtomicUsize::new(usize::MAX),
            share: AtomicU64::new(0),
        };
        Self {
            batch,
            next_task: AtomicUsize::new(0),
            is_stopping: AtomicBool::new(false),
            workers: (0..jobs).map(worker).collect(),
        }
    }

    /// Runs the tasks; gives their outcomes in task order.
    pub(super) fn run(
        &self,
        signals: &Signals,
        console: &mut Console,
    ) -> (Vec<Option<TaskOutcome>>, Cost) {
        let task_count = self.batch.task_count();
        let begun = Instant::now();
        let mut outcomes: Vec<_> = (0..task_count).map(|_| None).collect();
        let mut ended_count = 0;
        thread::scope(|scope| {
            let (sender, receiver) = mpsc::channel();
            for worker in &self.workers {
                let sender = sender.clone();
                scope.spawn(move || self.work(worker, &sender));
            }
            drop(sender);
            loop {
                match receiver.recv_timeout(LOOK_PERIOD) {
                    Ok((task, outcome)) => {
                        ended_count += usize::from(Option::is_some(&outcome));
                        outcomes[task] = outcome;
                    }
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => break,
                }
                if signals.received().is_some() {
                    self.is_stopping.store(true, Ordering::Relaxed);
                }
                console.progress(&self.progress(ended_count, begun.elapsed()));
            }
        });
        let cost = Cost {
            wall: begun.elapsed(),
            jobs: self.workers.len(),
            task_count,
            ended_count,
        };
        (outcomes, cost)
    }

    fn work(&self, worker: &Worker, sender: &Sender<(usize, Option<TaskOutcome>)>) {
        while !self.is_stopping.load(Ordering::Relaxed) {
            let task = self.next_task.fetch_add(1, Ordering::Relaxed);
            if task >= self.batch.task_count() {
                break;
            }
            worker.share.store(0, Ordering::Relaxed);
            worker.task.store(task, Ordering::Relaxed);
            let outcome = self.batch.run(task, &mut |share| {
                worker.share.store(parts(share), Ordering::Relaxed);
                !self.is_stopping.load(Ordering::Relaxed)
            });
            worker.task.store(usize::MAX, Ordering::Relaxed);
            if sender.send((task, outcome)).is_err() {
                break;
            }
        }
        worker.task.store(usize::MAX, Ordering::Relaxed);
    }

    fn progress(&self, ended_count: usize, elapsed: Duration) -> String {
        let running = self.workers.iter().filter_map(|worker| {
            let task = worker.task.load(Ordering::Relaxed);
            (task != usize::MAX).then(|| (task, worker.share.load(Ordering::Relaxed) as f64))
        });
        let (mut done, mut labels) = (ended_count as f64, Vec::new());
        for (task, share) in running {
            done += share / SHARE_UNIT;
            labels.push(self.batch.label(task));
        }
        let share = (done / self.batch.task_count().max(1) as f64).min(1.0);
        line(Some(share), elapsed, &labels.join(" | "))
    }
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a share of 0..=1 in parts per million"
)]
fn parts(share: f64) -> u64 {
    (share.clamp(0.0, 1.0) * SHARE_UNIT) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_core::study::{Cell, Study, StudyReport, Table, Watch, into_batch};

    /// Task n gives n squared, in a time that has nothing to do with n.
    #[derive(Debug)]
    struct Squares;

    impl Study for Squares {
        type Outcome = u64;

        fn task_count(&self) -> usize {
            100
        }

        fn label(&self, task: usize) -> String {
            task.to_string()
        }

        fn run(&self, task: usize, watch: Watch<'_>) -> Option<u64> {
            for turn in 0..(task * 7919) % 97 {
                if !watch(turn as f64 / 97.0) {
                    return None;
                }
            }
            Some((task * task) as u64)
        }

        fn report(&self, outcomes: &[Option<&u64>]) -> StudyReport {
            let rows = outcomes
                .iter()
                .map(|outcome| vec![outcome.map_or(Cell::Absent, |square| Cell::Count(*square))])
                .collect();
            StudyReport {
                tables: vec![Table {
                    rows,
                    ..Table::default()
                }],
                ..StudyReport::default()
            }
        }
    }

    fn report_with(jobs: usize) -> StudyReport {
        let batch = into_batch(Squares);
        let signals = Signals::install().unwrap();
        let (outcomes, cost) =
            Pool::new(batch.as_ref(), jobs).run(&signals, &mut Console::new(true));
        assert_eq!(
            (cost.ended_count, cost.task_count, cost.jobs),
            (100, 100, jobs)
        );
        batch.report(&outcomes)
    }

    #[test]
    fn the_report_does_not_depend_on_the_number_of_threads() {
        let one = report_with(1);
        assert_eq!(one.tables[0].rows[9], [Cell::Count(81)]);
        assert_eq!(one, report_with(2));
        assert_eq!(one, report_with(7));
    }

    #[test]
    fn a_stopped_pool_begins_no_further_task() {
        let batch = into_batch(Squares);
        let pool = Pool::new(batch.as_ref(), 2);
        pool.is_stopping.store(true, Ordering::Relaxed);
        let signals = Signals::install().unwrap();
        let (outcomes, cost) = pool.run(&signals, &mut Console::new(true));
        assert_eq!(cost.ended_count, 0);
        assert!(outcomes.iter().all(Option::is_none));
    }
}
