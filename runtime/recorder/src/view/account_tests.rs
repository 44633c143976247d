//! Tests of [`super`]: messages of a link that loses some.

use super::*;
use hil_core::record::{EgressRecord, IngressRecord, PublishedRecord, TakenRecord, UNAVAILABLE};

const MS: i64 = 1_000_000;

fn account(has_link: bool) -> Account {
    let channel = ChannelFacts {
        link: has_link.then(|| "hop".to_owned()),
        ..ChannelFacts::default()
    };
    Account::new(&channel, true)
}

fn record(at_ns: i64, body: Body) -> LiveRecord {
    LiveRecord {
        at_ns,
        channel: 0,
        body,
    }
}

fn published(sequence: u64, at_ns: i64) -> LiveRecord {
    let body = Body::Record(Record::Published(PublishedRecord {
        sequence,
        published_ns: at_ns,
        epoch: 1,
        reserved: 0,
    }));
    record(at_ns, body)
}

fn sent(sequence: u64, at_ns: i64) -> LiveRecord {
    let body = Body::Record(Record::Egress(EgressRecord {
        sequence,
        published_ns: at_ns - 10_000,
        taken_ns: at_ns - 5_000,
        handed_ns: at_ns,
        tx_software_ns: UNAVAILABLE,
        tx_hardware_ns: UNAVAILABLE,
        realtime_offset_ns: 0,
        epoch: 1,
        session: 0,
        flags: 0,
        fragment_count: 1,
    }));
    record(at_ns, body)
}

fn received(sequence: u64, at_ns: i64) -> LiveRecord {
    let body = Body::Record(Record::Ingress(IngressRecord {
        sequence,
        published_ns: at_ns - MS,
        handed_ns: at_ns - MS,
        rx_hardware_ns: UNAVAILABLE,
        rx_software_ns: UNAVAILABLE,
        received_ns: at_ns,
        forwarded_ns: at_ns + 2_000,
        realtime_offset_ns: 0,
        emulated_ns: UNAVAILABLE,
        due_ns: UNAVAILABLE,
        follow_up_sequence: 0,
        follow_up_ns: UNAVAILABLE,
        epoch: 1,
        session: 0,
        flags: 0,
        fragment_count: 1,
    }));
    record(at_ns, body)
}

fn taken(sequence: u64, at_ns: i64) -> LiveRecord {
    let body = Body::Record(Record::Taken(TakenRecord {
        sequence,
        published_ns: at_ns - 2 * MS,
        forwarded_ns: at_ns - 1000,
        taken_ns: at_ns,
        epoch: 1,
        reserved: 0,
    }));
    record(at_ns, body)
}

#[test]
fn what_was_sent_and_did_not_arrive_is_lost_after_a_second() {
    let mut account = account(true);
    for sequence in 0..10_u64 {
        let at_ns = sequence.cast_signed() * 100 * MS;
        account.take(&published(sequence, at_ns));
        account.take(&sent(sequence, at_ns));
        if sequence % 5 != 3 {
            account.take(&received(sequence, at_ns + MS));
            account.take(&taken(sequence, at_ns + 2 * MS));
        }
    }
    account.settle(1000 * MS);
    assert_eq!(account.take_losses("x", 1.0, Some(0)), None);
    account.settle(1900 * MS);
    let losses = account.take_losses("x", 1.9, Some(0)).unwrap();
    assert_eq!(
        (&losses["sequences"], &losses["count"]),
        (&json!([3, 8]), &json!(2))
    );
    assert_eq!(losses["first_at_s"], 0.3);
    let figures = account.metrics("x", 1900 * MS);
    assert_eq!(
        (&figures["lost_count"], &figures["published_count"]),
        (&json!(2), &json!(10))
    );
    assert_eq!(
        (&figures["received_count"], &figures["taken_count"]),
        (&json!(8), &json!(8))
    );
    // One of them comes after all.
    account.take(&received(8, 1950 * MS));
    assert_eq!(account.metrics("x", 1950 * MS)["lost_count"], 1);
}

#[test]
fn pieces_of_a_message_are_no_arrival() {
    let mut account = account(true);
    for sequence in 0..2_u64 {
        let at_ns = sequence.cast_signed() * MS;
        account.take(&published(sequence, at_ns));
        account.take(&sent(sequence, at_ns));
    }
    account.take(&received(0, MS));
    let pieces = |at_ns: i64| {
        let mut one = received(1, at_ns);
        if let Body::Record(Record::Ingress(record)) = &mut one.body {
            record.flags = IngressRecord::INCOMPLETE;
            record.forwarded_ns = UNAVAILABLE;
        }
        one
    };
    // Before and after it was found lost.
    account.take(&pieces(2 * MS));
    account.settle(1100 * MS);
    account.take(&pieces(1100 * MS));
    let figures = account.metrics("x", 1100 * MS);
    assert_eq!(
        (&figures["lost_count"], &figures["received_count"]),
        (&json!(1), &json!(1))
    );
}

#[test]
fn what_was_taken_or_received_was_published() {
    let mut account = account(true);
    account.take(&taken(0, 2 * MS));
    account.take(&taken(1, 3 * MS));
    let published_count =
        |account: &mut Account| account.metrics("x", 4 * MS)["published_count"].clone();
    // Nobody here notes what is published, as far as is known.
    assert_eq!(published_count(&mut account), Value::Null);
    account.take(&published(0, 0));
    assert_eq!(published_count(&mut account), 2);
    for sequence in 0..3 {
        account.take(&received(sequence, MS));
    }
    assert_eq!(published_count(&mut account), 3);
    for sequence in 1..5 {
        account.take(&published(sequence, MS));
    }
    assert_eq!(published_count(&mut account), 5);
}

