//! A Wi-Fi 6 link from its mechanisms: contention, retries with back-off, rate fallback, path loss,
//! shadowing, fading, power save, outages and the queue before all of them. Each is in a file of
//! its own and can be switched off. It is a model of one pair of stations in the infrastructure of
//! others, not a simulator of a network: the others appear only as a busy medium.
//!
//! # What the channels of a link share
//! Each channel and direction is an object of its own, made in the process of its receiver. What
//! they share is a function of the link's seeded stream and of the time since the start of the run:
//! outages, shadowing, fades, beacons. Each draws its collisions, back-offs and errors by itself and
//! has a queue of its own. They do not contend with each other; the airtime they take from each
//! other has to be told as part of `busy_ratio`.

mod channel;
mod contention;
mod phy;
mod power_save;
mod preset;
mod rate;
mod spec;
#[cfg(test)]
mod tests;

use core::time::Duration;

pub use preset::WifiPreset;
pub use spec::{AccessCategory, PowerSave, WifiSpec};

use crate::outages::OutageLink;
use crate::spec::Way;
use hil_core::case_study::ParameterError;
use hil_core::link_model::{Fate, LinkModel, LossCauses};
use hil_core::random::RandomStream;
use hil_core::time::Instant;

use channel::{Fading, Shadowing, median_snr_db};
use contention::Contention;
use phy::{Phy, nanoseconds};
use power_save::Doze;

/// What became of the messages offered. Every message has one of the four fates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct WifiCounts {
    /// Messages offered.
    pub offered_count: u64,
    /// Messages delivered.
    pub delivered_count: u64,
    /// Messages lost because every attempt failed.
    pub exhausted_count: u64,
    /// Messages given up because they were too old.
    pub expired_count: u64,
    /// Messages lost in an outage.
    pub outage_count: u64,
    /// Messages that waited for the end of an outage, or for a beacon.
    pub held_count: u64,
    /// Attempts on the air.
    pub attempt_count: u64,
    /// Attempts that collided.
    pub collision_count: u64,
    /// Attempts that did not collide and were not received.
    pub error_count: u64,
}

/// The link.
#[derive(Debug, Clone)]
pub struct WifiLink {
    spec: WifiSpec,
    phy: Phy,
    contention: Contention,
    median_snr_db: f64,
    shadowing: Shadowing,
    fading: Fading,
    /// Of the step of shadowing: its number, the average signal-to-noise ratio, the rate.
    local: (i64, f64, usize),
    doze: Option<Doze>,
    outages: OutageLink,
    lifetime_ns: i64,
    forwarding: Duration,
    random: RandomStream,
    /// When the next frame may go on the air if it is there by then.
    ready: Instant,
    counts: WifiCounts,
}

/// How one PPDU ended: received at this instant, or not.
type Received = Result<Instant, Gone>;

/// Why a message is lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Gone {
    Exhausted,
    Expired,
}

impl WifiLink {
    /// A link that draws what is its own from `random`, and from `shared` what all channels of a
    /// link meet together, both ways: give them equal streams for it. Time counts from the start
    /// of the run, [`Instant::ZERO`].
    ///
    /// # Errors
    /// The first key of `spec` outside its range.
    pub fn new(
        spec: &WifiSpec,
        way: Way,
        random: RandomStream,
        mut shared: RandomStream,
    ) -> Result<Self, ParameterError> {
        spec.check()?;
        // Drawn whether needed or not, so that no mechanism moves another's numbers.
        let (shadowing_key, fading_key) = (shared.next_u64(), shared.next_u64());
        let beacon_phase = shared.uniform();
        let is_dozing = matches!(
            (spec.power_save, way),
            (PowerSave::Forward, Way::Forward) | (PowerSave::Backward, Way::Backward)
        );
        Ok(Self {
            spec: *spec,
            phy: Phy::new(spec),
            contention: Contention::new(spec),
            median_snr_db: median_snr_db(spec),
            shadowing: Shadowing::new(spec, shadowing_key),
            fading: Fading::new(spec, fading_key),
            local: (i64::MIN, 0.0, 0),
            doze: is_dozing.then(|| Doze::new(spec, beacon_phase)),
            outages: OutageLink::new(spec.outages, shared, Instant::ZERO)?,
            lifetime_ns: nanoseconds(spec.lifetime_ms * 1e6),
            forwarding: Duration::from_secs_f64(spec.forwarding_us * 1e-6),
            random,
            ready: Instant::from_ns(i64::MIN),
            counts: WifiCounts::default(),
        })
    }

    /// What became of the messages so far.
    pub fn counts(&self) -> WifiCounts {
        self.counts
    }

    /// When the frame offered at `now` contends for the medium, the frames before it having gone.
    fn head_of_line(&mut self, now: Instant) -> Result<Instant, Gone> {
        let mut at = now.max(self.ready);
        if let Some(doze) = &self.doze {
            at = doze.listens_from(at);
        }
        if at.ns_since(now) > self.lifetime_ns {
            return Err(Gone::Expired);
        }
        Ok(at)
    }

