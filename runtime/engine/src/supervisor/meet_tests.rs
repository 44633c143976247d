//! Two ends of a meeting on loopback: who meets, and who is told why not.

use super::*;
use crate::supervisor::frame::{CHUNK_BYTES, Frame, write_chunk, write_message};
use crate::supervisor::peer::PeerEvent;
use std::net::{Ipv4Addr, Shutdown, TcpListener};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// How long a host that was met may be away.
const PEER_TIMEOUT: Duration = Duration::from_secs(5);
/// How long anything that must come is waited for.
const LIMIT: Duration = Duration::from_mins(1);
/// How often what a machine that stood still may spoil is tried.
const TRIES: u32 = 3;

/// A machine that stands still for seconds looks like a cut or a peer without progress; a fault looks so every time.
fn at_least_once(mut attempt: impl FnMut() -> Result<(), String>) {
    let reasons: Vec<String> = (0..TRIES).map_while(|_| attempt().err()).collect();
    println!("{reasons:?}");
    assert!(reasons.len() < TRIES as usize, "{reasons:?}");
}

fn hello(host: &str, hash: u64, domain: u8) -> PeerHello {
    PeerHello {
        version: "1".to_owned(),
        topology_hash: hash,
        host: host.to_owned(),
        clock_id: 1,
        domain: [domain; 16],
        has_fast_aes: true,
        resumed: None,
    }
}

fn pair(left: &PeerHello, right: &PeerHello) -> [Result<Vec<Peer>, PeerError>; 2] {
    pair_with(left, None, right, None, LIMIT)
}

fn pair_with(
    left: &PeerHello,
    left_key: Option<PreSharedKey>,
    right: &PeerHello,
    right_key: Option<PreSharedKey>,
    timeout: Duration,
) -> [Result<Vec<Peer>, PeerError>; 2] {
    let probe = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = probe.local_addr().unwrap();
    drop(probe);
    let meeting = |is_here, other: &PeerHello, key| Meeting {
        address,
        is_here,
        own: address.ip(),
        expected: vec![(other.host.clone(), address.ip())],
        timeout,
        peer_timeout: PEER_TIMEOUT,
        key,
    };
    let there = meeting(false, left, right_key);
    let here = meeting(true, right, left_key);
    let right = right.clone();
    let joining = thread::spawn(move || meet(&there, &right, &mut |_| true));
    let hosting = meet(&here, left, &mut |_| true);
    [hosting, joining.join().unwrap()].map(|end| end.map(|met| met.peers))
}

#[test]
fn two_hosts_meet_and_talk() {
    let [left, right] = pair(&hello("a", 1, 1), &hello("b", 1, 2));
    let (mut left, mut right) = (left.unwrap(), right.unwrap());
    assert_eq!(left[0].hello.host, "b");
    left[0].say(&PeerMessage::Ready);
    let event = right[0].receive(LIMIT);
    assert!(matches!(
        event,
        Some(PeerEvent::Frame(Frame::Message(PeerMessage::Ready)))
    ));
    drop(left);
    let event = right[0].receive(LIMIT);
    assert!(matches!(event, Some(PeerEvent::Closed(_))));
}

fn key(name: &str) -> PreSharedKey {
    let file = format!("hil-meet-{name}-{}.key", std::process::id());
    let path = std::env::temp_dir().join(file);
    let key = PreSharedKey::create(&path).unwrap();
    std::fs::remove_file(path).unwrap();
    key
}

#[test]
fn with_one_key_two_hosts_meet_and_with_two_or_one_alone_both_say_why_in_the_end() {
    let (a, b) = (hello("a", 1, 1), hello("b", 1, 2));
    let (one, other) = (key("one"), key("other"));
    let [left, right] = pair_with(&a, Some(one.clone()), &b, Some(one.clone()), LIMIT);
    let (mut left, mut right) = (left.unwrap(), right.unwrap());
    left[0].say(&PeerMessage::Ready);
    let event = right[0].receive(LIMIT);
    assert!(matches!(
        event,
        Some(PeerEvent::Frame(Frame::Message(PeerMessage::Ready)))
    ));
    for (ours, theirs, word) in [
        (Some(one.clone()), Some(other), "another key"),
        (Some(one.clone()), None, "key"),
        (None, Some(one), "plain"),
    ] {
        let timeout = Duration::from_secs(2);
        for outcome in pair_with(&a, ours.clone(), &b, theirs.clone(), timeout) {
            // Neither has proven anything to the other: both wait for the right one to the end.
            let error = outcome.map(|_| ()).unwrap_err();
            assert!(matches!(error, PeerError::Absent { .. }), "{error}");
            let text = error.to_string();
            assert!(
                text.contains(word) && text.contains("(127.0.0.1)"),
                "{text}"
            );
        }
    }
}

