//! The command line of `hil-runtime link`: definitions only.

use std::time::Duration;

use clap::{ArgGroup, Args, Subcommand};

use hil_topology::duration_within;

const SHOW_EXAMPLES: &str = "\
Examples:
  hil-runtime link show
      the links of the run that goes on here, and what each emulated one does
      now
  hil-runtime link show runs/teleop-emulated-20261122-101500 --json
      of one run, for scripts; a finished run shows what it ended with";

const SET_EXAMPLES: &str = "\
Examples:
  hil-runtime link set hop --delay 120ms --loss 0.3
      both directions of link hop: 120 ms one way, three of ten messages lost
  hil-runtime link set hop.backward --cut
      nothing gets through from the second host to the first
  hil-runtime link set hop --delay 120ms runs/teleop-emulated-20261122-101500
      where several runs go on: a run by its folder or its name

A condition that is set takes the place of everything the topology says of that
direction: outages, rate, Wi-Fi model, trace. What is not given is none: --delay
alone loses nothing. It holds for messages that the gateway receives from then
on; what is under way keeps its fate. The gateway confirms it; the run's report
names every change. docs/live-links.md has the rest.

Exit code 1 when the gateway refuses or does not answer, 2 when there is no such
link, it is not emulated, or a number is outside its range.";

const RESET_EXAMPLES: &str = "\
Example:
  hil-runtime link reset hop
      both directions do again what the topology says";

/// What to do with the links of a run that goes on.
#[derive(Debug, Subcommand)]
pub enum LinkCommand {
    /// Show the links of a run and the condition that is in force.
    #[command(after_help = SHOW_EXAMPLES)]
    Show(RunChoice),
    /// Change an emulated link while the run goes on.
    #[command(after_help = SET_EXAMPLES)]
    Set(SetArgs),
    /// Have an emulated link do again what the topology says.
    #[command(after_help = RESET_EXAMPLES)]
    Reset {
        /// The link, or one direction of it: LINK.forward, LINK.backward.
        link: String,
        /// Which run.
        #[command(flatten)]
        choice: RunChoice,
    },
}

/// Which run, and how to print.
#[derive(Debug, Args)]
pub struct RunChoice {
    /// The run's folder or name; without it the one that goes on here.
    #[arg(value_name = "RUN")]
    pub run: Option<String>,
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
}

/// A condition for a link.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("condition").required(true).multiple(true).args(["delay", "loss", "cut"]))]
pub struct SetArgs {
    /// The link, or one direction of it: LINK.forward, LINK.backward.
    pub link: String,
    /// How long every message is under way, with its unit, at most 60 s.
    #[arg(long, value_name = "TIME",
          value_parser = duration_within(Duration::ZERO, Duration::from_mins(1)))]
    pub delay: Option<Duration>,
    /// Share of the messages that is lost, each by itself, 0 to 1.
    #[arg(long, value_name = "RATIO", allow_negative_numbers = true)]
    pub loss: Option<f64>,
    /// Nothing gets through.
    #[arg(long, conflicts_with_all = ["delay", "loss"])]
    pub cut: bool,
    /// Which run.
    #[command(flatten)]
    pub choice: RunChoice,
}
