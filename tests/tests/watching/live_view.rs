//! The live view of real runs: a viewer that shares no code with the server connects to
//! `hil-recorder serve` over its socket and over HTTP, sees topics, robots that move and figures that
//! change, and changes an emulated link.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;
use std::time::{Duration, Instant};

use hil_tests::binary::hil_recorder_binary;
use hil_tests::child::ChildGuard;
use hil_tests::run_folder::RunFolder;
use hil_tests::trial::{RunFiles, Trial};
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::HeaderValue;
use tungstenite::{Message, WebSocket};

const LIMIT: Duration = Duration::from_mins(1);
/// Kind of a binary message of the server: data of a topic.
const MESSAGE_DATA: u8 = 1;

/// A server of the live view, and where it listens.
struct Server {
    child: ChildGuard,
    page: String,
    socket: String,
}

impl Server {
    fn start(arguments: &[&str]) -> Self {
        let mut command = Command::new(hil_recorder_binary());
        command.args(["serve", "--port", "0", "--http-port", "0"]);
        command.args(arguments);
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        child.wait_for_output("viewers ws://", LIMIT).unwrap();
        let said = child.stdout_so_far();
        let at = |begin: &str| {
            let rest = said.split(begin).nth(1).unwrap();
            let end = rest.find(['/', '\n']).unwrap_or(rest.len());
            rest[..end].to_owned()
        };
        Self {
            page: at("http://"),
            socket: at("ws://"),
            child,
        }
    }

    /// Status, headers and body of a request.
    fn get(&self, request: &str) -> (String, String, String) {
        let mut stream = TcpStream::connect(&self.page).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        write!(
            stream,
            "{request} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
            self.page
        )
        .unwrap();
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).unwrap();
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let (head, body) = text.split_once("\r\n\r\n").unwrap();
        let (status, headers) = head.split_once("\r\n").unwrap();
        let status = status.split(' ').nth(1).unwrap().to_owned();
        (status, headers.to_lowercase(), body.to_owned())
    }

    fn end(mut self) {
        self.child.signal(Signal::SIGINT).unwrap();
        self.child.wait_within(LIMIT).unwrap().assert_success();
    }
}

/// A viewer that subscribes to everything, or to topics that begin alike.
struct Viewer {
    wanted: &'static str,
    socket: WebSocket<TcpStream>,
    topics: BTreeMap<u32, String>,
    schemas: BTreeMap<String, (String, String)>,
    seen: BTreeMap<String, Vec<Vec<u8>>>,
    texts: Vec<Value>,
}

impl Viewer {
    fn connect(server: &Server) -> Self {
        Self::of_topics(server, "/")
    }

    fn of_topics(server: &Server, wanted: &'static str) -> Self {
        let stream = TcpStream::connect(&server.socket).unwrap();
        stream
            .set_read_timeout(Some(Duration::from_secs(20)))
            .unwrap();
        let mut request = format!("ws://{}", server.socket)
            .into_client_request()
            .unwrap();
        let protocol = HeaderValue::from_static("foxglove.sdk.v1");
        request
            .headers_mut()
            .insert("Sec-WebSocket-Protocol", protocol);
        let (socket, response) = tungstenite::client(request, stream).unwrap();
        assert_eq!(
            response.headers()["sec-websocket-protocol"],
            "foxglove.sdk.v1"
        );
        Self {
            wanted,
            socket,
            topics: BTreeMap::new(),
            schemas: BTreeMap::new(),
            seen: BTreeMap::new(),
            texts: Vec::new(),
        }
    }

    fn send(&mut self, message: &Value) {
        let text = message.to_string();
        self.socket.send(Message::text(text)).unwrap();
    }

    fn step(&mut self) {
        match self.socket.read().unwrap() {
            Message::Text(text) => {
                let message: Value = serde_json::from_str(text.as_str()).unwrap();
                if message["op"] == "advertise" {
                    self.subscribe(&message);
                }
                self.texts.push(message);
            }
            Message::Binary(bytes) if bytes[0] == MESSAGE_DATA => {
                let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                let topic = self.topics[&id].clone();
                self.seen
                    .entry(topic)
                    .or_default()
                    .push(bytes[13..].to_vec());
            }
            _ => {}
        }
    }

    fn subscribe(&mut self, advertised: &Value) {
        let mut subscriptions = Vec::new();
        for channel in advertised["channels"].as_array().unwrap() {
            let topic = channel["topic"].as_str().unwrap().to_owned();
            let text = |key: &str| channel[key].as_str().unwrap_or_default().to_owned();
            let kind = (text("encoding"), text("schemaName"));
            self.schemas.insert(topic.clone(), kind);
            if !topic.starts_with(self.wanted) {
                continue;
            }
            let id = u32::try_from(self.topics.len() + 1).unwrap();
            self.topics.insert(id, topic);
            subscriptions.push(json!({ "id": id, "channelId": channel["id"] }));
        }
        self.send(&json!({ "op": "subscribe", "subscriptions": subscriptions }));
    }

