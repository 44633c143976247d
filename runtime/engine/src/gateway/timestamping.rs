//! Switches kernel stamps on before the measured threads start, finds out by sending which really
//! come, and says what the sockets of a hop are to ask for. It opens no socket of a channel.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use hil_net::interface::interface_with_address;
use hil_net::timestamping::TimestampMode;
use hil_protocol::transport::Description;
use hil_transport::probe::{
    Availability, DISCARD_PORT, ProbeReport, ProbeSettings, Sentinel, arm_and_probe,
};

use super::WorkerError;
use super::socket::{timestamp_mode, transport_of};
use super::stamp_plan::StampPlan;
use hil_nic::radio::sampler::Sampler;
use hil_nic::radio::socket::RadioSocket;
use hil_rundir::launch::{DirectionLaunch, GatewayWork, Side};
use hil_rundir::radio_record::RadioRecord;
use hil_rundir::record::{RecordFileError, RecordKind, RecordSink, Recorder};
use hil_topology::Timestamps;

/// How long each half of the stamp probe may take; a restart must not wait long for it.
pub(crate) const PROBE_BOUND: Duration = Duration::from_millis(300);
/// How long each half of the probe may take where a card is to stamp: its driver answers from a
/// worker of normal priority.
const CARD_PROBE_BOUND: Duration = Duration::from_secs(1);
/// Records of a radio that a ring holds: minutes of them.
const RADIO_RECORDS: usize = 4096;

/// What is known before the first socket opens.
#[derive(Debug)]
pub(crate) struct TimestampingSetup {
    /// Held until the end, so that the kernel never switches receive stamps off in between.
    _sentinel: Option<Sentinel>,
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

impl TimestampingSetup {
    /// `text` says why nothing was probed.
    fn without_probe(text: String) -> Self {
        Self {
            _sentinel: None,
            facts: vec![("kernel stamps".to_owned(), text)],
            found: None,
            is_wireless: false,
            radio: None,
        }
    }

    /// What the sockets of `direction` are to ask for.
    pub(crate) fn plan(&self, direction: &DirectionLaunch) -> StampPlan {
        let asked = timestamp_mode(direction.socket.common.timestamps);
        let has_reports = transport_of(&direction.socket)
            .is_ok_and(|one| one.description().capabilities.has_radio_reports);
        let plan = match (&self.found, direction.side) {
            (Some((first, second)), Side::Egress) => {
                StampPlan::found(asked, first, second.as_ref())
            }
            // The probe says nothing of arrivals, which a card may stamp where it stamps no
            // departures; and nothing waits for their stamps.
            _ => StampPlan::asked(asked),
        };
        plan.on_radio(self.is_wireless && has_reports)
    }

    /// Starts the sampler of the hop's radio, if it has one, until `stop` is set; call it from a thread
    /// of normal priority. Where its record file cannot be opened the run continues without samples, and
    /// a fact says so.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn start_sampler(
        &mut self,
        process: &str,
        recorder: &mut Recorder,
        stop: Arc<AtomicBool>,
    ) -> Result<Option<Sampler>, WorkerError> {
        let Some(RadioHop { interface, socket }) = self.radio.take() else {
            return Ok(None);
        };
        match open_sink(process, &interface, recorder) {
            Ok(sink) => Sampler::start(interface, socket, sink, stop)
                .map(Some)
                .map_err(WorkerError::Thread),
            Err(error) => {
                let text = format!("unavailable: {error}");
                self.facts.push(("radio samples".to_owned(), text));
                Ok(None)
            }
        }
    }
}

fn open_sink(
    process: &str,
    interface: &str,
    recorder: &mut Recorder,
) -> Result<RecordSink, RecordFileError> {
    let name = format!("{process}/{interface}");
    let size = size_of::<RadioRecord>();
    recorder.sink(RecordKind::Radio, &name, size, RADIO_RECORDS)
}