#[test]
fn a_receiver_alone_knows_the_lost_by_the_numbers_passed_over() {
    let mut account = account(true);
    for sequence in [5_u64, 6, 9, 8, 12] {
        account.take(&received(sequence, sequence.cast_signed() * MS));
    }
    account.settle(3000 * MS);
    let losses = account.take_losses("x", 3.0, Some(0)).unwrap();
    assert_eq!(losses["sequences"], json!([7, 10, 11]));
    assert_eq!(losses["first_at_s"], Value::Null);
    assert_eq!(
        account.metrics("x", 3000 * MS)["published_count"],
        Value::Null
    );
}

#[test]
fn a_sender_alone_knows_of_no_loss() {
    let mut account = account(true);
    account.take(&sent(0, 0));
    account.settle(5000 * MS);
    let figures = account.metrics("x", 5000 * MS);
    assert_eq!(figures["lost_count"], Value::Null);
    assert_eq!(figures["link_state"], "none");
    assert_eq!(account.take_losses("x", 5.0, Some(0)), None);
}

#[test]
fn each_segment_is_counted_once_as_soon_as_its_ends_are_known() {
    let mut account = account(true);
    for one in [
        taken(0, 2 * MS),
        received(0, MS),
        published(0, 0),
        sent(0, 10_000),
    ] {
        account.take(&one);
    }
    let figures = account.metrics("x", 3 * MS);
    let counts: Vec<_> = (0..7)
        .map(|index| &figures["segments"][index]["count"])
        .collect();
    assert_eq!(counts, [1, 1, 0, 0, 0, 1, 1]);
    assert_eq!(figures["segments"][1]["p50_us"], 5.0);
    assert_eq!(figures["segments"][2]["is_available"], false);
    assert_eq!(figures["one_way"]["max_us"], 2000.0);
}

#[test]
fn a_cut_link_is_silent_and_an_idle_one_is_not() {
    let mut account = account(true);
    for sequence in 0..10_u64 {
        account.take(&sent(sequence, sequence.cast_signed() * 10 * MS));
        account.take(&received(sequence, sequence.cast_signed() * 10 * MS + MS));
    }
    let state =
        |account: &mut Account, ms: i64| account.metrics("x", ms * MS)["link_state"].clone();
    assert_eq!(state(&mut account, 100), "up");
    assert_eq!(state(&mut account, 5000), "up");
    for sequence in 10..200 {
        account.take(&sent(sequence, sequence.cast_signed() * 10 * MS));
    }
    assert_eq!(state(&mut account, 2000), "silent");
    assert_eq!(account.metrics("x", 2091 * MS)["silent_s"], 2.0);
}

#[test]
fn of_a_producer_elsewhere_only_what_had_a_rhythm_can_be_silent() {
    let mut unseen = account(true);
    assert_eq!(unseen.metrics("x", 9000 * MS)["rate_hz"], Value::Null);
    for (count, state) in [(2, "up"), (100, "silent")] {
        let mut account = account(true);
        for sequence in 0..count {
            account.take(&received(sequence, sequence.cast_signed() * 10 * MS));
        }
        let figures = account.metrics("x", 9000 * MS);
        assert_eq!(figures["link_state"], state, "{count} messages");
        assert_eq!(figures["rate_hz"], 0.0);
    }
}

#[test]
fn shared_memory_has_one_segment_and_loses_nothing_that_we_know_of() {
    let mut account = account(false);
    account.take(&published(0, 0));
    account.take(&taken(0, 2 * MS));
    account.take(&published(1, 0));
    account.settle(5000 * MS);
    let figures = account.metrics("x", 10 * MS);
    assert_eq!(figures["segments"].as_array().map(Vec::len), Some(1));
    assert_eq!(figures["segments"][0]["p50_us"], 2000.0);
    assert_eq!(
        (&figures["lost_count"], &figures["link_state"]),
        (&Value::Null, &json!("none"))
    );
}

#[test]
fn what_is_older_than_a_second_does_not_count() {
    let mut recent = Recent::default();
    for tick in 0..300 {
        recent.add(tick * 10_000_000, 1);
    }
    assert_eq!(recent.count(3_000_000_000), 100);
    assert_eq!(recent.count(3_200_000_000), 100);
    assert_eq!(recent.count(3_500_000_000), 74);
    assert_eq!(recent.count(9_000_000_000), 0);
}

#[test]
fn percentiles_are_those_of_the_window() {
    let mut samples = Samples::default();
    assert_eq!(samples.metrics("x", 0)["is_available"], false);
    assert_eq!(samples.metrics("x", 0)["p50_us"], Value::Null);
    samples.add(0, 900_000);
    for index in 1..=100 {
        samples.add(WINDOW_NS + index, index * 1000);
    }
    let figures = samples.metrics("x", WINDOW_NS + 200);
    assert_eq!(figures["count"], 100);
    assert_eq!(figures["p50_us"], 50.0);
    assert_eq!(figures["p99_us"], 99.0);
    assert_eq!(figures["max_us"], 100.0);
    let later = samples.metrics("x", 3 * WINDOW_NS);
    assert_eq!(
        (&later["count"], &later["max_us"]),
        (&json!(0), &Value::Null)
    );
    assert_eq!(later["is_available"], true);
}
