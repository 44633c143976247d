//! The role "human": plays the motion at the capture's rate. It stands where a capture suit
//! stands in the real system.

use core::time::Duration;

use crate::HUMAN_FRAME;
use crate::messages::HumanFrame;
use crate::motion::Player;
use hil_core::component::{Component, Role};
use hil_core::time::{Instant, Tick, duration_ns};

/// The role.
#[derive(Debug)]
pub(crate) struct Human {
    player: Player,
    frame_period: Duration,
}

impl Human {
    pub(crate) fn new(player: Player, frame_period: Duration) -> Self {
        Self {
            player,
            frame_period,
        }
    }

    pub(crate) fn into_role(self) -> Box<dyn Role> {
        let period = self.frame_period;
        let component = Component::of(self);
        component
            .publish(HUMAN_FRAME, period, Self::frame)
            .into_role()
    }

    fn frame(&mut self, _now: Instant, tick: Tick) -> HumanFrame {
        // The capture samples on its grid even when this process was late.
        let index = i64::try_from(tick.index).unwrap_or(i64::MAX);
        let source_time_ns = index.saturating_mul(duration_ns(self.frame_period));
        let pose = self.player.at(source_time_ns as f64 * 1e-9);
        HumanFrame {
            frame_index: tick.index,
            source_time_ns,
            root: pose.root.into(),
            right_hand: pose.right_hand.into(),
            left_hand: pose.left_hand.into(),
        }
    }
}
