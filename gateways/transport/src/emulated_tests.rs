//! Emulated receivers over queues: what the link model says happens to the datagrams, nothing is lost
//! uncounted, and what is held stays bounded.

use core::time::Duration;

use hil_core::link_model::Fate;
use hil_core::random::RandomStream;
use hil_link::spec::{LinkPlace, LinkSpec};

use super::*;
use crate::DatagramSender;
use crate::queue::{QueueSender, queue_pair};

const MS: i64 = 1_000_000;

/// Delays the n-th datagram by the n-th of these milliseconds; a negative one loses it.
#[derive(Debug)]
struct Listed(Vec<i64>);

impl LinkModel for Listed {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        match self.0.remove(0) {
            ms if ms < 0 => Fate::Lost,
            ms => Fate::Delivered(now + Duration::from_millis(ms.unsigned_abs())),
        }
    }
}

fn emulated(
    link: impl LinkModel + 'static,
    capacity_count: usize,
) -> (QueueSender, EmulatedReceiver) {
    let (sender, inner) = queue_pair();
    let settings = EmulatedSettings {
        capacity_count,
        datagram_bytes_max: 16,
        clock: None,
    };
    let offer_of = |datagram: &[u8]| (datagram.first() != Some(&b'h')).then_some(ANY);
    let receiver = EmulatedReceiver::new(Box::new(inner), Box::new(link), offer_of, 0, settings);
    (sender, receiver)
}

const ANY: Offer = Offer {
    channel: 0,
    message: None,
};

impl EmulatedReceiver {
    fn free_count(&self) -> usize {
        self.settings.capacity_count - self.held.len() + self.free.len()
    }

    fn counts(&self) -> LinkCounts {
        self.link_counts(0).unwrap()
    }
}

fn take(receiver: &mut impl DatagramReceiver, now: Instant) -> Option<(u8, Received)> {
    let mut buffer = [0; 16];
    let arrival = receiver.receive(now, &mut buffer).unwrap()?;
    Some((buffer[0], arrival))
}

#[test]
fn a_caller_that_was_held_up_does_not_make_a_datagram_early() {
    let (mut sender, inner) = queue_pair();
    let link = LinkSpec::fixed(Duration::from_millis(50), 0.0)
        .build(&LinkPlace::alone(1, "late caller"))
        .unwrap();
    let settings = EmulatedSettings {
        clock: Some(|| Instant::from_ns(8_000_000)),
        ..EmulatedSettings::default()
    };
    let mut receiver =
        EmulatedReceiver::new(Box::new(inner), Box::new(link), |_| Some(ANY), 0, settings);
    sender.send(b"x").unwrap();
    let mut buffer = [0; 8];
    assert!(
        receiver
            .receive(Instant::ZERO, &mut buffer)
            .unwrap()
            .is_none()
    );
    assert_eq!(receiver.next_due(), Some(Instant::from_ns(58_000_000)));
}

#[test]
fn datagrams_come_when_due_in_due_order_and_say_how_long_they_were_held() {
    let (mut sender, mut receiver) = emulated(Listed(vec![30, -1, 10, 10]), 8);
    for byte in 0..4 {
        sender.send(&[byte]).unwrap();
    }
    let start = Instant::from_ns(5 * MS);
    assert_eq!(take(&mut receiver, start), None);
    assert_eq!(receiver.next_due(), Some(Instant::from_ns(15 * MS)));
    assert_eq!(take(&mut receiver, Instant::from_ns(15 * MS - 1)), None);
    let now = Instant::from_ns(40 * MS);
    let order: Vec<_> = core::iter::from_fn(|| take(&mut receiver, now)).collect();
    assert_eq!(
        order.iter().map(|(byte, _)| *byte).collect::<Vec<_>>(),
        [2, 3, 0]
    );
    let delay = order[2].1.emulated.unwrap();
    assert_eq!(
        (delay.arrived, delay.due),
        (start, Instant::from_ns(35 * MS))
    );
    assert_eq!(receiver.counts().lost_count, 1);
    assert_eq!((receiver.next_due(), receiver.held_count()), (None, 0));
}

#[test]
fn a_full_link_drops_and_counts_and_recovers() {
    let (mut sender, mut receiver) = emulated(Listed(vec![10; 8]), 2);
    for byte in 0..5 {
        sender.send(&[byte]).unwrap();
        assert_eq!(take(&mut receiver, Instant::ZERO), None);
    }
    assert_eq!(receiver.counts().overflow_count, 3);
    let due = Instant::from_ns(10 * MS);
    assert_eq!(take(&mut receiver, due).unwrap().0, 0);
    assert_eq!(take(&mut receiver, due).unwrap().0, 1);
    sender.send(&[9]).unwrap();
    assert_eq!(take(&mut receiver, due), None);
    assert_eq!(take(&mut receiver, Instant::from_ns(20 * MS)).unwrap().0, 9);
}

