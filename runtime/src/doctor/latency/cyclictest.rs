//! The field's own tool on the same CPUs, so that two methods stand beside each other. It runs the
//! program and reads its histogram; it does not install it.

use std::io::{self, Read};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::{LOOK_PERIOD, LatencyRequest};
use crate::platform::host_facts::{Fact, format_cpu_list};

/// Bins of a microsecond each; what is longer is counted as one.
const BIN_COUNT: usize = 20_000;
/// Start and end of the program, beside the time it measures.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longer than any answer.
const ANSWER_BYTES_MAX: u64 = 64 << 20;

/// What `cyclictest` says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CyclictestReport {
    /// How it was started.
    pub command: String,
    /// One per thread.
    pub threads: Vec<CyclictestThread>,
}

/// One thread of `cyclictest`, in its resolution of 1 us.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CyclictestThread {
    /// The CPU it was pinned to, where CPUs were named.
    pub cpu: Option<usize>,
    /// Wake-ups. One that passed while the thread was late is not among them.
    pub count: u64,
    /// Median; `None` when it lies beyond the histogram.
    pub p50_us: Option<u64>,
    /// 99 %.
    pub p99_us: Option<u64>,
    /// 99.9 %.
    pub p999_us: Option<u64>,
    /// The largest.
    pub max_us: u64,
}

/// Runs it for the request's duration, whole seconds; ends it when `is_stopped`.
pub(super) fn run(
    request: &LatencyRequest,
    is_stopped: &dyn Fn() -> bool,
    tell: &dyn Fn(&str),
) -> Fact<CyclictestReport> {
    let seconds = request.duration.as_secs().max(1);
    let arguments = arguments(request, seconds);
    let command = format!("cyclictest {}", arguments.join(" "));
    let spawned = Command::new("cyclictest")
        .args(&arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    let child = match spawned {
        Ok(child) => child,
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            return Fact::Unavailable("not installed: apt-get install rt-tests".to_owned());
        }
        Err(error) => return Fact::Unavailable(format!("cyclictest: {error}")),
    };
    let limit = Duration::from_secs(seconds) + PATIENCE;
    match answer(child, limit, &|| {
        tell("cyclictest");
        is_stopped()
    }) {
        Ok(text) => match parse(&text, &request.cpus) {
            Some(threads) => Fact::Available(CyclictestReport { command, threads }),
            None => Fact::Unavailable(format!("{command} printed no histogram")),
        },
        Err(why) => Fact::Unavailable(format!("{command}: {why}")),
    }
}

fn arguments(request: &LatencyRequest, seconds: u64) -> Vec<String> {
    let mut arguments = vec![
        "--mlockall".to_owned(),
        format!("--priority={}", request.priority),
        format!("--interval={}", request.period.as_micros()),
        // All threads at the same period, as the built-in loop has it.
        "--distance=0".to_owned(),
        format!("--duration={seconds}"),
        format!("--histogram={BIN_COUNT}"),
        "--quiet".to_owned(),
    ];
    if !request.cpus.is_empty() {
        arguments.push(format!("--affinity={}", format_cpu_list(&request.cpus)));
        arguments.push(format!("--threads={}", request.cpus.len()));
    }
    arguments
}

/// What the child prints, if it ends in time and without a fault.
fn answer(
    mut child: Child,
    limit: Duration,
    is_stopped: &dyn Fn() -> bool,
) -> Result<String, String> {
    let (Some(output), Some(errors)) = (child.stdout.take(), child.stderr.take()) else {
        return Err("its output is not here".to_owned());
    };
    // Read beside it: twenty thousand lines do not fit into a pipe.
    let read = |source: Box<dyn Read + Send>| {
        thread::spawn(move || {
            let mut text = String::new();
            let read = source.take(ANSWER_BYTES_MAX).read_to_string(&mut text);
            read.map(|_| text).unwrap_or_default()
        })
    };
    let (output, errors) = (read(Box::new(output)), read(Box::new(errors)));
    let deadline = Instant::now() + limit;
    let ended = loop {
        match child.try_wait() {
            Ok(Some(status)) => break Ok(status),
            Ok(None) if is_stopped() => break Err("interrupted".to_owned()),
            Ok(None) if Instant::now() >= deadline => {
                break Err(format!("did not end within {} s", limit.as_secs()));
            }
            Ok(None) => thread::sleep(LOOK_PERIOD),
            Err(error) => break Err(error.to_string()),
        }
    };
    if ended.is_err() {
        // It may end by itself in between; waiting afterwards is what matters.
        let _already_ended = child.kill().is_err();
        let _already_waited_for = child.wait().is_err();
    }
    let (output, errors) = (
        output.join().unwrap_or_default(),
        errors.join().unwrap_or_default(),
    );
    let status = ended?;
    if status.success() {
        return Ok(output);
    }
    let complaint = errors
        .lines()
        .chain(output.lines())
        .find(|line| !line.trim().is_empty());
    Err(format!(
        "ended with {status}: {}",
        complaint.unwrap_or("without a word").trim()
    ))
}

