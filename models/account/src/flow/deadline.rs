//! Requests and their answers: whether each came back in time, and if not, whose time it took. The answer to a request
//! is the first frame that the other program sent back after it was given the request and before it was given the
//! next, since what programs say is not read. Times of two hosts are never compared: a request and its answer are timed where the
//! request began, and the program between them where it ran.

use hil_stats::histogram::Distribution;
use serde::{Deserialize, Serialize};

/// A frame between two programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FramePassage {
    /// When the program sent it, on its host's clock.
    pub sent_ns: i64,
    /// What became of it.
    pub end: FrameEnd,
}

/// What became of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameEnd {
    /// The other program's interface was given it, by the clock of that host.
    Given(i64),
    /// The network lost it.
    LostByNetwork,
    /// A host lost it.
    LostByHarness,
    /// Unknown, as of one under way at the end.
    Unknown,
}

/// How the requests of a flow were answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeadlineMetrics {
    /// The flow.
    pub name: String,
    /// What was allowed from sending a request until its answer was given, nanoseconds.
    pub limit_ns: i64,
    /// Requests.
    pub request_count: u64,
    /// Answered in time.
    pub in_time_count: u64,
    /// Answered late, of which the network took longer than allowed and the program did not.
    pub late_by_network_count: u64,
    /// Answered late, of which the program took longer than allowed and the network did not.
    pub late_by_program_count: u64,
    /// Answered late, where both took longer than allowed, or only both together.
    pub late_by_both_count: u64,
    /// The network lost the request or the answer.
    pub missing_by_network_count: u64,
    /// The program was given the request and sent nothing before it was given the next.
    pub missing_by_program_count: u64,
    /// A host lost the request or the answer.
    pub missing_by_harness_count: u64,
    /// Unknown: under way at the end of the run, or without records.
    pub unknown_count: u64,
    /// From sending a request until its answer was given.
    pub response: Distribution,
    /// Of that, between the request's arrival and the sending of the answer.
    pub program: Distribution,
}

/// Pairs requests with answers, for each pair of ends.
#[derive(Debug)]
pub struct DeadlineFold {
    metrics: DeadlineMetrics,
    responses_ns: Vec<i64>,
    programs_ns: Vec<i64>,
}

impl DeadlineFold {
    /// Of the flow `name`, whose answers must come within `limit_ns`.
    pub fn new(name: &str, limit_ns: i64) -> Self {
        Self {
            metrics: DeadlineMetrics {
                name: name.to_owned(),
                limit_ns,
                request_count: 0,
                in_time_count: 0,
                late_by_network_count: 0,
                late_by_program_count: 0,
                late_by_both_count: 0,
                missing_by_network_count: 0,
                missing_by_program_count: 0,
                missing_by_harness_count: 0,
                unknown_count: 0,
                response: Distribution::of_samples(&[], NO_ANSWER),
                program: Distribution::of_samples(&[], NO_ANSWER),
            },
            responses_ns: Vec::new(),
            programs_ns: Vec::new(),
        }
    }

    /// Adds the `requests` of two ends and the frames that go back between these, in order of their sending.
    pub fn add(&mut self, requests: &[FramePassage], answers: &[FramePassage]) {
        // The last moment of which the requesting program's host knows.
        let last_ns = requests.iter().map(|request| request.sent_ns).max();
        let mut given = Vec::new();
        for request in requests {
            self.metrics.request_count += 1;
            match request.end {
                FrameEnd::Given(given_ns) => given.push((given_ns, request.sent_ns)),
                end => self.metrics.add_missing(end),
            }
        }
        given.sort_unstable();
        for (index, &(given_ns, sent_ns)) in given.iter().enumerate() {
            let first = answers.partition_point(|answer| answer.sent_ns < given_ns);
            let next_ns = given.get(index + 1).map(|(next_ns, _)| *next_ns);
            let is_its = |answer: &&FramePassage| next_ns.is_none_or(|ns| answer.sent_ns < ns);
            if let Some(answer) = answers.get(first).filter(is_its) {
                self.add_answered([sent_ns, given_ns], answer);
                continue;
            }
            let waited_ns = last_ns.map_or(0, |ns| ns.saturating_sub(sent_ns));
            if next_ns.is_some() || waited_ns >= self.metrics.limit_ns {
                self.metrics.missing_by_program_count += 1;
            } else {
                self.metrics.unknown_count += 1;
            }
        }
    }

    /// Adds requests that no frame answers by its ends, as those to many.
    pub fn add_unanswerable(&mut self, requests: &[FramePassage]) {
        self.metrics.request_count += requests.len() as u64;
        self.metrics.unknown_count += requests.len() as u64;
    }