    /// Reads on until `is_so`.
    fn until(&mut self, what: &str, is_so: impl Fn(&Self) -> bool) {
        let deadline = Instant::now() + LIMIT;
        while !is_so(self) {
            let seen: Vec<_> = self.seen.keys().collect();
            assert!(
                Instant::now() < deadline,
                "{what}: not within {LIMIT:?}; seen {seen:?}"
            );
            self.step();
        }
    }

    fn live(&self, topic: &str) -> Vec<Value> {
        let seen = self.seen.get(topic).map_or(&[][..], Vec::as_slice);
        let parsed = seen
            .iter()
            .map(|bytes| serde_json::from_slice(bytes).unwrap());
        parsed.collect()
    }

    fn last(&self, topic: &str) -> Option<Value> {
        let seen = self.seen.get(topic)?.last()?;
        serde_json::from_slice(seen).ok()
    }

    fn run_state(&self) -> Option<String> {
        let run = self.last("/live/run")?;
        run["state"].as_str().map(str::to_owned)
    }

    /// Sets a parameter; what the server says it is then.
    fn set(&mut self, name: &str, value: &Value, id: &str) -> Option<Value> {
        let parameter = json!({ "name": name, "value": value });
        self.send(&json!({ "op": "setParameters", "parameters": [parameter], "id": id }));
        let is_answer = |text: &Value| text["op"] == "parameterValues" && text["id"] == id;
        self.until("an answer", |viewer| viewer.texts.iter().any(is_answer));
        let answer = self.texts.iter().rev().find(|text| is_answer(text))?;
        let parameters = answer["parameters"].as_array()?;
        let found = parameters.iter().find(|one| one["name"] == name)?;
        Some(found["value"].clone())
    }
}

fn robots(picture: &Value) -> Vec<(f64, f64)> {
    let robots = picture["robots"].as_array().unwrap().iter();
    let at = |robot: &Value, key: &str| robot[key].as_f64().unwrap();
    robots
        .map(|robot| (at(robot, "x_m"), at(robot, "y_m")))
        .collect()
}

fn name_of(trial: &Trial) -> String {
    let files = trial.folder("", LIMIT);
    let name = files.root().file_name().unwrap();
    name.to_str().unwrap().to_owned()
}

/// An observer is no part of a run, so its account does not know of one.
fn check_that_nobody_was_in_the_way(child: &mut ChildGuard, files: &RunFiles) {
    let ended = child.wait_within(LIMIT).unwrap();
    assert!(!ended.stderr.contains("still used"), "{ended:?}");
    let summary = files.read("summary.json");
    assert!(!summary.contains("still used"), "{summary}");
}

#[test]
fn a_fleet_is_seen_driving_and_its_link_is_changed() {
    let folder = RunFolder::new("live-fleet");
    let trial = Trial::shipped("fleet-emulated.toml", folder.path())
        .set("run.duration=\"45 s\"")
        .set("case.parameters.fleets=1")
        .on_own_ports(&["commands", "states"]);
    let mut child = trial.start_here();
    let name = name_of(&trial);
    let record = folder.path().join("live.mcap");
    let words = ["--wait", &name, "--record"];
    let server = Server::start(&[&words[..], &[record.to_str().unwrap()]].concat());
    let mut viewer = Viewer::connect(&server);
    viewer.until("robots and a map", |viewer| {
        let last = viewer.last("/live/fleet");
        last.is_some_and(|last| robots(&last).len() == 7) && viewer.last("/live/map").is_some()
    });
    check_the_map(&viewer);

    let first = robots(&viewer.last("/live/fleet").unwrap());
    viewer.until("a robot on its way", |viewer| {
        let last = robots(&viewer.last("/live/fleet").unwrap());
        let mut pairs = first.iter().zip(&last);
        pairs.any(|(first, last)| (first.0 - last.0).abs() > 0.5)
    });
    let picture = viewer.last("/live/fleet").unwrap();
    let is_driving = |robot: &&Value| robot["phase"] == "driving";
    let driving = picture["robots"]
        .as_array()
        .unwrap()
        .iter()
        .find(is_driving)
        .unwrap();
    assert!(driving["path"].is_u64() && !driving["ahead"].as_array().unwrap().is_empty());
    assert_eq!(
        (&picture["basis"], &picture["collision_count"]),
        (&json!("truth"), &json!(0))
    );
    assert!(viewer.seen.contains_key("/fleet/state"));

    let rate = |channels: &Value| channels["channels"][2]["rate_hz"].as_f64().unwrap();
    viewer.until("states every 30 ms and delays", |viewer| {
        let last = viewer.last("/live/channels");
        last.is_some_and(|last| rate(&last) > 20.0 && last["channels"][2]["one_way"].is_object())
    });
    change_the_link(&mut viewer);

    let run = viewer.last("/live/run").unwrap();
    assert_eq!(
        (&run["state"], &run["case"]),
        (&json!("running"), &json!("fleet"))
    );
    assert_eq!(run["recorder"]["file"], json!(record));
    child.signal(Signal::SIGINT).unwrap();
    see_the_end(&mut viewer, &server);
    check_that_nobody_was_in_the_way(&mut child, &trial.folder(&name, LIMIT));
    server.end();
    let bytes = std::fs::read(&record).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut topics = summary.channels.values().map(|channel| &channel.topic);
    assert!(topics.any(|topic| topic == "/fleet/state"));
}

