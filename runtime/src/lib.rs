//! The runtime: clock, shared memory, threads, processes, files. It runs the case studies of
//! `hil_models` as separate processes and carries their channels through `hil_gateways`.
//!
//! A binary is five lines:
//!
//! ```no_run
//! use hil_models::shuttle::Shuttle;
//!
//! fn main() -> std::process::ExitCode {
//!     hil_runtime::cli::Runtime::new().case::<Shuttle>().run()
//! }
//! ```
//!
//! One folder for each part, from the lowest to the highest:
//!
//! 1. [`platform`]: the machine. [`topology`]: what runs where.
//! 2. [`rundir`]: what a run writes and others read.
//! 3. [`shm`]: shared memory between processes. [`nic`]: network cards, their clocks, radios.
//! 4. [`engine`]: the supervisor, and what runs inside each process that it starts.
//! 5. [`report`]: from the records to what a person reads. [`watch`]: looking on while a run goes.
//! 6. [`doctor`], [`probe`], [`cli`]: the commands.

pub mod cli;
pub mod doctor;
pub mod engine;
pub mod nic;
pub mod platform;
pub mod probe;
pub mod report;
pub mod rundir;
pub mod shm;
pub mod topology;
pub mod watch;

pub use cli::Runtime;
