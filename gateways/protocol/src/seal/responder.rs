//! The receiving gateway's end of the seal: answers authentic requests for keys, opens what comes, and
//! seals the bridge's replies. It owns no socket.

use super::counts::{SealCounts, SealRefusal};
use super::keys::{Association, Root, SALT_BYTES, Salt};
use super::layout::{KEY_EXCHANGE_BYTES, KeyExchange, SealFields, about, code_place, covered};
use super::traffic::{OpeningWay, Rotation, SealingWay};
use crate::wire::{Kind, TAG_BYTES, u32_at};

/// Starts of the sender that keys are held for: nobody without the run's secret takes a place, and
/// requests that were recorded in the run take one per start of the sender.
const PLACES: usize = 8;

/// What an accepted datagram was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Opened {
    /// An authentic datagram for the bridge; so long is the plain datagram.
    Datagram(usize),
    /// A request for keys; send this answer to where it came from.
    Answer([u8; KEY_EXCHANGE_BYTES]),
}

/// Keys agreed with one start of the sender.
#[derive(Debug)]
struct Place {
    session: u32,
    asking: Salt,
    answering: Salt,
    /// Number of the newest request answered.
    request: u64,
    forward: OpeningWay,
    backward: SealingWay,
    /// It sealed something under these keys, so it is no recording.
    is_proven: bool,
    used: u64,
}

/// The receiving end.
#[derive(Debug)]
pub struct Responder {
    root: Root,
    /// From which the salts of all answers follow.
    seed: ring::hmac::Key,
    drawn_count: u64,
    rotation: Rotation,
    places: Box<[Option<Place>]>,
    /// Counts uses, to tell which place was used last.
    clock: u64,
    counts: SealCounts,
}

impl Responder {
    /// `seed` is drawn at random for each start of a gateway.
    pub fn new(association: &Association, seed: &[u8; 32], rotation: Rotation) -> Self {
        Self {
            root: Root::new(association),
            seed: ring::hmac::Key::new(ring::hmac::HMAC_SHA256, seed),
            drawn_count: 0,
            rotation,
            places: (0..PLACES).map(|_| None).collect(),
            clock: 0,
            counts: SealCounts::default(),
        }
    }

    /// Opens a datagram in place.
    ///
    /// # Errors
    /// Why it is refused; it is counted.
    pub fn open(&mut self, datagram: &mut [u8]) -> Result<Opened, SealRefusal> {
        let result = self.accept(datagram);
        match &result {
            Ok(Opened::Datagram(_)) => {}
            Ok(Opened::Answer(_)) => self.counts.key_exchange_count += 1,
            Err(cause) => self.counts.refused.count(*cause),
        }
        result
    }

    fn accept(&mut self, datagram: &mut [u8]) -> Result<Opened, SealRefusal> {
        let fields = SealFields::read(datagram, self.root.flow)?;
        match fields.kind {
            Kind::KeyRequest => return self.answer(datagram).map(Opened::Answer),
            Kind::Data | Kind::SyncRequest | Kind::Hello | Kind::Bye => {}
            _ => return Err(SealRefusal::WrongWay),
        }
        let place = find(&mut self.places, fields.session).ok_or(SealRefusal::ForeignSession)?;
        let length = place.forward.open(fields, datagram, &mut self.counts)?;
        self.clock += 1;
        place.used = self.clock;
        place.is_proven = true;
        Ok(Opened::Datagram(length))
    }

    fn answer(&mut self, datagram: &[u8]) -> Result<[u8; KEY_EXCHANGE_BYTES], SealRefusal> {
        let request = KeyExchange::read(datagram)?;
        let (said, code) = covered(datagram);
        if ring::hmac::verify(&self.root.request, said, code).is_err() {
            return Err(SealRefusal::BadTag);
        }
        let known = find(&mut self.places, request.session);
        match known.filter(|place| place.asking == request.salt) {
            Some(place) if request.request <= place.request => return Err(SealRefusal::Replayed),
            Some(place) => {
                place.request = request.request;
                if request.about == about(&place.answering) {
                    let (forward, counts) = (&mut place.forward, &mut self.counts);
                    forward.catch_up(request.generation, request.handed_ns, counts);
                }
            }
            None => self.agree(&request),
        }
        let place = find(&mut self.places, request.session).expect("agreed just now or before");
        let answer = KeyExchange {
            kind: Kind::KeyAnswer,
            generation: place.backward.index(),
            salt: place.answering,
            about: [0; 8],
            ..request
        };
        let mut bytes = [0; KEY_EXCHANGE_BYTES];
        answer.write(&mut bytes);
        let said = covered(&bytes).0;
        let mut code = ring::hmac::Context::with_key(&self.root.answer);
        code.update(said);
        code.update(&request.salt);
        let code = code.sign();
        code_place(&mut bytes).copy_from_slice(code.as_ref());
        Ok(bytes)
    }

    /// Keys for a start of the sender that has none.
    fn agree(&mut self, request: &KeyExchange) {
        self.drawn_count += 1;
        let drawn = ring::hmac::sign(&self.seed, &self.drawn_count.to_le_bytes());
        let mut answering = [0; SALT_BYTES];
        answering.copy_from_slice(&drawn.as_ref()[..SALT_BYTES]);
        let forward = self.root.forward(&request.salt, &answering);
        let backward = self.root.backward(&request.salt, &answering);
        self.clock += 1;
        let place = Place {
            session: request.session,
            asking: request.salt,
            answering,
            request: request.request,
            forward: OpeningWay::new(&forward, self.rotation),
            backward: SealingWay::new(backward, self.rotation),
            is_proven: false,
            used: self.clock,
        };
        let index = self.place_for(request.session);
        self.places[index] = Some(place);
        self.counts.agreement_count += 1;
    }

    /// A place of the same session, a free one, that of a recording, or the one used longest ago.
    fn place_for(&self, session: u32) -> usize {
        let order = |place: &Option<Place>| {
            let place = place.as_ref().filter(|one| one.session != session);
            place.map(|one| (one.is_proven, one.used))
        };
        let places = self.places.iter().enumerate();
        let least = places.min_by_key(|(_, place)| order(place));
        least.map_or(0, |(index, _)| index)
    }

    /// Seals the bridge's `reply` into the start of `out` and gives the length; `None` when its session
    /// has no keys.
    ///
    /// # Panics
    /// When `out` is not 16 bytes longer than `reply`.
    pub fn seal(&mut self, reply: &[u8], out: &mut [u8]) -> Option<usize> {
        let place = find(&mut self.places, u32_at(reply, 8))?;
        let length = reply.len() + TAG_BYTES;
        out[..reply.len()].copy_from_slice(reply);
        let counts = &mut self.counts;
        place.backward.seal(&mut out[..length], counts);
        Some(length)
    }

    /// Notes a datagram that its owner refused before it came here.
    pub fn refuse(&mut self, cause: SealRefusal) {
        self.counts.refused.count(cause);
    }

    /// What was counted so far.
    pub const fn counts(&self) -> SealCounts {
        self.counts
    }
}

fn find(places: &mut [Option<Place>], session: u32) -> Option<&mut Place> {
    let mut places = places.iter_mut().flatten();
    places.find(|place| place.session == session)
}
