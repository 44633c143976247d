//! A delay distribution in the form of Linux netem's tables (`tc qdisc ... distribution FILE`): 4096
//! deviates of a distribution with mean 0 and standard deviation 1, ascending, times 8192
//! (iproute2, `netem/maketable.c`). It is an export only, and keeps no order and no loss.

use crate::csv::one_line;
use core::fmt::Write;

use super::Trace;

/// Deviates in a table.
pub const TABLE_COUNT: usize = 4096;
/// What a deviate of 1 is written as (`NETEM_DIST_SCALE`).
const SCALE: f64 = 8192.0;

/// A table with what belongs on the command line beside it.
#[derive(Debug, Clone, PartialEq)]
pub struct NetemTable {
    /// The file.
    pub text: String,
    /// Mean delay, for `delay`.
    pub mean_ns: f64,
    /// Standard deviation, for its second argument.
    pub deviation_ns: f64,
    /// Entries whose deviate is beyond the 16 bits of a table, four deviations from the mean: they are
    /// written as the farthest that fits, so `netem` makes no delay beyond it.
    pub cut_count: usize,
    /// Largest error of both from the clocks, 0 on one clock; `None` when it is not known.
    pub bound_ns: Option<u64>,
}

/// The table of the trace's delays; `None` below two delays, or when they do not vary.
pub fn table(trace: &Trace) -> Option<NetemTable> {
    let mut delays_ns = trace.delays_ns();
    if delays_ns.len() < 2 {
        return None;
    }
    delays_ns.sort_unstable();
    let n = delays_ns.len() as f64;
    let mean_ns = delays_ns.iter().map(|ns| *ns as f64).sum::<f64>() / n;
    let squares = delays_ns.iter().map(|ns| (*ns as f64 - mean_ns).powi(2));
    let deviation_ns = (squares.sum::<f64>() / (n - 1.0)).sqrt();
    if deviation_ns <= 0.0 {
        return None;
    }
    let channel = match one_line(&trace.header.channel) {
        unknown if unknown.is_empty() => "unknown channel".to_owned(),
        known => known,
    };
    let mut text = format!(
        "# delay distribution of {channel}: tc ... netem delay {:.0}us {:.0}us distribution FILE\n",
        mean_ns / 1e3,
        deviation_ns / 1e3
    );
    let bound_ns = trace.delay_bound_ns();
    // A remark to `tc`, as the line above. Moving each delay by at most the bound moves neither mean
    // nor deviation by more.
    let _infallible = match bound_ns {
        Some(0) => writeln!(text, "# both delays measured on one clock"),
        Some(ns) => writeln!(text, "# both within {:.3}us by the clocks", ns as f64 / 1e3),
        None => writeln!(
            text,
            "# how far the clocks may have led both astray is unknown"
        ),
    };
    let mut cut_count = 0;
    for index in 0..TABLE_COUNT {
        // The middle of each of 4096 equal shares.
        let rank = (2 * index + 1) * delays_ns.len() / (2 * TABLE_COUNT);
        let deviate = (delays_ns[rank] as f64 - mean_ns) / deviation_ns;
        // The kernel holds 16 bits.
        let wanted = (deviate * SCALE).round();
        let written = wanted.clamp(-32_768.0, 32_767.0);
        cut_count += usize::from(wanted.to_bits() != written.to_bits());
        let end = if index % 8 == 7 { '\n' } else { ' ' };
        let _infallible = write!(text, "{written}{end}");
    }
    Some(NetemTable {
        text,
        mean_ns,
        deviation_ns,
        cut_count,
        bound_ns,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{TraceHeader, TraceRecord};
    use hil_core::random::RandomStream;

    #[test]
    fn the_table_has_mean_zero_and_deviation_one() {
        let mut random = RandomStream::new(1, "netem");
        let mut delivered = |index: u64| {
            let delay_ns = 5_000_000 + i64::try_from(random.next_u64() % 2_000_000).unwrap();
            TraceRecord::published(i64::try_from(index).unwrap(), index, 1).delivered(delay_ns, 0)
        };
        let trace = Trace {
            header: TraceHeader::new("a/b"),
            records: (0..10_000).map(&mut delivered).collect(),
        };
        let table = table(&trace).unwrap();
        assert!((table.mean_ns - 6e6).abs() < 3e4, "{}", table.mean_ns);
        let lines = table.text.lines().filter(|line| !line.starts_with('#'));
        let numbers = lines.flat_map(str::split_whitespace);
        let numbers: Vec<f64> = numbers.map(|number| number.parse().unwrap()).collect();
        assert_eq!(numbers.len(), TABLE_COUNT);
        assert!(numbers.is_sorted());
        let mean = numbers.iter().sum::<f64>() / 4096.0;
        let square = numbers.iter().map(|x| x * x).sum::<f64>() / 4096.0;
        assert!(mean.abs() < 30.0, "{mean}");
        assert!((square.sqrt() / SCALE - 1.0).abs() < 0.01, "{square}");
    }

    #[test]
    fn a_table_says_how_far_its_mean_may_be_off() {
        let told = |bounds: [u64; 2]| {
            let mut delay_ns = 1_000_000;
            let records = bounds.map(|bound_ns| {
                delay_ns += 500_000;
                TraceRecord::published(0, 0, 1).delivered(delay_ns, bound_ns)
            });
            let trace = Trace {
                header: TraceHeader::new("a/b"),
                records: records.to_vec(),
            };
            let table = table(&trace).unwrap();
            let line = table.text.lines().nth(1).unwrap().to_owned();
            (table.bound_ns, line)
        };
        let of_nobody = Trace {
            header: TraceHeader::new(""),
            records: [5, 7]
                .map(|ns| TraceRecord::published(0, 0, 1).delivered(ns, 0))
                .to_vec(),
        };
        let text = table(&of_nobody).unwrap().text;
        assert!(
            text.starts_with("# delay distribution of unknown channel: tc"),
            "{text}"
        );
        let (bound_ns, line) = told([40_000, 90_000]);
        assert_eq!(bound_ns, Some(90_000));
        assert_eq!(line, "# both within 90.000us by the clocks");
        assert_eq!(told([0, 0]).1, "# both delays measured on one clock");
        let (bound_ns, line) = told([0, crate::UNBOUNDED_NS]);
        assert!(bound_ns.is_none() && line.ends_with("is unknown"), "{line}");
    }

    #[test]
    fn a_constant_delay_has_no_table() {
        let record = TraceRecord::published(0, 0, 1).delivered(5, 0);
        let trace = Trace {
            header: TraceHeader::new("a/b"),
            records: vec![record; 9],
        };
        assert_eq!(table(&trace), None);
    }
}