/// Delivers every datagram after 10 ms and once more after 25 ms.
#[derive(Debug)]
struct Twice;

impl LinkModel for Twice {
    fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
        Fate::Duplicated {
            first: now + Duration::from_millis(10),
            second: now + Duration::from_millis(25),
        }
    }
}

#[test]
fn a_copy_comes_when_it_is_due_with_the_bytes_and_the_arrival_of_the_original() {
    let (mut sender, mut receiver) = emulated(Twice, 8);
    sender.send(b"ab").unwrap();
    assert_eq!(take(&mut receiver, Instant::ZERO), None);
    // What comes in between must not overwrite the copy.
    sender.send(b"cd").unwrap();
    let mut seen = Vec::new();
    for ms in 1..=40 {
        let mut buffer = [0; 16];
        let now = Instant::from_ns(ms * MS);
        while let Some(received) = receiver.receive(now, &mut buffer).unwrap() {
            let delay = received.emulated.unwrap();
            assert_eq!((received.length_bytes, delay.due), (2, now));
            seen.push((buffer[..2].to_vec(), delay.arrived.as_ns() / MS, ms));
        }
    }
    let expected = [("ab", 0, 10), ("cd", 1, 11), ("ab", 0, 25), ("cd", 1, 26)];
    let expected = expected.map(|(text, arrived, due)| (text.into(), arrived, due));
    assert_eq!(seen, expected);
    assert_eq!((receiver.held_count(), receiver.free_count()), (0, 8));
    assert_eq!(receiver.counts().overflow_count, 0);
}

#[test]
fn copies_that_find_no_room_are_counted_and_the_receiver_stays_bounded() {
    let (mut sender, mut receiver) = emulated(Twice, 3);
    for byte in 0..4 {
        sender.send(&[byte]).unwrap();
        assert_eq!(take(&mut receiver, Instant::ZERO), None);
        assert!(receiver.held_count() <= 3);
    }
    // Two places for the first, one for the second: its copy, and both of the others, drop.
    assert_eq!(receiver.counts().overflow_count, 5);
    assert_eq!(
        receiver.no_room_count(),
        2,
        "a copy is no datagram that was sent"
    );
    let at = |ms| Instant::from_ns(ms * MS);
    assert_eq!(take(&mut receiver, at(10)).unwrap().0, 0);
    assert_eq!(take(&mut receiver, at(10)).unwrap().0, 1);
    assert_eq!(take(&mut receiver, at(24)), None);
    assert_eq!(take(&mut receiver, at(25)).unwrap().0, 0);
    assert_eq!((receiver.held_count(), receiver.free_count()), (0, 3));
    // And it is as good as new.
    sender.send(b"9").unwrap();
    assert_eq!(take(&mut receiver, at(30)), None);
    assert_eq!(take(&mut receiver, at(40)).unwrap().0, b'9');
    assert_eq!(take(&mut receiver, at(55)).unwrap().0, b'9');
}

#[test]
fn a_hundred_thousand_random_fates_leave_nothing_behind() {
    #[derive(Debug)]
    struct Random(RandomStream);
    impl LinkModel for Random {
        fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
            let mut later = |at: Instant| at + Duration::from_nanos(self.0.next_u64() % 5_000);
            let first = later(now);
            let second = later(first);
            match self.0.next_u64() % 3 {
                0 => Fate::Lost,
                1 => Fate::Delivered(first),
                _ => Fate::Duplicated { first, second },
            }
        }
    }
    let stream = RandomStream::new(17, "random fates");
    let (mut sender, mut receiver) = emulated(Random(stream), 5);
    let mut newest_due = Instant::ZERO;
    let mut taken_count = 0;
    for step in 0..100_000_i64 {
        let now = Instant::from_ns(step * 1_000);
        sender.send(b"message").unwrap();
        while let Some((_, arrival)) = take(&mut receiver, now) {
            let delay = arrival.emulated.unwrap();
            assert!(delay.due <= now && delay.arrived <= delay.due);
            newest_due = newest_due.max(delay.due);
            taken_count += 1;
        }
        assert_eq!(receiver.held_count() + receiver.free_count(), 5);
        assert!(receiver.next_due().is_none_or(|due| due > now));
    }
    let end = Instant::from_ns(i64::MAX);
    taken_count += core::iter::from_fn(|| take(&mut receiver, end)).count() as u64;
    let counters = receiver.counters();
    assert_eq!((receiver.held_count(), receiver.free_count()), (0, 5));
    assert_eq!(counters.received_count, taken_count);
    assert!(receiver.counts().overflow_count > 1_000);
}

