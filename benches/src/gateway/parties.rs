//! What a thread cost the machine: processor time and how often it slept, from `/proc`. Where the
//! kernel does not tell, the figure is unavailable.

use std::fs;
use std::time::{Duration, Instant};

use hil_platform::realtime::{self, RealtimeRequest, SchedulingPolicy};
use nix::unistd::gettid;

/// Real-time priority that benches ask for: above ordinary work, below interrupt threads.
pub const PRIORITY: u8 = 40;

/// Pins the calling thread and asks for [`PRIORITY`]; gives what was refused, in words.
pub fn claim(cpu: usize) -> Vec<String> {
    let grant = realtime::apply(&RealtimeRequest {
        cpu: Some(cpu),
        policy: SchedulingPolicy::Fifo { priority: PRIORITY },
        lock_memory: false,
        timer_slack: Some(Duration::from_nanos(1)),
    });
    let refusals = grant.refusals();
    refusals
        .map(|item| format!("{:?}: {:?}", item.item, item.outcome))
        .collect()
}

/// Processor time of the whole machine so far, in clock ticks (`proc(5)`, `stat`).
#[derive(Debug, Clone, Copy)]
pub struct MachineTime {
    all: u64,
    stolen: u64,
}

impl MachineTime {
    /// Reads it; `None` where the kernel does not tell.
    pub fn read() -> Option<Self> {
        let text = fs::read_to_string("/proc/stat").ok()?;
        let fields = text
            .lines()
            .next()?
            .strip_prefix("cpu ")?
            .split_whitespace();
        // User, nice, system, idle, waiting, two kinds of interrupts, stolen; guests are in user.
        let ticks: Option<Vec<u64>> = fields.take(8).map(|field| field.parse().ok()).collect();
        let ticks = ticks?;
        Some(Self {
            all: ticks.iter().sum(),
            stolen: *ticks.get(7)?,
        })
    }

    /// Share of the time since `earlier` in which the hypervisor kept a processor from running.
    pub fn stolen_since(&self, earlier: &Self) -> f64 {
        let all = self.all.saturating_sub(earlier.all).max(1);
        self.stolen.saturating_sub(earlier.stolen) as f64 / all as f64
    }
}

/// In words, how much was stolen between two readings; above a few per cent no tail means much.
pub fn stolen_text(before: Option<MachineTime>, after: Option<MachineTime>) -> String {
    match before.zip(after) {
        Some((before, after)) => {
            let share = 100.0 * after.stolen_since(&before);
            format!("stolen by the hypervisor while measuring: {share:.1} %")
        }
        None => "stolen by the hypervisor while measuring: unavailable".to_owned(),
    }
}

/// One thread of a case.
#[derive(Debug, Clone)]
pub struct Party {
    /// What it is, for the table.
    pub name: &'static str,
    task: i32,
}

/// What a thread has used so far.
#[derive(Debug, Clone, Copy)]
pub struct Used {
    at: Instant,
    processor_ns: Option<u64>,
    sleep_count: Option<u64>,
}

/// What a thread used over some slices.
#[derive(Debug, Clone, Copy, Default)]
pub struct Usage {
    /// Time that passed.
    pub elapsed_ns: u64,
    /// Processor time used in it.
    pub processor_ns: u64,
    /// How often it went to sleep in it, and so was woken.
    pub sleep_count: u64,
    /// Slices for which the kernel did not tell.
    pub unknown_count: u64,
}

impl Party {
    /// The calling thread.
    pub fn myself(name: &'static str) -> Self {
        Self {
            name,
            task: gettid().as_raw(),
        }
    }

    /// What it has used so far; any thread of the process may ask.
    pub fn used(&self) -> Used {
        let read =
            |file: &str| fs::read_to_string(format!("/proc/self/task/{}/{file}", self.task)).ok();
        let processor_ns = read("schedstat").and_then(|text| {
            text.split_whitespace()
                .next()
                .and_then(|word| word.parse().ok())
        });
        let sleep_count = read("status").and_then(|text| {
            let line = text
                .lines()
                .find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
            line.trim().parse().ok()
        });
        Used {
            at: Instant::now(),
            processor_ns,
            sleep_count,
        }
    }
}

impl Usage {
    /// Adds what was used between two readings.
    pub fn add(&mut self, before: Used, after: Used) {
        let known = (
            before.processor_ns.zip(after.processor_ns),
            before.sleep_count.zip(after.sleep_count),
        );
        let (Some(processor), Some(sleeps)) = known else {
            self.unknown_count += 1;
            return;
        };
        let elapsed = (after.at - before.at).as_nanos();
        self.elapsed_ns += u64::try_from(elapsed).unwrap_or(u64::MAX);
        self.processor_ns += processor.1.saturating_sub(processor.0);
        self.sleep_count += sleeps.1.saturating_sub(sleeps.0);
    }

    /// Share of one processor; `None` where the kernel does not tell.
    pub fn share(&self) -> Option<f64> {
        (self.elapsed_ns > 0).then(|| self.processor_ns as f64 / self.elapsed_ns as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_busy_thread_uses_its_processor_and_a_sleeping_one_sleeps() {
        let party = Party::myself("test");
        let before = party.used();
        let started = Instant::now();
        while started.elapsed() < Duration::from_millis(20) {}
        std::thread::sleep(Duration::from_millis(1));
        let mut usage = Usage::default();
        usage.add(before, party.used());
        if usage.unknown_count == 0 {
            assert!(usage.processor_ns > 0 && usage.sleep_count > 0, "{usage:?}");
            assert!(usage.share().is_some_and(|share| share <= 1.5));
        }
    }
}
