//! Tells of connections that are lost and come back, from a thread that carries no messages.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use hil_core::time::Instant;
use hil_link::condition::flow_label;
use hil_transport::ConnectionTally;

use hil_rundir::launch::DirectionLaunch;
use hil_rundir::pipe::{FromProcess, say};

/// A connection that is away for longer is told of before it is back. The gateways of a run do not
/// end at one instant, so a shorter absence may be its end.
const PATIENCE: Duration = Duration::from_secs(1);

/// One direction's connection, as told so far.
#[derive(Debug)]
pub(super) struct Connection {
    link: String,
    peer: SocketAddr,
    tally: Arc<ConnectionTally>,
    /// Connections that came about, as of the last look.
    begun_count: u64,
    /// Without a connection since then.
    away_since: Option<Instant>,
    is_told: bool,
}

impl Connection {
    pub(super) fn new(launch: &DirectionLaunch, tally: Arc<ConnectionTally>) -> Self {
        Self {
            link: flow_label(&launch.flow).to_owned(),
            peer: launch.peer,
            begun_count: tally.begun_count(),
            tally,
            away_since: None,
            is_told: false,
        }
    }

    /// Looks, and says what is new.
    pub(super) fn tell(&mut self, now: Instant) {
        if let Some(text) = self.news(now) {
            say(&FromProcess::Warning(text));
        }
    }

    fn news(&mut self, now: Instant) -> Option<String> {
        let (ended_count, begun_count) = (self.tally.ended_count(), self.tally.begun_count());
        let is_new = begun_count > self.begun_count.max(1);
        self.begun_count = begun_count;
        let (link, peer) = (&self.link, self.peer);
        if begun_count > ended_count {
            let away = self.away_since.take();
            self.is_told = false;
            return is_new.then(|| {
                let away_ms =
                    away.map_or(0, |since| now.saturating_duration_since(since).as_millis());
                format!(
                    "{link}: the connection to {peer} was lost for about {away_ms} ms and is \
                     back (reconnect {})",
                    begun_count - 1
                )
            });
        }
        let since = *self.away_since.get_or_insert(now);
        let is_long = now.saturating_duration_since(since) >= PATIENCE;
        (is_long && !core::mem::replace(&mut self.is_told, is_long)).then(|| {
            format!("{link}: no connection to {peer} for a second; trying again and again")
        })
    }
}
