//! What processes and hosts of a run leave for each other: records, frames between supervisors,
//! summaries, layouts, and words with a meaning.

use std::path::Path;

use hil_capture::flow::FlowFilter;
use hil_core::record::{IngressRecord, PublishedRecord};
use hil_engine::supervisor::frame::{
    FRAME_BYTES_MAX, Frame, is_plain_record_name, read_frame, write_chunk, write_message,
};
use hil_nic::radio;
use hil_platform::clock_discipline::{ChronyTracking, NtpVariables, PtpStatus};
use hil_platform::domain_address::DomainAddress;
use hil_report::summary::RunSummary;
use hil_rundir::event::HostHistory;
use hil_rundir::layout::{Decoder, Value};
use hil_rundir::manifest::FieldDescription;
use hil_rundir::record::RecordFile;
use hil_rundir::record::file::HEADER_BYTES;
use hil_topology::read_duration;

use crate::Verdict;
use crate::input::Input;

/// Header, whole records and the rest make up the file, and the header reads as it was written.
pub(crate) fn record_file(bytes: &[u8]) -> Verdict {
    let path = Path::new("input.rec");
    let file = match RecordFile::from_bytes(path, bytes.to_vec()) {
        Ok(file) => file,
        Err(error) => {
            assert!(error.to_string().contains("input.rec"), "{error}");
            return Verdict::Refused;
        }
    };
    let record_bytes = file.header.record_bytes as usize;
    let parts = HEADER_BYTES + file.record_count() * record_bytes + file.truncated_bytes;
    // The header may say that the records end before the file.
    let said = u64::from_le_bytes(core::array::from_fn(|byte| bytes[24 + byte]));
    let said = usize::try_from(said).unwrap_or(usize::MAX);
    let end = if said == 0 { bytes.len() } else { said };
    assert_eq!(parts, end.clamp(HEADER_BYTES, bytes.len()));
    assert!(file.truncated_bytes < record_bytes);
    let header = file.header.encode(path).expect("it was read");
    let again = RecordFile::from_bytes(path, header.to_vec()).expect("it was written");
    assert_eq!((&again.header, again.record_count()), (&file.header, 0));
    let name = file.header.file_name("writer");
    assert_eq!(file.header.writer(&name), Some("writer"));
    assert_eq!(file.message(file.record_count()), None);
    if file.message(0).is_some() {
        for index in 0..file.record_count() {
            let (_, payload) = file.message(index).expect("each record is a message");
            let envelope_bytes = size_of::<hil_core::message::Envelope>();
            assert_eq!(payload.len() + envelope_bytes, record_bytes);
        }
    }
    for (size, count) in [
        (
            size_of::<PublishedRecord>(),
            file.records::<PublishedRecord>().count(),
        ),
        (
            size_of::<IngressRecord>(),
            file.records::<IngressRecord>().count(),
        ),
    ] {
        let expected = if size == record_bytes {
            file.record_count()
        } else {
            0
        };
        assert_eq!(count, expected);
    }
    Verdict::Accepted
}

/// What is read is written as frames that read the same; a name that could leave the folder is not
/// a plain one.
pub(crate) fn peer_frames(bytes: &[u8]) -> Verdict {
    let mut input = bytes;
    let mut count = 0;
    loop {
        let before = input.len();
        let Ok((frame, _)) = read_frame(&mut input, FRAME_BYTES_MAX) else {
            break;
        };
        assert!(before - input.len() <= FRAME_BYTES_MAX + 5);
        count += 1;
        let mut wire = Vec::new();
        match &frame {
            Frame::Message(message) => {
                write_message(&mut wire, message).expect("no longer than it was");
            }
            Frame::Chunk(chunk) => {
                write_chunk(&mut wire, chunk).expect("no longer than it was");
                if let Ok(history) = serde_json::from_slice::<HostHistory>(chunk) {
                    let written =
                        serde_json::to_vec(&history).expect("what was read can be written");
                    let again = serde_json::from_slice(&written).ok();
                    assert_eq!(again, Some(history));
                }
            }
        }
        let again = read_frame(&mut wire.as_slice(), FRAME_BYTES_MAX);
        assert_eq!(again.ok().map(|(frame, _)| frame), Some(frame));
    }
    if let Ok(name) = str::from_utf8(bytes)
        && is_plain_record_name(name)
    {
        let below = Path::new("/records").join(name);
        assert_eq!(below.parent(), Some(Path::new("/records")));
        assert_eq!(below.file_name().and_then(|name| name.to_str()), Some(name));
    }
    Verdict::of(count > 0)
}

/// A summary that is read is written as one that reads the same.
pub(crate) fn summary(bytes: &[u8]) -> Verdict {
    let Ok(text) = str::from_utf8(bytes) else {
        return Verdict::Refused;
    };
    match RunSummary::from_json(text) {
        Ok(summary) => {
            let written = summary.to_json().expect("what was read can be written");
            let again = RunSummary::from_json(&written).expect("what was written can be read");
            let twice = again.to_json().expect("what was read can be written");
            assert_eq!(twice, written, "writing and reading changes it");
            Verdict::Accepted
        }
        Err(error) => {
            assert!(!error.to_string().is_empty());
            Verdict::Refused
        }
    }
}

