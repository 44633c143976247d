//! After a run, every host gets the records of all hosts, so that each report is complete: the
//! others send theirs to the first host of the topology, and it sends everything to each. It
//! computes nothing from them.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use super::event::{Event, ProcessStory};
use super::frame::{
    CHUNK_BYTES, Frame, PeerMessage, is_plain_record_name, write_chunk, write_message,
};
use super::peer::{Peer, PeerEvent};

/// A peer that sends nothing for this long while records are due has failed to deliver them.
const PATIENCE: Duration = Duration::from_secs(20);

/// What one host tells of its share of the run.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct HostStory {
    pub(crate) events: Vec<Event>,
    pub(crate) processes: Vec<ProcessStory>,
}

/// What came from the peers.
#[derive(Debug, Default)]
pub(crate) struct Received {
    pub(crate) stories: Vec<HostStory>,
    /// Why records of a host are missing or incomplete.
    pub(crate) problems: Vec<String>,
}

/// Sends this host's records and story, and receives those of the others into `records`.
pub(crate) fn exchange(
    peers: &mut [Peer],
    is_first_host: bool,
    records: &Path,
    story: &HostStory,
) -> Received {
    let mut received = Received::default();
    let own = match record_files(records) {
        Ok(own) => own,
        Err(error) => {
            received
                .problems
                .push(format!("cannot list own records: {error}"));
            Vec::new()
        }
    };
    if is_first_host {
        for peer in peers.iter_mut() {
            take_all(peer, records, &mut received);
        }
        let everything = record_files(records).unwrap_or(own);
        let mut stories = received.stories.clone();
        stories.push(story.clone());
        for peer in peers.iter_mut() {
            let host = peer.hello.host.clone();
            let (writer, _) = peer.halves();
            if let Err(error) = give_all(writer, &everything, &stories) {
                received
                    .problems
                    .push(format!("records could not be sent to {host}: {error}"));
            }
        }
    } else {
        for peer in peers.iter_mut() {
            give_and_take(peer, &own, records, (story, &mut received));
        }
    }
    received
}

/// Sends in a thread of its own: two ends that only send would wait for each other for ever.
fn give_and_take(
    peer: &mut Peer,
    own: &[PathBuf],
    records: &Path,
    (story, received): (&HostStory, &mut Received),
) {
    let host = peer.hello.host.clone();
    let (writer, inbox) = peer.halves();
    let stories = [story.clone()];
    let sent = thread::scope(|scope| {
        let sending = scope.spawn(|| give_all(writer, own, &stories));
        let mut next = || inbox.recv_timeout(PATIENCE).ok();
        take_from(&host, &mut next, records, received);
        sending
            .join()
            .unwrap_or_else(|_panic| Err(io::Error::other("the sending thread panicked")))
    });
    if let Err(error) = sent {
        received
            .problems
            .push(format!("records could not be sent to {host}: {error}"));
    }
    // The first host sends everybody's story back, this host's own included.
    received.stories.retain(|other| other != story);
}

fn take_all(peer: &mut Peer, records: &Path, received: &mut Received) {
    let host = peer.hello.host.clone();
    let mut next = || peer.receive(PATIENCE);
    take_from(&host, &mut next, records, received);
}

fn record_files(records: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files: Vec<PathBuf> = fs::read_dir(records)?
        .map(|entry| Ok(entry?.path()))
        .collect::<io::Result<_>>()?;
    files.sort();
    Ok(files)
}

fn give_all(out: &mut impl Write, files: &[PathBuf], stories: &[HostStory]) -> io::Result<()> {
    for story in stories {
        let HostStory { events, processes } = story.clone();
        write_message(out, &PeerMessage::Report { events, processes })?;
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

/// A file on its way in.
struct Incoming {
    file: Option<File>,
    left: u64,
}

fn take_from(
    host: &str,
    next: &mut dyn FnMut() -> Option<PeerEvent>,
    records: &Path,
    received: &mut Received,
) {
    let mut incoming = Incoming {
        file: None,
        left: 0,
    };
    let problem = loop {
        let frame = match next() {
            Some(PeerEvent::Frame(frame)) => frame,
            Some(PeerEvent::Closed(reason)) => break reason,
            None => break format!("silent for {} s", PATIENCE.as_secs()),
        };
        match take_frame(frame, records, &mut incoming, &mut received.stories) {
            Ok(true) => return,
            Ok(false) => {}
            Err(error) => break error.to_string(),
        }
    };
    received
        .problems
        .push(format!("records of {host} are incomplete: {problem}"));
}

/// Deals with one frame; true when it was the last.
fn take_frame(
    frame: Frame,
    records: &Path,
    incoming: &mut Incoming,
    stories: &mut Vec<HostStory>,
) -> io::Result<bool> {
    let invalid = |text: String| io::Error::new(io::ErrorKind::InvalidData, text);
    match frame {
        Frame::Message(PeerMessage::Done) => return Ok(true),
        Frame::Message(PeerMessage::Report { events, processes }) => {
            stories.push(HostStory { events, processes });
        }
        Frame::Message(PeerMessage::File { name, size_bytes }) => {
            if !is_plain_record_name(&name) {
                return Err(invalid(format!(
                    "file name {name:?} is not a record file's"
                )));
            }
            // A file that is here already is this host's own, come back from the first host.
            let created = File::create_new(records.join(&name));
            incoming.left = size_bytes;
            incoming.file = match created {
                Ok(file) => Some(file),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => None,
                Err(error) => return Err(error),
            };
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
            if let Some(file) = &mut incoming.file {
                file.write_all(&bytes)?;
            }
        }
        // Left over from the run itself.
        Frame::Message(_) => {}
    }
    Ok(false)
}
