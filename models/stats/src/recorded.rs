//! Recorded runs pooled to rows of a case's tables: shares with their intervals, loss and delay of the
//! network, and how a row stands to the published one. It knows no case.

use core::fmt;
use std::collections::{BTreeMap, BTreeSet};

use hil_core::interval::{Interval, Spread, TooSmall};
use hil_core::recorded_run::{Doubt, LinkOrigin, RecordedCrossing, RecordedRun, SkippedTicks};
use hil_core::study::Verdict;

use crate::comparison::{Estimate, Judge, Scatter, Share, estimate_against_published};
use crate::statistics::clopper_pearson_at;

/// What happened in one run: so many of so many.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunShare {
    /// Both counts.
    pub share: Share,
    /// The interval of the share on the run's effective sample, or why there is none; `None` where nothing is known
    /// of it.
    pub interval: Option<Spread>,
}

/// What the interval of a pooled share rests on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Basis {
    /// The effective sample of the only run.
    OwnSample,
    /// Counts divided by so much, from how the runs scatter.
    AmongRuns(f64),
    /// Of none at all, counts divided by so much, as in the other cells of the table.
    LikeTheTable(f64),
    /// There is no interval.
    None(Option<TooSmall>),
}

impl fmt::Display for Basis {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OwnSample => formatter.write_str("interval on the run's effective sample"),
            Self::AmongRuns(scatter) => write!(
                formatter,
                "interval of counts divided by {scatter:.2}, the scatter among the runs"
            ),
            Self::LikeTheTable(scatter) => write!(
                formatter,
                "none seen: interval of counts divided by {scatter:.2}, the scatter of the table's cells"
            ),
            Self::None(Some(why)) => why.fmt(formatter),
            Self::None(None) => formatter.write_str("no interval: the runs give none"),
        }
    }
}

/// What happened in all runs of a row together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PooledShare {
    /// Both counts; as many as there are, where more happened.
    pub share: Share,
    /// 95 % interval of the share.
    pub interval: Option<Interval>,
    /// What that rests on.
    pub basis: Basis,
    /// Variance over that of independent trials, at least 1.
    scatter: f64,
}

impl PooledShare {
    /// Pools `runs`. Of a single run it keeps the run's own interval; where nothing happened the counts are divided by
    /// `of_none`, at least 1, or have no interval where that is not known.
    pub fn of(runs: &[RunShare], of_none: Option<f64>) -> Self {
        let shares: Vec<Share> = runs.iter().map(|run| run.share).collect();
        let of = shares.iter().map(|one| one.of).sum();
        let count: u64 = shares.iter().map(|one| one.count).sum();
        let share = Share {
            count: count.min(of),
            of,
        };
        let exact = |scatter| share.estimate(scatter).and_then(|one| one.interval);
        let without = |why| (None, Basis::None(why), 1.0);
        let (interval, basis, scatter) = match runs {
            _ if count == 0 => match of_none {
                Some(of_none) => {
                    let scatter = of_none.max(1.0);
                    (exact(scatter), Basis::LikeTheTable(scatter), scatter)
                }
                None => without(None),
            },
            [only] => match only.interval {
                Some(Spread::Known(interval)) => {
                    let scatter = Self::scatter_of(share, interval);
                    (Some(interval), Basis::OwnSample, scatter)
                }
                Some(Spread::Unknown(why)) => without(Some(why)),
                None => without(None),
            },
            _ if shares.iter().any(|one| one.count > one.of) => without(None),
            _ => match Scatter::of(&shares).divisor() {
                Some(divisor) => {
                    let scatter = divisor.max(1.0);
                    (exact(scatter), Basis::AmongRuns(scatter), scatter)
                }
                None => without(None),
            },
        };
        Self {
            share,
            interval,
            basis,
            scatter,
        }
    }

    /// What `share` scatters by, if its interval is as wide as `interval`.
    fn scatter_of(share: Share, interval: Interval) -> f64 {
        let estimate = Estimate {
            value: share.count as f64 / share.of as f64,
            interval: Some(interval),
        };
        let effective = estimate.effective_count().filter(|count| *count > 0.0);
        effective.map_or(1.0, |count| (share.of as f64 / count).max(1.0))
    }

    /// The share; `None` of none.
    pub fn ratio(&self) -> Option<f64> {
        (self.share.of > 0).then(|| self.share.count as f64 / self.share.of as f64)
    }

    /// How it stands to the `published` share, which is taken to scatter as this one does.
    fn against(&self, published: Share) -> Verdict {
        // Nothing happened in either: no interval is needed to see that they do not differ.
        if self.share.count == 0 && published.count == 0 {
            return if 2 * self.share.of >= published.of {
                Verdict::Agrees
            } else {
                Verdict::Inconclusive
            };
        }
        let Some((value, interval)) = self.ratio().zip(self.interval) else {
            return Verdict::Inconclusive;
        };
        let ours = Estimate {
            value,
            interval: Some(interval),
        };
        // So many independent trials it is worth.
        let effective = self.share.of as f64 / self.scatter;
        estimate_against_published(published, ours, effective, self.scatter)
            .unwrap_or(Verdict::NotComparable)
    }

