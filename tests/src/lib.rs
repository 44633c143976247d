//! Shared by the tests that cross crate and process borders.
