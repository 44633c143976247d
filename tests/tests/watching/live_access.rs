//! Who may look on: the socket and the page of `hil-recorder serve` against pages of others, names that
//! may be anybody's, too many viewers, viewers that vanish and bytes that are no request. No run is needed for
//! that.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::process::Command;
use std::time::{Duration, Instant};
use std::{fs, thread};

use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::run;
use hil_tests::lab::{INTERFACE, Lab};
use hil_tests::live_server::LiveServer;

pub(super) const LIMIT: Duration = Duration::from_mins(1);
/// Four times as long as a viewer that says nothing keeps its seat.
const GONE_LIMIT: Duration = Duration::from_mins(2);
/// Viewers at once, as docs/live-view.md says.
const SEATS: usize = 32;
const EVIL: &str = "https://evil.example";

/// A server without a run.
fn start(options: &[&str]) -> LiveServer {
    start_by(Command::new(hil_recorder_binary()), options)
}

fn start_by(command: Command, options: &[&str]) -> LiveServer {
    let waits = ["--wait", "no-run-is-called-so"];
    LiveServer::start_by(command, &[&waits, options].concat())
}

/// Asks to look on, as a browser or a program does.
fn ask(server: &LiveServer, host: &str, origin: Option<&str>) -> Asked {
    Asked::to_look_on(&server.socket, host, origin)
}

/// The same at the socket with this address.
pub(super) fn ask_as_program(socket: &str) -> Asked {
    Asked::to_look_on(socket, socket, None)
}

/// A request that was sent.
pub(super) struct Asked {
    pub(super) stream: TcpStream,
}

impl Asked {
    fn to_look_on(address: &str, host: &str, origin: Option<&str>) -> Self {
        Self::with_token(address, host, origin, None)
    }

    pub(super) fn with_token(
        address: &str,
        host: &str,
        origin: Option<&str>,
        token: Option<&str>,
    ) -> Self {
        let origin = origin.map_or_else(String::new, |origin| format!("Origin: {origin}\r\n"));
        let query = token.map_or_else(String::new, |token| format!("?token={token}"));
        let request = format!(
            "GET /{query} HTTP/1.1\r\nHost: {host}\r\n{origin}Upgrade: websocket\r\n\
             Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
             Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        );
        Self::send(address, request.as_bytes())
    }

    pub(super) fn send(address: &str, bytes: &[u8]) -> Self {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        stream.write_all(bytes).unwrap();
        Self { stream }
    }

    /// Reads until these words have come.
    fn until(&mut self, words: &str) -> String {
        let mut seen = Vec::new();
        let mut bytes = [0; 4096];
        loop {
            let text = String::from_utf8_lossy(&seen).into_owned();
            if text.contains(words) {
                return text;
            }
            let count = self.stream.read(&mut bytes).unwrap();
            assert!(count > 0, "ended before {words:?}: {text}");
            seen.extend_from_slice(&bytes[..count]);
        }
    }

