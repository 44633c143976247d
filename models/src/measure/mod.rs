//! Measures: from raw stamps to segments, histograms and intervals. It opens no file.

pub mod record;
