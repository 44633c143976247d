//! What a reader must be warned of the user's own programs: that one was silent, and what the witness beside them says
//! of its records. Of such a program nothing counts ticks, so its silence is told by its messages alone.

use hil_account::{ChannelAccount, ProducerSilence};
use hil_platform::text::grouped;
use hil_present::units::duration;
use hil_rundir::event::{EventKind, ProcessKind};
use hil_rundir::run_result::RunResult;

/// How long the producer of a channel was silent, and when.
pub(super) fn silence_words(silence: &ProducerSilence) -> String {
    let until = if silence.is_open {
        ", until the end of the run"
    } else {
        ""
    };
    format!(
        "{} from {} into the run on, after message {}{until}; nine of ten messages came within {} of the one before",
        duration(silence.length_ns),
        duration(silence.start_ns),
        grouped(silence.after_sequence),
        duration(silence.period_p90_ns),
    )
}

/// The warning of a channel that `program` publishes; `None` where it went on as usual, and where the silence is an
/// interruption of the program, which is an event of the run.
pub(super) fn silence_warning(
    channel: &str,
    program: &str,
    account: &ChannelAccount,
) -> Option<String> {
    let silence = account.gaps.producer.filter(ProducerSilence::is_long)?;
    let mut interruptions = account.interruptions.iter();
    if interruptions.any(|one| one.process == program) {
        return None;
    }
    Some(format!(
        "{program} sent nothing on {channel} for {}",
        silence_words(&silence)
    ))
}

/// What the witnesses say of the records that they write.
pub(super) fn witness_warnings(result: &RunResult) -> Vec<String> {
    let is_witness = |name: &str| {
        let mut processes = result.processes.iter();
        processes.any(|one| one.name == name && one.kind == ProcessKind::Witness)
    };
    let events = result.events.iter().filter(|one| is_witness(&one.process));
    let texts = events.filter_map(|event| match &event.kind {
        EventKind::Warning { text } => Some(text.clone()),
        _ => None,
    });
    texts.collect()
}

#[cfg(test)]
mod tests {
    use hil_account::synthetic::{Files, Written, same_clock};
    use hil_account::{Interruption, MessageFate, PathProcess, account};
    use hil_core::time::Instant;

    use super::*;

    const MS: i64 = 1_000_000;

    /// 100 messages, one every 10 ms, in a run of 6 s.
    fn files() -> Files {
        let mut files = Files::default();
        for sequence in 0..100 {
            let written = Written {
                epoch: 1,
                sequence,
                published_ns: sequence.cast_signed() * 10 * MS,
            };
            files.write(written, MessageFate::Taken);
        }
        files
    }

    #[test]
    fn a_program_that_stops_is_warned_of_and_one_that_was_down_is_an_event_already() {
        let of = |interruptions: &[Interruption], end_ms: i64| {
            let context = same_clock(end_ms * MS).with_interruptions(interruptions);
            let account = account(&files().records(), &context);
            silence_warning("cart/command", "controller", &account)
        };
        // The last message left at 990 ms.
        let warning = of(&[], 6_000).unwrap();
        let begin = "controller sent nothing on cart/command for 5.01\u{a0}s from 990\u{a0}ms into the run on, after \
                     message 99, until the end of the run;";
        assert!(warning.starts_with(begin), "{warning}");
        assert_eq!(of(&[], 1_000), None);
        let down = Interruption {
            process: "controller".to_owned(),
            place: PathProcess::Producer,
            from: Instant::from_ns(990 * MS),
            until: Instant::from_ns(6_000 * MS),
            cause: "killed".to_owned(),
        };
        assert_eq!(of(&[down], 6_000), None);
    }
}
