//! Conditions of emulated links as parameters that viewers see and set. What a condition does is the
//! link's business; here are names, ranges and refusals.

use std::sync::{Arc, Mutex, PoisonError};

use foxglove::websocket::{
    AnyClient, GetParametersResponder, Parameter, ParameterHandler, SetParametersResponder,
};

/// Whoever can read and change links of a run.
pub(crate) trait LinkControl: Send {
    /// Every parameter with its present value.
    fn list(&mut self) -> Vec<Parameter>;

    /// Sets one.
    ///
    /// # Errors
    /// Why it cannot be set, with the range it may have.
    fn set(&mut self, parameter: &Parameter) -> Result<(), String>;
}

/// The links of whatever run is shown; none of a run that is played back.
#[derive(Clone, Default)]
pub(crate) struct Links {
    control: Arc<Mutex<Option<Box<dyn LinkControl>>>>,
}

impl Links {
    /// From now on, these.
    pub(crate) fn replace(&self, control: Option<Box<dyn LinkControl>>) {
        *self.lock() = control;
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Box<dyn LinkControl>>> {
        self.control.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Every parameter with its present value; those called `names` only, if there are any.
    pub(crate) fn list(&self, names: &[String]) -> Vec<Parameter> {
        let mut control = self.lock();
        let all = control
            .as_mut()
            .map_or_else(Vec::new, |control| control.list());
        let is_asked = |one: &Parameter| names.is_empty() || names.contains(&one.name);
        all.into_iter().filter(is_asked).collect()
    }

    /// Sets what can be set; the words of each refusal.
    fn set(&self, parameters: &[Parameter]) -> Vec<String> {
        let mut control = self.lock();
        let mut refused = Vec::new();
        for parameter in parameters {
            let result = match control.as_mut() {
                Some(control) => control.set(parameter),
                None => Err("this run has no link that can be changed".to_owned()),
            };
            if let Err(why) = result {
                refused.push(format!("{}: {why}", parameter.name));
            }
        }
        refused
    }
}

impl ParameterHandler for Links {
    fn get(
        &self,
        _client: AnyClient,
        names: Vec<String>,
        _request: Option<String>,
        responder: GetParametersResponder,
    ) {
        responder.respond(self.list(&names));
    }

    fn set(
        &self,
        client: AnyClient,
        parameters: Vec<Parameter>,
        _request: Option<String>,
        responder: SetParametersResponder,
    ) {
        for why in Links::set(self, &parameters) {
            client.send_error(why);
        }
        // What they are now, whether the wish was granted or not.
        let names: Vec<String> = parameters.into_iter().map(|one| one.name).collect();
        responder.respond(self.list(&names));
    }
}
