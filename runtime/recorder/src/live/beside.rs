//! What stands beside the channels in a recording of a run that goes: its scene, and what was done to
//! its links.

use hil_models::link::condition::LinkConditionRecord;

use super::LiveTopics;
use crate::scene::waiting::LiveScene;
use crate::sink::Sink;

impl LiveTopics {
    /// Nothing more has come for now: draws the scene as far as it is known.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn draw<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.scene
            .as_mut()
            .map_or(Ok(()), |scene| scene.settle(sink))
    }

    /// False while something is being made that the scene waits for.
    pub(crate) fn is_scene_ready(&mut self) -> bool {
        self.scene.as_mut().is_none_or(LiveScene::is_ready)
    }

    /// Nothing more will come: draws the rest of the scene; what it lacks.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn finish_scene<S: Sink>(&mut self, sink: &mut S) -> Result<Vec<String>, S::Error> {
        let Some(scene) = &mut self.scene else {
            return Ok(Vec::new());
        };
        scene.finish(sink)?;
        Ok(scene.problems())
    }

    /// An order to an emulated link.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(super) fn condition<S: Sink>(
        &mut self,
        name: &str,
        record: &LinkConditionRecord,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        let host = self.conditions.host_of(name);
        let at_ns = host.and_then(|host| self.clocks.time_ns(host, record.from_ns));
        let Some(at_ns) = at_ns else {
            self.counts.timeless_count += 1;
            return Ok(());
        };
        self.conditions.write(name, (at_ns, record), sink)
    }
}
