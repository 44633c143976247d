//! What a run writes and others read: its folder with records, manifest and status, and the launch
//! files of its processes. It starts and computes nothing.
#![forbid(unsafe_code)]

pub mod adapter_record;
pub mod announcement;
pub mod event;
pub mod file_fault;
pub mod launch;
pub mod layout;
pub mod link_orders;
pub mod live_run;
pub mod manifest;
pub mod nic_history;
pub mod pipe;
pub mod protection;
pub mod radio_record;
pub mod record;
pub mod run_folder;
pub mod run_result;
pub mod run_seal;
pub mod select;
pub mod series;
pub mod status;
pub mod status_file;
