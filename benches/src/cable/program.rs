//! Two programs that speak IP, one that asks and one that answers. They block, as most programs do. Each is told
//! what to do over a Unix socket with a path, which leads into any network namespace, by lines of text; its answers
//! are numbers. It ends when that socket does.

use std::fmt::Display;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use nix::unistd::Pid;

/// Its datagrams come back.
const ECHO_PORT: u16 = 7_001;
/// Its datagrams are counted.
const FLOOD_PORT: u16 = 7_002;
/// Its bytes are counted.
const STREAM_PORT: u16 = 7_003;
/// A lost datagram ends a trip, not the bench.
const TRIP_MAX: Duration = Duration::from_millis(200);
/// No end of a stream keeps the other waiting for longer.
const STREAM_MAX: Duration = Duration::from_secs(10);
/// How much longer than it was told a program may take.
const PATIENCE: Duration = Duration::from_secs(20);
/// Trips of a turn that are not measured.
const COLD_COUNT: u32 = 20;
/// What a stream is written in, bytes.
const BLOCK_BYTES: usize = 1 << 16;

/// A program as the bench has it.
#[derive(Debug)]
pub struct Program {
    control: BufReader<UnixStream>,
    /// The program itself.
    pub pid: Pid,
}

/// Where a program that is about to start will say that it is there.
#[derive(Debug)]
pub struct ControlListener {
    listener: UnixListener,
    path: PathBuf,
}

/// What a turn of trips gave.
#[derive(Debug, Default)]
pub struct Trips {
    /// Half of each round trip, nanoseconds.
    pub half_ns: Vec<u64>,
    /// Trips without an answer.
    pub lost_count: u64,
}

impl ControlListener {
    /// Opens one at `path`.
    ///
    /// # Errors
    /// The kernel's.
    pub fn open(path: &Path) -> io::Result<Self> {
        let listener = UnixListener::bind(path)?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            listener,
            path: path.to_owned(),
        })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The program, if it has come.
    ///
    /// # Errors
    /// When it has, and does not say who it is.
    pub fn answer(&self) -> io::Result<Option<Program>> {
        let control = match self.listener.accept() {
            Ok((control, _)) => control,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(error) => return Err(error),
        };
        control.set_nonblocking(false)?;
        let mut program = Program {
            control: BufReader::new(control),
            pid: Pid::from_raw(0),
        };
        let [pid] = program.hear(Duration::ZERO)?;
        program.pid = Pid::from_raw(i32::try_from(pid).map_err(io::Error::other)?);
        Ok(Some(program))
    }
}

impl Program {
    fn order(&mut self, order: impl Display) -> io::Result<()> {
        writeln!(self.control.get_mut(), "{order}")
    }

    fn hear_all(&mut self, length: Duration) -> io::Result<Vec<u64>> {
        let control = self.control.get_mut();
        control.set_read_timeout(Some(length + PATIENCE))?;
        let mut next = || {
            let mut number = [0; 8];
            self.control.read_exact(&mut number)?;
            Ok(u64::from_le_bytes(number))
        };
        let count = next()?;
        (0..count).map(|_| next()).collect()
    }

    fn hear<const N: usize>(&mut self, length: Duration) -> io::Result<[u64; N]> {
        let numbers = self.hear_all(length)?;
        let wrong = |numbers: Vec<u64>| io::Error::other(format!("a program said {numbers:?}"));
        numbers.try_into().map_err(wrong)
    }

    /// Has it make round trips of `bytes` of payload for `length`, one after the other, or one every `period`.
    ///
    /// # Errors
    /// When it is gone or does not answer in time.
    pub fn ping(&mut self, bytes: usize, length: Duration, period: Duration) -> io::Result<Trips> {
        let (length_us, period_us) = (length.as_micros(), period.as_micros());
        self.order(format_args!("ping {bytes} {length_us} {period_us}"))?;
        let mut numbers = self.hear_all(length)?;
        let lost_count = numbers.pop().unwrap_or(0);
        let half_ns = numbers.into_iter().map(|trip| trip / 2).collect();
        Ok(Trips {
            half_ns,
            lost_count,
        })
    }

    /// Has it send datagrams of `bytes` as fast as it can for `length`; how many.
    ///
    /// # Errors
    /// As [`Self::ping`].
    pub fn flood(&mut self, bytes: usize, length: Duration) -> io::Result<u64> {
        self.order(format_args!("flood {bytes} {}", length.as_micros()))?;
        let [count] = self.hear(length)?;
        Ok(count)
    }

    /// How many datagrams of a flood came to it since it was last asked, and from the first to the last of them.
    ///
    /// # Errors
    /// As [`Self::ping`].
    pub fn flooded(&mut self) -> io::Result<(u64, Duration)> {
        self.order("flooded")?;
        let [count, span_ns] = self.hear(Duration::ZERO)?;
        Ok((count, Duration::from_nanos(span_ns)))
    }

