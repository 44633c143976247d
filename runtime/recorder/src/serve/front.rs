//! The door of the socket: reads the head of each request and lets pass who may look on;
//! [`super::passage`] hands their messages on.
//!
//! That server can only be had on a TCP port and checks no identity: it is behind a [`Gate`].

use std::collections::VecDeque;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::Duration;

use nix::sys::socket::{setsockopt, sockopt};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::task::{AbortHandle, JoinHandle, JoinSet};
use tokio::time::{sleep, timeout};

use super::access::{Access, Refusal};
use super::gate::Gate;
use super::head::{Head, head_bytes, parse};
use super::passage::{AllViewers, End, GONE_AFTER, pass};
use super::token;

/// Viewers at once.
pub(super) const SEATS: usize = 32;
/// Connections at once that have not said yet what they want; for a further one an old one goes.
const ENTERING_MAX: usize = 64;
/// A browser's head has a few hundred bytes, and what it adds of its own.
const HEAD_BYTES_MAX: usize = 16 * 1024;
/// How long it may take to come.
const HEAD_WITHIN: Duration = Duration::from_secs(5);
/// How long the library's server, on this machine, may take to answer.
const SERVER_WITHIN: Duration = Duration::from_secs(5);
/// How long one side may take to close after the other has.
const CLOSE_WITHIN: Duration = Duration::from_secs(1);
/// As much of what a refused viewer sends on is read away: a connection that is closed with unread
/// bytes in it is reset, and the answer lost.
const UNREAD_BYTES_MAX: u64 = 512 * 1024;
/// Bytes that the kernel keeps for a slow viewer, at either end of our part of the way. Without a
/// bound it would keep megabytes, and what a viewer sees would be as old as they are.
const KERNEL_BYTES: u32 = 128 * 1024;
/// Out of file descriptors, mostly: others must close first.
const PAUSE: Duration = Duration::from_millis(50);

/// Has the kernel close a connection of `socket`, and of those that it accepts, when the other side has
/// acknowledged nothing, or had no room for anything, for so long. It is asked when there is nothing to send.
///
/// # Errors
/// When the kernel does not know these options.
fn let_go_after(socket: &impl AsFd, time: Duration) -> io::Result<()> {
    let whole = |number: u128| u32::try_from(number).unwrap_or(u32::MAX);
    let asked_every_s = whole(u128::from(time.as_secs() / 3).max(1));
    setsockopt(socket, sockopt::KeepAlive, &true)?;
    setsockopt(socket, sockopt::TcpKeepIdle, &asked_every_s)?;
    setsockopt(socket, sockopt::TcpKeepInterval, &asked_every_s)?;
    setsockopt(socket, sockopt::TcpUserTimeout, &whole(time.as_millis()))?;
    Ok(())
}

/// Listens at `address`. Connections that take nothing for `gone_after` are closed, and the kernel keeps
/// `kernel_bytes` for each way of each.
///
/// # Errors
/// When the address cannot be had.
pub(super) fn listen(
    runtime: &Handle,
    address: SocketAddr,
    gone_after: Duration,
    kernel_bytes: u32,
) -> io::Result<TcpListener> {
    let _entered = runtime.enter();
    let socket = match address {
        SocketAddr::V4(_) => TcpSocket::new_v4()?,
        SocketAddr::V6(_) => TcpSocket::new_v6()?,
    };
    socket.set_reuseaddr(true)?;
    // Handed down to the connections.
    let_go_after(&socket, gone_after)?;
    socket.set_send_buffer_size(kernel_bytes)?;
    socket.set_recv_buffer_size(kernel_bytes)?;
    socket.bind(address)?;
    socket.listen(1024)
}

/// The port that viewers connect to; nobody is let in yet.
///
/// # Errors
/// When it cannot be had.
pub(super) fn viewer_listener(runtime: &Handle, address: SocketAddr) -> io::Result<TcpListener> {
    listen(runtime, address, GONE_AFTER, KERNEL_BYTES)
}

/// The open door.
#[derive(Debug)]
pub(super) struct Front {
    close: oneshot::Sender<()>,
    task: JoinHandle<()>,
    context: Arc<ServerContext>,
}

