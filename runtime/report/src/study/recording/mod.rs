//! `hil-runtime tables --record`: repeats runs in real time until each row of a case's tables has enough of them. It
//! starts no process itself, and makes no row: its runs are read as those of `--run` are.

mod folder;
mod next;
pub(in crate::study) mod trace_replay;

use std::collections::BTreeMap;
use std::fs::{self, File, TryLockError};
use std::io::{self, Seek as _};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use hil_core::recorded_run::{PublishedNetwork, RecordedRun, RowSample};
use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_platform::signals::Signals;
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_protocol::transport::IpProtocol;
use hil_stats::recorded::RecordedRow;
use hil_topology::registry::Registry;
use hil_topology::{Link, Recording, Topology, Via};
use serde_json::Value;

use self::folder::{Part, RowFolder};
use self::next::{Found, Next, REFUSED_MAX, Target, next};
use super::RunArgument;
use super::probed;
use super::recorded::recorded;
use crate::compare::{ComparedRun, add_leaves};
use crate::summary::Outcome;

/// A trial only shows whether the host keeps up.
const TRIAL: &str = "15 s";
/// The lock of the folder, and what the last run said.
const LAST_RUN: &str = "last-run.log";
/// What a run of a killed call may take to end in order.
const LOCK_PATIENCE: Duration = Duration::from_mins(1);
const LOCK_PERIOD: Duration = Duration::from_millis(200);
/// Where a case's keys are.
const PARAMETERS: &str = "case.parameters.";
/// More of their messages than of one copy's are lost by a network that many copies load. Trials have one seed, and an emulated link
/// the same outages.
const LOSS_MORE_MAX: f64 = 0.01;
/// Their messages wait for each other, which come at once; a queue that grows makes it more than this.
const DELAY_TIMES_MAX: f64 = 10.0;
/// Keys that are named where many differ.
const NAMED_COUNT: usize = 4;

/// How the process of a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunEnd {
    /// What it left tells.
    Over,
    /// This host has too little for it.
    HostTooSmall,
    /// If it did not begin, another one with these arguments would not either.
    Hopeless,
}

/// Starts a run by its arguments, with its outputs to a file, and waits for its end; calls the last one now and then.
pub type Start<'a> = &'a mut dyn FnMut(&[String], &File, &mut dyn FnMut()) -> io::Result<RunEnd>;

/// What came of a recording.
#[derive(Debug, Default)]
pub struct Recorded {
    /// The sound runs of each row.
    pub runs: Vec<RunArgument>,
    /// What each row has, in words.
    pub remarks: Vec<String>,
    /// Why rows do not have enough.
    pub faults: Vec<String>,
}

/// Why nothing is recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The case of the tables takes no recorded runs.
    #[error("{file}: case {case} has no rows of recorded runs")]
    NoRows {
        /// The topology of the tables.
        file: String,
        /// Its case.
        case: String,
    },
    /// Runs of a row cannot be made, or those in its folder are not of it.
    #[error("rows.{row}: {problem}")]
    Row {
        /// The row.
        row: String,
        /// What is wrong, and where.
        problem: String,
    },
    /// A signal came while the last run of a call before was waited for.
    #[error("interrupted while the last run of a call before was waited for")]
    Interrupted,
    /// Another call records into the folder.
    #[error(
        "{}: another call records into this folder, or a run of one that was killed has not ended yet",
        .0.display()
    )]
    Busy(PathBuf),
    /// A file cannot be read or written, or a run not be started.
    #[error("{}: {source}", path.display())]
    Io {
        /// Where.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

/// A row to be recorded.
#[derive(Debug)]
struct Row<'a> {
    name: &'a str,
    network: Option<PublishedNetwork>,
    file: &'a str,
    settings: &'a [String],
    topology: Topology,
    sample: RowSample,
    target: Target,
    case: &'static str,
    /// A run that skipped a larger share of its ticks is refused.
    skipped_ratio_max: f64,
    /// A passive probe captures at these hosts; nowhere if there are none.
    probed: Vec<String>,
    folder: RowFolder,
}

