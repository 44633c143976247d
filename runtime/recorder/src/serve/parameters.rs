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
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use foxglove::websocket::{
    AnyClient, GetParametersResponder, Parameter, ParameterHandler, ParameterType, ParameterValue,
    SetParametersResponder,
};
use hil_models::link::condition::LinkCondition;
use hil_runtime::link::{LinkDirection, RunLinks};
use hil_runtime::topology::read_duration;
use serde_json::{Value, json};

/// How often it is looked whether somebody else changed a link.
const LOOK_PERIOD: Duration = Duration::from_millis(500);
/// Requests that wait; a viewer that asks faster is refused.
const WAITING_MAX: usize = 64;

const DELAY: &str = "delay_ms";
const LOSS: &str = "loss_ratio";
const CUT: &str = "is_cut";

/// What a direction does, as far as it has numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Wish {
    delay_ms: Option<f64>,
    loss_ratio: Option<f64>,
    is_cut: bool,
}

/// Something to do for a viewer, or for the run's sake.
enum Request {
    /// Another run is shown, or one whose links are as they were.
    Show(Option<(PathBuf, Value)>),
    Get(Vec<String>, GetParametersResponder),
    Set(Vec<Parameter>, AnyClient, SetParametersResponder),
}

/// The links of whatever run is shown; none of a run that is played back.
#[derive(Clone)]
pub(crate) struct Links {
    ask: SyncSender<Request>,
    known: Arc<Mutex<BTreeMap<(String, String), Wish>>>,
}

impl Links {
    /// Begins without a run. The thread ends with the last of its clones.
    pub(crate) fn begin() -> Self {
        let (ask, asked) = sync_channel(WAITING_MAX);
        let known = Arc::new(Mutex::new(BTreeMap::new()));
        let worker = Worker {
            run: None,
            folder: None,
            known: Arc::clone(&known),
            topology: Value::Null,
            wishes: BTreeMap::new(),
        };
        thread::spawn(move || worker.work(&asked));
        Self { ask, known }
    }

    /// From now on, the links of the run in `folder` with this resolved topology; those of no run
    /// with `None`.
    pub(crate) fn show(&self, run: Option<(PathBuf, Value)>) {
        // A full queue means that the thread is about to look anyway; it is empty when runs change.
        let _is_heard = self.ask.try_send(Request::Show(run)).is_ok();
    }

    fn known(&self) -> MutexGuard<'_, BTreeMap<(String, String), Wish>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the direction `way` of `link` does: `condition`, `is_settable` and `why_not` of
    /// `/live/run`.
    pub(crate) fn describe(&self, link: &str, via: &str, way: &str, is_over: bool) -> Value {
        let key = (link.to_owned(), way.to_owned());
        let wish = self.known().get(&key).copied();
        let condition = wish
            .map(|wish| json!({ DELAY: wish.delay_ms, LOSS: wish.loss_ratio, CUT: wish.is_cut }));
        let why_not = match wish {
            _ if via != "emulated" => Some(format!("it is carried by {via}, not emulated")),
            _ if is_over => Some("the run does not go on".to_owned()),
            None => Some("another host emulates this way".to_owned()),
            Some(_) => None,
        };
        json!({
            "way": way, "condition": condition,
            "is_settable": why_not.is_none(), "why_not": why_not,
        })
    }

