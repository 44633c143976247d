//! The relation of two clocks over a whole run, ready to convert instants. How it is found is in
//! `band.rs` (what is guaranteed) and `anchors.rs` (what is estimated).

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::ClockSettings;
use crate::anchors::Anchors;
use crate::band::{Band, Cut, Stretch, cut};
use crate::drift::{self, DriftContradiction};
use crate::exchange::{Constraint, Exchange, StampKind};
use hil_core::time::{Instant, RemoteInstant};
use hil_stats::bounds::BoundMetrics;

/// An instant of another host on this host's clock, with its bounds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Localised {
    /// The estimate; lies between the two others.
    pub instant: Instant,
    /// It was no earlier than this, by causality alone.
    pub earliest: Instant,
    /// It was no later than this.
    pub latest: Instant,
}

impl Localised {
    /// Largest error of the estimate, nanoseconds.
    pub fn bound_ns(&self) -> u64 {
        let before = self.instant.ns_since(self.earliest);
        let after = self.latest.ns_since(self.instant);
        before.max(after).unsigned_abs()
    }
}

/// How another host's clock relates to this host's, over the time of a run.
#[derive(Debug, Clone)]
pub struct ClockMap {
    settings: ClockSettings,
    pieces: Vec<Piece>,
    figures: ClockMetrics,
}

#[derive(Debug, Clone)]
struct Piece {
    from_ns: i64,
    until_ns: i64,
    band: Band,
    anchors: Anchors,
}

impl ClockMap {
    /// The map that `exchanges`, in any order, allow. Without usable exchanges it converts nothing.
    pub fn new(exchanges: &[Exchange], settings: ClockSettings) -> Self {
        let usable = exchanges.iter().filter_map(|one| one.constraint(&settings));
        let mut constraints: Vec<Constraint> = usable.collect();
        constraints.sort_by_key(|one| one.middle().at_ns);
        let Cut {
            stretches,
            contradictions,
        } = cut(&constraints, &settings);
        let used_count: usize = stretches.iter().map(|one| one.constraints.len()).sum();
        let pieces = stretches.iter().map(|stretch| Piece {
            from_ns: stretch.from_ns,
            until_ns: stretch.until_ns,
            band: Band::new(&stretch.constraints, &settings),
            anchors: Anchors::new(&stretch.constraints, &settings),
        });
        let mut map = Self {
            settings,
            pieces: pieces.collect(),
            figures: no_metrics(exchanges, &settings),
        };
        map.figures.unused_count = (exchanges.len() - used_count) as u64;
        map.add_metrics(&constraints, &stretches);
        let estimates = map.pieces.iter().map(|piece| &piece.anchors);
        let found = drift::contradiction(&constraints, &contradictions, estimates, &settings);
        if found.is_some() {
            map.withdraw();
        }
        map.figures.drift_contradiction = found;
        map
    }

    /// Takes back all that rests on the drift limit.
    fn withdraw(&mut self) {
        self.pieces.clear();
        self.figures.offset = None;
        self.figures.stretch_offsets.clear();
        self.figures.bound = None;
        self.figures.steps.clear();
    }

    /// `remote` on this host's clock; `None` when the exchanges contradict the drift limit, around a step, more than
    /// [`BEYOND_NS_MAX`](super::BEYOND_NS_MAX) outside the exchanges and without any.
    pub fn localise(&self, remote: RemoteInstant) -> Option<Localised> {
        let at_ns = remote.as_ns();
        let piece = self.piece_at(at_ns)?;
        let offset = piece.offset_at(at_ns, &self.settings)?;
        let at = |offset_ns: i64| Instant::from_ns(at_ns.saturating_add(offset_ns));
        Some(Localised {
            instant: at(offset.estimate_ns),
            earliest: at(offset.lowest_ns),
            latest: at(offset.highest_ns),
        })
    }

    /// As [`Self::localise`], and further outside the exchanges too: what the nearest of them says,
    /// widened by the drift allowance for all the time between, in which no clock may step. For the
    /// axis of a report, on which a start that lies before all exchanges must be put somewhere; no delay is
    /// converted so. `None` in a noticed step and without exchanges. See [`Self::localise_early`] for a
    /// score.
    pub fn localise_beyond(&self, remote: RemoteInstant) -> Option<Localised> {
        if let Some(localised) = self.localise(remote) {
            return Some(localised);
        }
        let at_ns = remote.as_ns();
        let piece = self.piece_at(at_ns)?;
        let near_ns = piece.band.nearest_ns(at_ns)?;
        let near = piece.offset_at(near_ns, &self.settings)?;
        let drift_ns = self.settings.drift_ns(at_ns.saturating_sub(near_ns));
        let lowest_ns = near.lowest_ns.saturating_sub(drift_ns);
        let highest_ns = near.highest_ns.saturating_add(drift_ns);
        let estimate_ns = piece.anchors.offset_at(at_ns)?.clamp(lowest_ns, highest_ns);
        let at = |offset_ns: i64| Instant::from_ns(at_ns.saturating_add(offset_ns));
        Some(Localised {
            instant: at(estimate_ns),
            earliest: at(lowest_ns),
            latest: at(highest_ns),
        })
    }

