//! An endpoint: a role joined to its ports. It is the unit that both virtual and real time drive
//! with `poll(now)` and `next_wakeup()`; which kind of port it has, it does not know.

use core::fmt::Debug;

use crate::component::{Port, Role};
use crate::message::{Envelope, MessageType, TypeInfo};
use crate::time::Instant;

/// Takes messages from a channel.
pub trait InputPort: Debug {
    /// Why a receive can fail.
    type Error;

    /// Hands the oldest waiting message to `take`; false when none waits. Never blocks.
    ///
    /// # Errors
    /// When the channel itself is broken; an empty channel is not an error.
    fn receive(
        &mut self,
        now: Instant,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<bool, Self::Error>;

    /// When the next message will be there, where that is known (virtual time).
    fn next_arrival(&self) -> Option<Instant>;
}

/// Gives messages to a channel.
pub trait OutputPort: Debug {
    /// Why a send can fail.
    type Error;

    /// Publishes `payload` with the next sequence number. Never blocks.
    ///
    /// # Errors
    /// When the channel itself is broken; having no subscriber is not an error.
    fn send(&mut self, now: Instant, payload: &[u8]) -> Result<(), Self::Error>;
}

/// Messages taken from one port before the role is ticked; the rest waits for the next poll.
const MESSAGES_PER_POLL_MAX: usize = 1024;

/// What one [`Endpoint::poll`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Activity {
    /// Messages taken.
    pub received_count: u64,
    /// Messages given.
    pub sent_count: u64,
    /// Payloads that were not a message of their port.
    pub malformed_count: u64,
    /// Times the role was ticked.
    pub tick_count: u64,
}

/// A role and its ports.
#[derive(Debug)]
pub struct Endpoint<I, O> {
    role: Box<dyn Role>,
    inputs: Vec<I>,
    outputs: Vec<O>,
}

/// A channel of a role as someone else states it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StatedChannel {
    /// Name, also of the port.
    pub name: String,
    /// What it carries.
    pub message: TypeInfo,
}

/// The channels of a role as a case or a file states them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RoleChannels {
    /// The role.
    pub role: String,
    /// Who states them: a case or a file.
    pub stated_by: String,
    /// Those it reads.
    pub inputs: Vec<StatedChannel>,
    /// Those it writes.
    pub outputs: Vec<StatedChannel>,
}

/// Which way messages pass a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PortSide {
    /// To the role.
    Input,
    /// From the role.
    Output,
}

/// A port of a role and the channel of its name do not fit each other.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", sentence(self))]
pub struct PortError {
    /// The role.
    pub role: String,
    /// Who states the channel, see [`RoleChannels::stated_by`].
    pub stated_by: String,
    /// Input or output.
    pub side: PortSide,
    /// Name of port or channel.
    pub port: String,
    /// What the role takes or gives there; `None` when it has no such port.
    pub expected: Option<Box<MessageType>>,
    /// What is stated; `None` when no such channel is.
    pub found: Option<Box<TypeInfo>>,
}

fn sentence(error: &PortError) -> String {
    let PortError {
        role,
        stated_by,
        port,
        ..
    } = error;
    let (side, verb) = match error.side {
        PortSide::Input => ("input", "takes"),
        PortSide::Output => ("output", "gives"),
    };
    match (&error.expected, &error.found) {
        (Some(expected), Some(found)) => format!(
            "{side} port {port} of role {role} {verb} {expected}, but {stated_by} states {found}"
        ),
        (Some(expected), None) => format!(
            "{side} port {port} of role {role} {verb} {expected}, but {stated_by} states no such \
             channel"
        ),
        (None, found) => {
            let found = found.as_ref().map(|found| format!(" of {found}"));
            let found = found.unwrap_or_default();
            format!(
                "{stated_by} states the {side} channel {port}{found}, but role {role} has no such \
                 port"
            )
        }
    }
}

impl RoleChannels {
    /// Whether each port of `role` has the channel of its name and type, and each channel a port.
    ///
    /// # Errors
    /// The first pair that does not fit.
    pub fn check(&self, role: &dyn Role) -> Result<(), PortError> {
        let sides = [
            (PortSide::Input, role.inputs(), &self.inputs),
            (PortSide::Output, role.outputs(), &self.outputs),
        ];
        for (side, ports, channels) in sides {
            let fault =
                |port: &str, expected: Option<MessageType>, found: Option<&TypeInfo>| PortError {
                    role: self.role.clone(),
                    stated_by: self.stated_by.clone(),
                    side,
                    port: port.to_owned(),
                    expected: expected.map(Box::new),
                    found: found.cloned().map(Box::new),
                };
            for port in ports {
                let mut channels = channels.iter();
                let channel = channels.find(|channel| channel.name == port.name);
                let found = channel.map(|channel| &channel.message);
                if found != Some(&TypeInfo::of(&port.message)) {
                    return Err(fault(port.name, Some(port.message), found));
                }
            }
            for channel in channels {
                if ports.iter().all(|port| port.name != channel.name) {
                    return Err(fault(&channel.name, None, Some(&channel.message)));
                }
            }
        }
        Ok(())
    }
}

impl<E, I: InputPort<Error = E>, O: OutputPort<Error = E>> Endpoint<I, O> {
    /// Joins the ports of `role` to `channels` by name and type, and opens each.
    ///
    /// # Errors
    /// When a port and its channel do not fit, or one cannot be opened.
    pub fn join<F: From<PortError>>(
        role: Box<dyn Role>,
        channels: &RoleChannels,
        open_input: impl FnMut(&Port) -> Result<I, F>,
        open_output: impl FnMut(&Port) -> Result<O, F>,
    ) -> Result<Self, F> {
        channels.check(role.as_ref())?;
        let inputs = role.inputs().iter().map(open_input);
        let inputs = inputs.collect::<Result<_, F>>()?;
        let outputs = role.outputs().iter().map(open_output);
        let outputs = outputs.collect::<Result<_, F>>()?;
        Ok(Self {
            role,
            inputs,
            outputs,
        })
    }

