//! The network cards of a run with `timestamps = "hardware"`: the supervisor switches their stamps
//! on before the gateways start, reads their clocks against the host's beside the run, and puts
//! the cards back as they were. The stamps themselves come through the gateways' sockets.
//!
//! The supervisor does this and not a gateway, because a card belongs to its host: two links may
//! use one card. A supervisor that is killed outright cannot put it back; then its guard does.

pub mod guard;
pub mod probing;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use hil_account::nic_clock::NicClockRecord;
use hil_net::clock_pair::ClockPair;
use hil_net::interface::{interface_with_address, own_name};
use hil_net::nic_clock::NicClock;
use hil_net::timestamping::TimestampCapabilities;

use self::guard::GuardedNic;
use hil_rundir::nic_history::NicHistory;
use hil_rundir::record::{RecordKind, RecordSink, Recorder};
use hil_topology::{Host, Program, Timestamps, Topology};

/// How often the clocks are read: a crystal strays by nanoseconds in that time.
const SAMPLE_PERIOD: Duration = Duration::from_millis(100);
/// Reads of which the narrowest counts.
const READ_ATTEMPTS: u32 = 5;
/// Pairs that fit between two visits of the writer, many times over.
const RING_RECORDS: usize = 256;
/// Who writes the records of the cards, in their file names.
const WRITER: &str = "supervisor";

#[derive(Debug)]
struct WatchedNic {
    story: NicHistory,
    armed: Option<GuardedNic>,
}

/// The cards of this supervisor's hosts, armed and watched until [`NicWatch::finish`].
#[derive(Debug, Default)]
pub struct NicWatch {
    cards: Vec<WatchedNic>,
    recorder: Option<Recorder>,
    stop: Arc<AtomicBool>,
    sampling: Option<JoinHandle<Vec<Sampled>>>,
    problems: Vec<String>,
}

/// A clock being read, and where to.
#[derive(Debug)]
struct Sampled {
    nic_index: usize,
    clock: NicClock,
    sink: RecordSink,
    failed_read_count: u64,
}

impl NicWatch {
    /// Arms the cards that `topology` asks for on `hosts` and begins to read their clocks into
    /// `records`. What cannot be done is part of the story and ends no run. Call it from a thread
    /// of normal priority: the reading thread inherits it.
    pub fn start(topology: &Topology, hosts: &[&Host], records: &Path) -> Self {
        let mut watch = Self {
            cards: Vec::new(),
            recorder: None,
            stop: Arc::default(),
            sampling: None,
            problems: Vec::new(),
        };
        for host in hosts.iter().filter(|host| wants_cards(topology, host)) {
            let card = open_nic(host, &watch.cards);
            watch.cards.push(card);
        }
        if let Err(problem) = watch.begin_sampling(records) {
            watch.problems.push(problem);
        }
        watch
    }

    fn begin_sampling(&mut self, records: &Path) -> Result<(), String> {
        let mut recorder = Recorder::new(records, WRITER, 0);
        let mut sampled = Vec::new();
        for (nic_index, card) in self.cards.iter_mut().enumerate() {
            let Some(index) = card.story.phc_index else {
                continue;
            };
            let clock = match NicClock::open(index) {
                Ok(clock) => clock,
                Err(error) => {
                    card.story.clock = format!("unavailable: {error}");
                    continue;
                }
            };
            card.story.clock = format!("/dev/ptp{index} {}", clock.method().text());
            let size = size_of::<NicClockRecord>();
            let sink = recorder
                .sink(RecordKind::NicClock, &card.story.name(), size, RING_RECORDS)
                .map_err(|error| error.to_string())?;
            sampled.push(Sampled {
                nic_index,
                clock,
                sink,
                failed_read_count: 0,
            });
        }
        if sampled.is_empty() {
            return Ok(());
        }
        let failed = |error: std::io::Error| format!("card clocks are not read: {error}");
        recorder.start().map_err(failed)?;
        self.recorder = Some(recorder);
        let stop = Arc::clone(&self.stop);
        let builder = thread::Builder::new().name("card clocks".to_owned());
        let sampling = builder.spawn(move || {
            loop {
                // Read once more after the word to stop: the last messages lie before that pair.
                let is_last = stop.load(Ordering::Acquire);
                sampled.iter_mut().for_each(sample);
                if is_last {
                    return sampled;
                }
                thread::park_timeout(SAMPLE_PERIOD);
            }
        });
        self.sampling = Some(sampling.map_err(failed)?);
        Ok(())
    }

