//! Asks a radio ten times a second what it knows of its stations, and writes down what happens to
//! the association. A thread of normal priority of its own: the measured threads wait for nothing
//! here.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use super::nl80211::{AssociationEvent, Rate, Station};
use super::socket::RadioSocket;
use hil_core::record::UNAVAILABLE;
use hil_platform::clock::MonotonicClock;
use hil_rundir::radio_record::{
    NO_BYTE, NO_CODE, NO_RATE, NO_SIGNAL, RadioRecord, RateRecord, SAMPLE,
};
use hil_rundir::record::RecordSink;

/// Time between two samples.
pub(crate) const SAMPLE_PERIOD: Duration = Duration::from_millis(100);
/// How often it looks whether it should end; a fraction of the period.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Stations recorded of one sample: an access point may have many, of which one is the peer.
const STATION_COUNT_MAX: usize = 8;

/// What became of the samples.
#[derive(Debug, Default)]
struct Tally {
    sample_count: u64,
    failed_count: u64,
    left_out_count: u64,
    event_count: u64,
    /// Times the kernel threw events away, each for one event or more.
    overrun_count: u64,
    event_failure: Option<io::Error>,
    newest_failure: Option<io::Error>,
}

/// A sampler at work.
#[derive(Debug)]
pub struct Sampler {
    interface: String,
    hears_events: bool,
    thread: JoinHandle<Tally>,
}

impl Sampler {
    /// Starts it; it ends when `stop` is set. Call from a thread of normal priority.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        interface: String,
        mut socket: RadioSocket,
        mut sink: RecordSink,
        stop: Arc<AtomicBool>,
    ) -> io::Result<Self> {
        let hears_events = socket.hears_events();
        let live = move || {
            let mut tally = Tally::default();
            let mut due = MonotonicClock::now();
            while !stop.load(Ordering::Acquire) {
                let now = MonotonicClock::now();
                if now >= due {
                    due = now + SAMPLE_PERIOD;
                    look(&mut socket, &mut sink, &mut tally);
                }
                thread::sleep(LOOK_PERIOD);
            }
            look(&mut socket, &mut sink, &mut tally);
            tally
        };
        let builder = thread::Builder::new().name("radio".to_owned());
        Ok(Self {
            interface,
            hears_events,
            thread: builder.spawn(live)?,
        })
    }

    /// Waits for its end; says what it did, in words.
    pub fn finish(self) -> (String, String) {
        let label = "radio samples".to_owned();
        let Ok(tally) = self.thread.join() else {
            return (label, "unavailable: the sampler panicked".to_owned());
        };
        (label, describe(&tally, &self.interface, self.hears_events))
    }
}

fn describe(tally: &Tally, interface: &str, hears_events: bool) -> String {
    let mut parts = vec![format!("{} of {interface}", tally.sample_count)];
    if !hears_events {
        parts.push("events of the association unavailable".to_owned());
    } else if tally.event_count > 0 {
        parts.push(format!("{} events of the association", tally.event_count));
    }
    if tally.overrun_count > 0 {
        parts.push(format!(
            "the kernel threw events away {} times: roams may be missing",
            tally.overrun_count
        ));
    }
    if let Some(error) = &tally.event_failure {
        parts.push(format!("events of the association broke off: {error}"));
    }
    if tally.left_out_count > 0 {
        let count = tally.left_out_count;
        parts.push(format!(
            "{count} stations beyond {STATION_COUNT_MAX} left out"
        ));
    }
    if let Some(error) = &tally.newest_failure {
        parts.push(format!("{} failed: {error}", tally.failed_count));
    }
    parts.join("; ")
}

fn look(socket: &mut RadioSocket, sink: &mut RecordSink, tally: &mut Tally) {
    let at_ns = MonotonicClock::now().as_ns();
    let heard = socket.happenings(|happening| {
        tally.event_count += 1;
        sink.push(&happening_record(at_ns, &happening));
    });
    match heard {
        Ok(overrun_count) => tally.overrun_count += overrun_count,
        Err(error) => tally.event_failure = Some(error),
    }
    match socket.stations() {
        Ok(stations) => {
            tally.sample_count += 1;
            tally.left_out_count += stations.len().saturating_sub(STATION_COUNT_MAX) as u64;
            let note = |station: &Station| sink.push(&sample_record(at_ns, station));
            stations.iter().take(STATION_COUNT_MAX).for_each(note);
        }
        Err(error) => {
            tally.failed_count += 1;
            tally.newest_failure = Some(error);
        }
    }
}

/// A sample of `station`.
fn sample_record(at_ns: i64, station: &Station) -> RadioRecord {
    let count = |word: Option<u32>| word.map_or(UNAVAILABLE, i64::from);
    let signal = |dbm: Option<i8>| dbm.map_or(NO_SIGNAL, i32::from);
    RadioRecord {
        rx_packets: count(station.rx_packets),
        tx_packets: count(station.tx_packets),
        tx_retries: count(station.tx_retries),
        tx_failed: count(station.tx_failed),
        beacon_losses: count(station.beacon_losses),
        inactive_ms: count(station.inactive_ms),
        connected_s: count(station.connected_s),
        signal_dbm: signal(station.signal_dbm),
        signal_average_dbm: signal(station.signal_average_dbm),
        transmit: station.transmit.map_or(RateRecord::NONE, rate),
        receive: station.receive.map_or(RateRecord::NONE, rate),
        mac: station.mac,
        event: SAMPLE,
        ..RadioRecord::nothing(at_ns)
    }
}

/// An event.
fn happening_record(at_ns: i64, happening: &AssociationEvent) -> RadioRecord {
    RadioRecord {
        mac: happening.mac.unwrap_or_default(),
        event: happening.command,
        code: happening.code.unwrap_or(NO_CODE),
        ..RadioRecord::nothing(at_ns)
    }
}

fn rate(rate: Rate) -> RateRecord {
    RateRecord {
        kbps: rate.kbps.unwrap_or(NO_RATE),
        width_mhz: rate.width_mhz,
        generation: rate.generation as u8,
        mcs: rate.mcs.unwrap_or(NO_BYTE),
        stream_count: rate.stream_count.unwrap_or(NO_BYTE),
        reserved: [0; 3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_events_and_failures_are_told_beside_what_was_sampled() {
        let mut tally = Tally {
            sample_count: 40,
            event_count: 2,
            ..Tally::default()
        };
        let quiet = describe(&tally, "wlan0", true);
        assert_eq!(quiet, "40 of wlan0; 2 events of the association");
        tally.overrun_count = 3;
        tally.event_failure = Some(io::Error::from_raw_os_error(libc::EBADF));
        let text = describe(&tally, "wlan0", true);
        assert!(text.contains("threw events away 3 times"), "{text}");
        assert!(text.contains("broke off"), "{text}");
        assert!(describe(&tally, "wlan0", false).contains("unavailable"));
    }
}