impl Row<'_> {
    fn failed(&self, source: io::Error) -> RecordingError {
        let path = self.folder.under_way();
        RecordingError::Io { path, source }
    }

    fn refused(&self, problem: String) -> RecordingError {
        let row = self.name.to_owned();
        RecordingError::Row { row, problem }
    }

    /// A run of it in `folder`, as one of the command line.
    fn argument(&self, folder: &Path) -> RunArgument {
        RunArgument::of(self.name, self.network, folder).allow(self.skipped_ratio_max)
    }

    fn recorded(&self, run: ComparedRun) -> Result<RecordedRun<Value>, String> {
        let argument = self.argument(&run.folder);
        recorded(run, &argument, self.case)
    }

    /// What `run` counted, of which a trial may be too short to count anything.
    ///
    /// # Errors
    /// Why it may not be part of the row.
    fn judge(&self, run: ComparedRun, part: Part) -> Result<u64, String> {
        let run = self.recorded(run)?;
        let doubts: Vec<_> = run.doubts.iter().map(ToString::to_string).collect();
        if !doubts.is_empty() {
            return Err(doubts.join("; "));
        }
        if let Part::Trial(2..) = part {
            let one = ComparedRun::read(&self.folder.path(Part::Trial(1)));
            let one = self.recorded(one.map_err(|error| error.to_string())?)?;
            if let Some(why) = overload(one, run.clone()) {
                return Err(why);
            }
        }
        match run.count(self.sample.metric) {
            Ok(0) if !part.is_trial() => Err(format!("it counted no {}", self.sample.what)),
            count => count.map_err(|refusal| refusal.to_string()),
        }
    }

    /// The arguments that keep what its probe saw of the run in `folder`.
    fn probe_comparison(&self, folder: &Path) -> Vec<String> {
        let mut arguments = ["probe", "compare", "--keep"].map(str::to_owned).to_vec();
        arguments.push(folder.display().to_string());
        let captures = self.probed.iter().map(|host| {
            let file = self.folder.captures().join(format!("{host}.pcapng"));
            file.display().to_string()
        });
        arguments.extend(captures);
        arguments
    }

    /// What its folder holds.
    fn found(&self) -> Result<Found, RecordingError> {
        let mut found = Found::default();
        let failed = |source| self.failed(source);
        // Of a call that was killed.
        self.folder.clear().map_err(failed)?;
        for part in self.folder.parts().map_err(failed)? {
            let outcome = match self.folder.cause(part).map_err(failed)? {
                Some(cause) => Err(cause),
                None => Ok(self.kept(part).map_err(|problem| self.refused(problem))?),
            };
            found.add(part, outcome);
        }
        Ok(found)
    }

    /// What a kept run counted.
    ///
    /// # Errors
    /// When it is not what the row asks for.
    fn kept(&self, part: Part) -> Result<u64, String> {
        let folder = self.folder.path(part);
        let run = ComparedRun::read(&folder).map_err(|error| error.to_string())?;
        let differences = self.differences(&run.topology, part);
        if !differences.is_empty() {
            return Err(format!(
                "{} was recorded with other keys: {differences}; give the file another `folder`, or remove this one",
                folder.display()
            ));
        }
        if matches!(part, Part::Run(_))
            && !self.probed.is_empty()
            && !folder.join(probed::FILE).is_file()
        {
            return Err(format!(
                "{} was recorded without a probe; leave out `probe`, give the file another `folder`, or remove this one",
                folder.display()
            ));
        }
        let count = self.judge(run, part);
        count.map_err(|why| {
            format!(
                "{}: {why}, which the row does not allow; give the file another `folder`, or remove this one",
                folder.display()
            )
        })
    }

    /// In what the topology of a kept run differs from the row's, but for what each run has for itself, in words.
    fn differences(&self, kept: &Value, part: Part) -> String {
        let is_own = |key: &str| {
            matches!(key, "run.seed" | "run.record" | "security.key")
                || part.is_trial() && key == "run.duration"
                || self
                    .sample
                    .copies
                    .is_some_and(|own| key.strip_prefix(PARAMETERS) == Some(own))
        };
        let leaves = |value: &Value| {
            let mut leaves = BTreeMap::new();
            add_leaves(&mut leaves, "", value);
            leaves.retain(|key, _| !is_own(key));
            leaves
        };
        let wanted = serde_json::to_value(self.topology.resolved()).unwrap_or(Value::Null);
        let [kept, wanted] = [kept, &wanted].map(leaves);
        let mut keys: Vec<&String> = kept.keys().chain(wanted.keys()).collect();
        keys.sort_unstable();
        keys.dedup();
        keys.retain(|key| kept.get(*key) != wanted.get(*key));
        let value = |of: &BTreeMap<String, String>, key: &str| {
            of.get(key)
                .map_or_else(|| "nothing".to_owned(), Clone::clone)
        };
        let named = keys.iter().take(NAMED_COUNT).map(|key| {
            format!(
                "{key} was {}, is {}",
                value(&kept, key),
                value(&wanted, key)
            )
        });
        let named = named.collect::<Vec<_>>().join("; ");
        match keys.len().saturating_sub(NAMED_COUNT) {
            0 => named,
            more => format!("{named}; and {more} more"),
        }
    }

    /// What is done while `share` of `part` is over, in words, and what is counted by then, if this run counts as those before.
    fn progress(&self, part: Part, share: f64, found: &Found) -> (String, f64) {
        let (name, count, runs) = (self.name, found.count(), found.runs.len());
        let words = match part {
            Part::Trial(copies) => {
                format!(
                    "{name}: trial, {} {copies}",
                    self.sample.copies.unwrap_or_default()
                )
            }
            Part::Run(_) | Part::Refused(_) => format!(
                "{name}: run {}; {} of {} {}",
                runs + 1,
                grouped(count),
                grouped(self.target.enough),
                self.sample.what
            ),
        };
        let of_run = share * count as f64 / runs.max(1) as f64;
        (words, count as f64 + of_run)
    }

    /// What it has, in words.
    fn remark(&self, found: &Found) -> String {
        let Self {
            name,
            sample,
            target,
            ..
        } = self;
        let mut text = format!(
            "{name}: {} of {} {} in {}",
            grouped(found.count()),
            grouped(target.enough),
            sample.what,
            counted(found.runs.len() as u64, "run")
        );
        if let Some((copies, key)) = found
            .copies()
            .zip(sample.copies)
            .filter(|_| target.is_tried)
        {
            text = format!("{text} of {copies} {key}");
            if let Some((more, Some(why))) = found.trials.last_key_value() {
                text = format!("{text} (with {more}: {why})");
            }
        }
        if !found.refused.is_empty() {
            let refused = found.refused.iter();
            let refused: Vec<_> = refused
                .map(|(seed, why)| {
                    format!(
                        "{} ({why})",
                        self.folder.path(Part::Refused(*seed)).display()
                    )
                })
                .collect();
            let count = counted(refused.len() as u64, "run");
            text = format!(
                "{text}; {count} refused and kept apart: {}",
                refused.join(", ")
            );
        }
        text
    }
}

