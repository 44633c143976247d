//! Tests of the two bridges together.
