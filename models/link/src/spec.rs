//! What a link does, as it is written down: the description of one direction, which the topology,
//! a gateway's launch description and virtual time share. [`LinkSpec::build`] makes the model of a
//! channel of it; it reads no file.
//!
//! A message meets the parts in this order:
//!
//! 1. **Outages**, first, because they are what a radio next to the sender does: what is lost here
//!    takes no place in the queue, and what is held back arrives at the queue in one go.
//! 2. **Wi-Fi** ([`super::wifi`]), the mechanistic model of a radio hop, where there is one. It delivers
//!    in order.
//! 3. **Loss** by chance, also before the queue, as in Linux netem: a lost message takes no place.
//! 4. **Rate and queue**: serialisation and waiting, tail drop.
//! 5. **Delay**: what is left of the way, independent of the load. With `reorders` = false a message
//!    arrives no earlier than the one before it.
//! 6. **Reordering**, after the floor of the delay, which would undo it.
//! 7. **Duplication**, last: the copy repeats an arrival.
//!
//! Each part has a random stream of its own and draws for every message, whatever the parts before
//! it did: turning one part on changes no draw of another, and the draws for the n-th message of a
//! channel depend on the seed and on n alone, whatever other channels carry. Wi-Fi is the exception:
//! it draws per attempt and back-off, so its draws for a message depend also on when the messages of
//! its channel before it were offered and what they met.

use core::time::Duration;

use serde::{Deserialize, Serialize};

use super::chain::LinkChain;
use super::delay::{DelayLaw, TIMES};
use super::loss::LossLaw;
use super::outages::Outages;
use super::rate::RateLimit;
use super::reordering::{Duplication, Reordering};
use super::wifi::WifiSpec;
use hil_core::case_study::ParameterError;
use hil_core::link_model::LinkModel;
use hil_core::options;
use hil_core::options::{
    Field, Kind, Options, Scalar as _, Setting, Shape, Short, Slot, Templates, short_table, table,
};

/// One direction of a link. The default does nothing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkSpec {
    /// When nothing gets through: on all channels of the link and both ways at once.
    pub outages: Outages,
    /// A Wi-Fi 6 hop with outages, losses, queue and delay of its own.
    pub wifi: Option<WifiSpec>,
    /// What is lost by chance.
    pub loss: LossLaw,
    /// A rate with a queue; `None` is as fast as it gets.
    pub rate: Option<RateLimit>,
    /// How long a message is under way.
    pub delay: DelayLaw,
    /// Whether a message that drew a shorter delay overtakes the one before it. False makes it
    /// wait: then the law holds for messages so far apart that none could overtake, and at a period
    /// T the delay D' has P(D' <= x) = F(x) F(x + T) F(x + 2 T)... for the law F. True keeps the law
    /// at every rate.
    pub reorders: bool,
    /// Messages held back.
    pub reordering: Option<Reordering>,
    /// Messages that arrive twice.
    pub duplication: Option<Duplication>,
}

hil_core::labelled! {
    /// Which way on a link.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Way, word {
        /// From the first host of the link to the second.
        Forward = "forward",
        /// From the second to the first.
        Backward = "backward",
    }
}

/// Which channel of which run a model is for: it names the random streams.
#[derive(Debug, Clone, Copy)]
pub struct LinkPlace<'a> {
    /// Seed of the run.
    pub seed: u64,
    /// Name of the link.
    pub link: &'a str,
    /// Name of the channel.
    pub channel: &'a str,
    /// Its way on the link.
    pub way: Way,
}

impl<'a> LinkPlace<'a> {
    /// Of a channel alone on its link.
    pub const fn alone(seed: u64, channel: &'a str) -> Self {
        Self {
            seed,
            link: channel,
            channel,
            way: Way::Forward,
        }
    }
}