/// Why `many` copies do not meet the network that `one` met: as many messages as they send change what it does.
fn overload(one: RecordedRun<Value>, many: RecordedRun<Value>) -> Option<String> {
    let rows = [one, many].map(|run| RecordedRow::of_runs(vec![run], |_, _| true));
    let rows = rows.each_ref().map(|rows| rows.first());
    let of = |figure: fn(&RecordedRow<Value>) -> Option<f64>| rows.map(|row| row.and_then(figure));
    if let [Some(one), Some(many)] = of(RecordedRow::loss_ratio)
        && many > one + LOSS_MORE_MAX
    {
        let [one, many] = [one, many].map(|ratio| 100.0 * ratio);
        return Some(format!(
            "they load the network, which lost {many:.1} % of their messages and {one:.1} % of one's"
        ));
    }
    if let [Some(one), Some(many)] = of(|row| row.delay_ms(0.5))
        && many > DELAY_TIMES_MAX * one
    {
        return Some(format!(
            "they load the network, which took {many:.2} ms for half of their messages and {one:.2} ms for one's"
        ));
    }
    None
}

/// The rows of `recording` for tables of the case of `tables`.
fn rows<'a>(
    recording: &'a Recording,
    tables: &Topology,
    registry: &Registry,
    host: Option<&str>,
) -> Result<Vec<Row<'a>>, RecordingError> {
    let wanted = tables.case().map_or("none", |case| case.name.as_str());
    let entry = registry.find(wanted);
    let of_case = entry.and_then(|entry| Some((entry.name, entry.row_sample?)));
    let (case, sample) = of_case.ok_or_else(|| RecordingError::NoRows {
        file: recording.tables.clone(),
        case: wanted.to_owned(),
    })?;
    let root = Path::new(&recording.folder);
    let rows = recording.rows.0.iter().map(|(name, row)| {
        let file = Path::new(&row.topology);
        let topology = hil_topology::load(file, &row.set, registry.known());
        let refused = |problem: String| RecordingError::Row {
            row: name.clone(),
            problem,
        };
        let topology = topology.map_err(|errors| refused(format!("topology: {errors}")))?;
        let found = topology.case().map_or("none", |case| case.name.as_str());
        if found != case {
            let problem = format!(
                "topology {} is of case {found}, and the tables are of {case}",
                row.topology
            );
            return Err(refused(problem));
        }
        let is_tried = sample
            .copies
            .is_some_and(|key| !row.sets(&format!("{PARAMETERS}{key}")));
        let probed = if row.probe {
            let hosts = probed_hosts(&topology, host);
            hosts.map_err(|why| refused(format!("probe = true, and {why}")))?
        } else {
            Vec::new()
        };
        Ok(Row {
            name,
            network: row.network,
            file: &row.topology,
            settings: &row.set,
            topology,
            sample,
            target: Target {
                enough: row.enough.unwrap_or(sample.enough),
                seed: row.seed,
                is_tried,
            },
            case,
            skipped_ratio_max: row.skipped_ratio_max,
            probed,
            folder: RowFolder::new(root.join(name)),
        })
    });
    rows.collect()
}

