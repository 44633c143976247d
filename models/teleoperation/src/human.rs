//! The role "human": plays the motion at the capture's rate. It stands where a capture suit
//! stands in the real system.

use crate::messages::HumanFrame;
use crate::motion::Player;
use hil_core::component::{Component, Outbox};
use hil_core::message::MessageSet;
use hil_core::time::{Instant, PeriodicTimer, duration_ns};

/// Input of a role that hears nothing.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Nothing {}

impl MessageSet for Nothing {
    const PORTS: &'static [hil_core::message::MessageType] = &[];

    fn from_bytes(_port: usize, _bytes: &[u8]) -> Option<Self> {
        None
    }

    fn port(&self) -> usize {
        match *self {}
    }

    fn as_bytes(&self) -> &[u8] {
        match *self {}
    }
}

/// The role.
#[derive(Debug)]
pub(crate) struct Human {
    player: Player,
    timer: PeriodicTimer,
    frame_period_ns: i64,
}

impl Human {
    pub(crate) fn new(player: Player, frame_period: core::time::Duration) -> Self {
        Self {
            player,
            timer: PeriodicTimer::new(frame_period),
            frame_period_ns: duration_ns(frame_period),
        }
    }
}

impl Component for Human {
    type Input = Nothing;
    type Output = HumanFrame;

    fn on_start(&mut self, now: Instant) {
        self.timer.start(now);
    }

    fn on_message(&mut self, _now: Instant, input: &Nothing, _out: &mut Outbox<HumanFrame>) {
        match *input {}
    }

    fn on_tick(&mut self, now: Instant, out: &mut Outbox<HumanFrame>) {
        let Some(tick) = self.timer.poll(now) else {
            return;
        };
        // The capture samples on its grid even when this process was late.
        let index = i64::try_from(tick.index).unwrap_or(i64::MAX);
        let source_time_ns = index.saturating_mul(self.frame_period_ns);
        let pose = self.player.at(source_time_ns as f64 * 1e-9);
        out.send(HumanFrame {
            frame_index: tick.index,
            source_time_ns,
            root: pose.root.into(),
            right_hand: pose.right_hand.into(),
            left_hand: pose.left_hand.into(),
        });
    }

    fn next_tick(&self) -> Option<Instant> {
        self.timer.next()
    }

    fn skipped_ticks(&self) -> u64 {
        self.timer.skipped_total()
    }
}
