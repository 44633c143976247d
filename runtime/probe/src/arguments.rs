//! The command line of the probe: definitions only.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use hil_capture::flow::FlowFilter;

use hil_platform::argument::whole;
use hil_topology::duration_within;

const EXAMPLES: &str = "\
Examples:
  hil-runtime probe --interface eth0 --output here.pcapng
      our own datagrams on eth0, until Ctrl-C
  hil-runtime probe -i lan1 -i lan2 -o lan.pcapng --flow udp:dport=5004,id=2+2
      RTP through a bridge with two ports, known again by its sequence number
  hil-runtime probe -i eth0 -o card.pcapng --stamps card
      with the network card's own stamps of what arrives beside the kernel's
  ip netns exec robot hil-runtime probe -i eth0 -o robot.pcapng
      the same in another network namespace
  hil-runtime probe analyse here.pcapng there.pcapng
      delay, jitter, loss and reordering between two points, or between two
      ports of an ET2000
  hil-runtime probe compare runs/NAME here.pcapng there.pcapng
      the gateways' own account of the wire beside the probe's

Flows: hil (our datagrams), egm:port=6510, udp:CONDITIONS; conditions with
commas between:
  port=N sport=N dport=N src=ADDRESS dst=ADDRESS, and for udp
  id=OFFSET+BYTES[le] (a number in the payload; without it the whole payload is
  hashed)

Exit codes: 0 done; 1 packets were dropped, an interface failed, a file has a
fault, loss is unavailable, a clock was set, or the figures differ; 2 wrong
arguments, nothing to read, or a capture without anything of the run; 69 no
such interface; 78 the right to capture is missing (root or CAP_NET_RAW), or
the card gives no stamps; 130 interrupted before --duration was over, the file
is complete";

const ANALYSE_EXAMPLES: &str = "\
Examples:
  hil-runtime probe analyse here.pcapng there.pcapng
      our own datagrams between two points
  hil-runtime probe analyse bridge.pcapng --flow udp:dport=5004,id=2+2 --json
      RTP in one capture, known again by its sequence number";

const COMPARE_EXAMPLES: &str = "\
Example:
  hil-runtime probe compare runs/NAME here.pcapng there.pcapng

Exit code 1 when counts differ, or medians lie farther apart than --limit.";

/// Look at the wire without taking part: capture, analyse, compare with a run.
#[derive(Debug, Args)]
#[command(
    after_help = EXAMPLES,
    args_conflicts_with_subcommands = true,
    arg_required_else_help = true
)]
pub struct ProbeArgs {
    /// What to do, if not to capture.
    #[command(subcommand)]
    pub(crate) work: Option<ProbeWork>,
    /// Capture.
    #[command(flatten)]
    pub(crate) live: LiveArgs,
}

/// Arguments of a live capture.
#[derive(Debug, Args)]
pub(crate) struct LiveArgs {
    /// Interface to tap, of this network namespace; may be repeated.
    #[arg(long, short, value_name = "NAME")]
    pub(crate) interface: Vec<String>,
    /// The pcapng file to write.
    #[arg(long, short, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Replace the output file if it exists.
    #[arg(long)]
    pub(crate) force: bool,
    /// What to follow [default: hil]; may be repeated.
    #[arg(long, value_name = "FLOW")]
    pub(crate) flow: Vec<FlowFilter>,
    /// End after this time, e.g. 60s; otherwise with Ctrl-C.
    #[arg(long, value_name = "TIME", value_parser = time())]
    pub(crate) duration: Option<Duration>,
    /// Bytes kept of a packet; otherwise as many as the flows need to be known again.
    #[arg(long, value_name = "BYTES", value_parser = whole::<u32>(64, 65_536))]
    pub(crate) snap_length: Option<u32>,
    /// Memory for packets between two looks, MiB per interface.
    #[arg(long, value_name = "MIB", default_value_t = 8,
          value_parser = whole::<u16>(1, 256))]
    pub(crate) ring: u16,
    /// Whose stamps; `card` adds those of the network card, on its own clock, for what arrives. It
    /// sets the card up (`CAP_NET_ADMIN`) and puts it back.
    #[arg(long, value_enum, default_value = "kernel")]
    pub(crate) stamps: Stamps,
    /// Print no progress.
    #[arg(long, short)]
    pub(crate) quiet: bool,
}

/// Whose stamps a capture has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Stamps {
    /// The kernel's.
    Kernel,
    /// The card's as well.
    Card,
}

/// Everything but a live capture.
#[derive(Debug, Subcommand)]
pub(crate) enum ProbeWork {
    /// Delay, jitter, loss, reordering and gaps of the flows in one or two captures.
    #[command(after_help = ANALYSE_EXAMPLES)]
    Analyse {
        /// pcap or pcapng, also packed with gzip, or of an ET2000.
        file: PathBuf,
        /// The capture of a second point.
        second: Option<PathBuf>,
        /// Both captures were stamped by one clock, e.g. on one machine: only then is the time
        /// between them a one-way delay.
        #[arg(long)]
        one_clock: bool,
        /// How to read them.
        #[command(flatten)]
        reading: ReadingArgs,
    },
    /// The gateways' account of a finished run beside two captures of its wire.
    #[command(after_help = COMPARE_EXAMPLES)]
    Compare {
        /// The run's folder, of either host.
        run: PathBuf,
        /// A capture at one host, or of both.
        file: PathBuf,
        /// The capture at the other.
        second: Option<PathBuf>,
        /// Farthest the medians may lie apart, microseconds.
        #[arg(long, value_name = "US", default_value_t = 5.0)]
        limit: f64,
        /// Keep what the probe saw in the run's folder: the tables' row of the run shows its loss and delay beside the
        /// account's.
        #[arg(long)]
        keep: bool,
        /// How to read them.
        #[command(flatten)]
        reading: ReadingArgs,
    },
}

/// How captures are read and results given.
#[derive(Debug, Args)]
pub(crate) struct ReadingArgs {
    /// What to follow [default: hil]; may be repeated.
    #[arg(long, value_name = "FLOW")]
    pub(crate) flow: Vec<FlowFilter>,
    /// Farthest that two stamps of one datagram may lie apart, e.g. 5s.
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = time())]
    pub(crate) window: Duration,
    /// Print JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

/// A time that a capture may take or stamps may lie apart.
fn time() -> impl Fn(&str) -> Result<Duration, String> + Clone {
    duration_within(Duration::from_millis(1), Duration::from_hours(2_400))
}
