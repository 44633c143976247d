//! What a stream counts beyond the datagrams, and how a report shows it. It measures nothing itself.

use core::time::Duration;

use hil_net::tcp_info::ConnectionInfo;

use crate::{EndReport, Stalls};

/// Everything one end of a stream transport saw since it was opened, over all its connections.
/// What the kernel did not tell is `None`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct StreamMetrics {
    /// Connections that came about; all but the first are reconnects.
    pub(super) connection_count: u64,
    /// Of those, ended while this end was open.
    pub(super) connection_ended_count: u64,
    /// Attempts to connect that failed.
    pub(super) connect_failed_count: u64,
    /// The errno of the newest attempt that failed or connection that ended; 0 when the peer closed
    /// it in order.
    pub(super) newest_errno: Option<i32>,
    /// Connections of others than the peer's host, turned away.
    pub(super) foreign_connection_count: u64,
    /// Connections from the peer's address that delivered nothing of the peer's, ended.
    pub(super) unproven_connection_count: u64,
    /// Connections closed for a length that no frame has.
    pub(super) bad_frame_count: u64,
    /// Frames of which the end of a connection cut off the rest.
    pub(super) cut_frame_count: u64,
    /// Bytes that were accepted and not acknowledged when their connection ended.
    pub(super) abandoned_bytes: u64,
    /// Most bytes that waited in our own buffer at a time.
    pub(super) backlog_bytes_max: u64,
    /// Time during which any did.
    pub(super) backlogged: Duration,
    /// Most bytes seen waiting for an acknowledgement, in our buffer or in the kernel's.
    pub(super) waiting_bytes_max: u64,
    /// Spans in which the oldest unacknowledged byte waited longer than twice the smallest round trip and 50 ms, the
    /// longest that a receiver in good health keeps an acknowledgement back.
    pub(super) stalls: Stalls,
    /// What the kernel told, of all connections together.
    pub(super) kernel: ConnectionInfo,
}

impl StreamMetrics {
    /// Times the peer was connected to again.
    pub(super) fn reconnect_count(&self) -> u64 {
        self.connection_count.saturating_sub(1)
    }

    /// What the sending end reports; only it waits for acknowledgements.
    pub(super) fn of_sender(&self) -> EndReport {
        EndReport {
            counters: self.counters(),
            facts: vec![
                ("connections", connections(self)),
                ("waiting for acknowledgement", waiting(self)),
                ("TCP round trip", round_trip(self)),
                (
                    "segments",
                    format!(
                        "{} sent again",
                        optional(self.kernel.retransmitted_segments)
                    ),
                ),
            ],
            stalls: Some(self.stalls),
        }
    }

    /// What the receiving end reports.
    pub(super) fn of_receiver(&self) -> EndReport {
        let early = optional(self.kernel.out_of_order_segments);
        EndReport {
            counters: self.counters(),
            facts: vec![
                ("connections", connections(self)),
                ("segments", format!("{early} before their turn")),
            ],
            stalls: None,
        }
    }

    /// Every count with its name; times in microseconds. What the kernel did not tell is left out.
    fn counters(&self) -> Vec<(&'static str, u64)> {
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        let foreign_count = self.foreign_connection_count;
        let known = [
            ("connection_count", self.connection_count),
            ("reconnect_count", self.reconnect_count()),
            ("connection_ended_count", self.connection_ended_count),
            ("connect_failed_count", self.connect_failed_count),
            ("foreign_connection_count", foreign_count),
            ("unproven_connection_count", self.unproven_connection_count),
            ("bad_frame_count", self.bad_frame_count),
            ("cut_frame_count", self.cut_frame_count),
            ("abandoned_bytes", self.abandoned_bytes),
            ("backlog_bytes_max", self.backlog_bytes_max),
            ("backlogged_us", micros(self.backlogged)),
            ("waiting_bytes_max", self.waiting_bytes_max),
            ("stall_count", self.stalls.count),
            ("stalled_us", micros(self.stalls.total)),
            ("stall_longest_us", micros(self.stalls.longest)),
        ];
        let kernel = &self.kernel;
        let told = [
            ("busy_us", kernel.busy_us),
            ("window_limited_us", kernel.window_limited_us),
            ("buffer_limited_us", kernel.buffer_limited_us),
            ("retransmitted_segment_count", kernel.retransmitted_segments),
            ("out_of_order_segment_count", kernel.out_of_order_segments),
        ];
        let told = told
            .into_iter()
            .filter_map(|(key, count)| Some((key, count?)));
        known.into_iter().chain(told).collect()
    }
}

fn connections(figures: &StreamMetrics) -> String {
    let (count, reconnect_count) = (figures.connection_count, figures.reconnect_count());
    let mut words = vec![format!("{count}, {reconnect_count} of them reconnects")];
    for (what, count) in [
        ("failed attempts", figures.connect_failed_count),
        ("strangers turned away", figures.foreign_connection_count),
        (
            "ended from the peer's address without a datagram of the peer's",
            figures.unproven_connection_count,
        ),
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

fn waiting(figures: &StreamMetrics) -> String {
    let micros = Duration::from_micros;
    let busy = figures.kernel.busy_us.map(micros);
    let busy = busy.map_or("unavailable".to_owned(), milliseconds);
    let seen = figures.waiting_bytes_max;
    let mut words = vec![format!(
        "at most {seen} bytes seen, {busy} by the kernel's count"
    )];
    for (what, time) in [
        (
            "for a closed window",
            figures.kernel.window_limited_us.map(micros),
        ),
        (
            "for a full send buffer",
            figures.kernel.buffer_limited_us.map(micros),
        ),
        ("in the gateway's own buffer", Some(figures.backlogged)),
    ] {
        if let Some(time) = time.filter(|time| !time.is_zero()) {
            words.push(format!("{} {what}", milliseconds(time)));
        }
    }
    words.join(", ")
}

fn round_trip(figures: &StreamMetrics) -> String {
    let optional = |us: Option<u32>| {
        let time = us.map(|us| Duration::from_micros(us.into()));
        time.map_or("unavailable".to_owned(), milliseconds)
    };
    format!(
        "{} smoothed, deviation {}, smallest {}",
        optional(figures.kernel.rtt_us),
        optional(figures.kernel.rtt_variation_us),
        optional(figures.kernel.rtt_min_us)
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
        let expected = Stalls {
            count: 1,
            total: Duration::from_millis(300),
            longest: Duration::from_millis(300),
            threshold: Duration::from_millis(44),
        };
        let figures = StreamMetrics {
            connection_count: 2,
            stalls: expected,
            newest_errno: Some(libc::ECONNREFUSED),
            ..StreamMetrics::default()
        };
        let report = figures.of_sender();
        let of = |label: &str| {
            let mut found = report.facts.iter().filter(|(own, _)| *own == label);
            found.next().map(|(_, text)| text.as_str()).unwrap()
        };
        assert!(of("connections").starts_with("2, 1 of them reconnects"));
        assert!(
            of("connections").contains("refused"),
            "{}",
            of("connections")
        );
        assert_eq!(report.stalls, Some(expected));
        assert!(of("TCP round trip").starts_with("unavailable smoothed"));
        assert_eq!(of("segments"), "unavailable sent again");
    }
}
