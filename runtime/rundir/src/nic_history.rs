//! What became of a network card during a run, as its supervisor tells it. It asks no card.

use serde::{Deserialize, Serialize};

/// What became of one card, in words for the report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NicHistory {
    /// The host of the topology.
    pub host: String,
    /// Its interface.
    pub interface: String,
    /// Number N of the card's clock `/dev/ptpN`; `None` when it has none.
    pub phc_index: Option<u32>,
    /// What the driver claims to stamp.
    pub claims: String,
    /// What was asked for and granted, or why the card could not be armed.
    pub arming: String,
    /// It was armed.
    pub is_armed: bool,
    /// It stamps every arriving datagram.
    pub stamps_all_arrivals: bool,
    /// How it was set up before, and whether that was put back.
    pub restoring: String,
    /// How its clock was read, or why not.
    pub clock: String,
    /// Reads of its clock that failed.
    pub failed_read_count: u64,
}

impl NicHistory {
    /// Name of the card's records, and of the card in the report.
    pub fn name(&self) -> String {
        nic_name(&self.host, &self.interface)
    }
}

/// Name of the records of the card behind `interface` of `host`, and of the card in reports.
pub fn nic_name(host: &str, interface: &str) -> String {
    format!("{host}/{interface}")
}
