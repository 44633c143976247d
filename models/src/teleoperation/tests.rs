//! The whole case: hours of motion in virtual time.
