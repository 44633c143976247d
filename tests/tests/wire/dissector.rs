//! Wireshark as judge: its command-line form reads our datagrams through the dissector we ship, and
//! our captures and those of an ET2000 through its own, and must find the values we put in.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use hil_capture::esl::EslHeader;
use hil_capture::reader::{CaptureReader, Step};
use hil_capture::writer::PacketToWrite;
use hil_capture::{CaptureInterface, esl, writer};
use hil_net::{Direction, link_type};
use hil_protocol::StampSource;
use hil_protocol::body::{Hello, HelloAck, HelloStatus, PieceAck, SyncResponse};
use hil_protocol::wire::{FollowUpField, HEADER_BYTES, Header, Kind};
use hil_tests::binary::{hil_runtime_binary, workspace_folder};
use hil_tests::child::run;
use hil_tests::run_folder::RunFolder;

const LIMIT: Duration = Duration::from_mins(2);
const STAMP_NS: u64 = 1_790_000_000_123_456_789;

/// True when tshark is there.
///
/// # Panics
/// In CI (`CI` is set) when it is missing.
fn has_tshark() -> bool {
    let is_there = Command::new("tshark").arg("--version").output().is_ok();
    if !is_there {
        assert!(std::env::var_os("CI").is_none(), "tshark is missing in CI");
        eprintln!("skipped: tshark is not installed");
    }
    is_there
}

/// The values of `fields` in each packet of `file`; several of one packet with commas between.
fn tshark(file: &Path, options: &[&str], fields: &[&str]) -> Vec<BTreeMap<String, String>> {
    let mut command = Command::new("tshark");
    command.args(["-n", "-T", "fields", "-E", "separator=;", "-r"]);
    command.arg(file).args(options);
    for field in fields {
        command.args(["-e", field]);
    }
    let finished = run(&mut command, LIMIT).unwrap();
    let lines = finished.stdout.lines().map(|line| {
        let values = line.split(';').map(str::to_owned);
        fields
            .iter()
            .map(|field| (*field).to_owned())
            .zip(values)
            .collect()
    });
    lines.collect()
}

fn dissector() -> String {
    let script = workspace_folder().join("deploy/wireshark/hil.lua");
    format!("lua_script:{}", script.display())
}

fn udp_frame(payload: &[u8]) -> Vec<u8> {
    let udp_bytes = u16::try_from(8 + payload.len()).unwrap();
    let mut frame = vec![2, 0, 0, 0, 0, 2, 2, 0, 0, 0, 0, 1, 8, 0, 0x45, 0];
    frame.extend((20 + udp_bytes).to_be_bytes());
    frame.extend([0, 1, 0x40, 0, 64, 17, 0, 0, 10, 77, 0, 1, 10, 77, 0, 2]);
    for half in [48_001, 48_002, udp_bytes, 0] {
        frame.extend(half.to_be_bytes());
    }
    frame.extend(payload);
    frame
}

/// Writes frames one microsecond apart.
fn capture(folder: &RunFolder, frames: &[Vec<u8>]) -> PathBuf {
    let mut bytes = Vec::new();
    writer::begin(&mut bytes, "dissector test", "none");
    let interface = CaptureInterface {
        name: Some("lan1".to_owned()),
        link_type: link_type::ETHERNET,
        ..CaptureInterface::default()
    };
    writer::interface(&mut bytes, &interface, "none");
    for (index, frame) in (0_u64..).zip(frames) {
        let packet = PacketToWrite {
            interface_index: 0,
            stamp_ns: STAMP_NS + 1000 * index,
            original_bytes: u32::try_from(frame.len()).unwrap(),
            direction: Direction::Outbound,
            data: [frame, &[]],
        };
        writer::packet(&mut bytes, &packet);
    }
    writer::statistics(&mut bytes, 0, STAMP_NS, STAMP_NS + 9000, 6, 3, None);
    fs::create_dir_all(folder.path()).unwrap();
    let path = folder.path().join("sample.pcapng");
    fs::write(&path, bytes).unwrap();
    path
}

