//! Why a secured hop refused a datagram, and how often. It decides nothing.

use crate::counters::causes;
use crate::counts;

causes! {
    /// Why a secured hop refused a datagram.
    pub enum SealRefusal;
    /// One counter per [`SealRefusal`].
    pub struct SealRefusalCounts;

    /// It comes from another address than the peer's.
    ForeignSource => "foreign source", "source address is not the peer's";
    /// Shorter than a header and a tag.
    TooShort => "too short", "datagram is shorter than a header and a tag";
    /// Not a datagram of this protocol.
    BadMagic => "foreign protocol", "datagram does not start with the magic number";
    /// Another version of the protocol.
    WrongVersion => "wrong version", "protocol version is not 1";
    /// A plain datagram where every one must be sealed.
    NotSealed => "not sealed", "datagram is not sealed";
    /// Kind, flags or header length are none of this version.
    BadHeader => "malformed header", "kind, flags or header length are unknown";
    /// The flow is not this one.
    ForeignFlow => "foreign flow", "flow is not carried here";
    /// A kind that only the other end sends.
    WrongWay => "wrong way", "kind belongs to the other direction";
    /// No key was agreed with its session.
    ForeignSession => "foreign session", "no key was agreed with this session";
    /// Its key's generation is over, or far ahead.
    StaleEpoch => "stale key", "generation of the key is over or not yet due";
    /// Forged, damaged on the way, cut, or of another key.
    BadTag => "forged or damaged", "tag does not fit";
    /// Taken before: a copy of an authentic datagram, by an attacker or by the network.
    Replayed => "replayed", "datagram was taken before";
    /// Too old to say whether it was taken before.
    TooOld => "too old to tell from a replay", "datagram is older than the replay window";
    /// An answer to no open request for keys.
    Unsolicited => "unsolicited key answer", "key answer answers no open request";
}

counts! {
    /// What one end of a secured hop counted.
    pub struct SealCounts {
        /// Datagrams sealed.
        sealed_count,
        /// Datagrams opened: authentic and new.
        opened_count,
        /// Requests and answers for keys sent.
        key_exchange_count,
        /// Keys agreed with another start of the peer.
        agreement_count,
        /// Times a key gave way to the next generation, both ways together.
        rotation_count,
    }
    beside {
        /// Datagrams refused, by cause.
        refused: SealRefusalCounts,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cause_has_a_name_and_a_counter_of_its_own() {
        let mut counts = SealRefusalCounts::default();
        for (index, &cause) in SealRefusal::ALL.iter().enumerate() {
            assert_eq!(cause as usize, index);
            for _ in 0..=index {
                counts.count(cause);
            }
            assert_eq!(counts.get(cause), index as u64 + 1);
        }
        let mut names: Vec<_> = counts.iter().map(|(name, _)| name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), SealRefusal::ALL.len());
        let n = SealRefusal::ALL.len() as u64;
        assert_eq!(counts.total(), n * (n + 1) / 2);
    }
}
