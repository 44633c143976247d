//! The command line of `doctor`: definitions only.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use hil_platform::argument::whole;
use hil_topology::duration_within;

const EXAMPLES: &str = "\
Examples:
  hil-runtime doctor
      what this host can measure, the worst first, each with why and the fix
  hil-runtime doctor --topology deploy/topologies/split.toml
      with the topology's pinned CPUs, ports, routes, message sizes and clock
      path as well
  hil-runtime doctor --strict && hil-runtime --topology split.toml
      run only on a host without warnings
  hil-runtime doctor --latency 30s --cpu 2,3
      how late threads wake on two CPUs and what a busy poller loses there, and
      what figures in microseconds this supports
  hil-runtime doctor --json > robot-pc.json
  hil-runtime doctor --with robot-pc.json
      how far the clocks of two hosts may be apart

Severities, from good to bad: ok, note, cannot tell (it could not be read; never
taken for ok), warning, error. docs/doctor.md explains every finding by its
name, and the JSON.

--latency TIME measures for TIME on all CPUs at once, then lets a busy poller
spin for TIME, 10 s at most, on one CPU after the other. Ctrl-C gives what there
is so far.

Exit codes:
  0    examined; without --strict whatever was found
  2    wrong arguments, or a topology or report that cannot be read
  78   with --strict: a warning or an error
  130  interrupted: with --latency the report is of what there was so far, else
       there is none";

/// Arguments of `doctor`.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct DoctorArgs {
    /// A topology: what it pins, binds, sends and exchanges on this host is examined as well.
    #[arg(long, short, value_name = "FILE")]
    pub topology: Option<PathBuf>,
    /// Change one value of the topology; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "topology")]
    pub overrides: Vec<String>,
    /// Name of this host in the topology, if it is not found by itself.
    #[arg(long, requires = "topology")]
    pub host: Option<String>,
    /// Another host's report (--json), to bound the distance of the two clocks.
    #[arg(long = "with", value_name = "FILE")]
    pub other: Option<PathBuf>,
    /// Exit with 78 when there is a warning or an error.
    #[arg(long)]
    pub strict: bool,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Measure wake-up latency and gaps for this long each, at least 100 ms.
    #[arg(long, value_name = "TIME",
          value_parser = duration_within(Duration::from_millis(100), Duration::from_hours(24)))]
    pub latency: Option<Duration>,
    /// CPUs to measure on; without it those the topology pins, else the isolated ones, else all.
    #[arg(long, value_name = "N", value_delimiter = ',', requires = "latency")]
    pub cpu: Vec<usize>,
    /// Real-time (FIFO) priority of the measuring threads.
    #[arg(long, value_name = "P", default_value_t = 80, requires = "latency",
          value_parser = whole::<u8>(1, 99))]
    pub priority: u8,
    /// From one wake-up to the next, 100 us to 1 s.
    #[arg(long, value_name = "TIME", default_value = "1ms", requires = "latency",
          value_parser = duration_within(Duration::from_micros(100), Duration::from_secs(1)))]
    pub period: Duration,
}