impl Front {
    /// Lets those who come to `listener` in to the library's server behind `server`, if `access` does.
    /// `page_port` is that of our own page.
    pub(super) fn open(
        runtime: &Handle,
        listener: TcpListener,
        server: Gate,
        access: Arc<Access>,
        page_port: u16,
    ) -> Self {
        let context = Arc::new(ServerContext {
            access,
            page_port,
            server,
            seats: Arc::new(Semaphore::new(SEATS)),
            all: AllViewers::default(),
        });
        let (close, closed) = oneshot::channel();
        let task = runtime.spawn(attend(listener, Arc::clone(&context), closed));
        Self {
            close,
            task,
            context,
        }
    }

    /// The library is about to send all viewers its closing frame.
    pub(super) fn announce_end(&self) {
        self.context.all.end();
    }

    /// Lets nobody in any more, and closes all connections: those of viewers that have closed, after the
    /// server's closing frame, are at their end already.
    pub(super) fn end(self, runtime: &Handle) {
        // It fails where there is nobody to hear it, which is as well.
        let _is_heard = self.close.send(()).is_ok();
        let mut task = self.task;
        let ended = runtime.block_on(async { timeout(CLOSE_WITHIN, &mut task).await });
        if ended.is_err() {
            task.abort();
        }
    }
}

/// What all connections need.
#[derive(Debug)]
struct ServerContext {
    access: Arc<Access>,
    page_port: u16,
    server: Gate,
    seats: Arc<Semaphore>,
    all: AllViewers,
}

/// One that may look on, and the library's server for it.
#[derive(Debug)]
struct Admitted {
    viewer: End,
    server: TcpStream,
    _seat: OwnedSemaphorePermit,
}

/// Tasks of connections of which at most so many go on.
#[derive(Debug)]
pub(super) struct Newest {
    max: usize,
    tasks: VecDeque<(IpAddr, AbortHandle)>,
}

impl Newest {
    pub(super) const fn new(max: usize) -> Self {
        Self {
            max,
            tasks: VecDeque::new(),
        }
    }

    /// Adds one; whether another was ended for it: the oldest of the address that has most of them.
    pub(super) fn admit(&mut self, address: IpAddr, task: AbortHandle) -> bool {
        self.tasks.retain(|(_, task)| !task.is_finished());
        let is_full = self.tasks.len() >= self.max;
        if is_full {
            let of = |address: IpAddr| self.tasks.iter().filter(|one| one.0 == address).count();
            let most = self.tasks.iter().map(|one| of(one.0)).max().unwrap_or(0);
            let oldest = self.tasks.iter().position(|one| of(one.0) == most);
            if let Some((_, task)) = oldest.and_then(|oldest| self.tasks.remove(oldest)) {
                task.abort();
            }
        }
        self.tasks.push_back((address, task));
        is_full
    }
}

/// Takes connections until it is told to end, then waits for those that are there.
async fn attend(
    listener: TcpListener,
    context: Arc<ServerContext>,
    mut closed: oneshot::Receiver<()>,
) {
    // Dropped with this, and all connections with them.
    let mut entering = JoinSet::new();
    let mut admitted = JoinSet::new();
    let mut newest = Newest::new(ENTERING_MAX);
    loop {
        tokio::select! {
            _ = &mut closed => break,
            Some(entered) = entering.join_next() => {
                // Whoever goes away in the middle is nobody's fault.
                if let Ok(Ok(Some(one))) = entered {
                    admitted.spawn(hand_on(one, Arc::clone(&context)));
                }
            }
            Some(_) = admitted.join_next() => {}
            accepted = listener.accept() => match accepted {
                Ok((viewer, from)) => {
                    let task = entering.spawn(enter(viewer, Arc::clone(&context)));
                    if newest.admit(from.ip(), task) {
                        context.access.count(&Refusal::Crowded(ENTERING_MAX));
                    }
                }
                Err(_) => sleep(PAUSE).await,
            },
        }
    }
    drop(listener);
    drop(entering);
    while admitted.join_next().await.is_some() {}
}

/// Judges one connection; `None` where it is refused.
async fn enter(mut viewer: TcpStream, context: Arc<ServerContext>) -> io::Result<Option<Admitted>> {
    viewer.set_nodelay(true)?;
    let mut bytes = Vec::new();
    let head = match timeout(HEAD_WITHIN, read_head(&mut viewer, &mut bytes)).await {
        // Browsers open connections that they may need, and say nothing.
        Err(_) if bytes.is_empty() => return Ok(None),
        Err(_) => Err(Refusal::TooSlow),
        Ok(head) => match head? {
            Some(head) => head,
            None => return Ok(None),
        },
    };
    let judged = head.and_then(|head| {
        let is_own = || token::is_own(&viewer);
        context.access.admit(&head, context.page_port, is_own)
    });
    let seat = judged.and_then(|()| {
        let seat = Arc::clone(&context.seats).try_acquire_owned();
        seat.map_err(|_none| Refusal::Full(SEATS))
    });
    let server = match seat {
        Ok(seat) => connect(&context.server).await.map(|server| (server, seat)),
        Err(refusal) => Err(refusal),
    };
    match server {
        Ok((server, seat)) => {
            let viewer = End {
                stream: viewer,
                read: bytes,
            };
            Ok(Some(Admitted {
                viewer,
                server,
                _seat: seat,
            }))
        }
        Err(refusal) => {
            context.access.count(&refusal);
            refuse(&mut viewer, &refusal).await.map(|()| None)
        }
    }
}

