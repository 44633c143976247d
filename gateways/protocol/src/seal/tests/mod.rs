//! The seal between two ends in one thread: agreement, forgery, replay, rotation, restart.

mod agreement;
mod forgery;
mod rotation;

use super::*;
use crate::wire::{HEADER_BYTES, Header, Kind};

pub(super) const SUITES: [Suite; 2] = [Suite::Aes256Gcm, Suite::ChaCha20Poly1305];
pub(super) const SESSION: u32 = 77;

pub(super) fn association(suite: Suite) -> Association {
    Association {
        secret: RunSecret::new(&mut [9; 32]),
        suite,
        flow: 3,
        flow_name: "link/hop/forward".to_owned(),
    }
}

/// A datagram as a bridge makes it.
pub(super) fn plain(kind: Kind, sequence: u64, handed_ns: i64, payload: &[u8]) -> Vec<u8> {
    let mut header = Header::new(kind, SESSION, 3);
    header.sequence = sequence;
    header.handed_ns = handed_ns;
    header.total_len = u32::try_from(payload.len()).unwrap();
    let mut bytes = vec![0; HEADER_BYTES + payload.len()];
    header.encode(&mut bytes);
    bytes[HEADER_BYTES..].copy_from_slice(payload);
    bytes
}

pub(super) fn hello() -> Vec<u8> {
    plain(Kind::Hello, 0, 1_000, &[5; 60])
}

/// Both ends of a flow.
pub(super) struct Pair {
    pub(super) sender: Initiator,
    pub(super) receiver: Responder,
}

impl Pair {
    /// Without keys yet.
    pub(super) fn strangers(suite: Suite, rotation: Rotation) -> Self {
        Self {
            sender: Initiator::new(&association(suite), [1; 16], rotation),
            receiver: Responder::new(&association(suite), &[2; 32], rotation),
        }
    }

    /// With keys.
    pub(super) fn agreed(suite: Suite, rotation: Rotation) -> Self {
        let mut pair = Self::strangers(suite, rotation);
        assert_eq!(pair.agree(), Heard::Keys);
        pair
    }

    /// One request and its answer.
    pub(super) fn agree(&mut self) -> Heard {
        let mut request = self.sender.request_before(&hello()).unwrap();
        let Ok(Opened::Answer(mut answer)) = self.receiver.open(&mut request) else {
            panic!("an authentic request is answered");
        };
        self.sender.open(&mut answer).unwrap()
    }

    pub(super) fn sealed(&mut self, datagram: &[u8]) -> Vec<u8> {
        let mut out = vec![0; datagram.len() + 16];
        let length = self.sender.seal(datagram, &mut out).unwrap();
        assert_eq!(length, out.len());
        out
    }

    pub(super) fn open(&mut self, mut sealed: Vec<u8>) -> Result<Vec<u8>, SealRefusal> {
        match self.receiver.open(&mut sealed)? {
            Opened::Datagram(length) => {
                sealed.truncate(length);
                Ok(sealed)
            }
            Opened::Answer(_) => panic!("no request for keys"),
        }
    }
}