    /// All of the answer, to the end of the connection.
    fn answer(mut self) -> String {
        let mut bytes = Vec::new();
        self.stream.read_to_end(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    /// It may look on: the server has said who it is, in its own protocol.
    pub(super) fn is_let_in(&mut self) {
        let text = self.until("\"op\":\"serverInfo\"");
        assert!(text.starts_with("HTTP/1.1 101 "), "{text}");
    }
}

/// The answer says so and says why, and nothing of the run comes with it.
fn assert_refused(answer: &str, status: &str, why: &str) {
    assert!(
        answer.starts_with(&format!("HTTP/1.1 {status} ")),
        "{answer}"
    );
    assert!(answer.contains(why), "{answer}");
    assert!(
        !answer.contains("serverInfo") && !answer.contains("advertise"),
        "{answer}"
    );
}

#[test]
fn pages_of_others_are_refused_named_once_and_counted() {
    let mut server = start(&[]);
    for _attempt in 0..5 {
        let answer = ask(&server, &server.socket, Some(EVIL)).answer();
        assert_refused(
            &answer,
            "403",
            &format!("refused a page of {EVIL}; --allow-origin {EVIL}"),
        );
    }
    // As of a page in a sandbox, which any page can show.
    let answer = ask(&server, &server.socket, Some("null")).answer();
    assert_refused(&answer, "403", "refused a page without an origin");
    server
        .child
        .wait_for_output("without an origin", LIMIT)
        .unwrap();
    let finished = server.end();
    let named = finished
        .stderr
        .matches(&format!("refused a page of {EVIL};"))
        .count();
    assert_eq!(named, 1, "{}", finished.stderr);
    let account = format!("refused 6 requests: 5 × a page of {EVIL}; 1 × a page without");
    assert!(finished.stderr.contains(&account), "{}", finished.stderr);
}

#[test]
fn programs_our_own_page_and_allowed_pages_look_on() {
    let server = start(&["--allow-origin", "https://app.foxglove.dev"]);
    ask_as_program(&server.socket).is_let_in();
    let own = format!("http://{}", server.page);
    let claimed = format!("http://{}", server.socket);
    for origin in [&*own, &*claimed, "https://app.foxglove.dev"] {
        ask(&server, &server.socket, Some(origin)).is_let_in();
    }
    let file = ask(&server, &server.socket, Some("file://")).answer();
    assert_refused(
        &file,
        "403",
        "--allow-origin file:// lets them all see the run",
    );
    // Through a tunnel from another machine, by whatever port.
    let page_port = server.page.rsplit(':').next().unwrap();
    let tunnelled = format!("http://localhost:{page_port}");
    ask(&server, "localhost:18765", Some(&tunnelled)).is_let_in();
    let other = ask(&server, "localhost:18765", Some("http://localhost:3000"));
    assert_refused(&other.answer(), "403", "http://localhost:3000");
    server.end();
    let server = start(&["--allow-origin", "file://"]);
    ask(&server, &server.socket, Some("file://")).is_let_in();
    server.end();
}

/// Nobody else on this machine has it.
const STRANGER: u32 = 45_678;

/// The first line that a program of another user of this machine hears that asks to look on.
fn ask_as_stranger(server: &LiveServer, query: &str) -> String {
    let script = r#"exec 3<>"/dev/tcp/$1/$2" || exit
        printf 'GET /%s HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n' "$3" >&3
        printf 'Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n' >&3
        printf 'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n' >&3
        read -r line <&3 && printf '%s' "$line""#;
    let id = STRANGER.to_string();
    let (host, port) = server.socket.rsplit_once(':').unwrap();
    let mut command = Command::new("setpriv");
    command.args(["--reuid", &id, "--regid", &id, "--clear-groups"]);
    command.args(["bash", "-c", script, "bash", host, port, query]);
    run(&mut command, LIMIT).unwrap().stdout
}

#[test]
fn another_user_of_this_machine_looks_on_with_the_token_and_is_refused_and_counted_without() {
    let server = start(&[]);
    let right = format!("?token={}", server.token);
    let wrong = format!("?token={}", "0".repeat(server.token.len()));
    for query in ["", "?token=", &wrong] {
        let answer = ask_as_stranger(&server, query);
        assert!(answer.starts_with("HTTP/1.1 403 "), "{query}: {answer}");
    }
    let answer = ask_as_stranger(&server, &right);
    assert!(answer.starts_with("HTTP/1.1 101 "), "{answer}");
    // This user's own need none.
    ask_as_program(&server.socket).is_let_in();
    let finished = server.end();
    let account =
        "refused 3 requests: 3 × a viewer of another user or another machine without the token";
    println!("{}", finished.stderr);
    assert!(finished.stderr.contains(account), "{}", finished.stderr);
}

#[test]
fn root_needs_the_token_where_the_server_has_another_user() {
    let id = STRANGER.to_string();
    let mut command = Command::new("setpriv");
    command.args(["--reuid", &id, "--regid", &id, "--clear-groups"]);
    // Some kernels take the packet filter with it only.
    command.args(["--inh-caps", "+net_admin", "--ambient-caps", "+net_admin"]);
    command.arg(hil_recorder_binary());
    let server = start_by(command, &[]);
    let answer = ask_as_program(&server.socket).answer();
    assert_refused(&answer, "403", "without the token");
    let socket = &server.socket;
    Asked::with_token(socket, socket, None, Some(&server.token)).is_let_in();
    assert!(ask_as_stranger(&server, "").starts_with("HTTP/1.1 101 "));
    server.end();
}

#[test]
fn nobody_is_told_to_paste_what_a_shell_would_run() {
    let server = start(&[]);
    let origin = "http://$(touch${IFS}pwned).example;`id`";
    let answer = ask(&server, &server.socket, Some(origin)).answer();
    assert_refused(&answer, "403", "refused a page of http://$(touch");
    assert!(!answer.contains("--allow-origin"), "{answer}");
    let finished = server.end();
    assert!(!finished.stderr.contains("--allow-origin"), "{finished:?}");
}

#[test]
fn names_that_may_be_anybodys_reach_neither_socket_nor_page() {
    let server = start(&["--allow-host", "robot.example.org"]);
    let get = |path: &str, host: &str| {
        let request = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
        Asked::send(&server.page, request.as_bytes()).answer()
    };
    let why = "--allow-host evil.example says that it is";
    assert_refused(
        &ask(&server, "evil.example:8765", None).answer(),
        "403",
        why,
    );
    for path in ["/", "/config.json"] {
        assert_refused(&get(path, "evil.example"), "403", why);
    }
    assert!(!get("/config.json", "evil.example").contains("ws_port"));
    ask(&server, "robot.example.org:8765", None).is_let_in();
    for host in ["robot.example.org:80", "localhost:8766", &server.page] {
        let answer = get("/config.json", host);
        assert!(answer.contains("ws_port"), "{host}: {answer}");
    }
    server.end();
}

#[test]
fn a_viewer_too_many_is_told_so_and_comes_in_when_another_has_gone() {
    let server = start(&[]);
    // All at once.
    let asked = (0..SEATS).map(|_| ask_as_program(&server.socket));
    let mut viewers: Vec<Asked> = asked.collect();
    viewers.iter_mut().for_each(Asked::is_let_in);
    let answer = ask_as_program(&server.socket).answer();
    assert_refused(&answer, "503", &format!("{SEATS} look on already"));
    drop(viewers.pop());
    let deadline = Instant::now() + LIMIT;
    loop {
        let mut asked = ask_as_program(&server.socket);
        if asked.until("\r\n\r\n").starts_with("HTTP/1.1 101 ") {
            break;
        }
        assert!(Instant::now() < deadline, "the place stays taken");
    }
    // One that does not read keeps nobody from ending; the others get the closing frame.
    let finished = server.end();
    assert!(finished.stderr.contains("ended"), "{}", finished.stderr);
    for mut viewer in viewers {
        let mut rest = Vec::new();
        viewer.stream.read_to_end(&mut rest).unwrap();
    }
}

#[test]
fn viewers_whose_cable_was_pulled_lose_their_seats() {
    let Some(lab) = Lab::two_hosts_or_skip() else {
        return;
    };
    let [here, there] = [0, 1].map(|index| lab.host(index));
    let program = here.command(hil_recorder_binary());
    let mut server = start_by(program, &["--host", "0.0.0.0"]);
    // Where others find it, which 0.0.0.0 does not say.
    let (here_at, page_port) = server.page.rsplit_once(':').unwrap();
    assert_eq!(here_at, "127.0.0.1");
    let port = server.socket.rsplit(':').next().unwrap();
    let (address, token) = (here.address(), &server.token);
    let said = format!(
        "from other machines  http://{address}:{page_port}/?token={token}  \
         ws://{address}:{port}/?token={token}\n"
    );
    server.child.wait_for_output(&said, LIMIT).unwrap();
    let [local, remote] = [Ipv4Addr::LOCALHOST, here.address()].map(|one| format!("{one}:{port}"));
    let look_on = || {
        let mut asked = Asked::with_token(&remote, &remote, None, Some(&server.token));
        asked.is_let_in();
        asked
    };
    let stranger = there.on_network(|| Asked::to_look_on(&remote, &remote, None));
    assert_refused(
        &stranger.answer(),
        "403",
        "another machine without the token",
    );
    let viewers: Vec<Asked> = there.on_network(|| (0..SEATS).map(|_| look_on()).collect());
    let ask = || here.on_network(|| Asked::to_look_on(&local, &local, None));
    let full = format!("{SEATS} look on already");
    assert_refused(&ask().answer(), "503", &full);
    there.set_link(INTERFACE, "down");
    let deadline = Instant::now() + GONE_LIMIT;
    while !ask().until("\r\n\r\n").starts_with("HTTP/1.1 101 ") {
        assert!(Instant::now() < deadline, "the seats stay taken");
        thread::sleep(Duration::from_millis(500));
    }
    drop(viewers);
    server.end();
}

#[test]
fn bytes_that_are_no_request_are_answered_and_keep_nobody_out() {
    let server = start(&[]);
    let silent: Vec<_> = (0..20).map(|_| Asked::send(&server.socket, b"")).collect();
    let slow = Asked::send(&server.socket, b"GET / HTTP/1.1\r\nHost: local");
    let gone = Asked::send(&server.socket, b"GET / HTTP/1.1\r\n");
    gone.stream.shutdown(Shutdown::Write).unwrap();
    assert_eq!(gone.answer(), "");
    for bytes in [
        &b"\x16\x03\x01\x02\x00\x01\n\n"[..],
        b"Host: localhost\r\n\r\n",
    ] {
        let answer = Asked::send(&server.socket, bytes).answer();
        assert_refused(&answer, "400", "no request of HTTP/1.1");
    }
    let long = format!("GET / HTTP/1.1\r\nX: {}", "a".repeat(20_000));
    let answer = Asked::send(&server.socket, long.as_bytes()).answer();
    assert_refused(&answer, "431", "too long a head");
    ask_as_program(&server.socket).is_let_in();
    assert_refused(&slow.answer(), "408", "too slow to come");
    drop(silent);
    server.end();
}

/// Local addresses at which a process listens, as the kernel writes them: hexadecimal, of the host's
/// byte order, with the port behind.
fn listening(pid: i32) -> Vec<String> {
    let sockets: Vec<String> = fs::read_dir(format!("/proc/{pid}/fd"))
        .unwrap()
        .filter_map(|entry| fs::read_link(entry.unwrap().path()).ok())
        .map(|target| target.to_string_lossy().into_owned())
        .collect();
    let table = fs::read_to_string(format!("/proc/{pid}/net/tcp")).unwrap();
    let fields = table.lines().map(|line| line.split_whitespace().collect());
    let own = |fields: &Vec<&str>| {
        const LISTEN: &str = "0A";
        fields[3] == LISTEN && sockets.contains(&format!("socket:[{}]", fields[9]))
    };
    let own = fields.skip(1).filter(own);
    own.map(|fields: Vec<&str>| fields[1].to_owned()).collect()
}

#[test]
fn what_is_behind_the_door_is_where_nobody_looks() {
    let server = start(&[]);
    let known = |at: &str| {
        let port: u16 = at.rsplit(':').next().unwrap().parse().unwrap();
        format!("{:08X}:{port:04X}", u32::from_ne_bytes([127, 0, 0, 1]))
    };
    let mut listening = listening(server.child.pid().as_raw());
    assert_eq!(listening.len(), 3, "{listening:?}");
    listening.retain(|at| *at != known(&server.socket) && *at != known(&server.page));
    let [hidden] = &listening[..] else {
        panic!("{listening:?}");
    };
    let (hidden, port) = hidden.split_once(':').unwrap();
    let hidden = u32::from_str_radix(hidden, 16).unwrap().to_ne_bytes();
    let [first, rest @ ..] = hidden;
    assert_eq!(first, 127);
    assert_ne!(rest, [0, 0, 1]);
    // Nor has anybody a way in there who read this in the kernel's tables: while nobody looks on, when one
    // comes, and while it looks on.
    let port = u16::from_str_radix(port, 16).unwrap();
    let hidden = SocketAddr::new(Ipv4Addr::from(hidden).into(), port);
    let refused = || TcpStream::connect_timeout(&hidden, Duration::from_millis(500)).is_err();
    assert!(refused());
    let mut viewer = ask_as_program(&server.socket);
    assert!(refused());
    viewer.is_let_in();
    assert!(refused());
    server.end();
}

#[test]
fn a_taken_port_is_said_to_be_taken() {
    let server = start(&[]);
    let port = server.socket.rsplit(':').next().unwrap();
    let mut command = Command::new(hil_recorder_binary());
    command.args(["serve", "--wait", "no-run-is-called-so", "--http-port", "0"]);
    let refused = run(command.args(["--port", port]), LIMIT).unwrap_err();
    let words = format!("cannot listen for viewers at {}", server.socket);
    assert!(
        refused.contains(&words) && refused.contains("--port takes another"),
        "{refused}"
    );
    server.end();
}