/// Switches kernel stamps on and finds out whether they really come, and whether the hop is a
/// radio's.
pub(super) fn arm(work: &GatewayWork) -> TimestampingSetup {
    let (radio, mut facts) = find_radio(work);
    let transports = work
        .directions
        .iter()
        .filter_map(|one| transport_of(&one.socket).ok());
    let mut unstamped = transports.filter_map(|transport| {
        let Description {
            label,
            capabilities,
            ..
        } = transport.description();
        let why = capabilities.unstamped_because?;
        Some(format!("unavailable over {label}: {why}"))
    });
    let mut armed = if let Some(text) = unstamped.next() {
        TimestampingSetup::without_probe(text)
    } else {
        let mut directions = work.directions.iter();
        let stamped = directions.find(|one| one.socket.common.timestamps != Timestamps::Off);
        let mut armed = arm_and_describe(stamped.map(|direction| ProbeSettings {
            timestamps: timestamp_mode(direction.socket.common.timestamps),
            interface: direction.socket.interface.clone(),
            transmit_target: Some(SocketAddr::new(direction.peer.ip(), DISCARD_PORT)),
            proof_count: 5,
            bound: PROBE_BOUND,
        }));
        if let (Some((first, second)), Some(stamped)) = (&armed.found, stamped) {
            let asked = timestamp_mode(stamped.socket.common.timestamps);
            let fallback = StampPlan::found(asked, first, second.as_ref()).fallback();
            armed
                .facts
                .extend(fallback.map(|text| ("stamp fallback".to_owned(), text)));
        }
        armed
    };
    armed.facts.append(&mut facts);
    armed.is_wireless = radio.is_some();
    armed.radio = radio;
    armed
}

/// The radio of the hop's interface, and what it is used as. A wired hop says nothing of radios.
fn find_radio(work: &GatewayWork) -> (Option<RadioHop>, Vec<(String, String)>) {
    let Some(interface) = work.directions.iter().find_map(interface_of) else {
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
pub(crate) fn arm_and_describe(settings: Option<ProbeSettings>) -> TimestampingSetup {
    let Some(settings) = settings else {
        return TimestampingSetup::without_probe("switched off in the topology".to_owned());
    };
    let asked_bound = settings.bound;
    let bound = if settings.timestamps == TimestampMode::Hardware {
        CARD_PROBE_BOUND
    } else {
        settings.bound
    };
    let settings = ProbeSettings { bound, ..settings };
    match arm_and_probe(&settings) {
        Ok((report, sentinel)) => {
            let second = probe_before_queue(settings, asked_bound, &report);
            let text = describe_probe(&report, second.as_ref());
            TimestampingSetup {
                _sentinel: Some(sentinel),
                found: Some((report, second)),
                ..TimestampingSetup::without_probe(text)
            }
        }
        Err(error) => TimestampingSetup::without_probe(format!("unavailable: {error}")),
    }
}

/// Where no departure was stamped: whether the stack stamps before the queue.
fn probe_before_queue(
    settings: ProbeSettings,
    bound: Duration,
    first: &ProbeReport,
) -> Option<ProbeReport> {
    if !StampPlan::needs_second_probe(settings.timestamps, first) {
        return None;
    }
    let settings = ProbeSettings {
        timestamps: TimestampMode::Scheduled,
        bound,
        ..settings
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_too_long_for_a_record_file_ends_no_gateway() {
        let folder = std::env::temp_dir().join(format!("hil-arming-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let mut recorder = Recorder::new(&folder, "gateway", 0);
        let process = format!("gateway-{}-robot-pc", "l".repeat(80));
        let error = open_sink(&process, "wlan0", &mut recorder).unwrap_err();
        assert!(
            error.to_string().contains("longer than 96 bytes"),
            "{error}"
        );
        let sink = open_sink("gateway-air-robot-pc", "wlan0", &mut recorder);
        assert!(sink.is_ok());
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn loopback_has_no_nic_to_wait_for() {
        let settings = ProbeSettings {
            bound: PROBE_BOUND,
            proof_count: 5,
            ..ProbeSettings::loopback(TimestampMode::Hardware)
        };
        let armed = arm_and_describe(Some(settings));
        let (first, second) = armed.found.unwrap();
        assert_eq!(first.tx_hardware, Availability::NotOffered);
        let plan = StampPlan::found(TimestampMode::Hardware, &first, second.as_ref());
        assert!(!plan.awaits_hardware(), "{plan:?}");
        assert!(plan.fallback().unwrap().contains("do not come"));
    }
}
