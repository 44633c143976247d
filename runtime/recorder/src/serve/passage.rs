//! Messages of a viewer on their way to the library's server and back, within limits per viewer. The library
//! bounds its queues by messages, not by bytes, and neither the answers to pings nor the names of parameters
//! to whose updates a viewer subscribes.

use std::collections::{HashSet, VecDeque};
use std::future::pending;
use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt as _, StreamExt as _};
use serde::Deserialize;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::{Mutex as AsyncMutex, Notify};
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};

/// Bytes of a message from a viewer: a subscription to some 4000 topics.
const MESSAGE_BYTES_MAX: usize = 128 * 1024;
/// Bytes that a viewer may send at once, and those that it may send on in a second.
const BURST_BYTES: usize = 1024 * 1024;
const RATE_BYTES_PER_S: usize = 64 * 1024;
/// Parameters of whose changes a viewer is told, and the bytes of their names.
const NAMES_MAX: usize = 4096;
const NAME_BYTES_MAX: usize = 256 * 1024;
/// Bytes of topics that wait for one viewer; then its oldest messages go.
const DATA_BYTES_MAX: usize = 1024 * 1024;
/// Bytes of answers that may always wait for one viewer, and those for all of them together.
const ANSWER_BYTES_MAX: usize = 1024 * 1024;
const ALL_ANSWER_BYTES_MAX: usize = 32 * 1024 * 1024;
/// What a message takes beside its bytes.
const MESSAGE_COST_BYTES: usize = 128;
/// Bytes that are read at once.
const READ_BYTES: usize = 16 * 1024;
/// How long a viewer may take to hear why it is disconnected.
const REASON_WITHIN: Duration = Duration::from_secs(1);
/// How long a viewer may neither acknowledge nor have room for what it is sent: one whose cable was
/// pulled sends no closing frame, and would keep its seat for the kernel's two hours.
pub(super) const GONE_AFTER: Duration = Duration::from_secs(30);
/// First byte of a message of a topic.
const MESSAGE_DATA: u8 = 1;

/// Why a viewer that was let in is disconnected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub(crate) enum Excess {
    /// It sent too long a message.
    #[error("sent a message of more than {} KiB", MESSAGE_BYTES_MAX / 1024)]
    Message,
    /// It sent too much.
    #[error(
        "sent more than {} KiB at once and {} KiB a second",
        BURST_BYTES / 1024,
        RATE_BYTES_PER_S / 1024
    )]
    Rate,
    /// It subscribes to updates of too many parameters.
    #[error("subscribes to updates of more than {NAMES_MAX} parameters, or of names of more than {} KiB", NAME_BYTES_MAX / 1024)]
    Names,
    /// It asks for more than it takes, or than the library keeps.
    #[error("asked for more answers than could be sent")]
    Answers,
    /// It acknowledged nothing, or took nothing, for this long.
    #[error("took nothing for {} s", GONE_AFTER.as_secs())]
    Stalled,
    /// The library's side ended without a closing frame.
    #[error("was cut off: the server ended the connection")]
    Ended,
}

impl Excess {
    fn close_frame(self) -> CloseFrame {
        let code = match self {
            Self::Message => CloseCode::Size,
            Self::Ended => CloseCode::Error,
            _ => CloseCode::Policy,
        };
        CloseFrame {
            code,
            reason: format!("the viewer {self}").into(),
        }
    }
}

/// How the way of a viewer ended before either side closed it.
#[derive(Debug)]
enum Broken {
    Excess(Excess),
    /// By the library, and why.
    Refused(Excess),
    /// By the viewer.
    Gone,
}

impl From<Excess> for Broken {
    fn from(excess: Excess) -> Self {
        Self::Excess(excess)
    }
}

