//! The sending gateway's end of the seal: asks for keys, seals what its bridge gives, and opens the
//! replies. It owns no socket.

use super::counts::{SealCounts, SealRefusal};
use super::keys::{Association, Root, Salt};
use super::layout::{
    KEY_EXCHANGE_BYTES, KeyExchange, SealFields, about, code_place, covered, handed_ns_of, kind_of,
};
use super::traffic::{OpeningWay, Rotation, SealingWay};
use crate::wire::{Kind, TAG_BYTES, u32_at};

/// Clock exchanges without an authentic reply after which keys are asked for again: the receiver may
/// have started anew, and then knows the old ones no more.
pub const UNANSWERED_MAX: u32 = 3;
/// Starts of the receiver whose keys are never taken up again.
const RETIRED_LENGTH: usize = 32;

/// What a reply was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heard {
    /// An authentic reply for the bridge; so long is the plain datagram.
    Reply(usize),
    /// Keys for a start of the receiver that was not known before.
    Keys,
    /// Nothing new.
    Nothing,
}

#[derive(Debug)]
struct Traffic {
    answering: Salt,
    forward: SealingWay,
    backward: OpeningWay,
}

/// The sending end.
#[derive(Debug)]
pub struct Initiator {
    root: Root,
    salt: Salt,
    rotation: Rotation,
    session: u32,
    traffic: Option<Traffic>,
    /// Number of the newest request, from 1.
    request: u64,
    /// Number of the newest request whose answer was taken.
    answered: u64,
    retired: [Option<Salt>; RETIRED_LENGTH],
    retired_next: usize,
    unanswered_count: u32,
    counts: SealCounts,
}

impl Initiator {
    /// `salt` is drawn at random for each start of a gateway.
    pub fn new(association: &Association, salt: Salt, rotation: Rotation) -> Self {
        Self {
            root: Root::new(association),
            salt,
            rotation,
            session: 0,
            traffic: None,
            request: 0,
            answered: 0,
            retired: [None; RETIRED_LENGTH],
            retired_next: 0,
            unanswered_count: 0,
            counts: SealCounts::default(),
        }
    }

    /// A request for keys that is due before the bridge's `datagram`: with every greeting, and when
    /// clock exchanges stay without an authentic reply.
    pub fn request_before(&mut self, datagram: &[u8]) -> Option<[u8; KEY_EXCHANGE_BYTES]> {
        self.session = u32_at(datagram, 8);
        match kind_of(datagram) {
            Kind::Hello => {}
            Kind::SyncRequest => {
                self.unanswered_count = self.unanswered_count.saturating_add(1);
                if self.unanswered_count <= UNANSWERED_MAX {
                    return None;
                }
            }
            _ => return None,
        }
        self.request += 1;
        self.counts.key_exchange_count += 1;
        let request = KeyExchange {
            kind: Kind::KeyRequest,
            session: self.session,
            flow: self.root.flow,
            request: self.request,
            generation: self.traffic.as_ref().map_or(0, |one| one.forward.index()),
            handed_ns: handed_ns_of(datagram),
            salt: self.salt,
            about: self
                .traffic
                .as_ref()
                .map_or([0; 8], |one| about(&one.answering)),
        };
        let mut bytes = [0; KEY_EXCHANGE_BYTES];
        request.write(&mut bytes);
        let code = ring::hmac::sign(&self.root.request, covered(&bytes).0);
        code_place(&mut bytes).copy_from_slice(code.as_ref());
        Some(bytes)
    }

    /// Seals the bridge's `datagram` into the start of `out` and gives the length; `None` without keys.
    ///
    /// # Panics
    /// When `out` is not 16 bytes longer than `datagram`.
    pub fn seal(&mut self, datagram: &[u8], out: &mut [u8]) -> Option<usize> {
        self.seal_parts(datagram, &[], out)
    }

