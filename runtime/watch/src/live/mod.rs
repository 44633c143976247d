//! A running run on a terminal: its channels one by one (`hil-runtime channel`) and all of it at a
//! glance (`hil-runtime top`). It watches; nothing here sends, and no measured process waits for it.

pub mod channel;
pub mod cli;
mod conditions;
mod delay;
mod echo;
mod hz;
mod observer;
mod pace;
mod process;
mod tail;
pub mod top;
