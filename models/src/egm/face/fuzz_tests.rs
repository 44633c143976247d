//! Mutated datagrams.
