//! A running run on a terminal: its channels one by one (`hil-runtime channel`) and all of it at a
//! glance (`hil-runtime top`). It watches; nothing here sends, and no measured process waits for it.

pub(crate) mod channel;
pub mod cli;
mod conditions;
mod delay;
mod echo;
mod hz;
mod observer;
mod pace;
mod process;
pub mod status;
pub(crate) mod status_file;
mod tail;
pub(crate) mod top;
