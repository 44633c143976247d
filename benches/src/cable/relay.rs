//! The least that can stand in a cable's place: the same inlet, and one thread that sends each frame as one
//! datagram to its like on the other host and puts in what comes from there. No header, account or seal. A
//! frame too long for a datagram of the path is cut by IP.

use std::io;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::os::fd::AsFd as _;
use std::os::unix::process::CommandExt as _;
use std::process::{self, Command, Stdio, exit};
use std::{env, thread};

use hil_cable::{CableClient, CableServer, GivenEnd, Inlet, Inside};
use hil_net::handover;
use hil_net::packet_ring::FrameSender;
use hil_platform::own_process;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::Signal;

use crate::gateway::hosts::SetupError;

/// Frames that go one way before the other way is looked at.
const AT_ONCE: usize = 64;
/// The first word of the helper's arguments; see [`become_program`].
pub const INSIDE: &str = "--inside";

/// Starts `program` behind a cable and carries its frames between the addresses `ends`, here and there, until it
/// ends. Waits for both in the kernel, or without end with `spins`, giving the processor to others in between.
///
/// # Errors
/// When there can be no cable, or it breaks.
pub fn run(
    ends: [SocketAddr; 2],
    inside: IpAddr,
    spins: bool,
    program: &[String],
) -> Result<(), SetupError> {
    let socket = UdpSocket::bind(ends[0])?;
    socket.connect(ends[1])?;
    socket.set_nonblocking(true)?;
    let (here, there) = handover::pair()?;
    let mut helper = own_process::again();
    helper.args([INSIDE, &inside.to_string()]).args(program);
    let mut child = helper.stdin(Stdio::from(there)).spawn()?;
    drop(helper);
    let path = env::temp_dir().join(format!("hil-relay-{}", process::id()));
    let mut server = CableServer::open(&path, here)?;
    let mut fetched = || -> Result<(CableClient, GivenEnd), SetupError> {
        let client = CableClient::at(&path)?.ok_or("no server")?;
        server.attend()?;
        let end = client.take()?.ok_or("the server gives no end")?;
        Ok((client, end))
    };
    let (_, end) = fetched()?;
    let sender = end.into_sender();
    let (client, end) = fetched()?;
    let mut inlet = end.into_inlet()?;
    inlet.begin()?;
    client.begin_program()?;
    server.attend()?;
    drop(server);
    thread::spawn(move || {
        exit(i32::from(
            !child.wait().is_ok_and(|status| status.success()),
        ))
    });
    carry(&mut inlet, &sender, &socket, spins)
}

fn carry(
    inlet: &mut Inlet,
    sender: &FrameSender,
    socket: &UdpSocket,
    spins: bool,
) -> Result<(), SetupError> {
    let mut buffer = vec![0; 1 << 16];
    loop {
        let mut has_moved = false;
        for _ in 0..AT_ONCE {
            // What finds no room is lost, as the relay at the other end may be.
            if !inlet.next_frame(|_stamp, frame| _ = socket.send(frame).is_err()) {
                break;
            }
            has_moved = true;
        }
        for _ in 0..AT_ONCE {
            let Ok(length) = socket.recv(&mut buffer) else {
                break;
            };
            let _refused = sender.send(&buffer[..length]).is_err();
            has_moved = true;
        }
        if spins {
            thread::yield_now();
        } else if !has_moved {
            let readable = |fd| PollFd::new(fd, PollFlags::POLLIN);
            let mut waited = [readable(inlet.descriptor()), readable(socket.as_fd())];
            poll(&mut waited, PollTimeout::NONE)?;
        }
    }
}

/// Enters namespaces with one interface that has the address `inside`, gives the other end of the cable away over
/// the standard input, and becomes `program`. This process must have one thread. It returns why it could not.
pub fn become_program(inside: IpAddr, program: &[String]) -> SetupError {
    let entered = || -> Result<bool, SetupError> {
        set_pdeathsig(Signal::SIGKILL)?;
        let control = io::stdin();
        match hil_cable::enter(&Inside { address: inside }) {
            Ok(end) => hil_cable::hand_over(control.as_fd(), &end)?,
            Err(refusal) => {
                hil_cable::refuse(control.as_fd(), &refusal)?;
                return Err(refusal.into());
            }
        }
        Ok(hil_cable::await_go(control.as_fd())?)
    };
    match (entered(), program) {
        (Ok(true), [name, arguments @ ..]) => {
            let mut command = Command::new(name);
            command.args(arguments).stdin(Stdio::null()).exec().into()
        }
        (Ok(_), _) => "the relay is gone".into(),
        (Err(error), _) => error,
    }
}