/// Messages that are shown: larger ones show nothing new and take long.
pub(crate) const MESSAGE_BYTES_MAX: usize = 1 << 12;

/// By a layout that is accepted every message of its size is read, each part as in the whole, and
/// none of another size.
pub(crate) fn layout(bytes: &[u8]) -> Verdict {
    let Some((fields, size_bytes, message)) = split_layout(bytes) else {
        return Verdict::Refused;
    };
    let decoder = match Decoder::new("input.Message.v1", &fields, size_bytes) {
        Ok(decoder) => decoder,
        Err(fault) => {
            assert!(!fault.to_string().is_empty());
            return Verdict::Refused;
        }
    };
    if size_bytes > MESSAGE_BYTES_MAX {
        return Verdict::Accepted;
    }
    let message = sized(message, size_bytes);
    let value = decoder.decode(&message).expect("a message of its size");
    assert_eq!(decoder.decode(&message[1..]), None);
    assert!(!value.to_string().is_empty());
    serde_json::to_string(&value).expect("every value has a form in JSON");
    let Value::Record(parts) = &value else {
        panic!("a message is a structure");
    };
    let told = fields.iter().filter(|field| !field.is_reserved());
    assert_eq!(parts.len(), told.clone().count());
    for ((name, part), field) in parts.iter().zip(told) {
        assert_eq!(name, &field.name);
        // Names are anybody's: one with a dot is a path, and of two equal ones the first counts.
        let is_plain =
            !name.contains('.') && parts.iter().filter(|one| one.0 == *name).count() == 1;
        if is_plain {
            let selected = decoder.select(name).expect("the message has the field");
            let alone = decoder.decode_part(&selected, &message);
            let same = alone.map(|alone| alone.to_string());
            assert_eq!(same, Some(part.to_string()), "{name}");
        }
    }
    Verdict::Accepted
}

/// An input that is a layout and a message: the length of the layout's JSON in two bytes, the JSON
/// (an object with `fields` and `size_bytes`), the message.
pub(crate) fn split_layout(bytes: &[u8]) -> Option<(Vec<FieldDescription>, usize, &[u8])> {
    let mut input = Input::new(bytes);
    let length = usize::from(input.short());
    let json = input.take(length);
    let value: serde_json::Value = serde_json::from_slice(json).ok()?;
    let fields = serde_json::from_value(value.get("fields")?.clone()).ok()?;
    let size_bytes = usize::try_from(value.get("size_bytes")?.as_u64()?).ok()?;
    Some((fields, size_bytes, input.rest()))
}

/// `bytes` cut or filled with zeros to `size_bytes`.
pub(crate) fn sized(bytes: &[u8], size_bytes: usize) -> Vec<u8> {
    let mut message = bytes[..bytes.len().min(size_bytes)].to_vec();
    message.resize(size_bytes, 0);
    message
}

/// Each answer takes at least a header's bytes, and one cut off within a header is none.
pub(crate) fn radio(bytes: &[u8]) -> Verdict {
    const HEADER_BYTES: usize = 16;
    let heard = radio::heard(bytes);
    assert!(
        heard.answer_count * HEADER_BYTES <= bytes.len(),
        "{heard:?}"
    );
    for count in [
        heard.station_count,
        heard.interface_count,
        heard.event_count,
        heard.family_count,
    ] {
        assert!(count <= heard.answer_count, "{heard:?}");
    }
    let piece = radio::heard(&bytes[..bytes.len() / 2]);
    assert!(
        piece.answer_count <= heard.answer_count,
        "{piece:?} of {heard:?}"
    );
    Verdict::of(heard.answer_count > 0)
}

/// Words of users and of other programs: the first byte says which.
pub(crate) fn words(bytes: &[u8]) -> Verdict {
    let mut input = Input::new(bytes);
    let which = input.byte();
    let Ok(text) = str::from_utf8(input.rest()) else {
        return Verdict::Refused;
    };
    let is_accepted = match which % 6 {
        0 => read_duration(text).is_some(),
        1 => text.parse::<DomainAddress>().is_ok_and(|address| {
            let again = address.to_string().parse::<DomainAddress>();
            assert!(again.is_ok_and(|again| again == address), "{address}");
            true
        }),
        2 => match text.parse::<FlowFilter>() {
            Ok(flow) => {
                assert!(flow.snap_bytes() <= 1 << 16, "{flow:?}");
                true
            }
            Err(error) => {
                assert!(!error.to_string().is_empty());
                false
            }
        },
        3 => told(ChronyTracking::parse(text), |tracking| {
            assert!(
                tracking.bound_ns() <= 3 * 86_400 * 1_000_000_000,
                "{tracking:?}"
            );
        }),
        4 => told(NtpVariables::parse(text), |variables| {
            let _bound = (variables.bound_ns(), variables.is_synchronised());
        }),
        _ => told(PtpStatus::parse(text), |status| {
            assert!(status.bound_ns() <= 2_000_000_000_000_000, "{status:?}");
        }),
    };
    Verdict::of(is_accepted)
}

fn told<T>(parsed: Result<T, String>, check: impl FnOnce(T)) -> bool {
    match parsed {
        Ok(value) => {
            check(value);
            true
        }
        Err(why) => {
            assert!(!why.is_empty(), "refused without a word");
            false
        }
    }
}
