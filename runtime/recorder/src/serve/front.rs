//! The door of the socket: reads the head of each request, lets pass who may look on, and hands
//! bytes on both ways between viewers and the library's server.
//!
//! That server can only be had on a TCP port and asks nobody who they are: it is behind a [`Gate`].

use std::io;
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::Duration;

use nix::sys::socket::{setsockopt, sockopt};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, oneshot};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{sleep, timeout};

use super::access::{Access, Refusal};
use super::gate::Gate;
use super::head::{Head, Parsed, parse};
use super::token;

/// Viewers at once.
const SEATS: usize = 32;
/// Connections at once that have not said yet what they want; more wait.
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
const UNREAD_BYTES_MAX: u64 = 64 * 1024;
/// Bytes on their way in this process, per viewer and way.
const BUFFER_BYTES: usize = 32 * 1024;
/// Bytes that the kernel keeps for a slow viewer, at either end of our part of the way. Without a
/// bound it would keep megabytes, and what a viewer sees would be as old as they are.
const KERNEL_BYTES: u32 = 128 * 1024;
/// How long a viewer may neither acknowledge nor have room for what it is sent: one whose cable was
/// pulled says no goodbye, and would keep its seat for the kernel's two hours.
const GONE_AFTER: Duration = Duration::from_secs(30);
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
/// `kernel_bytes` for each.
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
        });
        let (close, closed) = oneshot::channel();
        let task = runtime.spawn(attend(listener, context, closed));
        Self { close, task }
    }

    /// Lets nobody in any more, and closes all connections: those of polite viewers, who have heard
    /// the server's goodbye, are at their end already.
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
}

/// Takes connections until it is told to end, then waits for those that are there.
async fn attend(
    listener: TcpListener,
    context: Arc<ServerContext>,
    mut closed: oneshot::Receiver<()>,
) {
    // Dropped with this, and all connections with it.
    let mut connections = JoinSet::new();
    let entering = Arc::new(Semaphore::new(ENTERING_MAX));
    loop {
        let next = async {
            let place = Arc::clone(&entering).acquire_owned().await;
            (place, listener.accept().await)
        };
        tokio::select! {
            _ = &mut closed => break,
            Some(_) = connections.join_next() => {}
            (place, accepted) = next => match accepted {
                Ok((viewer, _)) => {
                    let context = Arc::clone(&context);
                    connections.spawn(async move {
                        // Whoever goes away in the middle is nobody's fault.
                        let _is_served = serve(viewer, &context, place).await.is_ok();
                    });
                }
                Err(_) => sleep(PAUSE).await,
            },
        }
    }
    drop(listener);
    while connections.join_next().await.is_some() {}
}

/// One connection; `place` is its place among those that enter.
async fn serve<P>(mut viewer: TcpStream, context: &ServerContext, place: P) -> io::Result<()> {
    viewer.set_nodelay(true)?;
    let mut bytes = Vec::new();
    let head = match timeout(HEAD_WITHIN, read_head(&mut viewer, &mut bytes)).await {
        // Browsers open connections that they may need, and say nothing.
        Err(_) if bytes.is_empty() => return Ok(()),
        Err(_) => Err(Refusal::TooSlow),
        Ok(head) => match head? {
            Some(head) => head,
            None => return Ok(()),
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
        Ok((mut server, _seat)) => {
            drop(place);
            server.write_all(&bytes).await?;
            drop(bytes);
            hand_on(&mut viewer, &mut server).await
        }
        Err(refusal) => {
            context.access.count(&refusal);
            refuse(&mut viewer, &refusal).await
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
            match parse(bytes) {
                Parsed::Whole(head) => return Ok(Some(Ok(head))),
                Parsed::Broken => return Ok(Some(Err(Refusal::Malformed))),
                Parsed::Partial => {}
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
    let (code, word) = refusal.status();
    let words = refusal.words();
    let answer = format!(
        "HTTP/1.1 {code} {word}\r\nContent-Type: text/plain; charset=utf-8\r\n\
         X-Content-Type-Options: nosniff\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{words}\n",
        words.len() + 1
    );
    let goodbye = async {
        viewer.write_all(answer.as_bytes()).await?;
        viewer.shutdown().await?;
        tokio::io::copy(&mut viewer.take(UNREAD_BYTES_MAX), &mut tokio::io::sink()).await
    };
    timeout(CLOSE_WITHIN, goodbye)
        .await
        .map_or(Ok(()), |done| done.map(drop))
}

/// Hands bytes on both ways until both sides have ended, or one has failed.
async fn hand_on(viewer: &mut TcpStream, server: &mut TcpStream) -> io::Result<()> {
    let (from_viewer, to_viewer) = viewer.split();
    let (from_server, to_server) = server.split();
    let up = pass(from_viewer, to_server);
    let down = pass(from_server, to_viewer);
    tokio::pin!(up, down);
    tokio::select! {
        // The server ends when it hears the end, and what it still says is the viewer's.
        done = &mut up => {
            done?;
            down.await
        }
        // A viewer that hangs would keep its place for ever.
        done = &mut down => {
            done?;
            timeout(CLOSE_WITHIN, up).await.unwrap_or(Ok(()))
        }
    }
}

/// Hands bytes on one way, and their end.
async fn pass(from: ReadHalf<'_>, mut to: WriteHalf<'_>) -> io::Result<()> {
    let mut from = BufReader::with_capacity(BUFFER_BYTES, from);
    tokio::io::copy_buf(&mut from, &mut to).await?;
    to.shutdown().await
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::net::{Ipv4Addr, TcpListener as StdListener, TcpStream as StdStream};
    use std::thread;

    use tokio::runtime::{Builder, Runtime};

    use super::*;
    use crate::serve::gate::hidden_address;

    const REQUEST: &[u8] = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
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

    #[test]
    fn all_bytes_and_their_end_get_through_both_ways() {
        const BYTES: usize = 3_000_000;
        let (listener, server) = listener();
        let answering = thread::spawn(move || {
            let mut stream = accepted(&listener);
            let mut bytes = Vec::new();
            stream.read_to_end(&mut bytes).unwrap();
            // Only now, when the other way is closed already.
            stream.write_all(&bytes).unwrap();
        });
        let (address, front, runtime) = door(server);
        let mut stream = viewer(address);
        let body: Vec<u8> = (0..=250).cycle().take(BYTES).collect();
        stream.write_all(&body).unwrap();
        let sent = [REQUEST, &body].concat();
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        let mut received = Vec::new();
        stream.read_to_end(&mut received).unwrap();
        assert!(
            received == sent,
            "{} of {} bytes",
            received.len(),
            sent.len()
        );
        answering.join().unwrap();
        front.end(runtime.handle());
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

    /// Writes to the next connection, until that fails, more than there is room for on the way.
    fn writing_on(listener: &StdListener) -> thread::JoinHandle<io::Result<()>> {
        let mut inside = accepted(listener);
        thread::spawn(move || inside.write_all(&vec![0; 50_000_000]))
    }

    /// Our part of the way has ended: its other end did not only wait in vain.
    fn assert_closed(writing: thread::JoinHandle<io::Result<()>>) {
        let kind = writing.join().unwrap().unwrap_err().kind();
        let in_vain = [io::ErrorKind::WouldBlock, io::ErrorKind::TimedOut];
        assert!(!in_vain.contains(&kind), "{kind}");
    }
}