/// The ground of the shipped warehouse, and of what kind the topics are.
fn check_the_map(viewer: &Viewer) {
    let map = viewer.last("/live/map").unwrap();
    assert_eq!(map["footprint"]["length_m"], 2.0);
    assert_eq!(map["bounds"]["x_max_m"], 80.0);
    assert!(map["paths"].as_array().unwrap().len() > 20);
    assert!(!map["conflict_areas"].as_array().unwrap().is_empty());
    let kind = |topic: &str| viewer.schemas[topic].clone();
    let protobuf = |name: &str| ("protobuf".to_owned(), name.to_owned());
    assert_eq!(kind("/fleet/state"), protobuf("hil.FleetState.v2"));
    assert_eq!(
        kind("/net/fleet/state/latency"),
        protobuf("hil.MessageLatency.v1")
    );
    assert_eq!(kind("/live/fleet").0, "json");
}

/// The last word and picture, also for who comes after the end.
fn see_the_end(viewer: &mut Viewer, server: &Server) {
    viewer.until("the end", |viewer| {
        viewer.run_state().as_deref() == Some("ended")
    });
    let run = viewer.last("/live/run").unwrap();
    assert!(run["how"].is_string(), "{run}");
    let mut late = Viewer::connect(server);
    late.until("the last picture", |late| {
        late.run_state().as_deref() == Some("ended") && late.last("/live/fleet").is_some()
    });
}

/// Loses everything on the way of the commands, and sees that it is lost.
fn change_the_link(viewer: &mut Viewer) {
    viewer.send(&json!({ "op": "getParameters", "parameterNames": [], "id": "all" }));
    let listed = |text: &Value| text["op"] == "parameterValues" && text["id"] == "all";
    viewer.until("parameters", |viewer| viewer.texts.iter().any(listed));
    let name = "link.commands.forward.loss_ratio";
    let text = viewer
        .texts
        .iter()
        .find(|text| listed(text))
        .unwrap()
        .to_string();
    assert!(
        text.contains(name) && text.contains("link.states.backward.is_cut"),
        "{text}"
    );
    assert_eq!(viewer.set(name, &json!(1.0), "loss"), Some(json!(1.0)));
    viewer.until("losses", |viewer| viewer.last("/live/losses").is_some());
    viewer.until("the condition in the run's words", |viewer| {
        let run = viewer.last("/live/run").unwrap();
        let way = &run["links"][0]["directions"][0];
        way["condition"]["loss_ratio"] == 1.0 && way["is_settable"] == true
    });
    assert_eq!(
        viewer.set("link.commands.forward.loss_ratio", &json!(7.0), "far"),
        Some(json!(1.0))
    );
    assert_eq!(
        viewer.set("link.nowhere.forward.delay_ms", &json!(1.0), "none"),
        None
    );
    let refused = |words: &'static str| {
        move |text: &Value| {
            let said = text["message"].as_str().unwrap_or_default();
            text["op"] == "status" && said.contains(words)
        }
    };
    assert!(viewer.texts.iter().any(refused("outside 0 to 1")));
    assert!(viewer.texts.iter().any(refused("no link `nowhere")));
}

