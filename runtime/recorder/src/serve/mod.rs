//! `hil-recorder serve`: a run as it goes on, or as it went, to browsers and viewers. One thread reads
//! records, works out the state and hands it to the socket; the socket and the page have a runtime of
//! their own. Before the socket is a door, [`front`], that knows whose page asks.

mod access;
mod engine;
mod front;
mod gate;
mod head;
mod page;
mod parameters;
mod passage;
mod recording;
mod source;
mod token;
mod viewers;

pub(crate) use access::{host, origin};

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use std::{fs, thread};

use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_platform::signals::Signals;
use hil_rundir::live_run::LiveRun;
use hil_rundir::run_folder::RunFolder;
use hil_rundir::select::{SelectError, select};
use tokio::runtime::Runtime;

use crate::cli::{RecordOptions, ServeOptions};
use crate::failure::{Exit, Failure};
use crate::split::prepare;
use crate::view::state::RunState;
use access::{Access, NO_ORIGIN, Refusal};
use engine::{Engine, Showing, Shown};
use front::{Front, viewer_listener};
use parameters::{Links, RunWithLinks};
use source::{Playback, Running};
use token::Token;
use viewers::Viewers;

/// What a kill may lose at most of a recording.
const FLUSH: Duration = Duration::from_secs(1);
/// Between two looks for a run that begins.
const WAIT_PERIOD: Duration = Duration::from_millis(300);

