//! Both ends of every case of `gateway_overhead`, each opened in the thread that uses it. What is
//! timed is in [`super::turns`] and [`super::applications`].

use std::cell::{RefCell, RefMut};
use std::rc::Rc;
use std::sync::atomic::{AtomicU64, AtomicUsize};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use hil_platform::clock::MonotonicClock;

use super::applications::PartyGroup;
use super::cases::{CasePlan, Kind};
use super::hosts::{Hosts, Joint, SetupError, greet};
use super::network::Network;
use super::parties::{Party, Usage, claim};
use super::side::{EchoSide, GatewaySide, PlainSide, Side};
use super::turns::{RoundTrips, Turns, answer};

/// Latencies the far thread noted, for the near one to fetch.
pub type Noted = Arc<Mutex<Vec<u64>>>;

/// A far end that answers nothing and notes how long each message was under way.
#[derive(Debug)]
struct Sink {
    side: GatewaySide,
    noted: Noted,
}

impl Side for Sink {
    fn send(&mut self, _count: u64) {}

    fn receive(&mut self) -> Option<u64> {
        self.side.receive()?;
        let elapsed = MonotonicClock::now().ns_since(self.side.published()?);
        let mut noted = self.noted.lock().unwrap_or_else(PoisonError::into_inner);
        noted.push(u64::try_from(elapsed).unwrap_or(0));
        None
    }

    fn sleeps(&self) -> bool {
        self.side.sleeps()
    }
}

/// The near end of a case.
#[derive(Debug)]
pub enum NearEnd {
    /// Bare UDP.
    PingPong(Box<dyn Side>),
    /// Gateways in this thread, measured in two ways at once.
    Gateway(Shared, Column),
    /// The same, towards a far end that only listens.
    Hop {
        /// The gateways.
        side: Box<GatewaySide>,
        /// What the far end noted.
        noted: Noted,
        /// What the far thread used.
        usage: Usage,
    },
    /// A thread per party.
    Applications(Box<PartyGroup>),
}

/// Which of the two ways.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Column {
    /// With what the applications took.
    Whole,
    /// Without.
    BetweenGateways,
}

/// The near end of two cases that are measured together.
#[derive(Debug, Clone)]
pub struct Shared(Rc<RefCell<Pair>>);

#[derive(Debug)]
struct Pair {
    side: GatewaySide,
    /// The case the far thread knows.
    case: usize,
    whole: Option<Vec<u64>>,
    between_gateways: Option<Vec<u64>>,
}

impl Shared {
    /// The `column` of this round: whoever asks first has `measure` called for the case the far
    /// thread knows, the other gets what was left.
    pub fn column(
        &self,
        column: Column,
        measure: impl FnOnce(usize, &mut GatewaySide) -> RoundTrips,
    ) -> Vec<u64> {
        let mut pair = self.0.borrow_mut();
        let pair = &mut *pair;
        let left = match column {
            Column::Whole => pair.whole.take(),
            Column::BetweenGateways => pair.between_gateways.take(),
        };
        left.unwrap_or_else(|| {
            let found = measure(pair.case, &mut pair.side);
            match column {
                Column::Whole => {
                    pair.between_gateways = Some(found.between_gateways);
                    found.whole
                }
                Column::BetweenGateways => {
                    pair.whole = Some(found.whole);
                    found.between_gateways
                }
            }
        })
    }
}

/// An end on its way to its thread.
#[derive(Debug)]
enum Loose {
    Ready(Box<dyn Side + Send>),
    Gateway(Box<Joint>, Arc<AtomicU64>),
    /// The other way to measure the case before.
    Twin,
    Hop(Box<Joint>, Noted),
    Applications(Box<[Joint; 2]>),
    /// Another thread's.
    Elsewhere,
}

/// Everything `gateway_overhead` measures with.
#[derive(Debug)]
pub struct Setup {
    /// Both hosts.
    pub hosts: Hosts,
    /// The near ends, case by case.
    pub near: Vec<NearEnd>,
    /// Whose turn it is.
    pub turns: Arc<Turns>,
    /// The answering thread; it ends with what real-time rights it was refused.
    pub far: JoinHandle<Vec<String>>,
    /// The same, to ask what it used.
    pub far_party: Party,
    /// What real-time rights this thread was refused.
    pub refusals: Vec<String>,
}

