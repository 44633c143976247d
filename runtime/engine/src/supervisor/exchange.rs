//! After a run, every host gets the records of all hosts, so that each report is complete: the
//! others send theirs to the first host of the topology, and it sends everybody the rest. It
//! computes nothing from them.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread::{self, ScopedJoinHandle};
use std::time::{Duration, Instant};

use super::frame::{
    CHUNK_BYTES, Frame, PeerMessage, REPORT_BYTES_MAX, is_plain_record_name, write_chunk,
    write_message,
};
use super::peer::{Peer, PeerEvent};
use hil_rundir::event::HostHistory;

/// A peer that says nothing for this long while records are due has failed to deliver them.
const PATIENCE: Duration = Duration::from_secs(20);
/// How often the first host says that it is still there while it receives.
const ALIVE_PERIOD: Duration = Duration::from_secs(1);

/// What came from one peer, or from all of them.
#[derive(Debug, Default)]
pub(crate) struct Received {
    pub(crate) stories: Vec<HostHistory>,
    /// Why records of a host are missing or incomplete.
    pub(crate) problems: Vec<String>,
    names: BTreeSet<String>,
}

/// Sends this host's records and story, and receives those of the others into `records`.
pub(crate) fn exchange(
    peers: &mut [Peer],
    is_first_host: bool,
    records: &Path,
    story: &HostHistory,
) -> Received {
    let mut all = Received::default();
    let own = record_files(records).unwrap_or_else(|error| {
        all.problems
            .push(format!("cannot list own records: {error}"));
        Vec::new()
    });
    for peer in peers.iter_mut() {
        if let Err(error) = peer.allow_writes_to_take(PATIENCE) {
            all.problems.push(format!("{}: {error}", peer.hello.host));
        }
    }
    if is_first_host {
        let received = collect(peers, records);
        distribute(peers, &own, story, &received, records, &mut all);
        for one in received {
            all.stories.extend(one.stories);
            all.problems.extend(one.problems);
        }
    } else {
        for peer in peers.iter_mut() {
            give_and_take(peer, &own, story, records, &mut all);
        }
    }
    all
}

/// Receives from all peers at once, and says meanwhile that this host is still there.
fn collect(peers: &mut [Peer], records: &Path) -> Vec<Received> {
    thread::scope(|scope| {
        let mut writers = Vec::new();
        let mut receiving = Vec::new();
        for peer in peers {
            let host = peer.hello.host.clone();
            let (writer, inbox) = peer.halves();
            writers.push(writer);
            let take = move || take_from(&host, inbox, records);
            receiving.push(scope.spawn(take));
        }
        let mut said = Instant::now();
        while !receiving.iter().all(ScopedJoinHandle::is_finished) {
            if said.elapsed() >= ALIVE_PERIOD {
                said = Instant::now();
                for writer in &mut writers {
                    // A peer that left is noticed by the thread that receives from it.
                    let _left = write_message(*writer, &PeerMessage::Alive).is_err();
                }
            }
            thread::sleep(Duration::from_millis(2));
        }
        receiving.into_iter().map(join_receiving).collect()
    })
}

/// Sends every peer what it does not have yet, all at once.
fn distribute(
    peers: &mut [Peer],
    own: &[PathBuf],
    own_history: &HostHistory,
    received: &[Received],
    records: &Path,
    all: &mut Received,
) {
    let sent = thread::scope(|scope| {
        let mut sending = Vec::new();
        for (index, peer) in peers.iter_mut().enumerate() {
            let others = received
                .iter()
                .enumerate()
                .filter(|(other, _)| *other != index);
            let mut files = own.to_vec();
            let mut stories = vec![own_history.clone()];
            for (_, other) in others {
                files.extend(other.names.iter().map(|name| records.join(name)));
                stories.extend(other.stories.iter().cloned());
            }
            let host = peer.hello.host.clone();
            let (writer, _) = peer.halves();
            let give = move || give_all(writer, &files, &stories);
            sending.push((host, scope.spawn(give)));
        }
        sending
            .into_iter()
            .map(|(host, one)| (host, join_sending(one)))
            .collect::<Vec<_>>()
    });
    for (host, outcome) in sent {
        note_unsent(&host, outcome, all);
    }
}

/// Sends in a thread of its own: two ends that only send would wait for each other for ever.
fn give_and_take(
    peer: &mut Peer,
    own: &[PathBuf],
    own_history: &HostHistory,
    records: &Path,
    all: &mut Received,
) {
    let host = peer.hello.host.clone();
    let (writer, inbox) = peer.halves();
    let (received, sent) = thread::scope(|scope| {
        let sending = scope.spawn(|| give_all(writer, own, std::slice::from_ref(own_history)));
        let received = take_from(&host, inbox, records);
        (received, join_sending(sending))
    });
    all.stories.extend(received.stories);
    all.problems.extend(received.problems);
    note_unsent(&host, sent, all);
}

