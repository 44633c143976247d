//! Conditions of emulated links as parameters that viewers see and set. What a condition does is the
//! link's business; here are names, ranges and refusals. A thread of its own gives the orders, as a
//! link's gateway may take a moment to confirm one.
//!
//! | `link.<link>.<way>.…` | value | what |
//! |---|---|---|
//! | `delay_ms` | 0 to 60 000 | fixed delay; absent while the topology gives a law and no number |
//! | `loss_ratio` | 0 to 1 | independent losses; absent likewise |
//! | `is_cut` | true, false | nothing gets through |

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use std::{fs, thread};

use foxglove::websocket::{
    AnyClient, GetParametersResponder, Parameter, ParameterHandler, ParameterType, ParameterValue,
    SetParametersResponder,
};
use hil_link::condition::LinkCondition;
use hil_topology::read_duration;
use hil_watch::link::RunLinks;
use serde_json::{Value, json};

/// How often it is looked whether somebody else changed a link.
const LOOK_PERIOD: Duration = Duration::from_millis(500);
/// Requests that wait; a viewer that asks faster is refused.
const WAITING_MAX: usize = 64;

const DELAY: &str = "delay_ms";
const LOSS: &str = "loss_ratio";
const CUT: &str = "is_cut";

/// What each direction does, by its name: `<link>.<forward or backward>`.
type Wishes = BTreeMap<String, Wish>;

/// What a direction does, as far as it has numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Wish {
    delay_ms: Option<f64>,
    loss_ratio: Option<f64>,
    /// Somebody set a number: both hold in place of the topology's law.
    is_set: bool,
    is_cut: bool,
}

impl Wish {
    /// The same with the value of `parameter` as its part called `what`.
    fn with(mut self, what: &str, parameter: &Parameter) -> Result<Self, String> {
        match (what, number(parameter), &parameter.value) {
            (DELAY, Some(ms), _) => {
                self.delay_ms = Some(within(ms, 60_000.0, "ms")?);
                self.is_set = true;
            }
            (LOSS, Some(ratio), _) => {
                self.loss_ratio = Some(within(ratio, 1.0, "")?);
                self.is_set = true;
            }
            (CUT, _, Some(ParameterValue::Bool(is_cut))) => self.is_cut = *is_cut,
            (DELAY | LOSS, ..) => return Err("must be a number".to_owned()),
            (CUT, ..) => return Err("must be true or false".to_owned()),
            _ => return Err(format!("there is {DELAY}, {LOSS} and {CUT}")),
        }
        Ok(self)
    }

    /// What the gateway is asked for. A cut link stays cut; what it does after that is remembered
    /// here. Numbers that are only the topology's stand beside its law, not in place of it.
    fn condition(self) -> LinkCondition {
        if self.is_cut {
            return LinkCondition::Cut;
        }
        if !self.is_set {
            return LinkCondition::Topology;
        }
        LinkCondition::Fixed {
            delay: Duration::from_secs_f64(self.delay_ms.unwrap_or(0.0) / 1e3),
            loss_ratio: self.loss_ratio.unwrap_or(0.0),
        }
    }
}

/// A run that goes on, whose links can be changed.
#[derive(Debug, Clone)]
pub(crate) struct RunWithLinks {
    /// Its folder.
    pub(crate) folder: PathBuf,
    /// Its resolved topology.
    pub(crate) topology: Value,
}

/// The run that is shown from now on, if its links can be changed.
struct Change(Option<RunWithLinks>);

/// Something to do for a viewer, or for the run's sake.
enum Request {
    /// Another run is shown.
    Wake,
    Get(Vec<String>, GetParametersResponder),
    Set(Vec<Parameter>, AnyClient, SetParametersResponder),
}

/// The links of whatever run is shown; none of a run that is played back.
#[derive(Clone)]
pub(crate) struct Links {
    ask: SyncSender<Request>,
    /// Beside the queue, so that it is not lost when viewers fill that.
    change: Arc<Mutex<Option<Change>>>,
    wishes: Arc<Mutex<Wishes>>,
}

impl Links {
    /// Begins without a run. The thread ends with the last of its clones.
    pub(crate) fn begin() -> Self {
        let (ask, asked) = sync_channel(WAITING_MAX);
        let links = Self {
            ask,
            change: Arc::default(),
            wishes: Arc::default(),
        };
        let worker = Worker {
            change: Arc::clone(&links.change),
            wishes: Arc::clone(&links.wishes),
            ..Worker::default()
        };
        thread::spawn(move || worker.work(&asked));
        links
    }

    /// From now on, the links of this run; those of no run with `None`.
    pub(crate) fn show(&self, run: Option<RunWithLinks>) {
        *locked(&self.change) = Some(Change(run));
        // A full queue wakes the thread as well.
        let _is_heard = self.ask.try_send(Request::Wake).is_ok();
    }

