//! The condition of one direction of an emulated link, as it can be changed while a run goes on: the
//! order that is given, and the record of what became of it. It changes nothing itself.

use core::fmt;
use core::time::Duration;

use bytemuck::{Pod, Zeroable};

use super::spec::{LinkSpec, Way};
use hil_core::case_study::ParameterError;
use hil_core::time::duration_ns;

/// Version of the layout of [`LinkChangeRequest`].
pub const ORDER_VERSION: u32 = 1;
/// Name of the message type of the channel that orders travel on.
pub const ORDER_TYPE_NAME: &str = "hil.LinkOrder.v1";
/// Longest delay that can be asked for.
pub const DELAY_MAX: Duration = Duration::from_mins(1);

const TOPOLOGY: u32 = 0;
const FIXED: u32 = 1;
const CUT: u32 = 2;

/// What one direction of an emulated link does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LinkCondition {
    /// What the topology says.
    Topology,
    /// A fixed delay and independent losses in place of it.
    Fixed {
        /// How long each message is under way.
        delay: Duration,
        /// Share of the messages that is lost, 0..=1.
        loss_ratio: f64,
    },
    /// Nothing gets through.
    Cut,
}

impl LinkCondition {
    /// Checks the numbers against their ranges.
    ///
    /// # Errors
    /// When the delay is above [`DELAY_MAX`] or the loss ratio outside 0..=1.
    pub fn check(self) -> Result<(), ParameterError> {
        let Self::Fixed { delay, loss_ratio } = self else {
            return Ok(());
        };
        let longest_s = DELAY_MAX.as_secs_f64();
        let (delay_s, range) = (delay.as_secs_f64(), 0.0..=longest_s);
        ParameterError::check("delay", delay_s, range, "0 to 60 s")?;
        ParameterError::check("loss", loss_ratio, 0.0..=1.0, "0 to 1")
    }

    /// The link that does this in place of the topology's; `None` for the topology's own.
    pub fn spec(self) -> Option<LinkSpec> {
        match self {
            Self::Topology => None,
            Self::Fixed { delay, loss_ratio } => Some(LinkSpec::fixed(delay, loss_ratio)),
            Self::Cut => Some(LinkSpec::fixed(Duration::ZERO, 1.0)),
        }
    }

    /// Longest time that a message is under way; zero where the topology decides.
    pub const fn delay(self) -> Duration {
        match self {
            Self::Fixed { delay, .. } => delay,
            Self::Topology | Self::Cut => Duration::ZERO,
        }
    }

    fn numbers(self) -> (u32, u64, f64) {
        match self {
            Self::Topology => (TOPOLOGY, 0, 0.0),
            Self::Fixed { delay, loss_ratio } => {
                (FIXED, duration_ns(delay).unsigned_abs(), loss_ratio)
            }
            Self::Cut => (CUT, 0, 0.0),
        }
    }

    fn of(kind: u32, delay_ns: u64, loss_ratio: f64) -> Option<Self> {
        match kind {
            TOPOLOGY => Some(Self::Topology),
            FIXED => Some(Self::Fixed {
                delay: Duration::from_nanos(delay_ns),
                loss_ratio,
            }),
            CUT => Some(Self::Cut),
            _ => None,
        }
    }
}

impl fmt::Display for LinkCondition {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Topology => formatter.write_str("as the topology says"),
            Self::Fixed { delay, loss_ratio } => {
                let delay_ms = delay.as_secs_f64() * 1e3;
                write!(formatter, "delay {delay_ms} ms, loss {loss_ratio}")
            }
            Self::Cut => formatter.write_str("cut"),
        }
    }
}

/// An order to change the condition, as it lies in shared memory. Little-endian like every message.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct LinkChangeRequest {
    /// [`ORDER_VERSION`].
    pub version: u32,
    /// 0 as the topology says, 1 fixed delay and loss, 2 cut.
    pub kind: u32,
    /// Chosen by whoever gives the order: the record of the change repeats it.
    pub request: u64,
    /// Delay, nanoseconds.
    pub delay_ns: u64,
    /// Loss ratio, 0..=1.
    pub loss_ratio: f64,
}

impl LinkChangeRequest {
    /// The order to set `condition`, known by `request`.
    pub fn new(condition: LinkCondition, request: u64) -> Self {
        let (kind, delay_ns, loss_ratio) = condition.numbers();
        Self {
            version: ORDER_VERSION,
            kind,
            request,
            delay_ns,
            loss_ratio,
        }
    }