/// The hosts at which a probe captures; else why its figures would not be the network's.
fn probed_hosts(topology: &Topology, host: Option<&str>) -> Result<Vec<String>, &'static str> {
    let links = topology.links();
    if host.is_some() {
        return Err(
            "with --host each PC has a capture of its own; leave out `probe`, make runs by hand with `hil-runtime probe` beside \
             them, and give them with --run",
        );
    }
    if links.iter().any(|link| link.emulation().is_some()) {
        return Err(
            "a link is emulated: its gateways keep what it delays and drop what it loses before the wire",
        );
    }
    let is_of_datagrams = |link: &Link| match &link.via {
        Via::Network(hop) => hop.transport.capabilities.receiver_port != Some(IpProtocol::Tcp),
        _ => false,
    };
    if !links.iter().any(is_of_datagrams) {
        return Err("no link has datagrams that a probe can read");
    }
    match topology.hosts() {
        [one, other] => Ok(vec![one.name.clone(), other.name.clone()]),
        _ => Err("its topology has not two hosts"),
    }
}

/// Records what the rows of `recording` lack, with all hosts on this PC, or as this `host` beside others. A run that was under way
/// when a call was killed is made again.
///
/// # Errors
/// When a topology, a run in the folder, or the folder itself cannot be used.
pub fn record(
    recording: &Recording,
    tables: &Topology,
    registry: &Registry,
    host: Option<&str>,
    start: Start<'_>,
    signals: &Signals,
    console: &mut Console,
) -> Result<Recorded, RecordingError> {
    let rows = rows(recording, tables, registry, host)?;
    let said = lock(Path::new(&recording.folder), signals, console)?;
    // Before the first run: a fault of the last row would be told after hours.
    let found = rows.iter().map(Row::found).collect::<Result<Vec<_>, _>>()?;
    let mut recorded = Recorded::default();
    let mut maker = RunMaker {
        registry,
        host,
        start,
        said,
        signals,
        console,
    };
    for (row, mut found) in rows.iter().zip(found) {
        recorded.faults.extend(maker.fill(row, &mut found)?);
        recorded.remarks.push(row.remark(&found));
        let runs = found
            .runs
            .keys()
            .map(|seed| row.folder.path(Part::Run(*seed)));
        recorded.runs.extend(runs.map(|path| row.argument(&path)));
    }
    Ok(recorded)
}

