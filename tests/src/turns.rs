//! Attacks on a run in turns with as long a time without, and what each cost: messages of the shuttle, clock exchanges,
//! whatever else was watched. It sends nothing itself.
#![allow(clippy::print_stdout, reason = "a test's figures are its result")]

use core::ops::Range;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use std::{env, fs, thread};

use hil_core::record::{PublishedRecord, RoundTripRecord, TakenRecord};
use hil_platform::clock::MonotonicClock;
use hil_rundir::record::RecordFile;

use crate::shuttle::{CHANNELS, records};
use crate::trial::{RunFiles, Trial};

/// Of an attack, and of the time without that follows it.
pub const TURN: Duration = Duration::from_millis(500);

/// What an attack may cost, and how much must have been sent to show it.
#[derive(Debug, Clone, Copy)]
pub struct Bound {
    /// Share of what was sent that may be lost above the time without, or what fewer cannot show.
    pub cost_max: f64,
    /// Sent under the attack, and as many beside it.
    pub sent_min: usize,
}

impl Bound {
    /// Where none of n is lost, the share that is lost is below 3 / n with 95 % confidence (Hanley and
    /// Lippman-Hand, JAMA 1983).
    pub const MESSAGES: Self = Self {
        cost_max: 0.001,
        sent_min: 1_000,
    };
    /// For clock exchanges: half of those that a hop makes.
    fn of_exchanges(windows_ns: &[Range<i64>]) -> Self {
        let span_ns: i64 = windows_ns.iter().map(|one| one.end - one.start).sum();
        Self {
            cost_max: 0.1,
            sent_min: usize::try_from(span_ns / (2 * EXCHANGE_PERIOD_NS)).expect("a span"),
        }
    }
}

/// From one clock exchange of a hop to the next. A clock path makes more.
const EXCHANGE_PERIOD_NS: i64 = 100_000_000;

/// What was sent in some windows of time, and what of it never came.
#[derive(Debug, Default, Clone, Copy)]
pub struct Cost {
    /// Sent, as their sender recorded it.
    pub sent: usize,
    /// Of those, never received.
    pub lost: usize,
}

impl Cost {
    /// Of what was sent at these times, whose second part says whether it came.
    pub fn of(sent: impl Iterator<Item = (i64, bool)>, windows_ns: &[Range<i64>]) -> Self {
        let mut cost = Self::default();
        for (at_ns, has_come) in sent {
            if windows_ns.iter().any(|window| window.contains(&at_ns)) {
                cost.sent += 1;
                cost.lost += usize::from(!has_come);
            }
        }
        cost
    }

    fn ratio(self) -> f64 {
        self.lost as f64 / self.sent.max(1) as f64
    }

    fn and(self, other: Self) -> Self {
        Self {
            sent: self.sent + other.sent,
            lost: self.lost + other.lost,
        }
    }
}

/// The run of the shuttle with room for what comes while the machine stalls for a second, so that the cost of an attack is
/// measured and not that of the host.
#[must_use]
pub fn roomy(trial: Trial) -> Trial {
    trial
        .set("channels.\"shuttle/command\".depth=1024")
        .set("channels.\"shuttle/status\".depth=1024")
        .set("links.hop.receive_buffer_bytes=4194304")
}

/// Of the messages of `channel`, which leads from the first of `files` to the second.
///
/// # Panics
/// When the records cannot be read.
pub fn cost(files: [&RunFiles; 2], channel: &str, windows_ns: &[Range<i64>]) -> Cost {
    let published: Vec<PublishedRecord> = records(files[0], channel, "published");
    let taken: Vec<TakenRecord> = records(files[1], channel, "taken");
    let taken: BTreeSet<_> = taken.iter().map(|one| (one.epoch, one.sequence)).collect();
    let sent = published.iter().map(|one| {
        let has_come = taken.contains(&(one.epoch, one.sequence));
        (one.published_ns, has_come)
    });
    Cost::of(sent, windows_ns)
}

/// Of both channels of the shuttle, between the hosts that left `files`.
///
/// # Panics
/// As [`cost`].
pub fn cost_of_both(files: &[RunFiles; 2], windows_ns: &[Range<i64>]) -> Cost {
    let there = cost([&files[0], &files[1]], CHANNELS[0], windows_ns);
    there.and(cost([&files[1], &files[0]], CHANNELS[1], windows_ns))
}

