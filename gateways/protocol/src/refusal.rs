//! Every way a datagram can be refused, and a counter for each. A bad datagram is a count, never
//! an error of the loop that received it.

use crate::counters::causes;

causes! {
    /// Why a datagram was refused.
    pub enum Refusal;
    /// One counter per [`Refusal`].
    pub struct RefusalCounts;

    /// Shorter than the fixed header.
    TooShort => "shorter than the header", "datagram is shorter than the 72-byte header";
    /// Not a datagram of this protocol.
    BadMagic => "bad magic", "datagram does not start with the magic number";
    /// Another version of the protocol.
    UnsupportedVersion => "unsupported version", "protocol version is not 2";
    /// A kind this version does not know.
    UnknownKind => "unknown kind", "kind is outside 1 to 9";
    /// The header claims another length than this version's.
    BadHeaderLength => "bad header length", "header length is not 72 bytes";
    /// A flag this version does not know.
    UnknownFlags => "unknown flags", "an unknown flag is set";
    /// Sealed, and this hop is plain.
    AuthenticationNotConfigured => "authentication not configured",
        "datagram is sealed but this hop is plain";
    /// Bytes that must be zero are not.
    ReservedNotZero => "reserved not zero", "a reserved field is not zero";
    /// Fragment index, count and total length contradict each other or an earlier fragment.
    FragmentInconsistent => "fragment inconsistent", "fragment fields contradict each other";
    /// Longer or shorter than its header says.
    LengthMismatch => "length mismatch", "datagram length differs from what its header says";
    /// The body of a greeting, reply or exchange does not parse.
    MalformedBody => "malformed body", "body does not parse";
    /// A kind that only the other direction carries.
    UnexpectedKind => "unexpected kind", "kind belongs to the other direction";
    /// The channel or flow is not this bridge's.
    UnknownChannel => "unknown channel", "channel or flow is not carried here";
    /// It comes from another address than the one that greeted.
    ForeignSource => "source that did not greet", "source address is not the one that greeted";
    /// Its session has not greeted.
    UnknownSession => "unknown session", "session has not greeted";
    /// It belongs to a session, epoch, greeting or message that is over.
    Stale => "stale", "datagram belongs to something that is over";
    /// The two hosts disagree on the message type.
    TypeMismatch => "type mismatch", "message type differs from this host's";
    /// The two hosts disagree on the channels of the flow.
    ChannelsDiffer => "channels differ", "the channels of the flow differ from this host's";
    /// Both ends of the flow lie in one shared-memory domain, so messages bypass the hop.
    SharedDomain => "shared domain", "both ends lie in one shared-memory domain";
    /// The message is larger than the channel's largest.
    Oversize => "oversize", "message is larger than the channel allows";
    /// Its stamps contradict each other or the clock.
    ImplausibleStamp => "implausible stamp", "stamps contradict each other or the clock";
    /// Its sequence number is too far ahead of everything seen.
    ImplausibleSequence => "implausible sequence", "sequence number leaps too far ahead";
    /// This fragment has arrived before.
    DuplicateFragment => "duplicate fragment", "fragment arrived before";
    /// Its destination has no memory for its message.
    NoMemory => "no memory for a piece", "there is no memory for the message of this fragment";
    /// A reply to nothing that was asked, or a second reply.
    Unsolicited => "unsolicited", "reply answers no open request";
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seal::SealRefusal;

    #[test]
    fn no_cause_of_the_seal_has_the_same_name() {
        for refusal in Refusal::ALL {
            let mut others = SealRefusal::ALL.iter();
            assert!(
                others.all(|other| other.name() != refusal.name()),
                "{refusal:?}"
            );
        }
    }

    #[test]
    fn every_refusal_has_its_own_counter_and_name() {
        let mut counts = RefusalCounts::default();
        for (index, &refusal) in Refusal::ALL.iter().enumerate() {
            assert_eq!(refusal as usize, index);
            for _ in 0..=index {
                counts.count(refusal);
            }
        }
        let mut names: Vec<_> = counts.iter().map(|(name, _)| name).collect();
        assert!(
            counts
                .iter()
                .map(|(_, n)| n)
                .eq(1..=Refusal::ALL.len() as u64)
        );
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), Refusal::ALL.len());
        let n = Refusal::ALL.len() as u64;
        assert_eq!(counts.total(), n * (n + 1) / 2);
    }
}
