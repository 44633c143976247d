//! Who sees to it that a recorder which gives way does not wait for a processor for ever: a thread of
//! normal weight, which sleeps but for a few looks a second at how the kernel counts the wait of the
//! thread that looks at the run. That thread cannot say so itself before it runs.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use hil_runtime::platform::realtime::SchedulingPolicy;

use super::{Precedence, own};

/// Looks of the watcher within the longest wait that is allowed: so much later than that it notices.
const LOOKS_PER_WAIT: u32 = 2;
/// What is read of a file of `/proc` at most; what matters stands at its beginning.
const READ_BYTES: usize = 256;

/// The looks of one thread, each judged by how long it was kept waiting for a processor. Use it in
/// the thread that looks.
#[derive(Debug)]
pub(crate) struct Looks {
    late_max: Duration,
    precedence: Precedence,
    /// `None` where the kernel does not tell, or nothing ever gives way.
    watched: Option<Watched>,
}

#[derive(Debug)]
struct Watched {
    schedstat: File,
    shared: Arc<Shared>,
    watcher: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    /// How long the thread had waited in all when it last looked, nanoseconds.
    waited_ns: AtomicU64,
    is_over: AtomicBool,
}

impl Looks {
    /// Between two looks of the calling thread it may wait for `late_max`. To be called before
    /// anything gives way, or the watcher has to wait for its first turn as all others.
    pub(crate) fn begin(late_max: Duration, precedence: &Precedence) -> Self {
        let may_give_way = precedence.may_give_way();
        let watched = may_give_way.then(|| Watched::begin(late_max, precedence));
        Self {
            late_max,
            precedence: precedence.clone(),
            watched: watched.and_then(Result::ok),
        }
    }

    /// Judges the time since the look before: nothing but a lack of processor time counts, neither
    /// a slow disk nor a stopped terminal.
    pub(crate) fn judge(&mut self) {
        let Some(watched) = &self.watched else { return };
        let Some(counted) = Counted::read(&watched.schedstat) else {
            return;
        };
        let before = &watched.shared.waited_ns;
        let before_ns = before.swap(nanoseconds(counted.waited), Ordering::Relaxed);
        let late = counted
            .waited
            .saturating_sub(Duration::from_nanos(before_ns));
        if late > self.late_max {
            self.precedence.raise(late);
        }
    }
}

impl Watched {
    fn begin(late_max: Duration, precedence: &Precedence) -> io::Result<Self> {
        let thread = fs::canonicalize("/proc/thread-self")?;
        let schedstat = File::open(thread.join("schedstat"))?;
        let counted = Counted::read(&schedstat).ok_or(io::ErrorKind::InvalidData)?;
        let shared = Arc::new(Shared::default());
        let waited_ns = nanoseconds(counted.waited);
        shared.waited_ns.store(waited_ns, Ordering::Relaxed);
        let watcher = Watcher::of(&thread, (late_max, precedence), &shared)?;
        let (say, hear) = channel();
        let watcher = thread::Builder::new()
            .name("watcher".to_owned())
            .spawn(move || watcher.run(&say))?;
        // It is to stand by itself before the others are moved.
        let _is_ready = hear.recv().is_ok();
        Ok(Self {
            schedstat,
            shared,
            watcher: Some(watcher),
        })
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        self.shared.is_over.store(true, Ordering::Relaxed);
        if let Some(watcher) = self.watcher.take() {
            watcher.thread().unpark();
            let _has_ended = watcher.join().is_ok();
        }
    }
}

/// Watches over one thread.
struct Watcher {
    schedstat: File,
    stat: File,
    shared: Arc<Shared>,
    precedence: Precedence,
    late_max: Duration,
}

impl Watcher {
    /// For the thread whose folder in `/proc` this is.
    fn of(
        thread: &Path,
        (late_max, precedence): (Duration, &Precedence),
        shared: &Arc<Shared>,
    ) -> io::Result<Self> {
        Ok(Self {
            schedstat: File::open(thread.join("schedstat"))?,
            stat: File::open(thread.join("stat"))?,
            shared: Arc::clone(shared),
            precedence: precedence.clone(),
            late_max,
        })
    }

