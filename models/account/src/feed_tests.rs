//! One fold, fed in different ways, tells the same: as records become readable during a run, in small pieces,
//! and the whole files at once. Only what the clocks are known by may differ, and a transmit stamp that came
//! along too late.

use core::time::Duration;

use super::network::Passage;
use super::synthetic::{Files, PERIOD_NS, TAKEN_NS, Written, same_clock};
use super::*;
use hil_clock::{Exchange, Requester};
use hil_core::random::RandomStream;
use hil_core::record::{IngressRecord, RoundTripRecord, UNAVAILABLE};
use hil_core::time::duration_ns;

const MS: i64 = 1_000_000;
/// How far the clock of the consumer's host is ahead where there are two.
const AHEAD_NS: i64 = 7_000_000 * MS;
const DEPTH: usize = 16;

/// A run that never was, with each record when it can be read.
struct Run {
    files: Files,
    /// When each can be read, on the producer's clock.
    events: Vec<(i64, RecordEvent)>,
    interruptions: Vec<Interruption>,
    span: RunSpan,
    has_two_clocks: bool,
    round_trips: Vec<RoundTripRecord>,
}

fn up_to(stream: &mut RandomStream, max: u64) -> u64 {
    stream.next_u64() % (max + 1)
}

fn signed(number: u64) -> i64 {
    i64::try_from(number).unwrap()
}

impl Run {
    /// Starts of the producer with losses alone and in a row, copies, a gateway that is killed, a consumer
    /// that stands still, and kinds of records that are late or missing.
    fn random(seed: u64) -> Self {
        let mut stream = RandomStream::new(seed, "account.feed");
        let mut files = Files::default();
        let mut interruptions = Vec::new();
        let mut now_ns = 5 * MS;
        let epochs = &[70_u32, 4, 900][..=usize::try_from(up_to(&mut stream, 2)).unwrap()];
        for epoch in epochs {
            let count = 50 + up_to(&mut stream, 400);
            let outage = up_to(&mut stream, count)..up_to(&mut stream, count) + 40;
            let pause = up_to(&mut stream, count)..up_to(&mut stream, count) + 60;
            let kill_from = up_to(&mut stream, 2 * count);
            let kill = kill_from..kill_from + 30;
            for sequence in 0..count {
                let fate = if kill.contains(&sequence) || outage.contains(&sequence) {
                    MessageFate::LostOnWire
                } else if pause.contains(&sequence) {
                    MessageFate::SupersededAtConsumer
                } else {
                    random_fate(&mut stream)
                };
                let published_ns = now_ns + signed(up_to(&mut stream, 200_000));
                files.write(
                    Written {
                        epoch: *epoch,
                        sequence,
                        published_ns,
                    },
                    fate,
                );
                if kill.contains(&sequence) && sequence == kill.end.min(count) - 1 {
                    let span_ns = signed(sequence - kill.start) * PERIOD_NS;
                    interruptions.push(Interruption {
                        process: "gateway".to_owned(),
                        place: PathProcess::ReceivingGateway,
                        from: Instant::from_ns(now_ns - span_ns - MS),
                        until: Instant::from_ns(now_ns + MS / 2),
                        cause: "killed by signal 9".to_owned(),
                    });
                }
                now_ns += PERIOD_NS;
            }
            now_ns += signed(up_to(&mut stream, 300)) * MS;
        }
        let each = files.ingress.iter().enumerate();
        let with_copies = each.flat_map(|(index, record)| {
            let copy = index.is_multiple_of(37).then(|| copy_of(record));
            core::iter::once(*record).chain(copy)
        });
        files.ingress = with_copies.collect();
        let mut run = Self {
            files,
            events: Vec::new(),
            interruptions,
            span: RunSpan {
                start: Instant::ZERO,
                end: Instant::from_ns(now_ns + signed(up_to(&mut stream, 100)) * MS),
            },
            has_two_clocks: stream.chance(0.5),
            round_trips: Vec::new(),
        };
        if run.has_two_clocks {
            run.set_consumer_ahead();
        }
        run.note_events(&mut stream);
        run
    }

