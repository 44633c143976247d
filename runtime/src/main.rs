//! The `hil-runtime` binary with the shipped case studies.
fn main() {}
