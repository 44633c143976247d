//! How long a datagram the path takes. Greetings are padded to the length under test, and an answer proves it:
//! packetization layer path MTU discovery (RFC 8899) with a list of lengths, before the first message. Nothing that a
//! router or a stranger says of the path is asked.

use crate::wire::payload_budget_bytes;

/// Packets that paths are known to take, less the longest headers of IP and UDP (48 bytes): jumbo frames, `WireGuard`
/// over them, `PPPoE`, `WireGuard`, the least of IPv6, the least that most links of IPv4 keep to.
const KNOWN_BYTES: [usize; 7] = [
    9000 - 48,
    8920 - 48,
    1492 - 48,
    1420 - 48,
    1280 - 48,
    1006 - 48,
    576 - 48,
];
/// Lengths that differ by no more than headers may are one.
const HEADERS_DIFFER_BYTES: usize = 20;
/// Padded greetings without an answer, each beside an answered bare one, after which a shorter length is tried. Where three
/// of ten datagrams are lost each way, a length that the path takes is given up once in 600 times.
const TRY_COUNT: u32 = 6;
/// The same of lengths that were given up in an earlier round.
const TRY_AGAIN_COUNT: u32 = 2;
/// Greetings that are remembered: 1.6 s of them.
const SENT_COUNT: usize = 64;

/// A greeting that left.
#[derive(Debug, Clone, Copy)]
struct Sent {
    handed_ns: i64,
    /// Index of its length.
    rung: usize,
    is_answered: bool,
}

/// The search of one flow.
#[derive(Debug)]
pub(super) struct PathSearch {
    /// Lengths of datagrams with their tags, the longest first.
    lengths: Box<[usize]>,
    /// The length of a greeting without padding.
    bare: usize,
    /// The length under test; the path did not take those before it.
    rung: usize,
    /// Those before it were given up in an earlier round.
    known_rung: usize,
    failed_count: u32,
    sent: [Option<Sent>; SENT_COUNT],
    sent_count: usize,
}

impl PathSearch {
    /// Between `longest`, the longest datagram that the flow has to send, and a `bare` greeting.
    pub(super) fn new(longest: usize, bare: usize) -> Self {
        let longest = longest.max(bare);
        let is_shorter =
            |length: &usize| *length > bare && *length + HEADERS_DIFFER_BYTES < longest;
        let shorter = KNOWN_BYTES.into_iter().filter(is_shorter);
        Self {
            lengths: [longest].into_iter().chain(shorter).collect(),
            bare,
            rung: 0,
            known_rung: 0,
            failed_count: 0,
            sent: [None; SENT_COUNT],
            sent_count: 0,
        }
    }

    /// True where the flow has but one length, and there is nothing to find out.
    const fn is_decided(&self) -> bool {
        self.lengths.len() == 1
    }

    /// A new round of greetings.
    pub(super) fn begin(&mut self) {
        self.known_rung = self.known_rung.max(core::mem::take(&mut self.rung));
        self.failed_count = 0;
        self.sent = [None; SENT_COUNT];
    }

    /// Length of the greeting that leaves now, its tag included: a padded one, and behind it a bare one, which tells whether
    /// the peer is there. And whether the next one is such a bare one.
    pub(super) fn next_length(&mut self, handed_ns: i64) -> (usize, bool) {
        let is_padded = |sent: &Sent| sent.rung < self.lengths.len();
        let is_behind_padded = self.newest().is_some_and(is_padded);
        let rung = if self.is_decided() || is_behind_padded {
            self.lengths.len()
        } else {
            self.rung
        };
        self.sent[self.sent_count % SENT_COUNT] = Some(Sent {
            handed_ns,
            rung,
            is_answered: false,
        });
        self.sent_count += 1;
        match self.lengths.get(rung) {
            Some(length) => (*length, true),
            None => (self.bare, false),
        }
    }

    fn newest(&self) -> Option<&Sent> {
        let place = self.sent_count.checked_sub(1)?;
        self.sent[place % SENT_COUNT].as_ref()
    }