/// A refusal of nine made-up bytes, and one by somebody who holds another key, before the right host is there.
#[test]
fn refusals_without_proof_of_the_key_are_counted_and_the_right_host_is_met_after_them() {
    let probe = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = probe.local_addr().unwrap();
    let (one, other) = (key("refused-one"), key("refused-other"));
    let meeting = |is_here, host: &str, key: &PreSharedKey| Meeting {
        address,
        is_here,
        own: address.ip(),
        expected: vec![(host.to_owned(), address.ip())],
        timeout: Duration::from_secs(20),
        peer_timeout: PEER_TIMEOUT,
        key: Some(key.clone()),
    };
    let there = meeting(false, "a", &one);
    let joining = thread::spawn(move || meet(&there, &hello("b", 1, 2), &mut |_| true));
    for code in [1, 2, 3] {
        let (mut stranger, _) = probe.accept().unwrap();
        let refusal = [b'H', b'I', b'L', b'K', 1, 3, 1, 0, code];
        io::Write::write_all(&mut stranger, &refusal).unwrap();
    }
    drop(probe);
    let wrong = Meeting {
        timeout: Duration::from_secs(1),
        ..meeting(true, "b", &other)
    };
    let error = meet(&wrong, &hello("a", 1, 1), &mut |_| true).unwrap_err();
    assert!(matches!(error, PeerError::Absent { .. }), "{error}");
    let hosting = meet(&meeting(true, "b", &one), &hello("a", 1, 1), &mut |_| true);
    assert_eq!(hosting.unwrap().peers.len(), 1);
    let strangers = joining.join().unwrap().unwrap().strangers.unwrap();
    for words in ["another key", "plain", "without a greeting"] {
        assert!(strangers.contains(words), "{strangers}");
    }
}

/// The other end hears under the key that it is not awaited, so it may believe it.
#[test]
fn a_host_of_another_name_is_told_at_once_under_the_key() {
    let probe = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = probe.local_addr().unwrap();
    drop(probe);
    let key = key("misnamed");
    let meeting = |is_here, host: &str, seconds| Meeting {
        address,
        is_here,
        own: address.ip(),
        expected: vec![(host.to_owned(), address.ip())],
        timeout: Duration::from_secs(seconds),
        peer_timeout: PEER_TIMEOUT,
        key: Some(key.clone()),
    };
    let there = meeting(false, "a", 20);
    let joining = thread::spawn(move || meet(&there, &hello("c", 1, 2), &mut |_| true));
    let hosting = meet(&meeting(true, "b", 2), &hello("a", 1, 1), &mut |_| true);
    let error = joining.join().unwrap().unwrap_err();
    assert!(matches!(error, PeerError::Mismatch { .. }), "{error}");
    let error = hosting.unwrap_err();
    assert!(
        error.to_string().contains("not awaited at its address"),
        "{error}"
    );
}

#[test]
fn another_topology_is_refused_on_both_hosts() {
    let [left, right] = pair(&hello("a", 1, 1), &hello("b", 2, 2));
    for outcome in [left, right] {
        let error = outcome.map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("topology"), "{error}");
    }
}

#[test]
fn another_version_is_refused_on_both_hosts_with_both_versions() {
    let mut newer = hello("b", 1, 2);
    newer.version = "2".to_owned();
    for outcome in pair(&hello("a", 1, 1), &newer) {
        let error = outcome.map(|_| ()).unwrap_err().to_string();
        assert!(
            error.contains("1 on a") && error.contains("2 on b"),
            "{error}"
        );
    }
}

#[test]
fn one_domain_at_both_ends_is_refused() {
    let [left, _] = pair(&hello("a", 1, 7), &hello("b", 1, 7));
    assert!(
        left.map(|_| ())
            .unwrap_err()
            .to_string()
            .contains("bypass the network")
    );
}

#[test]
fn nobody_there_is_said_with_the_name_and_the_address() {
    let meeting = Meeting {
        address: SocketAddr::from((Ipv4Addr::LOCALHOST, 1)),
        is_here: false,
        own: Ipv4Addr::LOCALHOST.into(),
        expected: vec![("robot-pc".to_owned(), Ipv4Addr::LOCALHOST.into())],
        timeout: Duration::from_millis(1),
        peer_timeout: PEER_TIMEOUT,
        key: None,
    };
    let error = meet(&meeting, &hello("a", 1, 1), &mut |_| true)
        .map(|_| ())
        .unwrap_err();
    assert!(
        error.to_string().starts_with("robot-pc did not appear"),
        "{error}"
    );
}

