//! What a stream transport counts beyond the datagrams. It measures nothing itself.

use core::sync::atomic::{AtomicU64, Ordering};
use core::time::Duration;

use hil_net::tcp_info::ConnectionInfo;

/// How often connections came and went, for a thread that tells of it while another carries
/// messages.
#[derive(Debug, Default)]
pub struct ConnectionTally {
    begun: AtomicU64,
    ended: AtomicU64,
}

impl ConnectionTally {
    pub(super) fn begin(&self) {
        self.begun.fetch_add(1, Ordering::Release);
    }

    pub(super) fn end(&self) {
        self.ended.fetch_add(1, Ordering::Release);
    }

    /// Connections that came about.
    pub fn begun_count(&self) -> u64 {
        self.begun.load(Ordering::Acquire)
    }

    /// Connections that ended.
    pub fn ended_count(&self) -> u64 {
        self.ended.load(Ordering::Acquire)
    }
}

/// Everything one end of a stream transport saw since it was opened, over all its connections.
/// What the kernel did not tell is `None`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StreamFigures {
    /// Connections that came about; all but the first are reconnects.
    pub connection_count: u64,
    /// Of those, ended while this end was open.
    pub connection_ended_count: u64,
    /// Attempts to connect that failed.
    pub connect_failed_count: u64,
    /// The errno of the newest attempt that failed or connection that ended; 0 when the peer closed
    /// it in order.
    pub newest_errno: Option<i32>,
    /// Connections of others than the peer's host, turned away.
    pub foreign_connection_count: u64,
    /// Connections closed for a length that no frame has.
    pub bad_frame_count: u64,
    /// Frames of which the end of a connection cut off the rest.
    pub cut_frame_count: u64,
    /// Bytes that were accepted and not acknowledged when their connection ended.
    pub abandoned_bytes: u64,
    /// Most bytes that waited in our own buffer at a time.
    pub backlog_bytes_max: u64,
    /// Time during which any did.
    pub backlogged: Duration,
    /// Most bytes seen waiting for an acknowledgement, in our buffer or in the kernel's.
    pub waiting_bytes_max: u64,
    /// A byte that waits longer than this is stalled: twice the smallest round trip and 50 ms,
    /// the longest that a receiver in good health keeps an acknowledgement back.
    pub stall_threshold: Duration,
    /// Stalls: spans in which the oldest unacknowledged byte was stalled.
    pub stall_count: u64,
    /// Their length together, each from when its first byte was sent.
    pub stalled: Duration,
    /// The longest.
    pub stall_longest: Duration,
    /// Time with data under way or waiting for it, as the kernel counts.
    pub busy: Option<Duration>,
    /// Of that, while the receiver's window was closed: the peer did not read.
    pub window_limited: Option<Duration>,
    /// Of that, while the send buffer was full.
    pub buffer_limited: Option<Duration>,
    /// Segments sent again.
    pub retransmitted_segment_count: Option<u64>,
    /// Segments that came before their turn.
    pub out_of_order_segment_count: Option<u64>,
    /// Smoothed round trip of the newest connection.
    pub rtt: Option<Duration>,
    /// Its mean deviation.
    pub rtt_variation: Option<Duration>,
    /// The smallest round trip of the newest connection.
    pub rtt_min: Option<Duration>,
}

impl StreamFigures {
    /// Adds what the kernel says of a connection.
    pub(super) fn add(&mut self, info: &ConnectionInfo) {
        let micros = |us: u32| Duration::from_micros(us.into());
        add(&mut self.busy, info.busy_us.map(Duration::from_micros));
        add(
            &mut self.window_limited,
            info.window_limited_us.map(Duration::from_micros),
        );
        add(
            &mut self.buffer_limited,
            info.buffer_limited_us.map(Duration::from_micros),
        );
        add(
            &mut self.retransmitted_segment_count,
            info.retransmitted_segments.map(u64::from),
        );
        add(
            &mut self.out_of_order_segment_count,
            info.out_of_order_segments.map(u64::from),
        );
        self.rtt = info.rtt_us.map(micros);
        self.rtt_variation = info.rtt_variation_us.map(micros);
        self.rtt_min = info.rtt_min_us.map(micros);
    }

    /// Times the peer was connected to again.
    pub fn reconnect_count(&self) -> u64 {
        self.connection_count.saturating_sub(1)
    }

    /// Every count with its name; times in microseconds. What the kernel did not tell is left out.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        [
            ("connection_count", Some(self.connection_count)),
            ("reconnect_count", Some(self.reconnect_count())),
            ("connection_ended_count", Some(self.connection_ended_count)),
            ("connect_failed_count", Some(self.connect_failed_count)),
            (
                "foreign_connection_count",
                Some(self.foreign_connection_count),
            ),
            ("bad_frame_count", Some(self.bad_frame_count)),
            ("cut_frame_count", Some(self.cut_frame_count)),
            ("abandoned_bytes", Some(self.abandoned_bytes)),
            ("backlog_bytes_max", Some(self.backlog_bytes_max)),
            ("backlogged_us", Some(micros(self.backlogged))),
            ("waiting_bytes_max", Some(self.waiting_bytes_max)),
            ("stall_count", Some(self.stall_count)),
            ("stalled_us", Some(micros(self.stalled))),
            ("stall_longest_us", Some(micros(self.stall_longest))),
            ("busy_us", self.busy.map(micros)),
            ("window_limited_us", self.window_limited.map(micros)),
            ("buffer_limited_us", self.buffer_limited.map(micros)),
            (
                "retransmitted_segment_count",
                self.retransmitted_segment_count,
            ),
            (
                "out_of_order_segment_count",
                self.out_of_order_segment_count,
            ),
        ]
        .into_iter()
        .filter_map(|(name, count)| Some((name, count?)))
    }
}

fn add<T: core::ops::Add<Output = T> + Copy>(sum: &mut Option<T>, more: Option<T>) {
    *sum = match (*sum, more) {
        (Some(sum), Some(more)) => Some(sum + more),
        (sum, more) => sum.or(more),
    };
}
