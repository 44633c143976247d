//! What happens in an episode, drawn from its seed. It does nothing.

use std::fmt;
use std::time::Duration;

use hil_core::random::RandomStream;

/// Length of a run, from its begin.
pub const RUN_LENGTH: Duration = Duration::from_secs(2);
/// How long a host may be silent before the other gives it up.
pub const PEER_TIMEOUT: Duration = Duration::from_secs(4);

/// What is done to a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// `kill -9` of a component, which is started again.
    KillComponent,
    /// `kill -9` of a gateway, which is started again.
    KillGateway,
    /// `kill -9` of a component or gateway while it starts.
    KillAtStart,
    /// `kill -9` of a supervisor.
    KillSupervisor,
    /// `kill -9` of a recorder that looks on.
    KillRecorder,
    /// SIGSTOP of a component, and SIGCONT.
    PauseComponent,
    /// SIGSTOP of a gateway, and SIGCONT.
    PauseGateway,
    /// SIGSTOP of a supervisor for less than the other waits, and SIGCONT.
    PauseSupervisor,
    /// SIGSTOP of a supervisor for longer than the other waits, and SIGCONT.
    HangSupervisor,
    /// SIGINT to a supervisor.
    Interrupt,
    /// The cable is pulled and plugged in.
    CutCable,
    /// Datagrams and connections of a stranger at every port of the run.
    Flood,
    /// Datagrams that look like a gateway's and are of none.
    Forge,
    /// Copies of real datagrams, late and out of order.
    Copy,
    /// Copies of real datagrams with flipped bits, as a bad cable delivers them.
    Damage,
    /// A path that takes only short packets, and then longer ones again.
    ShrinkMtu,
    /// No room for records.
    FillDisk,
    /// Another condition on an emulated link.
    StepCondition,
}

impl Kind {
    /// Every kind, with how often it is drawn.
    pub const ALL: [(Self, u64); 18] = [
        (Self::KillComponent, 4),
        (Self::KillGateway, 4),
        (Self::KillAtStart, 2),
        (Self::KillSupervisor, 2),
        (Self::KillRecorder, 2),
        (Self::PauseComponent, 3),
        (Self::PauseGateway, 3),
        (Self::PauseSupervisor, 2),
        (Self::HangSupervisor, 1),
        (Self::Interrupt, 1),
        (Self::CutCable, 3),
        (Self::Flood, 2),
        (Self::Forge, 2),
        (Self::Copy, 3),
        (Self::Damage, 2),
        (Self::ShrinkMtu, 2),
        (Self::FillDisk, 2),
        (Self::StepCondition, 2),
    ];

    /// A run to which nothing else is done reaches its planned end on both hosts.
    pub const fn is_survived(self) -> bool {
        !matches!(
            self,
            Self::KillAtStart
                | Self::KillSupervisor
                | Self::HangSupervisor
                | Self::Interrupt
                | Self::FillDisk
        )
    }

    /// In words.
    pub const fn label(self) -> &'static str {
        match self {
            Self::KillComponent => "kill a component",
            Self::KillGateway => "kill a gateway",
            Self::KillAtStart => "kill at start",
            Self::KillSupervisor => "kill a supervisor",
            Self::KillRecorder => "kill a recorder",
            Self::PauseComponent => "pause a component",
            Self::PauseGateway => "pause a gateway",
            Self::PauseSupervisor => "pause a supervisor",
            Self::HangSupervisor => "hang a supervisor",
            Self::Interrupt => "interrupt",
            Self::CutCable => "cut the cable",
            Self::Flood => "flood",
            Self::Forge => "forge datagrams",
            Self::Copy => "copy datagrams",
            Self::Damage => "damage datagrams",
            Self::ShrinkMtu => "shrink the MTU",
            Self::FillDisk => "fill the disk",
            Self::StepCondition => "step the link",
        }
    }
}

/// One thing that is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Injection {
    /// What.
    pub kind: Kind,
    /// To which host: 0 or 1.
    pub host: usize,
    /// When, after messages flow; of [`Kind::KillAtStart`] after the supervisors were started.
    pub at: Duration,
    /// How long, where that means something.
    pub length: Duration,
    /// For what is drawn while it is done.
    pub seed: u64,
}

/// How messages cross.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Carrier {
    /// UDP.
    Udp,
    /// TCP.
    Tcp,
    /// UDP through an emulated link.
    Emulated,
}