    /// Starts the role and gives what it sends at once; call once before the first poll.
    ///
    /// # Errors
    /// The first port that fails.
    pub fn start(&mut self, now: Instant) -> Result<Activity, E> {
        let mut activity = Activity::default();
        let mut failed = None;
        self.role.start(now);
        let mut emit = emitter(
            &mut self.outputs,
            now,
            &mut activity.sent_count,
            &mut failed,
        );
        self.role.flush(&mut emit);
        drop(emit);
        failed.map_or(Ok(activity), Err)
    }

    /// Takes the waiting messages, port by port, then ticks the role when due.
    ///
    /// # Errors
    /// The first port that fails.
    pub fn poll(&mut self, now: Instant) -> Result<Activity, E> {
        let mut activity = Activity::default();
        let Self {
            role,
            inputs,
            outputs,
        } = self;
        let mut failed = None;
        for (port, input) in inputs.iter_mut().enumerate() {
            let mut take = |_: &Envelope, payload: &[u8]| {
                activity.received_count += 1;
                let mut emit = emitter(outputs, now, &mut activity.sent_count, &mut failed);
                if !role.message(now, port, payload, &mut emit) {
                    activity.malformed_count += 1;
                }
            };
            // Bounded, so that a flood on one port cannot keep the role from its tick.
            for _ in 0..MESSAGES_PER_POLL_MAX {
                if !input.receive(now, &mut take)? {
                    break;
                }
            }
        }
        if role.next_tick().is_some_and(|due| due <= now) {
            let mut emit = emitter(outputs, now, &mut activity.sent_count, &mut failed);
            role.tick(now, &mut emit);
            activity.tick_count += 1;
        }
        failed.map_or(Ok(activity), Err)
    }

    /// When `poll` next has something to do, as far as this endpoint can know.
    pub fn next_wakeup(&self) -> Option<Instant> {
        let arrivals = self.inputs.iter().filter_map(InputPort::next_arrival);
        arrivals.chain(self.role.next_tick()).min()
    }

    /// The role, for its counters.
    pub fn role(&self) -> &dyn Role {
        self.role.as_ref()
    }

    /// The input ports, in port order.
    pub fn inputs_mut(&mut self) -> &mut [I] {
        &mut self.inputs
    }

    /// The output ports, in port order.
    pub fn outputs_mut(&mut self) -> &mut [O] {
        &mut self.outputs
    }
}

fn emitter<'a, E, O: OutputPort<Error = E>>(
    outputs: &'a mut [O],
    now: Instant,
    sent_count: &'a mut u64,
    failed: &'a mut Option<E>,
) -> impl FnMut(usize, &[u8]) + 'a {
    move |port, payload| match outputs[port].send(now, payload) {
        Ok(()) => *sent_count += 1,
        Err(error) => {
            failed.get_or_insert(error);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::component::{Component, Output};

    crate::message! {
        struct Command = "test.Command.v1" { speed_mps: f64 }
        struct Status = "test.Status.v1" { position_m: [f64; 2] }
    }

    #[derive(Debug, Default)]
    struct Robot {
        status: Output<Status>,
    }

    impl Robot {
        fn role() -> Box<dyn Role> {
            Component::of(Self::default())
                .input("left/command", |_, _, _: &Command| {})
                .input("right/command", |_, _, _: &Command| {})
                .output("robot/status", |own| &mut own.status)
                .into_role()
        }
    }

    fn channel<M: crate::message::Message>(name: &str) -> StatedChannel {
        StatedChannel {
            name: name.to_owned(),
            message: TypeInfo::of(&MessageType::of::<M>()),
        }
    }

    #[track_caller]
    fn check(change: impl FnOnce(&mut RoleChannels), expected: Result<(), &str>) {
        let mut channels = RoleChannels {
            role: "robot".to_owned(),
            stated_by: "robot.json".to_owned(),
            inputs: vec![
                channel::<Command>("right/command"),
                channel::<Command>("left/command"),
            ],
            outputs: vec![channel::<Status>("robot/status")],
        };
        change(&mut channels);
        let found = channels.check(Robot::role().as_ref());
        let found = found.map_err(|error| error.to_string());
        assert_eq!(found, expected.map_err(str::to_owned));
    }

    #[test]
    fn ports_and_channels_are_joined_by_name_and_type_and_not_by_position() {
        check(|_| {}, Ok(()));
        check(|channels| channels.inputs.reverse(), Ok(()));
        check(
            |channels| channels.inputs[1] = channel::<Status>("left/command"),
            Err(
                "input port left/command of role robot takes test.Command.v1 (8 bytes aligned to \
                 8), but robot.json states test.Status.v1 (16 bytes aligned to 8)",
            ),
        );
        check(
            |channels| channels.outputs[0].message.size_bytes = 12,
            Err(
                "output port robot/status of role robot gives test.Status.v1 (16 bytes aligned to \
                 8), but robot.json states test.Status.v1 (12 bytes aligned to 8)",
            ),
        );
        check(
            |channels| drop(channels.inputs.remove(0)),
            Err(
                "input port right/command of role robot takes test.Command.v1 (8 bytes aligned to \
                 8), but robot.json states no such channel",
            ),
        );
        check(
            |channels| channels.outputs.push(channel::<Command>("robot/truth")),
            Err(
                "robot.json states the output channel robot/truth of test.Command.v1 (8 bytes \
                 aligned to 8), but role robot has no such port",
            ),
        );
    }
}
