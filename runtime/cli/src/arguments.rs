//! The command line: definitions only. What a command does is elsewhere.

use std::net::IpAddr;
use std::path::PathBuf;

use clap::{ArgGroup, Args, Parser, Subcommand};

use hil_doctor::cli::DoctorArgs;
use hil_engine::security::cli::KeyCommand;
use hil_nic::nic_clock::guard::NicGuardArgs;
use hil_probe::arguments::ProbeArgs;
use hil_report::compare::cli as compare_cli;
use hil_report::compare::cli::CompareArgs;
use hil_report::page::Format;
use hil_report::study::{BatchArgs, RunArgument};
use hil_report::trace::cli::TraceCommand;
use hil_watch::link::cli::LinkCommand;
use hil_watch::live::cli::{ChannelArgs, TopArgs};

const EXAMPLES: &str = "\
Examples:
  hil-runtime --topology deploy/topologies/local.toml
      the whole loop on this PC, over shared memory
  hil-runtime --topology deploy/topologies/split.toml
      this host's share of the loop; start the same command on the other host
  hil-runtime --topology deploy/topologies/split.toml --on-one-pc
      both hosts on this PC, each with a network of its own
  hil-runtime --topology deploy/topologies/split.toml --check
      say what is wrong with the file, start nothing
  hil-runtime join --link 'delay 5ms loss 1%' -- ./ctrl 10.77.0.2 -- ./robot
      two programs of your own that speak IP, and a link between them
  hil-runtime simulate --topology deploy/topologies/emulated.toml
      the same loop and link in virtual time, in a moment
  hil-runtime tables --topology deploy/topologies/tables.toml
      the published tables of case study 1 beside our own, in virtual time
  hil-runtime calibrate teleoperation --mlr 0.008
      the outages under which case study 2 loses 0.8 % of its motion loops
  hil-runtime top
      the run that goes on this host at a glance; `channel` for one channel
  hil-runtime report runs/teleop-local-20261121-101500
      print a finished run's report again
  hil-runtime replay runs/teleop-local-20261121-101500
      run its robot again in virtual time and compare every message

Exit codes:
  0  the run ended as planned         75  an address or a port is not
  1  the run failed, its report has       there yet: try again
     gaps, a result cannot be         77  a folder is not this user's,
     written, or a replay differs         or the key cannot be used
  2  wrong arguments or topology      78  this host gives too little, or
  69 a peer host was not reachable        doctor --strict: it is not fit
  70 internal error                   130 interrupted; report complete
                                      131 interrupted twice: no report";

const TABLES_EXAMPLES: &str = "\
Examples:
  hil-runtime tables --topology deploy/topologies/tables.toml --sections 100000
      the published tables of case study 1 beside our own
  hil-runtime tables --topology deploy/topologies/tables.toml \\
      --run ethernet=runs/eth-1 --run 'short=runs/wifi-*' --run runs/lte-1
      the same with recorded runs as rows: two beside the paper's rows for
      Ethernet and short-range Wi-Fi 6, one that stands for itself
  hil-runtime tables --record deploy/recordings/fleet.toml
      the runs of those rows are made first, hours of them; the same command
      resumes where it was ended or killed

Equal seeds give equal tables, whatever the number of threads. Ctrl-C prints
what is complete. Exit code 1 when a criterion is missed.";

const JOIN_EXAMPLES: &str = "\
Examples:
  hil-runtime join -- ping -c 20 10.77.0.2 -- sleep 60
      what a bare cable does to twenty echoes
  hil-runtime join --link 'delay 5ms loss 1%' -- ./ctrl 10.77.0.2 -- ./robot
      a controller and a robot with a link that hurts between them
  hil-runtime join --link outages.toml -- iperf3 -c 10.77.0.2 -- iperf3 -s
      over the link of a topology file

Each program has a network of its own with one interface, eth0, and nothing but
the other program in it. The run ends when one of them does. It needs no root.
docs/two-programs.md has the rest.";

