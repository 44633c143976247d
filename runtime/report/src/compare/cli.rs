//! The command line of `hil-runtime compare`: definitions only.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

/// Examples of the command, for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  hil-runtime compare runs/before runs/after
      every delay, loss and score of both, their ratio or difference with its
      interval
  hil-runtime compare --base runs/a1 runs/a2 --new runs/b1 runs/b2
      repetitions: intervals then know how runs differ from each other
  hil-runtime compare --base runs/a1 runs/a2 --new runs/b1 runs/b2 \\
      --fail-if \"p99 > 1.2x\"
      for a script: exit code 1 when a condition holds beyond the figure's
      interval
  hil-runtime compare runs/before runs/after --format md > comparison.md

A condition is [CHANNEL:]METRIC OP VALUE[UNIT]. Without a channel it is one on
every channel; those where it cannot be judged, as with too few messages, are
named.
  METRIC  p50, p99, p99.9, max (end to end), loss, or a score by its name in
          summary.json
  OP      > >= < <=
  UNIT    of delays: x (new by base); s, ms, us, ns (of the new runs)
          of loss: % (of the new runs), pp (new less base, in percentage points)
          of scores: x, or none (of the new runs)

Exit code 0 when no condition holds, 1 when one does, 2 for wrong arguments,
folders that are no finished runs, and conditions that can be judged on no
channel. docs/compare.md has the methods.";

/// Arguments of a comparison.
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// Two folders of runs: the base, then the new one.
    #[arg(value_names = ["BASE", "NEW"], num_args = 2, conflicts_with_all = ["base", "new"], required_unless_present_all = ["base", "new"])]
    pub runs: Vec<PathBuf>,
    /// Repetitions of the base.
    #[arg(long, value_name = "RUN", num_args = 1.., requires = "new")]
    pub base: Vec<PathBuf>,
    /// Repetitions to compare with it.
    #[arg(long, value_name = "RUN", num_args = 1.., requires = "base")]
    pub new: Vec<PathBuf>,
    /// Fail when this holds; may be repeated.
    #[arg(long, value_name = "CONDITION")]
    pub fail_if: Vec<String>,
    /// Judge conditions by the figures alone, without their intervals.
    #[arg(long, requires = "fail_if")]
    pub strict: bool,
    /// Print every figure with its method, not only the answer and what differs.
    #[arg(long)]
    pub full: bool,
    /// What to print.
    #[arg(long, value_enum, default_value_t = CompareFormat::Text)]
    pub format: CompareFormat,
}

/// How a comparison is printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum CompareFormat {
    /// For a terminal.
    Text,
    /// A table for a page or a pull request.
    Md,
    /// Everything, for programs.
    Json,
}
