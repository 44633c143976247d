//! After a run, every host gets the records of all hosts, so that each report is complete: the
//! others send theirs to the first host of the topology, and it sends everybody the rest. It
//! computes nothing from them.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::thread::{self, ScopedJoinHandle};
use std::time::Duration;

use super::conversation::Conversation;
use super::frame::{
    CHUNK_BYTES, Frame, PeerMessage, REPORT_BYTES_MAX, is_plain_record_name, write_chunk,
    write_message,
};
use super::peer::Peer;
use hil_rundir::event::HostHistory;
use hil_rundir::file_fault::{FileFault, GapCause, RecordGap};

/// A peer that lives and neither gives nor takes anything for this long has failed to deliver, as one behind a disk
/// that stands still for good: so long Linux bears a task that waits for a disk before it reports it
/// (`kernel.hung_task_timeout_secs`).
const PROGRESS_PATIENCE: Duration = Duration::from_mins(2);

/// What came from one peer, or from all of them.
#[derive(Debug, Default)]
pub(crate) struct Received {
    pub(crate) stories: Vec<HostHistory>,
    /// Records that hosts lack.
    pub(crate) gaps: Vec<RecordGap>,
    /// What else a reader of the records must know.
    pub(crate) problems: Vec<String>,
    names: BTreeSet<String>,
}

impl Received {
    /// Takes back the record files that came: a part of them is worse than none.
    fn drop_files(&mut self, records: &Path) {
        for name in core::mem::take(&mut self.names) {
            let path = records.join(name);
            if let Err(error) = fs::remove_file(&path) {
                let path = path.display();
                let text = format!("{path}: {error}; it may be a part of a file only");
                self.problems.push(text);
            }
        }
    }

    /// Whether the connection failed.
    fn is_broken(&self) -> bool {
        let causes = self.gaps.iter().map(|gap| &gap.cause);
        causes
            .into_iter()
            .any(|cause| matches!(cause, GapCause::Connection(_)))
    }

    /// Notes that `host` lacks the records of those whose reports came, or of `peer` if none did.
    fn note_gap(&mut self, host: &str, peer: &str, cause: GapCause) {
        let mut of = hosts_of(&self.stories);
        if of.is_empty() {
            of.push(peer.to_owned());
        }
        let host = host.to_owned();
        self.gaps.push(RecordGap { host, of, cause });
    }
}

/// Sends this host's records and story, and receives those of the others into `records`. In the end the
/// hosts tell each other which records they lack, so that all reports say the same of the run.
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
        if let Err(error) = peer.conversation().expect_progress(PROGRESS_PATIENCE) {
            all.problems.push(format!("{}: {error}", peer.hello.host));
        }
    }
    if is_first_host {
        let here = &story.hosts[0];
        let take = |host: &str, peer: &Conversation| take_from(here, host, peer, records);
        let mut received = receive_from_all(peers, take, |host| {
            let mut received = Received::default();
            let cause = "the receiving thread panicked".to_owned();
            received.note_gap(here, host, GapCause::Connection(cause));
            received
        });
        for (peer, one) in peers.iter_mut().zip(&mut received) {
            // Nothing more is expected of it, and it is not waited for again.
            if one.is_broken() {
                peer.hang_up();
            }
            all.gaps.append(&mut one.gaps);
            all.problems.append(&mut one.problems);
        }
        distribute(peers, &own, story, &received, records, &mut all);
        let panicked = |_host: &str| Err("the receiving thread panicked".to_owned());
        let words = receive_from_all(peers, |_host, peer| take_word(peer), panicked);
        for (peer, word) in peers.iter().zip(words) {
            note_word(&peer.hello.host, word, &mut all);
        }
        for peer in peers.iter_mut() {
            peer.say(&PeerMessage::Taken(all.gaps.clone()));
        }
        all.stories
            .extend(received.into_iter().flat_map(|one| one.stories));
    } else {
        for peer in peers.iter_mut() {
            give_and_take(peer, &own, story, records, &mut all);
            peer.say(&PeerMessage::Taken(all.gaps.clone()));
            let word = take_word(&peer.conversation());
            if word.is_ok() {
                // It has what was said just now.
                all.gaps.clear();
            }
            note_word(&peer.hello.host, word, &mut all);
        }
    }
    all
}

