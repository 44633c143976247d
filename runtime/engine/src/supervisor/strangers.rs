//! Connections of the supervisors that came to nothing before their other end had proven the key: by
//! address and cause, a bounded number of them. They decide nothing.

use std::net::IpAddr;

/// Pairs of address and cause that are kept apart; what more there are is counted together.
const KINDS_MAX: usize = 8;

/// Why a connection came to nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cause {
    /// It came from an address that is not awaited.
    ForeignAddress,
    /// Its greeting was made with another key.
    AnotherKey,
    /// It spoke as a host without a key does, and this run needs one.
    WithoutKey,
    /// It greeted with a key, and this host has none.
    WithKey,
    /// It proved the key under a name that is not awaited at its address.
    AnotherName,
    /// It said something else, or nothing in time, or left.
    NoGreeting,
    /// It made way for newer ones of its address.
    CrowdedOut,
    /// The end that was called said, without proof of the key, that this host holds another one.
    SaysAnotherKey,
    /// It said, without proof, that it works without a key.
    SaysPlain,
    /// It said, without proof, that it needs a key.
    SaysKeyNeeded,
    /// It did not greet as a host of ours does.
    SaysNothing,
}

impl Cause {
    /// Whether this host made the connection.
    const fn is_of_called(self) -> bool {
        matches!(
            self,
            Self::SaysAnotherKey | Self::SaysPlain | Self::SaysKeyNeeded | Self::SaysNothing
        )
    }

    const fn words(self) -> &'static str {
        match self {
            Self::ForeignAddress => "of an address that is not awaited",
            Self::AnotherKey => {
                "with another key (compare `hil-runtime key check FILE` on both hosts)"
            }
            Self::WithoutKey => "without a key, which this run needs",
            Self::WithKey => {
                "with a key, and this topology says [security] hops = \"plain\" (use the same file on both)"
            }
            Self::AnotherName => "with the key under a name that is not awaited at its address",
            Self::NoGreeting | Self::SaysNothing => "without a greeting",
            Self::CrowdedOut => "that made way for newer ones",
            Self::SaysAnotherKey => {
                "which answered without proof of the key that this host holds another key (compare \
                 `hil-runtime key check FILE` on both hosts)"
            }
            Self::SaysPlain => {
                "which answered without proof of the key that its topology says [security] hops = \"plain\" \
                 (use the same file on both)"
            }
            Self::SaysKeyNeeded => {
                "which answered that it speaks with holders of its key only, and this topology says \
                 [security] hops = \"plain\" (use the same file on both)"
            }
        }
    }
}

/// How many connections came to nothing.
#[derive(Debug, Clone, Default)]
pub(super) struct Strangers {
    /// In order of their first coming.
    kinds: Vec<(IpAddr, Cause, u64)>,
    /// Of further addresses and causes.
    other_count: u64,
}

impl Strangers {
    pub(super) fn note(&mut self, ip: IpAddr, cause: Cause) {
        let mut kinds = self.kinds.iter_mut();
        if let Some((_, _, count)) = kinds.find(|(known, why, _)| (*known, *why) == (ip, cause)) {
            *count += 1;
        } else if self.kinds.len() < KINDS_MAX {
            self.kinds.push((ip, cause, 1));
        } else {
            self.other_count += 1;
        }
    }

    /// In words, with the names that `name` gives to addresses; `None` when there were none.
    pub(super) fn words(&self, name: impl Fn(IpAddr) -> String) -> Option<String> {
        let known: u64 = self.kinds.iter().map(|(_, _, count)| count).sum();
        let total = known + self.other_count;
        let kinds = self.kinds.iter().map(|(ip, cause, count)| {
            let (who, why) = (name(*ip), cause.words());
            let way = if cause.is_of_called() { "to" } else { "from" };
            format!("{count} {way} {who} {why}")
        });
        let others = (self.other_count > 0).then(|| format!("{} of others", self.other_count));
        let kinds: Vec<String> = kinds.chain(others).collect();
        let noun = if total == 1 {
            "connection"
        } else {
            "connections"
        };
        (total > 0).then(|| {
            format!(
                "{total} {noun} came to nothing while the hosts met: {}",
                kinds.join(", ")
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    #[test]
    fn strangers_are_told_by_address_and_cause_and_their_list_is_bounded() {
        let mut strangers = Strangers::default();
        let name = |ip: IpAddr| ip.to_string();
        assert_eq!(strangers.words(name), None);
        for number in 0..100_u8 {
            let ip = Ipv4Addr::new(10, 0, 0, number % 20);
            strangers.note(ip.into(), Cause::NoGreeting);
        }
        let words = strangers.words(name).unwrap();
        assert!(words.starts_with("100 connections"), "{words}");
        assert!(
            words.contains("5 from 10.0.0.3 without a greeting"),
            "{words}"
        );
        assert!(words.ends_with("60 of others"), "{words}");
        assert_eq!(strangers.kinds.len(), KINDS_MAX);
    }
}
