//! How long a datagram the path takes. Greetings are padded to the length under test, and an answer proves it:
//! packetization layer path MTU discovery (RFC 8899) with a list of lengths, before the first message. Nothing that a
//! router or a stranger says of the path is asked.

use crate::wire::payload_budget_bytes;

/// Packets that paths are known to take, less the longest headers of IP and UDP (48 bytes): jumbo frames, `WireGuard`
/// over them, Ethernet, `PPPoE`, `WireGuard`, the least of IPv6, the least that most links of IPv4 keep to.
const KNOWN_BYTES: [usize; 8] = [
    9000 - 48,
    8920 - 48,
    1500 - 48,
    1492 - 48,
    1420 - 48,
    1280 - 48,
    1006 - 48,
    576 - 48,
];
/// Greetings of one length without an answer, after which a shorter one is tried. Where every other one and every other
/// answer is lost, a length that the path takes is given up once in ten times.
const TRY_COUNT: u32 = 8;
/// Greetings that are remembered: 3.2 s of them.
const SENT_COUNT: usize = 64;

/// A greeting that left.
#[derive(Debug, Clone, Copy)]
struct Sent {
    handed_ns: i64,
    /// Index of its length.
    rung: usize,
}

/// The search of one flow.
#[derive(Debug)]
pub(super) struct PathSearch {
    /// Lengths of datagrams with their tags, the longest first, the last that of a bare greeting.
    lengths: Box<[usize]>,
    /// Payload of a datagram of the last but one, which a path that takes no more is given.
    least_budget_bytes: usize,
    /// The length under test; the path did not take those before it.
    rung: usize,
    try_count: u32,
    /// The longest of this round that was answered.
    answered: Option<usize>,
    sent: [Option<Sent>; SENT_COUNT],
    sent_count: usize,
}

impl PathSearch {
    /// Between `longest`, the longest datagram that the flow has to send, and a `bare` greeting.
    pub(super) fn new(longest: usize, bare: usize) -> Self {
        let shorter = KNOWN_BYTES.into_iter().filter(|length| *length < longest);
        let lengths = [longest].into_iter().chain(shorter);
        let mut lengths: Vec<usize> = lengths.filter(|length| *length > bare).collect();
        let least_budget_bytes = payload_budget_bytes(lengths.last().copied().unwrap_or(bare));
        // A single length leaves nothing to find out.
        if lengths.len() < 2 {
            lengths.clear();
        }
        lengths.push(bare);
        Self {
            lengths: lengths.into_boxed_slice(),
            least_budget_bytes,
            rung: 0,
            try_count: 0,
            answered: None,
            sent: [None; SENT_COUNT],
            sent_count: 0,
        }
    }

    /// A new round of greetings. Lengths that were given up stay so.
    pub(super) fn begin(&mut self) {
        self.try_count = 0;
        self.answered = None;
        self.sent = [None; SENT_COUNT];
    }

    /// Length of the greeting that leaves now, its tag included. Until the peer has answered any, every other one is
    /// bare: it may not be there.
    pub(super) fn next_length(&mut self, handed_ns: i64) -> usize {
        let last = self.lengths.len() - 1;
        let is_bare = self.answered.is_none() && self.try_count % 2 == 1;
        if self.answered.is_some() && self.try_count >= TRY_COUNT {
            self.rung = (self.rung + 1).min(last);
            self.try_count = 0;
        }
        self.try_count += 1;
        let rung = if is_bare { last } else { self.rung };
        self.sent[self.sent_count % SENT_COUNT] = Some(Sent { handed_ns, rung });
        self.sent_count += 1;
        self.lengths[rung]
    }

    /// The greeting handed over at `handed_ns` was answered. True when the length is found, else another is to be sent.
    pub(super) fn on_answer(&mut self, handed_ns: i64) -> bool {
        let mut sent = self.sent.iter().flatten();
        let of = sent.find(|one| one.handed_ns == handed_ns);
        let rung = of.map_or(self.lengths.len() - 1, |one| one.rung);
        if self.answered.is_none() {
            self.try_count = 0;
        }
        let longest = self.answered.map_or(rung, |before| before.min(rung));
        self.answered = Some(longest);
        let is_found = longest <= self.rung;
        if is_found {
            self.rung = longest;
        }
        is_found
    }

    /// The longest greeting.
    pub(super) fn greeting_bytes_max(&self) -> usize {
        self.lengths[0]
    }

    /// Bytes of a message in a datagram of the shortest length that may be found.
    pub(super) const fn least_budget_bytes(&self) -> usize {
        self.least_budget_bytes
    }

    /// Bytes of a message in a datagram of the length found.
    pub(super) fn budget_bytes(&self) -> usize {
        payload_budget_bytes(self.lengths[self.rung]).max(self.least_budget_bytes)
    }

    /// The length found, if the path does not take the longest.
    pub(super) fn shortened(&self) -> Option<usize> {
        (self.rung > 0).then(|| self.lengths[self.rung])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Greets over a path that takes `path_bytes` until the length is found, and gives it and how many greetings that took.
    fn found(search: &mut PathSearch, path_bytes: usize, absent_count: i64) -> (usize, i64) {
        search.begin();
        for handed_ns in 0..1_000 {
            let length = search.next_length(handed_ns);
            let is_answered = handed_ns >= absent_count && length <= path_bytes;
            if is_answered && search.on_answer(handed_ns) {
                return (search.budget_bytes(), handed_ns + 1);
            }
        }
        panic!("not found");
    }

    #[test]
    fn a_path_that_takes_the_longest_is_found_with_the_first_answer() {
        let mut search = PathSearch::new(1472, 120);
        assert_eq!(found(&mut search, 1472, 0), (1472 - 88, 1));
        assert_eq!(search.shortened(), None);
        // The peer comes late, and the greeting that it answers first is a bare one.
        for absent_count in [1, 2, 31] {
            let (budget, count) = found(&mut search, 1472, absent_count);
            assert_eq!(budget, 1472 - 88);
            assert!(count <= absent_count + 2, "{count} for {absent_count}");
        }
    }

    #[test]
    fn a_shorter_path_is_found_before_the_first_message_and_known_afterwards() {
        for (path_bytes, length) in [(1392, 1372), (1252, 1232), (600, 528), (1471, 1452)] {
            let mut search = PathSearch::new(1472, 120);
            let (budget, count) = found(&mut search, path_bytes, 5);
            assert_eq!(budget, length - 88);
            assert_eq!(search.shortened(), Some(length));
            assert!(count < 60, "{count}");
            let (again, count) = found(&mut search, path_bytes, 0);
            assert_eq!((again, count), (budget, 1));
        }
    }

    #[test]
    fn a_path_shorter_than_any_is_given_the_least_and_small_messages_ask_nothing() {
        let mut search = PathSearch::new(1472, 120);
        assert_eq!(found(&mut search, 300, 0).0, 528 - 88);
        let mut search = PathSearch::new(180, 120);
        assert_eq!(found(&mut search, 120, 0), (180 - 88, 1));
        assert_eq!(search.shortened(), None);
    }

    #[test]
    fn lost_greetings_shorten_nothing_that_is_answered_once() {
        let mut search = PathSearch::new(1472, 120);
        search.begin();
        let lengths = [0, 1].map(|handed_ns| search.next_length(handed_ns));
        assert_eq!(lengths, [1472, 120]);
        let bare = 1;
        assert!(!search.on_answer(bare));
        for handed_ns in 100..106 {
            assert_eq!(search.next_length(handed_ns), 1472);
        }
        assert!(search.on_answer(101));
        assert_eq!(search.shortened(), None);
    }
}
