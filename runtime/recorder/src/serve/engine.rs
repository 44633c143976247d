//! Reads what came of a run and shows what is due, round by round; waits for a run where there is
//! none.

use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use foxglove::websocket::Parameter;
use hil_platform::console::Console;
use serde_json::{Value, json};

use super::parameters::Links;
use super::recording::{Recording, Target};
use super::source::{Progress, Source, Warning};
use super::viewers::Viewers;
use crate::view::Body;
use crate::view::facts::RunFacts;
use crate::view::state::RunState;

/// Between two pictures of robots and arms.
const PICTURE_PERIOD: Duration = Duration::from_millis(50);
/// Between two pictures of fleets of many robots.
const LARGE_PICTURE_PERIOD: Duration = Duration::from_millis(200);
/// Between two accounts of the channels.
const CHANNELS_PERIOD: Duration = Duration::from_millis(100);
/// Between two words on the run.
const RUN_PERIOD: Duration = Duration::from_secs(1);

/// Between two rounds, where shared memory does not ask for more: half of what is between two pictures.
pub(super) const REST: Duration = Duration::from_millis(25);

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

/// A run that is shown.
pub(crate) struct Shown {
    /// How far it has come.
    pub(crate) state: RunState,
    /// Where its records come from.
    pub(crate) source: Box<dyn Source>,
    /// How fast, if it is played back.
    pub(crate) playback_speed: Option<f64>,
    /// Its folder and resolved topology, if it goes on: its links can be changed.
    pub(crate) links: Option<(PathBuf, Value)>,
    /// What became known of what is amiss, once a second.
    warnings: Vec<Warning>,
    /// Ticks skipped, by process, and of which hosts they are known, as often.
    overruns: [Value; 2],
}

impl Shown {
    /// A run of which nothing has been read.
    pub(crate) fn new(
        facts: RunFacts,
        source: Box<dyn Source>,
        playback_speed: Option<f64>,
        links: Option<(PathBuf, Value)>,
    ) -> Self {
        Self {
            state: RunState::new(facts),
            source,
            playback_speed,
            links,
            warnings: Vec::new(),
            overruns: [Value::Null, Value::Null],
        }
    }

    fn look_for_warnings(&mut self) {
        self.warnings = self.source.warnings();
        let own = self.state.problem();
        self.warnings.extend(own.map(|what| Warning {
            process: None,
            what: what.to_owned(),
        }));
        let overruns = self.source.overruns();
        let overruns = overruns.map(|all| [json!(all.processes), json!(all.hosts)]);
        self.overruns = overruns.unwrap_or_default();
    }
}

/// Which run is shown, and how it stands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Showing<'a> {
    /// Its name.
    pub(crate) name: &'a str,
    /// No more records come.
    pub(crate) is_over: bool,
    /// It is played back.
    pub(crate) is_playback: bool,
}

/// From records to viewers.
pub(crate) struct Engine {
    shown: Option<Shown>,
    viewers: Viewers,
    links: Links,
    /// Parameters as they were told last.
    told: Vec<Parameter>,
    /// Where what is shown is recorded, and the recording.
    target: Option<Target>,
    recording: Option<Recording>,
    /// Recordings that were begun.
    recorded_count: usize,
    /// A recording before this one came to nothing.
    has_failed: bool,
    due: Due,
}

impl Engine {
    /// Nothing is shown yet.
    pub(crate) fn new(viewers: Viewers, links: Links, target: Option<Target>) -> Self {
        Self {
            shown: None,
            viewers,
            links,
            told: Vec::new(),
            target,
            recording: None,
            recorded_count: 0,
            has_failed: false,
            due: Due::default(),
        }
    }

    /// From now on shows this run.
    pub(crate) fn show(&mut self, shown: Shown, console: &mut Console) {
        self.viewers.forget();
        let words = self.viewers.offer(&shown.state.facts);
        for words in words.unwrap_or_else(|error| vec![error.to_string()]) {
            console.warn(&words);
        }
        self.links.show(shown.links.clone());
        if let Some(mut before) = self.recording.take() {
            before.end(console);
            self.has_failed |= before.has_failed;
        }
        // What is played back is on record already.
        let goes_on = self.target.as_ref().zip(shown.links.as_ref());
        self.recording = goes_on.map(|(target, (folder, _))| {
            self.recorded_count += 1;
            Recording::begin(folder, target, self.recorded_count)
        });
        self.shown = Some(shown);
        self.due = Due::default();
    }

