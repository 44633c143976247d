//! What a report says of radios: the association of each wireless hop during the run, and of each
//! channel what the radio reported of its messages. It draws no conclusion.

use hil_account::radio::RadioMetrics;
use serde::{Deserialize, Serialize};

/// Everything about radios. Empty on a wired run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RadioReport {
    /// Wireless hops, one for each gateway process on one.
    pub hops: Vec<RadioHopSummary>,
    /// Channels that went through a gateway.
    pub channels: Vec<ChannelRadio>,
}

impl RadioReport {
    /// What there is of `channel`.
    pub fn channel(&self, channel: &str) -> Option<&ChannelRadio> {
        self.channels.iter().find(|one| one.channel == channel)
    }
}

/// One channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelRadio {
    /// Its name.
    pub channel: String,
    /// What the radio reported of its messages; `None` when none reported anything.
    pub acknowledgements: Option<RadioMetrics>,
}

/// The radio of one gateway.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RadioHopSummary {
    /// The gateway process.
    pub process: String,
    /// Its host.
    pub host: String,
    /// The interface.
    pub interface: String,
    /// The stations it knew: of a station the access point, of an access point all.
    pub stations: Vec<StationSummary>,
    /// Times the association changed: connected, roamed, disconnected.
    pub event_count: u64,
    /// File of the samples below the run's folder; empty when it could not be written.
    pub series_file: String,
}

/// One station during the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StationSummary {
    /// Its address.
    pub mac: String,
    /// Samples that knew it.
    pub sample_count: u64,
    /// Signal of the newest packet, dBm; `None` when the driver does not say.
    pub signal_dbm: Option<Spread>,
    /// Rate sent with, Mbit/s.
    pub transmit_mbps: Option<Spread>,
    /// Rate received with, Mbit/s.
    pub receive_mbps: Option<Spread>,
    /// How the last packet was modulated; `None` when not known.
    pub transmit_modulation: Option<String>,
    /// How the last packet received was modulated; `None` when not known.
    pub receive_modulation: Option<String>,
    /// Packets sent during the run.
    pub tx_packet_count: Option<u64>,
    /// Frames sent again during the run.
    pub tx_retry_count: Option<u64>,
    /// Packets given up during the run.
    pub tx_failed_count: Option<u64>,
    /// Beacon losses during the run.
    pub beacon_loss_count: Option<u64>,
    /// Longest time without hearing anything of it, milliseconds.
    pub inactive_ms_max: Option<u64>,
    /// How long it had been associated at the end, seconds.
    pub connected_s: Option<u64>,
}

/// The spread of a sampled figure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Smallest sample.
    pub min: f64,
    /// Middle sample.
    pub median: f64,
    /// Largest sample.
    pub max: f64,
}

impl Spread {
    /// Of these samples; `None` without any.
    pub fn of(mut samples: Vec<f64>) -> Option<Self> {
        samples.sort_by(f64::total_cmp);
        Some(Self {
            min: *samples.first()?,
            median: samples[samples.len() / 2],
            max: *samples.last()?,
        })
    }
}
