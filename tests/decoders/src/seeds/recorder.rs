//! Seeds of what the recorder reads.

use std::collections::BTreeMap;
use std::io::Cursor;

use hil_recorder::decoders::RecordedMessages;
use hil_rundir::manifest::describe_fields;
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};

use super::numbered;
use super::runtime::{bytes_of, message_inputs, with_layout};
use crate::Seed;

/// Of our own page, of a program, of other pages, and of one that hides behind a name.
pub(crate) fn viewer_requests() -> Vec<Seed> {
    let inputs = [
        "Host: localhost:8765\r\nOrigin: http://localhost:8766",
        "Host: 127.0.0.1:8765\r\nOrigin: http://127.0.0.1:8766",
        "Host: [::1]:8765\r\nAccept: */*\r\nOrigin: null",
        "Host: localhost:8765\r\nOrigin: https://evil.example",
        "Host: evil.example:8765\r\nOrigin: http://localhost:8766",
        "Host: control-pc",
    ];
    numbered(
        "request",
        inputs.map(|fields| {
            let begin = "GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n";
            format!("{begin}{fields}\r\n\r\n").into_bytes()
        }),
    )
}

/// Short recordings with and without compression, and one that is cut within its chunk.
pub(crate) fn recordings() -> Vec<Seed> {
    let [plain, compressed] = [None, Some(Compression::Zstd)].map(written);
    let cut = plain[..plain.len() / 3].to_vec();
    numbered("recording", [plain, compressed, cut])
}

fn written(compression: Option<Compression>) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let options = WriteOptions::new()
        .library("seed")
        .profile("")
        .compression(compression);
    let mut writer = Writer::with_options(&mut bytes, options).expect("memory takes it");
    let schema = writer
        .add_schema("Seed", "protobuf", b"schema")
        .expect("the first");
    let channel = writer
        .add_channel(schema, "/seed", "protobuf", &BTreeMap::new())
        .expect("the first");
    for sequence in 0..8 {
        let header = MessageHeader {
            channel_id: channel,
            sequence,
            log_time: u64::from(sequence) * 1_000_000,
            publish_time: u64::from(sequence) * 1_000_000,
        };
        let message = bytes_of(24);
        writer
            .write_to_known_channel(&header, &message)
            .expect("memory takes it");
    }
    writer.finish().expect("memory takes it");
    drop(writer);
    bytes.into_inner()
}

/// Layouts as of `layouts`, each with a message as a recording has it.
pub(crate) fn recorded_messages() -> Vec<Seed> {
    let inputs = message_inputs(|fields, size| {
        let messages = RecordedMessages::new(&describe_fields(fields), size);
        let messages = messages.expect("a layout of ours");
        let data = messages.write(&bytes_of(size)).expect("of its size");
        with_layout(fields, size, &data)
    });
    numbered("message", inputs)
}
