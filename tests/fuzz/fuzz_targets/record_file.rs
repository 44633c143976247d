//! Searches for an input that `record_file` of hil-decoders does not keep its promises for.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    hil_decoders::target("record_file").check(input);
});
