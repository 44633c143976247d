//! Processes killed at random moments, start-up included.
