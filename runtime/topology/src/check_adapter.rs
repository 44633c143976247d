//! What an adapter says about the case: which side of the protocol it is, whether the case has the
//! channels for it, which roles nobody needs to play beside it, and whose addresses collide.

use hil_arm::egm::messages::{EgmCommand, EgmFeedback, Side};
use hil_core::case_study::ChannelSpec;
use hil_core::message::Message;

use super::adapter::{AdapterEntry, AdapterKind, EgmAdapter};
use super::errors::{Fault, Faults};
use super::file::ProcessEntry;
use super::known::KnownCase;
use super::model::{Case, Process, Program};
use super::tree::{Table, Value, join};

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
    entry: &AdapterEntry,
    role: &str,
    case: &KnownCase,
    faults: &Faults,
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
        faults.add(
            entry.path.clone(),
            Some(entry.place),
            Fault::Inconsistent(fault),
        );
        return None;
    };
    if kind == AdapterKind::Robot && entry.says_when_to_send {
        let fault = "does not apply to a robot adapter, which sends with every cycle of the robot";
        let key = join(&entry.path, "send");
        faults.add(
            key,
            Some(entry.place),
            Fault::Inconsistent(fault.to_owned()),
        );
    }
    if kind == AdapterKind::Sensor && entry.axes == 6 {
        let fault = "is 6, but our controller moves seven joints: a robot of six axes would not \
                     follow J7 and does not measure it; allowed in a sensor adapter: 7";
        let key = join(&entry.path, "axes");
        faults.add(
            key,
            Some(entry.place),
            Fault::Inconsistent(fault.to_owned()),
        );
    }
    if kind == AdapterKind::Robot
        && let Some((side, address)) = entry
            .addresses()
            .find(|(_, address)| address.ip().is_unspecified())
    {
        let fault = format!(
            "\"{address}\" is no address to send to; write that of the host with the foreign \
             program"
        );
        let key = join(&entry.path, side.word());
        faults.add(key, Some(entry.place), Fault::Inconsistent(fault));
    }
    for (side, _) in entry.addresses() {
        for (name, message) in wire(side) {
            if !case.channels.iter().any(|spec| is(spec, name, message)) {
                let fault = format!("case `{}` has no channel {name} of {message}", case.name);
                let key = join(&entry.path, side.word());
                faults.add(key, Some(entry.place), Fault::Inconsistent(fault));
            }
        }
    }
    Some(entry.adapter(kind))
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

/// Checks the adapters of all processes against each other and against the case's parameters: all of
/// them, and those that the file writes, with their places.
pub(super) fn check_adapters(
    entries: &[ProcessEntry],
    processes: &[Process],
    case: Option<&Case>,
    written: Option<&Table>,
    faults: &Faults,
) {
    let mut taken = Vec::new();
    for (entry, process) in entries.iter().zip(processes) {
        let (Some(table), Program::Egm { adapter, .. }) = (&entry.egm, &process.program) else {
            continue;
        };
        for (side, address) in table.addresses() {
            if let Some((other, _)) = taken.iter().find(|(_, known)| *known == address) {
                let fault = format!("\"{address}\" is an address of process `{other}` already");
                let key = join(&table.path, side.word());
                faults.add(key, Some(table.place), Fault::Inconsistent(fault));
            }
            if adapter.kind == AdapterKind::Sensor {
                taken.push((process.name.clone(), address));
            }
        }
        if adapter.kind == AdapterKind::Robot {
            check_sessions(table, case, written, faults);
        }
    }
}

/// The maker's protocol has no word for starting a session, so nobody could ask for the first one,
/// nor for another after a session ended.
fn check_sessions(
    entry: &AdapterEntry,
    case: Option<&Case>,
    written: Option<&Table>,
    faults: &Faults,
) {
    let Some(case) = case else { return };
    let value = |key| case.parameters.get("egm")?.get(key)?.as_str();
    let why = "but a foreign program cannot request a session (EGM has no word for it)";
    let refuse = |key: &str, value: &str, allowed: &str| {
        let node = written.and_then(|table| match &table.get("egm")?.value {
            Value::Table(egm) => egm.get(key),
            _ => None,
        });
        let place = node.map_or(entry.place, |node| node.place);
        let by_default = if node.is_none() { " by default" } else { "" };
        let fault =
            format!("is \"{value}\"{by_default}, {why}; allowed beside a robot adapter: {allowed}");
        let key = join("case.parameters.egm", key);
        faults.add(key, Some(place), Fault::Inconsistent(fault));
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