    /// Has it write into a connection for `length`; bits per second, until the other end had all of them, and 0 when
    /// the connection broke.
    ///
    /// # Errors
    /// As [`Self::ping`].
    pub fn stream(&mut self, length: Duration) -> io::Result<f64> {
        self.order(format_args!("stream {}", length.as_micros()))?;
        let [bytes, took_ns] = self.hear(length + STREAM_MAX)?;
        Ok(bytes as f64 * 8e9 / took_ns.max(1) as f64)
    }
}

fn say(control: &mut UnixStream, numbers: &[u64]) -> io::Result<()> {
    let words = [numbers.len() as u64];
    let words = words.iter().chain(numbers);
    let bytes: Vec<u8> = words.flat_map(|word| word.to_le_bytes()).collect();
    control.write_all(&bytes)
}

fn connect(control: &Path) -> io::Result<UnixStream> {
    let mut control = UnixStream::connect(control)?;
    say(&mut control, &[u64::from(std::process::id())])?;
    Ok(control)
}

/// The words of each order, until there are no more.
fn orders(control: &UnixStream) -> io::Result<impl Iterator<Item = (String, Vec<u64>)> + use<>> {
    let lines = BufReader::new(control.try_clone()?).lines();
    Ok(lines.map_while(Result::ok).map(|line| {
        let mut words = line.split(' ');
        let name = words.next().unwrap_or_default().to_owned();
        (name, words.filter_map(|word| word.parse().ok()).collect())
    }))
}

/// What came of a flood.
#[derive(Debug, Default)]
struct Flood {
    count: u64,
    first_and_last: Option<[Instant; 2]>,
}

fn any(port: u16) -> SocketAddr {
    (Ipv4Addr::UNSPECIFIED, port).into()
}

/// The program that answers.
///
/// # Errors
/// When a port is taken or nobody is at the other end of `control`.
pub fn echo(control: &Path) -> io::Result<()> {
    let echo = UdpSocket::bind(any(ECHO_PORT))?;
    let sink = UdpSocket::bind(any(FLOOD_PORT))?;
    let listener = TcpListener::bind(any(STREAM_PORT))?;
    let mut control = connect(control)?;
    thread::spawn(move || {
        let mut buffer = [0; 2_048];
        loop {
            // Its way back may fail while a cable is being made.
            if let Ok((length, from)) = echo.recv_from(&mut buffer) {
                let _lost = echo.send_to(&buffer[..length], from).is_err();
            }
        }
    });
    let flood = Arc::new(Mutex::new(Flood::default()));
    let counted = Arc::clone(&flood);
    thread::spawn(move || {
        let mut buffer = [0; 2_048];
        while sink.recv(&mut buffer).is_ok() {
            let now = Instant::now();
            let mut flood = counted.lock().unwrap_or_else(PoisonError::into_inner);
            flood.count += 1;
            flood.first_and_last.get_or_insert([now; 2])[1] = now;
        }
    });
    thread::spawn(move || {
        for stream in listener.incoming().map_while(Result::ok) {
            let _broken = count_bytes(stream).is_err();
        }
    });
    for _order in orders(&control)? {
        let flood = core::mem::take(&mut *flood.lock().unwrap_or_else(PoisonError::into_inner));
        let span = flood.first_and_last.map(|[first, last]| last - first);
        say(&mut control, &[flood.count, nanoseconds(span)])?;
    }
    Ok(())
}

fn nanoseconds(span: Option<Duration>) -> u64 {
    u64::try_from(span.unwrap_or_default().as_nanos()).unwrap_or(u64::MAX)
}

fn count_bytes(mut stream: TcpStream) -> io::Result<()> {
    stream.set_read_timeout(Some(STREAM_MAX))?;
    let mut buffer = vec![0; BLOCK_BYTES];
    let mut count = 0_u64;
    while let length @ 1.. = stream.read(&mut buffer)? {
        count += length as u64;
    }
    stream.write_all(&count.to_le_bytes())
}

/// The program that asks the one at `peer`.
///
/// # Errors
/// When it has no socket or nobody is at the other end of `control`.
pub fn ask(control: &Path, peer: IpAddr) -> io::Result<()> {
    let socket = UdpSocket::bind(any(0))?;
    socket.set_read_timeout(Some(TRIP_MAX))?;
    let mut control = connect(control)?;
    let mut number = 0;
    for (order, numbers) in orders(&control)? {
        let numbers: [u64; 3] = core::array::from_fn(|at| numbers.get(at).copied().unwrap_or(0));
        let [bytes, length_us, period_us] = numbers;
        let bytes = usize::try_from(bytes).map_err(io::Error::other)?;
        let answer = match order.as_str() {
            "ping" => {
                socket.connect((peer, ECHO_PORT))?;
                let [length, period] = [length_us, period_us].map(Duration::from_micros);
                ping(&socket, bytes, length, period, &mut number)
            }
            "flood" => {
                socket.connect((peer, FLOOD_PORT))?;
                vec![flood(&socket, bytes, Duration::from_micros(length_us))]
            }
            // A connection that breaks carried nothing.
            _ => stream(peer, Duration::from_micros(numbers[0])).unwrap_or(vec![0, 1]),
        };
        say(&mut control, &answer)?;
    }
    Ok(())
}

