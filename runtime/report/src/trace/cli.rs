//! The command line of `hil-runtime trace`: definitions only.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

const INFO_EXAMPLES: &str = "\
Examples:
  hil-runtime trace info runs/teleop-outages-20261122-101500
      every channel that crossed a link in that run
  hil-runtime trace info runs/NAME/traces/egm.right.command.trace --json
      one channel, for scripts

Exit code 1 when a file is damaged: the offset of its first fault is named, and
what stands before it is shown. Exit code 2 when it is no trace at all.";

const FIT_EXAMPLES: &str = "\
Examples:
  hil-runtime trace fit runs/NAME/traces/shuttle.command.trace
      loss and delay laws, ranked, with what speaks against each
  hil-runtime trace fit runs/NAME
      every trace of a run, as [links.NAME.forward] and .backward; a second
      channel's as a remark
  hil-runtime trace fit FILE --link wlan >> my-topology.toml
      the best laws as [links.wlan]; the table goes to standard error

Equal seeds give equal fits.";

const PLOT_EXAMPLES: &str = "\
Examples:
  hil-runtime trace plot FILE
      delay distribution, burst lengths and memory in the terminal
  hil-runtime trace plot FILE --output plots
      every series as CSV as well: cdf, bursts, memory, and delay and loss over
      time";

const CONVERT_EXAMPLES: &str = "\
Examples:
  hil-runtime trace convert runs/NAME/traces/shuttle.command.trace command.csv
  hil-runtime trace convert measured.csv measured.trace
      two columns are enough: published_ns and delay_ns, empty where the message
      was lost
  hil-runtime trace convert FILE.trace link.mahimahi
      delivery opportunities of 1500 bytes; what is not kept is said
  hil-runtime trace convert FILE.trace delays.dist
      a delay distribution for tc ... netem

The form of the input is found by its content, that of the output by the ending
of its name, or --to. A damaged trace is converted up to its first fault, with
exit code 1.";

/// What to do with link traces.
#[derive(Debug, Subcommand)]
pub enum TraceCommand {
    /// Describe traces: losses and their bursts, delays and their bound, memory.
    #[command(after_help = INFO_EXAMPLES)]
    Info(TraceFiles),
    /// Fit link models to a trace, with goodness of fit, and print them as a topology's link.
    #[command(after_help = FIT_EXAMPLES)]
    Fit {
        /// Which traces.
        #[command(flatten)]
        files: TraceFiles,
        /// Seed of the resampling behind the probabilities.
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// Name of the link in the lines that are printed; else what the trace calls it, or `hop`.
        #[arg(long)]
        link: Option<String>,
    },
    /// Plot traces in the terminal, and as CSV.
    #[command(after_help = PLOT_EXAMPLES)]
    Plot {
        /// Which traces.
        #[command(flatten)]
        files: TraceFiles,
        /// Also write every series to this folder.
        #[arg(long, short, value_name = "DIR")]
        output: Option<PathBuf>,
    },
    /// Write a trace in another form.
    #[command(after_help = CONVERT_EXAMPLES)]
    Convert {
        /// The trace, in any form.
        from: PathBuf,
        /// The file to write.
        into: PathBuf,
        /// Its form, if its name does not end in it.
        #[arg(long, value_name = "FORM")]
        to: Option<TraceForm>,
        /// Overwrite a file that exists.
        #[arg(long)]
        force: bool,
    },
}

/// Traces to read.
#[derive(Debug, Args)]
pub struct TraceFiles {
    /// Trace files, or folders of a run.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
}

/// A form of a trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum TraceForm {
    /// The binary form.
    Trace,
    /// Comma-separated values.
    Csv,
    /// Delivery opportunities, as Mahimahi reads them.
    Mahimahi,
    /// A delay distribution, as Linux netem reads it.
    Netem,
}