impl Carrier {
    /// As `via` says it.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Udp => "udp",
            Self::Tcp => "tcp",
            Self::Emulated => "emulated",
        }
    }
}

/// An episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// What it was drawn from.
    pub seed: u64,
    /// How messages cross.
    pub carrier: Carrier,
    /// Hops are sealed.
    pub is_sealed: bool,
    /// What is done, in order of time.
    pub injections: Vec<Injection>,
}

impl Plan {
    /// The episode of this seed.
    pub fn of(seed: u64) -> Self {
        let mut random = RandomStream::new(seed, "chaos");
        let mut below = |bound: u64| random.next_u64() % bound;
        let mut carrier = match below(4) {
            0 => Carrier::Tcp,
            1 => Carrier::Emulated,
            _ => Carrier::Udp,
        };
        let total: u64 = Kind::ALL.iter().map(|one| one.1).sum();
        let mut injections = Vec::new();
        for _ in 0..=below(3) {
            let mut place = below(total);
            let drawn = Kind::ALL.iter().find(|(_, weight)| {
                let is_here = place < *weight;
                place = place.saturating_sub(*weight);
                is_here
            });
            let kind = drawn.map_or(Kind::KillGateway, |one| one.0);
            if kind == Kind::StepCondition {
                carrier = Carrier::Emulated;
            }
            let within_ms = match kind {
                // The first 40 ms of a process are when its death leaves things half made.
                Kind::KillAtStart => 400,
                _ => 1500,
            };
            let length_ms = match kind {
                Kind::HangSupervisor => 5500 + below(1000),
                Kind::CutCable => 50 + below(550),
                _ => 50 + below(750),
            };
            injections.push(Injection {
                kind,
                host: usize::from(below(2) == 1),
                at: Duration::from_micros(below(within_ms * 1000)),
                length: Duration::from_millis(length_ms),
                seed: below(u64::MAX),
            });
        }
        injections.sort_by_key(|injection| injection.at);
        Self {
            seed,
            carrier,
            // By a lot of its own, so that what is done stays what it was before hops could be sealed.
            is_sealed: RandomStream::new(seed, "chaos seal").chance(0.5),
            injections,
        }
    }

    /// Whether `kind` is done to `host`; `None`: to any.
    pub fn has(&self, kind: Kind, host: Option<usize>) -> bool {
        let mut injections = self.injections.iter();
        injections.any(|one| one.kind == kind && host.is_none_or(|host| one.host == host))
    }

    /// Both hosts reach the planned end.
    pub fn is_survived(&self) -> bool {
        self.injections.iter().all(|one| one.kind.is_survived())
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hops = if self.is_sealed { "sealed" } else { "plain" };
        write!(f, "seed {} over {hops} {}", self.seed, self.carrier.word())?;
        for injection in &self.injections {
            write!(
                f,
                "; {} on {} at {} ms",
                injection.kind.label(),
                injection.host,
                injection.at.as_millis()
            )?;
            if !matches!(
                injection.kind,
                Kind::KillComponent | Kind::KillGateway | Kind::KillSupervisor | Kind::Interrupt
            ) {
                write!(f, " for {} ms", injection.length.as_millis())?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_is_an_episode_and_another_seed_another() {
        assert_eq!(Plan::of(7), Plan::of(7));
        assert_ne!(Plan::of(7), Plan::of(8));
        let order = |plan: &Plan| plan.injections.is_sorted_by_key(|one| one.at);
        assert!((0..500).all(|seed| order(&Plan::of(seed))));
    }

    #[test]
    fn every_kind_is_drawn_on_either_host() {
        let plans: Vec<Plan> = (0..500).map(Plan::of).collect();
        for (kind, _) in Kind::ALL {
            for host in 0..2 {
                let count = plans.iter().filter(|plan| plan.has(kind, Some(host)));
                assert!(count.count() >= 2, "{kind:?} on {host}");
            }
        }
        assert!(plans.iter().any(Plan::is_survived));
        let sealed_count = plans.iter().filter(|plan| plan.is_sealed).count();
        assert!((200..300).contains(&sealed_count), "{sealed_count}");
        let steps = plans
            .iter()
            .filter(|plan| plan.has(Kind::StepCondition, None));
        assert!(
            steps
                .into_iter()
                .all(|plan| plan.carrier == Carrier::Emulated)
        );
    }
}
