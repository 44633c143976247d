//! Measures: from raw stamps to segments, histograms and intervals. It opens no file.
//!
//! [`record`] is what processes write, [`account`] joins it into one latency account per channel,
//! [`network`] says in the field's terms what the network did, [`correlation`] asks whether the
//! robot followed, [`histogram`] and [`statistics`] turn samples into figures with intervals.

pub mod account;
pub mod card_clock;
pub mod comparison;
pub mod correlation;
pub mod histogram;
pub(crate) mod in_order;
pub mod network;
pub(crate) mod packed;
pub mod radio;
pub mod record;
pub(crate) mod resampling;
pub(crate) mod samples;
pub(crate) mod series;
pub(crate) mod special;
pub mod statistics;
