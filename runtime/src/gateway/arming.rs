//! Switches kernel stamps on before the measured threads start, finds out by sending which really
//! come, and says what the sockets of a hop are to ask for. It opens no socket of a channel.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use hil_gateways::transport::probe::{
    Availability, ProbeReport, ProbeSettings, Sentinel, arm_and_probe,
};
use hil_gateways::transport::timestamping::{TimestampMode, interface_with_address};

use super::GatewayError;
use super::direction;
use super::process::PROBE_BOUND;
use super::socket::stamps_of;
use super::stamp_plan::StampPlan;
use crate::process::launch::{DirectionLaunch, GatewayLaunch, Transport};
use crate::radio::record::RadioRecord;
use crate::radio::sampler::Sampler;
use crate::radio::socket::RadioSocket;
use crate::record::{RecordKind, RecordSink, Recorder};
use crate::topology::Timestamps;

/// How long each half of the probe may take where a card is to stamp: its driver answers from a
/// worker of normal priority.
const CARD_PROBE_BOUND: Duration = Duration::from_secs(1);
/// Records of a radio that a ring holds: minutes of them.
const RADIO_RECORDS: usize = 4096;

/// What is known before the first socket opens.
#[derive(Debug)]
#[allow(dead_code, reason = "the sentinel is held, not read")]
pub(crate) struct Arming {
    /// Held until the end, so that the kernel never switches receive stamps off in between.
    pub(crate) sentinel: Option<Sentinel>,
    /// What was found, in words.
    pub(crate) facts: Vec<(String, String)>,
    found: Option<(ProbeReport, Option<ProbeReport>)>,
    is_wireless: bool,
    /// The wireless interface of the hop, until its sampler starts.
    radio: Option<RadioHop>,
}

/// A wireless interface, by its name.
#[derive(Debug)]
pub(crate) struct RadioHop {
    pub(crate) interface: String,
    pub(crate) socket: RadioSocket,
}

/// A radio's sampler that has not started.
#[derive(Debug)]
pub(super) struct PreparedSampler {
    radio: RadioHop,
    sink: RecordSink,
}

impl PreparedSampler {
    /// Starts it; call from a thread of normal priority.
    pub(super) fn start(self, stop: Arc<AtomicBool>) -> Result<Sampler, GatewayError> {
        let RadioHop { interface, socket } = self.radio;
        Sampler::start(interface, socket, self.sink, stop).map_err(GatewayError::Thread)
    }
}

impl Arming {
    /// What the sockets of `direction` are to ask for.
    pub(crate) fn plan(&self, direction: &DirectionLaunch) -> StampPlan {
        let asked = stamps_of(&direction.socket);
        let is_datagram = direction.socket.transport == Transport::Udp;
        let plan = match &self.found {
            Some((first, second)) => StampPlan::found(asked, first, second.as_ref()),
            None => StampPlan::asked(asked),
        };
        plan.on_radio(self.is_wireless && is_datagram)
    }

    /// Opens the record file of the hop's radio, if it has one.
    pub(super) fn prepare_sampler(
        &mut self,
        process: &str,
        recorder: &mut Recorder,
    ) -> Result<Option<PreparedSampler>, GatewayError> {
        let Some(radio) = self.radio.take() else {
            return Ok(None);
        };
        let name = format!("{process}/{}", radio.interface);
        let size = size_of::<RadioRecord>();
        let sink = recorder.sink(RecordKind::Radio, &name, size, RADIO_RECORDS)?;
        Ok(Some(PreparedSampler { radio, sink }))
    }
}

/// Switches kernel stamps on and finds out whether they really come, and whether the hop is a
/// radio's.
pub(super) fn arm(launch: &GatewayLaunch) -> Arming {
    let (radio, mut facts) = find_radio(launch);
    let mut sockets = launch.directions.iter().map(|one| one.socket.transport);
    if sockets.any(|transport| transport == Transport::Tcp) {
        let why = "unavailable over TCP: the kernel stamps bytes of a stream, not messages";
        facts.insert(0, ("kernel stamps".to_owned(), why.to_owned()));
        return Arming {
            sentinel: None,
            facts,
            found: None,
            is_wireless: radio.is_some(),
            radio,
        };
    }
    let mut directions = launch.directions.iter();
    let stamped = directions.find(|one| one.socket.timestamps != Timestamps::Off);
    let settings = stamped.map(|direction| ProbeSettings {
        timestamps: stamps_of(&direction.socket),
        interface: direction.socket.interface.clone(),
        transmit_target: Some(direction::probe_target(direction)),
        proof_count: 5,
        bound: PROBE_BOUND,
    });
    let mut armed = arm_and_describe(settings);
    let asked = stamped.map(|direction| stamps_of(&direction.socket));
    if let (Some((first, second)), Some(asked)) = (&armed.found, asked)
        && let Some(text) = StampPlan::found(asked, first, second.as_ref()).fallback()
    {
        armed
            .facts
            .push(("stamp fallback".to_owned(), text.to_owned()));
    }
    armed.facts.append(&mut facts);
    armed.is_wireless = radio.is_some();
    armed.radio = radio;
    armed
}

