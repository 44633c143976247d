//! Orders to change emulated links while the run goes on: taken from shared memory, handed to the
//! threads that carry messages, and written down. It runs in the gateway's own thread of normal
//! priority; nobody gives orders as a rule, and then it only looks.

use std::fs::File;
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Duration;

use hil_link::condition::{
    LinkChangeRequest, LinkCondition, LinkConditionRecord, OrderOutcome, flow_name,
};

use super::WorkerError;
use super::link_switch::{Replacements, SwitchHandle};
use hil_platform::clock::MonotonicClock;
use hil_rundir::launch::WorkerLaunch;
use hil_rundir::link_orders::condition_header;
use hil_rundir::pipe::{FromProcess, say};
use hil_rundir::record::file::RecordHeader;
use hil_rundir::record::{RecordFile, RecordFileError};
use hil_shm::{ChannelError, Domain, RawInput};

/// Orders that may wait.
pub(crate) const ORDERS_MAX: usize = 8;
/// A change holds from so long after it was handed over, so that every thread has it by then and all
/// channels of the direction change at one instant.
const LEAD: Duration = Duration::from_millis(5);

/// Every emulated way of the link of one gateway process.
#[derive(Debug, Default)]
pub(super) struct LinkControl {
    lines: Vec<ControlLine>,
}

/// One direction of a link, with all channels that go that way.
#[derive(Debug)]
struct ControlLine {
    orders: RawInput,
    switch: SwitchHandle,
    book: ConditionBook,
    number: u64,
    /// One complaint about its channel is enough.
    has_complained: bool,
}

impl LinkControl {
    /// Listens for orders to `switches`. A gateway that is started again goes on in the condition that
    /// its predecessor was left in.
    ///
    /// # Errors
    /// When the channel of a direction is not there.
    pub(super) fn open(
        domain: &Domain,
        launch: &WorkerLaunch,
        switches: Vec<SwitchHandle>,
    ) -> Result<Self, WorkerError> {
        let mut lines: Vec<ControlLine> = Vec::new();
        for switch in switches {
            let emulation = switch.emulation();
            let name = flow_name(&emulation.link, emulation.way);
            lines.push(ControlLine {
                orders: RawInput::open(domain, &name, ORDERS_MAX)?,
                switch,
                book: ConditionBook::new(launch, name),
                number: 0,
                has_complained: false,
            });
        }
        for line in &mut lines {
            line.resume();
        }
        Ok(Self { lines })
    }

    /// Does what was ordered since the last look.
    pub(super) fn attend(&mut self) {
        for line in &mut self.lines {
            line.attend();
        }
    }
}

impl ControlLine {
    fn attend(&mut self) {
        let mut waiting = Vec::new();
        for _ in 0..ORDERS_MAX {
            let mut order = None;
            let taken = self.orders.receive(&mut |_, bytes| {
                order = bytemuck::try_pod_read_unaligned::<LinkChangeRequest>(bytes).ok();
            });
            match taken {
                Ok(true) => waiting.extend(order),
                Ok(false) => break,
                // Its messages go on as they are, and what was taken before is obeyed.
                Err(error) => {
                    self.complain(&error);
                    break;
                }
            }
        }
        for order in waiting {
            self.obey(&order);
        }
    }

    /// Says that no orders come any more; who gives one sees only that nothing answers.
    fn complain(&mut self, error: &ChannelError) {
        if self.has_complained {
            return;
        }
        self.has_complained = true;
        let text = format!("{}: orders cannot be taken: {error}", self.book.channel);
        say(&FromProcess::Warning(text));
    }

    /// Goes on in the condition that an earlier start of this gateway was in.
    fn resume(&mut self) {
        let earlier = self.book.earlier();
        self.number = earlier
            .iter()
            .map(|record| record.number)
            .max()
            .unwrap_or(0);
        let in_force =
            |record: &&LinkConditionRecord| record.outcome() == Some(OrderOutcome::InForce);
        let Some(last) = earlier.iter().rev().find(in_force) else {
            return;
        };
        if let Some(condition) = last
            .condition()
            .filter(|one| *one != LinkCondition::Topology)
        {
            self.obey(&LinkChangeRequest::new(condition, last.request));
        }
    }