    /// Reads the clocks a last time, puts the cards back as they were, and gives their stories
    /// and what went wrong with the records.
    pub fn finish(mut self) -> (Vec<NicHistory>, Vec<String>) {
        self.stop.store(true, Ordering::Release);
        if let Some(sampling) = self.sampling.take() {
            sampling.thread().unpark();
            match sampling.join() {
                Ok(sampled) => {
                    for one in sampled {
                        let story = &mut self.cards[one.nic_index].story;
                        story.failed_read_count = one.failed_read_count;
                    }
                }
                Err(_) => self
                    .problems
                    .push("the reader of card clocks panicked".to_owned()),
            }
        }
        if let Some(recorder) = self.recorder.take() {
            let written = recorder.finish();
            let failures = written.failures.iter().map(ToString::to_string);
            self.problems.extend(failures);
            if written.has_panicked {
                self.problems
                    .push("the writer of card clocks panicked".to_owned());
            }
        }
        // In the reverse order: of two hosts with one card, the first found its former setting.
        for card in self.cards.iter_mut().rev() {
            if let Some(armed) = &mut card.armed {
                card.story.restoring = armed.restore_in_words();
            }
        }
        let stories = self.cards.iter().map(|card| card.story.clone()).collect();
        (stories, core::mem::take(&mut self.problems))
    }
}

impl Drop for NicWatch {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        while let Some(last) = self.cards.pop() {
            drop(last);
        }
    }
}

/// True when a gateway or adapter on `host` asks for hardware stamps of datagrams.
fn wants_cards(topology: &Topology, host: &Host) -> bool {
    let of_hops = topology.crossings().any(|crossing| {
        crossing.hop.socket.timestamps == Timestamps::Hardware
            && [crossing.from_host, crossing.to_host]
                .iter()
                .any(|end| end.name == host.name)
    });
    let of_faces = topology.processes_on(&host.name).any(|process| {
        matches!(&process.program, Program::Egm { adapter, .. } if adapter.timestamps == Timestamps::Hardware)
    });
    of_hops || of_faces
}

/// The interface of the card that a run of `topology` sets up on `host`, as the kernel calls it.
pub fn card_of(topology: &Topology, host: &Host) -> Option<String> {
    let interface = wants_cards(topology, host).then(|| interface_of(host));
    let interface = interface?.ok()?;
    Some(own_name(&interface).unwrap_or(interface))
}

/// The interface that the datagrams of `host` pass: the one it names, else that of its address.
pub(crate) fn interface_of(host: &Host) -> Result<String, String> {
    if let Some(interface) = &host.interface {
        return Ok(interface.clone());
    }
    let address = host.gateway_address();
    match interface_with_address(address) {
        Ok(Some(interface)) => Ok(interface),
        Ok(None) => Err(format!("no interface has the address {address}")),
        Err(error) => Err(format!("the interfaces cannot be listed: {error}")),
    }
}

