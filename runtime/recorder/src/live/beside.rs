//! What stands beside the channels in a recording of a run that goes: its scene, and what was done to
//! its links.

use hil_models::link::condition::LinkConditionRecord;

use super::LiveTopics;
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

    /// Nothing more will come: draws the rest of the scene; why it lacks something, if it does.
    ///
    /// # Errors
    /// When the sink cannot take it.
    pub(crate) fn finish_scene<S: Sink>(&mut self, sink: &mut S) -> Result<Option<&str>, S::Error> {
        let Some(scene) = &mut self.scene else {
            return Ok(None);
        };
        scene.finish(sink)?;
        Ok(scene.problem())
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