    /// How it stands to what happened in the `recorded` runs of which it is the replay: given how often it happened in
    /// both, how often in those is binomial (Przyborowski and Wilenski 1940). Counts are divided by the larger scatter of the two.
    fn against_recorded(&self, recorded: &Self, judge: Judge) -> Verdict {
        let both = self.share.count + recorded.share.count;
        let is_enough = 2 * self.share.of >= recorded.share.of;
        if both > 0 {
            let known = [self, recorded].into_iter();
            let known = known.filter(|one| one.interval.is_some());
            let Some(scatter) = known.map(|one| one.scatter).reduce(f64::max) else {
                return Verdict::Inconclusive;
            };
            let confidence = judge.miss_confidence();
            let found = clopper_pearson_at(recorded.share.count, both, scatter, confidence);
            let expected = recorded.share.of as f64 / (recorded.share.of + self.share.of) as f64;
            if found.is_some_and(|interval| !interval.holds(expected)) {
                return Verdict::Differs;
            }
        }
        if is_enough {
            Verdict::Agrees
        } else {
            Verdict::Inconclusive
        }
    }
}

fn is_replayed<P>(run: &RecordedRun<P>) -> bool {
    run.replays.as_ref().is_ok_and(|scores| !scores.is_empty())
}

/// Runs that make one row: those of one published network, one link and like parameters, or a run alone.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedRow<P> {
    /// Its sound ones; where none is, all.
    runs: Vec<RecordedRun<P>>,
    /// Doubted ones beside sound ones.
    left_out: Vec<RecordedRun<P>>,
    /// Another row has the same name otherwise.
    is_named_by_folder: bool,
    /// What happened is of replays of the runs.
    is_replay: bool,
}

impl<P> RecordedRow<P> {
    /// The rows of `runs`, in the order of their first runs.
    pub fn of_runs(runs: Vec<RecordedRun<P>>, are_alike: impl Fn(&P, &P) -> bool) -> Vec<Self> {
        let mut rows: Vec<Self> = Vec::new();
        for mut run in runs {
            let is_its = |row: &&mut Self| {
                let first = row.first();
                (run.network.is_some() || run.row.is_some())
                    && first.network == run.network
                    && first.row == run.row
                    && first.link == run.link
                    && are_alike(&first.parameters, &run.parameters)
            };
            let Some(row) = rows.iter_mut().find(is_its) else {
                rows.push(Self {
                    runs: vec![run],
                    left_out: Vec::new(),
                    is_named_by_folder: false,
                    is_replay: false,
                });
                continue;
            };
            let mut sound = row.runs.iter().filter(|other| other.is_sound());
            let is_drawn = run.link.origin != LinkOrigin::Real;
            if is_drawn && sound.any(|other| other.seed == run.seed) {
                run.doubts.push(Doubt::SharedSeed(run.seed));
            }
            row.runs.push(run);
        }
        for row in &mut rows {
            if row.runs.iter().any(RecordedRun::is_sound) {
                let runs = core::mem::take(&mut row.runs).into_iter();
                (row.runs, row.left_out) = runs.partition(RecordedRun::is_sound);
            }
        }
        let names: Vec<_> = rows.iter().map(Self::method).collect();
        for (row, name) in rows.iter_mut().zip(&names) {
            let alike = names.iter().filter(|other| *other == name).count();
            row.is_named_by_folder = row.first().network.is_none() && alike > 1;
        }
        rows
    }

    /// The runs whose figures it has: its sound ones, or all where none is.
    pub fn runs(&self) -> &[RecordedRun<P>] {
        &self.runs
    }

    /// The first of them, with which the others have network, link and parameters in common.
    ///
    /// # Panics
    /// Never: a row has a run.
    pub fn first(&self) -> &RecordedRun<P> {
        self.runs.first().expect("a row is made of a run")
    }

    /// The same robots in virtual time over the traces of its runs; `None` where not each was replayed.
    pub fn replayed(&self) -> Option<Self>
    where
        P: Clone,
    {
        let of_run = |run: &RecordedRun<P>| -> Vec<_> {
            let scores = run.replays.iter().flatten();
            let replay = |score: &BTreeMap<_, _>| {
                let what = || "that of the runs themselves".to_owned();
                RecordedRun {
                    score: score.clone(),
                    replays: Ok(Vec::new()),
                    skipped: SkippedTicks::default(),
                    probed: None,
                    crossing: RecordedCrossing {
                        offered_count: 0,
                        lost_count: Err(what()),
                        delays: Err(what()),
                    },
                    ..run.clone()
                }
            };
            scores.map(replay).collect()
        };
        self.runs.iter().all(is_replayed).then(|| Self {
            runs: self.runs.iter().flat_map(of_run).collect(),
            left_out: Vec::new(),
            is_named_by_folder: self.is_named_by_folder,
            is_replay: true,
        })
    }