fn join_receiving(thread: ScopedJoinHandle<'_, Received>) -> Received {
    thread.join().unwrap_or_else(|_panic| Received {
        problems: vec!["a receiving thread panicked".to_owned()],
        ..Received::default()
    })
}

fn join_sending(thread: ScopedJoinHandle<'_, io::Result<()>>) -> io::Result<()> {
    let panicked = |_panic| Err(io::Error::other("the sending thread panicked"));
    thread.join().unwrap_or_else(panicked)
}

fn note_unsent(host: &str, sent: io::Result<()>, all: &mut Received) {
    if let Err(error) = sent {
        all.problems
            .push(format!("records could not be sent to {host}: {error}"));
    }
}

fn record_files(records: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files: Vec<PathBuf> = fs::read_dir(records)?
        .map(|entry| Ok(entry?.path()))
        .collect::<io::Result<_>>()?;
    files.sort();
    Ok(files)
}

/// Gives one report, and how long all so far are.
fn give_report(out: &mut impl Write, story: &HostHistory, before_bytes: u64) -> io::Result<u64> {
    let body = serde_json::to_vec(story)?;
    let size_bytes = body.len() as u64;
    let whole_bytes = before_bytes.saturating_add(size_bytes);
    check_reports(whole_bytes)?;
    write_message(out, &PeerMessage::Report { size_bytes })?;
    for chunk in body.chunks(CHUNK_BYTES) {
        write_chunk(out, chunk)?;
    }
    Ok(whole_bytes)
}

fn check_reports(whole_bytes: u64) -> io::Result<()> {
    if whole_bytes <= REPORT_BYTES_MAX {
        return Ok(());
    }
    let text = format!("reports of {whole_bytes} bytes, {REPORT_BYTES_MAX} is most");
    Err(invalid(text))
}

fn invalid(text: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, text)
}

fn give_all(out: &mut impl Write, files: &[PathBuf], stories: &[HostHistory]) -> io::Result<()> {
    let mut report_bytes = 0;
    for story in stories {
        report_bytes = give_report(out, story, report_bytes)?;
    }
    for path in files {
        let Some(name) = path.file_name().and_then(|name| name.to_str()) else {
            continue;
        };
        let mut file = File::open(path)?;
        let size_bytes = file.metadata()?.len();
        write_message(
            out,
            &PeerMessage::File {
                name: name.to_owned(),
                size_bytes,
            },
        )?;
        let mut left = size_bytes;
        let mut chunk = vec![0; CHUNK_BYTES];
        while left > 0 {
            let length = chunk.len().min(usize::try_from(left).unwrap_or(usize::MAX));
            file.read_exact(&mut chunk[..length])?;
            write_chunk(out, &chunk[..length])?;
            left -= length as u64;
        }
    }
    write_message(out, &PeerMessage::Done)
}

/// What is on its way in, and how many bytes of it are still to come.
struct Incoming {
    body: Body,
    left: u64,
    /// Of all reports so far.
    report_bytes: u64,
}

enum Body {
    Nothing,
    File(File),
    Report(Vec<u8>),
}

impl Incoming {
    /// What was announced before came in full.
    fn check_whole(&self) -> io::Result<()> {
        if self.left == 0 {
            return Ok(());
        }
        Err(invalid(format!("{} bytes did not come", self.left)))
    }
}

fn take_from(host: &str, inbox: &mut Receiver<PeerEvent>, records: &Path) -> Received {
    let mut received = Received::default();
    let mut incoming = Incoming {
        body: Body::Nothing,
        left: 0,
        report_bytes: 0,
    };
    let problem = loop {
        let frame = match inbox.recv_timeout(PATIENCE) {
            Ok(PeerEvent::Frame(frame)) => frame,
            Ok(PeerEvent::Closed(reason)) => break reason,
            Err(RecvTimeoutError::Disconnected) => break "connection closed".to_owned(),
            Err(RecvTimeoutError::Timeout) => {
                break format!("silent for {} s", PATIENCE.as_secs());
            }
        };
        match take_frame(frame, records, &mut incoming, &mut received) {
            Ok(true) => return received,
            Ok(false) => {}
            Err(error) => break error.to_string(),
        }
    };
    let text = format!("records of {host} are incomplete: {problem}");
    received.problems.push(text);
    received
}