impl LinkSpec {
    /// The paper's static model: a fixed delay and independent losses.
    pub fn fixed(delay: Duration, loss_ratio: f64) -> Self {
        Self {
            loss: LossLaw::bernoulli(loss_ratio),
            delay: DelayLaw::fixed(delay),
            ..Self::default()
        }
    }

    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let Self { outages, wifi, .. } = self;
        outages.check()?;
        if let Some(wifi) = wifi {
            wifi.check()?;
        }
        LinkParts::from(self).check()
    }

    /// The model of the channel at `place`, on a clock that reads zero when the run starts: the
    /// same live and in virtual time.
    ///
    /// # Errors
    /// The first key outside its range.
    pub fn build(&self, place: &LinkPlace<'_>) -> Result<Box<dyn LinkModel>, ParameterError> {
        Ok(Box::new(LinkChain::new(self, place)?))
    }

    /// How long all but a share of 1 - `quantile` of the messages are under way at most, but for an
    /// outage that holds them; `quantile` within 0..=1.
    pub fn flight_time(&self, quantile: f64) -> Duration {
        let queue = self.rate.map_or(Duration::ZERO, |rate| rate.longest());
        let hold = self.reordering.map_or(Duration::ZERO, |one| one.hold);
        let lag = self.duplication.map_or(Duration::ZERO, |one| one.lag);
        let radio = self
            .wifi
            .map_or(Duration::ZERO, |wifi| wifi.flight_time_max());
        radio + queue + self.delay.quantile(quantile) + hold + lag
    }

    /// The description in words.
    pub fn describe(&self) -> String {
        let mut parts = vec![self.delay.to_string(), self.loss.to_string()];
        if let Some(wifi) = &self.wifi {
            parts.insert(0, wifi.describe());
            if wifi.outages.is_active() {
                parts.insert(1, wifi.outages.describe());
            }
        }
        if !self.delay.is_fixed() {
            let order = if self.reorders {
                "messages overtake"
            } else {
                "no message overtakes"
            };
            parts.push(order.to_owned());
        }
        if let Some(rate) = &self.rate {
            parts.push(format!(
                "{} bit/s with a queue of {} bytes, {} bytes per message on top",
                rate.bits_per_second, rate.queue_bytes, rate.overhead_bytes
            ));
        }
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        if let Some(Reordering { ratio, hold }) = self.reordering {
            parts.push(format!("a ratio of {ratio} held back by {} ms", ms(hold)));
        }
        if let Some(Duplication { ratio, lag }) = self.duplication {
            parts.push(format!("a ratio of {ratio} twice, {} ms apart", ms(lag)));
        }
        if self.outages.is_active() {
            parts.push(self.outages.describe());
        }
        parts.join(", ")
    }
}

options! {
    /// The parts of a link that each direction can have of its own, as far as a file states them.
    pub struct LinkParts {
        /// How long a message is under way: a law with its options.
        delay: Option<LinkDelay>;
        /// What is lost by chance: a law with its options.
        loss: Option<LossLaw>;
        /// A rate with a queue in front of it.
        rate: Option<RateLimit>;
        /// Messages that are held back.
        reordering: Option<Reordering>;
        /// Messages that arrive twice.
        duplication: Option<Duplication>;
    }
}

impl LinkParts {
    /// Those of one direction: its own, and where it has none those of both.
    #[must_use]
    pub fn or(self, both: &Self) -> Self {
        let both = both.clone();
        Self {
            delay: self.delay.or(both.delay),
            loss: self.loss.or(both.loss),
            rate: self.rate.or(both.rate),
            reordering: self.reordering.or(both.reordering),
            duplication: self.duplication.or(both.duplication),
        }
    }
}

/// A link without outages and without a radio.
impl From<LinkParts> for LinkSpec {
    fn from(parts: LinkParts) -> Self {
        let delay = parts.delay.unwrap_or(LinkDelay::UNSET);
        Self {
            loss: parts.loss.unwrap_or_default(),
            rate: parts.rate,
            delay: delay.law,
            reorders: delay.reorders,
            reordering: parts.reordering,
            duplication: parts.duplication,
            ..Self::default()
        }
    }
}