/// Reads the head of a request, and whatever came with it, into `bytes`; `None` when the other side
/// ends before its head does.
async fn read_head(
    viewer: &mut TcpStream,
    bytes: &mut Vec<u8>,
) -> io::Result<Option<Result<Head, Refusal>>> {
    loop {
        let read = bytes.len();
        if (&mut *viewer).take(4096).read_buf(bytes).await? == 0 {
            return Ok(None);
        }
        // A head can only end where a line does.
        if bytes[read..].contains(&b'\n') {
            let parsed = parse(bytes);
            if parsed.is_some() {
                return Ok(parsed);
            }
        }
        if bytes.len() >= HEAD_BYTES_MAX {
            return Ok(Some(Err(Refusal::TooLong)));
        }
    }
}

async fn connect(server: &Gate) -> Result<TcpStream, Refusal> {
    let connect = async {
        // The library stops listening for good when it has no descriptor for a connection.
        let spare = TcpSocket::new_v4()?;
        let socket = TcpSocket::new_v4()?;
        drop(spare);
        socket.set_recv_buffer_size(KERNEL_BYTES)?;
        let stream = server.connect(socket).await?;
        stream.set_nodelay(true)?;
        Ok::<_, io::Error>(stream)
    };
    let connected = timeout(SERVER_WITHIN, connect).await;
    let connected = connected.unwrap_or_else(|late| Err(late.into()));
    connected.map_err(|why| Refusal::NoServer(why.to_string()))
}

/// Says no, and why.
async fn refuse(viewer: &mut TcpStream, refusal: &Refusal) -> io::Result<()> {
    let status = refusal.status();
    let words = refusal.words();
    let answer = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\n\
         X-Content-Type-Options: nosniff\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{words}\n",
        words.len() + 1
    );
    timeout(CLOSE_WITHIN, viewer.write_all(answer.as_bytes())).await??;
    close(viewer).await
}

/// Closes a connection so that the last that was said arrives.
async fn close(viewer: &mut TcpStream) -> io::Result<()> {
    let closing = async {
        viewer.shutdown().await?;
        tokio::io::copy(&mut viewer.take(UNREAD_BYTES_MAX), &mut tokio::io::sink()).await
    };
    timeout(CLOSE_WITHIN, closing)
        .await
        .map_or(Ok(()), |done| done.map(drop))
}