/// Deals with one frame; true when it was the last.
fn take_frame(
    frame: Frame,
    records: &Path,
    incoming: &mut Incoming,
    received: &mut Received,
) -> io::Result<bool> {
    match frame {
        Frame::Message(PeerMessage::Done) => {
            incoming.check_whole()?;
            if received.stories.is_empty() {
                return Err(invalid("no report came".to_owned()));
            }
            return Ok(true);
        }
        Frame::Message(PeerMessage::Report { size_bytes }) => {
            incoming.check_whole()?;
            incoming.report_bytes = incoming.report_bytes.saturating_add(size_bytes);
            check_reports(incoming.report_bytes)?;
            if size_bytes == 0 {
                return Err(invalid("an empty report".to_owned()));
            }
            incoming.body = Body::Report(Vec::new());
            incoming.left = size_bytes;
        }
        Frame::Message(PeerMessage::File { name, size_bytes }) => {
            incoming.check_whole()?;
            if !is_plain_record_name(&name) {
                return Err(invalid(format!(
                    "file name {name:?} is not a record file's"
                )));
            }
            incoming.body = Body::File(File::create_new(records.join(&name))?);
            incoming.left = size_bytes;
            received.names.insert(name);
        }
        Frame::Chunk(bytes) => {
            let length = bytes.len() as u64;
            if length > incoming.left {
                return Err(invalid(format!(
                    "{length} bytes came, {} were due",
                    incoming.left
                )));
            }
            incoming.left -= length;
            match &mut incoming.body {
                Body::Nothing => {}
                Body::File(file) => file.write_all(&bytes)?,
                Body::Report(body) => {
                    body.extend_from_slice(&bytes);
                    if incoming.left == 0 {
                        received.stories.push(serde_json::from_slice(body)?);
                        incoming.body = Body::Nothing;
                    }
                }
            }
        }
        // Left over from the run itself.
        Frame::Message(_) => {}
    }
    Ok(false)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::supervisor::frame::read_frame;
    use hil_core::time::Instant as At;
    use hil_rundir::event::{Event, EventKind};

    fn story(event_count: usize) -> HostHistory {
        let event = |index| Event {
            at: At::ZERO,
            host: "robot-pc".to_owned(),
            process: "p".repeat(96),
            kind: EventKind::Warning {
                text: format!("said: line {index}"),
            },
            interruption: None,
        };
        HostHistory {
            hosts: vec!["robot-pc".to_owned()],
            span: (At::ZERO, At::from_ns(1)),
            events: (0..event_count).map(event).collect(),
            discipline: None,
            processes: Vec::new(),
            cards: Vec::new(),
        }
    }

    fn taken(wire: &[u8]) -> io::Result<Received> {
        let (mut input, mut received) = (wire, Received::default());
        let mut incoming = Incoming {
            body: Body::Nothing,
            left: 0,
            report_bytes: 0,
        };
        let nowhere = Path::new("/nonexistent");
        while !take_frame(
            read_frame(&mut input)?,
            nowhere,
            &mut incoming,
            &mut received,
        )? {}
        Ok(received)
    }

    #[test]
    fn reports_longer_than_a_frame_arrive_whole() {
        for event_count in [0, 1, 100_000] {
            let mut wire = Vec::new();
            give_all(&mut wire, &[], &[story(event_count), story(1)]).unwrap();
            let received = taken(&wire).unwrap();
            assert_eq!(received.stories, [story(event_count), story(1)]);
        }
    }

    #[test]
    fn what_is_too_long_cut_short_or_missing_is_refused() {
        let report = |size_bytes| PeerMessage::Report { size_bytes };
        let file = || PeerMessage::File {
            name: "a.rec".to_owned(),
            size_bytes: 1,
        };
        let cases: [(&[PeerMessage], &[u8], PeerMessage, &str); 6] = [
            (
                &[report(REPORT_BYTES_MAX + 1)],
                b"",
                PeerMessage::Done,
                "reports of 268435457 bytes",
            ),
            (&[report(0)], b"", PeerMessage::Done, "an empty report"),
            (&[], b"", PeerMessage::Done, "no report came"),
            (
                &[report(9)],
                b"{}",
                PeerMessage::Done,
                "7 bytes did not come",
            ),
            (&[report(9)], b"{}", file(), "7 bytes did not come"),
            (
                &[report(1)],
                b"{}",
                PeerMessage::Done,
                "2 bytes came, 1 were due",
            ),
        ];
        for (before, chunk, after, expected) in cases {
            let mut wire = Vec::new();
            for message in before {
                write_message(&mut wire, message).unwrap();
            }
            if !chunk.is_empty() {
                write_chunk(&mut wire, chunk).unwrap();
            }
            write_message(&mut wire, &after).unwrap();
            let said = taken(&wire).unwrap_err().to_string();
            assert!(said.contains(expected), "{said}");
        }
    }
}