    /// As [`Self::localise_beyond`] before the first exchange, as [`Self::localise`] from then on. For the
    /// messages of a score, which are published before gateways meet; true beside those that only this
    /// converts, which take it that no clock stepped before the first exchange.
    pub fn localise_early(&self, remote: RemoteInstant) -> Option<(Localised, bool)> {
        if let Some(localised) = self.localise(remote) {
            return Some((localised, false));
        }
        let at_ns = remote.as_ns();
        let first_ns = self.pieces.first()?.band.nearest_ns(at_ns)?;
        let is_early = at_ns < first_ns;
        is_early.then_some((self.localise_beyond(remote)?, true))
    }

    /// `local` on the other host's clock, with the largest error in nanoseconds.
    pub fn to_remote(&self, local: Instant) -> Option<(RemoteInstant, u64)> {
        self.pieces.iter().find_map(|piece| {
            let first = piece.anchors.points.first()?.middle;
            let mut at_ns = local.as_ns().saturating_sub(first.offset_ns);
            // The offset changes by a thousandth of the time at most: three rounds reach a
            // nanosecond from years away.
            for _ in 0..3 {
                // The first guess may lie beyond what has an interval, and the result within.
                let bounded = piece.offset_at(at_ns, &self.settings);
                let bounded_ns = bounded.map(|offset| offset.estimate_ns);
                let offset_ns = bounded_ns.or_else(|| piece.anchors.offset_at(at_ns))?;
                at_ns = local.as_ns().saturating_sub(offset_ns);
            }
            let remote = RemoteInstant::from_ns(at_ns);
            let is_inside = (piece.from_ns..=piece.until_ns).contains(&at_ns);
            let bound_ns = self.localise(remote).filter(|_| is_inside)?.bound_ns();
            Some((remote, bound_ns))
        })
    }

    /// How far the offset may have moved between two instants of the other host's clock, by the
    /// drift allowance; `None` when a noticed step lies between them, or one is in a step.
    pub fn drift_ns(&self, from: RemoteInstant, until: RemoteInstant) -> Option<u64> {
        let [from_ns, until_ns] = [from.as_ns(), until.as_ns()];
        let piece = self.piece_at(from_ns)?;
        let is_same = (piece.from_ns..=piece.until_ns).contains(&until_ns);
        let drift_ns = self.settings.drift_ns(until_ns.saturating_sub(from_ns));
        is_same.then_some(drift_ns.unsigned_abs())
    }

    /// What the map says of itself.
    pub const fn metrics(&self) -> &ClockMetrics {
        &self.figures
    }

    fn piece_at(&self, at_ns: i64) -> Option<&Piece> {
        let index = self.pieces.partition_point(|one| one.until_ns < at_ns);
        self.pieces.get(index).filter(|one| one.from_ns <= at_ns)
    }

    fn add_metrics(&mut self, constraints: &[Constraint], stretches: &[Stretch]) {
        let middle_of = |one: &Constraint| one.middle().at_ns;
        self.figures.rtt_min_ns = rtt_min_ns(constraints);
        let ends = constraints.first().zip(constraints.last());
        self.figures.offset = ends.and_then(|(first, last)| {
            let middle_ns = half_way(middle_of(first), middle_of(last));
            // In a step there is no offset: then the nearest instant that has one.
            let offsets = stretches
                .iter()
                .zip(&self.pieces)
                .filter_map(|(one, piece)| {
                    let (first, last) = one.constraints.first().zip(one.constraints.last())?;
                    let at_ns = middle_ns.clamp(middle_of(first), middle_of(last));
                    piece.offset_at(at_ns, &self.settings)
                });
            offsets.min_by_key(|offset| offset.at_ns.abs_diff(middle_ns))
        });
        let by_stretch = stretches
            .iter()
            .zip(&self.pieces)
            .filter_map(|(one, piece)| {
                let (first, last) = one.constraints.first().zip(one.constraints.last())?;
                let at_ns = half_way(middle_of(first), middle_of(last));
                piece.offset_at(at_ns, &self.settings)
            });
        self.figures.stretch_offsets = by_stretch.collect();
        // Bounds are widest half-way between exchanges.
        let between = constraints
            .windows(2)
            .map(|pair| half_way(middle_of(&pair[0]), middle_of(&pair[1])));
        let instants = constraints.iter().map(middle_of).chain(between);
        let bounds = instants.filter_map(|at_ns| {
            let localised = self.localise(RemoteInstant::from_ns(at_ns))?;
            Some(localised.bound_ns())
        });
        self.figures.bound = BoundMetrics::of(bounds.collect());
        let longest = self
            .pieces
            .iter()
            .max_by_key(|piece| piece.anchors.points.len());
        if let Some(piece) = longest {
            self.figures.spread_ns = piece.anchors.spread_ns();
            let line = piece.anchors.line();
            self.figures.skew_ppm = line.map(|line| line.slope * 1e6);
            self.figures.skew_error_ppm = line.map(|line| line.slope_error * 1e6);
        }
        self.figures.steps = stretches
            .windows(2)
            .enumerate()
            .map(|(index, pair)| {
                let (from_ns, until_ns) = (pair[0].until_ns, pair[1].from_ns);
                let estimate = |piece: &Piece, at_ns| piece.anchors.offset_at(at_ns);
                let before_ns = estimate(&self.pieces[index], from_ns);
                let after_ns = estimate(&self.pieces[index + 1], until_ns);
                let size_ns = before_ns
                    .zip(after_ns)
                    .map(|(before_ns, after_ns)| after_ns.saturating_sub(before_ns));
                ClockStep {
                    from_ns,
                    until_ns,
                    size_ns,
                }
            })
            .collect();
    }
}

