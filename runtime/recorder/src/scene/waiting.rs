//! Messages of a run that goes come channel by channel, the scene wants them in order of time: they
//! wait here until what could come before them has come, and until there is a ground to draw them on.

use std::collections::BTreeMap;

use super::{Heard, Scene, concerns, signed};
use crate::newest::Newest;
use crate::sink::Sink;

/// Whatever was published so long before the newest message has come, when nothing more waits.
const BEHIND_NS: i64 = 150_000_000;
/// Messages that wait at most. A recorder that begins late has a long past to read; the oldest go on
/// then before their time, and the picture of that moment may lack one of them. The same when a
/// ground takes long to make; that is said.
const WAITING_MAX: usize = 50_000;

#[derive(Debug)]
struct Message {
    channel: String,
    kind: String,
    payload: Vec<u8>,
    published_ns: i64,
}

/// The scene of a run that goes.
#[derive(Debug)]
pub(crate) struct LiveScene {
    scene: Scene,
    /// By time, then by arrival.
    waiting: BTreeMap<(u64, u64), Message>,
    arrived_count: u64,
    newest: Newest,
    /// Messages that went on before the ground was known.
    groundless_count: u64,
}

impl LiveScene {
    /// Nothing waits yet.
    pub(crate) fn new(scene: Scene) -> Self {
        Self {
            scene,
            waiting: BTreeMap::new(),
            arrived_count: 0,
            newest: Newest::default(),
            groundless_count: 0,
        }
    }

    /// False while the ground is being made that messages wait for.
    pub(crate) fn is_ready(&mut self) -> bool {
        self.arrived_count == 0 || self.scene.is_ready()
    }

    /// Takes a message, in whatever order.
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn take<S: Sink>(
        &mut self,
        heard: &Heard<'_>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        if !concerns(heard.message) {
            return Ok(());
        }
        let message = Message {
            channel: heard.channel.to_owned(),
            kind: heard.message.to_owned(),
            payload: heard.payload.to_vec(),
            published_ns: heard.published_ns,
        };
        self.waiting
            .insert((heard.at_ns, self.arrived_count), message);
        self.arrived_count += 1;
        self.newest.take(signed(heard.at_ns));
        while self.waiting.len() > WAITING_MAX {
            self.give_first(sink)?;
        }
        Ok(())
    }

    /// Nothing more has come for now: gives on what is old enough.
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn settle<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        if !self.is_ready() {
            return Ok(());
        }
        let newest_ns = self.newest.get().unwrap_or_default();
        let until_ns = newest_ns.saturating_sub(BEHIND_NS);
        self.give_until(until_ns.max(0).cast_unsigned(), sink)
    }

    /// Gives on everything, and the last picture.
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn finish<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.give_until(u64::MAX, sink)?;
        self.scene.finish(sink)
    }

    /// What the scene lacks, once it is finished.
    pub(crate) fn problems(&mut self) -> Vec<String> {
        let mut problems: Vec<String> = self
            .scene
            .problem()
            .map(str::to_owned)
            .into_iter()
            .collect();
        if self.groundless_count > 0 {
            problems.push(format!(
                "the scene of the first {} messages was drawn before the fleet's ways were planned: \
                 it lacks sections and ways ahead",
                self.groundless_count
            ));
        }
        if !self.is_ready() {
            let why = "the fleet's ways were not planned in time";
            problems.push(format!("/scene/ground is missing: {why}"));
        }
        problems
    }

    fn give_until<S: Sink>(&mut self, until_ns: u64, sink: &mut S) -> Result<(), S::Error> {
        while self
            .waiting
            .first_key_value()
            .is_some_and(|((at_ns, _), _)| *at_ns <= until_ns)
        {
            self.give_first(sink)?;
        }
        Ok(())
    }

    fn give_first<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        let Some(((at_ns, _), one)) = self.waiting.pop_first() else {
            return Ok(());
        };
        let heard = Heard {
            channel: &one.channel,
            message: &one.kind,
            payload: &one.payload,
            at_ns,
            published_ns: one.published_ns,
        };
        self.groundless_count += u64::from(!self.scene.is_ready());
        self.scene.take(&heard, sink)
    }
}
