//! How a connection between supervisors that was cut comes back: the end that made it makes another one, and
//! the first host listens for as long as one is missing. Only who proves the key is let in, as when the hosts
//! met; another start of the peer is not.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant as WallInstant};

use super::control_listener::{ControlListener, Newcomer, say};
use super::frame::{PeerHello, PeerMessage, Resumed};
use super::meet::{Meeting, connect, greet};
use super::peer::ControlHalves;
use super::strangers::Strangers;

/// How often an end that lacks a connection tries.
const PERIOD: Duration = Duration::from_millis(10);
/// How long it does, from its first attempt on: at the first host this is the time for which the door is open.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// Where the first host lets those in again that it has met.
#[derive(Debug, Default)]
pub(super) struct Door {
    /// Open while a connection is missing.
    listener: Option<ControlListener>,
    missing_count: usize,
    /// Whoever came and was not looked at: of each host the last one.
    came: Vec<Newcomer>,
}

impl Door {
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
    pub(super) door: Arc<Mutex<Door>>,
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

    /// A connection to the same start of the peer, and how many frames that has taken; `taken_count` were taken
    /// here. Tries while `is_wanted`.
    ///
    /// # Errors
    /// Why there is none.
    pub(super) fn make(
        &self,
        taken_count: u64,
        is_wanted: impl Fn() -> bool,
    ) -> Result<(ControlHalves, u64), String> {
        let hello = PeerHello {
            resumed: Some(Resumed {
                of: self.theirs.domain,
                taken_count,
            }),
            ..self.own.clone()
        };
        lock(&self.door).missing_count += 1;
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
            let first_tried = *first_tried.get_or_insert_with(WallInstant::now);
            if first_tried.elapsed() >= PATIENCE || !is_wanted() {
                let limit_s = PATIENCE.as_secs();
                break Err(format!("there was no new one within {limit_s} s"));
            }
            thread::sleep(PERIOD);
        };
        let mut door = lock(&self.door);
        door.missing_count -= 1;
        if door.missing_count == 0 {
            door.listener = None;
            door.came.clear();
        }
        made
    }

    /// Looks once whether the peer has come.
    fn look(&self, hello: &PeerHello) -> Result<Option<(ControlHalves, u64)>, String> {
        let mut door = lock(&self.door);
        door.look(&self.meeting, &self.own);
        let mut came = door.came.iter();
        let Some(place) = came.position(|one| one.hello.host == self.theirs.host) else {
            return Ok(None);
        };
        let Newcomer {
            mut ends,
            hello: said,
        } = door.came.swap_remove(place);
        drop(door);
        if said.domain != self.theirs.domain {
            return Err("it was started again".to_owned());
        }
        let Some(resumed) = said.resumed else {
            // It has not heard the answer to its first hello, which is the first frame.
            return Ok(Some((ends, 0)));
        };
        let said = say(&mut ends, &PeerMessage::Hello(hello.clone()));
        Ok(said.is_ok().then_some((ends, resumed.taken_count)))
    }

    /// Calls the first host once.
    fn call(&self, hello: &PeerHello) -> Result<Option<(ControlHalves, u64)>, String> {
        let Ok(Ok(stream)) = connect(&self.meeting) else {
            return Ok(None);
        };
        let key = self.meeting.key.as_ref();
        match greet(stream, hello, &self.theirs.host, key) {
            Ok((ends, PeerMessage::Hello(said))) if said.domain == self.theirs.domain => {
                Ok(said.resumed.map(|one| (ends, one.taken_count)))
            }
            Ok((_, PeerMessage::Refused(reason))) => Err(reason),
            _ => Ok(None),
        }
    }
}

pub(super) fn lock(door: &Mutex<Door>) -> MutexGuard<'_, Door> {
    door.lock().unwrap_or_else(PoisonError::into_inner)
}