/// Of the viewer's end.
impl From<Error> for Broken {
    fn from(error: Error) -> Self {
        match error {
            Error::Capacity(_) => Self::Excess(Excess::Message),
            Error::Io(error) if error.kind() == io::ErrorKind::TimedOut => {
                Self::Excess(Excess::Stalled)
            }
            Error::Io(error) => {
                let inner = error.get_ref().and_then(|inner| inner.downcast_ref());
                inner.map_or(Self::Gone, |excess: &Excess| Self::Excess(*excess))
            }
            _ => Self::Gone,
        }
    }
}

/// One end of the way, and what was read of its messages already.
#[derive(Debug)]
pub(super) struct End {
    pub(super) stream: TcpStream,
    pub(super) read: Vec<u8>,
}

/// What all viewers have in common.
#[derive(Debug, Default)]
pub(super) struct AllViewers {
    /// Of the answers that wait for them.
    waiting_bytes: AtomicUsize,
    is_over: AtomicBool,
}

impl AllViewers {
    /// From now on the library sends its closing frame because the server ends.
    pub(super) fn end(&self) {
        self.is_over.store(true, Ordering::Release);
    }
}

/// Hands messages on both ways until one side closes. Gives the viewer's connection back, which has heard
/// the reason and of which nothing is read any more, and why the viewer was disconnected, if it was.
pub(super) async fn pass(
    viewer: End,
    server: End,
    all: &AllViewers,
) -> (TcpStream, Result<(), Excess>) {
    let limits = WebSocketConfig::default()
        .read_buffer_size(READ_BYTES)
        .write_buffer_size(0);
    let metered = Metered {
        stream: viewer.stream,
        allowance: Allowance::new(Instant::now()),
    };
    let viewer_limits = limits
        .max_message_size(Some(MESSAGE_BYTES_MAX))
        .max_frame_size(Some(MESSAGE_BYTES_MAX));
    let server_limits = limits.max_message_size(None).max_frame_size(None);
    let viewer = WebSocketStream::from_partially_read(
        metered,
        viewer.read,
        Role::Server,
        Some(viewer_limits),
    );
    let server = WebSocketStream::from_partially_read(
        server.stream,
        server.read,
        Role::Client,
        Some(server_limits),
    );
    let (to_viewer, mut from_viewer) = viewer.await.split();
    let (to_server, from_server) = server.await.split();
    let to_viewer = AsyncMutex::new(to_viewer);
    let outbox = Outbox::new(&all.waiting_bytes);
    let is_leaving = AtomicBool::new(false);
    let done = {
        let up = async {
            let mut to_server = to_server;
            hand_up(&mut from_viewer, &mut to_server, &to_viewer).await?;
            is_leaving.store(true, Ordering::Release);
            // It has gone if it does not hear it.
            let _is_heard = to_server.close().await.is_ok();
            Ok(())
        };
        let filled = async {
            let close = fill(from_server, &outbox).await?;
            let expected = [&is_leaving, &all.is_over];
            if expected.iter().any(|one| one.load(Ordering::Acquire)) {
                Ok(outbox.push(close.unwrap_or(Message::Close(None)))?)
            } else {
                // It keeps so many answers for a viewer and no more.
                Err(Broken::Refused(
                    close.map_or(Excess::Ended, |_close| Excess::Answers),
                ))
            }
        };
        let down = async { tokio::try_join!(filled, empty(&outbox, &to_viewer)).map(drop) };
        tokio::select! {
            done = up => done,
            done = down => done,
        }
    };
    let mut to_viewer = to_viewer.into_inner();
    let kept = match done {
        Err(Broken::Excess(excess)) => Err(excess),
        Err(Broken::Refused(excess)) if !all.is_over.load(Ordering::Acquire) => Err(excess),
        Ok(()) | Err(Broken::Refused(_) | Broken::Gone) => Ok(()),
    };
    if let Err(excess) = kept {
        let close = Message::Close(Some(excess.close_frame()));
        // One that takes nothing does not hear it.
        let _is_heard = timeout(REASON_WITHIN, to_viewer.send(close)).await.is_ok();
    }
    let stream = to_viewer.reunite(from_viewer).expect("two halves of one");
    (stream.into_inner().stream, kept)
}