impl Setup {
    /// Opens everything and takes a processor for this thread.
    ///
    /// # Errors
    /// When the machine refuses something that is needed.
    pub fn open(cases: &[CasePlan], cpu_count: usize) -> Result<Self, SetupError> {
        let mut hosts = Hosts::create(Network::open())?;
        let turns = Arc::new(Turns::default());
        let mut near_ends = Vec::new();
        let mut far_ends = Vec::new();
        for case in cases {
            let (near, far) = open_case(&mut hosts, case)?;
            near_ends.push(near);
            far_ends.push(far);
        }
        hosts.start_recording()?;
        let is_gateway = |end: &&Loose| matches!(end, Loose::Gateway(..) | Loose::Hop(..));
        let gateways = far_ends.iter().filter(is_gateway).count();
        let remaining = Arc::new(AtomicUsize::new(2 * gateways));
        let (ready, far_answer) = channel();
        let far = thread::spawn({
            let (turns, remaining) = (Arc::clone(&turns), Arc::clone(&remaining));
            move || far_thread(far_ends, &turns, &remaining, &ready)
        });
        let mut near: Vec<NearEnd> = Vec::new();
        for (case, end) in near_ends.into_iter().enumerate() {
            let connected = connect(end, near.last(), case, &turns, cpu_count)?;
            near.push(connected);
        }
        greet_near(&mut near, &remaining)?;
        let far_party = far_answer.recv()??;
        Ok(Self {
            hosts,
            near,
            turns,
            far,
            far_party,
            refusals: claim(0),
        })
    }
}

fn open_case(
    hosts: &mut Hosts,
    CasePlan { kind, plan, .. }: &CasePlan,
) -> Result<(Loose, Loose), SetupError> {
    Ok(match kind {
        Kind::Echo => {
            let [near, far] = EchoSide::pair(&hosts.network, *plan)?;
            (Loose::Ready(Box::new(near)), Loose::Ready(Box::new(far)))
        }
        Kind::Plain => {
            let [near, far] = PlainSide::pair(&hosts.network, plan.size_bytes)?;
            (Loose::Ready(Box::new(near)), Loose::Ready(Box::new(far)))
        }
        Kind::Gateway => {
            let [near, far] = hosts.add(*plan)?.map(Box::new);
            let noted = Arc::<AtomicU64>::default();
            (
                Loose::Gateway(near, Arc::clone(&noted)),
                Loose::Gateway(far, noted),
            )
        }
        Kind::BetweenGateways => (Loose::Twin, Loose::Twin),
        Kind::Hop => {
            let [near, far] = hosts.add(*plan)?.map(Box::new);
            let noted = Noted::default();
            (Loose::Hop(near, Arc::clone(&noted)), Loose::Hop(far, noted))
        }
        Kind::Applications { .. } => {
            let joints = Box::new(hosts.add(*plan)?);
            (Loose::Applications(joints), Loose::Elsewhere)
        }
    })
}

fn connect(
    end: Loose,
    before: Option<&NearEnd>,
    case: usize,
    turns: &Arc<Turns>,
    cpu_count: usize,
) -> Result<NearEnd, SetupError> {
    Ok(match end {
        Loose::Ready(side) => NearEnd::PingPong(side),
        Loose::Gateway(joint, noted) => {
            let pair = Pair {
                side: GatewaySide::connect(*joint, noted)?,
                case,
                whole: None,
                between_gateways: None,
            };
            NearEnd::Gateway(Shared(Rc::new(RefCell::new(pair))), Column::Whole)
        }
        Loose::Twin => match before {
            Some(NearEnd::Gateway(shared, _)) => {
                NearEnd::Gateway(shared.clone(), Column::BetweenGateways)
            }
            _ => return Err("a twin follows its gateways".into()),
        },
        Loose::Hop(joint, noted) => NearEnd::Hop {
            side: Box::new(GatewaySide::connect(*joint, Arc::default())?),
            noted,
            usage: Usage::default(),
        },
        Loose::Applications(joints) => NearEnd::Applications(Box::new(PartyGroup::start(
            *joints, case, turns, cpu_count,
        )?)),
        Loose::Elsewhere => return Err("every case has a near end".into()),
    })
}

