//! Requests and their answers: whether each came back in time, and if not, whose time it took. What programs say is
//! not read: frames that the other program sends back between two requests answer, in order, as many of those that
//! it was given before and has not answered, the newest ones where they are fewer. Times of two hosts are never compared: a request and its answer are timed where the
//! request began, and the program between them where it ran.

use std::collections::VecDeque;

use hil_core::interval::Spread;
use hil_stats::dependence::Batches;
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
    /// The other program's interface was given it.
    Given {
        /// When, on the clock of that host, nanoseconds.
        at_ns: i64,
        /// What the hosts took of its time, see [`MessageHistory::host_time_ns`](crate::MessageHistory::host_time_ns).
        host_ns: i64,
    },
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
    /// Answered late, but in time without what processes and timers of the hosts took.
    #[serde(default)]
    pub late_by_harness_count: u64,
    /// Answered late, of which the network took longer than allowed and the program did not.
    pub late_by_network_count: u64,
    /// Answered late, of which the program took longer than allowed and the network did not.
    pub late_by_program_count: u64,
    /// Answered late, where both took longer than allowed, or only both together.
    pub late_by_both_count: u64,
    /// The network lost the request or the answer.
    pub missing_by_network_count: u64,
    /// The program was given the request and answered later ones, or nothing any more.
    pub missing_by_program_count: u64,
    /// A host lost the request or the answer.
    pub missing_by_harness_count: u64,
    /// Unknown: under way at the end of the run, or without records.
    pub unknown_count: u64,
    /// Those that came late or not at all, and would have come in time but for the network: what programs and hosts
    /// took of their time is within what is allowed, or the network lost them.
    pub hurt_count: u64,
    /// 95 % interval of the share of those that the network hurt, see [`Self::hurt_count`], of those
    /// of which it is known; or why there is none.
    #[serde(default)]
    pub hurt_share: Option<Spread>,
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
    /// When each request was sent, and whether the network hurt it.
    hurt: Vec<(i64, bool)>,
    /// See [`Self::doubt_program`].
    is_program_doubted: bool,
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
                late_by_harness_count: 0,
                late_by_network_count: 0,
                late_by_program_count: 0,
                late_by_both_count: 0,
                missing_by_network_count: 0,
                missing_by_program_count: 0,
                missing_by_harness_count: 0,
                unknown_count: 0,
                hurt_count: 0,
                hurt_share: None,
                response: Distribution::of_samples(&[], NO_ANSWER),
                program: Distribution::of_samples(&[], NO_ANSWER),
            },
            responses_ns: Vec::new(),
            programs_ns: Vec::new(),
            hurt: Vec::new(),
            is_program_doubted: false,
        }
    }

    /// An inlet lost frames, of which answers may have been: requests without an answer are unknown from now on.
    pub const fn doubt_program(&mut self) {
        self.is_program_doubted = true;
    }

    /// Adds the `requests` of two ends and the frames that go back between these, in order of their sending.
    pub fn add(&mut self, requests: &[FramePassage], answers: &[FramePassage]) {
        // The last moment of which the requesting program's host knows.
        let last_ns = requests.iter().map(|request| request.sent_ns).max();
        let mut given = Vec::new();
        for request in requests {
            self.metrics.request_count += 1;
            match request.end {
                FrameEnd::Given { at_ns, host_ns } => given.push([at_ns, request.sent_ns, host_ns]),
                end => self.add_missing(request.sent_ns, end),
            }
        }
        given.sort_unstable();
        let mut waiting = VecDeque::new();
        for (index, &request) in given.iter().enumerate() {
            let [given_ns, ..] = request;
            waiting.push_back(request);
            let next_ns = given
                .get(index + 1)
                .map_or(i64::MAX, |[next_ns, ..]| *next_ns);
            let [first, end] =
                [given_ns, next_ns].map(|ns| answers.partition_point(|answer| answer.sent_ns < ns));
            let answered_count = waiting.len().min(end - first);
            let answered = waiting.drain(waiting.len() - answered_count..);
            for (request, answer) in answered.zip(&answers[first..]) {
                self.add_answered(request, answer);
            }
            if answered_count > 0 {
                // The program has answered later ones. What it answers of these after more than is allowed would be
                // its own delay, too.
                let limit_ns = self.metrics.limit_ns;
                let is_over = |[ns, ..]: &mut [i64; 3]| given_ns.saturating_sub(*ns) > limit_ns;
                while let Some([_, sent_ns, _]) = waiting.pop_front_if(is_over) {
                    self.add_unanswered(sent_ns);
                }
            }
        }
        for [_, sent_ns, _] in waiting {
            let waited_ns = last_ns.map_or(0, |ns| ns.saturating_sub(sent_ns));
            if waited_ns >= self.metrics.limit_ns {
                self.add_unanswered(sent_ns);
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

    fn add_answered(&mut self, [given_ns, sent_ns, host_ns]: [i64; 3], answer: &FramePassage) {
        let (back_ns, host_ns) = match answer.end {
            FrameEnd::Given {
                at_ns,
                host_ns: back,
            } => (at_ns, host_ns.saturating_add(back)),
            end => return self.add_missing(sent_ns, end),
        };
        let metrics = &mut self.metrics;
        let response_ns = back_ns.saturating_sub(sent_ns);
        let program_ns = answer.sent_ns.saturating_sub(given_ns);
        self.responses_ns.push(response_ns);
        self.programs_ns.push(program_ns);
        let is_long = |ns: i64| ns > metrics.limit_ns;
        let without_hosts_ns = response_ns.saturating_sub(host_ns);
        let network_ns = without_hosts_ns.saturating_sub(program_ns);
        let is_hurt = is_long(response_ns) && !is_long(response_ns.saturating_sub(network_ns));
        let count = if !is_long(response_ns) {
            &mut metrics.in_time_count
        } else if !is_long(without_hosts_ns) {
            &mut metrics.late_by_harness_count
        } else {
            match (is_long(network_ns), is_long(program_ns)) {
                (true, false) => &mut metrics.late_by_network_count,
                (false, true) => &mut metrics.late_by_program_count,
                _ => &mut metrics.late_by_both_count,
            }
        };
        *count += 1;
        self.hurt.push((sent_ns, is_hurt));
    }

    /// Adds a request of which it, or its answer, was not given.
    fn add_missing(&mut self, sent_ns: i64, end: FrameEnd) {
        let (count, is_hurt) = match end {
            FrameEnd::LostByNetwork => (&mut self.metrics.missing_by_network_count, true),
            FrameEnd::LostByHarness => (&mut self.metrics.missing_by_harness_count, false),
            FrameEnd::Given { .. } | FrameEnd::Unknown => {
                self.metrics.unknown_count += 1;
                return;
            }
        };
        *count += 1;
        self.hurt.push((sent_ns, is_hurt));
    }

    fn add_unanswered(&mut self, sent_ns: i64) {
        if self.is_program_doubted {
            self.metrics.unknown_count += 1;
            return;
        }
        self.metrics.missing_by_program_count += 1;
        self.hurt.push((sent_ns, false));
    }

    /// What it comes to.
    pub fn finish(mut self) -> DeadlineMetrics {
        self.hurt.sort_unstable();
        let hurt = self.hurt.iter().map(|(_, is_hurt)| f64::from(*is_hurt));
        DeadlineMetrics {
            hurt_count: self.hurt.iter().filter(|(_, is_hurt)| *is_hurt).count() as u64,
            hurt_share: (!self.hurt.is_empty()).then(|| Batches::of(hurt).share_interval()),
            response: Distribution::of_samples(&self.responses_ns, NO_ANSWER),
            program: Distribution::of_samples(&self.programs_ns, NO_ANSWER),
            ..self.metrics
        }
    }
}

const NO_ANSWER: &str = "no request was answered";

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    /// What the clock of the answering host is ahead, which changes no figure.
    const AHEAD_NS: i64 = 77_777 * MS;

    const fn given(at_ns: i64) -> FrameEnd {
        FrameEnd::Given { at_ns, host_ns: 0 }
    }

    const fn request(at_ms: i64, there_ms: i64) -> FramePassage {
        FramePassage {
            sent_ns: at_ms * MS,
            end: given((at_ms + there_ms) * MS + AHEAD_NS),
        }
    }

    const fn answer(at_ms: i64, back_ms: i64) -> FramePassage {
        FramePassage {
            sent_ns: at_ms * MS + AHEAD_NS,
            end: given((at_ms + back_ms) * MS),
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
    fn answers_that_a_program_sends_together_after_a_pause_are_those_of_all_requests_of_the_pause()
    {
        let requests: Vec<FramePassage> = (0..8).map(|index| request(10 * index, 1)).collect();
        // The program stood still from the second request to after the seventh.
        let mut answers = vec![answer(1, 1)];
        answers.extend([62; 6].map(|at_ms| answer(at_ms, 1)));
        answers.push(answer(72, 1));
        let found = folded(20 * MS, &requests, &answers);
        assert_eq!(
            (found.missing_by_program_count, found.unknown_count),
            (0, 0)
        );
        assert_eq!((found.in_time_count, found.late_by_program_count), (4, 4));
        assert_eq!(found.response.measured().unwrap().max_ns, 53 * MS);
        // Of the pause only the newest is answered: the older ones never are.
        let skipped = [answers[0], answer(62, 1), answer(72, 1)];
        let found = folded(20 * MS, &requests, &skipped);
        assert_eq!(
            (found.missing_by_program_count, found.in_time_count),
            (5, 3)
        );
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
        // Of both that were late by both, the program alone took longer than allowed in one.
        assert_eq!(found.hurt_count, 4);
        assert_eq!(found.response.measured().unwrap().max_ns, 11 * MS);
        assert_eq!(found.program.measured().unwrap().max_ns, 5 * MS);
    }

    #[test]
    fn what_only_the_hosts_made_late_is_not_the_networks() {
        let on_hosts = |frame: FramePassage, host_ms: i64| {
            let FrameEnd::Given { at_ns, .. } = frame.end else {
                panic!("{frame:?}");
            };
            let host_ns = host_ms * MS;
            let end = FrameEnd::Given { at_ns, host_ns };
            FramePassage { end, ..frame }
        };
        let requests = [
            on_hosts(request(0, 4), 3),   // 6 ms, 5 of them on the hosts
            on_hosts(request(100, 9), 3), // 11 ms, 5 on the hosts, 6 over the network
            on_hosts(request(200, 4), 3), // 14 ms, 5 on the hosts, 8 in the program
            on_hosts(request(300, 1), 1), // in time
        ];
        let answers = [
            on_hosts(answer(4, 2), 2),
            on_hosts(answer(109, 2), 2),
            on_hosts(answer(212, 2), 2),
            answer(301, 1),
        ];
        let found = folded(4 * MS, &requests, &answers);
        let counts = [
            found.in_time_count,
            found.late_by_harness_count,
            found.late_by_network_count,
            found.late_by_program_count,
            found.late_by_both_count,
            found.hurt_count,
        ];
        // With 5 ms on the hosts the second would have been late without a network, too.
        assert_eq!(counts, [1, 1, 1, 1, 0, 0]);
    }

    #[test]
    fn fewer_answers_are_of_the_newest_requests_and_as_many_are_of_each() {
        let requests = [request(0, 1), request(4, 1), request(8, 1)];
        let counts = |answers: &[FramePassage]| {
            let found = folded(4 * MS, &requests, answers);
            let counts = [
                found.in_time_count,
                found.late_by_program_count,
                found.missing_by_program_count,
                found.unknown_count,
            ];
            (counts, found.response.measured().unwrap().max_ns)
        };
        let all = [answer(2, 1), answer(6, 1), answer(10, 1)];
        assert_eq!(counts(&all), ([3, 0, 0, 0], 3 * MS));
        assert_eq!(counts(&all[1..]), ([2, 0, 1, 0], 3 * MS));
        // Two at once are answered one by one: the first one late.
        let [one, other] = [answer(6, 1), answer(7, 1)];
        assert_eq!(counts(&[one, other, all[2]]), ([2, 1, 0, 0], 7 * MS));
        // More than there were requests are of the program's own accord.
        assert_eq!(
            counts(&[all[0], answer(3, 1), all[1], all[2]]),
            ([3, 0, 0, 0], 3 * MS)
        );
        assert_eq!(counts(&all[..2]), ([2, 0, 0, 1], 3 * MS));
    }

    #[test]
    fn requests_that_a_network_held_back_and_gave_at_once_are_no_silence_of_the_program() {
        let requests: Vec<_> = (0..10).map(|one| request(4 * one, 50 - 4 * one)).collect();
        let answers: Vec<_> = (0..10).map(|_| answer(51, 1)).collect();
        let found = folded(8 * MS, &requests, &answers);
        let counts = [found.late_by_network_count, found.missing_by_program_count];
        assert_eq!(counts, [10, 0]);
    }

    #[test]
    fn a_share_is_of_the_requests_of_which_it_is_known() {
        let every = |step: usize, end: FrameEnd| {
            let requests = (0..1000).map(|one| request(10 * one, 1));
            let lost = requests.enumerate().map(|(index, one)| match index % step {
                0 => lost(one, end),
                _ => one,
            });
            lost.collect::<Vec<_>>()
        };
        let requests = every(20, FrameEnd::LostByNetwork);
        // Every second one has an answer.
        let answers: Vec<_> = (0..500).map(|one| answer(20 * one + 12, 1)).collect();
        let [known, doubted] = [false, true].map(|is_doubted| {
            let mut fold = DeadlineFold::new("command", 4 * MS);
            if is_doubted {
                fold.doubt_program();
            }
            fold.add(&requests, &answers);
            let found = fold.finish();
            let of = found.request_count - found.unknown_count;
            let share = found.hurt_count as f64 / of as f64;
            let interval = found.hurt_share.and_then(Spread::known).unwrap();
            assert!(interval.holds(share), "{share}: {interval:?}");
            (found.missing_by_program_count, found.hurt_count, of)
        });
        assert_eq!(known, (450, 50, 1000));
        assert_eq!(doubted, (0, 50, 550));
    }

    #[test]
    fn requests_to_many_are_answered_by_nobody_that_is_known() {
        let requests = [request(0, 1), request(4, 1), request(8, 1)];
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
