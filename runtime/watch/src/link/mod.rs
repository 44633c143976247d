//! The links of a run that goes on: what each emulated direction does now, and orders to change it.
//! Everything is read from the run's folder; an order goes through shared memory to the gateway that
//! emulates the direction, and the gateway's record of it is the confirmation.

pub mod cli;
pub mod work;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, io, thread};

use hil_core::case_study::ParameterError;
use hil_core::message::Envelope;
use hil_core::time::Instant;
use hil_link::condition::{
    LinkChangeRequest, LinkCondition, LinkConditionRecord, OrderOutcome, flow_name,
};
use hil_link::spec::Way;
use serde_json::Value;

use hil_platform::clock::MonotonicClock;
use hil_platform::domain_address::{DomainAddress, DomainAddressError};
use hil_rundir::launch::{self, GatewayWork, Work, WorkerLaunch};
use hil_rundir::link_orders::{in_force, orders_on_record};
use hil_rundir::manifest::Manifest;
use hil_rundir::record::RecordFileError;
use hil_rundir::run_folder::RunFolder;
use hil_shm::{ChannelError, Domain, DomainError, RawOutput};

/// How long the gateway may take to confirm an order. It looks every 5 ms.
const CONFIRM_WITHIN: Duration = Duration::from_secs(3);
/// How often its record is looked for.
const LOOK_PERIOD: Duration = Duration::from_millis(5);

/// Why a link cannot be shown or changed.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The folder is not that of a run, or cannot be read.
    #[error("run folder {folder}: {source}")]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The run has no link of that name.
    #[error("the run has no link `{asked}`; its links: {known}")]
    UnknownLink {
        /// What was asked for.
        asked: String,
        /// Those there are.
        known: String,
    },
    /// A real link is as it is.
    #[error("link {link} is carried by {via}: it is not emulated, so there is nothing to set")]
    NotEmulated {
        /// The link.
        link: String,
        /// The word of the topology.
        via: String,
    },
    /// Another host receives that way, and emulates it.
    #[error(
        "{link}.{way} is not emulated on this host: either no channel goes that way, or the host that \
         receives it does; `hil-runtime link show` lists what can be set here", way = .way.word()
    )]
    Elsewhere {
        /// The link.
        link: String,
        /// Which way.
        way: Way,
    },
    /// A number is outside its range.
    #[error(transparent)]
    Range(#[from] ParameterError),
    /// The gateway could not hold what would be under way.
    #[error(
        "{link}.{way}: a delay of {asked_s} s is too long: the gateway made room for {longest_s:.1} s of 100 \
         messages per second when the run began; a longer delay in the topology makes more", way = .way.word()
    )]
    NoRoom {
        /// The link.
        link: String,
        /// Which way.
        way: Way,
        /// The delay asked for, seconds.
        asked_s: f64,
        /// The longest there is room for, seconds.
        longest_s: f64,
    },
    /// The run's shared memory is not there.
    #[error("the run has ended, or its shared memory is not this user's: {0}")]
    Over(#[source] DomainError),
    /// The channel for orders.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The gateway's records.
    #[error(transparent)]
    Record(#[from] RecordFileError),
    /// The gateway refused.
    #[error("{gateway} refused the change of {direction}: {why}")]
    Refused {
        /// The gateway process.
        gateway: String,
        /// Link and way.
        direction: String,
        /// Its reason.
        why: &'static str,
    },
    /// No record came.
    #[error(
        "{gateway} did not confirm the change of {direction} within {within_s} s; is the run still going?"
    )]
    Silent {
        /// The gateway process.
        gateway: String,
        /// Link and way.
        direction: String,
        /// How long was waited, seconds.
        within_s: u64,
    },
}

/// One direction of an emulated link on this host.
#[derive(Debug, Clone)]
pub struct LinkDirection {
    /// Name of the link.
    pub link: String,
    /// Which way.
    pub way: Way,
    /// The gateway process that emulates it.
    pub gateway: String,
    /// The channels that go that way.
    pub channels: Vec<String>,
    /// What the topology says of it, in words.
    pub described: String,
    /// Longest delay that there is room for; `None` when the topology's trace cannot be read here.
    pub delay_max: Option<Duration>,
    domain: String,
}

