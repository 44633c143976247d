//! Reads what came of a run and shows what is due, round by round; waits for a run where there is
//! none.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use foxglove::websocket::Parameter;
use hil_platform::console::Console;
use serde_json::{Value, json};

use super::parameters::{Links, RunWithLinks};
use super::recording::Recording;
use super::source::{Progress, Source, Warning};
use super::viewers::Viewers;
use crate::cli::RecordOptions;
use crate::view::Body;
use crate::view::fleet::FleetView;
use crate::view::state::RunState;

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
    /// Itself, if it goes on.
    pub(crate) links: Option<RunWithLinks>,
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
    target: Option<RecordOptions>,
    recording: Option<Recording>,
    /// Recordings that were begun.
    recorded_count: usize,
    /// A recording before this one came to nothing.
    has_failed: bool,
    due: Due,
}

impl Engine {
    /// Nothing is shown yet.
    pub(crate) fn new(viewers: Viewers, links: Links, target: Option<RecordOptions>) -> Self {
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
        self.recording = goes_on.map(|(target, run)| {
            self.recorded_count += 1;
            Recording::begin(&run.folder, target, self.recorded_count)
        });
        self.shown = Some(shown);
        self.due = Due::default();
    }

    /// The run that is shown.
    pub(crate) fn showing(&self) -> Option<Showing<'_>> {
        let shown = self.shown.as_ref()?;
        Some(Showing {
            name: &shown.state.facts.name,
            is_over: shown.state.how_ended.is_some(),
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
        let Self { viewers, due, .. } = self;
        let Some(shown) = &mut self.shown else {
            let now_ns = realtime_ns();
            if is_due(&mut due.run, RUN_PERIOD) {
                let run = waiting(viewers.server.client_count());
                viewers.live("/live/run", now_ns, run);
            }
            viewers.welcome(now_ns);
            return;
        };
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
        let now_ns = source.now_ns();
        let mut is_over = state.how_ended.is_some();
        match progress {
            Progress::Going => {}
            Progress::Rewound => {
                state.rewind();
                is_over = false;
                *due = Due::default();
            }
            Progress::Ended(how) => {
                state.ended_ns.get_or_insert(now_ns);
                if !is_over {
                    *due = Due::default();
                } else if state.how_ended.as_ref() != Some(&how) {
                    due.run = None;
                }
                state.how_ended = Some(how);
            }
        }
        if let Some(map) = state.pictures.fleet.as_mut().and_then(FleetView::new_map) {
            viewers.live("/live/map", now_ns, json!(map));
        }
        // After the end the last picture stays, the one with what came in the last look.
        if !is_over {
            pictures(state, viewers, due, now_ns);
        }
        if is_due(&mut due.run, RUN_PERIOD) {
            if let Some(recording) = &mut self.recording {
                recording.look(console);
            }
            let mut run = words(shown, &self.links, viewers.server.client_count(), now_ns);
            let file = self.recording.as_ref().map(|recording| &recording.path);
            run["recorder"]["file"] = json!(file);
            viewers.live("/live/run", now_ns, run);
            let parameters = self.links.list();
            if parameters != self.told {
                self.told.clone_from(&parameters);
                viewers.server.publish_parameter_values(parameters);
            }
        }
        viewers.welcome(now_ns);
    }
}

/// Shows robots, arms, channels and single messages, each when it is due.
fn pictures(state: &mut RunState, viewers: &mut Viewers, due: &mut Due, now_ns: i64) {
    let shown = &mut state.pictures;
    if is_due(&mut due.picture, Duration::from_nanos(shown.period_ns()))
        && let Some(origin_ns) = state.origin_ns
    {
        if let Some(fleet) = &mut shown.fleet {
            let picture = json!(fleet.picture(now_ns, origin_ns));
            viewers.live("/live/fleet", now_ns, picture);
        }
        if shown.arms.is_known() {
            let picture = json!(shown.arms.picture(now_ns, origin_ns));
            viewers.live("/live/arms", now_ns, picture);
        }
    }
    if is_due(&mut due.channels, CHANNELS_PERIOD) {
        let (channels, losses) = state.channels(now_ns);
        viewers.live("/live/channels", now_ns, channels);
        for loss in losses {
            viewers.live("/live/losses", now_ns, loss);
        }
        for (place, account) in state.accounts.iter_mut().enumerate() {
            for stamps in account.take_shown() {
                viewers.latency(place, now_ns, &stamps);
            }
        }
    }
}

/// `/live/run`.
fn words(shown: &mut Shown, links: &Links, viewer_count: usize, now_ns: i64) -> Value {
    let Shown { state, source, .. } = shown;
    let is_playback = shown.playback_speed.is_some();
    let is_over = state.how_ended.is_some() || is_playback;
    let listed = state.facts.links.iter().map(|link| {
        let ways = ["forward", "backward"];
        let ways = ways.map(|way| links.describe(&link.name, &link.via, way, is_over));
        json!({
            "name": link.name, "via": link.via,
            "from_host": link.between[0], "to_host": link.between[1], "directions": ways,
        })
    });
    let mut warnings = source.warnings();
    let problem = state
        .pictures
        .fleet
        .as_ref()
        .and_then(|fleet| fleet.problem.clone());
    warnings.extend(problem.map(Warning::of_the_run));
    let overruns = source.overruns();
    let mut run = state.run(now_ns);
    run["links"] = listed.collect();
    run["is_playback"] = json!(is_playback);
    run["speed"] = json!(shown.playback_speed.unwrap_or(1.0));
    run["warnings"] = json!(warnings);
    run["overruns"] = json!(overruns.as_ref().map(|all| &all.processes));
    run["overrun_hosts"] = json!(overruns.as_ref().map(|all| &all.hosts));
    run["recorder"]["missed_count"] = json!(source.missed_count());
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