/// The radio of the hop's interface, and what it is used as. A wired hop says nothing of radios.
fn find_radio(launch: &GatewayLaunch) -> (Option<RadioHop>, Vec<(String, String)>) {
    let Some(interface) = launch.directions.iter().find_map(interface_of) else {
        return (None, Vec::new());
    };
    let label = || "radio".to_owned();
    match RadioSocket::open(&interface) {
        Ok((mut socket, wireless)) => {
            let power_save = match socket.is_power_save_on() {
                Ok(true) => {
                    ", power save ON: a sleeping radio hears of arrivals with a beacon only, some \
                     100 ms late"
                }
                Ok(false) => ", power save off",
                Err(_) => ", power save unavailable: the driver does not say",
            };
            let frequency = wireless.frequency_mhz;
            let channel = frequency.map_or_else(String::new, |mhz| format!(", {mhz} MHz"));
            let text = format!(
                "{interface} is an {}{channel}{power_save}",
                wireless.label()
            );
            let text = text.replace("an station", "a station");
            (Some(RadioHop { interface, socket }), vec![(label(), text)])
        }
        Err(error) => (None, vec![(label(), error.to_string())]),
    }
}

/// The interface this end of a hop is bound to or has the address of.
fn interface_of(direction: &DirectionLaunch) -> Option<String> {
    let bound = direction.socket.interface.clone();
    bound.or_else(|| interface_with_address(direction.local.ip()).ok().flatten())
}

/// Arms and probes what `settings` ask for; `None` where no stamps are wanted.
pub(crate) fn arm_and_describe(settings: Option<ProbeSettings>) -> Arming {
    let with = |sentinel, text: String, found| Arming {
        sentinel,
        facts: vec![("kernel stamps".to_owned(), text)],
        found,
        is_wireless: false,
        radio: None,
    };
    let Some(settings) = settings else {
        return with(None, "switched off in the topology".to_owned(), None);
    };
    let bound = if settings.timestamps == TimestampMode::Hardware {
        CARD_PROBE_BOUND
    } else {
        settings.bound
    };
    let settings = ProbeSettings { bound, ..settings };
    match arm_and_probe(&settings) {
        Ok((report, sentinel)) => {
            let second = probe_before_queue(&settings, &report);
            let text = describe_probe(&report, second.as_ref());
            with(Some(sentinel), text, Some((report, second)))
        }
        Err(error) => with(None, format!("unavailable: {error}"), None),
    }
}

/// Where no departure was stamped: whether the stack stamps before the queue.
fn probe_before_queue(settings: &ProbeSettings, first: &ProbeReport) -> Option<ProbeReport> {
    let is_missed = first.tx_software != Availability::Seen;
    if settings.timestamps != TimestampMode::Software || !is_missed {
        return None;
    }
    let settings = ProbeSettings {
        timestamps: TimestampMode::Scheduled,
        ..settings.clone()
    };
    // The first probe's sentinel keeps receive stamps on.
    arm_and_probe(&settings)
        .ok()
        .map(|(report, _sentinel)| report)
}

fn describe_probe(report: &ProbeReport, second: Option<&ProbeReport>) -> String {
    let word = |availability| match availability {
        Availability::Seen => "seen",
        Availability::ClaimedButNotSeen => "claimed by the driver, not seen",
        Availability::NotOffered => "unavailable",
    };
    let mut text = format!(
        "probe of {:.1} ms: receive software {}, transmit software {}, transmit hardware {}",
        report.waited_ns as f64 * 1e-6,
        word(report.rx_software),
        word(report.tx_software),
        word(report.tx_hardware)
    );
    if let Some(second) = second {
        let more = format!(
            "; second probe of {:.1} ms: transmit before the queue {}",
            second.waited_ns as f64 * 1e-6,
            word(second.tx_scheduled)
        );
        text.push_str(&more);
    }
    text
}
