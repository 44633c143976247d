//! tmp
use crate::fleet::Fleet;
use crate::run_log::RunLog;
use crate::score::Score;
pub(crate) fn score(_f: &Fleet, _l: &RunLog) -> Score {
    Score::default()
}
