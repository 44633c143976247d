//! The figures of a stream transport as a report shows them. It measures nothing.

use std::time::Duration;

use hil_core::time::duration_ns;
use hil_transport::tcp::StreamFigures;

use hil_rundir::launch::Side;
use hil_rundir::pipe::{CountByName, CounterGroup, StallFigures};

/// Every count under the name a report prints.
pub(super) fn counters(figures: &StreamFigures) -> Vec<CountByName> {
    CountByName::all(CounterGroup::Stream, figures.iter()).collect()
}

/// How often a sending stream stood still.
pub(super) fn stalls(figures: &StreamFigures) -> StallFigures {
    let nanoseconds = |time: Duration| duration_ns(time).unsigned_abs();
    StallFigures {
        count: figures.stall_count,
        total_ns: nanoseconds(figures.stalled),
        longest_ns: nanoseconds(figures.stall_longest),
        threshold_ns: nanoseconds(figures.stall_threshold),
    }
}

/// What a reader has to know of the connection, in words.
pub(super) fn facts(figures: &StreamFigures, side: Side) -> Vec<(String, String)> {
    let mut facts = vec![("connections", connections(figures))];
    if side == Side::Egress {
        facts.push(("waiting for acknowledgement", waiting(figures)));
        facts.push(("TCP round trip", round_trip(figures)));
    }
    let resent = optional(figures.retransmitted_segment_count);
    let early = optional(figures.out_of_order_segment_count);
    facts.push((
        "segments",
        match side {
            Side::Egress => format!("{resent} sent again"),
            Side::Ingress => format!("{early} before their turn"),
        },
    ));
    facts
        .into_iter()
        .map(|(label, text)| (label.to_owned(), text))
        .collect()
}

fn connections(figures: &StreamFigures) -> String {
    let (count, reconnect_count) = (figures.connection_count, figures.reconnect_count());
    let mut words = vec![format!("{count}, {reconnect_count} of them reconnects")];
    for (what, count) in [
        ("failed attempts", figures.connect_failed_count),
        ("strangers turned away", figures.foreign_connection_count),
        ("closed for a bad frame length", figures.bad_frame_count),
        ("ended within a frame", figures.cut_frame_count),
        ("bytes given up with one", figures.abandoned_bytes),
    ] {
        if count > 0 {
            words.push(format!("{what} {count}"));
        }
    }
    if let Some(errno) = figures.newest_errno.filter(|errno| *errno != 0) {
        let error = std::io::Error::from_raw_os_error(errno);
        words.push(format!("the newest failure: {error}"));
    }
    words.join("; ")
}

fn waiting(figures: &StreamFigures) -> String {
    let busy = figures.busy.map_or("unavailable".to_owned(), milliseconds);
    let seen = figures.waiting_bytes_max;
    let mut words = vec![format!(
        "at most {seen} bytes seen, {busy} by the kernel's count"
    )];
    for (what, time) in [
        ("for a closed window", figures.window_limited),
        ("for a full send buffer", figures.buffer_limited),
        ("in the gateway's own buffer", Some(figures.backlogged)),
    ] {
        if let Some(time) = time.filter(|time| !time.is_zero()) {
            words.push(format!("{} {what}", milliseconds(time)));
        }
    }
    words.join(", ")
}

fn round_trip(figures: &StreamFigures) -> String {
    let optional = |time: Option<Duration>| time.map_or("unavailable".to_owned(), milliseconds);
    format!(
        "{} smoothed, deviation {}, smallest {}",
        optional(figures.rtt),
        optional(figures.rtt_variation),
        optional(figures.rtt_min)
    )
}

fn optional(count: Option<u64>) -> String {
    count.map_or("unavailable".to_owned(), |count| count.to_string())
}

fn milliseconds(time: Duration) -> String {
    let ms = time.as_secs_f64() * 1e3;
    if ms < 10.0 {
        format!("{ms:.3} ms")
    } else {
        format!("{ms:.1} ms")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_kernel_does_not_tell_is_unavailable_and_stalls_are_numbers() {
        let figures = StreamFigures {
            connection_count: 2,
            stall_count: 1,
            stalled: Duration::from_millis(300),
            stall_longest: Duration::from_millis(300),
            stall_threshold: Duration::from_millis(44),
            newest_errno: Some(libc_refused()),
            ..StreamFigures::default()
        };
        let facts = facts(&figures, Side::Egress);
        let of = |label: &str| {
            let mut found = facts.iter().filter(|(own, _)| own == label);
            found.next().map(|(_, text)| text.as_str()).unwrap()
        };
        assert!(of("connections").starts_with("2, 1 of them reconnects"));
        assert!(
            of("connections").contains("refused"),
            "{}",
            of("connections")
        );
        let expected = StallFigures {
            count: 1,
            total_ns: 300_000_000,
            longest_ns: 300_000_000,
            threshold_ns: 44_000_000,
        };
        assert_eq!(stalls(&figures), expected);
        assert!(of("TCP round trip").starts_with("unavailable smoothed"));
        assert_eq!(of("segments"), "unavailable sent again");
    }

    fn libc_refused() -> i32 {
        nix::errno::Errno::ECONNREFUSED as i32
    }
}