impl LinkDirection {
    /// `<link>.<forward or backward>`, as the command line takes it.
    pub fn name(&self) -> String {
        format!("{}.{}", self.link, self.way.word())
    }

    /// The channel on which orders for it travel.
    pub fn order_channel(&self) -> String {
        flow_name(&self.link, self.way)
    }
}

/// A change that the gateway confirmed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Confirmed {
    /// What is in force.
    pub condition: LinkCondition,
    /// The gateway's count of orders to this direction, from 1.
    pub number: u64,
    /// Messages received from here on meet it, on this host's monotonic clock.
    pub from: Instant,
    /// Between `from` and here a message may have met either condition; equal to `from` as a rule.
    pub certain: Instant,
}

/// The links of one run on this host.
#[derive(Debug)]
pub struct RunLinks {
    records: PathBuf,
    directions: Vec<LinkDirection>,
    /// Every link of the topology and the topology's word for what carries it.
    carried: BTreeMap<String, String>,
}

/// The word for a model of a network; any other is for something real.
const EMULATED: &str = "emulated";

impl RunLinks {
    /// Reads which links the run in `folder` has. The run need not go on any more.
    ///
    /// # Errors
    /// When the folder has no manifest, or a launch file cannot be read.
    pub fn open(folder: &Path) -> Result<Self, LinkError> {
        let failed = |source| LinkError::Folder {
            folder: folder.to_owned(),
            source,
        };
        let run = RunFolder::existing(folder);
        let manifest = Manifest::read(&run).map_err(failed)?;
        let mut directions: Vec<LinkDirection> = Vec::new();
        for launch in newest_launches(folder).map_err(failed)? {
            if let Work::Gateway(work) = &launch.work {
                add_directions(&mut directions, &launch, work);
            }
        }
        directions.sort_by_key(LinkDirection::name);
        Ok(Self {
            records: run.records(),
            directions,
            carried: carried(&manifest.topology),
        })
    }

    /// The directions that are emulated on this host.
    pub fn directions(&self) -> &[LinkDirection] {
        &self.directions
    }

    /// Every order that was given to `direction`, oldest first.
    fn orders(&self, direction: &LinkDirection) -> Result<Vec<LinkConditionRecord>, LinkError> {
        Ok(orders_on_record(&self.records, &direction.order_channel())?)
    }

    /// What `direction` does now, and since when where it was changed, on this host's monotonic clock.
    ///
    /// # Errors
    /// When the gateway's records cannot be read.
    pub fn condition(
        &self,
        direction: &LinkDirection,
    ) -> Result<(LinkCondition, Option<Instant>), LinkError> {
        Ok(in_force(&self.orders(direction)?))
    }

    /// The directions that `name` means: a link, or a link and `.forward` or `.backward`.
    ///
    /// # Errors
    /// When there is no such link, it is not emulated, or another host emulates that way.
    pub fn named(&self, name: &str) -> Result<Vec<LinkDirection>, LinkError> {
        let (link, way) = self.split(name);
        let wanted = self.directions.iter().filter(|one| one.link == link);
        let wanted = wanted.filter(|one| way.is_none_or(|way| one.way == way));
        let wanted: Vec<LinkDirection> = wanted.cloned().collect();
        if !wanted.is_empty() {
            return Ok(wanted);
        }
        let link = link.to_owned();
        match self.carried.get(&link) {
            None => Err(LinkError::UnknownLink {
                asked: name.to_owned(),
                known: self.known(),
            }),
            Some(via) if via == EMULATED => Err(LinkError::Elsewhere {
                link,
                way: way.unwrap_or(Way::Forward),
            }),
            Some(via) => Err(LinkError::NotEmulated {
                link,
                via: via.clone(),
            }),
        }
    }