/// Serves until a signal comes; the exit code, which says whether what was to be recorded is.
///
/// # Errors
/// When there is nothing to show or nowhere to show it.
pub(crate) fn serve(
    options: &ServeOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<Exit, Failure> {
    if let Some(output) = &options.record {
        prepare(output, None, false).map_err(|error| {
            let failure = Failure::from(error);
            let words = format!("--record: {failure}");
            Failure { words, ..failure }
        })?;
    }
    let shown = first(options, signals, console)?;
    if signals.received().is_some() {
        return Ok(Exit::Interrupted);
    }
    let links = Links::begin();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("viewers")
        .enable_all()
        .build()
        .map_err(|error| Failure::failed(format!("cannot begin: {error}")))?;
    let token = Token::draw();
    let token =
        token.map_err(|error| Failure::failed(format!("no token can be drawn: {error}")))?;
    let access = Arc::new(admitted(options).with_token(token));
    let (viewers, front) = open(options, &runtime, &links, &access, console)?;
    let target = options.record.clone().map(|output| RecordOptions {
        output,
        flush: FLUSH,
        no_scene: options.no_scene,
        ..RecordOptions::default()
    });
    let mut engine = Engine::new(viewers, links, target);
    match shown {
        Some(shown) => engine.show(shown, console),
        None => console.say("no run goes on here; waiting for one"),
    }
    let mut looked = Instant::now();
    let mut said = None;
    while signals.received().is_none() {
        if options.wait && looked.elapsed() >= WAIT_PERIOD {
            looked = Instant::now();
            show_next(options, &mut engine, &mut said, console);
        }
        engine.round(console);
        for words in access.take_unsaid() {
            console.warn(&words);
        }
        thread::sleep(engine.rest());
    }
    let (viewers, is_recorded) = engine.into_viewers(console);
    front.announce_end();
    viewers.end(runtime.handle());
    front.end(runtime.handle());
    runtime.shutdown_timeout(Duration::from_secs(1));
    if let Some(account) = access.account() {
        console.say(&account);
    }
    console.say("ended");
    Ok(if is_recorded {
        Exit::Done
    } else {
        Exit::Failed
    })
}

/// What is shown first; `None` when it has to be waited for.
fn first(
    options: &ServeOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<Option<Shown>, Failure> {
    let wanted = options.run.as_deref();
    let folder = wanted.map(Path::new).filter(|path| path.is_dir());
    // Asked before whether it goes on, so that one that begins in between is not played back.
    if let Some(folder) = folder.filter(|folder| has_not_begun(folder)) {
        let folder = folder.display();
        let why = format!("the run in {folder} has not begun yet; --wait waits for it");
        return if options.wait {
            Ok(None)
        } else {
            Err(Failure::failed(why))
        };
    }
    let goes_on = |folder: &&Path| LiveRun::read(folder).is_ok_and(|run| run.is_held());
    if let Some(folder) = folder.filter(|folder| !goes_on(folder)) {
        if options.record.is_some() {
            let folder = folder.display();
            return Err(Failure::usage(format!(
                "--record: the run in {folder} is over and would only be played back; \
                 `hil-recorder convert {folder} -o FILE` makes a file of it"
            )));
        }
        let progress = Progress::begin();
        let (speed, repeats) = (options.speed, options.repeats);
        let read = Playback::read(folder, speed, repeats, &mut |share, path| {
            progress.show(console, Some(share), &format!("reading {path}"));
            signals.received().is_none()
        });
        let (playback, facts) = read?;
        for words in playback.words() {
            console.warn(words);
        }
        return Ok(Some(Shown {
            state: RunState::new(facts),
            source: Box::new(playback),
            playback_speed: Some(options.speed),
            links: None,
        }));
    }
    match select(wanted) {
        Ok(run) => Ok(Some(watch(run)?)),
        Err(SelectError::NoneRuns | SelectError::NoSuch { .. }) if options.wait => Ok(None),
        Err(error) => {
            let cure = "--wait waits for one, and the folder of a finished run is played back";
            Err(Failure::usage(format!("{error}; {cure}")))
        }
    }
}

/// True for the folder of a run whose supervisor has only just made it: nothing is announced or
/// recorded. A finished run has records.
fn has_not_begun(folder: &Path) -> bool {
    let run = RunFolder::existing(folder);
    let is_told = folder.join(LiveRun::FILE_NAME).exists() || run.summary().exists();
    let records = fs::read_dir(run.records());
    !is_told && records.is_ok_and(|mut records| records.next().is_none())
}

fn watch(run: LiveRun) -> Result<Shown, Failure> {
    let folder = run.folder.clone();
    let (running, facts) = Running::open(run).map_err(Failure::failed)?;
    Ok(Shown {
        state: RunState::new(facts),
        links: Some(RunWithLinks {
            folder,
            topology: running.topology().clone(),
        }),
        source: Box::new(running),
        playback_speed: None,
    })
}

/// Shows a run that has begun, where none is shown or the one shown gives way to it. `said` is what
/// was said last of why none can be chosen.
fn show_next(
    options: &ServeOptions,
    engine: &mut Engine,
    said: &mut Option<String>,
    console: &mut Console,
) {
    let showing = engine.showing();
    if showing.is_some_and(|showing| !showing.is_over && !showing.is_playback) {
        return;
    }
    let run = match select(options.run.as_deref()) {
        Ok(run) => run,
        Err(error @ SelectError::Several { .. }) => {
            // Asked three times a second: once for each choice of runs.
            let words = error.to_string();
            if said.as_ref() != Some(&words) {
                console.warn(&words);
                *said = Some(words);
            }
            return;
        }
        // None has begun, which is what is waited for.
        Err(_) => return,
    };
    if showing.is_some_and(|showing| !gives_way(showing, &run.name)) {
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

/// True when what is shown makes room for the run called `name`, which goes on. What is played back
/// under that name was looked at before the run began.
fn gives_way(showing: Showing<'_>, name: &str) -> bool {
    if showing.name == name {
        showing.is_playback
    } else {
        showing.is_over
    }
}

/// Opens socket and page and says where they are.
fn open(
    options: &ServeOptions,
    runtime: &Runtime,
    links: &Links,
    access: &Arc<Access>,
    console: &mut Console,
) -> Result<(Viewers, Front), Failure> {
    let runtime = runtime.handle();
    let address = SocketAddr::new(options.host, options.port);
    let listening = viewer_listener(runtime, address);
    let listening = listening.and_then(|listener| Ok((listener.local_addr()?, listener)));
    let (socket, listener) = listening.map_err(|why| {
        Failure::failed(format!(
            "cannot listen for viewers at {address}: {why}; --port takes another, 0 any that is free"
        ))
    })?;
    let viewers = Viewers::begin(runtime, Arc::new(links.clone())).map_err(|error| {
        Failure::failed(format!(
            "cannot listen behind the socket on loopback: {error}"
        ))
    })?;
    let address = SocketAddr::new(options.host, options.http_port);
    let page = page::serve(runtime, address, socket.port(), Arc::clone(access)).map_err(|why| {
        Failure::failed(format!(
            "cannot serve the page at {address}: {why}; --http-port takes another, 0 any that is \
                 free"
        ))
    })?;
    let query = access.query();
    let access = Arc::clone(access);
    let gate = viewers.gate.clone();
    if !gate.is_shut() {
        console.warn(
            "other users of this machine can look on without the token: this kernel lets only a process with \
             CAP_NET_ADMIN keep them from the socket behind the check",
        );
    }
    let front = Front::open(runtime, listener, gate, access, page.port());
    if !options.host.is_loopback() {
        console.warn(
            "other machines reach this address, and what is sent crosses the network in the clear, the token \
             too: who has it sees the run and may change its emulated links",
        );
    }
    if options
        .allow_origin
        .iter()
        .any(|origin| origin == NO_ORIGIN)
    {
        console
            .warn("--allow-origin null lets any page in: every page can show one of that origin");
    }
    let [page_here, socket_here] = [page, socket].map(here);
    console.result(&format!(
        "page    http://{page_here}/\nviewers ws://{socket_here}\n\
         for other users  http://{page_here}/{query}  ws://{socket_here}/{query}\n"
    ));
    if options.host.is_unspecified() {
        for address in own_addresses(options.host) {
            let [page, socket] = [page, socket].map(|at| SocketAddr::new(address, at.port()));
            console.result(&format!(
                "from other machines  http://{page}/{query}  ws://{socket}/{query}\n"
            ));
        }
    }
    Ok((viewers, front))
}

/// Where this machine's own programs find what listens at `at`: on loopback, if it is at all addresses.
fn here(at: SocketAddr) -> SocketAddr {
    let address = match at.ip() {
        IpAddr::V4(any) if any.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(any) if any.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        one => one,
    };
    SocketAddr::new(address, at.port())
}

/// The addresses at which others find this machine, of the family of `any`; IPv6 takes both in. Those of
/// loopback, and those that need an interface's name behind them, are of use to nobody else.
fn own_addresses(any: IpAddr) -> Vec<IpAddr> {
    let interfaces = nix::ifaddrs::getifaddrs();
    let addresses = interfaces.into_iter().flatten().filter_map(|interface| {
        let address = interface.address?;
        let v4 = address.as_sockaddr_in().map(|one| IpAddr::from(one.ip()));
        let v6 = address.as_sockaddr_in6().map(|one| IpAddr::from(one.ip()));
        v4.or(v6)
    });
    let mut found: Vec<IpAddr> = addresses.filter(|one| is_of_use(*one, any)).collect();
    found.sort_unstable();
    found.dedup();
    found
}

fn is_of_use(address: IpAddr, any: IpAddr) -> bool {
    let is_far = match address {
        IpAddr::V4(one) => !one.is_link_local(),
        IpAddr::V6(one) => any.is_ipv6() && !one.is_unicast_link_local(),
    };
    is_far && !address.is_loopback()
}

/// Who may look on. A machine that does not know its name has none.
fn admitted(options: &ServeOptions) -> Access {
    let machine = nix::unistd::gethostname().ok();
    let machine = machine.and_then(|name| name.into_string().ok());
    let machine = machine.filter(|name| !name.is_empty());
    Access::new(
        &options.allow_host,
        &options.allow_origin,
        machine.as_deref(),
    )
}

/// What [`front`] decides by the head of a request, of a machine called `machine` where nothing more was
/// allowed: the host it names, or why it is refused; `None` while the head is not whole.
pub(crate) fn judge_head(
    bytes: &[u8],
    machine: &str,
    page_port: u16,
) -> Option<Result<String, Refusal>> {
    let head = head::parse(bytes)?;
    Some(head.and_then(|head| {
        Access::new(&[], &[], Some(machine)).judge(&head, page_port)?;
        head.host.ok_or(Refusal::NoHost)
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_with_nothing_in_it_yet_is_not_that_of_a_finished_run() {
        let name = format!("hil-recorder-not-begun-{}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        let run = RunFolder::existing(&folder);
        // One of a program that keeps no records.
        fs::create_dir_all(&folder).unwrap();
        assert!(!has_not_begun(&folder));
        fs::create_dir(run.records()).unwrap();
        assert!(has_not_begun(&folder));
        fs::write(run.summary(), "{}").unwrap();
        assert!(!has_not_begun(&folder));
        fs::remove_file(run.summary()).unwrap();
        fs::write(run.records().join("x.rec"), "").unwrap();
        assert!(!has_not_begun(&folder));
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn only_addresses_that_others_reach_are_said() {
        let of =
            |address: &str, any: &str| is_of_use(address.parse().unwrap(), any.parse().unwrap());
        assert!(of("192.0.2.7", "0.0.0.0") && of("192.0.2.7", "::") && of("2001:db8::1", "::"));
        for (address, any) in [
            ("127.0.0.1", "0.0.0.0"),
            ("169.254.1.1", "0.0.0.0"),
            ("2001:db8::1", "0.0.0.0"),
            ("fe80::1", "::"),
            ("::1", "::"),
        ] {
            assert!(!of(address, any), "{address}");
        }
    }

    #[test]
    fn a_run_that_goes_on_takes_the_place_of_its_own_playback_and_of_what_is_over() {
        let showing = |is_over, is_playback| Showing {
            name: "x-1",
            is_over,
            is_playback,
        };
        assert!(gives_way(showing(false, true), "x-1"));
        assert!(!gives_way(showing(true, false), "x-1"));
        assert!(gives_way(showing(true, false), "x-2"));
        assert!(!gives_way(showing(false, true), "x-2"));
    }
}