const CALIBRATE_EXAMPLES: &str = "\
Examples:
  hil-runtime calibrate teleoperation --mlr 0.008
      the outages under which the default case loses 0.8 % of its motion loops
  hil-runtime calibrate teleop --mlr 0.027 --topology emulated.toml
      the same with the case's parameters of a file; `teleop` names one case
      only
  hil-runtime calibrate teleop --figure mlr=0.008 --seeds 40 --output curve
      more runs per point, and the curve as CSV

Equal seeds give equal tables, whatever the number of threads. Ctrl-C prints
what is complete. Exit code 1 when the value cannot be reached or a criterion is
missed.";

const REPLAY_EXAMPLES: &str = "\
Examples:
  hil-runtime replay runs/teleop-local-20261121-101500
      run its robot again in virtual time and compare every message

Of a folder it reads the manifest and the records of the run, and nothing else.
Exit code 0 when every message is the same to the last bit, 1 when one differs
or records are missing, 2 when the folder cannot be replayed at all.";

const REPORT_EXAMPLES: &str = "\
Examples:
  hil-runtime report runs/teleop-local-20261121-101500
      print it again, as the run did at its end; --full for every figure
  hil-runtime report runs/teleop-local-20261121-101500 -o report.html
      one page with figures that opens offline and can be printed
  hil-runtime report runs/a runs/b simulated -o report.html
      several runs: a table with one row each, then each run
  hil-runtime report runs/a --format csv
      one row per channel and figure, to standard output
  hil-runtime report runs/a --format svg -o figures
      every figure as a file of its own; --figure timeline for one
  hil-runtime report runs/a runs/b --format pdf -o figures
      the same for print: also run-1-fig6-input.pdf to fig11 of teleoperation
  hil-runtime report runs/a --template lab.html -o report.html
      the data of --format json through a template of your own

A folder that `simulate --output` wrote is a run as well. A file that is there
already is overwritten only if it is a report, or with --force. docs/reports.md
has the rest.";

/// Runs a robot's controller and its model as separate processes, over shared memory or a real
/// network, and accounts for every microsecond in between.
#[derive(Debug, Parser)]
#[command(
    name = "hil-runtime",
    version,
    after_help = EXAMPLES,
    args_conflicts_with_subcommands = true,
    arg_required_else_help = true
)]
pub struct Cli {
    /// What to do, if not to run a topology.
    #[command(subcommand)]
    pub command: Option<Command>,

    /// Run this topology.
    #[command(flatten)]
    pub run: RunArgs,
}

/// Arguments of a run.
#[derive(Debug, Args)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "switches are independent of each other"
)]
pub struct RunArgs {
    /// The topology file (TOML).
    #[arg(long, short, value_name = "FILE")]
    pub topology: Option<PathBuf>,

    /// Name of this host in the topology; otherwise `HIL_HOST`, or found from the machine's name and
    /// addresses.
    #[arg(long, value_name = "NAME")]
    pub host: Option<String>,

    /// Run all hosts of the file on this PC, each with a network and shared memory of its own, joined by virtual
    /// Ethernet; needs neither root nor a key.
    #[arg(long, conflicts_with_all = ["host", "domain_root"])]
    pub on_one_pc: bool,

    /// With --on-one-pc: capture what passes each host's interfaces with the passive probe, to DIR/HOST.pcapng for
    /// `hil-runtime probe compare`.
    #[arg(long, value_name = "DIR")]
    pub probe: Option<PathBuf>,

    /// The host among those of --on-one-pc that this process is; not for use by hand.
    #[arg(long, value_name = "NAME", hide = true, conflicts_with_all = ["host", "on_one_pc"])]
    pub on_one_pc_as: Option<String>,

    /// Change one value of the file, e.g. --set run.duration='"5 s"'; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,

    /// Check the file, print what would run, start nothing; with --host also whether this machine can
    /// run its share: key, own programs by this shell's PATH and folder, memory, files, threads,
    /// interfaces, ports.
    #[arg(long)]
    pub check: bool,