    /// A link's own name may have a dot.
    fn split<'a>(&self, name: &'a str) -> (&'a str, Option<Way>) {
        let ways = [Way::Forward, Way::Backward];
        let parted = name.rsplit_once('.').and_then(|(link, word)| {
            let way = ways.into_iter().find(|way| way.word() == word)?;
            Some((link, Some(way)))
        });
        match parted {
            Some(found) if !self.carried.contains_key(name) => found,
            _ => (name, None),
        }
    }

    fn known(&self) -> String {
        if self.carried.is_empty() {
            return "none".to_owned();
        }
        let words = self.carried.iter();
        let words = words.map(|(link, via)| format!("{link} ({via})"));
        words.collect::<Vec<_>>().join(", ")
    }

    /// Has `direction` be in `condition` for messages that its gateway receives from now on, and waits
    /// for the gateway to confirm it. Messages under way keep their fate.
    ///
    /// # Errors
    /// When a number is outside its range, the gateway cannot hold what would be under way, the run is
    /// over, or no confirmation comes.
    pub fn set(
        &mut self,
        direction: &LinkDirection,
        condition: LinkCondition,
    ) -> Result<Confirmed, LinkError> {
        condition.check()?;
        let longest = direction.delay_max.unwrap_or(Duration::MAX);
        if condition.delay() > longest {
            return Err(LinkError::NoRoom {
                link: direction.link.clone(),
                way: direction.way,
                asked_s: condition.delay().as_secs_f64(),
                longest_s: longest.as_secs_f64(),
            });
        }
        let address: DomainAddress = direction
            .domain
            .parse()
            .map_err(|error: DomainAddressError| LinkError::Over(error.into()))?;
        // Only until the order is confirmed, and as one who is no part of the run: whoever gives
        // orders may live on when the run's memory goes.
        let domain = Domain::observe(&address).map_err(LinkError::Over)?;
        let mut output = RawOutput::open(&domain, &direction.order_channel(), false)?;
        let now = MonotonicClock::now();
        // Two who give orders within one nanosecond are told apart by their processes.
        let request = now.as_ns().unsigned_abs() ^ (u64::from(std::process::id()) << 40);
        let envelope = Envelope {
            published_ns: now.as_ns(),
            ..bytemuck::Zeroable::zeroed()
        };
        let order = LinkChangeRequest::new(condition, request);
        output.publish(&envelope, bytemuck::bytes_of(&order))?;
        self.wait_for(direction, request)
    }

    /// Waits for the record of `request`, and until what it says holds.
    fn wait_for(&self, direction: &LinkDirection, request: u64) -> Result<Confirmed, LinkError> {
        let deadline = MonotonicClock::now() + CONFIRM_WITHIN;
        loop {
            let orders = self.orders(direction)?;
            let answer = orders.iter().rev().find(|record| record.request == request);
            if let Some(record) = answer {
                return confirmed(direction, record);
            }
            if MonotonicClock::now() >= deadline {
                return Err(LinkError::Silent {
                    gateway: direction.gateway.clone(),
                    direction: direction.name(),
                    within_s: CONFIRM_WITHIN.as_secs(),
                });
            }
            thread::sleep(LOOK_PERIOD);
        }
    }
}

fn confirmed(
    direction: &LinkDirection,
    record: &LinkConditionRecord,
) -> Result<Confirmed, LinkError> {
    let refused = |why| LinkError::Refused {
        gateway: direction.gateway.clone(),
        direction: direction.name(),
        why,
    };
    let unknown = "its record is of another version";
    let condition = record.condition().ok_or_else(|| refused(unknown))?;
    match record.outcome() {
        Some(OrderOutcome::InForce) => {}
        Some(other) => return Err(refused(other.words())),
        None => return Err(refused(unknown)),
    }
    let certain = Instant::from_ns(record.certain_ns);
    let left = certain.saturating_duration_since(MonotonicClock::now());
    thread::sleep(left.min(CONFIRM_WITHIN));
    Ok(Confirmed {
        condition,
        number: record.number,
        from: Instant::from_ns(record.from_ns),
        certain,
    })
}