/// All of them but outages and radio, which both directions share.
impl From<&LinkSpec> for LinkParts {
    fn from(spec: &LinkSpec) -> Self {
        Self {
            delay: Some(LinkDelay {
                law: spec.delay.clone(),
                reorders: spec.reorders,
            }),
            loss: Some(spec.loss),
            rate: spec.rate,
            reordering: spec.reordering,
            duplication: spec.duplication,
        }
    }
}

/// The delay of a link: a table that names a law, or a time alone for the same delay of all messages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkDelay {
    /// The law.
    pub law: DelayLaw,
    /// See [`LinkSpec::reorders`].
    pub reorders: bool,
}

impl LinkDelay {
    const fn of(law: DelayLaw) -> Self {
        Self {
            law,
            reorders: false,
        }
    }
}

impl Options for LinkDelay {
    fn fields(&mut self) -> Vec<Field<'_>> {
        let is_fixed = self.law.is_fixed();
        let mut fields = self.law.fields();
        if !is_fixed {
            fields.push(Field::new(
                "reorders",
                "Whether a message with a shorter delay overtakes the one before it. False makes it wait.",
                self.reorders.slot(()),
            ));
        }
        fields
    }

    fn check_together(&self) -> Result<(), ParameterError> {
        self.law.check_together()
    }
}

impl Short for LinkDelay {
    const TEMPLATES: Option<Templates> = Some(named_law(DelayLaw::NAMES));
    const KEY: &'static str = "delay";
    const ABOUT: &'static str = "The same delay of all messages.";

    fn template(index: usize) -> Self {
        Self::of(DelayLaw::named(DelayLaw::NAMES[index]).unwrap_or_default())
    }

    fn chosen(&self) -> Option<&'static str> {
        Some(self.law.name())
    }

    fn shape() -> Shape {
        Shape::Time(TIMES)
    }

    fn short(&self) -> Option<Setting> {
        match &self.law {
            DelayLaw::Fixed(law) => Some(Setting::Time(law.delay)),
            _ => None,
        }
    }

    fn of_short(setting: Setting) -> Result<Self, String> {
        Ok(Self::of(DelayLaw::fixed(Duration::from_setting(setting)?)))
    }
}

impl Short for LossLaw {
    const TEMPLATES: Option<Templates> = Some(named_law(Self::NAMES));
    const KEY: &'static str = "loss_ratio";
    const ABOUT: &'static str = "Share of the messages that is lost, each by itself.";

    fn template(index: usize) -> Self {
        Self::named(Self::NAMES[index]).unwrap_or_default()
    }

    fn chosen(&self) -> Option<&'static str> {
        Some(self.name())
    }

    fn shape() -> Shape {
        Shape::Number(0.0..=1.0)
    }

    fn short(&self) -> Option<Setting> {
        match self {
            Self::Bernoulli(law) => Some(Setting::Number(law.ratio)),
            _ => None,
        }
    }

    fn of_short(setting: Setting) -> Result<Self, String> {
        Ok(Self::bernoulli(f64::from_setting(setting)?))
    }
}

/// A table that names its law.
const fn named_law(names: &'static [&'static str]) -> Templates {
    Templates {
        key: "law",
        names,
        chosen: None,
        is_required: true,
    }
}

macro_rules! law_tables {
    ($($kind:ty = $unset:expr;)*) => {$(
        impl Kind for $kind {
            type Range = ();
            const UNSET: Self = $unset;

            fn slot(&mut self, (): ()) -> Slot<'_> {
                table(self)
            }

            fn optional(value: &mut Option<Self>, (): ()) -> Slot<'_> {
                short_table(value)
            }
        }
    )*};
}

law_tables! {
    LinkDelay = Self::of(DelayLaw::fixed(Duration::ZERO));
    LossLaw = Self::bernoulli(0.0);
}