    /// What the direction `way` of `link` does: `condition`, `is_settable` and `why_not` of
    /// `/live/run`.
    pub(crate) fn describe(&self, link: &str, via: &str, way: &str, is_over: bool) -> Value {
        let wish = locked(&self.wishes).get(&format!("{link}.{way}")).copied();
        let condition = wish
            .map(|wish| json!({ DELAY: wish.delay_ms, LOSS: wish.loss_ratio, CUT: wish.is_cut }));
        let why_not = match wish {
            _ if via != "emulated" => Some(format!("it is carried by {via}, not emulated")),
            _ if is_over => Some("the run does not go on".to_owned()),
            None => Some("no channel goes this way, or another host emulates it".to_owned()),
            Some(_) => None,
        };
        json!({
            "way": way, "condition": condition,
            "is_settable": why_not.is_none(), "why_not": why_not,
        })
    }

    /// Every parameter with its present value.
    pub(crate) fn list(&self) -> Vec<Parameter> {
        named(&locked(&self.wishes), &[])
    }
}

impl ParameterHandler for Links {
    fn get(
        &self,
        client: AnyClient,
        names: Vec<String>,
        _request: Option<String>,
        responder: GetParametersResponder,
    ) {
        if self.ask.try_send(Request::Get(names, responder)).is_err() {
            client.send_error("too many requests at once");
        }
    }

    fn set(
        &self,
        client: AnyClient,
        parameters: Vec<Parameter>,
        _request: Option<String>,
        responder: SetParametersResponder,
    ) {
        let request = Request::Set(parameters, client.clone(), responder);
        if self.ask.try_send(request).is_err() {
            client.send_error("too many requests at once");
        }
    }
}

/// The thread that gives orders.
#[derive(Default)]
struct Worker {
    shown: Option<RunWithLinks>,
    run: Option<RunLinks>,
    /// The launch files when the links were opened.
    launches: BTreeMap<OsString, u64>,
    change: Arc<Mutex<Option<Change>>>,
    wishes: Arc<Mutex<Wishes>>,
}