    /// What it asks for; `None` when it is of another version or kind, or a number is outside its
    /// range.
    pub fn condition(&self) -> Option<LinkCondition> {
        let condition = LinkCondition::of(self.kind, self.delay_ns, self.loss_ratio)?;
        (self.version == ORDER_VERSION && condition.check().is_ok()).then_some(condition)
    }
}

hil_core::labelled! {
    /// What became of an order.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum OrderOutcome, words {
        /// It took effect.
        InForce: 0 = "",
        /// It could not be understood, or a number was outside its range.
        Malformed: 1 = "it is of another version, or a number is outside its range",
        /// The gateway has too little room for what would be under way.
        NoRoom: 2 = "the gateway has too little room for what would be under way",
        /// Earlier changes wait for a message to meet them.
        Busy: 3 = "earlier changes still wait for a message to meet them",
    }
}

impl OrderOutcome {
    /// The number in a record.
    pub const fn number(self) -> u32 {
        self as u32
    }
}

/// An order and what became of it: written by the gateway that emulates the direction.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct LinkConditionRecord {
    /// The gateway's own count of orders, from 1.
    pub number: u64,
    /// The order's.
    pub request: u64,
    /// Messages that the gateway received from here on met the new condition, on this host's
    /// monotonic clock. Of a refused order, when it was refused.
    pub from_ns: i64,
    /// Messages that were received between `from_ns` and this may have met either condition: the
    /// thread that changes it was held up. Equal to `from_ns` as a rule.
    pub certain_ns: i64,
    /// Delay, nanoseconds.
    pub delay_ns: u64,
    /// Loss ratio, 0..=1.
    pub loss_ratio: f64,
    /// As in [`LinkChangeRequest`].
    pub kind: u32,
    /// An [`OrderOutcome`].
    pub outcome: u32,
}

impl LinkConditionRecord {
    /// What was asked for; `None` for a kind that this version does not know.
    pub fn condition(&self) -> Option<LinkCondition> {
        LinkCondition::of(self.kind, self.delay_ns, self.loss_ratio)
    }

    /// What became of it; `None` for an outcome that this version does not know.
    pub fn outcome(&self) -> Option<OrderOutcome> {
        let mut all = OrderOutcome::ALL.into_iter();
        all.find(|outcome| outcome.number() == self.outcome)
    }
}

const FLOW_PREFIX: &str = "hil/link/";

/// What one link carries one way: the name under which its gateways' clock exchanges and the orders to
/// change it are recorded, and of the channel on which those orders travel. Names that begin with `hil/`
/// are reserved.
pub fn flow_name(link: &str, way: Way) -> String {
    format!("{FLOW_PREFIX}{link}/{way}")
}

/// What a reader is shown of such a name: `hop/forward`; another name as it is.
pub fn flow_label(name: &str) -> &str {
    name.strip_prefix(FLOW_PREFIX).unwrap_or(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_order_gives_back_what_was_asked_and_a_strange_one_nothing() {
        let fixed = |delay_ms, loss_ratio| LinkCondition::Fixed {
            delay: Duration::from_millis(delay_ms),
            loss_ratio,
        };
        for condition in [LinkCondition::Topology, fixed(50, 0.1), LinkCondition::Cut] {
            let order = LinkChangeRequest::new(condition, 7);
            assert_eq!(order.condition(), Some(condition));
            let newer = LinkChangeRequest {
                version: ORDER_VERSION + 1,
                ..order
            };
            assert_eq!(newer.condition(), None);
        }
        for strange in [fixed(60_001, 0.0), fixed(1, 1.5), fixed(1, f64::NAN)] {
            assert!(strange.check().is_err(), "{strange}");
            assert_eq!(LinkChangeRequest::new(strange, 1).condition(), None);
        }
        let mut unknown = LinkChangeRequest::new(LinkCondition::Cut, 1);
        unknown.kind = 9;
        assert_eq!(unknown.condition(), None);
        assert_eq!(fixed(50, 0.1).to_string(), "delay 50 ms, loss 0.1");
        let name = flow_name("hop", Way::Backward);
        assert_eq!(name, "hil/link/hop/backward");
        assert_eq!(flow_label(&name), "hop/backward");
        assert_eq!(flow_label("clock/a-b"), "clock/a-b");
    }

    #[test]
    fn outcomes_have_numbers_of_their_own() {
        for outcome in OrderOutcome::ALL {
            let record = LinkConditionRecord {
                outcome: outcome.number(),
                ..LinkConditionRecord::zeroed()
            };
            assert_eq!(record.outcome(), Some(outcome));
            assert_eq!(outcome.words().is_empty(), outcome == OrderOutcome::InForce);
        }
    }
}