    fn set_consumer_ahead(&mut self) {
        for record in &mut self.files.ingress {
            record.received_ns += AHEAD_NS;
            if record.forwarded_ns != UNAVAILABLE {
                record.forwarded_ns += AHEAD_NS;
            }
            record.realtime_offset_ns -= AHEAD_NS;
        }
        for record in &mut self.files.taken {
            record.forwarded_ns += AHEAD_NS;
            record.taken_ns += AHEAD_NS;
        }
        for one in &mut self.interruptions {
            one.from = Instant::from_ns(one.from.as_ns() + AHEAD_NS);
            one.until = Instant::from_ns(one.until.as_ns() + AHEAD_NS);
        }
        let count = self.span.end.as_ns() / (100 * MS) + 3;
        self.round_trips = (0..count)
            .map(|index| {
                // A fast exchange now and then tells more of the clocks, also of earlier ones.
                let way_ns = if index % 7 == 6 { 20_000 } else { 400_000 };
                let sent_ns = index * 100 * MS;
                let there_ns = sent_ns + way_ns + AHEAD_NS;
                RoundTripRecord {
                    sequence: index.unsigned_abs(),
                    t1_ns: sent_ns,
                    t2_ns: there_ns,
                    t3_ns: there_ns,
                    t4_ns: sent_ns + 2 * way_ns,
                    session: 1,
                    sources: [1; 4],
                }
            })
            .collect();
    }

    /// Each kind of file is late by its own time, and each record by some more.
    fn note_events(&mut self, stream: &mut RandomStream) {
        let missing = up_to(stream, 9);
        if missing == 4 {
            self.files.forget_follow_ups();
        }
        let allowed_ns = signed(up_to(stream, 1)) * duration_ns(WRITING_TIME_MAX) * 9 / 10;
        // A file is written in order.
        let mut written_ns = [0; 4];
        let mut note = |kind: u64, published_ns: i64, event: RecordEvent| {
            if kind == missing {
                return;
            }
            let late_ns = allowed_ns * signed(kind % 3) / 2 + signed(up_to(stream, 9)) * MS;
            let written_ns = &mut written_ns[usize::try_from(kind).unwrap()];
            *written_ns = (published_ns + TAKEN_NS + late_ns).max(*written_ns);
            self.events.push((*written_ns, event));
        };
        for one in &self.files.published {
            note(0, one.published_ns, RecordEvent::Published(*one));
        }
        for one in &self.files.egress {
            note(1, one.published_ns, RecordEvent::Egress(*one));
        }
        for one in &self.files.ingress {
            note(2, one.published_ns, RecordEvent::Ingress(*one));
        }
        for one in &self.files.taken {
            note(3, one.published_ns, RecordEvent::Taken(*one));
        }
        let is_missing = |kind: u64| kind == missing;
        let files = &mut self.files;
        if is_missing(0) {
            files.published.clear();
        }
        if is_missing(1) {
            files.egress.clear();
        }
        if is_missing(2) {
            files.ingress.clear();
        }
        if is_missing(3) {
            files.taken.clear();
        }
        self.events.sort_by_key(|(at_ns, _)| *at_ns);
    }

