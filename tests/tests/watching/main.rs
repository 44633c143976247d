//! Whoever looks on while a run goes: the recorder, its files, the live view, its page in a browser.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    clippy::print_stdout,
    reason = "tests"
)]

mod browser;
mod browser_fleet;
mod browser_split;
mod live_access;
mod live_floods;
mod live_strangers;
mod live_view;
mod mcap;
mod record_kills;
mod record_live;
mod record_stopped;
mod watch_live;