impl Piece {
    fn offset_at(&self, at_ns: i64, settings: &ClockSettings) -> Option<OffsetMetrics> {
        let (lowest_ns, highest_ns) = self.band.interval_at(at_ns, settings)?;
        let estimate_ns = self.anchors.offset_at(at_ns)?;
        Some(OffsetMetrics {
            at_ns,
            // Noise may put the estimate where causality says that it cannot be.
            estimate_ns: estimate_ns.clamp(lowest_ns, highest_ns.max(lowest_ns)),
            lowest_ns,
            highest_ns,
        })
    }
}

/// Errors of the stamps can make a fast exchange seem to have taken less than nothing.
fn rtt_min_ns(constraints: &[Constraint]) -> Option<i64> {
    let smallest_ns = constraints.iter().map(|one| one.rtt_ns).min()?;
    Some(smallest_ns.max(0))
}

const fn half_way(first_ns: i64, last_ns: i64) -> i64 {
    first_ns.saturating_add(last_ns.saturating_sub(first_ns) / 2)
}

fn no_metrics(exchanges: &[Exchange], settings: &ClockSettings) -> ClockMetrics {
    let mut stamp_counts = BTreeMap::new();
    for kind in exchanges.iter().flat_map(Exchange::kinds) {
        *stamp_counts.entry(kind).or_insert(0_u64) += 1;
    }
    ClockMetrics {
        exchange_count: exchanges.len() as u64,
        unused_count: 0,
        stamp_counts,
        rtt_min_ns: None,
        offset: None,
        stretch_offsets: Vec::new(),
        spread_ns: None,
        skew_ppm: None,
        skew_error_ppm: None,
        bound: None,
        steps: Vec::new(),
        drift_ppb: settings.drift_ppb,
        drift_contradiction: None,
    }
}

/// An alignment in figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClockMetrics {
    /// Exchanges given, in both directions.
    pub exchange_count: u64,
    /// Those not used: implausible, or under way while a clock was stepped.
    pub unused_count: u64,
    /// Stamps of the exchanges given, four each, by what took them.
    pub stamp_counts: BTreeMap<StampKind, u64>,
    /// Smallest round trip, nanoseconds; 0 when errors of the stamps make it less than nothing.
    pub rtt_min_ns: Option<i64>,
    /// The offset in the middle of the exchanges or, when a clock was stepped just there, at the
    /// nearest instant that has one.
    pub offset: Option<OffsetMetrics>,
    /// The offset in the middle of each stretch between noticed steps, in order of time: one
    /// offset cannot be held against a run with steps.
    pub stretch_offsets: Vec<OffsetMetrics>,
    /// Standard deviation of the estimate's points about the line between their neighbours,
    /// nanoseconds; says nothing of a path that is always slower one way.
    pub spread_ns: Option<f64>,
    /// How much faster this host's clock runs than the other's, parts per million, over the longest
    /// stretch without a step.
    pub skew_ppm: Option<f64>,
    /// Its standard error: of the line, or of the mean of four parts' slopes, whichever is larger.
    pub skew_error_ppm: Option<f64>,
    /// Largest error of a converted instant, over the time of the exchanges.
    pub bound: Option<BoundMetrics>,
    /// Steps of either clock that were noticed.
    pub steps: Vec<ClockStep>,
    /// Drift allowance, parts per billion.
    pub drift_ppb: u32,
    /// The exchanges contradict that allowance: then there is no offset and no bound, and nothing
    /// converts.
    #[serde(default)]
    pub drift_contradiction: Option<DriftContradiction>,
}

/// The offset at one instant: `local = remote + offset`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OffsetMetrics {
    /// The instant, on the other host's clock, nanoseconds.
    pub at_ns: i64,
    /// Assuming that the fastest exchanges took equally long both ways.
    pub estimate_ns: i64,
    /// The guaranteed interval, from causality alone.
    pub lowest_ns: i64,
    /// Its other end.
    pub highest_ns: i64,
}

/// A step of one of the two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockStep {
    /// It happened after this, on the other host's clock, nanoseconds. Instants from here to
    /// `until_ns` have no alignment.
    pub from_ns: i64,
    /// It happened before this.
    pub until_ns: i64,
    /// What the offset gained by it, as estimated, nanoseconds.
    pub size_ns: Option<i64>,
}