/// Round trips, nanoseconds, and last how many were lost.
fn ping(
    socket: &UdpSocket,
    bytes: usize,
    length: Duration,
    period: Duration,
    number: &mut u64,
) -> Vec<u64> {
    for _ in 0..COLD_COUNT {
        if trip(socket, bytes, number).is_none() {
            break;
        }
    }
    let began = Instant::now();
    let (mut trips, mut lost_count) = (Vec::new(), 0);
    let mut due = began;
    while began.elapsed() < length {
        match trip(socket, bytes, number) {
            Some(took_ns) => trips.push(took_ns),
            None => lost_count += 1,
        }
        if !period.is_zero() {
            // On a grid; a period that is over is left out.
            while due <= Instant::now() {
                due += period;
            }
            thread::sleep(due.saturating_duration_since(Instant::now()));
        }
    }
    trips.push(lost_count);
    trips
}

fn trip(socket: &UdpSocket, bytes: usize, number: &mut u64) -> Option<u64> {
    *number += 1;
    let mark = number.to_le_bytes();
    let mut buffer = [0; 2_048];
    buffer[..mark.len()].copy_from_slice(&mark);
    let began = Instant::now();
    socket.send(&buffer[..bytes]).ok()?;
    loop {
        let length = socket.recv(&mut buffer).ok()?;
        let took = began.elapsed();
        // An answer that came too late is none of this trip.
        if buffer[..length].starts_with(&mark) {
            return Some(nanoseconds(Some(took)));
        }
        if took > TRIP_MAX {
            return None;
        }
    }
}

fn flood(socket: &UdpSocket, bytes: usize, length: Duration) -> u64 {
    let began = Instant::now();
    let buffer = vec![0; bytes];
    let mut count = 0;
    while began.elapsed() < length {
        count += u64::from(socket.send(&buffer).is_ok());
    }
    count
}

/// Bytes that the other end had, and how long it took, nanoseconds.
fn stream(peer: IpAddr, length: Duration) -> io::Result<Vec<u64>> {
    let mut stream = TcpStream::connect_timeout(&(peer, STREAM_PORT).into(), STREAM_MAX)?;
    stream.set_write_timeout(Some(STREAM_MAX))?;
    stream.set_read_timeout(Some(STREAM_MAX))?;
    let block = vec![0; BLOCK_BYTES];
    let began = Instant::now();
    while began.elapsed() < length {
        stream.write_all(&block)?;
    }
    stream.shutdown(Shutdown::Write)?;
    let mut count = [0; 8];
    stream.read_exact(&mut count)?;
    let took_ns = nanoseconds(Some(began.elapsed()));
    Ok(vec![u64::from_le_bytes(count), took_ns])
}

#[cfg(test)]
mod tests {
    use hil_tests::run_folder::RunFolder;

    use super::*;

    #[test]
    fn both_programs_do_what_they_are_told_and_end_with_the_bench() {
        let folder = RunFolder::new("programs");
        let controls =
            ["near", "far"].map(|name| ControlListener::open(&folder.join(name)).unwrap());
        let [near, far] = [0, 1].map(|index: usize| controls[index].path().to_owned());
        let running = [
            thread::spawn(move || ask(&near, Ipv4Addr::LOCALHOST.into())),
            thread::spawn(move || echo(&far)),
        ];
        let [mut near, mut far] = controls.map(|control| {
            loop {
                if let Some(program) = control.answer().unwrap() {
                    break program;
                }
                thread::yield_now();
            }
        });
        let turn = Duration::from_millis(20);
        assert_eq!(near.pid, Pid::this());
        assert!(
            !near
                .ping(64, turn, Duration::ZERO)
                .unwrap()
                .half_ns
                .is_empty()
        );
        let paced = near.ping(64, turn, Duration::from_millis(5)).unwrap();
        assert!((1..=5).contains(&paced.half_ns.len()), "{paced:?}");
        assert!(near.flood(64, turn).unwrap() > 0);
        let came = far.flooded().unwrap();
        assert!(came.0 > 0 && came.1 > Duration::ZERO, "{came:?}");
        assert!(near.stream(turn).unwrap() > 0.0);
        drop((near, far));
        for program in running {
            program.join().unwrap().unwrap();
        }
    }
}
