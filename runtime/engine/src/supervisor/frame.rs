//! Framing of the TCP connection between two supervisors: a length, a kind, then JSON or bytes.
//! Robot messages never go this way; gateways carry those.

use std::io::{self, Read, Write};

use serde::{Deserialize, Serialize};
use zeroize::Zeroizing;

use super::peer_status::HostTicks;
use hil_rundir::file_fault::RecordGap;
use hil_rundir::run_result::Outcome;
use hil_rundir::run_seal::RunSeal;

/// Largest frame either side accepts; a longer length field is an error, not an allocation.
pub const FRAME_BYTES_MAX: usize = 1 << 20;
/// Piece in which record files and reports travel.
pub const CHUNK_BYTES: usize = 1 << 18;
/// Most that a peer may send of reports: a million events, or the counters of tens of thousands of
/// channels.
pub const REPORT_BYTES_MAX: u64 = 1 << 28;

/// Who a supervisor is; the first frame each way.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerHello {
    /// Version of this program; both ends must be equal.
    pub version: String,
    /// Hash of the resolved topology; both ends must be equal.
    pub topology_hash: u64,
    /// Name of the host in the topology.
    pub host: String,
    /// Equal identities mean both ends read one clock.
    pub clock_id: u64,
    /// Fingerprint of the host's shared-memory domain; must differ.
    pub domain: [u8; 16],
    /// Its processor has instructions for AES.
    pub has_fast_aes: bool,
    /// It goes on with a connection that was cut.
    pub resumed: Option<Resumed>,
}

/// Where a connection that was cut goes on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resumed {
    /// Fingerprint of the other end's shared-memory domain, of which each start has another one.
    pub of: [u8; 16],
    /// Frames that came from the other end.
    pub come_count: u64,
}

/// What supervisors tell each other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PeerMessage {
    /// First frame each way.
    Hello(PeerHello),
    /// The other end does not fit, and why; the last frame.
    Refused(String),
    /// The run's secret; from the first host, over a secured connection only.
    Seal(RunSeal),
    /// Every process of this host is ready.
    Ready,
    /// Begin.
    Start {
        /// All hosts of the run read one clock.
        has_one_clock: bool,
    },
    /// Nothing new; sent so that silence means something.
    Alive,
    /// What was taken. It is no frame that counts.
    Acknowledged {
        /// Frames of the receiver.
        taken_count: u64,
        /// Frames that the sender and any host took of each other, apart from words that one lives: whether it makes
        /// progress.
        moved_count: u64,
    },
    /// The sender ends the connection for good. It is no frame that counts.
    Leaving,
    /// How many ticks passed without the processes of the hosts that the sender knows of. Sent in
    /// place of [`PeerMessage::Alive`] while a run goes on.
    Ticks(Vec<HostTicks>),
    /// The run ends here, in this way.
    Stop(Outcome),
    /// Components have stopped; gateways still run for what is under way.
    Quiet,
    /// A record file follows in chunks of raw bytes.
    File {
        /// Plain file name.
        name: String,
        /// Its size.
        size_bytes: u64,
    },
    /// What happened on a host and how its processes fared follows in chunks: a
    /// [`HostHistory`](hil_rundir::event::HostHistory) in JSON.
    Report {
        /// Its length.
        size_bytes: u64,
    },
    /// Everything has been sent.
    Done,
    /// What was sent has been taken, apart from these records; from the first host those of all hosts. The
    /// last message.
    Taken(Vec<RecordGap>),
}

/// One frame as read.
#[derive(Debug, Clone, PartialEq)]
pub enum Frame {
    /// A message.
    Message(PeerMessage),
    /// The next piece of the file or report announced last.
    Chunk(Vec<u8>),
}

const KIND_MESSAGE: u8 = 0;
const KIND_CHUNK: u8 = 1;

/// Writes one message.
///
/// # Errors
/// When the connection fails, or the message is longer than a frame may be.
pub fn write_message(out: &mut impl Write, message: &PeerMessage) -> io::Result<()> {
    // It may hold the run's secret.
    let body = Zeroizing::new(serde_json::to_vec(message)?);
    write_frame(out, KIND_MESSAGE, &body)
}

/// Writes one piece of a file or report.
///
/// # Errors
/// When the connection fails.
pub fn write_chunk(out: &mut impl Write, bytes: &[u8]) -> io::Result<()> {
    write_frame(out, KIND_CHUNK, bytes)
}

fn write_frame(out: &mut impl Write, kind: u8, body: &[u8]) -> io::Result<()> {
    if body.len() > FRAME_BYTES_MAX {
        let text = format!("a frame of {} bytes is above {FRAME_BYTES_MAX}", body.len());
        return Err(io::Error::new(io::ErrorKind::InvalidData, text));
    }
    let length = u32::try_from(body.len())
        .expect("FRAME_BYTES_MAX fits 32 bits")
        .to_le_bytes();
    out.write_all(&[length[0], length[1], length[2], length[3], kind])?;
    out.write_all(body)?;
    out.flush()
}

/// Reads one frame of at most `bytes_max`, which bounds what a stranger may announce, and gives it with the length of its
/// body in bytes; waits for it.
///
/// # Errors
/// When the connection ends or says something that is not a frame.
pub fn read_frame(input: &mut impl Read, bytes_max: usize) -> io::Result<(Frame, usize)> {
    let mut head = [0; 5];
    input.read_exact(&mut head)?;
    let length = u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize;
    if length > bytes_max {
        let text = format!("the peer announced a frame of {length} bytes, {bytes_max} is most");
        return Err(io::Error::new(io::ErrorKind::InvalidData, text));
    }
    let mut body = Zeroizing::new(vec![0_u8; length]);
    input.read_exact(&mut body)?;
    let frame = match head[4] {
        KIND_MESSAGE => Frame::Message(serde_json::from_slice(&body)?),
        KIND_CHUNK => Frame::Chunk(core::mem::take(&mut *body)),
        kind => {
            let text = format!("the peer sent a frame of unknown kind {kind}");
            return Err(io::Error::new(io::ErrorKind::InvalidData, text));
        }
    };
    Ok((frame, length))
}

/// A record file's name as a peer may give it: nothing that could leave the records folder.
pub fn is_plain_record_name(name: &str) -> bool {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'_');
    name.len() <= 255
        && name.as_bytes().ends_with(b".rec")
        && !name.starts_with('.')
        && name.bytes().all(is_plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_survive_the_stream() {
        let mut wire = Vec::new();
        write_message(&mut wire, &PeerMessage::Ready).unwrap();
        write_chunk(&mut wire, &[1, 2, 3]).unwrap();
        let mut input = wire.as_slice();
        assert_eq!(
            read_frame(&mut input, FRAME_BYTES_MAX).unwrap().0,
            Frame::Message(PeerMessage::Ready)
        );
        assert_eq!(
            read_frame(&mut input, FRAME_BYTES_MAX).unwrap().0,
            Frame::Chunk(vec![1, 2, 3])
        );
        assert_eq!(
            read_frame(&mut input, FRAME_BYTES_MAX).unwrap_err().kind(),
            io::ErrorKind::UnexpectedEof
        );
    }

    #[test]
    fn names_that_could_leave_the_folder_are_refused() {
        assert!(is_plain_record_name("arm.command.taken.robot.0.rec"));
        for name in ["../x.rec", "a/b.rec", ".rec", "x.toml", "x\0.rec", "é.rec"] {
            assert!(!is_plain_record_name(name), "{name}");
        }
    }
}
