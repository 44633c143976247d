//! The command line: definitions only. What a command does is in [`crate::command`].

use std::net::IpAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use hil_topology::read_duration;

const EXAMPLES: &str = "\
Examples:
  hil-recorder convert runs/teleop-local-20261121-101500 -o run.mcap
      a run's folder as one file for Lichtblick, Foxglove, PlotJuggler or Python
  hil-recorder record -o run.mcap
      the run that goes on this host, while it goes
  hil-recorder recover broken.mcap -o whole.mcap
      a whole file of what a killed writer left
  hil-recorder serve
      the run that goes on, in the browser and in whatever speaks the Foxglove
      WebSocket
  hil-recorder play run.mcap --only human/frame --speed 2 --loop
      a recorded channel into a run that goes on, in place of its producer

Exit codes:
  0  done                              70  internal error
  1  done, but the run's folder has    130 interrupted: no file; of
     gaps, or something was missed;        `record`: a whole one
     or it could not be done           131 interrupted twice
  2  wrong arguments, or not a run's
     folder or an MCAP file";

const SERVE_EXAMPLES: &str = "\
Examples:
  hil-recorder serve
      the run that goes on here; the page is at http://127.0.0.1:8766/
  hil-recorder serve --wait --record recordings/ --no-scene
      the next one, and the one after it, each recorded as well, without
      pictures
  hil-recorder serve runs/fleet-emulated-20261122-101806 --loop
      a finished run again and again
  ssh -L 8765:localhost:8765 -L 8766:localhost:8766 control-pc
      from another PC, then the same address; nothing is open to the network
  hil-recorder serve --allow-origin https://app.foxglove.dev
      pages of Foxglove's own web site may look on and change links as well
  hil-recorder serve --allow-origin file://
      for Lichtblick as an application; so may any saved page then

Web pages of others are refused, and named here once. Programs and our own page
need no option, and of another user or machine the token in the address that is
printed. Lichtblick and Foxglove connect to ws://127.0.0.1:8765. Topics and
fields are in docs/live-view.md. It ends with Ctrl-C; the exit code is 0
then, or 1 when --record could not write a file.";

const CONVERT_EXAMPLES: &str = "\
Examples:
  hil-recorder convert runs/teleop-local-20261121-101500 -o run.mcap
  hil-recorder convert runs/NAME -o fleet.mcap --force

Works for a run that was killed too: what is cut short is left out, counted, and
said in the file; the exit code is 1 then. Topics and schemas are in
docs/recordings.md.";

const RECORD_EXAMPLES: &str = "\
Examples:
  hil-recorder record -o run.mcap
      the only run that goes on this host, until it ends or Ctrl-C
  hil-recorder record --wait -o recordings/ &
      started before the run: waits for it; the file gets the run's name, the
      folder is made
  hil-recorder record teleop-split -o long.mcap --split-size 1GiB
      long_0001.mcap, long_0002.mcap and so on, each whole by itself

Until it is whole, a file is called FILE.partial. When the recorder is killed,
`hil-recorder recover FILE.partial -o FILE` gets back all but the last --flush.
What was missed is counted by channel, here and in the file; the exit code is 1
then. See docs/recordings.md.";

const RECOVER_EXAMPLES: &str = "\
Example:
  hil-recorder recover broken.mcap -o whole.mcap

Every chunk whose check sum is right is copied, the last one as far as it goes.
Each loss is said with the byte at which it begins, here and in the new file
under `hil.recovery`. The exit code is 0 when there is a new file, whatever was
lost.";

const PLAY_EXAMPLES: &str = "\
Examples:
  hil-recorder play run.mcap --only human/frame --loop
      as the program of a process in a topology: into the run that started it
  hil-recorder play run.mcap --only human/frame --into teleop-local
      by hand, into a channel that has no writer

Messages are rebuilt byte for byte and leave at their recorded spacing, with
numbers and times of their own. A channel with a living writer is refused.
Messages that leave late are counted and said at the end. As a process of a run
it stays, silent, when the recording is over, because its end would end the run.
docs/terminal.md has an example.";

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
        /// Leave out /scene and /tf, and the work that drawing them takes.
        #[arg(long)]
        no_scene: bool,
    },
    /// Record a run while it goes.
    #[command(after_help = RECORD_EXAMPLES)]
    Record(RecordOptions),
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
    /// Write manual pages and completions for a package to this folder.
    #[command(hide = true)]
    Documents {
        /// Where to.
        folder: PathBuf,
    },
    /// Show a run in the browser and in viewers that speak the Foxglove WebSocket.
    #[command(after_help = SERVE_EXAMPLES)]
    Serve(ServeOptions),
    /// Feed recorded channels into a run that goes on, at their recorded spacing.
    #[command(after_help = PLAY_EXAMPLES)]
    Play(PlayOptions),
}

/// What to record, and how.
#[derive(Debug, Clone, Default, Args)]
#[allow(clippy::struct_excessive_bools, reason = "options of a command line")]
pub(crate) struct RecordOptions {
    /// Name of the run, the beginning of it, or its folder; the only one if left out.
    #[arg(value_name = "RUN")]
    pub(crate) run: Option<String>,
    /// The file to write, or a folder for a file with the run's name; one that is not there is
    /// made if the name ends in `/`.
    #[arg(long, short, value_name = "FILE")]
    pub(crate) output: PathBuf,
    /// Wait for a run to begin.
    #[arg(long)]
    pub(crate) wait: bool,
    /// Of the runs that go on, know only those whose folders lie below this one, as those of one
    /// unit of systemd do.
    #[arg(long, value_name = "DIR")]
    pub(crate) below: Option<PathBuf>,
    /// Leave out what the run recorded before; otherwise a recorder that comes late catches up.
    #[arg(long)]
    pub(crate) from_now: bool,
    /// Begin another file when one is larger, e.g. 1GiB; looked at with every flush.
    #[arg(long, value_name = "SIZE", value_parser = size)]
    pub(crate) split_size: Option<u64>,
    /// What a kill of the recorder may lose at most, 100ms to 60s.
    #[arg(long, value_name = "TIME", value_parser = flush, default_value = "1s")]
    pub(crate) flush: Duration,
    /// Replace files that exist.
    #[arg(long)]
    pub(crate) force: bool,
    /// Leave out /scene and /tf, and the work that drawing them takes.
    #[arg(long)]
    pub(crate) no_scene: bool,
    /// The run that lies in this folder, instead.
    #[arg(skip)]
    pub(crate) folder: Option<PathBuf>,
}