/// The last start of each process of the run in `folder` on this host.
fn newest_launches(folder: &Path) -> io::Result<Vec<WorkerLaunch>> {
    let mut newest: BTreeMap<String, WorkerLaunch> = BTreeMap::new();
    for entry in fs::read_dir(folder.join("launch"))? {
        let path = entry?.path();
        let Ok(launch) = launch::read::<WorkerLaunch>(&path) else {
            continue;
        };
        let known = newest.get(&launch.process);
        if known.is_none_or(|known| known.instance < launch.instance) {
            newest.insert(launch.process.clone(), launch);
        }
    }
    Ok(newest.into_values().collect())
}

fn add_directions(directions: &mut Vec<LinkDirection>, launch: &WorkerLaunch, work: &GatewayWork) {
    for one in &work.directions {
        let emulated = || {
            let channels = one.channels.iter();
            channels.filter_map(|channel| Some((channel, channel.emulation.as_ref()?)))
        };
        let Some((_, first)) = emulated().next() else {
            continue;
        };
        let longest = emulated().map(|(channel, emulation)| {
            let room = emulation.room(channel.size_bytes).ok()?;
            Some(room.longest_delay())
        });
        directions.push(LinkDirection {
            link: first.link.clone(),
            way: first.way,
            gateway: launch.process.clone(),
            channels: emulated().map(|(one, _)| one.channel.clone()).collect(),
            described: first.describe(),
            delay_max: longest.min().flatten(),
            domain: launch.domain.clone(),
        });
    }
}

/// What carries each link, by the manifest's topology.
fn carried(topology: &Value) -> BTreeMap<String, String> {
    let links = topology.get("links").and_then(Value::as_object);
    let words = links.into_iter().flatten().filter_map(|(name, link)| {
        let via = link.get("via")?.as_str()?;
        Some((name.clone(), via.to_owned()))
    });
    words.collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn links() -> RunLinks {
        let direction = |way| LinkDirection {
            link: "hop".to_owned(),
            way,
            gateway: "gateway-hop-robot-pc".to_owned(),
            channels: vec!["shuttle/command".to_owned()],
            described: "5 ms".to_owned(),
            delay_max: Some(Duration::from_secs(10)),
            domain: "h0123abcd_@/run/hil/none".to_owned(),
        };
        let topology = json!({ "links": {
            "hop": { "via": "emulated" },
            "hop.backward": { "via": "emulated" },
            "wire": { "via": "udp" },
        }});
        RunLinks {
            records: PathBuf::new(),
            directions: vec![direction(Way::Backward), direction(Way::Forward)],
            carried: carried(&topology),
        }
    }

    #[test]
    fn a_name_means_a_link_or_one_way_on_it() {
        let links = links();
        assert_eq!(links.named("hop").unwrap().len(), 2);
        let forward = links.named("hop.forward").unwrap();
        assert_eq!(forward.len(), 1);
        assert_eq!(forward[0].name(), "hop.forward");
        let said = |name| links.named(name).unwrap_err().to_string();
        assert_eq!(
            said("wire"),
            "link wire is carried by udp: it is not emulated, so there is nothing to set"
        );
        assert_eq!(
            said("hob"),
            "the run has no link `hob`; its links: hop (emulated), hop.backward (emulated), wire (udp)"
        );
        // A link's own name comes before the way on another.
        assert!(said("hop.backward").contains("not emulated on this host"));
    }

    #[test]
    fn what_is_out_of_range_is_refused_before_it_is_sent() {
        let mut links = links();
        let direction = links.directions()[0].clone();
        let fixed = |delay_s, loss_ratio| LinkCondition::Fixed {
            delay: Duration::from_secs(delay_s),
            loss_ratio,
        };
        let mut said = |condition| links.set(&direction, condition).unwrap_err().to_string();
        assert!(said(fixed(1, 1.5)).contains("1.5 is outside 0 to 1"));
        assert!(said(fixed(20, 0.0)).contains("room for 10.0 s of 100 messages per second"));
        assert!(said(fixed(1, 0.0)).contains("the run has ended"));
    }
}