fn open_nic(host: &Host, others: &[WatchedNic]) -> WatchedNic {
    let mut story = NicHistory {
        host: host.name.clone(),
        interface: String::new(),
        phc_index: None,
        claims: String::new(),
        arming: String::new(),
        is_armed: false,
        stamps_all_arrivals: false,
        restoring: "nothing to put back".to_owned(),
        clock: "unavailable: the interface has no clock of its own".to_owned(),
        failed_read_count: 0,
    };
    let interface = match interface_of(host) {
        Ok(interface) => interface,
        Err(reason) => {
            "unknown".clone_into(&mut story.interface);
            story.arming = format!("unavailable: {reason}");
            return WatchedNic { story, armed: None };
        }
    };
    story.interface.clone_from(&interface);
    match TimestampCapabilities::query(&interface) {
        Ok(claims) => {
            story.phc_index = claims.phc_index;
            story.claims = describe_claims(&claims);
        }
        Err(error) => story.claims = format!("unavailable: {error}"),
    }
    let is_guarded = others
        .iter()
        .any(|other| other.armed.is_some() && other.story.interface == interface);
    let armed = match GuardedNic::arm(&interface, is_guarded) {
        Ok(guarded) => {
            let armed = guarded.armed();
            story.arming = armed.describe();
            story.is_armed = true;
            story.stamps_all_arrivals = armed.stamps_all_arrivals();
            Some(guarded)
        }
        Err(reason) => {
            story.arming = format!("unavailable: {reason}");
            None
        }
    };
    WatchedNic { story, armed }
}

fn describe_claims(claims: &TimestampCapabilities) -> String {
    let words = [
        (claims.tx_hardware, "hardware transmit"),
        (claims.rx_hardware, "hardware receive"),
        (claims.tx_software, "software transmit"),
        (claims.rx_software, "software receive"),
    ];
    let claimed: Vec<&str> = words.iter().filter(|one| one.0).map(|one| one.1).collect();
    if claimed.is_empty() {
        "nothing".to_owned()
    } else {
        claimed.join(", ")
    }
}

fn sample(one: &mut Sampled) {
    let pair = one.clock.read(READ_ATTEMPTS);
    let host = ClockPair::read(READ_ATTEMPTS);
    match (pair, host) {
        (Ok(pair), Ok(host)) => one.sink.push(&NicClockRecord {
            realtime_ns: pair.realtime_ns,
            nic_offset_ns: pair.nic_offset_ns,
            realtime_offset_ns: host.offset_ns,
            bound_ns: pair.bound_ns,
        }),
        _ => one.failed_read_count += 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host(interface: Option<&str>) -> Host {
        Host {
            name: "robot-pc".to_owned(),
            interface: interface.map(str::to_owned),
            ..Host::TEMPLATE
        }
    }

    #[test]
    fn an_interface_without_a_card_is_said_to_have_none() {
        let card = open_nic(&host(Some("lo")), &[]);
        assert!(card.armed.is_none() && !card.story.is_armed);
        assert_eq!(card.story.phc_index, None);
        assert!(
            card.story.arming.starts_with("unavailable: "),
            "{:?}",
            card.story
        );
        assert!(
            card.story.clock.contains("no clock of its own"),
            "{:?}",
            card.story
        );
        assert!(
            card.story.claims.contains("software transmit"),
            "{:?}",
            card.story
        );
        assert_eq!(card.story.name(), "robot-pc/lo");
    }

    #[test]
    fn a_host_that_names_no_interface_uses_that_of_its_address() {
        assert_eq!(interface_of(&host(None)).as_deref(), Ok("lo"));
        let card = open_nic(&host(Some("no-such-card")), &[]);
        assert!(
            card.story.claims.starts_with("unavailable: "),
            "{:?}",
            card.story
        );
    }

    #[test]
    fn a_watch_without_cards_tells_nothing_and_leaves_no_file() {
        let folder = std::env::temp_dir();
        let mut watch = NicWatch {
            cards: Vec::new(),
            recorder: None,
            stop: Arc::default(),
            sampling: None,
            problems: Vec::new(),
        };
        assert_eq!(watch.begin_sampling(&folder), Ok(()));
        assert!(watch.recorder.is_none());
        assert_eq!(watch.finish(), (Vec::new(), Vec::new()));
    }

    #[test]
    fn claims_are_put_into_words() {
        let claims = TimestampCapabilities::query("lo").unwrap();
        assert_eq!(
            describe_claims(&claims),
            "software transmit, software receive"
        );
    }
}
