//! The command line of `channel` and `top`: definitions only.

use std::time::Duration;

use clap::{Args, Subcommand};

use hil_platform::argument::whole;
use hil_topology::duration_within;

const CHANNEL_EXAMPLES: &str = "\
Examples:
  hil-runtime channel list
      the channels of the run that runs here
  hil-runtime channel hz egm/right/command
      rate, gaps, jitter and what is missing, every second
  hil-runtime channel echo egm/right/feedback --field tool.position_m --count 5
      a part of five messages; --raw for the bytes, --json for scripts
  hil-runtime channel delay egm/right/command --once --json
      where the time of its messages went, segment by segment, as one JSON
      object

RUN is the name or the folder of a run; it may be left out when one run runs
here. A run is watched, never disturbed. Ctrl-C ends with the totals so far.";

const LIST_EXAMPLES: &str = "\
Examples:
  hil-runtime channel list
  hil-runtime channel list teleop-local-20261121-101500 --json";

const HZ_EXAMPLES: &str = "\
Examples:
  hil-runtime channel hz egm/right/command
  hil-runtime channel hz egm/right/command --once --window '5 s' --json";

const ECHO_EXAMPLES: &str = "\
Examples:
  hil-runtime channel echo egm/right/feedback --once
  hil-runtime channel echo egm/right/feedback --field measured_rad.0 --count 100
  hil-runtime channel echo egm/right/feedback --raw --once

Fields are those of the run's manifest; a message whose fields nobody stated is
shown as bytes.";

const DELAY_EXAMPLES: &str = "\
Examples:
  hil-runtime channel delay egm/right/command
  hil-runtime channel delay egm/right/command --once --window '5 s' --json

Only what this host recorded is shown: of a channel that comes from another
host, the segments beyond the wire are \"unavailable\", here as in the run's
report without the other host's records.";

const TOP_EXAMPLES: &str = "\
Examples:
  hil-runtime top
      the run that runs here, until q
  hil-runtime top teleop-local-20261121-101500 --once
      one look as plain text; also what a pipe gets
  hil-runtime top --once --json
      the same as one JSON object

Keys: q ends, arrows choose a channel, space pauses, ? explains.";

/// Arguments of `channel`.
#[derive(Debug, Args)]
#[command(after_help = CHANNEL_EXAMPLES)]
pub struct ChannelArgs {
    /// What to do.
    #[command(subcommand)]
    pub command: ChannelCommand,
}

/// What can be asked about channels.
#[derive(Debug, Subcommand)]
pub enum ChannelCommand {
    /// List the channels of a run: message, way, rate, writers and readers.
    #[command(after_help = LIST_EXAMPLES)]
    List {
        /// Name or folder of the run; the only one that runs here if left out.
        run: Option<String>,
        /// Print JSON instead of a table.
        #[arg(long)]
        json: bool,
        /// How long to count messages for the rates.
        #[arg(long, value_name = "TIME", value_parser = window(), default_value = "1s")]
        window: Duration,
    },
    /// Rate, gaps, jitter and missing numbers of a channel.
    #[command(after_help = HZ_EXAMPLES)]
    Hz(WindowArgs),
    /// Show the messages of a channel, field by field.
    #[command(after_help = ECHO_EXAMPLES)]
    Echo(EchoArgs),
    /// Where the time of a channel's messages goes, segment by segment.
    #[command(after_help = DELAY_EXAMPLES)]
    Delay(WindowArgs),
}

/// Which channel of which run.
#[derive(Debug, Clone, Args)]
pub struct WhichChannel {
    /// Its name, e.g. egm/right/command.
    pub channel: String,
    /// Name or folder of the run; the only one that runs here if left out.
    pub run: Option<String>,
}

/// Arguments of figures over a window.
#[derive(Debug, Clone, Args)]
pub struct WindowArgs {
    /// Of what.
    #[command(flatten)]
    pub which: WhichChannel,
    /// End after one window.
    #[arg(long)]
    pub once: bool,
    /// Print JSON: one object per window and line.
    #[arg(long)]
    pub json: bool,
    /// How long a window is, e.g. '1 s' or '500 ms'.
    #[arg(long, value_name = "TIME", value_parser = window(), default_value = "1s")]
    pub window: Duration,
}

/// Arguments of `echo`.
#[derive(Debug, Clone, Args)]
pub struct EchoArgs {
    /// Of what.
    #[command(flatten)]
    pub which: WhichChannel,
    /// End after one message.
    #[arg(long, conflicts_with = "count")]
    pub once: bool,
    /// End after so many messages.
    #[arg(long, value_name = "N", value_parser = whole::<u64>(1, u64::MAX))]
    pub count: Option<u64>,
    /// Show one field only, e.g. `tool.position_m` or `measured_rad.0`.
    #[arg(long, value_name = "NAME", conflicts_with = "raw")]
    pub field: Option<String>,
    /// Show the bytes instead of the fields.
    #[arg(long)]
    pub raw: bool,
    /// Print JSON: one object per message and line.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `top`.
#[derive(Debug, Clone, Args)]
#[command(after_help = TOP_EXAMPLES)]
pub struct TopArgs {
    /// Name or folder of the run; the only one that runs here if left out.
    pub run: Option<String>,
    /// Print one look as plain text and end.
    #[arg(long)]
    pub once: bool,
    /// Print JSON instead: one object with --once, else one per window and line.
    #[arg(long)]
    pub json: bool,
    /// How often to look, and how long figures reach back.
    #[arg(long, value_name = "TIME", value_parser = window(), default_value = "1s")]
    pub window: Duration,
}

/// A window: below the least nothing has been written yet, above the most nobody waits.
fn window() -> impl Fn(&str) -> Result<Duration, String> + Clone {
    duration_within(Duration::from_millis(100), Duration::from_mins(10))
}
