//! What two supervisors say to each other, over as many TCP connections as it takes. Each end keeps the frames
//! that the other has not taken; when a connection is cut, the next one (`reconnect.rs`) goes on behind the last
//! frame that came. What the frames mean is not here.
//!
//! An end has room for all frames that the other may keep. So it reads whatever becomes of those it has, as
//! behind a disk that stands still, and its own acknowledgements, ten a second, say that it is there.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant as WallInstant};

use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use zeroize::Zeroizing;

use super::control_listener::GREETING_TIMEOUT;
use super::frame::{FRAME_BYTES_MAX, Frame, PeerMessage, read_frame, write_message};
use super::peer::{ControlHalves, ControlReader, ControlWriter, PeerEvent};
use super::reconnect::{Reconnect, lock};

/// Bytes of frames that are kept until the peer has taken them; then a sender waits.
const KEPT_BYTES_MAX: usize = 4 << 20;
/// What a frame counts beside its length.
const FRAME_COST_BYTES: usize = 64;
/// How often the peer is told at least what was taken. A cut that only one end has noticed lasts this long at
/// most where a reset comes back: the kernel of the end that noticed it answers what is said over it with one.
const ACKNOWLEDGE_PERIOD: Duration = Duration::from_millis(100);
/// A connection over which no byte came for so long is taken for cut: a path may drop what is sent, and the
/// resets, without a word. Longer than a busy host takes between two acknowledgements.
const SILENCE_MAX: Duration = Duration::from_secs(3);
/// Frames after which the peer is told at once.
const ACKNOWLEDGED_AT: u64 = 2;
/// How long the end of a conversation waits for the peer to take what it was sent last; after an exchange of records,
/// whose end both need to know, longer than it takes to notice a cut and to mend it.
const LAST_FRAMES_PATIENCES: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(5)];
/// How long an end that leaves tries to say so.
const LEAVING_PATIENCE: Duration = Duration::from_millis(500);

/// A time without a connection, after which nothing was missing.
#[derive(Debug, Clone)]
pub(super) struct Cut {
    /// When this end noticed it.
    pub(super) since: Instant,
    pub(super) length: Duration,
    /// What the system said.
    pub(super) cause: String,
}

/// One end. Of its two locks that of the writer is taken first.
#[derive(Debug)]
pub(super) struct Conversation {
    state: Mutex<State>,
    changed: Condvar,
    /// `None` without a connection. Held while a frame is written, never waited for by the thread that reads:
    /// two ends that only write would wait for each other for ever.
    writer: Mutex<Option<ControlWriter>>,
    /// Of this host with all its peers: a peer that waits for others sees by it that there is progress.
    pub(super) moved_count: Arc<AtomicU64>,
}

#[derive(Debug)]
struct State {
    /// Frames that the peer is not known to have taken, oldest first.
    kept: VecDeque<Arc<Zeroizing<Vec<u8>>>>,
    kept_bytes: usize,
    /// Frames that it has taken: the number of the oldest kept one.
    given_count: u64,
    /// Frames that came and were not taken, with what they count.
    waiting: VecDeque<(Frame, usize)>,
    waiting_bytes: usize,
    /// Frames that came.
    come_count: u64,
    /// Frames taken here.
    taken_count: u64,
    stream: Option<TcpStream>,
    reader: Option<JoinHandle<()>>,
    /// Since when there is no connection, and why.
    down: Option<(Instant, String)>,
    cuts: Vec<Cut>,
    is_over: bool,
    /// Why, where it was not this end that ended it.
    over: Option<String>,
    /// While records are exchanged: how long the peer may make no progress.
    progress_limit: Option<Duration>,
    /// When it made some last.
    progressed: WallInstant,
    /// Its count of frames moved.
    peer_moved_count: u64,
}