#[test]
fn exempt_datagrams_pass_at_once_and_change_no_fate() {
    let (mut sender, mut receiver) = emulated(Listed(vec![10, -1]), 8);
    sender.send(b"1").unwrap();
    sender.send(b"hello").unwrap();
    sender.send(b"2").unwrap();
    let (byte, arrival) = take(&mut receiver, Instant::ZERO).unwrap();
    assert_eq!((byte, arrival.emulated), (b'h', None));
    assert_eq!(
        take(&mut receiver, Instant::from_ns(10 * MS)).unwrap().0,
        b'1'
    );
    assert_eq!(receiver.counts().lost_count, 1);
}

#[test]
fn equal_seeds_lose_the_same_datagrams() {
    let survivors = |seed| {
        let link = LinkSpec::fixed(Duration::from_millis(3), 0.3)
            .build(&LinkPlace::alone(seed, "link"))
            .unwrap();
        let (mut sender, mut receiver) = emulated(link, 8);
        let mut seen = Vec::new();
        for byte in 0..200 {
            sender.send(&[byte]).unwrap();
            let now = Instant::from_ns(i64::from(byte) * MS);
            seen.extend(take(&mut receiver, now).map(|(byte, _)| byte));
        }
        seen
    };
    assert_eq!(survivors(4), survivors(4));
    assert_ne!(survivors(4), survivors(5));
    assert!((100..180).contains(&survivors(4).len()));
}

#[test]
fn a_clock_that_goes_back_does_not_reach_the_model() {
    #[derive(Debug)]
    struct Strict(Instant);
    impl LinkModel for Strict {
        fn offer(&mut self, now: Instant, _length_bytes: usize) -> Fate {
            assert!(now >= self.0, "offers come in order");
            self.0 = now;
            Fate::Delivered(now)
        }
    }
    let (mut sender, mut receiver) = emulated(Strict(Instant::ZERO), 8);
    for now in [7, 3, 9] {
        sender.send(&[now]).unwrap();
        take(&mut receiver, Instant::from_ns(i64::from(now)));
    }
    // The second came in at 7, so at 3 it was not due yet.
    assert_eq!(receiver.counters().received_count, 2);
    assert_eq!(receiver.held_count(), 1);
}

#[test]
fn each_channel_meets_its_own_model_and_has_its_own_counts() {
    #[derive(Debug)]
    struct ByChannel(Vec<Listed>);
    impl FlowLinks for ByChannel {
        fn offer(&mut self, now: Instant, length_bytes: usize, offer: Offer) -> Option<Fate> {
            let link = self.0.get_mut(usize::from(offer.channel))?;
            Some(LinkModel::offer(link, now, length_bytes))
        }
        fn attend(&mut self, _now: Instant) {}
        fn loss_causes(&self, channel: u16) -> Option<LossCauses> {
            let chance_count = u64::from(channel);
            Some(LossCauses {
                chance_count,
                ..LossCauses::default()
            })
        }
    }
    let links = ByChannel(vec![Listed(vec![-1, 30, -1]), Listed(vec![10, -1])]);
    let (mut sender, inner) = queue_pair();
    let offer_of = |datagram: &[u8]| {
        let channel = u16::from(datagram[0]);
        Some(Offer {
            channel,
            message: None,
        })
    };
    let settings = EmulatedSettings::default();
    let mut receiver =
        EmulatedReceiver::new(Box::new(inner), Box::new(links), offer_of, 2, settings);
    for channel in [0, 1, 0, 2, 1, 0] {
        sender.send(&[channel]).unwrap();
    }
    // A channel without a model passes at once.
    let (byte, arrival) = take(&mut receiver, Instant::ZERO).unwrap();
    assert_eq!((byte, arrival.emulated), (2, None));
    assert_eq!(take(&mut receiver, Instant::from_ns(10 * MS)).unwrap().0, 1);
    assert_eq!(take(&mut receiver, Instant::from_ns(30 * MS)).unwrap().0, 0);
    let counts = [0, 1, 2].map(|channel| receiver.link_counts(channel).unwrap());
    assert_eq!(counts.map(|one| one.lost_count), [2, 1, 0]);
    let causes = counts.map(|one| one.causes.unwrap().chance_count);
    assert_eq!(causes, [0, 1, 2]);
    assert_eq!(receiver.link_counts(3), None);
}
