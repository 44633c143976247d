//! Emulated links that someone changed while the run went on: when, to what, or why not. What the run
//! measured after a change is a result about the changed link.

use hil_link::condition::{LinkCondition, LinkConditionRecord, OrderOutcome};
use hil_link::spec::Way;
use serde::{Deserialize, Serialize};

use hil_present::units::{JOINT, duration_s, percent, seconds};

/// One order to one direction of a link.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkChange {
    /// Name of the link.
    pub link: String,
    /// Which way.
    pub way: Way,
    /// The gateway's count of orders to this direction, from 1.
    pub number: u64,
    /// Messages received from here on met the condition, seconds after the start of the run; `None`
    /// when that start is unknown on the host.
    pub at_s: Option<f64>,
    /// For so long after `at_s` messages may have met either condition, seconds; 0 as a rule.
    pub unsure_s: f64,
    /// What was asked for.
    pub to: ChangedTo,
    /// Why it did not take effect; `None` where it did.
    pub refused: Option<String>,
}

/// What a direction was changed to.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum ChangedTo {
    /// What the topology says.
    Topology,
    /// A fixed delay and independent losses.
    Fixed {
        /// Delay, seconds.
        delay_s: f64,
        /// Share lost, 0..=1.
        loss_ratio: f64,
    },
    /// Nothing gets through.
    Cut,
    /// The record is of another version, or its loss is no number.
    Unknown,
}

impl LinkChange {
    /// From what the gateway wrote; `at_s` is its instant on the axis of the run.
    pub fn of(link: &str, way: Way, record: &LinkConditionRecord, at_s: Option<f64>) -> Self {
        let to = match record.condition() {
            Some(LinkCondition::Topology) => ChangedTo::Topology,
            Some(LinkCondition::Fixed { delay, loss_ratio }) if loss_ratio.is_finite() => {
                ChangedTo::Fixed {
                    delay_s: delay.as_secs_f64(),
                    loss_ratio,
                }
            }
            Some(LinkCondition::Cut) => ChangedTo::Cut,
            // JSON has no word for a ratio that is no number; the gateway refused it.
            Some(LinkCondition::Fixed { .. }) | None => ChangedTo::Unknown,
        };
        let refused = match record.outcome() {
            Some(OrderOutcome::InForce) => None,
            Some(other) => Some(other.words().to_owned()),
            None => Some("the gateway's word for it is of another version".to_owned()),
        };
        let unsure_ns = record.certain_ns.saturating_sub(record.from_ns);
        Self {
            link: link.to_owned(),
            way,
            number: record.number,
            at_s,
            unsure_s: unsure_ns as f64 * 1e-9,
            to,
            refused,
        }
    }

    /// True when it took effect.
    pub const fn is_in_force(&self) -> bool {
        self.refused.is_none()
    }

    /// What happened, without the time.
    pub fn what(&self) -> String {
        let (link, way) = (&self.link, self.way.word());
        let to = match self.to {
            ChangedTo::Topology => "as the topology says again".to_owned(),
            ChangedTo::Fixed {
                delay_s,
                loss_ratio,
            } => format!(
                "delay {}, loss {}",
                duration_s(delay_s),
                percent(loss_ratio)
            ),
            ChangedTo::Cut => "cut".to_owned(),
            ChangedTo::Unknown => "an unknown condition".to_owned(),
        };
        let mut text = match &self.refused {
            None => format!("link {link}.{way} changed by hand: {to}"),
            Some(why) => format!("link {link}.{way} was not changed to {to}: {why}"),
        };
        if self.unsure_s > 0.0 {
            let unsure = duration_s(self.unsure_s);
            text.push_str(&[" (sure ", &unsure, " later)"].concat());
        }
        text
    }

    /// The time, as people write it.
    pub fn time(&self) -> String {
        self.at_s.map_or_else(
            || "at an unknown time".to_owned(),
            |at_s| format!("at{JOINT}{}", seconds(at_s)),
        )
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use hil_link::condition::LinkChangeRequest;

    use super::*;

    fn record(condition: LinkCondition, outcome: OrderOutcome) -> LinkConditionRecord {
        let order = LinkChangeRequest::new(condition, 9);
        LinkConditionRecord {
            number: 2,
            request: 9,
            from_ns: 1_000,
            certain_ns: 1_000,
            delay_ns: order.delay_ns,
            loss_ratio: order.loss_ratio,
            kind: order.kind,
            outcome: outcome.number(),
        }
    }

    #[test]
    fn a_change_is_told_with_its_values_and_a_refusal_with_its_reason() {
        let fixed = LinkCondition::Fixed {
            delay: Duration::from_millis(50),
            loss_ratio: 0.1,
        };
        let of = |condition, outcome| {
            let record = record(condition, outcome);
            LinkChange::of("hop", Way::Backward, &record, Some(12.3))
        };
        let change = of(fixed, OrderOutcome::InForce);
        let plain = |text: String| text.replace(JOINT, " ");
        assert_eq!(
            plain(change.what()),
            "link hop.backward changed by hand: delay 50.0 ms, loss 10.00 %"
        );
        assert_eq!(plain(change.time()), "at 12.300 s");
        assert!(change.is_in_force());
        let refused = of(fixed, OrderOutcome::NoRoom);
        assert!(!refused.is_in_force());
        assert!(
            refused.what().contains("was not changed"),
            "{}",
            refused.what()
        );
        assert!(refused.what().ends_with("under way"));
        let text = serde_json::to_string(&change).unwrap();
        assert_eq!(serde_json::from_str::<LinkChange>(&text).unwrap(), change);
        let reset = of(LinkCondition::Topology, OrderOutcome::InForce);
        assert!(reset.what().ends_with("as the topology says again"));
        let strange = LinkCondition::Fixed {
            delay: Duration::ZERO,
            loss_ratio: f64::NAN,
        };
        let strange = of(strange, OrderOutcome::Malformed);
        assert_eq!(strange.to, ChangedTo::Unknown);
        assert!(strange.what().contains("was not changed"));
    }
}