    /// Looks until told that it is over. Of a policy of its own, it is moved neither with those that
    /// give way nor back, and by waking up it interrupts nobody.
    fn run(self, ready: &Sender<()>) {
        let is_by_itself = own(SchedulingPolicy::Batch).is_ok();
        let _is_heard = ready.send(()).is_ok();
        let period = self.late_max / LOOKS_PER_WAIT;
        let mut waiting = Waiting::default();
        while is_by_itself && !self.shared.is_over.load(Ordering::Relaxed) {
            let since = Instant::now();
            thread::park_timeout(period);
            if !self.precedence.gives_way() {
                waiting = Waiting::default();
                continue;
            }
            let Some(counted) = Counted::read(&self.schedstat) else {
                return;
            };
            // When this thread itself came late, the other may have slept in between.
            let span = since.elapsed().min(period * 2);
            let for_now = waiting.after(span, counted, is_runnable(&self.stat));
            let before_ns = self.shared.waited_ns.load(Ordering::Relaxed);
            let counted = counted
                .waited
                .saturating_sub(Duration::from_nanos(before_ns));
            let late = counted + for_now;
            if late > self.late_max {
                self.precedence.raise(late);
            }
        }
    }
}

/// A wait that has not ended, and so is not counted by the kernel yet.
#[derive(Debug, Default)]
struct Waiting {
    /// What was counted at the last look, if the thread wanted a processor then.
    counted: Option<Counted>,
    length: Duration,
}

impl Waiting {
    /// How long the thread has waited at least, as it stands `span` after the last look: it wanted a
    /// processor then and now, and had none in between.
    fn after(&mut self, span: Duration, counted: Counted, is_runnable: bool) -> Duration {
        let has_waited = is_runnable && self.counted == Some(counted);
        self.length = if has_waited {
            self.length + span
        } else {
            Duration::ZERO
        };
        self.counted = is_runnable.then_some(counted);
        self.length
    }
}

/// What the kernel counted of a thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Counted {
    ran_ns: u64,
    /// How long it could have run and had no processor, up to the last time that it had one.
    waited: Duration,
    turn_count: u64,
}

impl Counted {
    fn read(schedstat: &File) -> Option<Self> {
        let mut bytes = [0; READ_BYTES];
        Self::of(start_of(schedstat, &mut bytes)?)
    }

    /// `schedstat`: time on a processor and on a run queue, nanoseconds, and turns on a processor.
    fn of(schedstat: &str) -> Option<Self> {
        let mut numbers = schedstat.split_whitespace().map(str::parse::<u64>);
        let mut next = || numbers.next()?.ok();
        Some(Self {
            ran_ns: next()?,
            waited: Duration::from_nanos(next()?),
            turn_count: next()?,
        })
    }
}

/// Whether the kernel counts how long the calling thread waits.
pub(super) fn can_tell() -> bool {
    let file = File::open("/proc/thread-self/schedstat").ok();
    file.is_some_and(|file| Counted::read(&file).is_some())
}

/// Whether the thread of this `stat` runs or wants to; one that is stopped does not.
fn is_runnable(stat: &File) -> bool {
    let mut bytes = [0; READ_BYTES];
    start_of(stat, &mut bytes).is_some_and(is_runnable_in)
}

fn is_runnable_in(stat: &str) -> bool {
    // The name before the last bracket may hold anything.
    let state = stat.rsplit_once(')').map(|(_, rest)| rest.trim_start());
    state.is_some_and(|rest| rest.starts_with('R'))
}

/// What a file of `/proc` says now, into memory that is there: a thread without a processor may hold
/// what guards all other memory.
fn start_of<'a>(file: &File, bytes: &'a mut [u8; READ_BYTES]) -> Option<&'a str> {
    let length = file.read_at(bytes, 0).ok()?;
    std::str::from_utf8(&bytes[..length]).ok()
}

fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::super::State;
    use super::*;

    /// As the kernel numbers them.
    const OTHER: u32 = 0;
    const IDLE: u32 = 5;
    /// Short, for a test's sake: what nobody can run past who gives way to busy threads.
    const LATE_MAX: Duration = Duration::from_millis(5);

    const fn counted(ran_ns: u64, waited_ms: u64) -> Counted {
        Counted {
            ran_ns,
            waited: Duration::from_millis(waited_ms),
            turn_count: 7,
        }
    }

    #[test]
    fn the_kernel_tells_how_long_a_thread_waited() {
        assert!(can_tell());
        let read = Counted::of("123 4000000 7\n");
        assert_eq!(read, Some(counted(123, 4)));
        assert_eq!(Counted::of("123 4567"), None);
        assert!(is_runnable_in("7 (a) S) R 1 2"));
        assert!(
            !is_runnable_in("7 (R) S 1 2") && !is_runnable_in("7 (R) T 1") && !is_runnable_in("")
        );
    }

    #[test]
    fn a_wait_is_one_only_while_nothing_is_counted_and_a_processor_is_wanted() {
        let mut waiting = Waiting::default();
        let span = Duration::from_millis(100);
        let mut after = |ran_ns, is_runnable| waiting.after(span, counted(ran_ns, 0), is_runnable);
        // Nobody knows for how long it had waited when it was first seen to.
        assert_eq!(after(1, true), Duration::ZERO);
        assert_eq!(after(1, true), span);
        assert_eq!(after(1, true), span * 2);
        assert_eq!(after(2, true), Duration::ZERO, "it ran");
        assert_eq!(after(2, false), Duration::ZERO, "it sleeps");
        assert_eq!(after(2, true), Duration::ZERO, "it was woken since");
        assert_eq!(after(2, true), span);
    }

    /// The policy of the calling thread, field 41 of its `stat`.
    fn policy() -> u32 {
        let text = fs::read_to_string("/proc/thread-self/stat").unwrap();
        let (_, after_name) = text.rsplit_once(')').unwrap();
        let field = after_name.split_whitespace().nth(38).unwrap();
        field.parse().unwrap()
    }

    /// Runs `what` while normal threads keep every processor busy.
    fn with_busy<T: Send + 'static>(what: impl FnOnce() -> T + Send + 'static) -> T {
        let is_over = AtomicBool::new(false);
        let count = thread::available_parallelism().map_or(8, usize::from);
        thread::scope(|scope| {
            for _ in 0..2 * count {
                scope.spawn(|| {
                    while !is_over.load(Ordering::Relaxed) {
                        core::hint::spin_loop();
                    }
                });
            }
            let joined = thread::spawn(what).join();
            is_over.store(true, Ordering::Relaxed);
            joined.unwrap()
        })
    }

    /// Whether the kernel let it up, and how it and a thread of its own stand then.
    fn raised(precedence: &Precedence, child: JoinHandle<u32>) -> (bool, [u32; 2]) {
        let policies = [policy(), child.join().unwrap()];
        match precedence.lock().clone() {
            State::Raised(waited) => {
                assert!(waited > LATE_MAX, "{waited:?}");
                (true, policies)
            }
            // Without the right to it.
            State::Refused(waited, words) => {
                assert!(
                    waited > LATE_MAX && words.contains("RLIMIT_NICE"),
                    "{words}"
                );
                (false, policies)
            }
            other => panic!("{other:?}"),
        }
    }

    /// A thread beside the calling one, of its policy, which it tells at its end.
    fn child() -> (Sender<()>, JoinHandle<u32>) {
        let (go, wait) = channel::<()>();
        let child = thread::spawn(move || {
            let _is_told = wait.recv().is_ok();
            policy()
        });
        (go, child)
    }

    /// No other test of this program gives way, so no other is moved.
    #[test]
    fn one_that_never_looks_again_is_let_up_by_its_watcher_and_one_that_looks_by_itself() {
        let (by_watcher, by_itself) = with_busy(|| {
            let precedence = Precedence::of(State::GivesWay);
            let looks = Looks::begin(LATE_MAX, &precedence);
            own(SchedulingPolicy::Idle).unwrap();
            let (go, other) = child();
            while precedence.gives_way() {
                core::hint::spin_loop();
            }
            // What the flag says, the watcher is about to do.
            drop(looks);
            drop(go);
            let by_watcher = raised(&precedence, other);
            own(SchedulingPolicy::Idle).unwrap();
            let precedence = Precedence::of(State::Asked);
            let mut looks = Looks::begin(LATE_MAX, &precedence);
            looks.precedence = Precedence::of(State::GivesWay);
            let (go, other) = child();
            // As if all that it ever waited had been since its last look.
            let watched = looks.watched.as_ref().unwrap();
            watched.shared.waited_ns.store(0, Ordering::Relaxed);
            looks.judge();
            drop(go);
            let by_itself = raised(&looks.precedence, other);
            (by_watcher, by_itself)
        });
        for (is_up, policies) in [by_watcher, by_itself] {
            assert_eq!(policies, [if is_up { OTHER } else { IDLE }; 2]);
        }
    }
}