    /// Every parameter with its present value.
    pub(crate) fn list(&self) -> Vec<Parameter> {
        let known = self.known();
        known
            .iter()
            .flat_map(|(key, wish)| parameters_of(key, wish))
            .collect()
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
struct Worker {
    run: Option<RunLinks>,
    folder: Option<PathBuf>,
    known: Arc<Mutex<BTreeMap<(String, String), Wish>>>,
    topology: Value,
    wishes: BTreeMap<(String, String), Wish>,
}

impl Worker {
    fn work(mut self, asked: &Receiver<Request>) {
        loop {
            match asked.recv_timeout(LOOK_PERIOD) {
                Ok(Request::Show(run)) => self.show(run),
                Ok(Request::Get(names, responder)) => {
                    self.look();
                    responder.respond(self.named(&names));
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
                    responder.respond(self.named(&names));
                }
                Err(RecvTimeoutError::Timeout) => self.look(),
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn show(&mut self, run: Option<(PathBuf, Value)>) {
        self.wishes.clear();
        self.run = None;
        let (folder, topology) = run.unzip();
        self.folder = folder;
        self.topology = topology.unwrap_or_default();
        self.look();
    }

    /// Takes over what the gateways have on record.
    fn look(&mut self) {
        // Gateways begin after the run is announced.
        let is_empty = self
            .run
            .as_ref()
            .is_none_or(|run| run.directions().is_empty());
        if let Some(folder) = self.folder.as_ref().filter(|_| is_empty) {
            self.run = RunLinks::open(folder).ok();
        }
        if let Some(run) = &self.run {
            for direction in run.directions() {
                let Ok((condition, _)) = run.condition(direction) else {
                    continue;
                };
                let key = key_of(direction);
                let before = self.wishes.get(&key).copied();
                let wish = wish_of(condition, before, &self.topology, &key);
                self.wishes.insert(key, wish);
            }
        }
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.clone_from(&self.wishes);
    }

    fn named(&self, names: &[String]) -> Vec<Parameter> {
        let all = self
            .wishes
            .iter()
            .flat_map(|(key, wish)| parameters_of(key, wish));
        all.filter(|one| names.is_empty() || names.contains(&one.name))
            .collect()
    }

    fn set(&mut self, parameter: &Parameter) -> Result<(), String> {
        let run = self
            .run
            .as_mut()
            .ok_or("no run goes on whose links could be changed")?;
        let (direction, what) = meant(run, &parameter.name)?;
        let key = key_of(&direction);
        let mut wish = self.wishes.get(&key).copied().unwrap_or_default();
        match (what.as_str(), number(parameter), &parameter.value) {
            (DELAY, Some(ms), _) => wish.delay_ms = Some(within(ms, 60_000.0, "ms")?),
            (LOSS, Some(ratio), _) => wish.loss_ratio = Some(within(ratio, 1.0, "")?),
            (CUT, _, Some(ParameterValue::Bool(is_cut))) => wish.is_cut = *is_cut,
            (DELAY | LOSS, ..) => return Err("must be a number".to_owned()),
            (CUT, ..) => return Err("must be true or false".to_owned()),
            _ => return Err(format!("there is {DELAY}, {LOSS} and {CUT}")),
        }
        // A cut link stays cut; what it will do after that is remembered.
        let has_numbers = wish.delay_ms.is_some() || wish.loss_ratio.is_some();
        let condition = match wish {
            wish if wish.is_cut => LinkCondition::Cut,
            _ if !has_numbers => LinkCondition::Topology,
            wish => LinkCondition::Fixed {
                delay: Duration::from_secs_f64(wish.delay_ms.unwrap_or(0.0) / 1e3),
                loss_ratio: wish.loss_ratio.unwrap_or(0.0),
            },
        };
        run.set(&direction, condition)
            .map_err(|error| error.to_string())?;
        self.wishes.insert(key, wish);
        Ok(())
    }
}

fn key_of(direction: &LinkDirection) -> (String, String) {
    (direction.link.clone(), direction.way.word().to_owned())
}

/// The direction and the part of it that `name` means.
fn meant(run: &RunLinks, name: &str) -> Result<(LinkDirection, String), String> {
    let unknown =
        || "a link's parameter is called link.<link>.<forward or backward>.<what>".to_owned();
    let inner = name.strip_prefix("link.").ok_or_else(unknown)?;
    let (direction, what) = inner.rsplit_once('.').ok_or_else(unknown)?;
    let found = run.named(direction).map_err(|error| error.to_string())?;
    match <[LinkDirection; 1]>::try_from(found) {
        Ok([direction]) => Ok((direction, what.to_owned())),
        Err(_) => Err(unknown()),
    }
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

/// What a direction does, by the gateway's record; numbers of the topology where that has some.
fn wish_of(
    condition: LinkCondition,
    before: Option<Wish>,
    topology: &Value,
    (link, way): &(String, String),
) -> Wish {
    match condition {
        LinkCondition::Fixed { delay, loss_ratio } => Wish {
            delay_ms: Some(delay.as_secs_f64() * 1e3),
            loss_ratio: Some(loss_ratio),
            is_cut: false,
        },
        LinkCondition::Cut => Wish {
            is_cut: true,
            ..before.unwrap_or_default()
        },
        LinkCondition::Topology => {
            let spec = &topology["links"][link][way];
            let delay = spec["delay"].as_str().and_then(read_duration);
            Wish {
                delay_ms: delay.map(|delay| delay.as_secs_f64() * 1e3),
                loss_ratio: spec["loss_ratio"].as_f64(),
                is_cut: false,
            }
        }
    }
}

fn parameters_of((link, way): &(String, String), wish: &Wish) -> Vec<Parameter> {
    let named = |what: &str| format!("link.{link}.{way}.{what}");
    let numbers = [(DELAY, wish.delay_ms), (LOSS, wish.loss_ratio)];
    let numbers = numbers.into_iter().filter_map(|(what, value)| {
        Some(Parameter {
            name: named(what),
            r#type: Some(ParameterType::Float64),
            value: Some(ParameterValue::Float64(value?)),
        })
    });
    let cut = Parameter {
        name: named(CUT),
        r#type: None,
        value: Some(ParameterValue::Bool(wish.is_cut)),
    };
    numbers.chain([cut]).collect()
}
