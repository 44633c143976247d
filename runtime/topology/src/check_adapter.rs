//! What an adapter says about the case: which side of the protocol it is, whether the case has the
//! channels for it, which roles nobody needs to play beside it, and whose addresses collide.

use hil_arm::egm::messages::{EgmCommand, EgmFeedback, Side};
use hil_core::case_study::ChannelSpec;
use hil_core::message::Message;

use super::adapter::{AdapterKind, EgmAdapter, ROBOT_SENDS};
use super::checks::Checks;
use super::errors::Fault;
use super::known::KnownCase;
use super::model::{Case, Process, Program};
use super::tree::join;

/// The channel with the commands to one arm, by its name in every case.
pub const fn command_channel(side: Side) -> &'static str {
    match side {
        Side::Right => "egm/right/command",
        Side::Left => "egm/left/command",
    }
}

/// The channel with the feedback of one arm, by its name in every case.
pub const fn feedback_channel(side: Side) -> &'static str {
    match side {
        Side::Right => "egm/right/feedback",
        Side::Left => "egm/left/feedback",
    }
}

/// The adapter of a process that plays `role` of `case`.
pub(super) fn check_adapter(
    mut adapter: EgmAdapter,
    path: &str,
    role: &str,
    case: &KnownCase,
    checks: &Checks<'_>,
) -> Option<EgmAdapter> {
    let Some(kind) = kind_of(role, case) else {
        let roles = case
            .roles
            .iter()
            .filter(|role| kind_of(role, case).is_some());
        let roles: Vec<_> = roles.map(|role| format!("`{role}`")).collect();
        let allowed = if roles.is_empty() {
            format!("case `{}` has none that does", case.name)
        } else {
            format!("only {} does", roles.join(" or "))
        };
        let fault = format!("needs a role that speaks EGM, which `{role}` does not: {allowed}");
        checks.refuse_because(path, fault);
        return None;
    };
    adapter.kind = kind;
    if kind == AdapterKind::Robot {
        checks.refuse_present(path, ["send", "send_hz"], ROBOT_SENDS);
    }
    if kind == AdapterKind::Sensor && adapter.axes == 6 {
        let fault = "is 6, but our controller moves seven joints: a robot of six axes would not \
                     follow J7 and does not measure it; allowed in a sensor adapter: 7";
        checks.refuse_because(join(path, "axes"), fault);
    }
    if kind == AdapterKind::Robot
        && let Some((side, address)) = adapter
            .addresses()
            .find(|(_, address)| address.ip().is_unspecified())
    {
        let fault = format!(
            "\"{address}\" is no address to send to; write that of the host with the foreign \
             program"
        );
        checks.refuse_because(join(path, side.word()), fault);
    }
    for (side, _) in adapter.addresses() {
        for (name, message) in wire(side) {
            if !case.channels.iter().any(|spec| is(spec, name, message)) {
                let fault = format!("case `{}` has no channel {name} of {message}", case.name);
                checks.refuse_because(join(path, side.word()), fault);
            }
        }
    }
    Some(adapter)
}

/// Both channels of an arm with the messages they must carry.
fn wire(side: Side) -> [(&'static str, &'static str); 2] {
    [
        (command_channel(side), EgmCommand::NAME),
        (feedback_channel(side), EgmFeedback::NAME),
    ]
}

fn is(spec: &ChannelSpec, name: &str, message: &str) -> bool {
    spec.name == name && spec.message.name == message
}

/// Who commands an arm is the sensor, so its stand-in needs a robot's adapter, and the other way
/// round.
fn kind_of(role: &str, case: &KnownCase) -> Option<AdapterKind> {
    let publishes = |message: &str| {
        let mut channels = case.channels.iter();
        channels.any(|spec| {
            let named = Side::BOTH.into_iter().flat_map(wire);
            spec.from == role
                && named
                    .filter(|(_, kind)| *kind == message)
                    .any(|(name, kind)| is(spec, name, kind))
        })
    };
    if publishes(EgmCommand::NAME) {
        Some(AdapterKind::Robot)
    } else {
        publishes(EgmFeedback::NAME).then_some(AdapterKind::Sensor)
    }
}

/// True when nobody misses `role`: it hears nothing, and all it says goes to roles that foreign
/// programs play.
pub(super) fn is_dispensable(role: &str, case: &KnownCase, processes: &[Process]) -> bool {
    let is_adapter = |role: &str| {
        processes
            .iter()
            .any(|process| process.role() == Some(role) && is_played_by_adapter(process))
    };
    let hears = case.channels.iter().any(|spec| spec.to == Some(role));
    let mut says = case.channels.iter().filter(|spec| spec.from == role);
    !hears && says.all(|spec| spec.to.is_some_and(is_adapter))
}

/// True when a foreign program plays the role of `process`.
pub(super) fn is_played_by_adapter(process: &Process) -> bool {
    matches!(process.program, Program::Egm { .. })
}

/// Checks the adapters of all processes against each other and against the case's parameters.
pub(super) fn check_adapters(processes: &[Process], case: Option<&Case>, checks: &Checks<'_>) {
    let mut taken = Vec::new();
    for process in processes {
        let Program::Egm { adapter, .. } = &process.program else {
            continue;
        };
        let path = join(&join("processes", &process.name), "egm");
        for (side, address) in adapter.addresses() {
            if let Some((other, _)) = taken.iter().find(|(_, known)| *known == address) {
                let fault = format!("\"{address}\" is an address of process `{other}` already");
                checks.refuse_because(join(&path, side.word()), fault);
            }
            if adapter.kind == AdapterKind::Sensor {
                taken.push((process.name.clone(), address));
            }
        }
        if adapter.kind == AdapterKind::Robot {
            check_sessions(&path, case, checks);
        }
    }
}

/// The maker's protocol has no word for starting a session, so nobody could ask for the first one,
/// nor for another after a session ended.
fn check_sessions(path: &str, case: Option<&Case>, checks: &Checks<'_>) {
    let Some(case) = case else { return };
    let value = |key| case.parameters.get("egm")?.get(key)?.as_str();
    let why = "but a foreign program cannot request a session (EGM has no word for it)";
    let refuse = |key: &str, value: &str, allowed: &str| {
        let parameter = join("case.parameters.egm", key);
        let is_written = checks.has(&parameter);
        let by_default = if is_written { "" } else { " by default" };
        let fault =
            format!("is \"{value}\"{by_default}, {why}; allowed beside a robot adapter: {allowed}");
        let place = if is_written { parameter.as_str() } else { path };
        checks.refuse_at(parameter.clone(), place, Fault::Inconsistent(fault));
    };
    let start = value("start").unwrap_or("request");
    if start != "power-on" {
        refuse("start", start, "\"power-on\"");
    }
    if value("restart") == Some("external_trigger") {
        let allowed = "\"auto_retry\", \"wait_then_restart\", \"go_home_first\"";
        refuse("restart", "external_trigger", allowed);
    }
}
