//! The corpus: inputs made by the product's own encoders, so that a search begins behind the first
//! checks. Every run makes the same bytes. The folders are written by `make_corpus`.

mod files;
mod network;
#[cfg(feature = "recorder")]
mod recorder;
#[cfg(feature = "runtime")]
mod runtime;

pub(crate) use files::{motions, opportunities, trace_texts, traces};
pub(crate) use network::{
    captures, control_messages, conversations, datagrams, egm_datagrams, egm_sessions, frames,
    reassembly, tcp_streams,
};
#[cfg(feature = "recorder")]
pub(crate) use recorder::{recorded_messages, recordings, viewer_requests};
#[cfg(feature = "runtime")]
pub(crate) use runtime::{
    layouts, peer_frames, radio_answers, record_files, summaries, topologies, words,
};

use crate::Seed;

/// Names each of `inputs` by its place.
fn numbered(name: &str, inputs: impl IntoIterator<Item = Vec<u8>>) -> Vec<Seed> {
    let numbered = inputs.into_iter().enumerate();
    numbered
        .map(|(index, bytes)| (format!("{name}-{index:02}"), bytes))
        .collect()
}

/// `bytes` behind one byte that says how they are to be taken.
fn behind(mode: u8, bytes: &[u8]) -> Vec<u8> {
    [&[mode][..], bytes].concat()
}
