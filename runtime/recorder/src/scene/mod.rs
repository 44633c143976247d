//! The scene of a run in its recording: `/scene`, `/scene/ground` and `/tf`, which viewers draw by
//! themselves. What is in it is worked out by [`crate::view`], as for the live page; here it is drawn
//! at an even pace of the run's own time, so that a file made live has the pictures of a converted
//! one as far as the same messages reached it in time: not those that only another host has, and not
//! those before it began.

mod draw;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use foxglove::messages::{FrameTransforms, SceneUpdate};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback};
use hil_core::message::Message;
use hil_fleet::messages::State;
use serde_json::Value;

use crate::newest::Newest;
use crate::sink::{Sink, Topic};
use crate::topics::{Names, timestamp, well_known};
use crate::view::fleet::FleetView;
use crate::view::{PERIOD_NS, Pictures, Told};
use crate::writer::Stamp;

/// Between two pictures of the ground: whoever opens one of several files, or the middle of a
/// stream, has it within this time.
const GROUND_PERIOD_NS: u64 = 10_000_000_000;
/// Nothing is drawn of a silence longer than this: one damaged time must not make a million pictures.
const SILENCE_NS: u64 = 2_000_000_000;

/// Whatever was published so long before the newest message has come, when nothing more waits.
const BEHIND_NS: i64 = 150_000_000;
/// Messages that wait at most. A recorder that begins late has a long past to read; the oldest go on
/// then before their time, and the picture of that moment may lack one of them. The same when a
/// ground takes long to make; that is said.
const WAITING_MAX: usize = 50_000;

/// A message that says something of the scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Heard {
    /// What it says.
    pub(crate) told: Told,
    /// When it was published, on the recording's axis.
    pub(crate) at_ns: u64,
    /// When it was published, on its producer's clock.
    pub(crate) published_ns: i64,
}

/// True when messages of this name are about arms.
pub(crate) fn is_of_arms(message: &str) -> bool {
    [EgmCommand::NAME, EgmFeedback::NAME].contains(&message)
}

/// The scene's topics, and what they show.
#[derive(Debug)]
pub(crate) struct Scene {
    pictures: Pictures,
    moving: Topic,
    ground: Topic,
    frames: Topic,
    /// The first message's time.
    origin_ns: Option<u64>,
    next_ns: u64,
    ground_due_ns: u64,
    picture_count: u64,
    ground_count: u64,
    /// Messages of a run that goes come channel by channel, the scene wants them in order of time: they
    /// wait until what could come before them has come, and until there is a ground to draw them on. By
    /// time, then by arrival.
    waiting: BTreeMap<(u64, u64), Heard>,
    arrived_count: u64,
    newest: Newest,
    /// Messages that went on before the ground was known.
    groundless_count: u64,
}

impl Scene {
    /// The scene of a run of `case` with these `[case.parameters]`. The ground of a fleet is made
    /// from now on, in a thread of its own.
    pub(crate) fn new(case: Option<&str>, parameters: &Value, names: &mut Names) -> Self {
        let mut scene_topic = |name: &str| {
            Topic::new(
                names.claim(name.to_owned()),
                well_known::<SceneUpdate>(),
                &[],
            )
        };
        let (moving, ground) = (scene_topic("/scene"), scene_topic("/scene/ground"));
        let frames = names.claim("/tf".to_owned());
        Self {
            pictures: Pictures::of(case, parameters),
            moving,
            ground,
            frames: Topic::new(frames, well_known::<FrameTransforms>(), &[]),
            origin_ns: None,
            next_ns: 0,
            ground_due_ns: 0,
            picture_count: 0,
            ground_count: 0,
            waiting: BTreeMap::new(),
            arrived_count: 0,
            newest: Newest::default(),
            groundless_count: 0,
        }
    }

    /// False while the ground of a fleet is being made; pictures drawn before lack what rests on it.
    pub(crate) fn is_ready(&mut self) -> bool {
        let Some(fleet) = &mut self.pictures.fleet else {
            return true;
        };
        fleet.new_map();
        fleet.map().is_some() || fleet.problem.is_some()
    }

    /// True while the ground is being made that messages wait for.
    pub(crate) fn awaits_ground(&mut self) -> bool {
        self.arrived_count > 0 && !self.is_ready()
    }

    /// What the scene lacks, once it is finished.
    pub(crate) fn problems(&mut self) -> Vec<String> {
        let fleet = self.pictures.fleet.as_ref();
        let problem = fleet.and_then(|fleet| fleet.problem.clone());
        let mut problems: Vec<String> = problem.into_iter().collect();
        if self.groundless_count > 0 {
            problems.push(format!(
                "the scene of the first {} messages was drawn before the fleet's ways were planned: \
                 it lacks sections and ways ahead",
                self.groundless_count
            ));
        }
        if self.awaits_ground() {
            let why = "the fleet's ways were not planned in time";
            problems.push(format!("/scene/ground is missing: {why}"));
        }
        problems
    }