#[test]
fn connections_that_say_nothing_keep_a_host_neither_from_its_deadline_nor_from_its_signals() {
    let probe = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = probe.local_addr().unwrap();
    drop(probe);
    let meeting = Meeting {
        address,
        is_here: true,
        own: address.ip(),
        expected: vec![("b".to_owned(), address.ip())],
        timeout: Duration::from_secs(1),
        peer_timeout: PEER_TIMEOUT,
        key: Some(key("knocked")),
    };
    let is_over = AtomicBool::new(false);
    let (mut told_count, mut tried_count) = (0, 0);
    let outcome = thread::scope(|scope| {
        let knocking = scope.spawn(|| {
            let mut open = std::collections::VecDeque::new();
            while !is_over.load(Ordering::Acquire) {
                open.extend(TcpStream::connect_timeout(&address, RETRY_PERIOD));
                tried_count += 1;
                if open.len() > 100 {
                    open.pop_front();
                }
            }
        });
        let outcome = meet(&meeting, &hello("a", 1, 1), &mut |_| {
            told_count += 1;
            true
        });
        is_over.store(true, Ordering::Release);
        knocking.join().unwrap();
        outcome
    });
    let error = outcome.map(|_| ()).unwrap_err();
    assert!(matches!(error, PeerError::Absent { .. }), "{error}");
    assert!(
        told_count > 1 && tried_count > 1,
        "{told_count} {tried_count}"
    );
}

/// Passes connections on to `to`, and cuts those it has.
struct Cable {
    address: SocketAddr,
    ends: Arc<Mutex<Vec<TcpStream>>>,
    is_away: Arc<AtomicBool>,
    is_stalled: Arc<AtomicBool>,
}

impl Cable {
    fn lay(to: SocketAddr) -> Self {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let cable = Self {
            address: listener.local_addr().unwrap(),
            ends: Arc::default(),
            is_away: Arc::default(),
            is_stalled: Arc::default(),
        };
        let (ends, is_away) = (Arc::clone(&cable.ends), Arc::clone(&cable.is_away));
        let is_stalled = Arc::clone(&cable.is_stalled);
        thread::spawn(move || {
            for near in listener.incoming() {
                let near = near.unwrap();
                if is_away.load(Ordering::Acquire) || is_stalled.load(Ordering::Acquire) {
                    continue;
                }
                let Ok(far) = TcpStream::connect(to) else {
                    continue;
                };
                for (from, into) in [(&near, &far), (&far, &near)] {
                    let (mut from, mut into) =
                        (from.try_clone().unwrap(), into.try_clone().unwrap());
                    let is_stalled = Arc::clone(&is_stalled);
                    thread::spawn(move || {
                        let mut bytes = vec![0; 1 << 16];
                        while let Ok(count @ 1..) = io::Read::read(&mut from, &mut bytes) {
                            // What was under way then is gone with the connection.
                            if is_stalled.load(Ordering::Acquire) {
                                wait_until("the end of a stall", || {
                                    !is_stalled.load(Ordering::Acquire)
                                });
                                break;
                            }
                            if io::Write::write_all(&mut into, &bytes[..count]).is_err() {
                                break;
                            }
                        }
                        let _gone = into.shutdown(Shutdown::Both).is_err();
                    });
                }
                ends.lock().unwrap().extend([near, far]);
            }
        });
        cable
    }

    /// One end notices at once, the other when it hears of it.
    fn cut(&self) {
        for end in self.ends.lock().unwrap().drain(..) {
            let _gone = end.shutdown(Shutdown::Both).is_err();
        }
    }

    /// Whether nothing comes through, without a word.
    fn stall(&self, is_stalled: bool) {
        self.is_stalled.store(is_stalled, Ordering::Release);
    }

    /// Cuts them, and passes no more on.
    fn take_away(&self) {
        self.is_away.store(true, Ordering::Release);
        self.cut();
    }
}

const CUT_COUNT: u64 = 5;
/// Frames that each end may send after each cut, and those of them that it takes before the next one.
const SENT_PER_CUT: u64 = 4_000;
const TAKEN_PER_CUT: u64 = 1_000;
const SENT_COUNT: u64 = (CUT_COUNT + 1) * SENT_PER_CUT;

fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let began = Instant::now();
    while !is_so() {
        assert!(began.elapsed() < LIMIT, "{what}");
        thread::sleep(Duration::from_millis(1));
    }
}

