//! `hil-recorder serve`: a run as it goes on, or as it went, to browsers and viewers. One thread reads
//! records, works out the state and hands it to the socket; the socket and the page have a runtime of
//! their own.

mod engine;
mod page;
mod parameters;
mod playback;
mod recording;
mod running;
mod source;
mod viewers;

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use hil_runtime::console::Console;
use hil_runtime::signals::{EXIT_INTERRUPTED, Signals};
use hil_runtime::watch::{FeedError, LiveRun, SelectError, select};
use tokio::runtime::Runtime;

use crate::cli::ServeOptions;
use engine::{Engine, Shown};
use parameters::Links;
use playback::Playback;
use running::Running;
use viewers::Viewers;

/// Between two looks at the records.
const LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Between two looks for a run that begins.
const WAIT_PERIOD: Duration = Duration::from_millis(300);

/// Why nothing is served.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ServeError {
    /// Nothing to play back.
    #[error(transparent)]
    Run(#[from] crate::run::RunError),
    /// No run goes on, or it is not clear which is meant.
    #[error("{0}; --wait waits for one, and the folder of a finished run is played back")]
    Select(#[from] SelectError),
    /// A run that goes on cannot be watched.
    #[error(transparent)]
    Feed(#[from] FeedError),
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
    let shown = first(options, signals, console)?;
    if signals.received().is_some() {
        return Ok(EXIT_INTERRUPTED);
    }
    let links = Links::begin();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("viewers")
        .enable_all()
        .build()?;
    let viewers = open(options, &runtime, &links, console)?;
    let mut engine = Engine::new(viewers, links, options.record.clone());
    match shown {
        Some(shown) => engine.show(shown, console),
        None => console.say("no run goes on here; waiting for one"),
    }
    let mut looked = Instant::now();
    while signals.received().is_none() {
        if options.wait && looked.elapsed() >= WAIT_PERIOD {
            looked = Instant::now();
            show_next(options, &mut engine, console);
        }
        engine.round(console);
        thread::sleep(LOOK_PERIOD);
    }
    engine.into_viewers(console).end(runtime.handle());
    runtime.shutdown_timeout(Duration::from_secs(1));
    console.say("ended");
    Ok(0)
}

/// What is shown first; `None` when it has to be waited for.
fn first(
    options: &ServeOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<Option<Shown>, ServeError> {
    let wanted = options.run.as_deref();
    let folder = wanted.map(Path::new).filter(|path| path.is_dir());
    if let Some(folder) = folder.filter(|folder| !goes_on(folder)) {
        let how = (options.speed, options.repeats);
        let read = Playback::read(folder, how, &mut |_| signals.received().is_none());
        let (playback, facts) = read?;
        for words in playback.words() {
            console.warn(words);
        }
        let source = Box::new(playback);
        return Ok(Some(Shown::new(facts, source, Some(options.speed), None)));
    }
    match select(wanted) {
        Ok(run) => Ok(Some(watch(run)?)),
        Err(error) if options.wait && is_none_yet(&error) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

fn goes_on(folder: &Path) -> bool {
    LiveRun::read(folder).is_ok_and(|run| run.is_held())
}

const fn is_none_yet(error: &SelectError) -> bool {
    matches!(error, SelectError::NoneRuns | SelectError::NoSuch { .. })
}

fn watch(run: LiveRun) -> Result<Shown, ServeError> {
    let folder = run.folder.clone();
    let (running, facts) = Running::open(run)?;
    let topology = running.topology().clone();
    let links = Some((folder, topology));
    Ok(Shown::new(facts, Box::new(running), None, links))
}

/// Shows a run that has begun, where none is shown or the one shown is over.
fn show_next(options: &ServeOptions, engine: &mut Engine, console: &mut Console) {
    let showing = engine.showing();
    if showing.is_some_and(|(_, is_over)| !is_over) {
        return;
    }
    let Ok(run) = select(options.run.as_deref()) else {
        return;
    };
    if showing.is_some_and(|(name, _)| name == run.name) {
        return;
    }
    let name = run.name.clone();
    match watch(run) {
        Ok(shown) => {
            console.say(&format!("showing {name}"));
            engine.show(shown, console);
        }
        // It may be over already, or not quite there: the next look tells.
        Err(error) => console.warn(&error.to_string()),
    }
}

/// Opens socket and page and says where they are.
fn open(
    options: &ServeOptions,
    runtime: &Runtime,
    links: &Links,
    console: &mut Console,
) -> Result<Viewers, ServeError> {
    let address = SocketAddr::new(options.host, options.port);
    let handler = Arc::new(links.clone());
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
