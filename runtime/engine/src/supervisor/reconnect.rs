//! How a connection between supervisors that was cut comes back: the end that made it makes another one, and
//! the first host listens for as long as one is missing. Only who proves the key is let in, as when the hosts
//! met; another start of the peer is not. Both try for as long as the run bears a silent host (`run.peer_timeout`),
//! from their first attempt on: whatever says that the other end is gone, such as a reset, is no proof of it.

use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use super::control_listener::{ControlListener, Newcomer, say};
use super::frame::{PeerHello, PeerMessage, Resumed};
use super::meet::{Meeting, connect, greet};
use super::peer::ControlHalves;
use super::strangers::Strangers;

/// How often an end that lacks a connection tries at first, and later.
const PERIODS: [Duration; 2] = [Duration::from_millis(10), Duration::from_millis(100)];

/// Where the first host lets those in again that it has met.
#[derive(Debug, Default)]
pub(super) struct Readmission {
    /// Open while a connection is missing.
    listener: Option<ControlListener>,
    missing_count: usize,
    /// Connections that wait for the thread that lacks them: of each host the last one.
    came: Vec<Newcomer>,
    /// Frames that this host and any peer took of each other, see [`PeerMessage::Acknowledged`].
    pub(super) moved_count: Arc<AtomicU64>,
}

impl Readmission {
    /// Keeps one that came until the thread that misses its connection looks for it. One that goes on with a run that
    /// is over hears so.
    pub(super) fn take(&mut self, mut newcomer: Newcomer, own: &PeerHello) {
        let hello = &newcomer.hello;
        if hello
            .resumed
            .as_ref()
            .is_some_and(|one| one.of != own.domain)
        {
            let text = format!("{} was started again", own.host);
            let _left = say(&mut newcomer.ends, &PeerMessage::Refused(text)).is_err();
            return;
        }
        self.came.retain(|one| one.hello.host != hello.host);
        self.came.push(newcomer);
    }

    fn look(&mut self, meeting: &Meeting, own: &PeerHello) {
        // While the hosts meet, the port is taken, and who comes back is handed in.
        let opened = match self.listener.take() {
            Some(listener) => Ok(listener),
            None => ControlListener::open(meeting.address, meeting.admission(&own.host)),
        };
        let Ok(mut listener) = opened else {
            return;
        };
        // They are refused as when the hosts met, but not told of.
        let mut strangers = Strangers::default();
        if listener.admit_waiting(&mut strangers).is_ok() {
            while let Some(newcomer) = listener.look(&mut strangers) {
                self.take(newcomer, own);
            }
            self.listener = Some(listener);
        }
    }
}

/// What a connection to one peer is made with again.
#[derive(Debug)]
pub(super) struct Reconnect {
    pub(super) meeting: Meeting,
    pub(super) own: PeerHello,
    pub(super) theirs: PeerHello,
    /// Of all peers.
    pub(super) readmission: Arc<Mutex<Readmission>>,
}

impl Reconnect {
    /// The peer's name.
    pub(super) fn host(&self) -> &str {
        &self.theirs.host
    }

    /// The peer makes the connections.
    pub(super) fn is_called(&self) -> bool {
        self.meeting.is_here
    }

    /// A connection to the same start of the peer, and how many frames came there; here it were `come_count`.
    /// Tries while `is_wanted`.
    ///
    /// # Errors
    /// Why there is none.
    pub(super) fn make(
        &self,
        come_count: u64,
        is_wanted: impl Fn() -> bool,
    ) -> Result<(ControlHalves, u64), String> {
        let hello = PeerHello {
            resumed: Some(Resumed {
                of: self.theirs.domain,
                come_count,
            }),
            ..self.own.clone()
        };
        lock(&self.readmission).missing_count += 1;
        let patience = self.meeting.peer_timeout;
        let mut first_tried = None;
        let made = loop {
            let found = if self.is_called() {
                self.look(&hello)
            } else {
                self.call(&hello)
            };
            if let Some(made) = found.transpose() {
                break made;
            }
            let tried_for = first_tried.get_or_insert_with(WallInstant::now).elapsed();
            if tried_for >= patience || !is_wanted() {
                let limit_s = patience.as_secs();
                break Err(format!("there was no new one within {limit_s} s"));
            }
            thread::sleep((tried_for / 10).clamp(PERIODS[0], PERIODS[1]));
        };
        let mut readmission = lock(&self.readmission);
        readmission.missing_count -= 1;
        if readmission.missing_count == 0 {
            readmission.listener = None;
            readmission.came.clear();
        }
        made
    }

    /// Looks once whether the peer has come.
    fn look(&self, hello: &PeerHello) -> Result<Option<(ControlHalves, u64)>, String> {
        let mut readmission = lock(&self.readmission);
        readmission.look(&self.meeting, &self.own);
        let mut came = readmission.came.iter();
        let Some(place) = came.position(|one| one.hello.host == self.theirs.host) else {
            return Ok(None);
        };
        let Newcomer {
            mut ends,
            hello: said,
        } = readmission.came.swap_remove(place);
        drop(readmission);
        if said.domain != self.theirs.domain {
            return Err("it was started again".to_owned());
        }
        let Some(resumed) = said.resumed else {
            // It has not heard the answer to its first hello, which is the first frame.
            return Ok(Some((ends, 0)));
        };
        let said = say(&mut ends, &PeerMessage::Hello(hello.clone()));
        Ok(said.is_ok().then_some((ends, resumed.come_count)))
    }

    /// Calls the first host once.
    fn call(&self, hello: &PeerHello) -> Result<Option<(ControlHalves, u64)>, String> {
        let Ok(Ok(stream)) = connect(&self.meeting) else {
            return Ok(None);
        };
        let key = self.meeting.key.as_ref();
        match greet(stream, hello, &self.theirs.host, key) {
            Ok((ends, PeerMessage::Hello(said))) if said.domain == self.theirs.domain => {
                Ok(said.resumed.map(|one| (ends, one.come_count)))
            }
            Ok((_, PeerMessage::Refused(reason))) => Err(reason),
            _ => Ok(None),
        }
    }
}

pub(super) fn lock(readmission: &Mutex<Readmission>) -> MutexGuard<'_, Readmission> {
    readmission.lock().unwrap_or_else(PoisonError::into_inner)
}