    fn add_answered(&mut self, [sent_ns, given_ns]: [i64; 2], answer: &FramePassage) {
        let metrics = &mut self.metrics;
        let back_ns = match answer.end {
            FrameEnd::Given(back_ns) => back_ns,
            end => return metrics.add_missing(end),
        };
        let response_ns = back_ns.saturating_sub(sent_ns);
        let program_ns = answer.sent_ns.saturating_sub(given_ns);
        self.responses_ns.push(response_ns);
        self.programs_ns.push(program_ns);
        let is_long = |ns: i64| ns > metrics.limit_ns;
        let network_ns = response_ns.saturating_sub(program_ns);
        let (program, network) = (is_long(program_ns), is_long(network_ns));
        let count = match (is_long(response_ns), network, program) {
            (false, ..) => &mut metrics.in_time_count,
            (true, true, false) => &mut metrics.late_by_network_count,
            (true, false, true) => &mut metrics.late_by_program_count,
            (true, ..) => &mut metrics.late_by_both_count,
        };
        *count += 1;
    }

    /// What it comes to.
    pub fn finish(self) -> DeadlineMetrics {
        DeadlineMetrics {
            response: Distribution::of_samples(&self.responses_ns, NO_ANSWER),
            program: Distribution::of_samples(&self.programs_ns, NO_ANSWER),
            ..self.metrics
        }
    }
}

impl DeadlineMetrics {
    /// An inlet lost frames, of which answers may have been.
    pub fn doubt_program(&mut self) {
        self.unknown_count += core::mem::take(&mut self.missing_by_program_count);
    }

    fn add_missing(&mut self, end: FrameEnd) {
        *match end {
            FrameEnd::LostByNetwork => &mut self.missing_by_network_count,
            FrameEnd::LostByHarness => &mut self.missing_by_harness_count,
            FrameEnd::Given(_) | FrameEnd::Unknown => &mut self.unknown_count,
        } += 1;
    }
}

const NO_ANSWER: &str = "no request was answered";

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    /// What the clock of the answering host is ahead, which changes no figure.
    const AHEAD_NS: i64 = 77_777 * MS;

    fn request(at_ms: i64, there_ms: i64) -> FramePassage {
        FramePassage {
            sent_ns: at_ms * MS,
            end: FrameEnd::Given((at_ms + there_ms) * MS + AHEAD_NS),
        }
    }

    fn answer(at_ms: i64, back_ms: i64) -> FramePassage {
        FramePassage {
            sent_ns: at_ms * MS + AHEAD_NS,
            end: FrameEnd::Given((at_ms + back_ms) * MS),
        }
    }

    fn lost(frame: FramePassage, end: FrameEnd) -> FramePassage {
        FramePassage { end, ..frame }
    }

    fn folded(
        limit_ns: i64,
        requests: &[FramePassage],
        answers: &[FramePassage],
    ) -> DeadlineMetrics {
        let mut fold = DeadlineFold::new("command", limit_ns);
        fold.add(requests, answers);
        fold.finish()
    }

    #[test]
    fn each_request_has_one_fate_and_the_late_ones_a_cause() {
        let requests = [
            request(0, 1),
            request(100, 5),
            request(200, 1),
            request(300, 5),
            lost(request(400, 1), FrameEnd::LostByNetwork),
            request(500, 1),
            lost(request(600, 1), FrameEnd::LostByHarness),
            request(700, 2),
            request(800, 1),
            request(900, 1),
        ];
        let answers = [
            answer(2, 1),   // in time
            answer(105, 1), // late: 6 ms over the network
            answer(206, 1), // late: 5 ms in the program
            answer(310, 1), // late: 5 ms there, 5 ms in the program
            lost(answer(502, 1), FrameEnd::LostByNetwork),
            answer(704, 2), // late: 4 ms and 2 ms, neither too long alone
        ];
        let found = folded(4 * MS, &requests, &answers);
        let counts = [
            found.request_count,
            found.in_time_count,
            found.late_by_network_count,
            found.late_by_program_count,
            found.late_by_both_count,
            found.missing_by_network_count,
            found.missing_by_harness_count,
            found.missing_by_program_count,
            found.unknown_count,
        ];
        // The last request may still be answered when the run ends.
        assert_eq!(counts, [10, 1, 1, 1, 2, 2, 1, 1, 1]);
        assert_eq!(found.response.measured().unwrap().max_ns, 11 * MS);
        assert_eq!(found.program.measured().unwrap().max_ns, 5 * MS);
    }

    #[test]
    fn an_answer_serves_the_newest_request_that_was_given_before_it() {
        let requests = [request(0, 1), request(4, 1), request(8, 1)];
        let found = folded(
            4 * MS,
            &requests,
            &[answer(6, 1), answer(7, 1), answer(10, 1)],
        );
        let counts = [found.missing_by_program_count, found.in_time_count];
        assert_eq!(counts, [1, 2]);
        assert_eq!(found.response.measured().unwrap().max_ns, 3 * MS);
        let mut fold = DeadlineFold::new("to many", MS);
        fold.add_unanswerable(&requests);
        assert_eq!(fold.finish().unknown_count, 3);
    }

    #[test]
    fn without_answers_nothing_is_made_up() {
        let found = folded(MS, &[request(0, 1), request(10, 1)], &[]);
        assert_eq!(
            (found.missing_by_program_count, found.unknown_count),
            (1, 1)
        );
        assert!(found.response.measured().is_none());
        assert_eq!(folded(MS, &[], &[]).request_count, 0);
    }
}
