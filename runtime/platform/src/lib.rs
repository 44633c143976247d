//! The machine under a run: clocks, waiting, real-time settings, facts of the host, the terminal.
//! It knows nothing of topologies and runs.

pub mod argument;
pub mod clock;
pub mod clock_discipline;
pub mod console;
pub mod domain_address;
pub mod file_window;
pub mod host_facts;
pub mod host_limits;
pub mod open_files;
pub mod own_folder;
pub mod own_process;
pub mod plain_file;
pub mod progress;
pub mod random;
pub mod realtime;
pub mod signals;
pub mod socket_table;
pub mod systemd;
pub mod text;
pub mod wait;
pub mod words;
