//! The recording's times of a run that still goes. Once chosen, a host's offset stays, so that the
//! differences of its times are those of its clock.

use std::collections::BTreeMap;

use hil_core::message::Envelope;
use hil_core::record::UNAVAILABLE;
use hil_watch::Feed;

use crate::clocks::{self, Basis, UNKNOWN_HOST, at};
use crate::facts::Words;
use crate::net::MessageLatency;

/// The clocks of a run that goes.
#[derive(Debug, Default)]
pub(crate) struct LiveClocks {
    /// Real-time minus monotonic clock of this machine.
    own_offset_ns: Option<i64>,
    hosts_here: Vec<String>,
    chosen: BTreeMap<String, Basis>,
    /// Of hosts whose clock is another one, by what their gateways noted; known at the end.
    noted_ns: BTreeMap<String, i64>,
    has_one_clock: Option<bool>,
}

impl LiveClocks {
    /// What the run's announcement and manifest say.
    pub(crate) fn of(feed: &Feed) -> Self {
        let mut clocks = Self {
            own_offset_ns: feed.manifest().realtime_minus_monotonic_ns,
            hosts_here: feed.manifest().hosts_here.clone(),
            has_one_clock: feed.has_one_clock(),
            ..Self::default()
        };
        for channel in feed.channels() {
            let host = channel.description.from_host.as_deref().unwrap_or_default();
            // Where nobody knows yet how a clock stands, the first message decides.
            if clocks.has_one_clock.is_some() || clocks.is_here(host) {
                clocks.basis(host);
            }
        }
        clocks
    }

    fn is_here(&self, host: &str) -> bool {
        host.is_empty() || self.hosts_here.iter().any(|here| here == host)
    }

    /// How the clocks stand, as far as it is known by now.
    pub(crate) fn learn(&mut self, has_one_clock: Option<bool>) {
        self.has_one_clock = has_one_clock;
    }

    /// True when stamps of both ends of a link compare.
    pub(crate) fn compares(&self) -> bool {
        self.has_one_clock == Some(true)
    }

    /// What a gateway of `host` read.
    pub(crate) fn note(&mut self, host: &str, offset_ns: i64) {
        if offset_ns != UNAVAILABLE && !self.noted_ns.contains_key(host) {
            self.noted_ns.insert(host.to_owned(), offset_ns);
        }
    }

    fn basis(&mut self, host: &str) -> Basis {
        if let Some(basis) = self.chosen.get(host) {
            return *basis;
        }
        let is_here = self.is_here(host);
        let basis = match (self.own_offset_ns, is_here) {
            (None, _) if is_here || self.compares() => Basis::None,
            (Some(_), true) => Basis::Manifest,
            (Some(_), false) if self.compares() => Basis::OtherHost,
            _ => Basis::Arrival,
        };
        self.chosen.insert(host.to_owned(), basis);
        basis
    }

    fn own(&self, monotonic_ns: i64) -> Option<u64> {
        at(self.own_offset_ns.unwrap_or(0), monotonic_ns)
    }

    /// The time of an instant on the clock of `host`; `None` when that clock is another one and
    /// nobody noted how it stands.
    pub(crate) fn time_ns(&mut self, host: &str, monotonic_ns: i64) -> Option<u64> {
        match self.basis(host) {
            Basis::Arrival => at(*self.noted_ns.get(host)?, monotonic_ns),
            _ => self.own(monotonic_ns),
        }
    }

    /// The time of a message whose producer runs on `host`.
    pub(crate) fn message_ns(&mut self, host: &str, envelope: &Envelope) -> Option<u64> {
        if self.basis(host) == Basis::Arrival && envelope.is_forwarded() {
            return self.own(envelope.forwarded_ns);
        }
        self.time_ns(host, envelope.published_ns)
    }

    /// The time of the stamps of a message whose producer runs on `host`.
    pub(crate) fn latency_ns(&mut self, host: &str, one: &MessageLatency) -> Option<u64> {
        if self.basis(host) == Basis::Arrival
            && let Some(arrived_ns) = one.forwarded_ns.or(one.received_ns)
        {
            return self.own(arrived_ns);
        }
        self.time_ns(host, one.published_ns?)
    }

    /// What a recording says of them.
    pub(crate) fn words(&self) -> Words {
        let mut words = clocks::words(self.has_one_clock);
        for (host, basis) in &self.chosen {
            let offset_ns = match basis {
                Basis::Arrival => self.noted_ns.get(host).copied(),
                _ => Some(self.own_offset_ns.unwrap_or(0)),
            };
            let host = if host.is_empty() { UNKNOWN_HOST } else { host };
            clocks::host_words(host, *basis, offset_ns, &mut words);
        }
        words
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clocks(has_one_clock: Option<bool>) -> LiveClocks {
        LiveClocks {
            own_offset_ns: Some(1000),
            hosts_here: vec!["here".to_owned()],
            has_one_clock,
            ..LiveClocks::default()
        }
    }

    fn envelope(is_forwarded: bool) -> Envelope {
        Envelope {
            published_ns: 5,
            forwarded_ns: 70,
            flags: if is_forwarded { Envelope::FORWARDED } else { 0 },
            ..Envelope::default()
        }
    }

    #[test]
    fn another_clock_is_not_read_as_ones_own() {
        let mut one = clocks(Some(true));
        assert_eq!(one.message_ns("here", &envelope(false)), Some(1005));
        assert_eq!(one.message_ns("there", &envelope(true)), Some(1005));
        let mut two = clocks(Some(false));
        assert_eq!(two.message_ns("there", &envelope(true)), Some(1070));
        assert_eq!(two.message_ns("there", &envelope(false)), None);
        two.note("there", 9);
        two.note("there", 99);
        assert_eq!(two.message_ns("there", &envelope(false)), Some(14));
        // What comes to be known later moves no time that was chosen.
        two.learn(Some(true));
        assert_eq!(two.message_ns("there", &envelope(true)), Some(1070));
        assert_eq!(two.words()["there/offset_ns"], "9");
    }
}
