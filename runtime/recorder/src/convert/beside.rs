//! What stands beside the channels in a recording of a finished run: its scene, and what was done to
//! its links.

use super::{Conversion, is_order_file};
use crate::conditions::Conditions;
use crate::run::Run;
use crate::scene::Scene;
use crate::writer::WriteError;

impl Conversion {
    /// Declares the topics of links that were given orders.
    pub(super) fn begin_conditions(&mut self, run: &Run) -> Result<(), WriteError> {
        self.conditions = Conditions::of(run.topology(), &mut self.names);
        let mut last = "";
        for file in run.files.iter().filter(|file| is_order_file(file)) {
            // By name, so that those of one direction follow each other.
            if last != file.header.channel {
                last = &file.header.channel;
                self.topic_count += self.conditions.declare(last, &mut self.recording)?;
            }
        }
        Ok(())
    }

    /// Begins the scene, and declares its topics.
    pub(super) fn begin_scene(&mut self, run: &Run) -> Result<(), WriteError> {
        let case = &run.topology()["case"];
        let mut scene = Scene::new(case["name"].as_str(), &case["parameters"], &mut self.names);
        let recorded = self.channels.iter().filter(|channel| channel.own.is_some());
        let messages = recorded.filter_map(|channel| channel.message.as_deref());
        self.topic_count += scene.declare(messages, &mut self.recording)?;
        self.scene = Some(scene);
        Ok(())
    }

    /// False while something is being made that the pictures need.
    pub(super) fn is_ready(&mut self) -> bool {
        self.scene.as_mut().is_none_or(Scene::is_ready)
    }

    /// Draws the last of the scene, and says why it lacks its ground, if it does.
    pub(super) fn finish_scene(&mut self, run: &mut Run) -> Result<(), WriteError> {
        let Some(scene) = &mut self.scene else {
            return Ok(());
        };
        scene.finish(&mut self.recording)?;
        run.gaps.words.extend(scene.problem().map(str::to_owned));
        Ok(())
    }
}
