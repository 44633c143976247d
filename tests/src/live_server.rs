//! A recorder that serves the live view on this host, and requests to its page.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::binary::hil_recorder_binary;
use crate::child::{ChildGuard, Finished};

const LIMIT: Duration = Duration::from_mins(1);

/// The server, and where it listens.
#[derive(Debug)]
pub struct LiveServer {
    /// The recorder.
    pub child: ChildGuard,
    /// Address of the page.
    pub page: String,
    /// Address of the socket for viewers.
    pub socket: String,
    /// What lets others than this user look on.
    pub token: String,
}

impl LiveServer {
    /// Starts it with these arguments.
    ///
    /// # Panics
    /// When it does not say where it listens.
    pub fn start(arguments: &[&str]) -> Self {
        Self::start_by(Command::new(hil_recorder_binary()), arguments)
    }

    /// As [`LiveServer::start`], by a command that ends in the recorder.
    ///
    /// # Panics
    /// As [`LiveServer::start`].
    pub fn start_by(mut command: Command, arguments: &[&str]) -> Self {
        command.args(["serve", "--port", "0", "--http-port", "0"]);
        let child = ChildGuard::spawn(command.args(arguments));
        let mut child = child.expect("a recorder starts");
        let listens = child.wait_for_output("for other users", LIMIT);
        listens.unwrap_or_else(|reason| panic!("{reason}"));
        let said = child.stdout_so_far();
        let at = |begin: &str| {
            let rest = said.split(begin).nth(1).expect("an address");
            let end = rest.find(['/', '\n']).unwrap_or(rest.len());
            rest[..end].to_owned()
        };
        let token = said.split("/?token=").nth(1).expect("a token");
        let token = token.split(' ').next().unwrap_or_default().to_owned();
        Self {
            token,
            page: at("http://"),
            socket: at("ws://"),
            child,
        }
    }

    /// Status, headers and body of a request for the page.
    ///
    /// # Panics
    /// When there is no answer.
    pub fn get(&self, request: &str) -> (String, String, String) {
        const ANSWERS: &str = "the page answers";
        let mut stream = TcpStream::connect(&self.page).expect(ANSWERS);
        stream.set_read_timeout(Some(LIMIT)).expect(ANSWERS);
        let host = &self.page;
        write!(
            stream,
            "{request} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
        )
        .expect(ANSWERS);
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).expect(ANSWERS);
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let (head, body) = text.split_once("\r\n\r\n").expect(ANSWERS);
        let (status, headers) = head.split_once("\r\n").expect(ANSWERS);
        let status = status.split(' ').nth(1).expect(ANSWERS).to_owned();
        (status, headers.to_lowercase(), body.to_owned())
    }

    /// Ends it as a user does.
    ///
    /// # Panics
    /// When it does not end well.
    pub fn end(mut self) -> Finished {
        self.child.signal(Signal::SIGINT).expect("it runs");
        let finished = self.child.wait_within(LIMIT);
        let finished = finished.unwrap_or_else(|reason| panic!("{reason}"));
        finished.assert_success();
        finished
    }
}