    /// What happened in each of its runs, as `of` reads it; in replays of one run together, which share its trace.
    ///
    /// # Errors
    /// The first of `of`.
    pub fn shares<E>(
        &self,
        of: impl Fn(&RecordedRun<P>) -> Result<RunShare, E>,
    ) -> Result<Vec<RunShare>, E> {
        let of_trace = |runs: &[RecordedRun<P>]| {
            runs.iter().try_fold(None, |sum: Option<RunShare>, run| {
                let one = of(run)?;
                let sum = sum.map(|sum| RunShare {
                    share: Share {
                        count: sum.share.count + one.share.count,
                        of: sum.share.of + one.share.of,
                    },
                    ..sum
                });
                Ok(Some(sum.unwrap_or(one)))
            })
        };
        let is_of_one = |one: &RecordedRun<P>, other: &RecordedRun<P>| {
            self.is_replay && one.folder == other.folder
        };
        let traces = self.runs.chunk_by(is_of_one).map(of_trace);
        traces.filter_map(Result::transpose).collect()
    }

    /// True of what happened in replays.
    pub const fn is_replay(&self) -> bool {
        self.is_replay
    }

    /// How it was obtained, as the paper's first column has it.
    pub fn method(&self) -> String {
        let first = self.first();
        let row = first.row.as_ref().unwrap_or(&first.name);
        let network = first.network.map_or(row.as_str(), |one| one.label());
        let how = if self.is_replay { "Replay" } else { "HiL" };
        let mut name = format!("{how}, {network}, {}", first.link.origin);
        if self.is_named_by_folder {
            name = format!("{name}, {}", first.folder);
        }
        // Where one run is sound, all that are left are.
        if !first.is_sound() {
            name.push_str(", doubted");
        }
        name
    }

    fn crossings(&self) -> impl Iterator<Item = &RecordedCrossing> {
        self.runs.iter().map(|run| &run.crossing)
    }

    /// Share of the messages that the network lost; `None` where that is unavailable of a run.
    pub fn loss_ratio(&self) -> Option<f64> {
        loss_ratio(self.crossings())
    }

    /// The one-way delay that a `quantile` (0..=1) of all messages did not exceed, milliseconds, within the width of a
    /// bin; `None` where delays are unavailable of a run.
    pub fn delay_ms(&self, quantile: f64) -> Option<f64> {
        delay_ms(self.crossings(), quantile)
    }

    /// The skipped ticks that the row allowed; `None` where none was skipped.
    fn allowed_skips(&self) -> Option<String> {
        let sound = self.runs.iter().filter(|run| run.is_sound());
        let all: Vec<SkippedTicks> = sound.map(|run| run.skipped).collect();
        let some_count = all.iter().filter(|one| one.skipped_count > 0).count();
        let sum = SkippedTicks {
            skipped_count: all.iter().map(|one| one.skipped_count).sum(),
            due_count: all.iter().map(|one| one.due_count).sum(),
        };
        (some_count > 0).then(|| match all.len() {
            1 => format!("host: {sum}"),
            count => format!("host: {sum}, in {some_count} of {count} runs"),
        })
    }

    /// Loss and delay by the passive probe, each of the runs of which it is known; `None` where no run was probed.
    fn probed(&self) -> Option<String> {
        let probed = self.runs.iter().filter_map(|run| run.probed.as_ref());
        probed.clone().next()?;
        let crossings = probed.clone().map(|one| &one.crossing);
        let words = |found: Option<String>, known_count: usize, why: Option<&String>| {
            let why = why.map_or_else(String::new, |why| format!(" ({why})"));
            match (found, self.runs.len()) {
                (None, _) => format!("unavailable{why}"),
                (Some(found), count) if count == known_count => found,
                (Some(found), count) => format!("{found} in {known_count} of {count} runs{why}"),
            }
        };
        let known = crossings.clone().filter(|one| one.lost_count.is_ok());
        let loss = words(
            loss_ratio(known.clone()).map(|ratio| format!("{ratio:.4}")),
            known.count(),
            crossings
                .clone()
                .find_map(|one| one.lost_count.as_ref().err()),
        );
        let known = crossings.clone().filter(|one| one.delays.is_ok());
        let [p50, p99] = [0.5, 0.99].map(|quantile| delay_ms(known.clone(), quantile));
        let delay = words(
            p50.zip(p99)
                .map(|(p50, p99)| format!("p50 {p50:.3} ms, p99 {p99:.3} ms")),
            known.count(),
            crossings.clone().find_map(|one| one.delays.as_ref().err()),
        );
        let left_out: BTreeSet<&str> = (probed.flat_map(|one| &one.left_out))
            .map(String::as_str)
            .collect();
        let without = if left_out.is_empty() {
            String::new()
        } else {
            let names: Vec<_> = left_out.into_iter().collect();
            format!(", without {} (TCP)", names.join(" and "))
        };
        Some(format!(
            "datagrams by the passive probe: PLR {loss}, delay {delay}{without}"
        ))
    }