    fn obey(&mut self, order: &LinkChangeRequest) {
        self.number += 1;
        let outcome = self.book.open().map(|()| self.try_obey(order));
        let said = match outcome {
            Ok(record) => self.book.write(&record),
            Err(error) => Err(error),
        };
        if let Err(error) = said {
            let text = format!("{}: a change is not on record: {error}", self.book.channel);
            say(&FromProcess::Warning(text));
        }
    }

    /// Changes all channels at one instant, or none.
    fn try_obey(&mut self, order: &LinkChangeRequest) -> LinkConditionRecord {
        let ready = self.prepare(order);
        let from = MonotonicClock::now() + LEAD;
        let outcome = match ready {
            Ok(replacements) => {
                self.switch.send(from, replacements);
                OrderOutcome::InForce
            }
            Err(refused) => refused,
        };
        let certain = MonotonicClock::now().max(from);
        LinkConditionRecord {
            number: self.number,
            request: order.request,
            from_ns: from.as_ns(),
            certain_ns: certain.as_ns(),
            delay_ns: order.delay_ns,
            loss_ratio: order.loss_ratio,
            kind: order.kind,
            outcome: outcome.number(),
        }
    }

    fn prepare(&mut self, order: &LinkChangeRequest) -> Result<Replacements, OrderOutcome> {
        let condition = order.condition().ok_or(OrderOutcome::Malformed)?;
        if !self.switch.can_hold(condition) {
            return Err(OrderOutcome::NoRoom);
        }
        if !self.switch.is_free() {
            return Err(OrderOutcome::Busy);
        }
        let built = self.switch.build(condition, self.number);
        built.map_err(|_range| OrderOutcome::Malformed)
    }
}

/// The record file of one direction: made with the first order, and written at once, as orders are
/// rare and whoever gave one waits for the record.
#[derive(Debug)]
struct ConditionBook {
    channel: String,
    folder: PathBuf,
    process: String,
    instance: u32,
    file: Option<(PathBuf, File)>,
}

impl ConditionBook {
    fn new(launch: &WorkerLaunch, channel: String) -> Self {
        Self {
            channel,
            folder: launch.records.clone(),
            process: launch.process.clone(),
            instance: launch.instance,
            file: None,
        }
    }

    fn header(&self, instance: u32) -> RecordHeader {
        condition_header(&self.channel, instance)
    }

    /// What earlier starts of this gateway wrote. A start without an order wrote nothing; what cannot
    /// be read is said: the link may go on in another condition than it was left in.
    fn earlier(&self) -> Vec<LinkConditionRecord> {
        let mut found = Vec::new();
        for instance in 0..self.instance {
            let name = self.header(instance).file_name(&self.process);
            match RecordFile::read(&self.folder.join(name)) {
                Ok(file) => found.extend(file.records::<LinkConditionRecord>()),
                Err(RecordFileError::Io { source, .. })
                    if source.kind() == io::ErrorKind::NotFound => {}
                Err(error) => {
                    let channel = &self.channel;
                    let text = format!("{channel}: earlier changes are not known: {error}");
                    say(&FromProcess::Warning(text));
                }
            }
        }
        found
    }

    fn open(&mut self) -> Result<(), RecordFileError> {
        if self.file.is_some() {
            return Ok(());
        }
        let header = self.header(self.instance);
        self.file = Some(header.create(&self.folder, &self.process)?);
        Ok(())
    }

    fn write(&mut self, record: &LinkConditionRecord) -> Result<(), RecordFileError> {
        let Some((path, file)) = &mut self.file else {
            return Ok(());
        };
        file.write_all(bytemuck::bytes_of(record))
            .map_err(|source| RecordFileError::Io {
                path: path.clone(),
                source,
            })
    }
}
