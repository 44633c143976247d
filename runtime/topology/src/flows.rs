//! `[flows.<name>]`: flows of frames that have a name, and requests among them that are to be answered in time.

use std::time::Duration;

use hil_account::flow::{FlowFilter, NamedFlow};
use hil_core::case_study::ParameterError;
use hil_core::options;
use hil_core::options::TextRule;

use super::checks::Checks;
use super::model::{Channel, Topology};
use super::tree::join;

const FILTER: TextRule = TextRule {
    what: "a filter of frames, e.g. udp dst port 6510",
    check: |text| {
        let filter = text.parse::<FlowFilter>();
        filter.map(drop).map_err(|error| error.to_string())
    },
    pattern: None,
};

options! {
    /// Frames between programs with `inside` that are told by a name.
    #[derive(Eq)]
    pub struct Flow
    with {
        /// Its key.
        name: String = String::new(),
    }
    {
        /// Which frames, in words of pcap-filter(7): `udp`, `tcp`, `icmp`, `icmp6`, `arp`, `ip`, `ip6`, `[src|dst] host
        /// ADDRESS`, `[src|dst] port NUMBER`, all of which must hold.
        r#match: String, in FILTER, hint "it says which frames, e.g. \"udp dst port 6510\"";
        /// Each frame is a request, and what the other program sends back must have come within this time. Of
        /// datagrams in one direction: `match` has `udp`, `icmp` or `icmp6`, and `src` or `dst`.
        deadline: Option<Duration>, in Duration::from_micros(1)..=Duration::from_secs(10);
    }
    check Flow::check_deadline;
}

impl Flow {
    fn check_deadline(&self) -> Result<(), ParameterError> {
        let refuse = |problem: &str| Err(ParameterError::new("deadline", problem.to_owned()));
        let filter = self.r#match.parse::<FlowFilter>();
        let (Some(_), Ok(filter)) = (self.deadline, filter) else {
            return Ok(());
        };
        if !filter.is_of_datagrams() {
            return refuse(
                "needs `udp`, `icmp` or `icmp6` in `match`: the kernel acknowledges what TCP brings, whether or not \
                 the program answers",
            );
        }
        if !filter.is_one_way() {
            return refuse(
                "needs `src` or `dst` in `match`: else the answers would be requests as well",
            );
        }
        Ok(())
    }
}

impl Topology {
    /// The flows with names, in the order of these.
    ///
    /// # Panics
    /// Never: the filter of a checked topology is one.
    pub fn named_flows(&self) -> Vec<NamedFlow> {
        let flows = self.flows.iter().map(|flow| NamedFlow {
            name: flow.name.clone(),
            filter: flow.r#match.parse().expect("a checked filter is one"),
            deadline_ns: flow
                .deadline
                .map(|limit| i64::try_from(limit.as_nanos()).unwrap_or(i64::MAX)),
        });
        flows.collect()
    }
}

/// Flows are of frames.
pub(super) fn check(topology: &Topology, checks: &Checks<'_>) {
    let has_frames = topology.channels.iter().any(Channel::carries_frames);
    for flow in topology.flows.iter().filter(|_| !has_frames) {
        let why = "needs processes with `inside`: other channels carry messages, not frames";
        checks.refuse_because(join("flows", &flow.name), why);
    }
}