    /// Print no progress, only the report.
    #[arg(long, short)]
    pub quiet: bool,

    /// Print every figure, not only the answer and what led to it.
    #[arg(long)]
    pub full: bool,

    /// Folder for the shared-memory domain; otherwise below /run or the temporary folder. Both
    /// hosts of a split run must have their own.
    #[arg(long, value_name = "DIR", hide = true)]
    pub domain_root: Option<PathBuf>,
}

/// Arguments of a calibration.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("wanted").required(true).args(["mlr", "figure"]))]
pub struct CalibrateArgs {
    /// The case; as much of its name as no other case has is enough.
    pub case: String,
    /// The motion loss rate to come out; short for --figure mlr=RATIO.
    #[arg(long, value_name = "RATIO", allow_negative_numbers = true)]
    pub mlr: Option<f64>,
    /// The figure and the value to come out; `hil-runtime cases` lists the figures of each case.
    #[arg(long, value_name = "NAME=VALUE")]
    pub figure: Option<String>,
    /// A topology file with the case's parameters; without it they have their defaults.
    #[arg(long, short, value_name = "FILE")]
    pub topology: Option<PathBuf>,
    /// Change one value of the file or of the defaults; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Runs per point of the curve; short for --set case.parameters.tables.seeds=N.
    #[arg(long, value_name = "N")]
    pub seeds: Option<u64>,
    /// How to compute and where to put the tables.
    #[command(flatten)]
    pub batch: BatchArgs,
}

/// Arguments of a report.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// The folders of the runs.
    #[arg(required = true, value_name = "RUN")]
    pub runs: Vec<PathBuf>,
    /// Write the report to this file (or figures to this folder) instead of printing it.
    #[arg(long, short, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// What to write; otherwise what the ending of --output says.
    #[arg(long, value_enum)]
    pub format: Option<Format>,
    /// Write one figure only, by its name.
    #[arg(long, value_name = "NAME")]
    pub figure: Option<String>,
    /// Put the data of --format json through this template (minijinja, which reads Jinja2).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["format", "figure"])]
    pub template: Option<PathBuf>,
    /// A run over a link that does not hurt: its values stand below the first ones of a page.
    #[arg(long, value_name = "RUN", conflicts_with = "figure")]
    pub against: Option<PathBuf>,
    /// Overwrite --output whatever it is.
    #[arg(long)]
    pub force: bool,
    /// Print every figure, not only the answer and what led to it.
    #[arg(long)]
    pub full: bool,
}

/// Arguments of a replay.
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// The run's folder, of either host.
    pub run: PathBuf,
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of a run of two programs.
#[derive(Debug, Args)]
pub struct JoinArgs {
    /// The link between the programs: words as in "delay 5ms loss 1% rate 10Mbit", or a topology file with
    /// one link. Without it nothing is delayed or lost on purpose.
    #[arg(long, value_name = "WORDS|FILE")]
    pub link: Option<String>,
    /// How long the programs run, e.g. 30s, where none of them ends before; without it, until one of them
    /// ends.
    #[arg(long, value_name = "TIME")]
    pub duration: Option<String>,
    /// Seed of the link's losses and delays. Without it each run has one of its own, which its report states, so
    /// that repetitions are independent.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Print no progress, only the report.
    #[arg(long, short)]
    pub quiet: bool,
    /// Print every figure, not only the answer and what led to it.
    #[arg(long)]
    pub full: bool,
    /// The first program, which has the address 10.77.0.1, and after another `--` the second, 10.77.0.2.
    #[arg(last = true, required = true, value_name = "FIRST -- SECOND")]
    pub programs: Vec<String>,
}