    /// The greeting handed over at `handed_ns` was answered. True when the length is found.
    pub(super) fn on_answer(&mut self, handed_ns: i64) -> bool {
        if self.is_decided() {
            return true;
        }
        let of = |sent: &Option<Sent>| sent.is_some_and(|one| one.handed_ns == handed_ns);
        let Some(place) = self.sent.iter().position(of) else {
            return false;
        };
        let Some(answered) = self.sent[place].as_mut() else {
            return false;
        };
        // An answer may come twice.
        if core::mem::replace(&mut answered.is_answered, true) {
            return false;
        }
        let rung = answered.rung;
        if rung < self.lengths.len() {
            // A longer one than is under test may be answered late.
            self.rung = self.rung.min(rung);
            return rung == self.rung;
        }
        let before = self.sent[(place + SENT_COUNT - 1) % SENT_COUNT];
        let has_failed = before.is_some_and(|one| one.rung == self.rung && !one.is_answered);
        self.failed_count += u32::from(has_failed);
        let try_count = if self.rung < self.known_rung {
            TRY_AGAIN_COUNT
        } else {
            TRY_COUNT
        };
        // Below the last no flow is of use.
        if self.failed_count >= try_count && self.rung + 1 < self.lengths.len() {
            self.rung += 1;
            self.failed_count = 0;
        }
        false
    }

    /// The longest greeting.
    pub(super) fn greeting_bytes_max(&self) -> usize {
        self.lengths[0]
    }

    /// Bytes of a message in a datagram of the shortest length that may be found.
    pub(super) fn least_budget_bytes(&self) -> usize {
        self.lengths
            .last()
            .map_or(0, |length| payload_budget_bytes(*length))
    }

    /// Bytes of a message in a datagram of the length found.
    pub(super) fn budget_bytes(&self) -> usize {
        payload_budget_bytes(self.lengths[self.rung])
    }

    /// The length found, if the path does not take the longest.
    pub(super) fn shortened(&self) -> Option<usize> {
        (self.rung > 0).then(|| self.lengths[self.rung])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Greets over a path that takes `path_bytes` until the length is found, and gives what a datagram then holds and how
    /// many pairs of greetings that took. The peer is there from the pair `absent_count` on.
    fn found(search: &mut PathSearch, path_bytes: usize, absent_count: i64) -> (usize, i64) {
        search.begin();
        for pair in 0..1_000 {
            let mut is_found = false;
            let mut has_bare = true;
            for handed_ns in [2 * pair, 2 * pair + 1] {
                if !has_bare {
                    break;
                }
                let (length, is_padded) = search.next_length(handed_ns);
                has_bare = is_padded;
                let is_answered = pair >= absent_count && length <= path_bytes;
                is_found |= is_answered && search.on_answer(handed_ns);
            }
            if is_found {
                return (search.budget_bytes(), pair + 1);
            }
        }
        panic!("not found");
    }

    #[test]
    fn a_path_that_takes_the_longest_is_found_with_the_first_answer() {
        for absent_count in [0, 1, 2, 31] {
            let mut search = PathSearch::new(1472, 120);
            assert_eq!(
                found(&mut search, 1472, absent_count),
                (1472 - 88, absent_count + 1)
            );
            assert_eq!(search.shortened(), None);
        }
    }

    #[test]
    fn a_shorter_path_is_found_before_the_first_message_and_again_in_less_time() {
        for (path_bytes, length) in [(1392, 1372), (1252, 1232), (600, 528), (1471, 1444)] {
            let mut search = PathSearch::new(1472, 120);
            let (budget, count) = found(&mut search, path_bytes, 5);
            assert_eq!(budget, length - 88);
            assert_eq!(search.shortened(), Some(length));
            assert!(count < 40, "{count}");
            let (again, shorter) = found(&mut search, path_bytes, 0);
            assert_eq!(again, budget);
            assert!(shorter < count, "{shorter}");
            // And a path that takes the longest again is found so.
            assert_eq!(found(&mut search, 1472, 0).0, 1472 - 88);
        }
    }

    #[test]
    fn small_messages_ask_nothing_and_a_peer_that_is_away_tells_nothing_of_the_path() {
        let mut search = PathSearch::new(180, 120);
        assert_eq!(found(&mut search, 120, 0), (180 - 88, 1));
        assert_eq!(search.shortened(), None);
        let mut search = PathSearch::new(1472, 120);
        search.begin();
        let (padded, _) = search.next_length(0);
        let (bare, _) = search.next_length(1);
        assert_eq!((padded, bare), (1472, 120));
        assert!(!search.on_answer(1));
        // Silence for as long as it likes, and answers that come twice.
        for handed_ns in 2..1_000 {
            search.next_length(handed_ns);
            assert!(!search.on_answer(1));
        }
        assert_eq!(search.lengths[search.rung], 1472);
    }
}