type ToViewer = SplitSink<WebSocketStream<Metered>, Message>;

/// Hands on what a viewer says, but its pings: they are answered here, each before more is read, so that
/// the answers of a viewer that takes nothing do not pile up.
async fn hand_up(
    from_viewer: &mut SplitStream<WebSocketStream<Metered>>,
    to_server: &mut SplitSink<WebSocketStream<TcpStream>, Message>,
    to_viewer: &AsyncMutex<ToViewer>,
) -> Result<(), Broken> {
    let mut names = Names::default();
    while let Some(message) = from_viewer.next().await {
        match message? {
            Message::Ping(_) => to_viewer.lock().await.flush().await?,
            Message::Pong(_) | Message::Close(_) | Message::Frame(_) => {}
            message => {
                if let Message::Text(text) = &message {
                    names.note(text)?;
                }
                if to_server.send(message).await.is_err() {
                    // What was read of the other way tells how the library ended it.
                    return pending().await;
                }
            }
        }
    }
    Ok(())
}

/// Takes all that the server says, at once, so that its queues stay empty, until its closing frame, which it sends
/// at the end, or when a viewer asks for more answers at once than it keeps; `None` when it ends without one.
async fn fill(
    mut from_server: SplitStream<WebSocketStream<TcpStream>>,
    outbox: &Outbox<'_>,
) -> Result<Option<Message>, Excess> {
    while let Some(Ok(message)) = from_server.next().await {
        // Copied, as a part would keep the whole of what was read at once.
        match message {
            Message::Text(text) => outbox.push(Message::text(text.as_str().to_owned()))?,
            Message::Binary(bytes) => outbox.push(Message::binary(bytes.to_vec()))?,
            Message::Close(_) => return Ok(Some(message)),
            Message::Ping(_) | Message::Pong(_) | Message::Frame(_) => {}
        }
    }
    Ok(None)
}

/// Sends what waits, until the server's end has been sent.
async fn empty(outbox: &Outbox<'_>, to_viewer: &AsyncMutex<ToViewer>) -> Result<(), Broken> {
    loop {
        let message = outbox.pop().await;
        let is_last = message.is_close();
        to_viewer.lock().await.send(message).await?;
        if is_last {
            return Ok(());
        }
    }
}

/// Messages that wait for a viewer. Those of topics push out their oldest; all others are kept.
#[derive(Debug)]
struct Outbox<'a> {
    waiting: Mutex<Waiting>,
    news: Notify,
    /// Of the answers that wait for all viewers.
    all_bytes: &'a AtomicUsize,
}

/// In the order of their numbers.
#[derive(Debug, Default)]
struct Waiting {
    data: VecDeque<(u64, Message)>,
    data_bytes: usize,
    answers: VecDeque<(u64, Message)>,
    answer_bytes: usize,
    next: u64,
}

impl<'a> Outbox<'a> {
    fn new(all_bytes: &'a AtomicUsize) -> Self {
        Self {
            waiting: Mutex::default(),
            news: Notify::new(),
            all_bytes,
        }
    }

    /// # Errors
    /// When too much waits that must not be dropped.
    fn push(&self, message: Message) -> Result<(), Excess> {
        let bytes = cost_bytes(&message);
        let mut waiting = self.waiting();
        let number = waiting.next;
        waiting.next += 1;
        let is_data =
            matches!(&message, Message::Binary(bytes) if bytes.first() == Some(&MESSAGE_DATA));
        if is_data {
            waiting.data.push_back((number, message));
            waiting.data_bytes += bytes;
            // One that is longer than all that may wait is sent where it waits alone.
            while waiting.data_bytes > DATA_BYTES_MAX && waiting.data.len() > 1 {
                let oldest = waiting.data.pop_front();
                waiting.data_bytes -= oldest.map_or(0, |(_, oldest)| cost_bytes(&oldest));
            }
        } else {
            waiting.answers.push_back((number, message));
            waiting.answer_bytes += bytes;
            let all_bytes = self.all_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
            if waiting.answer_bytes > ANSWER_BYTES_MAX && all_bytes > ALL_ANSWER_BYTES_MAX {
                return Err(Excess::Answers);
            }
        }
        drop(waiting);
        self.news.notify_one();
        Ok(())
    }

