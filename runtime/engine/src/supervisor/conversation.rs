//! What two supervisors say to each other, over as many TCP connections as it takes. Each end counts the
//! frames it has taken and keeps those that the other has not; when a connection is cut, the next one
//! (`reconnect.rs`) goes on behind the last frame taken. What the frames mean is not here.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant as WallInstant};

use hil_core::time::Instant;
use hil_platform::clock::MonotonicClock;
use zeroize::Zeroizing;

use super::control_listener::GREETING_TIMEOUT;
use super::frame::{Frame, PeerMessage, read_frame, write_message};
use super::peer::{ControlHalves, ControlReader, ControlWriter, PeerEvent};
use super::reconnect::Reconnect;

/// Bytes of frames that are kept until the peer has taken them; then a sender waits.
const KEPT_BYTES_MAX: usize = 4 << 20;
/// How often the peer is told at least what was taken. A cut that only one end has noticed lasts this long at
/// most where a reset comes back: the kernel of the end that noticed it answers what is said over it with one.
/// Where the path drops that without a word, the first host, if it has not noticed, does not listen, and the other
/// end's calls are refused until its patience is over.
const ACKNOWLEDGE_PERIOD: Duration = Duration::from_millis(100);
/// Frames after which the peer is told at once.
const ACKNOWLEDGED_AT: u64 = 2;
/// How long the end of a conversation waits for the peer to take what it was sent last: longer than a cut.
const LAST_FRAMES_PATIENCE: Duration = Duration::from_secs(1);
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
}

#[derive(Debug)]
struct State {
    /// Frames that the peer is not known to have taken, oldest first.
    kept: VecDeque<Arc<Zeroizing<Vec<u8>>>>,
    kept_bytes: usize,
    /// Frames that it has taken: the number of the oldest kept one.
    given_count: u64,
    /// Frames taken here.
    taken_count: u64,
    stream: Option<TcpStream>,
    reader: Option<JoinHandle<()>>,
    /// Since when there is no connection, and why.
    down: Option<(Instant, String)>,
    cuts: Vec<Cut>,
    is_over: bool,
    write_limit: Duration,
}

