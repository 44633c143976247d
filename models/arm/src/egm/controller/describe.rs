//! Events in words, for logs: which arm, which session, and the setting at work by the maker's
//! name for it.

use core::fmt;

use crate::egm::messages::{CommandRefusal, EgmEvent, EgmEventKind, EndCause, MotionKind, Side};
use crate::yumi::CHAIN_TO_MAKER;

impl EgmEvent {
    /// What happened, in one line; joints in the maker's numbering, angles in degrees.
    pub fn describe(&self) -> String {
        let arm = Side::from_index(self.side).map_or("unknown", Side::word);
        let Some(kind) = EgmEventKind::from_number(self.kind) else {
            return format!("{arm} arm: event of unknown kind {}", self.kind);
        };
        let what = self.what(kind);
        match kind {
            EgmEventKind::Started | EgmEventKind::MotionBegan | EgmEventKind::MotionEnded => {
                format!("{arm} arm: {what}")
            }
            _ if self.session == 0 => format!("{arm} arm: {what}"),
            EgmEventKind::Ended => format!("{arm} arm: EGM session {} ended: {what}", self.session),
            _ => format!("{arm} arm: EGM session {}: {what}", self.session),
        }
    }

    fn what(&self, kind: EgmEventKind) -> String {
        let (value, limit) = (Number(self.value), Number(self.limit));
        match kind {
            EgmEventKind::Started => "robot started".to_owned(),
            EgmEventKind::Activating => format!("guided motion is being set up for {value} s"),
            EgmEventKind::Running if self.session > 1 => {
                format!("guided motion runs, {value} s after the last session ended")
            }
            EgmEventKind::Running => format!("guided motion runs, {value} s after the start"),
            EgmEventKind::Ended => self.end(),
            EgmEventKind::SpeedThrottled => format!(
                "all joints are slowed: {value} deg/s asked (MaxSpeedDeviation = {limit} deg/s)"
            ),
            EgmEventKind::SpeedFree => format!(
                "joints are slowed no more, after {} s with up to {value} deg/s asked \
                 (MaxSpeedDeviation = {limit} deg/s)",
                Number(self.count as f64 * 1e-9)
            ),
            EgmEventKind::HoldBegan => {
                format!("no command for {value} s: the last one goes on acting")
            }
            EgmEventKind::HoldEnded => format!("commands are back after {value} s without"),
            EgmEventKind::CommandRefused => self.refusal(),
            EgmEventKind::QueueOverflow => format!(
                "the queue is full ({limit} commands): {} dropped so far",
                self.count
            ),
            EgmEventKind::MotionBegan => format!("{} began", self.motion()),
            EgmEventKind::MotionEnded => format!("{} ended after {value} s", self.motion()),
        }
    }

    fn end(&self) -> String {
        let (value, limit) = (Number(self.value), Number(self.limit));
        match EndCause::from_number(self.cause) {
            Some(EndCause::CommTimeout) => {
                format!("no message for {value} s (CommTimeout = {limit} s)")
            }
            Some(EndCause::ConditionTime) => format!(
                "every joint stayed within the convergence window of its order for {value} s \
                 (CondTime = {limit} s)"
            ),
            Some(EndCause::PositionDeviation) => format!(
                "joint {} is {value} deg from where the session started \
                 (MaxPosDeviation = {limit} deg)",
                self.joint()
            ),
            Some(EndCause::Requested) => format!("stopped by request, within {value} s"),
            None => format!("unknown cause {}", self.cause),
        }
    }

    fn refusal(&self) -> String {
        match CommandRefusal::from_number(self.cause) {
            Some(CommandRefusal::NotFinite) => format!(
                "command refused: joint {} of it is {}, no finite number",
                self.joint(),
                self.value
            ),
            Some(CommandRefusal::OutsideLimits) => format!(
                "command refused: {} deg for joint {} is beyond its limit of {} deg",
                Number(self.value.to_degrees()),
                self.joint(),
                Number(self.limit.to_degrees())
            ),
            Some(CommandRefusal::NoSession) => {
                "command refused: guided motion does not run".to_owned()
            }
            None => format!("command refused: unknown cause {}", self.cause),
        }
    }

    /// The maker's number of the joint at fault.
    fn joint(&self) -> String {
        let chain = usize::try_from(self.count).ok();
        chain
            .and_then(|chain| CHAIN_TO_MAKER.get(chain))
            .map_or_else(|| "?".to_owned(), ToString::to_string)
    }

    fn motion(&self) -> &'static str {
        MotionKind::from_number(self.cause).map_or("unknown motion", MotionKind::word)
    }
}

/// A number with at most three decimals and no idle zeros.
struct Number(f64);

impl fmt::Display for Number {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = format!("{:.3}", self.0);
        let short = if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.')
        } else {
            &text
        };
        formatter.write_str(if short == "-0" { "0" } else { short })
    }
}
