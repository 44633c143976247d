//! What a reader must be warned of an arm that went through an adapter: nobody answered, or what came
//! was refused, with what to do where that is known. The counting was done in the adapter.

use hil_arm::egm::wire::Cause;

use super::adapter::AdapterSummary;
use hil_platform::words::counted;
use hil_rundir::pipe::{AdapterRefusal, RefusalCount};
use hil_topology::AdapterKind;

/// The warnings of one arm, most important first.
pub(super) fn adapter_warnings(adapter: &AdapterSummary) -> Vec<String> {
    let at = format!("{}, {} arm", adapter.process, adapter.arm.word());
    if adapter.is_unanswered() {
        return vec![format!(
            "{at}: no foreign program answered at {}: {}",
            adapter.address, adapter.peer_state
        )];
    }
    let refused = adapter.refusals.iter();
    let refused = refused.map(|refusal| refusal_warning(&at, refusal, adapter));
    let mut warnings: Vec<String> = refused.collect();
    if !adapter.has_usable_messages() {
        warnings.insert(
            0,
            format!("{at}: all that the foreign program sent was refused"),
        );
    }
    warnings
}

fn refusal_warning(at: &str, refusal: &RefusalCount, adapter: &AdapterSummary) -> String {
    let count = counted(refusal.count, "datagram");
    let advice = advice(refusal.cause, adapter);
    let advice = advice.map_or_else(String::new, |advice| format!("; {advice}"));
    format!("{at}: {count} refused: {}{advice}", refusal.cause.label())
}

/// What to do about a cause; `None` where only its sender can know.
fn advice(cause: AdapterRefusal, adapter: &AdapterSummary) -> Option<String> {
    let AdapterRefusal::Protocol(cause) = cause else {
        return None;
    };
    let advice = match cause {
        // Our controller moves seven joints: a sensor adapter takes no `axes = 6`.
        Cause::WrongArity if adapter.kind == AdapterKind::Sensor => {
            "the robot must send six joints and J7 as its first external axis, as a YuMi does"
        }
        Cause::WrongArity => {
            let process = &adapter.process;
            return Some(format!(
                "set processes.{process}.egm.axes to 6 if the client has no external axis, to 7 \
                 if it has one"
            ));
        }
        Cause::OutsideLimits => {
            "positions are degrees, in the order J1 to J6 and then J7, within the arm's limits"
        }
        Cause::NotFinite => "the sender computes a NaN or an infinite value",
        Cause::TooFast => "speeds are degrees per second",
        Cause::MissingJoints => "joints must be sent; a pose or a speed alone is not taken",
        Cause::MissingHeader | Cause::WrongMessageType => {
            "each message needs a header with its sequence number, time and type"
        }
        Cause::NotProtobuf | Cause::TooLong => "something that does not speak EGM sends there",
        Cause::Overtaken => "the network reordered them",
        Cause::Repeated => "the network duplicated them",
        Cause::NoSession => return None,
    };
    Some(advice.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adapter::Answers;
    use hil_arm::egm::messages::Side;

    fn adapter(kind: AdapterKind, answers: Answers, refusals: &[(Cause, u64)]) -> AdapterSummary {
        let refusals = refusals.iter().map(|(cause, count)| RefusalCount {
            cause: AdapterRefusal::Protocol(*cause),
            count: *count,
        });
        AdapterSummary {
            process: "client".to_owned(),
            host: "local".to_owned(),
            kind,
            arm: Side::Right,
            address: "127.0.0.1:6510".to_owned(),
            peer_state: "never answered".to_owned(),
            cycle_ns: None,
            answers,
            segments: Vec::new(),
            refusals: refusals.collect(),
            counters: Vec::new(),
            facts: Vec::new(),
        }
    }

    fn answers(robot_message_count: u64, attended_count: u64) -> Answers {
        Answers {
            robot_message_count,
            attended_count,
            answered_count: attended_count,
        }
    }

    #[test]
    fn an_arm_that_nobody_answered_is_named_with_its_address() {
        for (kind, answers) in [
            (AdapterKind::Robot, answers(1_000, 0)),
            (AdapterKind::Sensor, answers(0, 0)),
        ] {
            let adapter = adapter(kind, answers, &[]);
            assert!(adapter.is_unanswered());
            let expected = "client, right arm: no foreign program answered at 127.0.0.1:6510: \
                            never answered";
            assert_eq!(adapter_warnings(&adapter), [expected]);
        }
        for (kind, answers) in [
            (AdapterKind::Robot, answers(1_000, 900)),
            (AdapterKind::Sensor, answers(1_000, 0)),
        ] {
            assert!(adapter_warnings(&adapter(kind, answers, &[])).is_empty());
        }
    }

    #[test]
    fn each_cause_is_told_with_its_count_and_what_to_do() {
        let causes = [(Cause::WrongArity, 1_200), (Cause::NoSession, 1)];
        let refused = adapter(AdapterKind::Robot, answers(1_000, 0), &causes);
        assert!(!refused.is_unanswered());
        assert_eq!(
            adapter_warnings(&refused),
            [
                "client, right arm: all that the foreign program sent was refused",
                "client, right arm: 1,200 datagrams refused: wrong number of joints; set \
                 processes.client.egm.axes to 6 if the client has no external axis, to 7 if it \
                 has one",
                "client, right arm: 1 datagram refused: no session",
            ]
        );
        let of_robot = adapter(AdapterKind::Sensor, answers(0, 0), &causes[..1]);
        let warning = adapter_warnings(&of_robot).pop().unwrap();
        assert!(
            warning.contains("first external axis") && !warning.contains("axes to 6"),
            "{warning}"
        );
    }
}
