//! One direction of a link at work on one channel: the parts of a [`LinkSpec`] in the order stated
//! there. It carries no bytes and knows no other channel.

use core::time::Duration;

use super::delay::DelaySampler;
use super::loss::Losses;
use super::outages::OutageLink;
use super::rate::Bottleneck;
use super::reordering::RandomHits;
use super::spec::{LinkPlace, LinkSpec};
use super::wifi::WifiLink;
use hil_core::case_study::ParameterError;
use hil_core::link_model::{Fate, LinkModel, LossCauses};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

/// The link.
#[derive(Debug)]
pub(crate) struct LinkChain {
    outages: OutageLink,
    wifi: Option<Box<WifiLink>>,
    loss: Box<dyn Losses>,
    bottleneck: Option<Bottleneck>,
    delay: (DelaySampler, RandomStream),
    reorders: bool,
    reordering: Option<RandomHits>,
    duplication: Option<RandomHits>,
    /// No later message arrives before, unless it was held back.
    floor: Instant,
    lost: LossCauses,
    /// When the last message was through the radio: later ones are no earlier.
    behind_radio: Instant,
}

impl LinkChain {
    /// The parts of `spec` with the random streams of `place`: the loss by chance has the
    /// channel's name alone, as it had before there were other parts.
    pub(super) fn new(spec: &LinkSpec, place: &LinkPlace<'_>) -> Result<Self, ParameterError> {
        spec.check()?;
        let own = |part: &str| RandomStream::new(place.seed, &format!("{}{part}", place.channel));
        // The link's own streams, so that all its channels fail together and no other link with
        // them.
        let shared =
            |part: &str| RandomStream::new(place.seed, &format!("links.{}{part}", place.link));
        let outages = OutageLink::new(spec.outages, shared(".outages"), Instant::ZERO)?;
        let wifi = spec.wifi.as_ref().map(|wifi| {
            let link = WifiLink::new(wifi, place.way, own(".wifi"), shared(".wifi"));
            link.map(Box::new)
        });
        let hits = |ratio, later, part| RandomHits::new(ratio, later, own(part));
        Ok(Self {
            outages,
            wifi: wifi.transpose()?,
            loss: spec.loss.start(own(""), shared(".bursts"))?,
            bottleneck: spec.rate.map(Bottleneck::new).transpose()?,
            delay: (DelaySampler::new(&spec.delay)?, own(".delay")),
            reorders: spec.reorders,
            reordering: spec
                .reordering
                .map(|one| hits(one.ratio, one.hold, ".reordering")),
            duplication: spec
                .duplication
                .map(|one| hits(one.ratio, one.lag, ".duplication")),
            floor: Instant::from_ns(i64::MIN),
            lost: LossCauses::default(),
            behind_radio: Instant::from_ns(i64::MIN),
        })
    }

    /// When a message offered at `now` is at the end of the queue; `None` when it is lost before.
    fn through_queue(&mut self, now: Instant, length_bytes: usize) -> Option<Instant> {
        let after_outage = self.outages.offer(now, length_bytes).arrival();
        let after_radio = match &mut self.wifi {
            Some(wifi) => after_outage.and_then(|at| wifi.offer(at, length_bytes).arrival()),
            None => after_outage,
        };
        // The loss is asked in order of time, for what the radio lost as well.
        self.behind_radio = self.behind_radio.max(after_radio.unwrap_or(now));
        let sets_out = self.behind_radio;
        let is_lost = self.loss.is_lost(sets_out);
        if after_outage.is_none() {
            self.lost.outage_count += 1;
            return None;
        }
        // The radio counts what it loses by itself.
        after_radio?;
        if is_lost {
            self.lost.chance_count += 1;
            return None;
        }
        let Some(bottleneck) = &mut self.bottleneck else {
            return Some(sets_out);
        };
        let sent = bottleneck.offer(sets_out, length_bytes);
        self.lost.queue_count += u64::from(sent.is_none());
        sent
    }
}

impl LinkModel for LinkChain {
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        let sent = self.through_queue(now, length_bytes);
        // Drawn for a lost message as well, so that no draw depends on what was lost.
        let delay = self.delay.0.draw(&mut self.delay.1);
        let held = self.reordering.as_mut().and_then(RandomHits::next);
        let copied = self.duplication.as_mut().and_then(RandomHits::next);
        let Some(sent) = sent else {
            return Fate::Lost;
        };
        let mut at = sent + delay;
        if !self.reorders {
            at = at.max(self.floor);
            self.floor = at;
        }
        let first = at + held.unwrap_or(Duration::ZERO);
        copied.map_or(Fate::Delivered(first), |lag| Fate::Duplicated {
            first,
            second: first + lag,
        })
    }

    fn loss_causes(&self) -> Option<LossCauses> {
        let radio = self.wifi.as_ref().and_then(LinkModel::loss_causes);
        Some(self.lost.plus(radio.unwrap_or_default()))
    }
}