/// What to play, and how.
#[derive(Debug, Args)]
pub(crate) struct PlayOptions {
    /// The MCAP file.
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// Play this channel; may be repeated. Without one, those of the file are listed.
    #[arg(long, value_name = "CHANNEL")]
    pub(crate) only: Vec<String>,
    /// How much faster than recorded, 0.01 to 100.
    #[arg(long, value_name = "FACTOR", value_parser = speed, default_value = "1")]
    pub(crate) speed: f64,
    /// Begin again at the end, until the run ends.
    #[arg(long = "loop")]
    pub(crate) is_looped: bool,
    /// Name or folder of the run; otherwise the run that started this program, or the only one.
    #[arg(long, value_name = "RUN")]
    pub(crate) into: Option<String>,
}

/// What is served, and where.
#[derive(Debug, Args)]
pub(crate) struct ServeOptions {
    /// The beginning of the name of a run that goes on, or the folder of any run; without, the
    /// only one that goes on here.
    #[arg(value_name = "RUN")]
    pub(crate) run: Option<String>,
    /// Wait for a run if none goes on, and for the next one when it is over.
    #[arg(long)]
    pub(crate) wait: bool,
    /// Address to listen at; another than this machine's own lets others in.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    pub(crate) host: IpAddr,
    /// Port of the socket; 0 takes one that is free.
    #[arg(long, value_name = "PORT", default_value_t = 8765)]
    pub(crate) port: u16,
    /// Port of the page; 0 takes one that is free.
    #[arg(long, value_name = "PORT", default_value_t = 8766)]
    pub(crate) http_port: u16,
    /// Let web pages of this origin look on and change emulated links, e.g.
    /// `https://app.foxglove.dev`; may be repeated.
    #[arg(long, value_name = "ORIGIN", value_parser = crate::serve::origin)]
    pub(crate) allow_origin: Vec<String>,
    /// A further name of this machine, as in the browser's address bar; addresses, localhost and
    /// the machine's own name need none; may be repeated.
    #[arg(long, value_name = "NAME", value_parser = crate::serve::host)]
    pub(crate) allow_host: Vec<String>,
    /// Record what is shown while it goes on, as `record` does: a file, or a folder for one file
    /// per run, which is made if it is not there and the name ends in `/`.
    #[arg(long, value_name = "FILE")]
    pub(crate) record: Option<PathBuf>,
    /// Leave out /scene and /tf of the file, and the work that drawing them takes.
    #[arg(long, requires = "record")]
    pub(crate) no_scene: bool,
    /// How fast a finished run is played back, 0.01 to 100.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = speed)]
    pub(crate) speed: f64,
    /// Play a finished run again and again.
    #[arg(long = "loop")]
    pub(crate) repeats: bool,
}

fn speed(text: &str) -> Result<f64, String> {
    let speed = text.parse::<f64>().ok();
    let speed = speed.filter(|speed| (0.01..=100.0).contains(speed));
    speed.ok_or_else(|| "must be a number from 0.01 to 100".to_owned())
}

/// Units of sizes, bytes each; the longer word of two that end alike comes first.
const SIZES: [(&str, f64); 7] = [
    ("KiB", 1024.0),
    ("MiB", 1_048_576.0),
    ("GiB", 1_073_741_824.0),
    ("kB", 1e3),
    ("MB", 1e6),
    ("GB", 1e9),
    ("B", 1.0),
];

fn size(text: &str) -> Result<u64, String> {
    let unit = SIZES.iter().find(|(name, _)| text.ends_with(name));
    let bytes = unit.and_then(|(name, factor)| {
        let number: f64 = text.strip_suffix(name)?.trim_end().parse().ok()?;
        Some(number * factor)
    });
    let bytes = bytes.filter(|bytes| (1.0..=1e18).contains(bytes));
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "checked just above"
    )]
    bytes
        .map(|bytes| bytes as u64)
        .ok_or_else(|| "1B to 1000000000GB, in B, kB, MB, GB, KiB, MiB or GiB".to_owned())
}

fn flush(text: &str) -> Result<Duration, String> {
    let range = Duration::from_millis(100)..=Duration::from_mins(1);
    let flush = read_duration(text).filter(|flush| range.contains(flush));
    flush.ok_or_else(|| "100ms to 60s".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_are_read_with_their_units_and_never_without() {
        assert_eq!(size("1GiB"), Ok(1 << 30));
        assert_eq!(size("1.5 kB"), Ok(1500));
        assert_eq!(flush("0.5 s"), Ok(Duration::from_millis(500)));
        for text in ["10", "0s", "-1s", "s", "1 d", "nans", "infs"] {
            assert!(flush(text).is_err(), "{text}");
        }
        assert!(size("0.5B").is_err() && size("1").is_err());
        assert!(flush("10ms").is_err() && flush("2min").is_err());
    }
}