#[test]
fn arms_are_seen_moving_and_the_page_is_served() {
    let folder = RunFolder::new("live-arms");
    let trial = Trial::shipped("local.toml", folder.path()).set("run.duration=\"25 s\"");
    let mut child = trial.start_here();
    let name = name_of(&trial);
    let server = Server::start(&["--wait", &name]);
    check_the_page(&server);
    let mut viewer = Viewer::connect(&server);
    let right = |picture: &Value| picture["arms"][0].clone();
    let frames = |viewer: &Viewer| {
        let picture = viewer.last("/live/arms")?;
        let frames = right(&picture)["measured_frames"].as_array()?.clone();
        Some((right(&picture)["state"].clone(), frames))
    };
    viewer.until("an arm", |viewer| frames(viewer).is_some());
    let (_, first) = frames(&viewer).unwrap();
    viewer.until("a session and an arm that moves", |viewer| {
        frames(viewer).is_some_and(|(state, last)| state == "running" && last[7] != first[7])
    });
    let last = right(&viewer.last("/live/arms").unwrap());
    assert_eq!(last["desired_rad"].as_array().map(Vec::len), Some(7));
    assert_eq!(last["desired_frames"].as_array().map(Vec::len), Some(8));
    assert!(last["tool_error_mm"].as_f64().is_some_and(f64::is_finite));
    let kind = viewer.schemas["/joints/egm/right/feedback"].clone();
    assert_eq!(
        kind,
        ("protobuf".to_owned(), "foxglove.JointStates".to_owned())
    );
    viewer.until("joints", |viewer| {
        viewer.seen.contains_key("/joints/egm/right/feedback")
    });
    let run = viewer.last("/live/run").unwrap();
    assert_eq!((&run["name"], &run["links"]), (&json!(name), &json!([])));
    let channels = run["channels"].as_array().unwrap();
    let frame = channels
        .iter()
        .find(|one| one["name"] == "human/frame")
        .unwrap();
    assert_eq!(
        (&frame["from"], &frame["via"]),
        (&json!("human"), &json!("shared-memory"))
    );
    child.signal(Signal::SIGINT).unwrap();
    check_that_nobody_was_in_the_way(&mut child, &trial.folder(&name, LIMIT));
    server.end();
    play_back(&trial.folder("", LIMIT).root().display().to_string());
}

/// The page, its type and its policy; nothing else.
fn check_the_page(server: &Server) {
    let (status, headers, body) = server.get("GET /");
    assert_eq!(status, "200");
    assert!(
        headers.contains("content-type: text/html; charset=utf-8"),
        "{headers}"
    );
    assert!(
        headers.contains("content-security-policy: default-src 'none'; script-src 'sha256-"),
        "{headers}"
    );
    assert!(body.contains("<html"), "{body}");
    // All of it in one answer: nothing that a browser would have to ask for once more.
    assert!(body.contains("<script type=\"module\">") && body.contains("<style>"));
    assert!(!body.contains("src=") && !body.contains("rel=\"stylesheet"));
    let (_, headers, config) = server.get("GET /config.json");
    assert!(
        headers.contains("content-type: application/json"),
        "{headers}"
    );
    let config: Value = serde_json::from_str(&config).unwrap();
    let port = server
        .socket
        .rsplit(':')
        .next()
        .unwrap()
        .parse::<u16>()
        .unwrap();
    assert_eq!(config["ws_port"], port);
    for path in [
        "/nowhere",
        "/../Cargo.toml",
        "/%2e%2e/Cargo.toml",
        "//etc/passwd",
        "/page/",
    ] {
        assert_eq!(server.get(&format!("GET {path}")).0, "404", "{path}");
    }
    assert_eq!(server.get("POST /").0, "405");
}

/// The same run, finished, through the same socket, again and again.
fn play_back(run: &str) {
    let server = Server::start(&[run, "--speed", "50", "--loop"]);
    // All topics at such a speed are more than a test reads; the newest would crowd out the rest.
    let mut viewer = Viewer::of_topics(&server, "/live/");
    viewer.until("two rounds", |viewer| {
        let runs = viewer.live("/live/run");
        let elapsed = runs.iter().filter_map(|run| run["elapsed_s"].as_f64());
        let elapsed: Vec<f64> = elapsed.collect();
        elapsed.windows(2).any(|two| two[1] < two[0])
    });
    let run = viewer.last("/live/run").unwrap();
    assert_eq!(
        (&run["is_playback"], &run["speed"]),
        (&json!(true), &json!(50.0))
    );
    assert!(!viewer.live("/live/arms").is_empty());
    server.end();
}

#[test]
fn without_a_run_it_says_so_or_waits() {
    let mut command = Command::new(hil_recorder_binary());
    command.args(["serve", "--port", "0", "--http-port", "0", "no-such-run"]);
    let output = command.output().unwrap();
    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{words}");
    assert!(words.contains("--wait"), "{words}");
    let server = Server::start(&["no-such-run", "--wait"]);
    let mut viewer = Viewer::connect(&server);
    viewer.until("a word that it waits", |viewer| {
        viewer.run_state().as_deref() == Some("waiting")
    });
    server.end();
}
