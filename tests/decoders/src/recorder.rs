//! What the recorder reads: requests of viewers, recordings, messages in them.

use hil_recorder::decoders::{RecordedMessages, Request, recording as read_recording, request};

use crate::Verdict;
use crate::runtime::{MESSAGE_BYTES_MAX, sized, split_layout};

const MACHINE: &str = "control-pc";
const PAGE_PORT: u16 = 8766;
/// Largest record of a file here: a few bytes of a compressed one may stand for so many.
const RECORD_BYTES_MAX: usize = 1 << 18;

/// A page that the plainest reading of the head finds to be another's is never let in, and nobody is
/// before the last byte of the head.
pub(crate) fn viewer_request(bytes: &[u8]) -> Verdict {
    let judged = request(bytes, MACHINE, PAGE_PORT);
    match &judged {
        Request::Partial => Verdict::Refused,
        Request::Refused(why) => {
            assert!(!why.is_empty());
            Verdict::Refused
        }
        Request::Admitted { host } => {
            for origin in plain_origins(bytes) {
                let end = host.find(']').map(|end| end + 1).or(host.find(':'));
                let own = format!("http://{}:{PAGE_PORT}", &host[..end.unwrap_or(host.len())]);
                let socket = format!("http://{host}");
                let is_own = [own, socket]
                    .iter()
                    .any(|one| origin.eq_ignore_ascii_case(one));
                assert!(is_own, "{origin:?} was let in to {host:?}");
            }
            let more = [bytes, b"\x81\x85\x00\x01\x02\x03"].concat();
            assert_eq!(
                request(&more, MACHINE, PAGE_PORT),
                judged,
                "read beyond its end"
            );
            let (mut end, mut step) = (bytes.len(), bytes.len().next_power_of_two());
            // The shortest beginning that is let in, as whatever follows a head changes nothing.
            while step > 0 {
                let shorter = end.saturating_sub(step);
                let judged = request(&bytes[..shorter], MACHINE, PAGE_PORT);
                if judged != Request::Partial {
                    end = shorter;
                }
                step /= 2;
            }
            let head = &bytes[..end];
            assert!(
                head.ends_with(b"\n\r\n") || head.ends_with(b"\n\n"),
                "let in early"
            );
            Verdict::Accepted
        }
    }
}

/// The origins that a head names, read in the plainest way there is.
fn plain_origins(bytes: &[u8]) -> Vec<String> {
    let text = String::from_utf8_lossy(bytes);
    let lines = text.split('\n').map(|line| line.trim_end_matches('\r'));
    let lines = lines.skip_while(|line| line.is_empty()).skip(1);
    let head = lines.take_while(|line| !line.is_empty());
    let named = head.filter_map(|line| line.split_once(':'));
    let named = named.filter(|(name, _)| name.trim().eq_ignore_ascii_case("origin"));
    named.map(|(_, value)| value.trim().to_owned()).collect()
}

/// What was lost lies within the file and in its order, and a file without a loss is whole. Half of
/// it can be read as well.
pub(crate) fn recording(bytes: &[u8]) -> Verdict {
    let Some(found) = read_recording(bytes, RECORD_BYTES_MAX) else {
        return Verdict::Refused;
    };
    let size_bytes = bytes.len() as u64;
    let mut last = 0;
    for (offset, lost_bytes) in &found.losses {
        assert!(
            last <= *offset && offset + lost_bytes <= size_bytes,
            "{found:?}"
        );
        last = *offset;
    }
    assert!(found.message_count <= found.record_count);
    assert!(found.is_complete || !found.losses.is_empty(), "{found:?}");
    let _half = read_recording(&bytes[..bytes.len() / 2], RECORD_BYTES_MAX);
    Verdict::of(found.record_count > 0)
}

/// Any data gives a message of the layout's size or a reason, and every message comes back from a
/// file as the file has it.
pub(crate) fn recorded_message(bytes: &[u8]) -> Verdict {
    let Some((fields, size_bytes, data)) = split_layout(bytes) else {
        return Verdict::Refused;
    };
    let messages = match RecordedMessages::new(&fields, size_bytes) {
        Ok(messages) => messages,
        Err(fault) => {
            assert!(!fault.to_string().is_empty());
            return Verdict::Refused;
        }
    };
    if size_bytes > MESSAGE_BYTES_MAX {
        return Verdict::Accepted;
    }
    match messages.read(data) {
        Ok(message) => {
            assert_eq!(message.len(), size_bytes);
            assert_kept(&messages, &message);
        }
        Err(why) => assert!(!why.is_empty()),
    }
    assert_kept(&messages, &sized(data, size_bytes));
    assert_eq!(messages.write(&vec![0; size_bytes + 1]), None);
    Verdict::Accepted
}

/// Reserved bytes apart, which a file does not have, `message` is read as it was written.
fn assert_kept(messages: &RecordedMessages, message: &[u8]) {
    let written = messages.write(message).expect("it has the layout's size");
    let read = messages.read(&written).expect("our own writing");
    assert_eq!(
        messages.write(&read).as_ref(),
        Some(&written),
        "{message:?} and {read:?}"
    );
}
