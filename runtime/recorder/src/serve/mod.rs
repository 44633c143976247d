//! `hil-recorder serve`: a run as it goes on, or as it went, to browsers and viewers. One thread reads
//! records, works out the state and hands it to the socket; the socket and the page have a runtime of
//! their own.

mod page;
mod parameters;
mod playback;
mod source;
mod viewers;

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use hil_runtime::console::Console;
use hil_runtime::signals::{EXIT_INTERRUPTED, Signals};
use serde_json::{Value, json};
use tokio::runtime::Runtime;

use crate::live::state::{RunState, Standing};
use crate::live::{Body, LiveRecord};
use parameters::Links;
use playback::Playback;
use source::{Progress, Source};
use viewers::Viewers;

/// Between two looks at the records.
const LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Between two pictures of robots and arms.
const PICTURE_PERIOD: Duration = Duration::from_millis(50);
/// Between two pictures of fleets of many robots.
const LARGE_PICTURE_PERIOD: Duration = Duration::from_millis(200);
/// Between two accounts of the channels.
const CHANNELS_PERIOD: Duration = Duration::from_millis(100);
/// Between two words on the run.
const RUN_PERIOD: Duration = Duration::from_secs(1);

/// What the command line says.
#[derive(Debug)]
pub(crate) struct ServeOptions {
    /// A run's folder.
    pub(crate) run: PathBuf,
    /// Where to listen.
    pub(crate) host: IpAddr,
    /// Of the socket; 0 takes a free one.
    pub(crate) port: u16,
    /// Of the page; 0 takes a free one.
    pub(crate) http_port: u16,
    /// Of a run that is played back.
    pub(crate) speed: f64,
    /// Begin again at the end.
    pub(crate) repeats: bool,
}

/// Why nothing is served.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ServeError {
    /// Nothing to show.
    #[error(transparent)]
    Run(#[from] crate::run::RunError),
    /// The socket.
    #[error(
        "cannot listen for viewers at {address}: {why}; --port takes another, 0 any that is free"
    )]
    Socket {
        /// Where.
        address: SocketAddr,
        /// What the library said.
        why: String,
    },
    /// The page.
    #[error(
        "cannot serve the page at {address}: {why}; --http-port takes another, 0 any that is free"
    )]
    Page {
        /// Where.
        address: SocketAddr,
        /// What the system said.
        why: std::io::Error,
    },
    /// Threads, mostly.
    #[error("cannot begin: {0}")]
    Runtime(#[from] std::io::Error),
}

