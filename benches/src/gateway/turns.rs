//! Whose turn it is: the near thread picks a case, the far thread answers it and sleeps between
//! cases. It times nothing but the round trips of [`ping`].

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::{self, Thread};
use std::time::{Duration, Instant};

use hil_platform::clock::{MonotonicClock, Wake};

use super::parties::{Party, Used};
use super::side::Side;

/// Nobody's turn.
pub const IDLE: usize = usize::MAX;
/// The far thread ends.
pub const STOP: usize = usize::MAX - 1;
/// The cache line's turn.
pub const FLOOR: usize = usize::MAX - 2;

/// Round trips that warm the caches and do not count.
const WARM_UP: usize = 200;
/// Messages that teach a hybrid listener the period and do not count.
const PACE_WARM_UP: u64 = 20;
/// Before a case that keeps a pace.
const PACE_REST: Duration = Duration::from_millis(30);
/// A message that has not come back by then never will.
const PATIENCE: Duration = Duration::from_millis(100);
/// Samples of one slice at most.
const SAMPLES_MAX: usize = 1 << 18;
/// Looks without a message between two looks at the clock.
const LOOKS: u32 = 4096;

/// What both threads of a bench see.
#[derive(Debug)]
pub struct Turns {
    turn: AtomicUsize,
    floor: CacheLine,
    lost: AtomicU64,
}

/// One cache line that both threads write in turn, odd by the near one.
#[derive(Debug, Default)]
#[repr(align(128))]
struct CacheLine(AtomicU64);

impl Default for Turns {
    fn default() -> Self {
        Self {
            turn: AtomicUsize::new(IDLE),
            floor: CacheLine::default(),
            lost: AtomicU64::new(0),
        }
    }
}

impl Turns {
    /// Whose turn it is.
    pub fn now(&self) -> usize {
        self.turn.load(Ordering::Acquire)
    }

    /// Gives the turn to `case` and wakes who answers it.
    pub fn give(&self, case: usize, answering: &[Thread]) {
        self.turn.store(case, Ordering::Release);
        answering.iter().for_each(Thread::unpark);
    }

    /// Messages that did not come back.
    pub fn lost_count(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// The far thread's part of the floor: answers once if there is something to answer.
    pub fn answer_floor(&self) {
        let count = self.floor.0.load(Ordering::Acquire);
        if count % 2 == 1 {
            self.floor.0.store(count + 1, Ordering::Release);
        }
    }

    /// The near thread's part of the floor: round trips of one cache line for `slice`.
    pub fn floor(&self, far: &Thread, slice: Duration) -> Vec<u64> {
        self.give(FLOOR, core::slice::from_ref(far));
        let samples = sample(slice, || {
            let count = self.floor.0.load(Ordering::Relaxed) + 1;
            self.floor.0.store(count, Ordering::Release);
            while self.floor.0.load(Ordering::Acquire) == count {
                core::hint::spin_loop();
            }
            Some(0)
        });
        self.turn.store(IDLE, Ordering::Release);
        samples.whole
    }
}

/// The far thread's life: answers whatever case has its turn.
pub fn answer(turns: &Turns, sides: &mut [&mut dyn Side]) {
    loop {
        match turns.now() {
            STOP => return,
            FLOOR => turns.answer_floor(),
            case if case < sides.len() => {
                let side = &mut *sides[case];
                if let Some(count) = side.receive() {
                    side.send(count);
                }
            }
            // Unparking a thread that is not parked yet lets its next park return at once.
            _ => thread::park(),
        }
    }
}

/// What [`ping`] found, in nanoseconds.
#[derive(Debug, Default)]
pub struct RoundTrips {
    /// From before a message is put to after its answer is taken.
    pub whole: Vec<u64>,
    /// The same less what the applications took to put and take.
    pub between_gateways: Vec<u64>,
}

/// Round trips of `side` for `slice` while the far thread answers `case`.
pub fn ping(
    turns: &Turns,
    far: &Thread,
    case: usize,
    side: &mut dyn Side,
    count: &mut u64,
    slice: Duration,
) -> RoundTrips {
    // Lets ordinary work have the processors before they are taken for a slice.
    thread::sleep(Duration::from_millis(3));
    turns.give(case, core::slice::from_ref(far));
    let found = sample(slice, || {
        *count += 1;
        side.send(*count);
        let has_come = await_answer(side, *count);
        turns
            .lost
            .fetch_add(u64::from(!has_come), Ordering::Relaxed);
        has_come.then(|| side.applications_ns())
    });
    turns.turn.store(IDLE, Ordering::Release);
    // Wakes the far thread if it sleeps for a message; its answer is an old one to the next round.
    *count += 1;
    side.send(*count);
    found
}

fn await_answer(side: &mut dyn Side, count: u64) -> bool {
    let looks_per_clock = if side.sleeps() { 1 } else { LOOKS };
    let started = Instant::now();
    for look in 1_u32.. {
        if side.receive() == Some(count) {
            return true;
        }
        if look % looks_per_clock == 0 && started.elapsed() > PATIENCE {
            return false;
        }
    }
    false
}

/// Times `round_trip` again and again; it gives what of its time was the applications', or `None`
/// when it does not count.
fn sample(slice: Duration, mut round_trip: impl FnMut() -> Option<u64>) -> RoundTrips {
    let mut found = RoundTrips {
        whole: Vec::with_capacity(SAMPLES_MAX),
        between_gateways: Vec::with_capacity(SAMPLES_MAX),
    };
    for _ in 0..WARM_UP {
        round_trip();
    }
    let started = Instant::now();
    while started.elapsed() < slice && found.whole.len() < SAMPLES_MAX {
        let sent = Instant::now();
        let of_applications = round_trip();
        let elapsed = sent.elapsed().as_nanos();
        if let Some(of_applications) = of_applications {
            let whole = u64::try_from(elapsed).unwrap_or(u64::MAX);
            found.whole.push(whole);
            found
                .between_gateways
                .push(whole.saturating_sub(of_applications));
        }
    }
    found
}

/// Sends a message every `period` for `slice` while the far thread listens as `case`, after a
/// while in which it learns the period; gives what the far thread used.
pub fn pace(
    turns: &Turns,
    far: &Thread,
    case: usize,
    side: &mut dyn Side,
    slice: Duration,
    period: Duration,
    listening: &Party,
    noted: &Mutex<Vec<u64>>,
) -> (Vec<u64>, [Used; 2]) {
    // A case that spun has starved ordinary work, and the kernel pays that back.
    thread::sleep(PACE_REST);
    turns.give(case, core::slice::from_ref(far));
    let mut due = MonotonicClock::now();
    let mut tick = |side: &mut dyn Side, count| {
        due = due + period;
        while MonotonicClock::sleep_until(due) == Wake::Interrupted {}
        side.send(count);
    };
    let fetch = || core::mem::take(&mut *noted.lock().unwrap_or_else(PoisonError::into_inner));
    (0..PACE_WARM_UP).for_each(|count| tick(side, count));
    drop(fetch());
    let before = listening.used();
    let started = Instant::now();
    let mut count = PACE_WARM_UP;
    while started.elapsed() < slice {
        tick(side, count);
        count += 1;
    }
    let used = [before, listening.used()];
    turns.turn.store(IDLE, Ordering::Release);
    tick(side, count);
    (fetch(), used)
}