fn datagram(header: &Header, body: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0; HEADER_BYTES];
    let mut header = *header;
    if header.kind != Kind::Data {
        header.total_len = u32::try_from(body.len()).unwrap();
    }
    header.encode(&mut bytes);
    bytes.extend(body);
    bytes
}

fn sample_header(kind: Kind) -> Header {
    let mut header = Header::new(kind, 0x1122_3344, 513);
    header.sequence = 0x0102_0304_0506_0708;
    header.type_hash = 0xfeed_face_cafe_beef;
    header.handed_ns = 123_456_789_012_345;
    header
}

/// One datagram of each kind, in frames.
fn sample_frames() -> Vec<Vec<u8>> {
    let mut data = sample_header(Kind::Data);
    data.published_ns = i64::MIN;
    data.follow_up = Some(FollowUpField {
        sequence_low: 77,
        handed_to_tx_ns: 4_321,
    });
    (
        data.total_len,
        data.fragment_index,
        data.fragment_count,
        data.epoch,
    ) = (20, 1, 2, 0xabcd);
    let hello = Hello {
        domain: [0xd0; 16],
        clock_id: 0x99,
        channel_count: 400,
        flow_name: "hil/link/hop/forward",
    };
    let ack = HelloAck {
        status: HelloStatus::SharedDomain,
        session: 0x55,
        clock_id: 0x66,
        domain: [0xd1; 16],
        answers_handed_ns: -5,
    };
    let response = SyncResponse {
        t1_ns: 11,
        t2_ns: -12,
        t3_ns: 13,
        t2_source: StampSource::KernelSoftware,
    };
    let piece_ack = PieceAck {
        answers_handed_ns: -6,
    };
    let mut bodies = [(); 4].map(|()| vec![0; 200]);
    let lengths = [
        hello.encode(&mut bodies[0]),
        ack.encode(&mut bodies[1]),
        response.encode(&mut bodies[2]),
        piece_ack.encode(&mut bodies[3]),
    ];
    [
        datagram(&data, b"0123456789"),
        datagram(&sample_header(Kind::SyncRequest), &[0; 40]),
        datagram(&sample_header(Kind::SyncResponse), &bodies[2][..lengths[2]]),
        datagram(&sample_header(Kind::Hello), &bodies[0][..lengths[0]]),
        datagram(&sample_header(Kind::HelloAck), &bodies[1][..lengths[1]]),
        datagram(&sample_header(Kind::Bye), &[]),
        datagram(&sample_header(Kind::PieceAck), &bodies[3][..lengths[3]]),
    ]
    .iter()
    .map(|bytes| udp_frame(bytes))
    .collect()
}