impl NearEnd {
    /// Datagrams with a receive stamp and datagrams received by this end; `None` where no stamps
    /// were asked for.
    pub fn stamp_coverage(&self) -> Option<(u64, u64)> {
        match self {
            Self::PingPong(side) => side.stamp_coverage(),
            Self::Gateway(shared, Column::Whole) => shared.0.borrow().side.stamp_coverage(),
            // The traffic of a hop goes the other way; a group's is in its records.
            Self::Gateway(..) | Self::Hop { .. } | Self::Applications(_) => None,
        }
    }
}

fn greet_near(ends: &mut [NearEnd], remaining: &AtomicUsize) -> Result<(), SetupError> {
    let mut shared: Vec<RefMut<'_, Pair>> = Vec::new();
    let mut sides: Vec<&mut GatewaySide> = Vec::new();
    for end in ends {
        match end {
            NearEnd::Gateway(pair, Column::Whole) => shared.push(pair.0.borrow_mut()),
            NearEnd::Hop { side, .. } => sides.push(side),
            _ => {}
        }
    }
    sides.extend(shared.iter_mut().map(|pair| &mut pair.side));
    greet_all(sides.into_iter(), remaining)
}

fn greet_all<'a>(
    sides: impl Iterator<Item = &'a mut GatewaySide>,
    remaining: &AtomicUsize,
) -> Result<(), SetupError> {
    let mut directions: Vec<_> = sides.flat_map(GatewaySide::directions).collect();
    greet(&mut directions, remaining)
}

enum FarSide {
    Any(Box<dyn Side>),
    Gateway(Box<GatewaySide>),
    Sink(Box<Sink>),
    /// Keeps the place of a case the far thread knows by another number.
    Nobody(Nobody),
}

#[derive(Debug)]
struct Nobody;

impl Side for Nobody {
    fn send(&mut self, _count: u64) {}

    fn receive(&mut self) -> Option<u64> {
        None
    }

    fn sleeps(&self) -> bool {
        false
    }
}

impl FarSide {
    fn as_side(&mut self) -> &mut dyn Side {
        match self {
            Self::Any(side) => side.as_mut(),
            Self::Gateway(side) => side.as_mut(),
            Self::Sink(sink) => sink.as_mut(),
            Self::Nobody(nobody) => nobody,
        }
    }

    fn gateway(&mut self) -> Option<&mut GatewaySide> {
        match self {
            Self::Any(_) | Self::Nobody(_) => None,
            Self::Gateway(side) => Some(side),
            Self::Sink(sink) => Some(&mut sink.side),
        }
    }
}

fn far_thread(
    ends: Vec<Loose>,
    turns: &Turns,
    remaining: &AtomicUsize,
    ready: &Sender<Result<Party, SetupError>>,
) -> Vec<String> {
    let mut sides = match far_sides(ends, remaining) {
        Ok(sides) => sides,
        Err(error) => {
            drop(ready.send(Err(error)));
            return Vec::new();
        }
    };
    let refusals = claim(1);
    drop(ready.send(Ok(Party::myself("far thread"))));
    let mut sides: Vec<&mut dyn Side> = sides.iter_mut().map(FarSide::as_side).collect();
    answer(turns, &mut sides);
    refusals
}

fn far_sides(ends: Vec<Loose>, remaining: &AtomicUsize) -> Result<Vec<FarSide>, SetupError> {
    let mut sides = Vec::new();
    for end in ends {
        sides.push(match end {
            Loose::Ready(side) => FarSide::Any(side),
            Loose::Gateway(joint, noted) => {
                FarSide::Gateway(Box::new(GatewaySide::connect(*joint, noted)?))
            }
            Loose::Twin => FarSide::Nobody(Nobody),
            Loose::Hop(joint, noted) => FarSide::Sink(Box::new(Sink {
                side: GatewaySide::connect(*joint, Arc::default())?,
                noted,
            })),
            // Crews come last and have threads of their own.
            Loose::Applications(_) | Loose::Elsewhere => break,
        });
    }
    greet_all(sides.iter_mut().filter_map(FarSide::gateway), remaining)?;
    Ok(sides)
}
