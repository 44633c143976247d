//! The command line: definitions only. What a command does is in [`crate::command`].

use std::path::PathBuf;

use clap::{Parser, Subcommand};

const EXAMPLES: &str = "\
Examples:
  hil-recorder convert runs/teleop-local-20261121-101500 -o run.mcap
      a run's folder as one file for Lichtblick, Foxglove, PlotJuggler or Python
  hil-recorder info run.mcap
      topics, counts, times, and what the file says of its run
  hil-recorder recover broken.mcap -o whole.mcap
      a whole file of what a killed writer left
  hil-recorder play run.mcap --only human/frame --speed 2 --loop
      a recorded channel into a run that goes on, in place of its producer

Exit codes:
  0  done                              70  internal error
  1  done, but the run's folder has    130 interrupted: no file
     gaps; or it could not be done     131 interrupted twice
  2  wrong arguments, or not a run's
     folder or an MCAP file";

const CONVERT_EXAMPLES: &str = "\
Examples:
  hil-recorder convert runs/teleop-local-20261121-101500 -o run.mcap
  hil-recorder convert runs/fleet-split-20261121-101500-control-pc -o fleet.mcap --force

Works for a run that was killed too: what is cut short is left out, counted, and said in the
file; the exit code is 1 then. Topics and schemas are in docs/recordings.md.";

const RECOVER_EXAMPLES: &str = "\
Example:
  hil-recorder recover broken.mcap -o whole.mcap

Every chunk whose check sum is right is copied, the last one as far as it goes. Each loss is said
with the byte at which it begins, here and in the new file under `hil.recovery`. The exit code is
0 when there is a new file, whatever was lost.";

const PLAY_EXAMPLES: &str = "\
Examples:
  hil-recorder play run.mcap --only human/frame --loop
      as the program of a process in a topology: into the run that started it
  hil-recorder play run.mcap --only human/frame --into teleop-local-20261121-101500
      by hand, into a channel that has no writer

Messages are rebuilt byte for byte and leave at their recorded spacing, with numbers and times of
their own. A channel with a living writer is refused. Messages that leave late are counted and
said at the end. As a process of a run it stays, silent, when the recording is over, because its
end would end the run. docs/terminal.md has an example.";

/// Turns the runs of hil-runtime into MCAP files, which other people's tools read.
#[derive(Debug, Parser)]
#[command(name = "hil-recorder", version, after_help = EXAMPLES, arg_required_else_help = true)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,

    /// Say only warnings and errors.
    #[arg(long, short, global = true)]
    pub(crate) quiet: bool,
}

/// What it can do.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Turn the folder of a finished or killed run into an MCAP file.
    #[command(after_help = CONVERT_EXAMPLES)]
    Convert {
        /// The run's folder.
        #[arg(value_name = "RUN")]
        run: PathBuf,
        /// The file to write.
        #[arg(long, short, value_name = "FILE")]
        output: PathBuf,
        /// Replace the file if it exists.
        #[arg(long)]
        force: bool,
    },
    /// Make a whole MCAP file of what is left of a broken one.
    #[command(after_help = RECOVER_EXAMPLES)]
    Recover {
        /// The broken file; it stays as it is.
        #[arg(value_name = "BROKEN")]
        broken: PathBuf,
        /// The file to write.
        #[arg(long, short, value_name = "FILE")]
        output: PathBuf,
        /// Replace the file if it exists.
        #[arg(long)]
        force: bool,
    },
    /// Print topics, counts, times and metadata of an MCAP file, whole or broken.
    Info {
        /// The file.
        #[arg(value_name = "FILE")]
        file: PathBuf,
        /// As JSON, with every value in full.
        #[arg(long)]
        json: bool,
    },
    /// Feed recorded channels into a run that goes on, at their recorded spacing.
    #[command(after_help = PLAY_EXAMPLES)]
    Play {
        /// The MCAP file.
        #[arg(value_name = "FILE")]
        file: PathBuf,
        /// Play this channel; may be repeated.
        #[arg(long, value_name = "CHANNEL", required = true)]
        only: Vec<String>,
        /// How much faster than recorded, 0.01 to 100.
        #[arg(long, value_name = "FACTOR", value_parser = speed, default_value = "1")]
        speed: f64,
        /// Begin again at the end, until the run ends.
        #[arg(long = "loop")]
        is_looped: bool,
        /// Name or folder of the run; otherwise the run that started this program, or the only one.
        #[arg(long, value_name = "RUN")]
        into: Option<String>,
    },
}

/// A speed within its bounds.
fn speed(text: &str) -> Result<f64, String> {
    let value: f64 = text
        .parse()
        .map_err(|_error| format!("{text:?} is not a number"))?;
    if (0.01..=100.0).contains(&value) {
        Ok(value)
    } else {
        Err(format!("{value} is outside 0.01 to 100"))
    }
}
