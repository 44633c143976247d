//! The link model of one channel in one direction: what makes it the same model live and in virtual
//! time, and why one cannot be made.

use std::time::Duration;

use hil_core::case_study::ParameterError;
use hil_core::link_model::LinkModel;
use hil_link::spec::{LinkPlace, LinkSpec, Way};
use serde::{Deserialize, Serialize};

use super::emulation_room::EmulationRoom;
use super::model::Crossing;
use super::trace_source::{TraceError, TraceLaunch};

/// A link model in front of a receiver: what makes it the same model live and in virtual time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmulationLaunch {
    /// What the link does in this direction.
    pub spec: LinkSpec,
    /// Name of the link: what all its channels share, they share by it.
    pub link: String,
    /// Which way on it.
    pub way: Way,
    /// Seed of the run.
    pub seed: u64,
    /// A recorded trace; with it the channel meets nothing of `spec`.
    pub trace: Option<TraceLaunch>,
}

/// Why a link cannot be emulated.
#[derive(Debug, thiserror::Error)]
pub enum EmulationError {
    /// A number is outside its range.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// The trace cannot be replayed.
    #[error(transparent)]
    Trace(#[from] TraceError),
}

impl EmulationLaunch {
    /// What the link of `crossing` does to it; `None` on a real hop.
    pub fn of(crossing: &Crossing<'_>, seed: u64) -> Option<Self> {
        Some(Self {
            spec: crossing.spec?.clone(),
            link: crossing.link.name.clone(),
            way: crossing.direction,
            seed,
            trace: crossing.link.emulation().and_then(|emulation| {
                let trace = emulation.trace.as_ref()?;
                trace.launch(&crossing.link.name, &crossing.channel.name)
            }),
        })
    }

    /// The model of one channel, on a clock that reads zero when the run starts.
    ///
    /// # Errors
    /// When a number is outside its range, or the trace cannot be replayed.
    pub fn model(&self, channel: &str) -> Result<Box<dyn LinkModel>, EmulationError> {
        if let Some(trace) = &self.trace {
            return Ok(Box::new(trace.model()?));
        }
        let model = self.spec.build(&LinkPlace {
            seed: self.seed,
            link: &self.link,
            channel,
            way: self.way,
        })?;
        Ok(model)
    }

    /// How long all but a share of 1 - `quantile` of the messages are under way at most.
    ///
    /// # Errors
    /// When its trace was not read before and cannot be.
    pub fn flight_time(&self, quantile: f64) -> Result<Duration, EmulationError> {
        match &self.trace {
            Some(trace) => Ok(trace.delay_max()?),
            None => Ok(self.spec.flight_time(quantile)),
        }
    }

    /// Room for what the model holds of a channel of messages of `message_bytes`.
    ///
    /// # Errors
    /// When a gateway cannot hold that much, or its trace was not read before and cannot be.
    pub fn room(&self, message_bytes: usize) -> Result<EmulationRoom, EmulationError> {
        let traced = match &self.trace {
            Some(trace) => Some(LinkSpec::fixed(trace.delay_max()?, 0.0)),
            None => None,
        };
        let spec = traced.as_ref().unwrap_or(&self.spec);
        EmulationRoom::of(spec, message_bytes).map_err(|error| {
            let key = match &self.trace {
                Some(trace) => trace.key.clone(),
                None => format!("links.{}.{}", self.link, error.key),
            };
            ParameterError::new(&key, error.problem).into()
        })
    }

    /// Share of the messages that the loss law loses in the long run; `None` for a trace, which has
    /// none.
    pub fn loss_ratio(&self) -> Option<f64> {
        let is_traced = self.trace.is_some();
        (!is_traced).then(|| self.spec.loss.loss_ratio())
    }

    /// The model in words.
    pub fn describe(&self) -> String {
        match &self.trace {
            Some(trace) => trace.describe(),
            None => self.spec.describe(),
        }
    }
}
