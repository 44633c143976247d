//! What a case study is written with.

pub use core::time::Duration;

pub use crate::case_study::{
    CaseStudy, ChannelSpec, ErrorSeries, Harm, Metric, ParameterError, Score,
};
pub use crate::component::{Component, Output, Role, Timer};
pub use crate::run_log::RunLog;
pub use crate::time::{Instant, Tick};
