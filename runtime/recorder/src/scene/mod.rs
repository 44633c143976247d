//! The scene of a run in its recording: `/scene`, `/scene/ground` and `/tf`, which viewers draw by
//! themselves. What is in it is worked out by [`crate::view`], as for the live page; here it is drawn
//! at an even pace of the run's own time, so that a file made live has the pictures of a converted
//! one as far as the same messages reached it in time: not those that only another host has, and not
//! those before it began.

mod arms;
mod fleet;
mod shapes;
#[cfg(test)]
mod tests;
pub(crate) mod waiting;

use foxglove::messages::{
    FrameTransforms, SceneEntity, SceneEntityDeletion, SceneUpdate, Timestamp,
    scene_entity_deletion,
};
use hil_arm::egm::messages::{EgmCommand, EgmFeedback};
use hil_core::message::Message;
use hil_fleet::messages::{Mission, State, Truth};
use prost::Message as _;
use serde_json::Value;

use crate::sink::{Sink, Topic};
use crate::topics::{Names, timestamp, well_known};
use crate::view::arms::ArmsView;
use crate::view::fleet::FleetView;
use crate::writer::Stamp;

/// Between two pictures, of the run's time: 20 Hz.
const PERIOD_NS: u64 = 50_000_000;
/// The same for fleets of many robots.
const LARGE_PERIOD_NS: u64 = 200_000_000;
/// Robots from which on a fleet counts as large.
const MANY_ROBOTS: usize = 64;
/// Between two pictures of the ground: whoever opens one of several files, or the middle of a
/// stream, has it within this time.
const GROUND_PERIOD_NS: u64 = 10_000_000_000;
/// Nothing is drawn of a silence longer than this: one damaged time must not make a million pictures.
const SILENCE_NS: u64 = 2_000_000_000;

/// A message that says something of the scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Heard<'a> {
    /// Its channel.
    pub(crate) channel: &'a str,
    /// Its message's name.
    pub(crate) message: &'a str,
    /// Itself.
    pub(crate) payload: &'a [u8],
    /// When it was published, on the recording's axis.
    pub(crate) at_ns: u64,
    /// When it was published, on its producer's clock.
    pub(crate) published_ns: i64,
}

/// True when messages of this name say anything of a scene.
pub(crate) fn concerns(message: &str) -> bool {
    is_of_fleet(message) || is_of_arms(message)
}

fn is_of_fleet(message: &str) -> bool {
    [State::NAME, Mission::NAME, Truth::NAME].contains(&message)
}

/// True when messages of this name are about arms.
pub(crate) fn is_of_arms(message: &str) -> bool {
    [EgmCommand::NAME, EgmFeedback::NAME].contains(&message)
}

/// The scene's topics, and what they show.
#[derive(Debug)]
pub(crate) struct Scene {
    fleet: Option<FleetView>,
    arms: ArmsView,
    /// `/live/map`, once it is known.
    map: Option<Value>,
    moving: Topic,
    ground: Topic,
    frames: Topic,
    /// The first message's time.
    origin_ns: Option<u64>,
    newest_ns: u64,
    next_ns: u64,
    ground_due_ns: u64,
    picture_count: u64,
    ground_count: u64,
}

impl Scene {
    /// The scene of a run of `case` with these `[case.parameters]`. The ground of a fleet is made
    /// from now on, in a thread of its own.
    pub(crate) fn new(case: Option<&str>, parameters: &Value, names: &mut Names) -> Self {
        let is_fleet = case == Some("fleet");
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
            fleet: is_fleet.then(|| FleetView::new(parameters)),
            arms: ArmsView::new(),
            map: None,
            moving,
            ground,
            frames: Topic::new(frames, well_known::<FrameTransforms>(), &[]),
            origin_ns: None,
            newest_ns: 0,
            next_ns: 0,
            ground_due_ns: 0,
            picture_count: 0,
            ground_count: 0,
        }
    }

    /// False while the ground of a fleet is being made; pictures drawn before lack what rests on it.
    pub(crate) fn is_ready(&mut self) -> bool {
        let Some(fleet) = &mut self.fleet else {
            return true;
        };
        if self.map.is_none() {
            self.map = fleet.new_map();
        }
        self.map.is_some() || fleet.problem.is_some()
    }

    /// Why a fleet has no ground.
    pub(crate) fn problem(&self) -> Option<&str> {
        self.fleet.as_ref()?.problem.as_deref()
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
            has_fleet |= message == State::NAME && self.fleet.is_some();
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
    ///
    /// # Errors
    /// When the sink cannot take a picture.
    pub(crate) fn take<S: Sink>(
        &mut self,
        heard: &Heard<'_>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let is_fleets = self.fleet.is_some() && is_of_fleet(heard.message);
        if !is_fleets && !is_of_arms(heard.message) {
            return Ok(());
        }
        if self.origin_ns.is_none() {
            self.origin_ns = Some(heard.at_ns);
            self.next_ns = heard.at_ns.saturating_add(PERIOD_NS);
            self.ground_due_ns = heard.at_ns;
        }
        self.draw_until(heard.at_ns, sink)?;
        self.newest_ns = self.newest_ns.max(heard.at_ns);
        let at_ns = signed(heard.at_ns);
        if is_fleets {
            if let Some(fleet) = &mut self.fleet {
                let offset_ns = at_ns.saturating_sub(heard.published_ns);
                fleet.take(heard.message, heard.payload, at_ns, offset_ns);
            }
        } else {
            self.arms
                .take(heard.channel, heard.message, heard.payload, at_ns);
        }
        Ok(())
    }

    /// Draws what the last messages said.
    ///
    /// # Errors
    /// When the sink cannot take the picture.
    pub(crate) fn finish<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
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
            let robots = self.fleet.as_ref().map_or(0, FleetView::robot_count);
            self.next_ns += if robots > MANY_ROBOTS {
                LARGE_PERIOD_NS
            } else {
                PERIOD_NS
            };
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
        if let Some(fleet) = &mut self.fleet {
            if fleet.robot_count() > 0
                && let Some(size) = fleet.vehicle_size_m()
            {
                let picture = fleet.picture(now_ns, origin_ns);
                let update = fleet::moving(&picture, size, time);
                self.moving.write(sink, stamp, &update.encode_to_vec())?;
                self.picture_count += 1;
            }
        } else if self.arms.is_known() {
            let picture = self.arms.picture(now_ns, origin_ns);
            let update = arms::shapes(&picture, time);
            self.moving.write(sink, stamp, &update.encode_to_vec())?;
            let frames = arms::transforms(&picture, time);
            self.frames.write(sink, stamp, &frames.encode_to_vec())?;
            self.picture_count += 1;
        }
        if at_ns >= self.ground_due_ns
            && let Some(map) = &self.map
        {
            self.ground_due_ns = at_ns.saturating_add(GROUND_PERIOD_NS);
            let stamp = Stamp::new(at_ns, self.ground_count);
            self.ground_count += 1;
            let update = fleet::ground(map, time);
            self.ground.write(sink, stamp, &update.encode_to_vec())?;
        }
        Ok(())
    }
}

fn signed(at_ns: u64) -> i64 {
    i64::try_from(at_ns).unwrap_or(i64::MAX)
}

/// A whole picture: it takes the place of all that the topic showed before, so that any one message
/// of a file is enough to see the scene.
fn entire(entities: Vec<SceneEntity>, at: Timestamp) -> SceneUpdate {
    SceneUpdate {
        deletions: vec![SceneEntityDeletion {
            timestamp: Some(at),
            r#type: scene_entity_deletion::Type::All.into(),
            id: String::new(),
        }],
        entities,
    }
}