    async fn pop(&self) -> Message {
        loop {
            if let Some(message) = self.try_pop() {
                return message;
            }
            self.news.notified().await;
        }
    }

    fn try_pop(&self) -> Option<Message> {
        let mut waiting = self.waiting();
        let first = |queue: &VecDeque<(u64, Message)>| queue.front().map(|(number, _)| *number);
        let (data, answer) = (first(&waiting.data), first(&waiting.answers));
        let is_data = data.is_some_and(|data| answer.is_none_or(|answer| data < answer));
        if is_data {
            let (_, message) = waiting.data.pop_front()?;
            waiting.data_bytes -= cost_bytes(&message);
            return Some(message);
        }
        let (_, message) = waiting.answers.pop_front()?;
        let bytes = cost_bytes(&message);
        waiting.answer_bytes -= bytes;
        self.all_bytes.fetch_sub(bytes, Ordering::Relaxed);
        Some(message)
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Outbox<'_> {
    fn drop(&mut self) {
        let bytes = self.waiting().answer_bytes;
        self.all_bytes.fetch_sub(bytes, Ordering::Relaxed);
    }
}

fn cost_bytes(message: &Message) -> usize {
    message.len() + MESSAGE_COST_BYTES
}

/// Names of parameters of whose changes a viewer is told.
#[derive(Debug, Default)]
struct Names {
    names: HashSet<String>,
    bytes: usize,
}

/// As much of a viewer's message as it takes to count these names; others are the library's to judge.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
enum Said {
    SubscribeParameterUpdates {
        parameter_names: Vec<String>,
    },
    UnsubscribeParameterUpdates {
        parameter_names: Vec<String>,
    },
    #[serde(other)]
    Other,
}

impl Names {
    fn note(&mut self, text: &str) -> Result<(), Excess> {
        match serde_json::from_str(text) {
            Ok(Said::SubscribeParameterUpdates { parameter_names }) => {
                for name in parameter_names {
                    let bytes = name.len();
                    if self.names.insert(name) {
                        self.bytes += bytes;
                    }
                }
            }
            Ok(Said::UnsubscribeParameterUpdates { parameter_names }) => {
                for name in &parameter_names {
                    if self.names.remove(name) {
                        self.bytes -= name.len();
                    }
                }
            }
            Ok(Said::Other) | Err(_) => {}
        }
        if self.names.len() > NAMES_MAX || self.bytes > NAME_BYTES_MAX {
            return Err(Excess::Names);
        }
        Ok(())
    }
}

/// Bytes that a viewer may still send.
#[derive(Debug)]
struct Allowance {
    bytes: f64,
    at: Instant,
}

impl Allowance {
    fn new(now: Instant) -> Self {
        Self {
            bytes: BURST_BYTES as f64,
            at: now,
        }
    }

    fn take(&mut self, count: usize, now: Instant) -> Result<(), Excess> {
        let more = now.duration_since(self.at).as_secs_f64() * RATE_BYTES_PER_S as f64;
        self.at = now;
        self.bytes = (self.bytes + more).min(BURST_BYTES as f64) - count as f64;
        if self.bytes < 0.0 {
            return Err(Excess::Rate);
        }
        Ok(())
    }
}

/// A connection of which no more is read than a viewer may send.
#[derive(Debug)]
struct Metered {
    stream: TcpStream,
    allowance: Allowance,
}

impl AsyncRead for Metered {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = bytes.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(context, bytes))?;
        let count = bytes.filled().len() - before;
        let taken = self.allowance.take(count, Instant::now());
        Poll::Ready(taken.map_err(io::Error::other))
    }
}

