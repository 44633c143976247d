//! Searches for an input that `peer_frames` of hil-decoders does not keep its promises for.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    hil_decoders::target("peer_frames").check(input);
});
