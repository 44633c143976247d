//! Why a secured hop refused a datagram, and how often. It decides nothing.

use core::fmt;

macro_rules! causes {
    ($($(#[doc = $doc:literal])+ $variant:ident => $name:literal, $message:literal;)+) => {
        /// Why a secured hop refused a datagram.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
        pub enum SealRefusal {
            $($(#[doc = $doc])+ #[error($message)] $variant,)+
        }

        impl SealRefusal {
            /// All of them, in the order of checking.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// As reports print it.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)+ }
            }
        }
    };
}

causes! {
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
    /// The channel is not this one.
    ForeignChannel => "foreign channel", "channel is not carried here";
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

const CAUSES: usize = SealRefusal::ALL.len();

/// What one end of a secured hop counted.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct SealCounts {
    /// Datagrams sealed.
    pub sealed_count: u64,
    /// Datagrams opened: authentic and new.
    pub opened_count: u64,
    /// Requests and answers for keys sent.
    pub key_exchange_count: u64,
    /// Keys agreed with another start of the peer.
    pub agreement_count: u64,
    /// Times a key gave way to the next generation, both ways together.
    pub rotation_count: u64,
    pub(super) refused: [u64; CAUSES],
}

impl Default for SealCounts {
    fn default() -> Self {
        Self {
            sealed_count: 0,
            opened_count: 0,
            key_exchange_count: 0,
            agreement_count: 0,
            rotation_count: 0,
            refused: [0; CAUSES],
        }
    }
}

impl SealCounts {
    /// Counts one refusal.
    pub fn refuse(&mut self, cause: SealRefusal) {
        self.refused[cause as usize] += 1;
    }

    /// How often `cause` happened.
    pub const fn refused(&self, cause: SealRefusal) -> u64 {
        self.refused[cause as usize]
    }

    /// Datagrams refused for any cause.
    pub fn refused_total(&self) -> u64 {
        self.refused.iter().sum()
    }

    /// Every cause with its count, zeros included, in the order of checking.
    pub fn refusals(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        let refused = self.refused;
        let causes = SealRefusal::ALL.iter();
        causes.map(move |&cause| (cause.name(), refused[cause as usize]))
    }
}

impl fmt::Debug for SealCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let happened = self.refusals().filter(|(_, count)| *count > 0);
        let happened: Vec<_> = happened.collect();
        f.debug_struct("SealCounts")
            .field("sealed_count", &self.sealed_count)
            .field("opened_count", &self.opened_count)
            .field("key_exchange_count", &self.key_exchange_count)
            .field("agreement_count", &self.agreement_count)
            .field("rotation_count", &self.rotation_count)
            .field("refused", &happened)
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cause_has_a_name_and_a_counter_of_its_own() {
        let mut counts = SealCounts::default();
        for (index, &cause) in SealRefusal::ALL.iter().enumerate() {
            assert_eq!(cause as usize, index);
            for _ in 0..=index {
                counts.refuse(cause);
            }
            assert_eq!(counts.refused(cause), index as u64 + 1);
        }
        let mut names: Vec<_> = counts.refusals().map(|(name, _)| name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), CAUSES);
        let n = CAUSES as u64;
        assert_eq!(counts.refused_total(), n * (n + 1) / 2);
    }
}