    /// The run that is shown.
    pub(crate) fn showing(&self) -> Option<Showing<'_>> {
        let shown = self.shown.as_ref()?;
        Some(Showing {
            name: &shown.state.facts.name,
            is_over: shown.state.is_over(),
            is_playback: shown.playback_speed.is_some(),
        })
    }

    /// How long it may rest before the next round: shared memory has room for little.
    pub(crate) fn rest(&mut self) -> Duration {
        let shown = self.shown.as_mut();
        let asked = shown.and_then(|shown| shown.source.rest());
        asked.unwrap_or(REST)
    }

    /// The viewers, at the end, and whether all that was to be recorded is.
    pub(crate) fn into_viewers(self, console: &mut Console) -> (Viewers, bool) {
        self.links.show(None);
        let mut has_failed = self.has_failed;
        if let Some(mut recording) = self.recording {
            recording.end(console);
            has_failed |= recording.has_failed;
        }
        (self.viewers, !has_failed)
    }

    /// Reads what came and shows what is due.
    pub(crate) fn round(&mut self, console: &mut Console) {
        let Some(shown) = &mut self.shown else {
            let now_ns = realtime_ns();
            if is_due(&mut self.due.run, RUN_PERIOD) {
                self.viewers
                    .live("/live/run", now_ns, waiting(self.viewers.count()));
            }
            self.viewers.welcome(now_ns);
            return;
        };
        let is_last = read(shown, &mut self.viewers, &mut self.due, console);
        let now_ns = shown.source.now_ns();
        let due = &mut self.due;
        pictures(shown, &mut self.viewers, due, now_ns, is_last);
        if is_due(&mut self.due.run, RUN_PERIOD) {
            shown.look_for_warnings();
            if let Some(recording) = &mut self.recording {
                recording.look(console);
            }
            let mut run = words(shown, &self.links, self.viewers.count(), now_ns);
            let file = self.recording.as_ref().map(|recording| &recording.path);
            run["recorder"]["file"] = json!(file);
            self.viewers.live("/live/run", now_ns, run);
            let parameters = self.links.list();
            if parameters != self.told {
                self.told.clone_from(&parameters);
                self.viewers.server.publish_parameter_values(parameters);
            }
        }
        self.viewers.welcome(now_ns);
    }
}

/// Takes what came; true when it was the last.
fn read(shown: &mut Shown, viewers: &mut Viewers, due: &mut Due, console: &mut Console) -> bool {
    let Shown { state, source, .. } = shown;
    if !state.facts.has_one_clock && source.has_one_clock() {
        state.compare_clocks();
    }
    let progress = source.poll(&mut |record| {
        state.take(record);
        if let Body::Message(payload) = &record.body {
            viewers.message(record.channel, record.at_ns, payload);
        }
    });
    for problem in source.take_problems() {
        console.warn(&problem);
    }
    match progress {
        Progress::Going => {}
        Progress::Rewound => {
            state.rewind();
            *due = Due::default();
        }
        Progress::Ended(how) => {
            let is_last = !state.is_over();
            if state.end(how, source.now_ns()) {
                due.run = None;
            }
            if is_last {
                *due = Due::default();
            }
            return is_last;
        }
    }
    false
}

fn pictures(shown: &mut Shown, viewers: &mut Viewers, due: &mut Due, now_ns: i64, is_last: bool) {
    let is_over = shown.state.is_over();
    let state = &mut shown.state;
    if let Some(map) = state.new_map() {
        viewers.live("/live/map", now_ns, map);
    }
    // After the end the last picture stays, the one with what came in the last look.
    if is_over && !is_last {
        return;
    }
    let period = if state.is_small() {
        PICTURE_PERIOD
    } else {
        LARGE_PICTURE_PERIOD
    };
    if is_due(&mut due.picture, period) {
        if let Some(fleet) = state.fleet(now_ns) {
            viewers.live("/live/fleet", now_ns, fleet);
        }
        if let Some(arms) = state.arms(now_ns) {
            viewers.live("/live/arms", now_ns, arms);
        }
    }
    if is_due(&mut due.channels, CHANNELS_PERIOD) {
        let (channels, losses) = state.channels(now_ns);
        viewers.live("/live/channels", now_ns, channels);
        for loss in losses {
            viewers.live("/live/losses", now_ns, loss);
        }
        for place in 0..state.facts.channels.len() {
            for stamps in state.shown(place) {
                viewers.latency(place, now_ns, &stamps);
            }
        }
    }
}

/// `/live/run`.
fn words(shown: &Shown, links: &Links, viewer_count: usize, now_ns: i64) -> Value {
    let is_over = shown.state.is_over() || shown.playback_speed.is_some();
    let listed = shown.state.facts.links.iter().map(|link| {
        let ways = ["forward", "backward"];
        let ways = ways.map(|way| links.describe(&link.name, &link.via, way, is_over));
        json!({
            "name": link.name, "via": link.via,
            "from_host": link.between[0], "to_host": link.between[1], "directions": ways,
        })
    });
    let mut run = shown.state.run(now_ns);
    run["links"] = listed.collect();
    run["is_playback"] = json!(shown.playback_speed.is_some());
    run["speed"] = json!(shown.playback_speed.unwrap_or(1.0));
    run["warnings"] = json!(shown.warnings);
    let [overruns, hosts] = &shown.overruns;
    run["overruns"] = overruns.clone();
    run["overrun_hosts"] = hosts.clone();
    run["recorder"]["missed_count"] = json!(shown.source.missed_count());
    run["recorder"]["viewer_count"] = json!(viewer_count);
    run
}

/// `/live/run` while there is none.
fn waiting(viewer_count: usize) -> Value {
    json!({
        "name": null, "case": null, "state": "waiting", "how": null,
        "is_playback": false, "speed": 1.0, "elapsed_s": null, "duration_s": null,
        "hosts_here": [], "hosts": [], "topology_hash": null, "seed": null,
        "channels": [], "links": [], "warnings": [], "overruns": null, "overrun_hosts": null,
        "recorder": {
            "file": null, "read_count": 0, "missed_count": null, "viewer_count": viewer_count,
        },
    })
}

fn realtime_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |since| {
        i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
    })
}