    fn records(&self) -> ChannelRecords<'_> {
        let all = self.files.records();
        ChannelRecords {
            published: all.published.filter(|one| one.count() > 0),
            egress: all.egress.filter(|one| one.count() > 0),
            ingress: all.ingress.filter(|one| one.count() > 0),
            taken: all.taken.filter(|one| one.count() > 0),
        }
    }

    /// The clocks by the exchanges that ended by `now_ns`.
    fn clock_map(&self, now_ns: i64) -> ClockMap {
        let past = self.round_trips.iter().filter(|one| one.t4_ns <= now_ns);
        let past: Vec<Exchange> = past
            .filter_map(|one| Exchange::of(one, Requester::Remote))
            .collect();
        ClockMap::new(&past, ClockSettings::default())
    }

    fn context<'a>(&'a self, map: &'a ClockMap) -> AccountContext<'a> {
        let shifted = |at: Instant| Instant::from_ns(at.as_ns() + AHEAD_NS);
        let one_clock = AccountContext {
            interruptions: &self.interruptions,
            depth: Some(DEPTH),
            ..same_clock(self.span.end.as_ns())
        };
        if !self.has_two_clocks {
            return one_clock;
        }
        AccountContext {
            path: ChannelPath::Mapped { map },
            consumer_run: Some(RunSpan {
                start: shifted(self.span.start),
                end: shifted(self.span.end),
            }),
            ..one_clock
        }
    }

    fn fold(&self, held_max: Option<usize>) -> ChannelFold {
        let mut fold = ChannelFold::new(FoldSettings {
            is_gateway: true,
            depth: Some(DEPTH),
            first_number: FirstNumber::Zero,
            held_max,
        });
        let map = self.clock_map(i64::MAX);
        fold.expect(RecordsAtHand::of(&self.records(), &self.context(&map)));
        fold
    }

    fn at_once(&self) -> Told {
        let map = self.clock_map(i64::MAX);
        let mut told = Told::default();
        let context = self.context(&map);
        each_history(&self.records(), &context, |one| told.add(one, context.path));
        told
    }

    /// As a watcher reads `events`: every 20 ms what can be read by then. Of the clocks and of the end of
    /// the run it knows the past.
    fn live(&self, events: &[(i64, RecordEvent)]) -> Told {
        let mut told = Told::default();
        let mut fold = self.fold(Some(4_096));
        let mut events = events.iter().peekable();
        let settling_ns = duration_ns(flight_time_max(Duration::ZERO) + WRITING_TIME_MAX);
        let mut now_ns = 0;
        while events.peek().is_some() {
            now_ns += 20 * MS;
            while let Some((_, event)) = events.next_if(|(at_ns, _)| *at_ns <= now_ns) {
                fold.push(event);
            }
            let map = self.clock_map(now_ns);
            let mut context = self.context(&map);
            if now_ns < self.span.end.as_ns() {
                (context.producer_run, context.consumer_run) = (None, None);
            }
            let path = context.path;
            fold.settle(&context, now_ns - settling_ns, &mut |one| {
                told.add(one, path);
            });
        }
        let map = self.clock_map(i64::MAX);
        let context = self.context(&map);
        fold.finish(&context, &mut |one| told.add(one, context.path));
        assert_eq!((fold.late_record_count(), fold.held_count()), (0, 0));
        told
    }

    /// In the order of publication, a few records at a time.
    fn in_pieces(&self, stream: &mut RandomStream) -> Told {
        let published_ns = |event: &RecordEvent| event.message().published_ns;
        let mut events: Vec<RecordEvent> = self.events.iter().map(|(_, event)| *event).collect();
        events.sort_by_key(published_ns);
        let map = self.clock_map(i64::MAX);
        let context = self.context(&map);
        let mut told = Told::default();
        let mut fold = self.fold(None);
        let mut rest = &events[..];
        while !rest.is_empty() {
            let count = usize::try_from(1 + up_to(stream, 11)).unwrap();
            let (piece, left) = rest.split_at(count.min(rest.len()));
            for event in piece {
                fold.push(event);
            }
            rest = left;
            // A transmit stamp comes with a later message.
            let until_ns = rest.first().map_or(i64::MAX, |next| {
                published_ns(next).saturating_sub(200 * PERIOD_NS)
            });
            fold.settle(&context, until_ns, &mut |one| told.add(one, context.path));
        }
        fold.finish(&context, &mut |one| told.add(one, context.path));
        told
    }
}

fn random_fate(stream: &mut RandomStream) -> MessageFate {
    use MessageFate as Fate;
    let rare = [
        Fate::SupersededAtInput,
        Fate::RefusedByKernel,
        Fate::LostOnWire,
        Fate::Incomplete,
        Fate::RefusedAtIngress,
        Fate::Late,
        Fate::Duplicate,
        Fate::SupersededAtConsumer,
        Fate::Unexplained,
    ];
    if stream.chance(0.8) {
        return Fate::Taken;
    }
    rare[usize::try_from(up_to(stream, rare.len() as u64 - 1)).unwrap()]
}

fn copy_of(record: &IngressRecord) -> IngressRecord {
    IngressRecord {
        flags: IngressRecord::DUPLICATE,
        forwarded_ns: UNAVAILABLE,
        received_ns: record.received_ns + 1_000,
        ..*record
    }
}

/// Everything that was told of a run.
#[derive(Debug)]
struct Told {
    messages: Vec<MessageHistory>,
    passages: Vec<Passage>,
    demand: DemandFold,
}

impl Default for Told {
    fn default() -> Self {
        let demand = Demand {
            latency_max: Duration::from_micros(30),
            survival_time: Duration::from_millis(2),
            interval: Duration::from_millis(1),
            availability: 0.999,
        };
        Self {
            messages: Vec::new(),
            passages: Vec::new(),
            demand: DemandFold::new(&demand, None),
        }
    }
}

impl Told {
    fn add(&mut self, message: &MessageHistory, path: ChannelPath<'_>) {
        self.messages.push(*message);
        self.passages.push(message.passage(path));
        self.demand.add(message, &AccountContext::new(path));
    }

    fn outages(&self) -> Vec<Outage> {
        let mut finder = OutageFinder::default();
        for message in &self.messages {
            finder.add(message);
        }
        finder.finish()
    }