/// Receives from all peers at once; `panicked` stands for what a thread did not give.
fn receive_from_all<T: Send>(
    peers: &[Peer],
    receive: impl Fn(&str, &Conversation) -> T + Sync,
    panicked: impl Fn(&str) -> T,
) -> Vec<T> {
    let receive = &receive;
    thread::scope(|scope| {
        let receiving = peers.iter().map(|peer| {
            let (host, conversation) = (&peer.hello.host, peer.conversation());
            (host, scope.spawn(move || receive(host, &conversation)))
        });
        let receiving: Vec<_> = receiving.collect();
        let joined = receiving.into_iter();
        joined
            .map(|(host, thread)| thread.join().unwrap_or_else(|_panic| panicked(host)))
            .collect()
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
            let writer = peer.writer();
            let of = hosts_of(&stories);
            let give = move || give_all(writer, &files, &stories);
            sending.push((host, of, scope.spawn(give)));
        }
        sending
            .into_iter()
            .map(|(host, of, one)| (host, of, join_sending(one)))
            .collect::<Vec<_>>()
    });
    for (peer, (host, of, sent)) in peers.iter_mut().zip(sent) {
        if sent.is_err() {
            peer.hang_up();
        }
        note_unsent(&host, of, sent, all);
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
    let own_history = std::slice::from_ref(own_history);
    let conversation = peer.conversation();
    let writer = peer.writer();
    let (received, sent) = thread::scope(|scope| {
        let sending = scope.spawn(|| {
            let sent = give_all(writer, own, own_history);
            if sent.is_err() {
                // The other host waits for the rest before it gives what is waited for here.
                conversation.leave();
            }
            sent
        });
        let received = take_from(&own_history[0].hosts[0], &host, &conversation, records);
        if received.is_broken() {
            // What is being sent would wait for as long again.
            conversation.leave();
        }
        (received, join_sending(sending))
    });
    if sent.is_err() || received.is_broken() {
        peer.hang_up();
    }
    all.stories.extend(received.stories);
    all.gaps.extend(received.gaps);
    all.problems.extend(received.problems);
    note_unsent(&host, hosts_of(own_history), sent, all);
}

fn join_sending(thread: ScopedJoinHandle<'_, io::Result<()>>) -> io::Result<()> {
    let panicked = |_panic| Err(io::Error::other("the sending thread panicked"));
    thread.join().unwrap_or_else(panicked)
}

fn hosts_of(stories: &[HostHistory]) -> Vec<String> {
    let hosts = stories.iter().flat_map(|story| story.hosts.clone());
    hosts.collect()
}

/// Notes that records did not get to `host`.
fn note_unsent(host: &str, of: Vec<String>, sent: io::Result<()>, all: &mut Received) {
    if let Err(error) = sent {
        all.gaps.push(RecordGap {
            host: host.to_owned(),
            of,
            cause: GapCause::Connection(error.to_string()),
        });
    }
}

/// The gaps that a peer tells in the end.
fn take_word(peer: &Conversation) -> Result<Vec<RecordGap>, String> {
    loop {
        if let Frame::Message(PeerMessage::Taken(gaps)) = peer.next_frame()? {
            return Ok(gaps);
        }
    }
}

fn note_word(host: &str, word: Result<Vec<RecordGap>, String>, all: &mut Received) {
    match word {
        Ok(gaps) => all.gaps.extend(gaps),
        // A connection that broke before is told already.
        Err(_) if !all.gaps.is_empty() => {}
        Err(reason) => {
            let text = format!("{host} did not say whether it has all records: {reason}");
            all.problems.push(text);
        }
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
#[derive(Default)]
struct Incoming {
    body: Body,
    left: u64,
    /// Of all reports so far.
    report_bytes: u64,
    /// The first file that was not written. What follows is read and left, so that the peer is not held up
    /// and hears of it.
    unwritten: Option<FileFault>,
}

#[derive(Default)]
enum Body {
    /// Nothing, or a file that is not kept.
    #[default]
    Nothing,
    File(File, PathBuf),
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

    /// The disk does not take the file at `path`.
    fn give_up(&mut self, path: &Path, error: &io::Error, records: &Path, received: &mut Received) {
        self.unwritten.get_or_insert(FileFault::new(path, error));
        self.body = Body::Nothing;
        received.drop_files(records);
    }
}

/// Takes on `here` what `host` sends.
fn take_from(here: &str, host: &str, peer: &Conversation, records: &Path) -> Received {
    let mut received = Received::default();
    let mut incoming = Incoming::default();
    let broken = loop {
        let taken = peer.next_frame().and_then(|frame| {
            let taken = take_frame(frame, records, &mut incoming, &mut received);
            taken.map_err(|error| error.to_string())
        });
        match taken {
            Ok(true) => break None,
            Ok(false) => {}
            Err(reason) => break Some(GapCause::Connection(reason)),
        }
    };
    if broken.is_some() {
        received.drop_files(records);
    }
    let unwritten = incoming.unwritten.map(GapCause::Unwritable);
    if let Some(cause) = unwritten.or(broken) {
        received.note_gap(here, host, cause);
    }
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
            incoming.left = size_bytes;
            incoming.body = Body::Nothing;
            if incoming.unwritten.is_none() {
                let path = records.join(&name);
                match File::create_new(&path) {
                    Ok(file) => {
                        received.names.insert(name);
                        incoming.body = Body::File(file, path);
                    }
                    Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                        return Err(error);
                    }
                    Err(error) => incoming.give_up(&path, &error, records, received),
                }
            }
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
                Body::File(file, path) => {
                    if let Err(error) = file.write_all(&bytes) {
                        let path = path.clone();
                        incoming.give_up(&path, &error, records, received);
                    }
                }
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
    use crate::supervisor::frame::{FRAME_BYTES_MAX, read_frame};
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
        let mut incoming = Incoming::default();
        let nowhere = Path::new("/nonexistent");
        while !take_frame(
            read_frame(&mut input, FRAME_BYTES_MAX)?.0,
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