/// Sends numbered frames, as many as `allowed`, and takes the other end's, which it counts in `taken`.
fn talk(peer: &mut Peer, allowed: &AtomicU64, taken: &AtomicU64) {
    let numbered = |size_bytes| PeerMessage::File {
        name: "n".repeat(500),
        size_bytes,
    };
    let conversation = peer.conversation();
    conversation.expect_progress(LIMIT).unwrap();
    let writer = peer.writer();
    thread::scope(|scope| {
        scope.spawn(|| {
            for number in 0..SENT_COUNT {
                wait_until("the next cut", || number < allowed.load(Ordering::Acquire));
                write_message(writer, &numbered(number)).unwrap();
            }
        });
        for number in 0..SENT_COUNT {
            let frame = conversation.next_frame().unwrap();
            assert_eq!(frame, Frame::Message(numbered(number)));
            taken.store(number + 1, Ordering::Release);
        }
    });
}

/// Two hosts that met over a cable.
fn met_over_a_cable(name: &str) -> (Cable, [Peer; 2]) {
    let probe = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = probe.local_addr().unwrap();
    let cable = Cable::lay(address);
    // Until now, so that the cable's own end is at another port.
    drop(probe);
    let key = key(name);
    let meeting = |address, is_here, host: &str| Meeting {
        address,
        is_here,
        own: Ipv4Addr::LOCALHOST.into(),
        expected: vec![(host.to_owned(), Ipv4Addr::LOCALHOST.into())],
        timeout: Duration::from_secs(20),
        peer_timeout: PEER_TIMEOUT,
        key: Some(key.clone()),
    };
    let there = meeting(cable.address, false, "a");
    let here = meeting(address, true, "b");
    let joining = thread::spawn(move || meet(&there, &hello("b", 1, 2), &mut |_| true));
    let here = meet(&here, &hello("a", 1, 1), &mut |_| true).unwrap();
    let there = joining.join().unwrap().unwrap();
    let peers = [here, there].map(|met| met.peers.into_iter().next().unwrap());
    (cable, peers)
}

#[test]
fn a_connection_that_is_cut_goes_on_with_every_frame_once_and_in_order() {
    let (cable, mut ends) = met_over_a_cable("cut");
    let conversations = ends.each_ref().map(Peer::conversation);
    let allowed = AtomicU64::new(SENT_PER_CUT);
    let taken = [AtomicU64::new(0), AtomicU64::new(0)];
    thread::scope(|scope| {
        for (peer, taken) in ends.iter_mut().zip(&taken) {
            let allowed = &allowed;
            scope.spawn(move || talk(peer, allowed, taken));
        }
        for number in 1..=CUT_COUNT {
            let due = (number - 1) * SENT_PER_CUT + TAKEN_PER_CUT;
            wait_until("frames before a cut", || {
                taken.iter().all(|one| one.load(Ordering::Acquire) >= due)
            });
            cable.cut();
            for conversation in &conversations {
                let mut cuts = Vec::new();
                wait_until("the connection after a cut", || {
                    cuts = conversation.take_cuts();
                    !cuts.is_empty()
                });
                println!("{number}: {cuts:?}");
            }
            allowed.fetch_add(SENT_PER_CUT, Ordering::AcqRel);
        }
    });
}

/// Waits for the end of the conversation and its reason.
fn closed(peer: &mut Peer) -> String {
    loop {
        match peer.receive(LIMIT) {
            Some(PeerEvent::Closed(reason)) => return reason,
            Some(PeerEvent::Frame(_)) => {}
            None => panic!("no end"),
        }
    }
}

/// The other end takes nothing, so nothing is acknowledged.
#[test]
fn a_frame_that_finds_no_room_in_time_ends_the_conversation_at_both_ends() {
    let (_cable, [mut here, mut there]) = met_over_a_cable("full");
    let large = PeerMessage::Refused("n".repeat(100_000));
    let writer = here.writer();
    let refused = (0..1_000).find_map(|_| write_message(writer, &large).err());
    assert_eq!(refused.unwrap().kind(), io::ErrorKind::TimedOut);
    for peer in [&mut here, &mut there] {
        println!("{}", closed(peer));
    }
}

#[test]
fn an_end_that_leaves_is_not_waited_for_and_one_that_does_not_come_back_is() {
    let (_cable, [here, mut there]) = met_over_a_cable("left");
    drop(here);
    assert_eq!(closed(&mut there), "it closed the connection");

    let (cable, mut ends) = met_over_a_cable("gone");
    cable.take_away();
    for peer in &mut ends {
        let reason = closed(peer);
        assert!(reason.contains("no new one within 5 s"), "{reason}");
    }
}