/// The threads of a histogram; `None` where there is none.
fn parse(text: &str, cpus: &[usize]) -> Option<Vec<CyclictestThread>> {
    let mut columns: Vec<Vec<u64>> = Vec::new();
    let mut maxima = Vec::new();
    let mut overflows = Vec::new();
    let numbers = |line: &str| -> Vec<u64> {
        line.split_whitespace()
            .map_while(|word| word.parse().ok())
            .collect()
    };
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix("# Max Latencies:") {
            maxima = numbers(rest);
        } else if let Some(rest) = line.strip_prefix("# Histogram Overflows:") {
            overflows = numbers(rest);
        } else if line.starts_with(|first: char| first.is_ascii_digit()) {
            let bin = numbers(line);
            let (_, counts) = bin.split_first()?;
            columns.resize(columns.len().max(counts.len()), Vec::new());
            for (column, count) in columns.iter_mut().zip(counts) {
                column.push(*count);
            }
        }
    }
    if columns.is_empty() || maxima.len() < columns.len() {
        return None;
    }
    let threads = columns.iter().enumerate().map(|(index, bins)| {
        let overflow = overflows.get(index).copied().unwrap_or(0);
        let count = bins.iter().sum::<u64>() + overflow;
        CyclictestThread {
            cpu: cpus.get(index).copied(),
            count,
            p50_us: quantile(bins, count, 500),
            p99_us: quantile(bins, count, 990),
            p999_us: quantile(bins, count, 999),
            max_us: maxima[index],
        }
    });
    Some(threads.collect())
}

/// The first bin up to which at least `permille` of `count` lie.
fn quantile(bins: &[u64], count: u64, permille: u64) -> Option<u64> {
    let rank = (count * permille).div_ceil(1000).max(1);
    let mut seen = 0;
    let index = bins.iter().position(|bin| {
        seen += bin;
        seen >= rank
    });
    index.and_then(|index| u64::try_from(index).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRINTED: &str = "# /dev/cpu_dma_latency set to 0us\n# Histogram\n000000 000000\t000000\n\
        000001 000090\t000000\n000002 000009\t000098\n000003 000000\t000001\n\
        # Total: 000000099 000000099\n# Min Latencies: 00001 00002\n# Avg Latencies: 00001 00002\n\
        # Max Latencies: 00077 00003\n# Histogram Overflows: 00001 00000\n\
        # Histogram Overflow at cycle number:\n# Thread 0: 00042\n# Thread 1:\n";

    #[test]
    fn its_histogram_is_read_thread_by_thread() {
        let threads = parse(PRINTED, &[0, 3]).unwrap();
        let first = &threads[0];
        assert_eq!((first.cpu, first.count, first.max_us), (Some(0), 100, 77));
        assert_eq!((first.p50_us, first.p99_us), (Some(1), Some(2)));
        assert_eq!(first.p999_us, None, "it lies beyond the histogram");
        let second = &threads[1];
        assert_eq!((second.cpu, second.count), (Some(3), 99));
        assert_eq!((second.p50_us, second.p999_us), (Some(2), Some(3)));
        assert_eq!(parse("Unable to change scheduling policy!\n", &[]), None);
    }

    #[test]
    fn it_is_asked_for_what_the_built_in_loop_does() {
        let request = LatencyRequest {
            cpus: vec![1, 2],
            ..LatencyRequest::brief(None)
        };
        let arguments = arguments(&request, 3).join(" ");
        for word in [
            "--priority=80",
            "--interval=1000",
            "--affinity=1-2",
            "--threads=2",
            "--duration=3",
        ] {
            assert!(arguments.contains(word), "{arguments}");
        }
    }

    #[test]
    fn a_program_that_fails_or_hangs_is_told_and_ended() {
        let child = |script: &str| {
            Command::new("sh")
                .args(["-c", script])
                .stdout(Stdio::piped())
                .stderr(Stdio::piped())
                .spawn()
                .unwrap()
        };
        let long = Duration::from_mins(1);
        let failed = answer(child("echo no rights >&2; exit 3"), long, &|| false);
        let why = failed.unwrap_err();
        assert!(why.contains('3') && why.contains("no rights"), "{why}");
        let stopped = answer(child("exec sleep 600"), long, &|| true);
        assert_eq!(stopped.unwrap_err(), "interrupted");
        let hung = answer(child("exec sleep 600"), Duration::ZERO, &|| false);
        assert!(hung.unwrap_err().contains("did not end"));
    }
}
