//! Tests of the capture decoders.