    /// As [`Initiator::seal`], of a datagram that lies in two places.
    ///
    /// # Panics
    /// When `out` is not 16 bytes longer than both.
    pub fn seal_parts(&mut self, head: &[u8], tail: &[u8], out: &mut [u8]) -> Option<usize> {
        let traffic = self.traffic.as_mut()?;
        let length = head.len() + tail.len() + TAG_BYTES;
        out[..head.len()].copy_from_slice(head);
        out[head.len()..][..tail.len()].copy_from_slice(tail);
        let counts = &mut self.counts;
        traffic.forward.seal(&mut out[..length], counts);
        Some(length)
    }

    /// Opens a reply in place.
    ///
    /// # Errors
    /// Why it is refused; it is counted.
    pub fn open(&mut self, datagram: &mut [u8]) -> Result<Heard, SealRefusal> {
        let result = self.accept(datagram);
        match result {
            Ok(Heard::Reply(_)) => self.unanswered_count = 0,
            Ok(_) => {}
            Err(cause) => self.counts.refused.count(cause),
        }
        result
    }

    fn accept(&mut self, datagram: &mut [u8]) -> Result<Heard, SealRefusal> {
        let fields = SealFields::read(datagram, self.root.flow)?;
        match fields.kind {
            Kind::KeyAnswer => return self.take_keys(datagram),
            Kind::HelloAck | Kind::SyncResponse | Kind::PieceAck => {}
            _ => return Err(SealRefusal::WrongWay),
        }
        let traffic = self
            .traffic
            .as_mut()
            .filter(|_| fields.session == self.session);
        let traffic = traffic.ok_or(SealRefusal::ForeignSession)?;
        let opened = traffic.backward.open(fields, datagram, &mut self.counts);
        opened.map(Heard::Reply)
    }

    fn take_keys(&mut self, datagram: &[u8]) -> Result<Heard, SealRefusal> {
        let answer = KeyExchange::read(datagram)?;
        if answer.session != self.session {
            return Err(SealRefusal::ForeignSession);
        }
        let (said, code) = covered(datagram);
        let mut bound = [0; KEY_EXCHANGE_BYTES];
        let length = said.len() + self.salt.len();
        bound[..said.len()].copy_from_slice(said);
        bound[said.len()..length].copy_from_slice(&self.salt);
        if ring::hmac::verify(&self.root.answer, &bound[..length], code).is_err() {
            return Err(SealRefusal::BadTag);
        }
        if answer.request <= self.answered || answer.request > self.request {
            return Err(SealRefusal::Unsolicited);
        }
        if let Some(traffic) = &mut self.traffic
            && traffic.answering == answer.salt
        {
            self.answered = answer.request;
            let now_ns = answer.handed_ns;
            let counts = &mut self.counts;
            traffic.backward.catch_up(answer.generation, now_ns, counts);
            return Ok(Heard::Nothing);
        }
        // Keys that were in use once must never be again: their numbers would begin anew.
        if self.retired.contains(&Some(answer.salt)) {
            return Err(SealRefusal::Unsolicited);
        }
        self.answered = answer.request;
        self.adopt(answer.salt);
        Ok(Heard::Keys)
    }

    fn adopt(&mut self, answering: Salt) {
        if let Some(old) = self.traffic.take() {
            self.retired[self.retired_next] = Some(old.answering);
            self.retired_next = (self.retired_next + 1) % RETIRED_LENGTH;
        }
        let forward = self.root.forward(&self.salt, &answering);
        let backward = self.root.backward(&self.salt, &answering);
        self.traffic = Some(Traffic {
            answering,
            forward: SealingWay::new(forward, self.rotation),
            backward: OpeningWay::new(&backward, self.rotation),
        });
        self.counts.agreement_count += 1;
        self.unanswered_count = 0;
    }

    /// What was counted so far.
    pub const fn counts(&self) -> SealCounts {
        self.counts
    }
}
