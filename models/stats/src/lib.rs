//! Statistics: histograms, intervals, series and comparisons of samples. It knows neither messages
//! nor links.
#![forbid(unsafe_code)]

pub mod bounds;
pub mod comparison;
pub mod correlation;
pub mod dependence;
pub mod goodness;
pub mod histogram;
pub mod in_order;
pub mod metric;
pub mod recorded;
pub mod reordering;
pub mod samples;
pub mod series;
pub mod special;
pub mod statistics;