    /// What differs between two ways to feed one run; the widths of bounds, and by them the estimates of
    /// delays between two clocks, may.
    fn difference(&self, other: &Self, run: &Run) -> Option<String> {
        if self.messages.len() != other.messages.len() {
            let (here, there) = (self.messages.len(), other.messages.len());
            return Some(format!("{here} messages and {there}"));
        }
        // A stamp that came along after its message had been told is not known there.
        let told_by_then = |here: &MessageHistory, there: &MessageHistory| MessageHistory {
            handed_to_tx_ns: here.handed_to_tx_ns.and(there.handed_to_tx_ns),
            ..*here
        };
        let mut pairs = self.messages.iter().zip(&other.messages);
        let apart = pairs.find(|(here, there)| told_by_then(here, there) != **there);
        if let Some((here, there)) = apart {
            return Some(format!("{here:?}\n{there:?}"));
        }
        let without_clocks = |one: &Passage| Passage {
            delay_ns: one.delay_ns.filter(|_| !run.has_two_clocks),
            delay_bound_ns: 0,
            ..*one
        };
        let mut pairs = self.passages.iter().zip(&other.passages);
        let apart = pairs.find(|(here, there)| without_clocks(here) != without_clocks(there));
        if let Some((here, there)) = apart {
            return Some(format!("{here:?}\n{there:?}"));
        }
        (self.outages() != other.outages()).then(|| "outages".to_owned())
    }
}

#[test]
fn a_run_is_told_alike_live_in_pieces_and_at_once() {
    let (mut interrupted_count, mut wider_count, mut failure_count) = (0, 0, 0);
    let (mut stamped_count, mut stamped_live_count) = (0, 0);
    for seed in 0..150 {
        let run = Run::random(seed);
        let at_once = run.at_once();
        let mut stream = RandomStream::new(seed, "account.pieces");
        let pieces = run.in_pieces(&mut stream);
        assert_eq!(
            at_once.difference(&pieces, &run),
            None,
            "seed {seed}, in pieces"
        );
        let live = run.live(&run.events);
        assert_eq!(at_once.difference(&live, &run), None, "seed {seed}, live");
        let [whole, pieces, live_demand] =
            [&at_once, &pieces, &live].map(|told| told.demand.clone().finish());
        assert_eq!(whole, pieces, "seed {seed}, in pieces");
        // With two clocks, a watcher's wider bounds leave more messages unknown.
        assert!(
            run.has_two_clocks || whole == live_demand,
            "seed {seed}, live"
        );
        failure_count += whole.service.measured().map_or(0, |one| one.failure_count);
        for (whole, live) in at_once.passages.iter().zip(&live.passages) {
            assert!(live.delay_ns.is_none() || live.delay_bound_ns >= whole.delay_bound_ns);
            wider_count += u64::from(live.delay_bound_ns > whole.delay_bound_ns);
        }
        let is_stamped = |one: &&MessageHistory| one.handed_to_tx_ns.is_some();
        stamped_count += at_once.messages.iter().filter(is_stamped).count();
        stamped_live_count += live.messages.iter().filter(is_stamped).count();
        let is_interrupted = |one: &&MessageHistory| one.interruption_index.is_some();
        interrupted_count += at_once.messages.iter().filter(is_interrupted).count();
    }
    assert!(interrupted_count > 100, "{interrupted_count}");
    assert!(failure_count > 100, "{failure_count}");
    assert!(stamped_live_count * 10 > stamped_count * 9);
    assert!(wider_count > 0, "the clocks are known better at the end");
}

#[test]
fn an_event_that_is_left_out_is_found_by_the_comparison() {
    for seed in 0..60 {
        let run = Run::random(seed);
        let at_once = run.at_once();
        let mut stream = RandomStream::new(seed, "account.dropped");
        let mut events = run.events.clone();
        let place = up_to(&mut stream, events.len() as u64 - 1);
        let (_, dropped) = events.remove(usize::try_from(place).unwrap());
        let live = run.live(&events);
        assert_ne!(
            at_once.difference(&live, &run),
            None,
            "seed {seed}: {dropped:?}"
        );
    }
}

/// A channel on one clock whose messages all leave.
fn paused_run(count: u64, taken_count: u64, depth: Option<usize>) -> FateCounts {
    let mut files = Files::default();
    for sequence in 0..count {
        let fate = if sequence < taken_count {
            MessageFate::Taken
        } else {
            MessageFate::SupersededAtConsumer
        };
        files.write(synthetic::at(7, sequence), fate);
    }
    let end_ns = signed(count) * PERIOD_NS + 500 * MS;
    let context = AccountContext {
        depth,
        ..same_clock(end_ns)
    };
    account(&files.records(), &context).fates
}