impl AsyncWrite for Metered {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn data(bytes: usize) -> Message {
        Message::binary(vec![MESSAGE_DATA; bytes])
    }

    #[test]
    fn the_oldest_of_the_topics_go_and_answers_keep_their_place() {
        let all = AtomicUsize::new(0);
        let outbox = Outbox::new(&all);
        outbox.push(data(1)).unwrap();
        outbox.push(Message::text("first")).unwrap();
        for index in 0..40 {
            outbox.push(data(100_000 + index)).unwrap();
        }
        outbox.push(Message::text("last")).unwrap();
        let sent: Vec<_> = std::iter::from_fn(|| outbox.try_pop()).collect();
        assert_eq!(sent.first(), Some(&Message::text("first")));
        assert_eq!(sent.last(), Some(&Message::text("last")));
        let kept: Vec<_> = sent[1..sent.len() - 1].iter().map(Message::len).collect();
        let expected: Vec<_> = (30..40).map(|index| 100_000 + index).collect();
        assert_eq!(kept, expected);
        assert_eq!(all.load(Ordering::Relaxed), 0);
        // One that is longer than all that may wait.
        outbox.push(data(2 * DATA_BYTES_MAX)).unwrap();
        assert_eq!(outbox.try_pop().unwrap().len(), 2 * DATA_BYTES_MAX);
    }

    #[test]
    fn one_that_does_not_take_its_answers_is_sent_away_and_others_are_not() {
        let all = AtomicUsize::new(0);
        let answer = || Message::text("x".repeat(100_000));
        let (first, second) = (Outbox::new(&all), Outbox::new(&all));
        let kept = (0..1000).take_while(|_| first.push(answer()).is_ok());
        let kept = kept.count() * 100_000;
        let is_kept = (ALL_ANSWER_BYTES_MAX * 9 / 10..ALL_ANSWER_BYTES_MAX).contains(&kept);
        assert!(is_kept, "{kept}");
        assert_eq!(first.push(answer()), Err(Excess::Answers));
        for _ in 0..10 {
            assert_eq!(second.push(answer()), Ok(()));
        }
        drop((first, second));
        assert_eq!(all.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn a_burst_and_a_rate_are_allowed_and_no_more() {
        let began = Instant::now();
        let mut allowance = Allowance::new(began);
        allowance.take(BURST_BYTES, began).unwrap();
        let later = began + Duration::from_secs(2);
        allowance.take(2 * RATE_BYTES_PER_S, later).unwrap();
        assert_eq!(allowance.take(1, later), Err(Excess::Rate));
    }

    #[test]
    fn names_are_counted_once_and_given_back() {
        let said = |op: &str, names: core::ops::Range<usize>| {
            let names: Vec<_> = names.map(|index| index.to_string()).collect();
            serde_json::json!({ "parameterNames": names, "op": op }).to_string()
        };
        let (more, fewer) = ("subscribeParameterUpdates", "unsubscribeParameterUpdates");
        let mut names = Names::default();
        for _ in 0..3 {
            names.note(&said(more, 0..NAMES_MAX)).unwrap();
        }
        names.note(&said(fewer, 0..1)).unwrap();
        names.note(&said(more, 0..1)).unwrap();
        names.note("{\"op\":\"subscribe\"}").unwrap();
        names.note("[").unwrap();
        assert_eq!(
            names.note(&said(more, 0..NAMES_MAX + 1)),
            Err(Excess::Names)
        );
        let long = "x".repeat(NAME_BYTES_MAX + 1);
        let text = serde_json::json!({ "op": more, "parameterNames": [long] }).to_string();
        assert_eq!(Names::default().note(&text), Err(Excess::Names));
    }
}
