//! Everything of a run at once: takes its records and gives the JSON of each topic of
//! docs/live-view.md.

use serde_json::{Value, json};

use super::account::Account;
use super::arms::ArmsView;
use super::facts::RunFacts;
use super::{Body, LiveRecord, Pictures, Told, seconds};

/// A run while it goes on.
#[derive(Debug)]
pub(crate) struct RunState {
    /// What was known before.
    pub(crate) facts: RunFacts,
    /// How it ended; `None` while records come.
    pub(crate) how_ended: Option<String>,
    /// Of each channel.
    pub(crate) accounts: Vec<Account>,
    /// What it looks like.
    pub(crate) pictures: Pictures,
    /// The first record's time.
    pub(crate) origin_ns: Option<i64>,
    /// When it ended.
    pub(crate) ended_ns: Option<i64>,
    read_count: u64,
}

impl RunState {
    /// A run without a record yet.
    pub(crate) fn new(facts: RunFacts) -> Self {
        let pictures = Pictures::of(facts.case.as_deref(), &facts.parameters);
        Self::with(facts, pictures)
    }

    fn with(facts: RunFacts, pictures: Pictures) -> Self {
        let channels = facts.channels.iter();
        let accounts = channels.map(|channel| Account::new(channel, facts.has_one_clock));
        Self {
            accounts: accounts.collect(),
            pictures,
            how_ended: None,
            origin_ns: None,
            ended_ns: None,
            read_count: 0,
            facts,
        }
    }

    /// Begins again with the same run; what takes long to work out is kept.
    pub(crate) fn rewind(&mut self) {
        let mut fleet = self.pictures.fleet.take();
        if let Some(fleet) = &mut fleet {
            fleet.rewind();
        }
        let arms = ArmsView::new();
        let facts = core::mem::take(&mut self.facts);
        *self = Self::with(facts, Pictures { fleet, arms });
    }

    /// Stamps of all hosts compare from now on.
    pub(crate) fn compare_clocks(&mut self) {
        self.facts.has_one_clock = true;
        for account in &mut self.accounts {
            account.compare_clocks();
        }
    }

    /// Takes a record.
    pub(crate) fn take(&mut self, record: &LiveRecord) {
        let Some(channel) = self.facts.channels.get(record.channel) else {
            return;
        };
        if self
            .origin_ns
            .is_none_or(|origin_ns| record.at_ns < origin_ns)
        {
            self.origin_ns = Some(record.at_ns);
        }
        self.accounts[record.channel].take(record);
        if let Body::Message(payload) = &record.body {
            self.read_count += 1;
            let message = channel.message.as_deref().unwrap_or_default();
            if let Some(told) = Told::of(&channel.name, message, payload) {
                let offset_ns = channel.offsets_ns[0];
                self.pictures.take(&told, record.at_ns, offset_ns);
            }
        }
    }

    /// Seconds from the first record to now or to the end.
    pub(crate) fn elapsed_s(&self, now_ns: i64) -> Option<f64> {
        let now_ns = self.ended_ns.unwrap_or(now_ns);
        self.origin_ns
            .map(|origin_ns| seconds((now_ns - origin_ns).max(0)))
    }

    /// `/live/run`, without what only the server knows.
    pub(crate) fn run(&self, now_ns: i64) -> Value {
        let facts = &self.facts;
        let state = if self.how_ended.is_some() {
            "ended"
        } else {
            "running"
        };
        json!({
            "name": facts.name, "case": facts.case, "state": state,
            "how": self.how_ended,
            "elapsed_s": self.elapsed_s(now_ns),
            "duration_s": facts.duration.map(|one| one.as_secs_f64()),
            "hosts_here": facts.hosts_here, "hosts": facts.hosts,
            "topology_hash": facts.topology_hash, "seed": facts.seed,
            "channels": facts.channels,
            "recorder": { "read_count": self.read_count },
        })
    }

    /// `/live/channels`, and each `/live/losses` since the last call.
    pub(crate) fn channels(&mut self, now_ns: i64) -> (Value, Vec<Value>) {
        let at_s = self.elapsed_s(now_ns);
        let (mut channels, mut losses) = (Vec::new(), Vec::new());
        for (account, facts) in self.accounts.iter_mut().zip(&self.facts.channels) {
            account.settle(now_ns);
            channels.push(account.metrics(&facts.name, now_ns));
            // Another host's clock may be anything.
            let from_host = facts.from_host.as_ref();
            let is_here = from_host.is_some_and(|host| self.facts.hosts_here.contains(host));
            let origin_ns = self
                .origin_ns
                .filter(|_| is_here || self.facts.has_one_clock);
            let origin_ns = origin_ns.map(|origin_ns| origin_ns - facts.offsets_ns[0]);
            losses.extend(account.take_losses(&facts.name, at_s.unwrap_or(0.0), origin_ns));
        }
        let channels = json!({ "at_s": at_s, "window_s": 1, "channels": channels });
        (channels, losses)
    }
}