/// Of the clock exchanges of all paths. One that is not on record was not answered; it was asked for between those beside
/// it, at equal distances.
///
/// # Panics
/// When the records cannot be read.
pub fn cost_of_exchanges(files: &RunFiles, windows_ns: &[Range<i64>]) -> Cost {
    let folder = files.root().join("records");
    let entries = fs::read_dir(&folder).expect("a folder of records");
    let paths = entries.flatten().map(|entry| entry.path());
    let paths = paths.filter(|path| path.to_string_lossy().contains(".round-trip."));
    let costs = paths.map(|path| {
        let file = RecordFile::read(&path).expect("records of exchanges");
        let answered = file.records::<RoundTripRecord>();
        let answered: BTreeMap<_, _> = answered
            .map(|one| ((one.session, one.sequence), one.t1_ns))
            .collect();
        let pairs = answered.iter().zip(answered.iter().skip(1));
        let sent = pairs.flat_map(
            |((&(session, first), &began_ns), (&(of, next), &ended_ns))| {
                let number = if of == session { next - first } else { 1 };
                (0..number).map(move |place| {
                    let step_ns = (ended_ns - began_ns) / i64::try_from(number).expect("a few");
                    let after_ns = step_ns * i64::try_from(place).expect("fewer");
                    (began_ns + after_ns, place == 0)
                })
            },
        );
        Cost::of(sent, windows_ns)
    });
    costs.fold(Cost::default(), Cost::and)
}

/// Turns of one kind of attack, and those without between them.
#[derive(Debug)]
pub struct Turns {
    /// The kind.
    pub name: &'static str,
    /// What was sent in all turns.
    pub sent_count: u64,
    /// The turns, this machine's monotonic clock.
    pub attacked_ns: Vec<Range<i64>>,
    /// Those without.
    pub quiet_ns: Vec<Range<i64>>,
}

impl Turns {
    /// Prints what the attack cost of `what`, counted by `cost`, and checks that it is within `bound`.
    ///
    /// # Panics
    /// When it is not.
    pub fn judge(&self, what: &str, cost: impl Fn(&[Range<i64>]) -> Cost, bound: Bound) {
        let [attacked, beside] = [&self.attacked_ns, &self.quiet_ns].map(|one| cost(one));
        let name = self.name;
        println!(
            "{name}: {} sent; {} of {} {what} lost, {} of {} beside it",
            self.sent_count, attacked.lost, attacked.sent, beside.lost, beside.sent
        );
        assert!(self.sent_count > 0, "{name}");
        assert!(
            attacked.sent.min(beside.sent) >= bound.sent_min,
            "{name}: {attacked:?}, {beside:?}"
        );
        let cost_max = bound.cost_max.max(3.0 / attacked.sent as f64);
        assert!(
            attacked.ratio() <= beside.ratio() + cost_max,
            "{name}: {attacked:?} of {what}, {beside:?} beside it"
        );
    }
}

/// Rounds of attacks: `HIL_ATTACK_ROUNDS`, else `usual`.
///
/// # Panics
/// When it is no number.
pub fn round_count(usual: u32) -> u32 {
    let asked = env::var("HIL_ATTACK_ROUNDS").ok();
    asked.map_or(usual, |text| text.parse().expect("a number of rounds"))
}

/// Plays each attack once a round and nothing after each.
pub fn play(attacks: &[(&'static str, &dyn Fn() -> u64)], round_count: u32) -> Vec<Turns> {
    let mut all: Vec<Turns> = attacks
        .iter()
        .map(|(name, _)| Turns {
            name,
            sent_count: 0,
            attacked_ns: Vec::new(),
            quiet_ns: Vec::new(),
        })
        .collect();
    let now_ns = || MonotonicClock::now().as_ns();
    for _ in 0..round_count {
        for ((_, attack), turns) in attacks.iter().zip(&mut all) {
            let began_ns = now_ns();
            turns.sent_count += attack();
            let ended_ns = now_ns();
            turns.attacked_ns.push(began_ns..ended_ns);
            thread::sleep(TURN);
            turns.quiet_ns.push(ended_ns..now_ns());
        }
    }
    all
}

/// Prints what each kind of attack cost a run of the shuttle, and checks that each cost none of its messages and clock
/// exchanges above the time without, within the bounds.
///
/// # Panics
/// When one did.
pub fn judge(files: &[RunFiles; 2], all: &[Turns]) {
    for turns in all {
        turns.judge(
            "messages",
            |windows_ns| cost_of_both(files, windows_ns),
            Bound::MESSAGES,
        );
        turns.judge(
            "clock exchanges",
            |windows_ns| cost_of_exchanges(&files[0], windows_ns),
            Bound::of_exchanges(&turns.attacked_ns),
        );
    }
}
