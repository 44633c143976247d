//! Stamps of several clocks brought to one, and what a figure says of them.

use super::*;

#[allow(clippy::unnecessary_wraps, reason = "as `bring_to_one_clock` takes it")]
fn stamp(at_ns: i64, bound_ns: u64) -> Option<ConvertedStamp> {
    Some(ConvertedStamp {
        at_ns,
        bound_ns,
        is_early: false,
    })
}

/// Every channel has a producer on a host of its own.
#[allow(clippy::unnecessary_wraps, reason = "as `bring_to_one_clock` takes it")]
fn source_of(channel: &str) -> Option<String> {
    Some(channel.to_owned())
}

/// Messages of two channels, 10 ns apart.
fn log() -> RunLog {
    let mut log = RunLog::default();
    for channel in ["command", "status"] {
        for sequence in 0..4 {
            let envelope = Envelope {
                sequence,
                published_ns: i64::try_from(sequence).unwrap() * 10,
                ..Envelope::default()
            };
            log.push(channel, envelope, &[]);
        }
    }
    log.set_clocks_differ();
    log
}

#[test]
fn stamps_are_brought_to_one_clock_with_their_largest_error_and_keep_their_order() {
    let mut log = log();
    // The third command's offset is 15 ns less than its neighbours'.
    let convert = |channel: &str, ns: i64| match (channel, ns) {
        ("command", 20) => stamp(5_000 + 20 - 15, 40),
        ("command", ns) => stamp(5_000 + ns, 30),
        (_, ns) => stamp(ns, 0),
    };
    assert_eq!(log.bring_to_one_clock(source_of, convert), Ok(()));
    assert!(log.has_one_clock());
    assert_eq!((log.stamp_bound_ns(), log.clock_bound_ns()), (40, 40));
    let stamps = |channel| -> Vec<i64> {
        let all = log.raw(channel).iter();
        all.map(|one| one.envelope.published_ns).collect()
    };
    assert_eq!(stamps("command"), [5_000, 5_010, 5_010, 5_030]);
    assert_eq!(stamps("status"), [0, 10, 20, 30]);
}

#[test]
fn channels_of_two_other_clocks_are_off_by_both_conversions() {
    let mut log = log();
    for channel in ["orders", "order_answers"] {
        log.push(channel, Envelope::default(), &[]);
    }
    // Robot and sensor are brought to the controller's clock; the answers are the sensor's too.
    let source_of = |channel: &str| {
        let source = match channel {
            "command" => "controller",
            "status" => "robot",
            _ => "sensor",
        };
        Some(source.to_owned())
    };
    let convert = |channel: &str, ns: i64| match channel {
        "command" => stamp(ns, 0),
        "status" => stamp(ns + 7, 30),
        "orders" => stamp(ns - 7, 25),
        _ => stamp(ns - 7, 20),
    };
    assert_eq!(log.bring_to_one_clock(source_of, convert), Ok(()));
    assert_eq!((log.stamp_bound_ns(), log.clock_bound_ns()), (30, 55));
}

#[test]
fn a_channel_of_an_unknown_clock_leaves_all_as_they_were() {
    let mut changed = log();
    let source_of = |channel: &str| source_of(channel).filter(|_| channel != "status");
    let failed = changed.bring_to_one_clock(source_of, |_, ns| stamp(ns + 5, 1));
    assert_eq!(failed, Err("status".to_owned()));
    assert_eq!(changed, log());
}

#[test]
fn one_stamp_that_does_not_convert_leaves_all_as_they_were() {
    let mut changed = log();
    let convert = |channel: &str, ns: i64| stamp(7, 1).filter(|_| channel != "status" || ns < 30);
    let failed = changed.bring_to_one_clock(source_of, convert);
    assert_eq!(failed, Err("status".to_owned()));
    assert_eq!(changed, log());
    assert!(!changed.has_one_clock());
}

#[test]
fn a_figure_says_of_two_clocks_what_one_clock_need_not() {
    let mut log = log();
    assert_eq!(log.clock_words(None), "");
    let convert = |channel: &str, ns| stamp(ns, if channel == "status" { 15_700 } else { 0 });
    log.bring_to_one_clock(source_of, convert).unwrap();
    let words = "; stamps of two hosts, aligned within ±15.7 us";
    assert_eq!(log.clock_words(Some(20e-6)), words);
    let wide = [words, ", wider than the figure"].concat();
    assert_eq!(log.clock_words(Some(-15e-6)), wide);
}

#[test]
fn a_message_before_the_first_exchange_is_named_with_what_it_widens() {
    let brought = |widest_ns: u64| {
        let mut log = log();
        let convert = |channel: &str, ns: i64| match (channel, ns) {
            ("status", 0) => Some(ConvertedStamp {
                at_ns: ns,
                bound_ns: widest_ns,
                is_early: true,
            }),
            ("status", ns) => stamp(ns, 15_700),
            _ => stamp(ns, 0),
        };
        log.bring_to_one_clock(source_of, convert).unwrap();
        log
    };
    let wide = brought(2_000_000);
    assert_eq!(wide.clock_bound_ns(), 2_000_000);
    let words = wide.clock_words(None);
    assert!(words.contains("no clock stepped until then"), "{words}");
    assert!(
        words.ends_with("the widest, of status, ±2000.0 us, without them ±15.7 us"),
        "{words}"
    );
    // One that widens nothing rests on the same assumption.
    let words = brought(9_000).clock_words(None);
    assert!(words.ends_with("the widest, of status, ±9.0 us"), "{words}");
}