    /// How what happened stands to the `published` share.
    pub fn verdict(&self, happened: &PooledShare, published: Option<Share>) -> Verdict {
        let is_doubted = self.runs.iter().any(|run| !run.doubts.is_empty());
        match published.filter(|_| self.first().network.is_some() && !is_doubted) {
            Some(published) => happened.against(published),
            None => Verdict::NotComparable,
        }
    }

    /// How what `happened` in these replays stands to what did in the `recorded` runs.
    pub fn verdict_of_replay(
        &self,
        happened: &PooledShare,
        recorded: &PooledShare,
        judge: Judge,
    ) -> Verdict {
        if self.first().is_sound() {
            happened.against_recorded(recorded, judge)
        } else {
            Verdict::NotComparable
        }
    }

    /// What a reader must know of the row: its runs, its link, what its interval rests on, and why it is not compared
    /// or lacks a figure.
    pub fn note(&self, happened: &PooledShare) -> String {
        let first = self.first();
        let folders = self.runs.iter().map(|run| run.folder.as_str());
        let mut parts = vec![
            folders.collect::<Vec<_>>().join(", "),
            first.link.about.clone(),
            happened.basis.to_string(),
        ];
        parts.extend(self.allowed_skips());
        parts.extend(self.probed());
        if first.network.is_none() {
            parts.push("not comparable: no label says for which network it stands".to_owned());
        }
        for run in &self.runs {
            // Of a single run the folder stands before.
            let of = match self.runs.as_slice() {
                [_] => String::new(),
                _ => format!("{}: ", run.folder),
            };
            let doubts = run.doubts.iter();
            parts.extend(doubts.map(|doubt| format!("not comparable: {of}{doubt}")));
            let crossing = &run.crossing;
            if let Err(why) = &crossing.lost_count {
                parts.push(format!("{of}loss is unavailable: {why}"));
            }
            if let Err(why) = &crossing.delays {
                parts.push(format!("{of}delays are unavailable: {why}"));
            }
            match &run.replays {
                Err(why) => parts.push(format!("{of}not replayed: {why}")),
                Ok(scores) if scores.is_empty() && self.runs.iter().any(is_replayed) => {
                    parts.push(format!("not replayed, beside others: {}", run.folder));
                }
                Ok(_) => {}
            }
        }
        let left_out = self.left_out.iter().map(|run| {
            let doubts: Vec<_> = run.doubts.iter().map(Doubt::to_string).collect();
            format!("left out: {}: {}", run.folder, doubts.join(", "))
        });
        parts.extend(left_out);
        parts.retain(|part| !part.is_empty());
        format!("{}: {}", self.method(), parts.join("; "))
    }
}

fn loss_ratio<'a>(crossings: impl Iterator<Item = &'a RecordedCrossing>) -> Option<f64> {
    let (mut lost, mut offered) = (0_u64, 0_u64);
    for crossing in crossings {
        lost += crossing.lost_count.as_ref().ok()?;
        offered += crossing.offered_count;
    }
    (offered > 0).then(|| lost as f64 / offered as f64)
}

fn delay_ms<'a>(
    crossings: impl Iterator<Item = &'a RecordedCrossing>,
    quantile: f64,
) -> Option<f64> {
    // Channels and runs have the same bins.
    let mut counts: BTreeMap<(i64, i64), u64> = BTreeMap::new();
    for crossing in crossings {
        for bin in crossing.delays.as_ref().ok()? {
            *counts.entry((bin.until_ns, bin.above_ns)).or_default() += bin.count;
        }
    }
    let rank = quantile * counts.values().sum::<u64>() as f64;
    let mut below = 0.0;
    for ((until_ns, above_ns), count) in counts.into_iter().filter(|(_, count)| *count > 0) {
        let count = count as f64;
        if below + count >= rank {
            let width_ns = until_ns.saturating_sub(above_ns) as f64;
            let delay_ns = above_ns as f64 + width_ns * (rank - below) / count;
            return Some(1e-6 * delay_ns);
        }
        below += count;
    }
    None
}

/// What a table with recorded rows says of them all.
pub const ROWS_NOTE: &str = "HiL with a kind of link: recorded runs in real time; PLR and delay (p50, p99) are the \
                             network's, of all messages on the channels that crossed it, delays by a histogram of \
                             20 bins a decade";

/// What a table with replays says of them all.
pub const REPLAYS_NOTE: &str = "Replay: the same robots in virtual time over the traces of the runs in the row above, with \
                                seeds of their own; the verdict is against that row, and agrees where no difference is shown";

