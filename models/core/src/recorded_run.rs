//! A finished run in real time, with hardware in the loop, as a case's tables take it: typed, read by
//! whoever can open its folder. It judges no figure.

use core::fmt;
use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::interval::Spread;
use crate::options::Difference;
use crate::study::StudyRefusal;

hil_core::words! {
    /// A network over which the seed paper measured with hardware in the loop (section III.A).
    pub enum PublishedNetwork {
        /// A wire.
        Ethernet = "ethernet",
        /// A radio at 20 m.
        ShortRange = "short",
        /// A radio at 35 m.
        LongRange = "long",
    }
}

impl PublishedNetwork {
    /// What the paper calls it.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ethernet => "Ethernet",
            Self::ShortRange => "short-range Wi-Fi 6",
            Self::LongRange => "long-range Wi-Fi 6",
        }
    }
}

/// How large a sample the runs of a row of a case's tables make together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RowSample {
    /// The figure of the score that counts it.
    pub metric: &'static str,
    /// What it counts, in the plural.
    pub what: &'static str,
    /// As many are enough, where nobody asks for another number.
    pub enough: u64,
    /// The key below `[case.parameters]` that says how many copies of the robots share the channels, so that as many times
    /// more is counted in the same time.
    pub copies: Option<&'static str>,
}

hil_core::labelled! {
    /// What kind of link carried a run's messages between its hosts.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
    pub enum LinkOrigin, label {
        /// A network.
        Real = "real link",
        /// The model of one, on some channel at least.
        Emulated = "emulated link",
        /// The trace of one, on some channel at least.
        Traced = "link replayed from a trace",
    }
}

/// What carried a run's messages between its hosts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedLink {
    /// Of what kind it was.
    pub origin: LinkOrigin,
    /// Its transport, or what its model does, in words.
    pub about: String,
}

/// So many one-way delays above one and up to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DelayBin {
    /// Lower edge, not included.
    pub above_ns: i64,
    /// Upper edge, included.
    pub until_ns: i64,
    /// Messages.
    pub count: u64,
}

/// What the network did to a run's messages, on all channels that crossed it together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedCrossing {
    /// Messages, or datagrams, handed to it whose outcome is known.
    pub offered_count: u64,
    /// Of these, lost by it; else why that is unavailable.
    pub lost_count: Result<u64, String>,
    /// Their delays, from one host's kernel to the other's gateway, in any order; else why there are none.
    pub delays: Result<Vec<DelayBin>, String>,
}

/// What a passive probe at both hosts saw of a run's messages, from tap to tap (section II.D).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProbedCrossing {
    /// Of their datagrams.
    pub crossing: RecordedCrossing,
    /// Channels of which it sees no datagrams, since they go over TCP.
    pub left_out: Vec<String>,
}

/// A figure of a run's score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedMetric {
    /// The figure; `None` when the run did not allow it.
    pub value: Option<f64>,
    /// Its 95 % interval, or why there is none, where it is a statistic.
    pub interval: Option<Spread>,
}

/// Ticks that a run's processes passed over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SkippedTicks {
    /// So many.
    pub skipped_count: u64,
    /// Of so many that were due.
    pub due_count: u64,
}

impl SkippedTicks {
    /// True where more than this share of the ticks was skipped.
    pub fn is_above(self, ratio: f64) -> bool {
        self.skipped_count as f64 > ratio * self.due_count as f64
    }
}

impl fmt::Display for SkippedTicks {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            skipped_count,
            due_count,
        } = self;
        write!(
            formatter,
            "{skipped_count} of {due_count} ticks were skipped"
        )
    }
}

/// Why a recorded run may not be held against the published one.
#[derive(Debug, Clone, PartialEq)]
pub enum Doubt {
    /// It ended before its length.
    Stopped {
        /// Why, in words.
        reason: String,
    },
    /// Its measurement is not valid, or nothing tells that it is.
    NotValid {
        /// What is said of the measurement, in words.
        measurement: String,
    },
    /// Processes passed over more ticks than the row allows.
    SkippedTicks(SkippedTicks),
    /// A link was changed while the run went on.
    LinkChanged,
    /// Records of what the robot did are missing.
    ScoreIncomplete,
    /// Parameters are not those of the table.
    OtherParameters(Vec<Difference>),
    /// Another run of the row has the same seed of an emulated link, which draws the same for both.
    SharedSeed(u64),
}

impl Doubt {
    /// True where the figures themselves are in doubt, not only what they are held against.
    pub const fn is_of_measurement(&self) -> bool {
        !matches!(self, Self::OtherParameters(_))
    }
}

