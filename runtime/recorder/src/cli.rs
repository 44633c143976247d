//! The command line: definitions only. What a command does is in [`crate::command`].

use std::net::IpAddr;
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
  hil-recorder serve
      the run that goes on, in the browser and in whatever speaks the Foxglove WebSocket

Exit codes:
  0  done                              70  internal error
  1  done, but the run's folder has    130 interrupted: no file
     gaps; or it could not be done     131 interrupted twice
  2  wrong arguments, or not a run's
     folder or an MCAP file";

const SERVE_EXAMPLES: &str = "\
Examples:
  hil-recorder serve
      the run that goes on here; the page is at http://127.0.0.1:8766/
  hil-recorder serve --wait
      the next one, and the one after it
  hil-recorder serve runs/fleet-emulated-20261122-101806 --loop
      a finished run again and again
  ssh -L 8765:localhost:8765 -L 8766:localhost:8766 control-pc
      from another PC, then the same address; nothing is open to the network

Lichtblick and Foxglove connect to ws://127.0.0.1:8765. Topics and fields are in docs/live-view.md.
It ends with Ctrl-C; the exit code is 0 then.";

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
    /// Show a run in the browser and in viewers that speak the Foxglove WebSocket.
    #[command(after_help = SERVE_EXAMPLES)]
    Serve {
        /// The beginning of the name of a run that goes on, or the folder of any run; without, the
        /// only one that goes on here.
        #[arg(value_name = "RUN")]
        run: Option<String>,
        /// Wait for a run if none goes on, and for the next one when it is over.
        #[arg(long)]
        wait: bool,
        /// Address to listen at; another than this machine's own lets others in.
        #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
        host: IpAddr,
        /// Port of the socket; 0 takes one that is free.
        #[arg(long, value_name = "PORT", default_value_t = 8765)]
        port: u16,
        /// Port of the page; 0 takes one that is free.
        #[arg(long, value_name = "PORT", default_value_t = 8766)]
        http_port: u16,
        /// How fast a finished run is played back, 0.01 to 100.
        #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = speed)]
        speed: f64,
        /// Play a finished run again and again.
        #[arg(long = "loop")]
        repeats: bool,
    },
}

fn speed(text: &str) -> Result<f64, String> {
    let speed = text.parse::<f64>().ok();
    let speed = speed.filter(|speed| (0.01..=100.0).contains(speed));
    speed.ok_or_else(|| "must be a number from 0.01 to 100".to_owned())
}