/// Serves until a signal comes; the exit code.
///
/// # Errors
/// When there is nothing to show or nowhere to show it.
pub(crate) fn serve(
    options: &ServeOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<i32, ServeError> {
    let how = (options.speed, options.repeats);
    let read = Playback::read(&options.run, how, &mut |_| signals.received().is_none());
    let (playback, facts) = read?;
    if signals.received().is_some() {
        return Ok(EXIT_INTERRUPTED);
    }
    for words in playback.words() {
        console.warn(words);
    }
    let links = Links::default();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("viewers")
        .enable_all()
        .build()?;
    let mut viewers = open(options, &runtime, &links, console)?;
    let state = RunState::new(facts);
    let words = viewers.offer(&state.facts);
    for words in words.unwrap_or_else(|error| vec![error.to_string()]) {
        console.warn(&words);
    }
    let mut engine = Engine {
        state,
        source: Box::new(playback),
        viewers,
        playback_speed: Some(options.speed),
        due: Due::default(),
    };
    while signals.received().is_none() {
        engine.round();
        thread::sleep(LOOK_PERIOD);
    }
    links.replace(None);
    engine.viewers.end(runtime.handle());
    runtime.shutdown_timeout(Duration::from_secs(1));
    console.say("ended");
    Ok(0)
}

/// Opens socket and page and says where they are.
fn open(
    options: &ServeOptions,
    runtime: &Runtime,
    links: &Links,
    console: &mut Console,
) -> Result<Viewers, ServeError> {
    let address = SocketAddr::new(options.host, options.port);
    let handler = std::sync::Arc::new(links.clone());
    let viewers = Viewers::begin(runtime.handle(), address, handler).map_err(|error| {
        let why = error.to_string();
        ServeError::Socket { address, why }
    })?;
    let socket = SocketAddr::new(options.host, viewers.port());
    let address = SocketAddr::new(options.host, options.http_port);
    let page = page::serve(runtime.handle(), address, viewers.port())
        .map_err(|why| ServeError::Page { address, why })?;
    if !options.host.is_loopback() {
        console.warn(
            "anybody who can reach this address sees the run and may change its emulated links; \
             without --host only this machine can",
        );
    }
    console.result(&format!("page    http://{page}/\nviewers ws://{socket}\n"));
    Ok(viewers)
}

/// When the next of each is due.
#[derive(Debug, Default)]
struct Due {
    picture: Option<Instant>,
    channels: Option<Instant>,
    run: Option<Instant>,
}

/// True when `due` has come; it is then due again in `period`.
fn is_due(due: &mut Option<Instant>, period: Duration) -> bool {
    let now = Instant::now();
    if due.is_some_and(|due| now < due) {
        return false;
    }
    *due = Some(now + period);
    true
}

/// A run on its way to the viewers.
struct Engine {
    state: RunState,
    source: Box<dyn Source>,
    viewers: Viewers,
    playback_speed: Option<f64>,
    due: Due,
}

impl Engine {
    /// Reads what came and shows what is due.
    fn round(&mut self) {
        let Self {
            state,
            source,
            viewers,
            ..
        } = self;
        let progress = source.poll(&mut |record| {
            state.take(record);
            show(state, viewers, record);
        });
        match progress {
            Progress::Going => {}
            Progress::Rewound => {
                self.state.rewind();
                self.due = Due::default();
            }
            Progress::Ended(how) => {
                if self.state.standing == Standing::Running {
                    self.state.standing = Standing::Ended(how);
                    self.due.run = None;
                }
            }
        }
        self.pictures();
        self.viewers.welcome(self.source.now_ns());
    }

    fn pictures(&mut self) {
        let now_ns = self.source.now_ns();
        if let Some(map) = self.state.new_map() {
            self.viewers.live("/live/map", now_ns, map);
        }
        let is_over = self.state.standing != Standing::Running;
        let period = if self.state.is_small() {
            PICTURE_PERIOD
        } else {
            LARGE_PICTURE_PERIOD
        };
        // After the end the last picture stays.
        if !is_over && is_due(&mut self.due.picture, period) {
            if let Some(fleet) = self.state.fleet(now_ns) {
                self.viewers.live("/live/fleet", now_ns, fleet);
            }
            if let Some(arms) = self.state.arms(now_ns) {
                self.viewers.live("/live/arms", now_ns, arms);
            }
        }
        if !is_over && is_due(&mut self.due.channels, CHANNELS_PERIOD) {
            let (channels, losses) = self.state.channels(now_ns);
            self.viewers.live("/live/channels", now_ns, channels);
            for loss in losses {
                self.viewers.live("/live/losses", now_ns, loss);
            }
            for place in 0..self.state.facts.channels.len() {
                for stamps in self.state.shown(place) {
                    self.viewers.latency(place, now_ns, &stamps);
                }
            }
        }
        if is_due(&mut self.due.run, RUN_PERIOD) {
            let run = self.run_words(now_ns);
            self.viewers.live("/live/run", now_ns, run);
        }
    }

    fn run_words(&mut self, now_ns: i64) -> Value {
        let mut run = self.state.run(now_ns);
        run["is_playback"] = json!(self.playback_speed.is_some());
        run["speed"] = json!(self.playback_speed.unwrap_or(1.0));
        run["recorder"]["file"] = Value::Null;
        run["recorder"]["missed_count"] = json!(self.source.missed_count());
        run["recorder"]["viewer_count"] = json!(self.viewers.count());
        run
    }
}

/// Hands a message on to those who look at its topic.
fn show(state: &RunState, viewers: &mut Viewers, record: &LiveRecord) {
    let Body::Message(envelope, payload) = &record.body else {
        return;
    };
    if let Some(channel) = state.facts.channels.get(record.channel) {
        let name = channel.name.as_str();
        viewers.message((record.channel, name), record.at_ns, envelope, payload);
    }
}