/// A chunk as the exchange of records sends it.
fn chunk() -> Vec<u8> {
    vec![7; CHUNK_BYTES]
}

/// Longer than a silence that is taken for a cut, and more than what may be kept: an end that takes nothing for so long,
/// as behind a slow disk, is waited for, without a cut.
#[test]
fn an_end_that_takes_nothing_for_a_time_is_waited_for_while_the_other_has_much_to_say() {
    at_least_once(|| {
        let (_cable, [mut slow, mut other]) = met_over_a_cable("slow");
        let (taking, giving) = (slow.conversation(), other.conversation());
        for one in [&taking, &giving] {
            one.expect_progress(LIMIT).unwrap();
        }
        let chunk_count = 64;
        thread::scope(|scope| {
            let writer = other.writer();
            scope.spawn(move || {
                for _ in 0..chunk_count {
                    write_chunk(writer, &chunk()).unwrap();
                }
            });
            for number in 0..chunk_count {
                if number == 8 {
                    thread::sleep(Duration::from_secs(7));
                }
                assert_eq!(taking.next_frame(), Ok(Frame::Chunk(chunk())));
            }
            slow.say(&PeerMessage::Done);
            assert_eq!(giving.next_frame(), Ok(Frame::Message(PeerMessage::Done)));
        });
        let cuts = [taking, giving].map(|one| one.take_cuts()).concat();
        if cuts.is_empty() {
            Ok(())
        } else {
            Err(format!("{cuts:?}"))
        }
    });
}

/// One says nothing but that it lives, one takes nothing of what it is told.
#[test]
fn a_peer_without_progress_is_given_up_in_time_however_often_it_says_that_it_lives() {
    let (_cable, [here, mut there]) = met_over_a_cable("alive");
    let waiting = here.conversation();
    waiting.expect_progress(Duration::from_secs(2)).unwrap();
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::Acquire) {
                there.say(&PeerMessage::Alive);
                thread::sleep(Duration::from_millis(10));
            }
        });
        let reason = loop {
            match waiting.next_frame() {
                Ok(frame) => assert_eq!(frame, Frame::Message(PeerMessage::Alive)),
                Err(reason) => break reason,
            }
        };
        is_over.store(true, Ordering::Release);
        assert_eq!(reason, "no progress for 2 s");
    });

    let (_cable, [mut here, _there]) = met_over_a_cable("still");
    let sending = here.conversation();
    sending.expect_progress(Duration::from_secs(2)).unwrap();
    let writer = here.writer();
    let refused = (0..1_000).find_map(|_| write_chunk(writer, &chunk()).err());
    let refused = refused.unwrap();
    assert_eq!(refused.kind(), io::ErrorKind::TimedOut);
    assert_eq!(refused.to_string(), "no progress for 2 s");
}

/// A first host that still takes another one's records gives nothing to this one and takes nothing from it.
#[test]
fn a_peer_that_makes_progress_with_another_host_is_waited_for() {
    at_least_once(|| {
        let (_cable, [here, mut there]) = met_over_a_cable("third");
        let waiting = here.conversation();
        waiting.expect_progress(Duration::from_secs(2)).unwrap();
        let elsewhere = there.conversation();
        thread::scope(|scope| {
            scope.spawn(|| {
                for _ in 0..60 {
                    elsewhere.moved_count.fetch_add(1, Ordering::Relaxed);
                    thread::sleep(Duration::from_millis(50));
                }
                there.say(&PeerMessage::Done);
            });
            let frame = waiting.next_frame()?;
            assert_eq!(frame, Frame::Message(PeerMessage::Done));
            Ok(())
        })
    });
}

/// A path that drops everything without a word, no resets either, for longer than a silence that is taken for a cut.
#[test]
fn a_connection_that_falls_silent_is_made_again() {
    let (cable, mut ends) = met_over_a_cable("silent");
    for number in 1..=2 {
        cable.stall(true);
        let conversations = ends.each_ref().map(Peer::conversation);
        ends[0].say(&PeerMessage::Ready);
        thread::sleep(Duration::from_secs(4));
        cable.stall(false);
        for conversation in &conversations {
            let mut cuts = Vec::new();
            wait_until("the connection after a silence", || {
                cuts.extend(conversation.take_cuts());
                !cuts.is_empty()
            });
            println!("{number}: {cuts:?}");
        }
        let event = ends[1].receive(LIMIT);
        let ready = Frame::Message(PeerMessage::Ready);
        assert!(
            matches!(&event, Some(PeerEvent::Frame(frame)) if *frame == ready),
            "{event:?}"
        );
    }
}