impl Worker {
    fn work(mut self, asked: &Receiver<Request>) {
        loop {
            let request = asked.recv_timeout(LOOK_PERIOD);
            let change = locked(&self.change).take();
            if let Some(Change(shown)) = change {
                self.run = None;
                self.shown = shown;
                locked(&self.wishes).clear();
                self.look();
            }
            match request {
                Ok(Request::Wake) => {}
                Ok(Request::Get(names, responder)) => {
                    self.look();
                    responder.respond(named(&locked(&self.wishes), &names));
                }
                Ok(Request::Set(parameters, client, responder)) => {
                    let mut names = Vec::new();
                    for parameter in parameters {
                        if let Err(why) = self.set(&parameter) {
                            client.send_error(format!("{}: {why}", parameter.name));
                        }
                        names.push(parameter.name);
                    }
                    self.look();
                    // What they are now, whether the wish was granted or not.
                    responder.respond(named(&locked(&self.wishes), &names));
                }
                Err(RecvTimeoutError::Timeout) => self.look(),
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// Takes over what the gateways have on record.
    fn look(&mut self) {
        let Some(RunWithLinks { folder, topology }) = &self.shown else {
            return;
        };
        // Gateways begin after the run is announced, one after the other, and may begin again. The links
        // are opened anew only then: to open one that replays a trace is to read the trace.
        let launches = launches_in(folder);
        if (self.run.is_none() || launches != self.launches)
            && let Ok(run) = RunLinks::open(folder)
        {
            self.run = Some(run);
            self.launches = launches;
        }
        let Some(run) = &self.run else {
            return;
        };
        for direction in run.directions() {
            if let Ok((condition, _)) = run.condition(direction) {
                let spec = &topology["links"][&direction.link][direction.way.word()];
                let mut wishes = locked(&self.wishes);
                let name = direction.name();
                let before = wishes.get(&name).copied();
                wishes.insert(name, wish_of(condition, before, spec));
            }
        }
    }

    fn set(&mut self, parameter: &Parameter) -> Result<(), String> {
        let run = self.run.as_mut();
        let run = run.ok_or("no run goes on whose links could be changed")?;
        let unknown = "a link's parameter is called link.<link>.<forward or backward>.<what>";
        let inner = parameter.name.strip_prefix("link.").ok_or(unknown)?;
        let (direction, what) = inner.rsplit_once('.').ok_or(unknown)?;
        let found = run.named(direction).map_err(|error| error.to_string())?;
        let [direction] = &found[..] else {
            return Err(unknown.to_owned());
        };
        let name = direction.name();
        let wish = locked(&self.wishes).get(&name).copied();
        let wish = wish.unwrap_or_default().with(what, parameter)?;
        run.set(direction, wish.condition())
            .map_err(|error| error.to_string())?;
        locked(&self.wishes).insert(name, wish);
        Ok(())
    }
}

fn locked<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Names and lengths of the launch files of the run in `folder`: they change with every start of a
/// process, and while a file is being written.
fn launches_in(folder: &Path) -> BTreeMap<OsString, u64> {
    let entries = fs::read_dir(folder.join("launch"));
    let entries = entries.into_iter().flatten().flatten();
    entries
        .filter_map(|entry| Some((entry.file_name(), entry.metadata().ok()?.len())))
        .collect()
}

fn number(parameter: &Parameter) -> Option<f64> {
    match parameter.value {
        Some(ParameterValue::Float64(value)) => Some(value),
        Some(ParameterValue::Integer(value)) => Some(value as f64),
        _ => None,
    }
}

fn within(value: f64, max: f64, unit: &str) -> Result<f64, String> {
    let is_within = (0.0..=max).contains(&value);
    let range = || {
        format!("{value} is outside 0 to {max} {unit}")
            .trim_end()
            .to_owned()
    };
    is_within.then_some(value).ok_or_else(range)
}

/// What a direction does, by the gateway's record; numbers of `spec`, what the topology says of it, where
/// that has some.
fn wish_of(condition: LinkCondition, before: Option<Wish>, spec: &Value) -> Wish {
    let of_topology = || {
        let delay = spec["delay"].as_str().and_then(read_duration);
        Wish {
            delay_ms: delay.map(|delay| delay.as_secs_f64() * 1e3),
            loss_ratio: spec["loss_ratio"].as_f64(),
            ..Wish::default()
        }
    };
    match condition {
        LinkCondition::Fixed { delay, loss_ratio } => Wish {
            delay_ms: Some(delay.as_secs_f64() * 1e3),
            loss_ratio: Some(loss_ratio),
            is_set: true,
            is_cut: false,
        },
        LinkCondition::Cut => Wish {
            is_cut: true,
            ..before.unwrap_or_else(of_topology)
        },
        LinkCondition::Topology => of_topology(),
    }
}

/// The parameters with these names, all of them without one.
fn named(wishes: &Wishes, names: &[String]) -> Vec<Parameter> {
    let all = wishes.iter().flat_map(|(direction, wish)| {
        let parameter = |what: &str, r#type, value| Parameter {
            name: format!("link.{direction}.{what}"),
            r#type,
            value: Some(value),
        };
        let number = |what, value: Option<f64>| {
            let value = ParameterValue::Float64(value?);
            Some(parameter(what, Some(ParameterType::Float64), value))
        };
        let cut = parameter(CUT, None, ParameterValue::Bool(wish.is_cut));
        let numbers = [number(DELAY, wish.delay_ms), number(LOSS, wish.loss_ratio)];
        numbers.into_iter().flatten().chain([cut])
    });
    all.filter(|one| names.is_empty() || names.contains(&one.name))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(wish: Wish, what: &str, value: ParameterValue) -> Wish {
        let parameter = Parameter {
            name: what.to_owned(),
            r#type: None,
            value: Some(value),
        };
        wish.with(what, &parameter).unwrap()
    }

    /// What the gateway is asked for when the link is cut and then no longer, with a look at its
    /// record between.
    fn cut_and_back(wish: Wish) -> LinkCondition {
        let cut = after(wish, CUT, ParameterValue::Bool(true));
        assert_eq!(cut.condition(), LinkCondition::Cut);
        let seen = wish_of(LinkCondition::Cut, Some(cut), &Value::Null);
        after(seen, CUT, ParameterValue::Bool(false)).condition()
    }

    #[test]
    fn a_link_that_was_cut_does_afterwards_what_it_did_before() {
        let spec = json!({ "delay": "5 ms", "loss_ratio": 0.1 });
        let wish = wish_of(LinkCondition::Topology, None, &spec);
        assert_eq!(wish.loss_ratio, Some(0.1));
        assert_eq!(cut_and_back(wish), LinkCondition::Topology);

        let set = after(wish, LOSS, ParameterValue::Float64(0.5));
        let condition = set.condition();
        assert!(matches!(condition, LinkCondition::Fixed { .. }));
        assert_eq!(cut_and_back(set), condition);

        let fixed = LinkCondition::Fixed {
            delay: Duration::from_millis(250),
            loss_ratio: 0.25,
        };
        let others = wish_of(fixed, Some(wish), &spec);
        assert_eq!(cut_and_back(others), fixed);
        // Somebody cut it before anybody looked.
        let unseen = wish_of(LinkCondition::Cut, None, &spec);
        let uncut = after(unseen, CUT, ParameterValue::Bool(false));
        assert_eq!(uncut.condition(), LinkCondition::Topology);
    }
}
