//! What happens to the robot of a live run: events that its case finds in the messages which processes of
//! this host record.

use std::cmp::Reverse;
use std::path::Path;
use std::time::Duration;

use hil_core::score::{LiveEvents, ScoreEvent};
use hil_core::time::Instant;

use super::view::{RobotEventRow, RobotView};
use crate::RecordFollower;

/// Events that are kept to be shown.
const SHOWN_MAX: usize = 8;
/// Bytes of records read at once, and the span of the run judged at once: a run that has gone for long is caught up
/// with step by step, between which other things are done.
const STEP_BYTES_MAX: usize = 1 << 20;
const STEP_SPAN: Duration = Duration::from_secs(10);

/// The events of one run's robot, from its beginning on.
#[derive(Debug)]
pub(super) struct RobotWatch {
    follower: RecordFollower,
    events: Box<dyn LiveEvents>,
    /// Publication of the newest message read.
    newest: Option<Instant>,
    /// Until when the events were taken.
    judged_until: Option<Instant>,
    /// More is written than was read.
    has_unread: bool,
    is_behind: bool,
    recent: Vec<ScoreEvent>,
    count: u64,
    problems: Vec<String>,
}

impl RobotWatch {
    /// Those that `events` finds in the record files of `folder`.
    pub(super) fn new(folder: &Path, events: Box<dyn LiveEvents>) -> Self {
        Self {
            follower: RecordFollower::new(folder).with_messages_of(events.channels()),
            events,
            newest: None,
            judged_until: None,
            has_unread: true,
            is_behind: true,
            recent: Vec::with_capacity(SHOWN_MAX + 1),
            count: 0,
            problems: Vec::new(),
        }
    }

    /// Takes a step towards `now`.
    pub(super) fn step(&mut self, now: Instant) {
        // What was read is judged before more is.
        if self.judged_until >= self.newest.map(|newest| newest.min(now)) {
            self.read();
        }
        let Some((newest, judged_until)) = self.newest.zip(self.judged_until) else {
            self.is_behind = self.has_unread;
            return;
        };
        // What is not read yet is later than what is.
        let known_until = if self.has_unread { newest } else { now };
        let until = known_until.min(judged_until + STEP_SPAN);
        self.is_behind = self.has_unread || until < known_until;
        self.judged_until = Some(until.max(judged_until));
        for event in self.events.take(until) {
            self.count += 1;
            self.keep(event);
        }
    }

    fn read(&mut self) {
        let Self {
            follower,
            events,
            newest,
            judged_until,
            ..
        } = self;
        self.has_unread = follower.poll(STEP_BYTES_MAX, &mut |batch| {
            for (envelope, payload) in batch.messages() {
                let at = Instant::from_ns(envelope.published_ns);
                *newest = (*newest).max(Some(at));
                judged_until.get_or_insert(at);
                events.hear(&batch.header.channel, at, payload);
            }
        });
        self.problems.extend(self.follower.take_problems());
    }

    /// Record files that cannot be read, and why.
    pub(super) fn problems(&self) -> &[String] {
        &self.problems
    }

    /// What was found in a run that began at `start`; `None` while none of the messages is recorded on this
    /// host.
    pub(super) fn look(&self, start: Option<Instant>) -> Option<RobotView> {
        let mut recent = self.recent.clone();
        recent.sort_by_key(|event| Reverse(event.at));
        let row = |event: ScoreEvent| RobotEventRow {
            at_s: start.map(|start| event.at.seconds_since(start)),
            severity: event.severity,
            what: event.what,
        };
        self.newest.map(|_| RobotView {
            recent: recent.into_iter().map(row).collect(),
            event_count: self.count,
            is_behind: self.is_behind,
        })
    }

    /// Keeps an event, in place of the oldest of the least severe ones where there is no room.
    fn keep(&mut self, event: ScoreEvent) {
        self.recent.push(event);
        let events = self.recent.iter().enumerate();
        let least = events.min_by_key(|(_, event)| (event.severity, event.at));
        if let Some((index, _)) = least.filter(|_| self.recent.len() > SHOWN_MAX) {
            self.recent.swap_remove(index);
        }
    }
}

