//! Seeds of traces and motion files.

use hil_teleoperation::swing::swing_bvh;
use hil_trace::{Trace, TraceFate, TraceRecord, csv, wire};

use super::{behind, numbered};
use crate::Seed;
use crate::trace::header;

fn trace(count: u64) -> Trace {
    let records = (0..count).map(|index| {
        let at_ns = i64::try_from(index).unwrap_or(0) * 10_000_000;
        let record = TraceRecord::published(at_ns, index, 64);
        match index % 4 {
            3 => TraceRecord {
                fate: TraceFate::LostInNetwork,
                ..record
            },
            _ => record.delivered(1_000_000 + at_ns / 7, 500),
        }
    });
    Trace {
        header: header("egm/right/command"),
        records: records.collect(),
    }
}

pub(crate) fn traces() -> Vec<Seed> {
    let encoded = [1, 5].map(|count| wire::encode(&trace(count)).unwrap_or_default());
    let cut = encoded[1][..encoded[1].len() - 20].to_vec();
    let inputs = [
        behind(1, &encoded[0]),
        behind(0xa1, &encoded[1]),
        behind(2, &encoded[1]),
        behind(0, &cut),
    ];
    numbered("trace", inputs)
}

pub(crate) fn trace_texts() -> Vec<Seed> {
    let own = csv::encode(&trace(5)).into_bytes();
    let two = b"departure_ns,delay_ns\n0,5\n10,\n20,7000000\n".to_vec();
    let words = b"# arrival: consumer\n# record_count: 1\nfate,published_ns,size_bytes\nlost,5,9\n";
    numbered("text", [own, two, words.to_vec()])
}

pub(crate) fn opportunities() -> Vec<Seed> {
    let inputs = ["0\n0\n4\n10\n", "17\n17\n204\n99999\n", "\n5\n  6\r\n"];
    numbered("opportunities", inputs.map(|text| text.as_bytes().to_vec()))
}

pub(crate) fn motions() -> Vec<Seed> {
    let swing = swing_bvh(0.5, 0.1, 10.0).unwrap_or_default().into_bytes();
    let small = "HIERARCHY\nROOT Hips\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition \
                 Zrotation Xrotation Yrotation\n JOINT Hand\n {\n  OFFSET 0 1.5 0\n  CHANNELS 3 \
                 Zrotation Xrotation Yrotation\n  End Site\n  {\n   OFFSET 0 1 0\n  }\n }\n}\nMOTION\n\
                 Frames: 2\nFrame Time: 0.008\n0 1 0 0 0 0 1 2 3\n0 1 0 0 0 0 4 5 6e-3\n";
    numbered("motion", [swing, small.as_bytes().to_vec()])
}
