//! The counters of one way of a link, and of each of its channels, under the names a report prints. It
//! counts nothing itself.

use hil_protocol::PeerState;
use hil_protocol::seal::SealCounts;
use hil_transport::{LinkCounts, ReceiverCounters};

use super::egress::Egress;
use super::ingress::Ingress;
use hil_platform::clock::MonotonicClock;
use hil_rundir::pipe::{CountByName, CounterGroup};

/// A peer that was silent for longer when the run ended is reported as such.
const SILENCE_NS: i64 = 1_000_000_000;

/// How the receiving gateway stood to this one, in words.
pub(super) fn egress_state(egress: &Egress) -> String {
    match egress.bridge.peer_state() {
        PeerState::Greeting => "never answered".to_owned(),
        // No message tells whether it mattered: how long it lasted does.
        PeerState::Down if egress.inputs.is_empty() => match silence_ns(egress) {
            Some(silence_ns) => {
                format!("unreachable for the last {:.3} s", silence_ns as f64 * 1e-9)
            }
            None => "unreachable".to_owned(),
        },
        // Gateways of two hosts stop one after the other: the later one may still have asked the
        // earlier one for the time, with no message concerned.
        PeerState::Down if !has_lost_messages(egress) => "left after the last message".to_owned(),
        PeerState::Down => "unreachable".to_owned(),
        PeerState::Refused(status) => format!("refused the link: {}", status.label()),
        PeerState::Established => {
            match silence_ns(egress).filter(|silence_ns| *silence_ns > SILENCE_NS) {
                Some(silence_ns) => format!("silent for {:.1} s", silence_ns as f64 * 1e-9),
                None => "established".to_owned(),
            }
        }
    }
}

/// How long ago the peer was heard last; `None` when it never was.
fn silence_ns(egress: &Egress) -> Option<i64> {
    let heard = egress.bridge.last_heard();
    heard.map(|at| MonotonicClock::now().ns_since(at))
}

/// True when a message could not go because the peer was unreachable.
fn has_lost_messages(egress: &Egress) -> bool {
    let channels = 0..egress.sent.len();
    channels
        .map(|channel| egress.bridge.channel_counts(channel))
        .any(|counts| counts.refused_peer_down_count + counts.message_failed_count > 0)
}

/// How the sending gateway stood to this one, in words.
pub(super) fn ingress_state(ingress: &Ingress) -> String {
    match (ingress.bridge.session(), ingress.bridge.has_left()) {
        (None, _) => "never greeted".to_owned(),
        (Some(_), true) => "said farewell".to_owned(),
        (Some(_), false) => "established".to_owned(),
    }
}

/// Whether the sender's mark survived the way; `None` where nothing arrived to tell.
pub(super) fn mark_fact(dscp: u8, counters: &ReceiverCounters) -> Option<(String, String)> {
    let (kept, changed) = (counters.mark_kept_count, counters.mark_changed_count);
    let text = match (kept, changed, counters.newest_other_dscp) {
        (0, 0, _) => return None,
        (_, 0, _) => format!("dscp {dscp} on all {kept} datagrams that arrived"),
        (_, _, other) => {
            let other = other.map_or_else(String::new, |dscp| format!(" (the newest {dscp})"));
            let total = kept + changed;
            format!("{changed} of {total} datagrams arrived with another dscp than {dscp}{other}")
        }
    };
    Some(("mark".to_owned(), text))
}

/// Everything a sending direction counted that is of no one channel.
pub(super) fn of_egress(egress: &Egress) -> Vec<CountByName> {
    let steps = ("clock_step_count", egress.line.clock.step_count());
    CountByName::all(CounterGroup::Own, egress.bridge.counts().iter())
        .chain(CountByName::all(
            CounterGroup::Socket,
            egress.line.sender().counters().iter(),
        ))
        .chain(CountByName::all(CounterGroup::Own, [steps]))
        .chain(CountByName::all(
            CounterGroup::Refused,
            egress.bridge.refusals().iter(),
        ))
        .collect()
}

/// Everything a sending direction counted of one channel.
pub(super) fn of_sent(egress: &Egress, channel: usize) -> Vec<CountByName> {
    let counts = egress.bridge.channel_counts(channel);
    CountByName::all(CounterGroup::Own, counts.iter()).collect()
}

/// Everything a receiving direction counted of one channel, whose number in datagrams is `number`.
pub(super) fn of_received(ingress: &Ingress, channel: usize, number: u16) -> Vec<CountByName> {
    let bridge = &ingress.bridge;
    let pieces = bridge.reassembly_counts(channel);
    let link = ingress.receiver.link_counts(number);
    CountByName::all(CounterGroup::Own, bridge.channel_counts(channel).iter())
        .chain(CountByName::all(
            CounterGroup::Messages,
            bridge.sequence_counts(channel).iter(),
        ))
        .chain(CountByName::all(CounterGroup::Pieces, pieces.iter()))
        .chain(CountByName::all(
            CounterGroup::Socket,
            link.iter().flat_map(LinkCounts::iter),
        ))
        .collect()
}

/// Everything a receiving direction counted that is of no one channel.
pub(super) fn of_ingress(ingress: &Ingress) -> Vec<CountByName> {
    let bridge = &ingress.bridge;
    let socket = ingress.receiver.counters();
    let steps = ("clock_step_count", ingress.clock.step_count());
    let foreign = ("foreign source", ingress.foreign_count);
    CountByName::all(CounterGroup::Own, bridge.counts().iter())
        .chain(CountByName::all(
            CounterGroup::Replies,
            bridge.reply_counts().iter(),
        ))
        .chain(CountByName::all(CounterGroup::Socket, socket.iter()))
        .chain(CountByName::all(CounterGroup::Own, [steps]))
        .chain(CountByName::all(CounterGroup::Refused, [foreign]))
        .chain(CountByName::all(
            CounterGroup::Refused,
            bridge.refusals().iter(),
        ))
        .collect()
}

/// What the seal of a direction counted.
pub(super) fn of_seal(counts: &SealCounts) -> Vec<CountByName> {
    CountByName::all(CounterGroup::Seal, counts.iter())
        .chain(CountByName::all(
            CounterGroup::Refused,
            counts.refused.iter(),
        ))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mark_is_kept_changed_or_unknown() {
        let mut counters = ReceiverCounters::default();
        assert_eq!(mark_fact(46, &counters), None);
        counters.mark_kept_count = 9;
        let words = |counters: &ReceiverCounters| mark_fact(46, counters).unwrap().1;
        assert_eq!(words(&counters), "dscp 46 on all 9 datagrams that arrived");
        counters.mark_changed_count = 1;
        counters.newest_other_dscp = Some(0);
        let expected = "1 of 10 datagrams arrived with another dscp than 46 (the newest 0)";
        assert_eq!(words(&counters), expected);
    }
}