/// The file that runs say their words to, held by this call and by each of its runs.
fn lock(folder: &Path, signals: &Signals, console: &mut Console) -> Result<Said, RecordingError> {
    let path = folder.join(LAST_RUN);
    let failed = |source| RecordingError::Io {
        path: path.clone(),
        source,
    };
    fs::create_dir_all(folder).map_err(failed)?;
    let options = File::options()
        .create(true)
        .truncate(false)
        .read(true)
        .write(true)
        .open(&path);
    let file = options.map_err(failed)?;
    let progress = Progress::begin();
    let deadline = Instant::now() + LOCK_PATIENCE;
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(Said { path, file }),
            Err(TryLockError::WouldBlock) if signals.received().is_some() => {
                return Err(RecordingError::Interrupted);
            }
            Err(TryLockError::WouldBlock) if Instant::now() < deadline => {
                progress.show(
                    console,
                    None,
                    "waiting for the last run of a call before to end",
                );
                thread::sleep(LOCK_PERIOD);
            }
            Err(TryLockError::WouldBlock) => return Err(RecordingError::Busy(folder.to_owned())),
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
    }
}

/// What the last run said.
#[derive(Debug)]
struct Said {
    path: PathBuf,
    file: File,
}

impl Said {
    fn empty(&self) -> io::Result<()> {
        self.file.set_len(0)?;
        (&self.file).rewind()
    }

    fn text(&self) -> String {
        let bytes = fs::read(&self.path).unwrap_or_default();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn last_line(&self) -> String {
        let text = self.text();
        let last = text.lines().map(str::trim).rfind(|line| !line.is_empty());
        last.unwrap_or("it left no report and said nothing")
            .to_owned()
    }
}

/// Makes runs.
struct RunMaker<'a> {
    registry: &'a Registry,
    host: Option<&'a str>,
    start: Start<'a>,
    said: Said,
    signals: &'a Signals,
    console: &'a mut Console,
}

/// What came of a run.
enum Made {
    /// It may be part of the row, and lies here.
    Sound { folder: PathBuf, count: u64 },
    /// It may not.
    Refused(String),
    /// No other one would come about.
    Hopeless(String),
    /// A signal ended it.
    Interrupted,
}