#[cfg(test)]
mod tests {
    use hil_core::score::Severity;

    use super::*;
    use crate::tests::{append, header};
    use hil_core::message::Envelope;
    use hil_rundir::record::RecordKind;

    /// An event for each message but the first.
    #[derive(Debug, Default)]
    struct Each(Vec<ScoreEvent>, u64);

    impl LiveEvents for Each {
        fn channels(&self) -> &'static [&'static str] {
            &["a/b"]
        }

        fn hear(&mut self, channel: &str, at: Instant, payload: &[u8]) {
            let what = format!("{channel} {}", payload[0]);
            let severity = match payload[0] {
                2 => Severity::Hazard,
                _ => Severity::Notice,
            };
            if self.1 > 0 {
                self.0.push(ScoreEvent::new(severity, at, "a/b", what));
            }
            self.1 += 1;
        }

        fn take(&mut self, now: Instant) -> Vec<ScoreEvent> {
            let waiting = core::mem::take(&mut self.0);
            let (told, kept) = waiting.into_iter().partition(|event| event.at <= now);
            self.0 = kept;
            told
        }
    }

    /// Messages of one byte, numbered, published a nanosecond after one another.
    fn write_messages(folder: &Path, channel: &str, count: u8) {
        let header = header(RecordKind::Message, channel, size_of::<Envelope>() + 1);
        for number in 0..count {
            let envelope = Envelope {
                sequence: u64::from(number),
                published_ns: i64::from(number),
                ..Envelope::default()
            };
            let bytes = [bytemuck::bytes_of(&envelope), &[number]].concat();
            append(folder, &header, "robot", &bytes);
        }
    }

    #[test]
    fn events_are_found_from_the_beginning_in_the_channels_of_the_case_only() {
        let folder = std::env::temp_dir().join(format!("hil-robot-watch-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let mut watch = RobotWatch::new(&folder, Box::<Each>::default());
        watch.step(Instant::ZERO);
        assert_eq!(watch.look(None), None);
        write_messages(&folder, "a/other", 30);
        write_messages(&folder, "a/b", 20);
        watch.follower.look_again();
        watch.step(Instant::from_ns(11));
        let look = watch.look(None).unwrap();
        assert_eq!((look.event_count, look.recent.len()), (11, SHOWN_MAX));
        assert_eq!(look.recent[0].what, "a/b 11");
        // The one of more weight stays.
        assert_eq!(look.recent[SHOWN_MAX - 1].what, "a/b 2");
        assert!(!look.is_behind);
        watch.step(Instant::from_ns(100));
        assert_eq!(watch.look(None).unwrap().event_count, 19);
        assert!(watch.problems().is_empty());
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_long_past_is_caught_up_with_in_steps_and_a_foreign_file_is_a_problem() {
        let name = format!("hil-robot-watch-steps-{}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&folder).unwrap();
        write_messages(&folder, "a/b", 20);
        std::fs::write(folder.join("a.b.message.robot.1.rec"), [7; 200]).unwrap();
        let mut watch = RobotWatch::new(&folder, Box::<Each>::default());
        let now = Instant::ZERO + 3 * STEP_SPAN;
        let mut steps = [0; 4].map(|_| {
            watch.step(now);
            watch.look(None).unwrap().is_behind
        });
        assert_eq!(steps, [true, true, false, false]);
        assert_eq!(watch.problems().len(), 1);
        // What is written faster than it is read leaves it behind.
        let record_bytes = size_of::<Envelope>() + 1;
        let header = header(RecordKind::Message, "a/b", record_bytes);
        let later = vec![0; 2 * STEP_BYTES_MAX / record_bytes * record_bytes];
        append(&folder, &header, "robot", &later);
        steps = [0; 4].map(|_| {
            watch.step(now);
            watch.look(None).unwrap().is_behind
        });
        assert!(steps[0]);
        assert!(!steps[3]);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