    /// Average signal-to-noise ratio at `at` and the rate that the sender settled on.
    fn local(&mut self, at: Instant) -> (f64, usize) {
        let (step, shadowing_db) = self.shadowing.at(at);
        if self.local.0 != step {
            let snr_db = self.median_snr_db + shadowing_db;
            self.local = (step, snr_db, self.spec.settled(snr_db));
        }
        (self.local.1, self.local.2)
    }

    /// Sends a PPDU that goes on the air at `at` for the first time, until it is received or given
    /// up; sets when the next may follow. No attempt begins after the lifetime.
    fn send(&mut self, offered: Instant, mut at: Instant, air_bytes: u64) -> Received {
        let access = self.contention.access;
        let attempt_limit = self.spec.attempt_limit as usize;
        let mut window = access.window_min;
        let mut result = Err(Gone::Exhausted);
        for attempt in 0..attempt_limit {
            if at.ns_since(offered) > self.lifetime_ns {
                // It grew too old in its back-off, which the next frame takes over.
                self.ready = at;
                return Err(Gone::Expired);
            }
            let (snr_db, settled) = self.local(at);
            let mcs = self.spec.stepped_down(settled, attempt);
            let ppdu_ns = self.phy.ppdu_ns(mcs, air_bytes);
            let snr_db = snr_db + self.fading.at(at);
            self.counts.attempt_count += 1;
            let mut air_ns = ppdu_ns;
            let is_received = if self.contention.collides(&mut self.random) {
                self.counts.collision_count += 1;
                // The longer of the two frames keeps the medium.
                air_ns = ppdu_ns.max(self.contention.busy_ns(&mut self.random));
                false
            } else {
                let error_ratio = self.spec.error_ratio(mcs, snr_db, air_bytes);
                let is_error = self.random.chance(error_ratio);
                self.counts.error_count += u64::from(is_error);
                !is_error
            };
            let received = after(at, ppdu_ns);
            at = after(at, air_ns + self.phy.response_ns(mcs));
            if is_received {
                result = Ok(received);
                break;
            }
            window = access.widened(window);
            if attempt + 1 < attempt_limit {
                at = after(at, self.contention.backoff_ns(&mut self.random, window));
            }
        }
        // Whatever became of it, a back-off follows before the next.
        let pause_ns = self
            .contention
            .backoff_ns(&mut self.random, access.window_min);
        self.ready = after(at, pause_ns);
        result
    }

    /// Sends a message in as many PPDUs as it needs; it arrives when the last does.
    fn carry(&mut self, offered: Instant, begin: Instant, length_bytes: usize) -> Received {
        let air_bytes = Phy::air_bytes(length_bytes);
        let part_count = self.phy.part_count(air_bytes);
        let part_bytes = air_bytes.div_ceil(part_count);
        let mut received = self.send(offered, begin, part_bytes)?;
        for _ in 1..part_count {
            received = self.send(offered, self.ready, part_bytes)?;
        }
        Ok(received)
    }

    fn lost(&mut self, gone: Gone) -> Fate {
        match gone {
            Gone::Exhausted => self.counts.exhausted_count += 1,
            Gone::Expired => self.counts.expired_count += 1,
        }
        Fate::Lost
    }
}

impl WifiCounts {
    /// What the lost messages were lost to: attempts that all failed are losses by chance, and
    /// frames that grew too old are losses to the queue.
    pub const fn loss_causes(self) -> LossCauses {
        LossCauses {
            outage_count: self.outage_count,
            chance_count: self.exhausted_count,
            queue_count: self.expired_count,
        }
    }
}

impl LinkModel for WifiLink {
    fn offer(&mut self, now: Instant, length_bytes: usize) -> Fate {
        self.counts.offered_count += 1;
        let mut begin = match self.head_of_line(now) {
            Ok(begin) => begin,
            Err(gone) => return self.lost(gone),
        };
        // Heads of the line come in order of time, as the outages are asked.
        if let Some(outage) = self.outages.outage_at(begin) {
            if !self.spec.outages.buffered {
                self.counts.outage_count += 1;
                return Fate::Lost;
            }
            begin = outage.end;
            if begin.ns_since(now) > self.lifetime_ns {
                return self.lost(Gone::Expired);
            }
        }
        if begin > now && begin > self.ready {
            // It waited for a beacon or the end of an outage, as others did: it draws a back-off.
            self.counts.held_count += 1;
            let window = self.contention.access.window_min;
            begin = after(begin, self.contention.backoff_ns(&mut self.random, window));
        } else if now > self.ready {
            begin = after(begin, self.contention.arrival_ns(&mut self.random));
        }
        match self.carry(now, begin, length_bytes) {
            Ok(received) => {
                self.counts.delivered_count += 1;
                if let Some(doze) = &mut self.doze {
                    doze.heard(received);
                }
                Fate::Delivered(received + self.forwarding)
            }
            Err(gone) => self.lost(gone),
        }
    }

    fn loss_causes(&self) -> Option<LossCauses> {
        Some(self.counts.loss_causes())
    }
}

/// The instant `ns` later, saturating.
const fn after(at: Instant, ns: i64) -> Instant {
    Instant::from_ns(at.as_ns().saturating_add(ns))
}