#[test]
fn what_a_consumer_left_that_stands_still_past_the_end_was_pushed_out_or_waits() {
    let fates = paused_run(1_000, 500, Some(16));
    assert_eq!(fates.of(MessageFate::Taken), 500);
    assert_eq!(fates.of(MessageFate::SupersededAtConsumer), 484);
    assert_eq!(fates.of(MessageFate::InFlight), 16, "in its buffer");
    assert_eq!(fates.of(MessageFate::Unexplained), 0);
    // One that never took anything.
    let fates = paused_run(100, 0, Some(1));
    assert_eq!(fates.of(MessageFate::SupersededAtConsumer), 99);
    assert_eq!(fates.of(MessageFate::InFlight), 1);
    // Of a buffer of unknown depth nothing can be said.
    assert_eq!(paused_run(100, 50, None).of(MessageFate::Unexplained), 50);
}

/// Feeds `count` messages, one a millisecond, as a watcher reads them; gives the most that were held.
fn watched(count: u64, fate: impl Fn(u64) -> MessageFate) -> (usize, FateCounts) {
    let mut fold = ChannelFold::new(FoldSettings {
        is_gateway: true,
        depth: Some(DEPTH),
        first_number: FirstNumber::OnRecord,
        held_max: Some(4_096),
    });
    let context = AccountContext::new(ChannelPath::Gateway {
        alignment: Some(Alignment::SAME_CLOCK),
    });
    let settling_ns = duration_ns(flight_time_max(Duration::ZERO) + WRITING_TIME_MAX);
    let (mut held_max, mut fates) = (0, FateCounts::default());
    for sequence in 0..count {
        let mut files = Files::default();
        let message = Written {
            epoch: u32::try_from(sequence / 50_000).unwrap(),
            sequence: sequence % 50_000,
            published_ns: signed(sequence) * PERIOD_NS,
        };
        files.write(message, fate(sequence));
        for one in files.published {
            fold.push(&RecordEvent::Published(one));
        }
        for one in files.egress {
            fold.push(&RecordEvent::Egress(one));
        }
        for one in files.ingress {
            fold.push(&RecordEvent::Ingress(one));
        }
        for one in files.taken {
            fold.push(&RecordEvent::Taken(one));
        }
        held_max = held_max.max(fold.held_count());
        if sequence % 10 == 0 {
            let until_ns = message.published_ns - settling_ns;
            fold.settle(&context, until_ns, &mut |one| {
                fates.add(one.fate, one.count);
            });
        }
    }
    fold.finish(&context, &mut |one| fates.add(one.fate, one.count));
    assert_eq!(fates.total(), count);
    (held_max, fates)
}

#[test]
fn a_watcher_holds_what_is_under_way_however_long_a_reader_stands_still() {
    let paused = |sequence| match sequence {
        5_000..25_000 => MessageFate::SupersededAtConsumer,
        30_000..50_000 => MessageFate::SupersededAtInput,
        70_000..80_000 => MessageFate::LostOnWire,
        _ => MessageFate::Taken,
    };
    let (held_max, fates) = watched(110_000, paused);
    assert!(held_max < 200, "{held_max}");
    assert_eq!(fates.of(MessageFate::SupersededAtConsumer), 20_000);
    assert_eq!(fates.of(MessageFate::SupersededAtInput), 20_000);
    assert_eq!(fates.of(MessageFate::LostOnWire), 10_000);
}

#[test]
fn a_buffer_that_nothing_leaves_holds_a_watcher_back_for_so_many_messages_only() {
    // A consumer stands still and the link is cut: what waits is neither taken nor pushed out.
    let stuck = |sequence| match sequence {
        0..1_000 => MessageFate::Taken,
        1_000..1_005 => MessageFate::SupersededAtConsumer,
        _ => MessageFate::LostOnWire,
    };
    let (held_max, fates) = watched(20_000, stuck);
    assert!(held_max < 4_400, "{held_max}");
    assert_eq!(fates.of(MessageFate::InFlight), 5);
    assert_eq!(fates.of(MessageFate::LostOnWire), 18_995);
}

#[test]
#[ignore = "7 million messages: run it with --release"]
fn thirty_minutes_of_400_channels_are_held_a_few_messages_at_a_time() {
    for _ in 0..400 {
        let (held_max, fates) = watched(17_500, |_| MessageFate::Taken);
        assert!(held_max < 200, "{held_max}");
        assert_eq!(fates.of(MessageFate::Taken), 17_500);
    }
}
