//! The handshake between two ends on loopback: who gets in, and what a stranger gets.

use std::net::{Ipv4Addr, Shutdown, TcpListener};
use std::path::PathBuf;
use std::thread;

use hil_core::random::RandomStream;

use super::*;

fn key(name: &str) -> PreSharedKey {
    let file = format!("hil-greeting-{name}-{}.key", std::process::id());
    let path: PathBuf = std::env::temp_dir().join(file);
    let key = PreSharedKey::create(&path).unwrap();
    std::fs::remove_file(path).unwrap();
    key
}

fn connected() -> [TcpStream; 2] {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let here = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    [here, listener.accept().unwrap().0]
}

fn timed(stream: TcpStream) -> TimedStream {
    TimedStream::new(stream, Instant::now() + Duration::from_secs(10))
}

/// Reads the first four bytes, as the listening end does before it knows what came.
fn answered(stream: TcpStream, key: &PreSharedKey) -> Result<(Secured, bool), GreetingError> {
    let mut stream = timed(stream);
    let mut magic = [0; 4];
    stream.read_exact(&mut magic)?;
    assert_eq!(magic, MAGIC);
    answer(stream, key, |theirs, ours| (theirs, ours) == ("b", "a"))
}

fn shake(
    ours: &PreSharedKey,
    theirs: &PreSharedKey,
    name: &'static str,
) -> (
    Result<(Secured, bool), GreetingError>,
    Result<Secured, GreetingError>,
) {
    let [here, there] = connected();
    let theirs = theirs.clone();
    let asking = thread::spawn(move || ask(timed(there), &theirs, name, "a"));
    let answered = answered(here, ours);
    (answered, asking.join().unwrap())
}

#[test]
fn with_one_key_both_ends_talk_and_the_wire_shows_nothing() {
    let key = key("one");
    let (here, there) = shake(&key, &key, "b");
    let ((mut here, is_awaited), there) = (here.unwrap(), there.unwrap());
    assert!(is_awaited);
    let mut writer = there.writer;
    let long: Vec<u8> = (0..100_000_u32)
        .map(|index| index.to_le_bytes()[0])
        .collect();
    let sent = long.clone();
    let sending = thread::spawn(move || {
        writer.write_all(&sent).unwrap();
        writer.flush().unwrap();
        writer
    });
    let mut read = vec![0; long.len()];
    here.reader.read_exact(&mut read).unwrap();
    assert_eq!(read, long);
    drop(sending.join().unwrap().stream().shutdown(Shutdown::Both));
    assert_eq!(here.reader.read(&mut read).unwrap(), 0, "an end is an end");
}

#[test]
fn another_key_is_told_to_both_ends_and_another_name_is_left_to_what_follows_under_the_key() {
    let (one, other) = (key("left"), key("right"));
    let (answered, asked) = shake(&one, &other, "b");
    for refused in [answered.map(|_| ()), asked.map(|_| ())] {
        assert!(
            matches!(refused, Err(GreetingError::Refused(Why::AnotherKey))),
            "{refused:?}"
        );
    }
    let (answered, asked) = shake(&one, &one, "c");
    assert!(!answered.unwrap().1 && asked.is_ok());
}

#[test]
fn a_stranger_gets_no_more_bytes_than_it_sent_whatever_it_says() {
    let key = key("flood");
    let mut random = RandomStream::new(5, "strangers");
    let recorded = {
        let [mut here, there] = connected();
        let asking = key.clone();
        let thread = thread::spawn(move || ask(timed(there), &asking, "b", "a").is_err());
        let mut first = vec![0; 8 + 32 + NAMES_BYTES_MIN + 16];
        here.read_exact(&mut first).unwrap();
        drop(here);
        assert!(thread.join().unwrap());
        first
    };
    for round in 0..300 {
        let mut said = recorded.clone();
        if round > 0 {
            let after_magic = said.len() as u64 - 4;
            let at = 4 + usize::try_from(random.next_u64() % after_magic).unwrap();
            said[at] ^= 1 << (round % 8);
        }
        let [here, mut there] = connected();
        there.write_all(&said).unwrap();
        there.shutdown(Shutdown::Write).unwrap();
        let outcome = answered(here, &key);
        // Played back whole, it gets the second message and must then seal with keys it lacks.
        let is_stuck =
            outcome.is_ok_and(|(mut one, _)| one.reader.read(&mut [0]).unwrap_or(0) == 0);
        assert_eq!(is_stuck, round == 0);
        let mut heard = Vec::new();
        let _reset = there.read_to_end(&mut heard).is_err();
        assert!(
            heard.len() < said.len(),
            "{} for {}",
            heard.len(),
            said.len()
        );
    }
}

#[test]
fn a_forged_record_ends_the_connection() {
    let key = key("forged");
    let (here, there) = shake(&key, &key, "b");
    let ((mut here, _), there) = (here.unwrap(), there.unwrap());
    let mut raw = there.writer.stream();
    raw.write_all(&[20, 0]).unwrap();
    raw.write_all(&[7; 20]).unwrap();
    let error = here.reader.read(&mut [0; 8]).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::InvalidData);
}

#[test]
fn bytes_that_drip_do_not_outlast_the_deadline() {
    let [here, mut there] = connected();
    let dripping = thread::spawn(move || {
        for byte in MAGIC.iter().chain(&[1, 1, 200, 0]).cycle().take(60) {
            if there.write_all(&[*byte]).is_err() {
                return;
            }
            thread::sleep(Duration::from_millis(20));
        }
    });
    let mut stream = TimedStream::new(here, Instant::now() + Duration::from_millis(200));
    let mut magic = [0; 4];
    stream.read_exact(&mut magic).unwrap();
    let outcome = answer(stream, &key("drip"), |_, _| true).map(|_| ());
    assert!(
        matches!(outcome, Err(GreetingError::Connection(_))),
        "{outcome:?}"
    );
    dripping.join().unwrap();
}