type Fields = Vec<(&'static str, String)>;

/// What tshark must find in all of them.
fn common_fields() -> Fields {
    [
        ("hil.magic", "HILG"),
        ("hil.version", "2"),
        ("hil.flags", "0x0000"),
        ("hil.session", "0x11223344"),
        ("hil.channel", "513"),
        ("hil.header_len", "72"),
        ("hil.sequence", "72623859790382856"),
        ("hil.type_hash", "0xfeedfacecafebeef"),
        ("hil.handed_ns", "123456789012345"),
        ("_ws.expert", ""),
    ]
    .map(|(name, value)| (name, value.to_owned()))
    .to_vec()
}

/// What it must find in each.
fn own_fields() -> [Fields; 7] {
    let dd = "d0".repeat(16);
    let d1 = "d1".repeat(16);
    let own: [&[(&'static str, &str)]; 7] = [
        &[
            ("hil.kind", "1"),
            ("hil.published_ns", "-9223372036854775808"),
            ("hil.follow_up.sequence", "77"),
            ("hil.follow_up.delta_ns", "4321"),
            ("hil.total_len", "20"),
            ("hil.fragment.index", "1"),
            ("hil.fragment.count", "2"),
            ("hil.epoch", "0x0000abcd"),
            ("hil.payload", "30313233343536373839"),
        ],
        &[
            ("hil.kind", "2"),
            ("hil.total_len", "40"),
            ("hil.follow_up.delta_ns", ""),
        ],
        &[
            ("hil.kind", "3"),
            ("hil.sync.t1_ns", "11"),
            ("hil.sync.t2_ns", "-12"),
            ("hil.sync.t3_ns", "13"),
            ("hil.sync.t2_source", "1"),
        ],
        &[
            ("hil.kind", "4"),
            ("hil.hello.domain", &dd),
            ("hil.hello.clock_id", "0x0000000000000099"),
            ("hil.hello.channel_count", "400"),
            ("hil.hello.flow_name", "hil/link/hop/forward"),
        ],
        &[
            ("hil.kind", "5"),
            ("hil.ack.status", "2"),
            ("hil.ack.session", "0x00000055"),
            ("hil.ack.clock_id", "0x0000000000000066"),
            ("hil.ack.domain", &d1),
            ("hil.ack.answers_handed_ns", "-5"),
        ],
        &[("hil.kind", "6"), ("hil.payload", "")],
        &[("hil.kind", "9"), ("hil.ack.answers_handed_ns", "-6")],
    ];
    own.map(|list| {
        list.iter()
            .map(|(name, value)| (*name, (*value).to_owned()))
            .collect()
    })
}

#[test]
fn the_lua_dissector_shows_every_field_of_every_kind() {
    if !has_tshark() {
        return;
    }
    let folder = RunFolder::new("dissector");
    let file = capture(&folder, &sample_frames());
    let (common, own) = (common_fields(), own_fields());
    let all = common.iter().chain(own.iter().flatten());
    let mut fields: Vec<&str> = all.map(|(name, _)| *name).collect();
    fields.sort_unstable();
    fields.dedup();
    let packets = tshark(&file, &["-X", &dissector()], &fields);
    assert_eq!(packets.len(), 7);
    for (packet, own) in packets.iter().zip(&own) {
        for (field, expected) in common.iter().chain(own) {
            assert_eq!(packet[*field], *expected, "{field} of {packet:?}");
        }
    }
}

#[test]
fn a_sealed_payload_is_shown_as_sealed_and_not_misread() {
    if !has_tshark() {
        return;
    }
    let folder = RunFolder::new("dissector-sealed");
    let mut sealed = datagram(&sample_header(Kind::SyncResponse), &[7; 96]);
    sealed[56..60].copy_from_slice(&80_u32.to_le_bytes());
    sealed[6..8].copy_from_slice(&[1, 3]);
    sealed[68..72].copy_from_slice(&9_u32.to_le_bytes());
    let mut request = datagram(&sample_header(Kind::KeyRequest), &[8; 48]);
    request[6] = 1;
    let frames: Vec<Vec<u8>> = [sealed, request].iter().map(|one| udp_frame(one)).collect();
    let file = capture(&folder, &frames);
    let fields = [
        "hil.kind",
        "hil.seal.generation",
        "hil.seal.number",
        "hil.seal.payload",
        "hil.tag",
        "hil.sync.t1_ns",
        "hil.seal.salt",
        "hil.expert.malformed",
    ];
    let packets = tshark(&file, &["-X", &dissector()], &fields);
    let (payload, tag, salt) = ("07".repeat(80), "07".repeat(16), "08".repeat(16));
    let shown = |index: usize| fields.map(|field| packets[index][field].as_str());
    assert_eq!(shown(0), ["3", "3", "9", &payload, &tag, "", "", ""]);
    assert_eq!(shown(1), ["7", "0", "0", "", "", "", &salt, ""]);
}

#[test]
fn the_dissector_marks_what_is_not_as_it_must_be_and_leaves_others_alone() {
    if !has_tshark() {
        return;
    }
    let folder = RunFolder::new("dissector-broken");
    let hello = datagram(&sample_header(Kind::Hello), &[1; 41]);
    let mut newer = datagram(&sample_header(Kind::Bye), &[]);
    newer[4] = 3;
    let frames = [
        hello,
        newer,
        b"HILX is something else".to_vec(),
        vec![0x48, 0x49],
    ];
    let frames: Vec<Vec<u8>> = frames.iter().map(|bytes| udp_frame(bytes)).collect();
    let file = capture(&folder, &frames);
    let fields = ["hil.magic", "hil.expert.malformed", "hil.expert.version"];
    let packets = tshark(&file, &["-X", &dissector()], &fields);
    let seen: Vec<[bool; 3]> = packets
        .iter()
        .map(|packet| fields.map(|field| !packet.get(field).is_none_or(String::is_empty)))
        .collect();
    assert_eq!(
        seen,
        [
            [true, true, false],
            [true, false, true],
            [false; 3],
            [false; 3]
        ]
    );
}

#[test]
fn wireshark_reads_our_captures_to_the_nanosecond() {
    if !has_tshark() {
        return;
    }
    let folder = RunFolder::new("dissector-stamps");
    let frames = vec![udp_frame(b"one"), udp_frame(b"two")];
    let file = capture(&folder, &frames);
    let fields = [
        "frame.time_epoch",
        "frame.interface_name",
        "frame.packet_flags_direction",
    ];
    let packets = tshark(&file, &[], &fields);
    assert_eq!(packets[0]["frame.time_epoch"], "1790000000.123456789");
    assert_eq!(packets[1]["frame.time_epoch"], "1790000000.123457789");
    assert_eq!(packets[1]["frame.interface_name"], "lan1");
    let direction = &packets[0]["frame.packet_flags_direction"];
    assert!(direction == "0x00000002" || direction == "2", "{direction}");
    let information = run(Command::new("capinfos").arg(&file), LIMIT)
        .unwrap()
        .stdout;
    assert!(information.contains("nanoseconds"), "{information}");
    assert!(information.contains("dissector test"), "{information}");
}

#[test]
fn an_et2000_capture_gives_tshark_and_us_the_same_ports_and_stamps() {
    let folder = RunFolder::new("dissector-esl");
    let mut frames = Vec::new();
    let mut expected = Vec::new();
    for port in 0..esl::PORT_COUNT {
        let index = usize::from(port);
        let header = EslHeader {
            flags: esl::FLAG_BITS[index] | esl::STAMP_ENABLED,
            stamp_ns: 0x0000_0012_3456_7800 + 1_000_001 * u64::from(port),
        };
        let inner = udp_frame(&datagram(&sample_header(Kind::Bye), &[]));
        let header_bytes = header.encode().to_vec();
        let parts = if port % 2 == 0 {
            [header_bytes, inner]
        } else {
            [inner, header_bytes]
        };
        frames.push(parts.concat());
        expected.push((u64::from(port), header.stamp_ns));
    }
    let file = capture(&folder, &frames);

    let bytes = fs::read(&file).unwrap();
    let mut reader = CaptureReader::default();
    reader.feed(&bytes);
    reader.end();
    let mut ours = Vec::new();
    while let Step::Packet(packet) = reader.next_step() {
        let (header, _) = esl::split(packet.data).unwrap();
        ours.push((u64::from(header.port().unwrap()), header.stamp_ns));
    }
    assert_eq!(ours, expected);

    let mut command = Command::new(hil_runtime_binary());
    command.args(["probe", "analyse", "--json"]).arg(&file);
    let report: serde_json::Value = serde_json::from_str(
        &command
            .output()
            .map(|out| String::from_utf8(out.stdout).unwrap())
            .unwrap(),
    )
    .unwrap();
    let points = report["points"].as_array().unwrap();
    assert_eq!(points.len(), expected.len());
    for (point, (port, stamp_ns)) in points.iter().zip(&expected) {
        let name = point["point"].as_str().unwrap();
        assert!(name.contains(&format!(":port{port}")), "{name}");
        assert_eq!(point["figures"]["first_ns"], *stamp_ns);
    }

    if !has_tshark() {
        return;
    }
    let fields = ["esl.port", "esl.timestamp", "ip.dst"];
    let packets = tshark(&file, &["--enable-heuristic", "esl_eth"], &fields);
    let theirs: Vec<(u64, u64)> = packets
        .iter()
        .map(|packet| {
            let stamp = packet["esl.timestamp"].trim_start_matches("0x");
            (
                packet["esl.port"].parse().unwrap(),
                u64::from_str_radix(stamp, 16).unwrap(),
            )
        })
        .collect();
    assert_eq!(theirs, expected);
    assert!(packets.iter().all(|packet| packet["ip.dst"] == "10.77.0.2"));
}