/// Hands the request on, and after it messages, until a side closes.
async fn hand_on(admitted: Admitted, context: Arc<ServerContext>) -> io::Result<()> {
    let Admitted {
        mut viewer,
        mut server,
        _seat,
    } = admitted;
    let messages = viewer.read.split_off(head_bytes(&viewer.read).unwrap_or(0));
    let request = std::mem::replace(&mut viewer.read, messages);
    server.write_all(&request).await?;
    let mut answer = Vec::new();
    let head = timeout(SERVER_WITHIN, async {
        loop {
            let is_end = (&mut server).take(4096).read_buf(&mut answer).await? == 0;
            let head = head_bytes(&answer);
            if is_end || head.is_some() || answer.len() >= HEAD_BYTES_MAX {
                return Ok::<_, io::Error>(head);
            }
        }
    });
    let head = head.await??;
    let is_agreed = |head: &usize| *head > 0 && answer.starts_with(b"HTTP/1.1 101 ");
    let Some(head) = head.filter(is_agreed) else {
        // The library says what is wrong with the request, and closes.
        viewer.stream.write_all(&answer).await?;
        let mut rest = server.take(UNREAD_BYTES_MAX);
        let rest = tokio::io::copy(&mut rest, &mut viewer.stream);
        timeout(SERVER_WITHIN, rest).await??;
        return close(&mut viewer.stream).await;
    };
    let read = answer.split_off(head);
    viewer.stream.write_all(&answer).await?;
    let server = End {
        stream: server,
        read,
    };
    let (mut stream, done) = pass(viewer, server, &context.all).await;
    if let Err(excess) = done {
        context.access.count(&Refusal::Excess(excess));
    }
    close(&mut stream).await
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::net::{Ipv4Addr, TcpListener as StdListener, TcpStream as StdStream};
    use std::thread;

    use tokio::runtime::{Builder, Runtime};
    use tokio_tungstenite::tungstenite::protocol::Role;
    use tokio_tungstenite::tungstenite::{Message, WebSocket};

    use super::*;
    use crate::serve::gate::hidden_address;

    const REQUEST: &[u8] = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
    const AGREED: &[u8] = b"HTTP/1.1 101 Switching Protocols\r\n\r\n";
    /// Nothing here takes a tenth of this on an overloaded machine.
    const LIMIT: Duration = Duration::from_mins(1);

    /// A door before what listens at `server`: its address, and what keeps it open.
    fn door(server: SocketAddr) -> (SocketAddr, Front, Runtime) {
        door_for(server, GONE_AFTER)
    }

    fn door_for(server: SocketAddr, gone_after: Duration) -> (SocketAddr, Front, Runtime) {
        let mut builder = Builder::new_multi_thread();
        let runtime = builder.worker_threads(2).enable_all().build().unwrap();
        let loopback = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
        let listener = listen(runtime.handle(), loopback, gone_after, KERNEL_BYTES).unwrap();
        let address = listener.local_addr().unwrap();
        let access = Arc::new(Access::new(&[], &[], None));
        let server = Gate::shut(server).unwrap();
        let front = Front::open(runtime.handle(), listener, server, access, 80);
        (address, front, runtime)
    }

    /// A viewer that has asked; whatever it waits for ends in time.
    fn viewer(address: SocketAddr) -> StdStream {
        let mut stream = StdStream::connect(address).unwrap();
        bounded(&stream);
        stream.write_all(REQUEST).unwrap();
        stream
    }

    /// The next connection to what is behind the door.
    fn accepted(listener: &StdListener) -> StdStream {
        listener.set_nonblocking(true).unwrap();
        let deadline = std::time::Instant::now() + LIMIT;
        loop {
            match listener.accept() {
                Ok((stream, _)) => {
                    stream.set_nonblocking(false).unwrap();
                    bounded(&stream);
                    return stream;
                }
                Err(error) => {
                    assert!(std::time::Instant::now() < deadline, "{error}");
                    thread::sleep(Duration::from_millis(5));
                }
            }
        }
    }

    fn bounded(stream: &StdStream) {
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        stream.set_write_timeout(Some(LIMIT)).unwrap();
    }

    fn listener() -> (StdListener, SocketAddr) {
        let listener = StdListener::bind((hidden_address().unwrap(), 0)).unwrap();
        let address = listener.local_addr().unwrap();
        (listener, address)
    }

    /// The server's end of a way whose request has come.
    fn agreed(mut stream: StdStream) -> WebSocket<StdStream> {
        let mut request = vec![0; REQUEST.len()];
        stream.read_exact(&mut request).unwrap();
        assert_eq!(request, REQUEST);
        stream.write_all(AGREED).unwrap();
        WebSocket::from_raw_socket(stream, Role::Server, None)
    }

    #[test]
    fn messages_and_their_end_get_through_both_ways() {
        let (listener, server) = listener();
        let answering = thread::spawn(move || {
            let mut inside = agreed(accepted(&listener));
            for _ in 0..3 {
                let message = inside.read().unwrap();
                // Many times as long, in one.
                let answer: String = message.to_text().unwrap().repeat(100);
                inside.send(Message::text(answer)).unwrap();
            }
            assert!(inside.read().unwrap().is_close());
        });
        let (address, front, runtime) = door(server);
        let mut stream = viewer(address);
        let mut head = vec![0; AGREED.len()];
        stream.read_exact(&mut head).unwrap();
        assert_eq!(head, AGREED);
        let mut outside = WebSocket::from_raw_socket(stream, Role::Client, None);
        for length in [0, 1, 100_000] {
            let text = "x".repeat(length);
            outside.send(Message::text(text.clone())).unwrap();
            assert_eq!(outside.read().unwrap(), Message::text(text.repeat(100)));
            // Answered by the door.
            outside.send(Message::Ping("now".into())).unwrap();
            assert_eq!(outside.read().unwrap(), Message::Pong("now".into()));
        }
        outside.close(None).unwrap();
        assert!(outside.read().unwrap().is_close());
        answering.join().unwrap();
        front.end(runtime.handle());
    }

    #[test]
    fn a_viewer_is_told_whether_the_library_closed_or_its_connection_ended() {
        for (closes, words) in [
            (true, "asked for more answers than could be sent"),
            (false, "the server ended the connection"),
        ] {
            let (listener, server) = listener();
            let (address, front, runtime) = door(server);
            let mut stream = viewer(address);
            let mut inside = agreed(accepted(&listener));
            if closes {
                inside.close(None).unwrap();
            }
            drop(inside);
            stream.read_exact(&mut [0; AGREED.len()]).unwrap();
            let mut outside = WebSocket::from_raw_socket(stream, Role::Client, None);
            let closed = outside.read().unwrap();
            assert!(closed.to_text().unwrap().contains(words), "{closed}");
            front.end(runtime.handle());
        }
    }

    #[test]
    fn what_is_wrong_with_a_request_is_the_librarys_to_say() {
        const NO: &[u8] = b"HTTP/1.1 400 Bad Request\r\n\r\nno";
        let (listener, server) = listener();
        let answering = thread::spawn(move || accepted(&listener).write_all(NO).unwrap());
        let (address, front, runtime) = door(server);
        let mut answer = Vec::new();
        viewer(address).read_to_end(&mut answer).unwrap();
        assert_eq!(answer, NO);
        answering.join().unwrap();
        front.end(runtime.handle());
    }

    #[test]
    fn a_further_connection_ends_the_oldest_of_the_address_with_most() {
        let mut builder = Builder::new_multi_thread();
        let runtime = builder.worker_threads(1).enable_all().build().unwrap();
        let mut newest = Newest::new(3);
        let [many, one] = [1, 2].map(|last| IpAddr::from([10, 0, 0, last]));
        let mut admit = |address| {
            let task = runtime.spawn(async { sleep(LIMIT).await });
            let is_full = newest.admit(address, task.abort_handle());
            (task, is_full)
        };
        let first = [one, many, many].map(&mut admit);
        assert!(first.iter().all(|(_, is_full)| !is_full));
        let (_last, is_full) = admit(one);
        assert!(is_full);
        let [(one, _), (many, _), (other, _)] = first;
        assert!(runtime.block_on(many).unwrap_err().is_cancelled());
        assert!(!one.is_finished() && !other.is_finished());
    }

    #[test]
    fn a_viewer_hears_that_there_is_nothing_to_see() {
        let (listener, server) = listener();
        let (address, front, runtime) = door(server);
        drop(listener);
        let mut stream = viewer(address);
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 503 "), "{answer}");
        assert!(
            answer.contains("cannot be reached: nothing of this process listens"),
            "{answer}"
        );
        front.end(runtime.handle());
        assert!(StdStream::connect(address).is_err());
    }

    #[test]
    fn one_that_neither_reads_nor_goes_does_not_keep_the_door_open() {
        let (listener, server) = listener();
        let (address, front, runtime) = door(server);
        let mut stream = viewer(address);
        let writing = writing_on(&listener);
        let mut first = [0; 1];
        stream.read_exact(&mut first).unwrap();
        front.end(runtime.handle());
        assert_closed(writing);
    }

    #[test]
    fn one_that_takes_nothing_for_long_loses_its_seat() {
        let (listener, server) = listener();
        let (address, front, runtime) = door_for(server, Duration::from_secs(1));
        let mut stream = viewer(address);
        let writing = writing_on(&listener);
        let mut first = [0; 1];
        stream.read_exact(&mut first).unwrap();
        assert_closed(writing);
        front.end(runtime.handle());
    }

    /// Sends to the next connection until that fails.
    fn writing_on(listener: &StdListener) -> thread::JoinHandle<io::Result<()>> {
        let mut inside = agreed(accepted(listener)).into_inner();
        // One of a topic, of 126 bytes.
        let message = [&[0x82, 126, 0, 126, 1][..], &[0; 125]]
            .concat()
            .repeat(500);
        thread::spawn(move || {
            loop {
                inside.write_all(&message)?;
            }
        })
    }

    /// Our part of the way has ended: its other end did not only wait in vain.
    fn assert_closed(writing: thread::JoinHandle<io::Result<()>>) {
        let kind = writing.join().unwrap().unwrap_err().kind();
        let in_vain = [io::ErrorKind::WouldBlock, io::ErrorKind::TimedOut];
        assert!(!in_vain.contains(&kind), "{kind}");
    }
}
