//! How much room an observer of a channel is given.

use hil_core::message::Envelope;

/// Memory that the waiting messages of one observer may take, bytes. A writer's memory holds as
/// many for each of its readers, so this is small.
const WAITING_BYTES_MAX: usize = 256 << 10;
/// Messages that may wait at most: a quarter of a second at 4 kHz.
const DEPTH_MAX: usize = 1024;
/// Messages that may wait in any case.
const DEPTH_MIN: usize = 4;

/// How many messages may wait for an observer of a channel whose messages have `size_bytes`: deeper
/// than a consumer's queue, for an observer comes by every few milliseconds and without priority.
pub fn observer_depth(size_bytes: usize) -> usize {
    let each = size_bytes.saturating_add(size_of::<Envelope>());
    (WAITING_BYTES_MAX / each).clamp(DEPTH_MIN, DEPTH_MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_observer_has_room_for_many_small_messages_and_for_some_large_ones() {
        assert_eq!(observer_depth(8), DEPTH_MAX);
        assert_eq!(observer_depth(192), 1024);
        assert_eq!(observer_depth(8 << 10), 31);
        assert_eq!(observer_depth(usize::MAX), DEPTH_MIN);
    }
}