/// Everything but a run.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run a topology in virtual time: same components, same link models, no processes.
    #[command(
        after_help = "Example:\n  hil-runtime simulate --topology emulated.toml --set run.duration='\"1 h\"'"
    )]
    Simulate {
        /// The topology file (TOML).
        #[arg(long, short, value_name = "FILE")]
        topology: PathBuf,
        /// Change one value of the file; may be repeated.
        #[arg(long = "set", value_name = "KEY=VALUE")]
        overrides: Vec<String>,
        /// Also write the run's folder: summary.json, reports, events.log and the case's series.
        #[arg(long, short, value_name = "DIR")]
        output: Option<PathBuf>,
        /// Print every figure, not only the answer and what led to it.
        #[arg(long)]
        full: bool,
    },
    /// Run two programs that speak IP, neither of them changed, and put a link between them, on this PC.
    #[command(after_help = JOIN_EXAMPLES)]
    Join(JoinArgs),
    /// Compute a case's tables in virtual time, on all processors.
    #[command(after_help = TABLES_EXAMPLES)]
    Tables {
        /// The topology file (TOML); `[case]` and `[run]` are enough.
        #[arg(long, short, value_name = "FILE", required_unless_present = "record")]
        topology: Option<PathBuf>,
        /// First repeat runs in real time, on this PC, until each row that this file (TOML) names has enough of
        /// them; the file names the topology of the tables too.
        #[arg(long, value_name = "FILE", conflicts_with = "topology")]
        record: Option<PathBuf>,
        /// Record with other PCs instead, on which the same command is called: this one is this host of the rows' topologies.
        #[arg(long, value_name = "NAME", requires = "record")]
        host: Option<String>,
        /// Change one value of the file; may be repeated.
        #[arg(long = "set", value_name = "KEY=VALUE")]
        overrides: Vec<String>,
        /// Critical sections per cell; short for --set case.parameters.tables.sections=N.
        #[arg(long, value_name = "N")]
        sections: Option<u64>,
        /// Add the finished run in this folder as a row; `*` in the last part stands for several. LABEL says for which
        /// network of the paper it stands: ethernet, short or long. Runs of one label are pooled.
        #[arg(long = "run", value_name = "[LABEL=]FOLDER", num_args = 1..)]
        runs: Vec<RunArgument>,
        /// How to compute and where to put the tables.
        #[command(flatten)]
        batch: BatchArgs,
    },
    /// Find the link parameters under which a figure comes out as given, in virtual time.
    #[command(after_help = CALIBRATE_EXAMPLES)]
    Calibrate(CalibrateArgs),
    /// Print the report of a finished run again, or write it as a page, tables or figures.
    #[command(after_help = REPORT_EXAMPLES)]
    Report(ReportArgs),
    /// Compare two runs, or two sets of repetitions: delays, losses and scores, with intervals.
    #[command(after_help = compare_cli::EXAMPLES)]
    Compare(CompareArgs),
    /// Run the robot of a finished run again and compare every message.
    #[command(after_help = REPLAY_EXAMPLES)]
    Replay(ReplayArgs),
    /// Describe, fit, plot and convert link traces.
    #[command(
        after_help = "Examples:\n  hil-runtime trace info runs/NAME      # what its links did\n  hil-runtime trace fit runs/NAME/traces/shuttle.command.trace"
    )]
    Trace {
        /// What to do with them.
        #[command(subcommand)]
        command: TraceCommand,
    },
    /// Show the links of a run that goes on, and change emulated ones.
    #[command(
        after_help = "Examples:\n  hil-runtime link show\n  hil-runtime link set hop --delay 120ms --loss 0.3\n  hil-runtime link reset hop"
    )]
    Link {
        /// What to do with them.
        #[command(subcommand)]
        command: LinkCommand,
    },
    /// Look at the channels of a run while it goes: list, rate, messages, delay.
    Channel(ChannelArgs),
    /// Look at a run while it goes: processes, channels, links, clocks.
    Top(TopArgs),
    /// Make or check the key file that keeps strangers out of a run between two hosts.
    #[command(
        after_help = "Examples:\n  sudo hil-runtime key new /etc/hil-runtime/hop.key\n  sudo hil-runtime key check /etc/hil-runtime/hop.key   # its fingerprint"
    )]
    Key {
        /// What to do with it.
        #[command(subcommand)]
        command: KeyCommand,
    },
    /// Say what this host can measure and what to change.
    Doctor(DoctorArgs),
    /// Look at the wire without taking part: capture, analyse, compare with a run.
    Probe(ProbeArgs),
    /// List the case studies with their channels and parameters.
    #[command(after_help = "Example:\n  hil-runtime cases")]
    Cases,
    /// Write the sample human motion as a BVH file.
    #[command(after_help = "Example:\n  hil-runtime motion --output deploy/motions/swing.bvh")]
    Motion {
        /// Where to write it; standard output if left out.
        #[arg(long, short, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Time from one side to the other and back, seconds.
        #[arg(long, default_value_t = 4.033)]
        period: f64,
        /// Half the way from side to side, metres.
        #[arg(long, default_value_t = 0.1875)]
        amplitude: f64,
        /// Frames per second.
        #[arg(long, default_value_t = 125.0)]
        rate: f64,
    },
    /// Run a component, gateway, clock path, adapter or cable; started by a run, not by hand.
    #[command(hide = true)]
    Worker {
        /// Launch file written by the supervisor.
        #[arg(long)]
        launch: PathBuf,
    },
    /// Become the supervisor of a host of --on-one-pc; not for use by hand.
    #[command(hide = true)]
    BecomeHost {
        /// Process id of what started it.
        #[arg(long)]
        starter: u32,
        /// Arguments of the supervisor.
        #[arg(last = true, required = true)]
        arguments: Vec<String>,
    },
    /// Become a user's own program that ends with its supervisor; not for use by hand.
    #[command(hide = true)]
    Become {
        /// Process id of the supervisor.
        #[arg(long)]
        supervisor: u32,
        /// Files that the program may have open, if not as many as the supervisor.
        #[arg(long)]
        open_files: Option<u64>,
        /// Its address in a network namespace of its own, whose cable goes to standard input.
        #[arg(long)]
        inside: Option<IpAddr>,
        /// What to ask of the kernel for it, as JSON.
        #[arg(long)]
        realtime: Option<String>,
        /// Program and arguments.
        #[arg(last = true, required = true)]
        program: Vec<String>,
    },
    /// Write manual pages and completions for a package to this folder.
    #[command(hide = true)]
    Documents {
        /// Where to.
        folder: PathBuf,
    },
    /// Remove what runs whose supervisor was killed left in shared memory; a unit does so at its end.
    #[command(hide = true)]
    Sweep,
    /// Wait for the end of the program that set a network card up; not for use by hand.
    #[command(hide = true)]
    CardGuard(NicGuardArgs),
}