/// Parameters that are named where many differ.
const NAMED_COUNT: usize = 4;

impl fmt::Display for Doubt {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stopped { reason } => write!(formatter, "it did not run its length: {reason}"),
            Self::NotValid { measurement } => write!(formatter, "measurement {measurement}"),
            Self::SkippedTicks(ticks) => ticks.fmt(formatter),
            Self::LinkChanged => formatter.write_str("a link was changed while it went on"),
            Self::ScoreIncomplete => {
                formatter.write_str("records of what the robot did are missing")
            }
            Self::OtherParameters(all) => {
                let named = all.iter().take(NAMED_COUNT).map(|one| {
                    let Difference { key, found, wanted } = one;
                    format!("{key} is {found}, the table has {wanted}")
                });
                let named = named.collect::<Vec<_>>().join("; ");
                match all.len().saturating_sub(NAMED_COUNT) {
                    0 => formatter.write_str(&named),
                    more => write!(formatter, "{named}; and {more} more"),
                }
            }
            Self::SharedSeed(seed) => write!(
                formatter,
                "another run of the row has its seed {seed} of an emulated link, which draws the same for both"
            ),
        }
    }
}

/// A run that ended, with what a row of a case's tables shows of it. `P` is its `[case.parameters]`.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedRun<P> {
    /// Its folder, as it was named.
    pub folder: String,
    /// Name of its topology.
    pub name: String,
    /// The published network that it stands for; `None` where it stands for itself.
    pub network: Option<PublishedNetwork>,
    /// The row that it was made for, where that stands for no published network: runs of one such row are pooled.
    pub row: Option<String>,
    /// What carried its messages.
    pub link: RecordedLink,
    /// Seed of its random streams.
    pub seed: u64,
    /// Its `[case.parameters]`.
    pub parameters: P,
    /// What its processes did not keep up with.
    pub skipped: SkippedTicks,
    /// What the network did to its messages.
    pub crossing: RecordedCrossing,
    /// The same by a passive probe; `None` where none was there.
    pub probed: Option<ProbedCrossing>,
    /// The figures of its score by name.
    pub score: BTreeMap<String, RecordedMetric>,
    /// Scores of the same robots in virtual time over the traces of this run, each with a seed of its own, or why there are
    /// none; empty where none was asked for.
    pub replays: Result<Vec<BTreeMap<String, RecordedMetric>>, String>,
    /// Why it may be held against nothing; empty for most.
    pub doubts: Vec<Doubt>,
}

impl<P> RecordedRun<P> {
    /// True where its figures are not in doubt.
    pub fn is_sound(&self) -> bool {
        !self.doubts.iter().any(Doubt::is_of_measurement)
    }

    /// The count called `name` of its score.
    ///
    /// # Errors
    /// When the score has none.
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the value is checked to be a count that a real number holds exactly"
    )]
    pub fn count(&self, name: &str) -> Result<u64, StudyRefusal> {
        let value = self.score.get(name).and_then(|metric| metric.value);
        let count = value.filter(|value| (0.0..=9.0e15).contains(value));
        let count = count.map(|value| value.round() as u64);
        count.ok_or_else(|| self.refused(format!("its score has no {name}")))
    }

    /// The interval of the figure called `name` of its score, or why there is none; `None` where nothing is known of
    /// it.
    pub fn interval(&self, name: &str) -> Option<Spread> {
        self.score.get(name).and_then(|metric| metric.interval)
    }

    /// Why it cannot be a row.
    pub fn refused(&self, problem: impl Into<String>) -> StudyRefusal {
        StudyRefusal::Run {
            folder: self.folder.clone(),
            problem: problem.into(),
        }
    }

    /// The same run with what `read` makes of its parameters.
    ///
    /// # Errors
    /// That of `read`, with the folder.
    pub fn with_parameters<Q, E: fmt::Display>(
        self,
        read: impl FnOnce(P) -> Result<Q, E>,
    ) -> Result<RecordedRun<Q>, StudyRefusal> {
        let parameters = read(self.parameters).map_err(|error| StudyRefusal::Run {
            folder: self.folder.clone(),
            problem: format!("its case.parameters cannot be read: {error}"),
        })?;
        Ok(RecordedRun {
            folder: self.folder,
            name: self.name,
            network: self.network,
            row: self.row,
            link: self.link,
            seed: self.seed,
            parameters,
            skipped: self.skipped,
            crossing: self.crossing,
            probed: self.probed,
            score: self.score,
            replays: self.replays,
            doubts: self.doubts,
        })
    }
}