/// How many of a case's replays have which verdict, in words; `None` of none.
pub fn replays_summary(verdicts: &[Verdict]) -> Option<String> {
    let count = |wanted| verdicts.iter().filter(|one| **one == wanted).count();
    let counts = Verdict::ALL
        .map(|one| (count(one), one.words()))
        .into_iter();
    let counts = counts.filter(|(count, _)| *count > 0);
    let counts: Vec<_> = counts
        .map(|(count, words)| format!("{words} {count}"))
        .collect();
    (!verdicts.is_empty()).then(|| {
        format!(
            "Against their own traces in virtual time, of {} rows: {}; by chance one of them differs in at most one of twenty tables.",
            verdicts.len(),
            counts.join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    use hil_core::interval::IntervalMethod;
    use hil_core::random::RandomStream;
    use hil_core::recorded_run::{
        DelayBin, ProbedCrossing, PublishedNetwork, RecordedCrossing, RecordedLink, RecordedMetric,
    };
    use hil_core::study::StudyRefusal;

    const fn share(count: u64, of: u64) -> Share {
        Share { count, of }
    }

    fn run(folder: &str, network: Option<PublishedNetwork>, seed: u64) -> RecordedRun<u8> {
        RecordedRun {
            folder: folder.to_owned(),
            name: "two-pcs".to_owned(),
            network,
            row: None,
            link: RecordedLink {
                origin: LinkOrigin::Emulated,
                about: "hop: 5 ms".to_owned(),
            },
            seed,
            parameters: 7,
            crossing: RecordedCrossing {
                offered_count: 1000,
                lost_count: Ok(10),
                delays: Ok(vec![
                    DelayBin {
                        above_ns: 1_000_000,
                        until_ns: 2_000_000,
                        count: 50,
                    },
                    DelayBin {
                        above_ns: 2_000_000,
                        until_ns: 4_000_000,
                        count: 50,
                    },
                ]),
            },
            score: BTreeMap::new(),
            skipped: SkippedTicks::default(),
            probed: None,
            replays: Ok(Vec::new()),
            doubts: Vec::new(),
        }
    }

    #[test]
    fn a_single_run_keeps_its_interval_and_several_have_that_of_their_scatter() {
        let interval = Interval::new(0.01, 0.04, IntervalMethod::EffectiveShare);
        let alone = RunShare {
            share: share(20, 1000),
            interval: Some(Spread::Known(interval)),
        };
        let one = PooledShare::of(&[alone], Some(1.0));
        assert_eq!(
            (one.interval, one.basis),
            (Some(interval), Basis::OwnSample)
        );
        // 0.02 * 0.98 * (2 * 1.95996 / 0.03)^2 = 334.7 trials: 1000 scatter by 2.99.
        assert!((one.scatter - 2.988).abs() < 0.01, "{}", one.scatter);
        // 10 of 1000 thrice, each off by 3, 3, 0: 18 / 9.9 over 2 degrees of freedom is below 1, and Student's quantile
        // of 2 is 4.30265: 0.909 * (4.30265 / 1.95996)^2 = 4.381.
        let runs = [7, 13, 10].map(|count| RunShare {
            share: share(count, 1000),
            interval: None,
        });
        let three = PooledShare::of(&runs, Some(1.0));
        assert_eq!(three.share, share(30, 3000));
        assert!((three.scatter - 4.381).abs() < 0.002, "{}", three.scatter);
        assert_eq!(three.basis, Basis::AmongRuns(three.scatter));
        let found = three.interval.unwrap();
        assert!(found.low > 0.0 && found.holds(0.01), "{found:?}");
    }

    #[test]
    fn without_an_interval_a_row_says_why_and_decides_nothing() {
        let why = TooSmall {
            effective: 3,
            needed: 5,
        };
        let few = |interval| {
            let share = share(3, 1000);
            PooledShare::of(&[RunShare { share, interval }], Some(1.0))
        };
        let found = few(Some(Spread::Unknown(why)));
        assert_eq!(
            (found.interval, found.basis),
            (None, Basis::None(Some(why)))
        );
        assert_eq!(found.against(share(0, 1000)), Verdict::Inconclusive);
        assert_eq!(few(None).basis, Basis::None(None));
        assert_eq!(PooledShare::of(&[], Some(1.0)).interval, None);
    }

    #[test]
    fn of_none_at_all_counts_are_divided_as_in_the_table() {
        let none = RunShare {
            share: share(0, 10_000),
            interval: None,
        };
        let high = |of_none| {
            PooledShare::of(&[none], Some(of_none))
                .interval
                .unwrap()
                .high
        };
        // 1 - 0.025^(1 / 10 000), and of a quarter of them.
        assert!((high(0.5) - 3.688e-4).abs() < 1e-7);
        assert!((high(4.0) - 1.4745e-3).abs() < 1e-6);
        let pooled = PooledShare::of(&[none], Some(1.0));
        assert_eq!(pooled.against(share(0, 10_000)), Verdict::Agrees);
        assert_eq!(pooled.against(share(23, 10_000)), Verdict::Differs);
        assert_eq!(pooled.against(share(0, 30_000)), Verdict::Inconclusive);
    }

    #[test]
    fn runs_of_one_network_link_and_parameters_are_one_row() {
        let short = Some(PublishedNetwork::ShortRange);
        let mut runs = vec![
            run("a", short, 1),
            run("b", None, 1),
            run("c", short, 2),
            run("d", None, 1),
            run("e", short, 1),
            run("f", short, 3),
            run("g", short, 4),
        ];
        runs[5].link.origin = LinkOrigin::Real;
        runs[6].parameters = 8;
        let rows = RecordedRow::of_runs(runs, |one, other| one == other);
        let folders = |row: &RecordedRow<u8>| -> Vec<String> {
            row.runs.iter().map(|run| run.folder.clone()).collect()
        };
        let folders: Vec<_> = rows.iter().map(|row| folders(row).join(" ")).collect();
        assert_eq!(folders, ["a c", "b", "d", "f", "g"]);
        assert_eq!(rows[0].method(), "HiL, short-range Wi-Fi 6, emulated link");
        assert_eq!(rows[1].method(), "HiL, two-pcs, emulated link, b");
        // An emulated link draws the same for equal seeds.
        assert_eq!(rows[0].left_out[0].folder, "e");
        assert_eq!(rows[0].left_out[0].doubts, [Doubt::SharedSeed(1)]);
        // Those that were made for one row are one without a label.
        let made = |folder, seed| {
            let mut run = run(folder, None, seed);
            run.row = Some("lte".to_owned());
            run
        };
        let made = vec![made("h", 1), run("i", None, 2), made("j", 2)];
        let made = RecordedRow::of_runs(made, |_, _| true);
        assert_eq!((made.len(), made[0].runs().len()), (2, 2));
        assert_eq!(made[0].method(), "HiL, lte, emulated link");
        // Alike, but no repetitions of each other.
        assert_eq!(rows[2].method(), "HiL, two-pcs, emulated link, d");
    }

    #[test]
    fn a_doubted_run_is_left_out_beside_sound_ones_and_named() {
        let short = Some(PublishedNetwork::ShortRange);
        let late = |folder: &str, seed| {
            let mut run = run(folder, short, seed);
            run.doubts.push(Doubt::SkippedTicks(SkippedTicks {
                skipped_count: 3,
                due_count: 500,
            }));
            run
        };
        let row = |runs| RecordedRow::of_runs(runs, |_, _| true).remove(0);
        let happened = PooledShare::of(
            &[RunShare {
                share: share(0, 10_000),
                interval: None,
            }],
            Some(1.0),
        );
        let published = Some(share(0, 10_000));
        // The sound one has the seed of a doubted one, which counts for nothing.
        let mixed = row(vec![late("a", 1), run("b", short, 1)]);
        assert_eq!(mixed.runs().len(), 1);
        assert_eq!(mixed.verdict(&happened, published), Verdict::Agrees);
        assert_eq!(mixed.method(), "HiL, short-range Wi-Fi 6, emulated link");
        let note = mixed.note(&happened);
        let expected = "left out: a: 3 of 500 ticks were skipped";
        assert!(
            note.contains(": b; hop") && note.ends_with(expected),
            "{note}"
        );
        let allowed = |folder: &str, seed, skipped_count| RecordedRun {
            skipped: SkippedTicks {
                skipped_count,
                due_count: 500 * skipped_count,
            },
            ..run(folder, short, seed)
        };
        let one = row(vec![allowed("a", 1, 1)]).note(&happened);
        assert!(one.contains("; host: 1 of 500 ticks were skipped"), "{one}");
        let some = row(vec![
            allowed("a", 1, 1),
            allowed("b", 2, 3),
            run("c", short, 3),
        ]);
        let some = some.note(&happened);
        let expected = "; host: 4 of 2000 ticks were skipped, in 2 of 3 runs";
        assert!(some.contains(expected), "{some}");
        assert!(
            !row(vec![run("c", short, 3)])
                .note(&happened)
                .contains("host:")
        );
        let doubted = row(vec![late("a", 1), late("b", 2)]);
        assert_eq!(doubted.runs().len(), 2);
        assert_eq!(
            doubted.verdict(&happened, published),
            Verdict::NotComparable
        );
        assert!(doubted.method().ends_with(", doubted"));
        let note = doubted.note(&happened);
        assert!(
            note.contains("not comparable: a: 3 of") && note.contains("not comparable: b: 3 of")
        );
    }

    #[test]
    fn loss_and_delay_are_of_all_messages_of_all_runs() {
        let short = Some(PublishedNetwork::ShortRange);
        let mut other = run("b", short, 2);
        other.crossing.lost_count = Ok(50);
        other.crossing.delays = Ok(vec![DelayBin {
            above_ns: 9_000_000,
            until_ns: 10_000_000,
            count: 100,
        }]);
        let row = |runs| RecordedRow::of_runs(runs, |_, _| true).remove(0);
        let one = row(vec![run("a", short, 1)]);
        assert_eq!(one.loss_ratio(), Some(0.01));
        // The 50th of 100 is the last of the first bin, the 99th the 49th of 50 from 2 to 4 ms.
        let close = |found: Option<f64>, expected: f64| (found.unwrap() - expected).abs() < 1e-9;
        assert!(close(one.delay_ms(0.5), 2.0) && close(one.delay_ms(0.99), 3.96));
        let both = row(vec![run("a", short, 1), other.clone()]);
        assert_eq!(both.loss_ratio(), Some(0.03));
        assert!(close(both.delay_ms(0.5), 4.0) && close(both.delay_ms(0.99), 9.98));
        other.crossing.delays = Err("clocks are not aligned".to_owned());
        let both = row(vec![run("a", short, 1), other]);
        assert_eq!(both.delay_ms(0.5), None);
        let happened = PooledShare::of(&[], Some(1.0));
        let note = both.note(&happened);
        assert!(note.contains("b: delays are unavailable: clocks"), "{note}");
    }

    #[test]
    fn a_row_without_a_label_or_with_a_doubt_is_not_compared_and_says_why() {
        let short = Some(PublishedNetwork::ShortRange);
        let none = RunShare {
            share: share(0, 10_000),
            interval: None,
        };
        let happened = PooledShare::of(&[none], Some(1.0));
        let of = |run| RecordedRow::of_runs(vec![run], |_, _| true).remove(0);
        let verdict = |row: &RecordedRow<u8>| row.verdict(&happened, Some(share(0, 10_000)));
        assert_eq!(verdict(&of(run("a", short, 1))), Verdict::Agrees);
        let unlabelled = of(run("a", None, 1));
        assert_eq!(verdict(&unlabelled), Verdict::NotComparable);
        assert!(unlabelled.note(&happened).contains("no label"));
        let mut late = run("runs/a", short, 1);
        late.doubts.push(Doubt::SkippedTicks(SkippedTicks {
            skipped_count: 3,
            due_count: 500,
        }));
        let late = of(late);
        assert_eq!(verdict(&late), Verdict::NotComparable);
        let expected = "not comparable: 3 of 500 ticks were skipped";
        assert!(late.note(&happened).contains(expected));
    }

    /// How often, of `times` pairs of samples with these rates, a replay differs from its row, alone in its table.
    fn differing(seed: u64, rates: [f64; 2], sizes: [u64; 2], times: u64) -> f64 {
        let mut random = RandomStream::new(seed, "replays");
        let mut sample = |rate: f64, of: u64| {
            // In four runs, of which each draws for itself.
            let mut run = |_| {
                let hits = (0..of / 4).filter(|_| random.uniform() < rate);
                RunShare {
                    share: share(hits.count() as u64, of / 4),
                    interval: None,
                }
            };
            let runs: Vec<_> = (0..4).map(&mut run).collect();
            PooledShare::of(&runs, Some(1.0))
        };
        let judge = Judge::of_tests(1);
        let differing = (0..times).filter(|_| {
            let [recorded, replay] = [0, 1].map(|one| sample(rates[one], sizes[one]));
            replay.against_recorded(&recorded, judge) == Verdict::Differs
        });
        differing.count() as f64 / times as f64
    }

    #[test]
    fn replays_of_the_same_rate_seldom_differ_and_those_of_another_do() {
        for (seed, sizes) in [(1, [2000, 2000]), (2, [2000, 8000])] {
            let alike = differing(seed, [0.005, 0.005], sizes, 400);
            assert!(alike <= 0.05, "seed {seed}: {alike}");
            let other = differing(seed, [0.01, 0.05], sizes, 100);
            assert!(other >= 0.9, "seed {seed}: {other}");
        }
    }

    #[test]
    fn a_replay_is_a_row_of_its_own_beside_the_runs() {
        let short = Some(PublishedNetwork::ShortRange);
        let metric = RecordedMetric {
            value: Some(3.0),
            interval: None,
        };
        let score = || BTreeMap::from([("collisions".to_owned(), metric)]);
        let mut first = run("a", short, 1);
        first.replays = Ok(vec![score(), score()]);
        let mut other = run("b", short, 2);
        other.replays = Ok(vec![score()]);
        let failed = RecordedRun {
            replays: Err("it left no traces".to_owned()),
            ..other.clone()
        };
        let without = RecordedRun {
            skipped: SkippedTicks::default(),
            probed: None,
            replays: Ok(Vec::new()),
            ..other.clone()
        };
        let none = PooledShare::of(&[], Some(1.0));
        for (run, why) in [
            (failed, "b: not replayed: it left no traces"),
            (without, "not replayed, beside others: b"),
        ] {
            let row = RecordedRow::of_runs(vec![first.clone(), run], |_, _| true).remove(0);
            assert_eq!(row.replayed(), None);
            assert!(row.note(&none).contains(why), "{}", row.note(&none));
        }
        let row = RecordedRow::of_runs(vec![first, other], |_, _| true).remove(0);
        let replay = row.replayed().unwrap();
        assert!(replay.is_replay() && replay.runs().len() == 3);
        assert_eq!(replay.runs()[1].count("collisions").unwrap(), 3);
        assert_eq!(
            replay.method(),
            "Replay, short-range Wi-Fi 6, emulated link"
        );
        // Replays of one trace are one trial, however many.
        let shares = |row: &RecordedRow<u8>| -> Vec<Share> {
            let of_run = |_: &RecordedRun<u8>| {
                Ok::<_, StudyRefusal>(RunShare {
                    share: share(1, 10),
                    interval: None,
                })
            };
            let found = row.shares(of_run).unwrap();
            found.into_iter().map(|one| one.share).collect()
        };
        let (recorded, traces) = (shares(&row), shares(&replay));
        assert_eq!(
            (recorded.len(), traces.len()),
            (row.runs().len(), row.runs().len())
        );
        let replays: u64 = traces.iter().map(|one| one.count).sum();
        assert_eq!(replays, replay.runs().len() as u64);
        // Loss and delay are those of the row.
        assert_eq!((replay.loss_ratio(), replay.delay_ms(0.5)), (None, None));
        let alone = RecordedRow::of_runs(vec![run("c", short, 3)], |_, _| true);
        assert_eq!(alone[0].replayed(), None);
    }

    #[test]
    fn what_a_probe_saw_stands_in_the_note_of_the_row_and_not_in_that_of_its_replay() {
        let short = Some(PublishedNetwork::ShortRange);
        let [mut one, mut other] =
            [("a", 3), ("b", 4)].map(|(folder, seed)| run(folder, short, seed));
        let none = PooledShare::of(&[], None);
        let note_of = |runs: &[&RecordedRun<u8>]| {
            let runs = runs.iter().map(|run| (*run).clone()).collect();
            RecordedRow::of_runs(runs, |_, _| true)[0].note(&none)
        };
        assert!(!note_of(&[&one, &other]).contains("probe"));
        one.probed = Some(ProbedCrossing {
            crossing: one.crossing.clone(),
            left_out: vec!["b".to_owned(), "a".to_owned()],
        });
        let words = "datagrams by the passive probe: PLR 0.0100 in 1 of 2 runs, delay p50 2.000 ms, p99 3.960 ms in 1 of 2 runs, \
                     without a and b (TCP)";
        assert!(
            note_of(&[&one, &other]).contains(words),
            "{}",
            note_of(&[&one, &other])
        );
        other.probed = Some(ProbedCrossing {
            crossing: RecordedCrossing {
                offered_count: 1000,
                lost_count: Ok(0),
                delays: Err("two clocks".to_owned()),
            },
            left_out: Vec::new(),
        });
        let words = "PLR 0.0050, delay p50 2.000 ms, p99 3.960 ms in 1 of 2 runs (two clocks), without a and b";
        assert!(
            note_of(&[&one, &other]).contains(words),
            "{}",
            note_of(&[&one, &other])
        );
        let words = "by the passive probe: PLR 0.0000, delay unavailable (two clocks)";
        assert!(note_of(&[&other]).contains(words), "{}", note_of(&[&other]));
        one.replays = Ok(vec![one.score.clone()]);
        let replay = RecordedRow::of_runs(vec![one], |_, _| true)[0].replayed();
        assert_eq!(replay.unwrap().first().probed, None);
    }

    #[test]
    fn a_replay_that_saw_as_little_agrees_and_a_small_one_decides_nothing() {
        let of = |count, of, interval: Option<[f64; 2]>| {
            let interval = interval
                .map(|[low, high]| Interval::new(low, high, IntervalMethod::EffectiveShare));
            let interval = interval.map(Spread::Known);
            PooledShare::of(
                &[RunShare {
                    share: share(count, of),
                    interval,
                }],
                None,
            )
        };
        let judge = Judge::of_tests(3);
        let verdict =
            |recorded: &PooledShare, replay: &PooledShare| replay.against_recorded(recorded, judge);
        let none = of(0, 890, None);
        assert_eq!(verdict(&none, &of(0, 3560, None)), Verdict::Agrees);
        assert_eq!(verdict(&none, &of(0, 400, None)), Verdict::Inconclusive);
        // How those of the replay come together is known.
        let many = of(356, 3560, Some([0.0901, 0.1099]));
        assert_eq!(verdict(&none, &many), Verdict::Differs);
        assert_eq!(verdict(&none, &of(356, 3560, None)), Verdict::Inconclusive);
        assert_eq!(replays_summary(&[]), None);
        let words = replays_summary(&[Verdict::Agrees, Verdict::Differs, Verdict::Agrees]).unwrap();
        assert!(words.contains("of 3 rows: agrees 2, differs 1;"), "{words}");
    }
}