impl Conversation {
    /// Goes on with `ends`, and with what `reconnect` finds after them.
    ///
    /// # Errors
    /// When there is no thread to be had.
    pub(super) fn begin(ends: ControlHalves, reconnect: Reconnect) -> io::Result<Arc<Self>> {
        // The first host's hello, which was read when the hosts met, is its first frame.
        let come_count = u64::from(!reconnect.is_called());
        let conversation = Arc::new(Self {
            state: Mutex::new(State {
                kept: VecDeque::new(),
                kept_bytes: 0,
                given_count: 0,
                waiting: VecDeque::new(),
                waiting_bytes: 0,
                come_count,
                taken_count: come_count,
                stream: None,
                reader: None,
                down: None,
                cuts: Vec::new(),
                is_over: false,
                over: None,
                progress_limit: None,
                progressed: WallInstant::now(),
                peer_moved_count: 0,
            }),
            changed: Condvar::new(),
            writer: Mutex::new(None),
            moved_count: Arc::clone(&lock(&reconnect.readmission).moved_count),
        });
        conversation.go_on(ends, 0)?;
        let kept = Arc::clone(&conversation);
        let keeping = thread::Builder::new()
            .name(format!("keep {}", reconnect.host()))
            .spawn(move || kept.keep(&reconnect));
        if let Err(error) = keeping {
            conversation.end(None);
            return Err(error);
        }
        Ok(conversation)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn writer(&self) -> MutexGuard<'_, Option<ControlWriter>> {
        self.writer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Until `is_so`, the end, or `limit`.
    fn wait_until(&self, limit: Duration, is_so: impl Fn(&State) -> bool) -> MutexGuard<'_, State> {
        let is_not = |state: &mut State| !state.is_over && !is_so(state);
        let waited = self.changed.wait_timeout_while(self.state(), limit, is_not);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// The next thing the peer said, waiting up to `timeout`.
    pub(super) fn receive(&self, timeout: Duration) -> Option<PeerEvent> {
        let mut state = self.wait_until(timeout, |state| !state.waiting.is_empty());
        let event = self.take(&mut state);
        drop(state);
        // There is room for more, and something to acknowledge.
        self.changed.notify_all();
        event
    }

    /// The next frame of the peer while records are exchanged.
    ///
    /// # Errors
    /// When the conversation is over, or the peer makes no progress.
    pub(super) fn next_frame(&self) -> Result<Frame, String> {
        loop {
            self.check_progress()?;
            match self.receive(ACKNOWLEDGE_PERIOD) {
                Some(PeerEvent::Frame(frame)) => return Ok(frame),
                Some(PeerEvent::Closed(reason)) => return Err(reason),
                None => {}
            }
        }
    }

    fn take(&self, state: &mut State) -> Option<PeerEvent> {
        let Some((frame, cost)) = state.waiting.pop_front() else {
            let closed = || {
                state
                    .over
                    .clone()
                    .unwrap_or_else(|| "connection closed".to_owned())
            };
            return state.is_over.then(|| PeerEvent::Closed(closed()));
        };
        state.waiting_bytes -= cost;
        state.taken_count += 1;
        let is_sign_of_life = matches!(
            frame,
            Frame::Message(PeerMessage::Alive | PeerMessage::Ticks(_))
        );
        self.note_moved(state, u64::from(!is_sign_of_life));
        Some(PeerEvent::Frame(frame))
    }

    fn note_moved(&self, state: &mut State, count: u64) {
        if count > 0 {
            state.progressed = WallInstant::now();
            self.moved_count.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// From now on records are exchanged: what is sent may take as long as the peer, which must not be without
    /// progress for longer than `limit`. Progress is a frame taken from it, or by it from any host; that it lives
    /// is none.
    ///
    /// # Errors
    /// When the system does not take the limit.
    pub(super) fn expect_progress(&self, limit: Duration) -> io::Result<()> {
        let mut state = self.state();
        state.progress_limit = Some(limit);
        state.progressed = WallInstant::now();
        let stream = state.stream.as_ref();
        stream.map_or(Ok(()), |stream| stream.set_write_timeout(None))
    }

    /// A time without a connection has a bound of its own.
    fn check_progress(&self) -> Result<(), String> {
        let state = self.state();
        let limit = state.progress_limit.filter(|_| state.down.is_none());
        match limit.filter(|limit| state.progressed.elapsed() > *limit) {
            Some(limit) => Err(format!("no progress for {} s", limit.as_secs())),
            None => Ok(()),
        }
    }

    /// Sends a frame, now or as soon as there is a connection again.
    ///
    /// # Errors
    /// When the conversation is over. It ends when there is no room for a frame within the time that a write may
    /// take, or while the peer makes no progress: without that frame the peer would miss one.
    pub(super) fn send(&self, frame: Zeroizing<Vec<u8>>) -> io::Result<()> {
        let cost = frame.len() + FRAME_COST_BYTES;
        let has_room =
            |state: &State| state.kept.is_empty() || state.kept_bytes + cost <= KEPT_BYTES_MAX;
        let began = WallInstant::now();
        loop {
            let state = self.wait_until(ACKNOWLEDGE_PERIOD, has_room);
            if state.is_over {
                return Err(io::ErrorKind::BrokenPipe.into());
            }
            if has_room(&state) {
                break;
            }
            let is_late = state.progress_limit.is_none() && began.elapsed() > GREETING_TIMEOUT;
            drop(state);
            let late = is_late.then(|| "no room for what is said to it".to_owned());
            if let Some(reason) = late.or_else(|| self.check_progress().err()) {
                self.end(Some(reason.clone()));
                return Err(io::Error::new(io::ErrorKind::TimedOut, reason));
            }
        }
        let frame = Arc::new(frame);
        let mut writer = self.writer();
        {
            let mut state = self.state();
            state.kept_bytes += cost;
            state.kept.push_back(Arc::clone(&frame));
        }
        self.write(&mut writer, |out| {
            out.write_all(&frame)?;
            out.flush()
        });
        Ok(())
    }

    /// Writes to the present connection, if there is one.
    fn write(
        &self,
        writer: &mut Option<ControlWriter>,
        write: impl FnOnce(&mut ControlWriter) -> io::Result<()>,
    ) {
        if let Some(out) = writer.as_mut()
            && let Err(error) = write(out)
        {
            *writer = None;
            self.note_cut(&error.to_string());
        }
    }

    fn note_cut(&self, cause: &str) {
        let mut state = self.state();
        if state.down.is_none() {
            state.down = Some((MonotonicClock::now(), cause.to_owned()));
        }
        state.hang_up();
        self.changed.notify_all();
    }

    /// The cuts since the last call that are over.
    pub(super) fn take_cuts(&self) -> Vec<Cut> {
        core::mem::take(&mut self.state().cuts)
    }

    /// Ends it without a word, so that whoever waits for it here notices at once; `why` where the peer, or the way to
    /// it, is the cause.
    fn end(&self, why: Option<String>) {
        let mut state = self.state();
        if !state.is_over {
            state.over = why;
        }
        state.is_over = true;
        state.hang_up();
        self.changed.notify_all();
    }

    /// Ends it and says so: an end that is gone without a word is waited for.
    pub(super) fn leave(&self) {
        let is_over = core::mem::replace(&mut self.state().is_over, true);
        if !is_over {
            self.say_leaving();
        }
        self.end(None);
    }

    fn say_leaving(&self) {
        let deadline = WallInstant::now() + LEAVING_PATIENCE;
        // At least once, however late this thread gets its turn.
        loop {
            if let Ok(mut writer) = self.writer.try_lock() {
                if let Some(out) = writer.as_mut() {
                    let limited = out.stream().set_write_timeout(Some(LEAVING_PATIENCE));
                    let _unsaid = limited
                        .and_then(|()| write_message(out, &PeerMessage::Leaving))
                        .is_err();
                }
                return;
            }
            if WallInstant::now() >= deadline {
                return;
            }
            thread::sleep(Duration::from_millis(1));
        }
    }

    /// Leaves once the peer has taken what it was sent, if it does so soon.
    pub(super) fn leave_in_order(&self) {
        let has_exchanged = self.state().progress_limit.is_some();
        let patience = LAST_FRAMES_PATIENCES[usize::from(has_exchanged)];
        drop(self.wait_until(patience, |state| state.kept.is_empty()));
        self.leave();
    }

    /// Goes on with a connection at whose other end `come_count` frames have come.
    fn go_on(self: &Arc<Self>, ends: ControlHalves, come_count: u64) -> io::Result<()> {
        let ControlHalves {
            mut reader,
            writer: out,
        } = ends;
        reader.wait_at_most(SILENCE_MAX)?;
        let stream = out.stream().try_clone()?;
        let mut writer = self.writer();
        let again: Vec<_> = {
            let mut state = self.state();
            if state.is_over {
                return Err(io::ErrorKind::BrokenPipe.into());
            }
            let write_limit = Some(GREETING_TIMEOUT).filter(|_| state.progress_limit.is_none());
            stream.set_write_timeout(write_limit)?;
            let known_count = state.kept_before(come_count)?;
            let forwarding = Arc::clone(self);
            let thread = thread::Builder::new().name("peer".to_owned());
            state.reader = Some(thread.spawn(move || forwarding.forward(reader))?);
            state.stream = Some(stream);
            state.progressed = WallInstant::now();
            if let Some((since, cause)) = state.down.take() {
                let length = MonotonicClock::now().saturating_duration_since(since);
                state.cuts.push(Cut {
                    since,
                    length,
                    cause,
                });
            }
            state.kept.iter().skip(known_count).cloned().collect()
        };
        self.changed.notify_all();
        *writer = Some(out);
        self.write(&mut writer, |out| {
            again.iter().try_for_each(|frame| out.write_all(frame))?;
            out.flush()
        });
        Ok(())
    }

    /// Takes what comes over one connection.
    fn forward(&self, mut input: ControlReader) {
        let cause = loop {
            match read_frame(&mut input, FRAME_BYTES_MAX) {
                Ok((
                    Frame::Message(PeerMessage::Acknowledged {
                        taken_count,
                        moved_count,
                    }),
                    _,
                )) => {
                    let mut state = self.state();
                    if moved_count > state.peer_moved_count {
                        state.peer_moved_count = moved_count;
                        state.progressed = WallInstant::now();
                    }
                    let given_count = state.given_count;
                    if let Err(error) = state.forget_until(taken_count) {
                        break error.to_string();
                    }
                    // What is said before that is mostly that this host lives.
                    if state.progress_limit.is_some() {
                        self.note_moved(&mut state, taken_count - given_count);
                    }
                }
                Ok((Frame::Message(PeerMessage::Leaving), _)) => {
                    self.end(Some("it closed the connection".to_owned()));
                    return;
                }
                Ok((frame, length)) => {
                    let cost = length + FRAME_COST_BYTES;
                    // A peer of ours keeps no more than there is room for.
                    let has_room = |state: &State| {
                        state.waiting.is_empty() || state.waiting_bytes + cost <= KEPT_BYTES_MAX
                    };
                    let mut state = self.wait_until(Duration::MAX, has_room);
                    state.waiting_bytes += cost;
                    state.waiting.push_back((frame, cost));
                    state.come_count += 1;
                }
                Err(error) => break cause_of(&error),
            }
            self.changed.notify_all();
        };
        self.note_cut(&cause);
    }

    /// Tells the peer what was taken, and gets a connection again whenever one was cut.
    fn keep(self: &Arc<Self>, reconnect: &Reconnect) {
        while let Some(cause) = self.acknowledge_until_cut() {
            *self.writer() = None;
            // What came over the connection that was cut comes first.
            let reader = self.state().reader.take();
            let _panicked = reader.map(|reader| reader.join().is_err());
            let come_count = self.state().come_count;
            let made = reconnect.make(come_count, || !self.state().is_over);
            let resumed = made.and_then(|(ends, come_count)| {
                let resumed = self.go_on(ends, come_count);
                resumed.map_err(|error| error.to_string())
            });
            if let Err(reason) = resumed {
                self.end(Some(format!(
                    "the connection was cut ({cause}), and {reason}"
                )));
                return;
            }
        }
    }

    /// Gives why the connection was cut, `None` at the end of the conversation.
    fn acknowledge_until_cut(&self) -> Option<String> {
        let mut told_count = self.state().taken_count;
        loop {
            let state = self.wait_until(ACKNOWLEDGE_PERIOD, |state| {
                state.down.is_some() || state.taken_count >= told_count + ACKNOWLEDGED_AT
            });
            if state.is_over {
                return None;
            }
            if let Some((_, cause)) = &state.down {
                return Some(cause.clone());
            }
            told_count = state.taken_count;
            drop(state);
            let told = PeerMessage::Acknowledged {
                taken_count: told_count,
                moved_count: self.moved_count.load(Ordering::Relaxed),
            };
            self.write(&mut self.writer(), |out| write_message(out, &told));
        }
    }
}

impl State {
    /// How many of the kept frames are among the first `count`.
    fn kept_before(&self, count: u64) -> io::Result<usize> {
        let sent_count = self.given_count + self.kept.len() as u64;
        let before = count.checked_sub(self.given_count);
        let before = before.and_then(|before| usize::try_from(before).ok());
        before
            .filter(|before| *before <= self.kept.len())
            .ok_or_else(|| {
                let text = format!(
                    "the peer says that it has {count} frames of {}..={sent_count}",
                    self.given_count
                );
                io::Error::new(io::ErrorKind::InvalidData, text)
            })
    }

    /// The peer has taken so many frames.
    fn forget_until(&mut self, given_count: u64) -> io::Result<()> {
        let given = self.kept_before(given_count)?;
        for frame in self.kept.drain(..given) {
            self.kept_bytes -= frame.len() + FRAME_COST_BYTES;
        }
        self.given_count = given_count;
        Ok(())
    }

    fn hang_up(&mut self) {
        if let Some(stream) = self.stream.take() {
            let _already_closed = stream.shutdown(Shutdown::Both).is_err();
        }
    }
}

/// Why a connection over which `error` came is cut.
fn cause_of(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => "it ended".to_owned(),
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => {
            format!("nothing came for {} s", SILENCE_MAX.as_secs())
        }
        _ => error.to_string(),
    }
}