impl RunMaker<'_> {
    /// Makes runs until `row` has enough, or a signal comes; else why it has not.
    fn fill(&mut self, row: &Row<'_>, found: &mut Found) -> Result<Option<String>, RecordingError> {
        let failed = |source| row.failed(source);
        let (begun, count_before) = (Progress::begin(), found.count());
        let (mut refused_count, mut last) = (0, String::new());
        while self.signals.received().is_none() {
            let (part, copies) = match next(&row.target, found, refused_count) {
                Next::Enough => break,
                Next::RefusedTooOften => {
                    let fewer = row.sample.copies.map_or_else(String::new, |key| {
                        format!(", or fewer {key}, e.g. {PARAMETERS}{key}=1 in its `set`")
                    });
                    return Ok(Some(format!(
                        "{}: {REFUSED_MAX} runs in a row were refused, the last one because: {last}; it takes less other \
                         work on this host{fewer}; then call again",
                        row.name
                    )));
                }
                Next::Make { part, copies } => (part, copies),
            };
            let made = self.make(row, part, copies, &mut |share, console| {
                let (words, made) = row.progress(part, share, found);
                let made = made - count_before as f64;
                let wanted = row.target.enough.saturating_sub(count_before).max(1);
                begun.show(console, Some(made / wanted as f64), &words);
            })?;
            let outcome = match made {
                Made::Sound { folder, count } => {
                    row.folder.keep(&folder, part).map_err(failed)?;
                    Ok(count)
                }
                Made::Refused(why) => {
                    let place = part.refused();
                    row.folder
                        .put_aside(place, &why, &self.said.text())
                        .map_err(failed)?;
                    self.console
                        .say(&format!("{}: {why}", row.folder.path(place).display()));
                    last.clone_from(&why);
                    Err(why)
                }
                Made::Hopeless(why) => {
                    row.folder.clear().map_err(failed)?;
                    return Ok(Some(format!("{}: {why}", row.name)));
                }
                Made::Interrupted => {
                    row.folder.clear().map_err(failed)?;
                    break;
                }
            };
            refused_count = match (&outcome, part) {
                (Ok(_), _) => 0,
                // The host keeps fewer.
                (Err(_), Part::Trial(2..)) => refused_count,
                (Err(_), _) => refused_count + 1,
            };
            found.add(part, outcome);
        }
        Ok(None)
    }

    /// Makes the run of `part`; calls `meanwhile` with the share of it that is over.
    fn make(
        &mut self,
        row: &Row<'_>,
        part: Part,
        copies: Option<u64>,
        meanwhile: &mut dyn FnMut(f64, &mut Console),
    ) -> Result<Made, RecordingError> {
        let failed = |source| row.failed(source);
        row.folder.begin().map_err(failed)?;
        self.said.empty().map_err(failed)?;
        let mut overrides = row.settings.to_vec();
        let copies = row.sample.copies.zip(copies);
        overrides.extend(copies.map(|(key, count)| format!("{PARAMETERS}{key}={count}")));
        let seed = match part {
            Part::Trial(_) => {
                overrides.push(format!("run.duration={TRIAL}"));
                row.target.seed
            }
            Part::Run(seed) | Part::Refused(seed) => seed,
        };
        // So many copies may be more than the case allows.
        let topology = hil_topology::load(Path::new(row.file), &overrides, self.registry.known());
        let length = match topology {
            Ok(topology) => topology.run().duration,
            Err(errors) => return Ok(Made::Refused(errors.to_string())),
        };
        overrides.push(format!("run.seed={seed}"));
        overrides.push(format!("run.record={}", row.folder.under_way().display()));
        let mut arguments = ["--topology", row.file, "--quiet"]
            .map(str::to_owned)
            .to_vec();
        arguments.extend(match self.host {
            None => vec!["--on-one-pc".to_owned()],
            Some(name) => vec!["--host".to_owned(), name.to_owned()],
        });
        if !row.probed.is_empty() {
            let captures = row.folder.captures().display().to_string();
            arguments.extend(["--probe".to_owned(), captures]);
        }
        arguments.extend(
            overrides
                .into_iter()
                .flat_map(|one| ["--set".to_owned(), one]),
        );
        let begun = Instant::now();
        let end = (self.start)(&arguments, &self.said.file, &mut || {
            let share = begun.elapsed().as_secs_f64() / length.as_secs_f64();
            meanwhile(share.min(1.0), self.console);
        });
        let end = end.map_err(failed)?;
        let folder = row.folder.ended().map_err(failed)?;
        if folder.is_none() && end != RunEnd::Over {
            let why = self.said.last_line();
            return Ok(match (end, part) {
                // One copy fewer may be kept.
                (RunEnd::HostTooSmall, Part::Trial(2..)) => Made::Refused(why),
                _ => Made::Hopeless(why),
            });
        }
        let mut ended_elsewhere = None;
        let mut outcome = folder
            .ok_or_else(|| self.said.last_line())
            .and_then(|folder| {
                let run = ComparedRun::read(&folder).map_err(|error| error.to_string())?;
                let facts = &run.summary.run;
                ended_elsewhere =
                    (facts.outcome == Outcome::Stopped).then(|| facts.exit_reason.clone());
                let count = row.judge(run, part)?;
                Ok(Made::Sound { folder, count })
            });
        if let (Ok(Made::Sound { folder, .. }), Part::Run(_)) = (&outcome, part) {
            // After a signal as well: the run is whole, and neither its captures nor its traces are kept.
            let console = &mut *self.console;
            let mut meanwhile = || meanwhile(1.0, console);
            if row.probed.is_empty() {
                trace_replay::write(folder, self.registry, &mut meanwhile).map_err(failed)?;
            } else {
                let arguments = row.probe_comparison(folder);
                (self.start)(&arguments, &self.said.file, &mut meanwhile).map_err(failed)?;
                if folder.join(probed::FILE).is_file() {
                    trace_replay::write(folder, self.registry, &mut meanwhile).map_err(failed)?;
                } else {
                    let why = self.said.last_line();
                    outcome = Err(format!("its probe's captures tell nothing: {why}"));
                }
            }
        }
        Ok(match outcome {
            Ok(made) => made,
            Err(_) if self.signals.received().is_some() => Made::Interrupted,
            // As the call on the host that ended it, this one makes it again: all hosts make the same runs.
            Err(why) => ended_elsewhere.map_or(Made::Refused(why), Made::Hopeless),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use hil_core::recorded_run::{
        DelayBin, LinkOrigin, RecordedCrossing, RecordedLink, SkippedTicks,
    };
    use hil_shuttle::Shuttle;

    const FILE: &str = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../deploy/topologies/shuttle-split.toml"
    );

    fn registry() -> Registry {
        let mut registry = Registry::default();
        registry.add::<Shuttle>();
        registry
    }

    fn topology(overrides: &[&str]) -> Topology {
        let overrides: Vec<_> = overrides.iter().map(|&text| text.to_owned()).collect();
        hil_topology::load(Path::new(FILE), &overrides, registry().known()).unwrap()
    }

    fn row(overrides: &[&str]) -> Row<'static> {
        Row {
            name: "a",
            network: None,
            file: FILE,
            settings: &[],
            topology: topology(overrides),
            sample: RowSample {
                metric: "trips_count",
                what: "trips",
                enough: 100,
                copies: Some("gain_per_s"),
            },
            target: Target {
                enough: 2000,
                seed: 1,
                is_tried: true,
            },
            case: "shuttle",
            skipped_ratio_max: 0.0,
            probed: Vec::new(),
            folder: RowFolder::new(PathBuf::from("runs/a")),
        }
    }

    #[test]
    fn a_run_of_other_keys_is_told_by_them_and_what_each_run_has_is_none() {
        let kept =
            |overrides: &[&str]| serde_json::to_value(topology(overrides).resolved()).unwrap();
        let differences = |overrides: &[&str], part| row(&[]).differences(&kept(overrides), part);
        let own = [
            "run.seed=7",
            "run.record=x/y",
            "security.key=/dev/shm/hop.key",
            "case.parameters.gain_per_s=3.0",
        ];
        assert_eq!(differences(&own, Part::Run(7)), "");
        assert_eq!(differences(&["run.duration=15 s"], Part::Trial(2)), "");
        let longer = differences(&["run.duration=15 s", "name=other"], Part::Run(7));
        assert!(
            longer.starts_with("name was other, is shuttle-split; run.duration was 15 s, is "),
            "{longer}"
        );
    }

    #[test]
    fn copies_that_change_the_network_are_too_many() {
        let run = |lost_count: u64, until_ns: i64| RecordedRun {
            folder: String::new(),
            name: String::new(),
            network: None,
            row: None,
            link: RecordedLink {
                origin: LinkOrigin::Emulated,
                about: String::new(),
            },
            seed: 1,
            parameters: Value::Null,
            crossing: RecordedCrossing {
                offered_count: 1000,
                lost_count: Ok(lost_count),
                delays: Ok(vec![DelayBin {
                    above_ns: 0,
                    until_ns,
                    count: 1000,
                }]),
            },
            score: BTreeMap::new(),
            skipped: SkippedTicks::default(),
            probed: None,
            replays: Ok(Vec::new()),
            doubts: Vec::new(),
        };
        let of = |many| overload(run(20, 1_000_000), many);
        assert_eq!(of(run(29, 9_000_000)), None);
        let lost = of(run(454, 1_000_000)).unwrap();
        assert!(
            lost.contains("lost 45.4 % of their messages and 2.0 % of one's"),
            "{lost}"
        );
        let late = of(run(20, 11_000_000)).unwrap();
        assert!(
            late.contains("took 5.50 ms for half of their messages and 0.50 ms"),
            "{late}"
        );
    }

    #[test]
    fn a_run_that_does_not_begin_ends_the_row_and_a_trial_that_is_too_large_does_not() {
        let root = std::env::temp_dir().join(format!("hil-recording-{}", std::process::id()));
        fs::create_dir_all(&root).unwrap();
        let row = Row {
            folder: RowFolder::new(root.join("a")),
            ..row(&[])
        };
        let made = |end: RunEnd, part: Part| {
            let path = root.join(LAST_RUN);
            let mut said = File::options();
            let said = said.create(true).truncate(true).read(true).write(true);
            let file = said.open(&path).unwrap();
            let mut maker = RunMaker {
                registry: &registry(),
                host: None,
                start: &mut |_, output, _| {
                    io::Write::write_all(&mut { output }, b"error: too little\n")?;
                    Ok(end)
                },
                said: Said { path, file },
                signals: &Signals::install().unwrap(),
                console: &mut Console::new(true),
            };
            match maker.make(&row, part, None, &mut |_, _| {}).unwrap() {
                Made::Refused(why) => ("refused", why),
                Made::Hopeless(why) => ("hopeless", why),
                Made::Sound { .. } | Made::Interrupted => panic!("it left nothing"),
            }
        };
        for (end, part, expected) in [
            (RunEnd::HostTooSmall, Part::Trial(2), "refused"),
            (RunEnd::HostTooSmall, Part::Trial(1), "hopeless"),
            (RunEnd::HostTooSmall, Part::Run(1), "hopeless"),
            (RunEnd::Hopeless, Part::Trial(2), "hopeless"),
            (RunEnd::Over, Part::Run(1), "refused"),
        ] {
            let why = "error: too little".to_owned();
            assert_eq!(made(end, part), (expected, why), "{end:?} {part:?}");
        }
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn a_row_says_what_it_has_and_what_was_refused_why() {
        let mut found = Found::default();
        found.add(Part::Trial(2), Ok(0));
        found.add(Part::Trial(4), Err("3 ticks were skipped".to_owned()));
        found.add(Part::Run(1), Ok(700));
        found.add(Part::Run(2), Err("5 ticks were skipped".to_owned()));
        found.add(Part::Run(3), Ok(500));
        assert_eq!(
            row(&[]).remark(&found),
            "a: 1,200 of 2,000 trips in 2 runs of 2 gain_per_s (with 4: 3 ticks were skipped); 1 run refused and kept \
             apart: runs/a/refused-2 (5 ticks were skipped)"
        );
        let (words, made) = row(&[]).progress(Part::Run(4), 0.5, &found);
        assert_eq!(words, "a: run 3; 1,200 of 2,000 trips");
        assert!((made - 1500.0).abs() < 1e-9);
    }

    #[test]
    fn rows_are_of_the_case_of_the_tables_and_of_one_that_has_them() {
        let recording = Recording {
            tables: FILE.to_owned(),
            ..Recording::TEMPLATE
        };
        let error = rows(&recording, &topology(&[]), &registry(), None).unwrap_err();
        assert_eq!(
            error.to_string(),
            format!("{FILE}: case shuttle has no rows of recorded runs")
        );
    }

    #[test]
    fn a_probe_is_where_it_sees_the_network_of_both_hosts() {
        let hosts = |overrides: &[&str], host| probed_hosts(&topology(overrides), host);
        let both = vec!["control-pc".to_owned(), "robot-pc".to_owned()];
        assert_eq!(hosts(&[], None), Ok(both));
        let emulated = ["links.hop.via=emulated", "links.hop.delay=1 ms"];
        for (overrides, host, expected) in [
            (&[][..], Some("robot-pc"), "make runs by hand"),
            (&emulated, None, "a link is emulated"),
            (&["links.hop.via=tcp"], None, "no link has datagrams"),
        ] {
            let why = hosts(overrides, host).unwrap_err();
            assert!(why.contains(expected), "{why}");
        }
    }
}