    /// Lets `sink` hear now of the topics that messages of these names lead to.
    ///
    /// # Errors
    /// When it has no room for them.
    pub(crate) fn declare<'a, S: Sink>(
        &mut self,
        messages: impl Iterator<Item = &'a str>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let (mut has_fleet, mut has_arms) = (false, false);
        for message in messages {
            has_fleet |= message == State::NAME && self.pictures.fleet.is_some();
            has_arms |= is_of_arms(message);
        }
        if has_fleet || has_arms {
            self.moving.declare(sink)?;
        }
        if has_fleet {
            self.ground.declare(sink)?;
        }
        if has_arms {
            self.frames.declare(sink)?;
        }
        Ok(())
    }

    /// Takes a message, after the pictures that are due before it. Messages come in order of time.
    fn take<S: Sink>(&mut self, heard: &Heard, sink: &mut S) -> Result<(), S::Error> {
        if !self.pictures.shows(&heard.told) {
            return Ok(());
        }
        if self.origin_ns.is_none() {
            self.origin_ns = Some(heard.at_ns);
            self.next_ns = heard.at_ns.saturating_add(PERIOD_NS);
            self.ground_due_ns = heard.at_ns;
        }
        self.draw_until(heard.at_ns, sink)?;
        let at_ns = signed(heard.at_ns);
        let offset_ns = at_ns.saturating_sub(heard.published_ns);
        self.pictures.take(&heard.told, at_ns, offset_ns);
        Ok(())
    }

    /// Takes a message in whatever order.
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn hold<S: Sink>(&mut self, heard: &Heard, sink: &mut S) -> Result<(), S::Error> {
        let key = (heard.at_ns, self.arrived_count);
        self.waiting.insert(key, *heard);
        self.arrived_count += 1;
        self.newest.take(signed(heard.at_ns));
        let excess_count = self.waiting.len().saturating_sub(WAITING_MAX);
        self.take_until(u64::MAX, excess_count, sink)
    }

    /// Nothing more has come for now: takes what waits and is old enough.
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn settle<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        if self.awaits_ground() {
            return Ok(());
        }
        let newest_ns = self.newest.get().unwrap_or_default();
        let until_ns = newest_ns.saturating_sub(BEHIND_NS).max(0);
        self.take_until(until_ns.cast_unsigned(), usize::MAX, sink)
    }

    /// Takes at most so many of the messages that wait, those until `until_ns`.
    fn take_until<S: Sink>(
        &mut self,
        until_ns: u64,
        count_max: usize,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        for _ in 0..count_max {
            let first = self.waiting.first_entry();
            let Some(first) = first.filter(|first| first.key().0 <= until_ns) else {
                break;
            };
            let heard = first.remove();
            self.groundless_count += u64::from(!self.is_ready());
            self.take(&heard, sink)?;
        }
        Ok(())
    }

    /// Takes everything that waits: nothing comes any more that was before it.
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn draw_held<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.take_until(u64::MAX, usize::MAX, sink)
    }

    /// Takes everything that waits, and draws what the last messages said.
    ///
    /// # Errors
    /// When the sink cannot take the picture.
    pub(crate) fn finish<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.draw_held(sink)?;
        if self.origin_ns.is_none() {
            return Ok(());
        }
        self.draw_until(self.next_ns, sink)
    }

    fn draw_until<S: Sink>(&mut self, at_ns: u64, sink: &mut S) -> Result<(), S::Error> {
        if at_ns.saturating_sub(self.next_ns) > SILENCE_NS {
            self.draw(self.next_ns, sink)?;
            let silent_ns = at_ns - self.next_ns;
            self.next_ns += silent_ns.next_multiple_of(PERIOD_NS);
        }
        while self.next_ns <= at_ns {
            self.draw(self.next_ns, sink)?;
            self.next_ns += self.pictures.period_ns();
        }
        Ok(())
    }

    fn draw<S: Sink>(&mut self, at_ns: u64, sink: &mut S) -> Result<(), S::Error> {
        let (Some(origin_ns), Some(time)) = (self.origin_ns, timestamp(at_ns)) else {
            return Ok(());
        };
        let (now_ns, origin_ns) = (signed(at_ns), signed(origin_ns));
        let stamp = Stamp::new(at_ns, self.picture_count);
        self.is_ready();
        let shown = &mut self.pictures;
        if let Some(fleet) = &mut shown.fleet {
            if fleet.robot_count() > 0
                && let Some(size) = fleet.vehicle_size_m()
            {
                let picture = fleet.picture(now_ns, origin_ns);
                let update = draw::moving(&picture, size, time);
                self.moving.put(sink, stamp, &update)?;
                self.picture_count += 1;
            }
        } else if shown.arms.is_known() {
            let picture = shown.arms.picture(now_ns, origin_ns);
            let update = draw::arms(&picture, time);
            self.moving.put(sink, stamp, &update)?;
            let frames = draw::transforms(&picture, time);
            self.frames.put(sink, stamp, &frames)?;
            self.picture_count += 1;
        }
        if at_ns >= self.ground_due_ns
            && let Some(map) = self.pictures.fleet.as_ref().and_then(FleetView::map)
        {
            self.ground_due_ns = at_ns.saturating_add(GROUND_PERIOD_NS);
            let stamp = Stamp::new(at_ns, self.ground_count);
            self.ground_count += 1;
            let update = draw::ground(map, time);
            self.ground.put(sink, stamp, &update)?;
        }
        Ok(())
    }
}

fn signed(at_ns: u64) -> i64 {
    i64::try_from(at_ns).unwrap_or(i64::MAX)
}
