//! Motion files.

use hil_core::text_file::TextFile;
use hil_teleoperation::bvh::Bvh;

use crate::Verdict;

/// A motion that is read can be written and read again: the same joints and channels, as many
/// frames, and from then on the same text.
pub(crate) fn bvh(bytes: &[u8]) -> Verdict {
    let Ok(text) = TextFile::decode(bytes) else {
        return Verdict::Refused;
    };
    match Bvh::parse(&text) {
        Ok(motion) => {
            assert!(motion.frame_count() > 0 && motion.frame_time_s > 0.0);
            assert!(motion.values.iter().all(|value| value.is_finite()));
            let written = motion.to_text();
            let again = Bvh::parse(&written.as_str().into());
            // Nine decimals make nothing of a shorter time.
            if motion.frame_time_s >= 1e-9 {
                let again = again.unwrap_or_else(|fault| panic!("{fault} in\n{written}"));
                assert_eq!(
                    again.skeleton.joints().len(),
                    motion.skeleton.joints().len()
                );
                assert_eq!(
                    again.skeleton.channel_count(),
                    motion.skeleton.channel_count()
                );
                assert_eq!(again.frame_count(), motion.frame_count());
            }
            Verdict::Accepted
        }
        Err(fault) => {
            assert!(fault.line <= text.end().number, "a line beyond the end");
            assert!(fault.offset <= bytes.len() as u64, "a byte beyond the end");
            assert!(!fault.problem.to_string().is_empty());
            Verdict::Refused
        }
    }
}