impl Conversation {
    /// Goes on with `ends`, and with what `reconnect` finds after them. What the peer says goes to `inbox`.
    ///
    /// # Errors
    /// When there is no thread to be had.
    pub(super) fn begin(
        ends: ControlHalves,
        reconnect: Reconnect,
        inbox: SyncSender<PeerEvent>,
    ) -> io::Result<Arc<Self>> {
        let conversation = Arc::new(Self {
            state: Mutex::new(State {
                kept: VecDeque::new(),
                kept_bytes: 0,
                given_count: 0,
                // The first host's hello, which was read when the hosts met, is its first frame.
                taken_count: u64::from(!reconnect.is_called()),
                stream: None,
                reader: None,
                down: None,
                cuts: Vec::new(),
                is_over: false,
                write_limit: GREETING_TIMEOUT,
            }),
            changed: Condvar::new(),
            writer: Mutex::new(None),
        });
        conversation.go_on(ends, 0, &inbox)?;
        let kept = Arc::clone(&conversation);
        let keeping = thread::Builder::new()
            .name(format!("keep {}", reconnect.host()))
            .spawn(move || kept.keep(&reconnect, &inbox));
        if let Err(error) = keeping {
            conversation.end();
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

    /// Sends a frame, now or as soon as there is a connection again.
    ///
    /// # Errors
    /// When the conversation is over. It ends when there is no room for a frame within the time that a write may
    /// take: without that frame the peer would miss one.
    pub(super) fn send(&self, frame: Zeroizing<Vec<u8>>) -> io::Result<()> {
        let length = frame.len();
        let has_room =
            |state: &State| state.kept.is_empty() || state.kept_bytes + length <= KEPT_BYTES_MAX;
        let limit = self.state().write_limit;
        let state = self.wait_until(limit, has_room);
        if state.is_over {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        if !has_room(&state) {
            drop(state);
            self.end();
            return Err(io::ErrorKind::TimedOut.into());
        }
        drop(state);
        let frame = Arc::new(frame);
        let mut writer = self.writer();
        {
            let mut state = self.state();
            state.kept_bytes += length;
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

    /// A write may take so long from now on.
    ///
    /// # Errors
    /// When the system does not take the limit.
    pub(super) fn limit_writes(&self, limit: Duration) -> io::Result<()> {
        let mut state = self.state();
        state.write_limit = limit;
        let stream = state.stream.as_ref();
        stream.map_or(Ok(()), |stream| stream.set_write_timeout(Some(limit)))
    }

    /// Ends it without a word, so that whoever waits for it here notices at once.
    fn end(&self) {
        let mut state = self.state();
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
        self.end();
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
        drop(self.wait_until(LAST_FRAMES_PATIENCE, |state| state.kept.is_empty()));
        self.leave();
    }

    /// Goes on with a connection whose other end has taken `given_count` frames.
    fn go_on(
        self: &Arc<Self>,
        ends: ControlHalves,
        given_count: u64,
        inbox: &SyncSender<PeerEvent>,
    ) -> io::Result<()> {
        let ControlHalves {
            mut reader,
            writer: out,
        } = ends;
        reader.wait_for_ever()?;
        let stream = out.stream().try_clone()?;
        let mut writer = self.writer();
        let again: Vec<_> = {
            let mut state = self.state();
            if state.is_over {
                return Err(io::ErrorKind::BrokenPipe.into());
            }
            stream.set_write_timeout(Some(state.write_limit))?;
            state.forget_until(given_count)?;
            let (forwarding, inbox) = (Arc::clone(self), inbox.clone());
            let thread = thread::Builder::new().name("peer".to_owned());
            state.reader = Some(thread.spawn(move || forwarding.forward(reader, &inbox))?);
            state.stream = Some(stream);
            if let Some((since, cause)) = state.down.take() {
                let length = MonotonicClock::now().saturating_duration_since(since);
                state.cuts.push(Cut {
                    since,
                    length,
                    cause,
                });
            }
            state.kept.iter().cloned().collect()
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
    fn forward(&self, mut input: ControlReader, inbox: &SyncSender<PeerEvent>) {
        let cause = loop {
            match read_frame(&mut input) {
                Ok(Frame::Message(PeerMessage::Acknowledged(count))) => {
                    if let Err(error) = self.state().forget_until(count) {
                        break error.to_string();
                    }
                }
                Ok(Frame::Message(PeerMessage::Leaving)) => {
                    self.end();
                    let closed = PeerEvent::Closed("it closed the connection".to_owned());
                    let _nobody_listens = inbox.send(closed).is_err();
                    return;
                }
                Ok(frame) => {
                    if inbox.send(PeerEvent::Frame(frame)).is_err() {
                        return;
                    }
                    self.state().taken_count += 1;
                }
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                    break "it ended".to_owned();
                }
                Err(error) => break error.to_string(),
            }
            self.changed.notify_all();
        };
        self.note_cut(&cause);
    }

    /// Tells the peer what was taken, and gets a connection again whenever one was cut.
    fn keep(self: &Arc<Self>, reconnect: &Reconnect, inbox: &SyncSender<PeerEvent>) {
        while let Some(cause) = self.acknowledge_until_cut() {
            *self.writer() = None;
            // What came over the connection that was cut comes first.
            let reader = self.state().reader.take();
            let _panicked = reader.map(|reader| reader.join().is_err());
            let taken_count = self.state().taken_count;
            let made = reconnect.make(taken_count, || !self.state().is_over);
            let resumed = made.and_then(|(ends, given_count)| {
                let resumed = self.go_on(ends, given_count, inbox);
                resumed.map_err(|error| error.to_string())
            });
            if let Err(reason) = resumed {
                self.end();
                let text = format!("the connection was cut ({cause}), and {reason}");
                let _nobody_listens = inbox.send(PeerEvent::Closed(text)).is_err();
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
            let told = PeerMessage::Acknowledged(told_count);
            self.write(&mut self.writer(), |out| write_message(out, &told));
        }
    }
}

impl State {
    /// The peer has taken so many frames.
    fn forget_until(&mut self, given_count: u64) -> io::Result<()> {
        let sent_count = self.given_count + self.kept.len() as u64;
        if !(self.given_count..=sent_count).contains(&given_count) {
            let text = format!(
                "the peer says that it has taken {given_count} frames of {}..={sent_count}",
                self.given_count
            );
            return Err(io::Error::new(io::ErrorKind::InvalidData, text));
        }
        while self.given_count < given_count
            && let Some(frame) = self.kept.pop_front()
        {
            self.kept_bytes -= frame.len();
            self.given_count += 1;
        }
        Ok(())
    }

    fn hang_up(&mut self) {
        if let Some(stream) = self.stream.take() {
            let _already_closed = stream.shutdown(Shutdown::Both).is_err();
        }
    }
}