#[cfg(test)]
mod tests {
    use std::fs;

    use clap::CommandFactory as _;

    use super::*;
    use hil_topology::documents::write;

    #[test]
    fn every_command_that_help_shows_has_a_page_with_exit_codes() {
        let folder = std::env::temp_dir().join(format!("hil-documents-{}", std::process::id()));
        let written = write(Cli::command(), &folder).unwrap();
        let names: Vec<String> = written
            .iter()
            .map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
            .collect();
        for name in [
            "hil-runtime.1",
            "hil-runtime-doctor.1",
            "hil-runtime-trace-fit.1",
            "hil-runtime.bash",
            "_hil-runtime",
            "hil-runtime.fish",
        ] {
            assert!(names.iter().any(|one| one == name), "{name}: {names:?}");
        }
        for hidden in ["worker", "become", "help"] {
            let hidden = format!("hil-runtime-{hidden}.1");
            assert!(!names.contains(&hidden), "{hidden}");
        }
        let pages = written
            .iter()
            .filter(|path| path.starts_with(folder.join("man1")));
        for path in pages {
            let text = fs::read_to_string(path).unwrap();
            let (_, codes) = text.split_once("EXIT STATUS").unwrap_or_default();
            assert!(
                codes.contains("doctor \\-\\-strict"),
                "{}: {text}",
                path.display()
            );
        }
        fs::remove_dir_all(folder).unwrap();
    }
}
