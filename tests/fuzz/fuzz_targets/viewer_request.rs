//! Searches for an input that `viewer_request` of hil-decoders does not keep its promises for.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    hil_decoders::target("viewer_request").check(input);
});
