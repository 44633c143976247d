//! A probe at both ends of the wire for as long as it is wanted: the product's taps, filter and
//! writer, drained as `hil-runtime probe` drains them, by an ordinary thread. It measures nothing.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use hil_capture::flow::FlowFilter;
use hil_capture::writer::{self, PacketToWrite};
use hil_net::packet_ring::{PacketRing, RingCounters, RingSettings, RingStamps};

use super::hosts::SetupError;
use super::network::Network;

/// As in the product.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// The thread that drains; made before any thread claims a processor, whose priority and pinning
/// it would inherit.
#[derive(Debug)]
pub struct Drainer {
    rings: Sender<Vec<PacketRing>>,
    counts: Receiver<RingCounters>,
    is_wanted: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Drainer {
    /// Starts the thread; it sleeps until there are rings.
    pub fn start() -> Self {
        let (rings, incoming) = channel::<Vec<PacketRing>>();
        let (done, counts) = channel();
        let is_wanted = Arc::new(AtomicBool::new(false));
        let thread = thread::spawn({
            let is_wanted = Arc::clone(&is_wanted);
            move || {
                for mut taps in incoming {
                    let mut file = Vec::new();
                    while is_wanted.load(Ordering::Acquire) {
                        for ring in &mut taps {
                            drain(ring, &mut file);
                        }
                        thread::sleep(LOOK_PERIOD);
                    }
                    let mut sum = RingCounters::default();
                    for one in taps.iter_mut().filter_map(|ring| ring.counters().ok()) {
                        sum.matched_count += one.matched_count;
                        sum.dropped_count += one.dropped_count;
                    }
                    if done.send(sum).is_err() {
                        return;
                    }
                }
            }
        });
        Self {
            rings,
            counts,
            is_wanted,
            thread,
        }
    }

    /// Taps interfaces of hosts while `work` runs; gives what it gave, and what the kernel counted.
    ///
    /// # Errors
    /// When one cannot be tapped.
    pub fn while_tapped<T>(
        &self,
        network: &Network,
        places: &[(usize, &str)],
        work: impl FnOnce() -> T,
    ) -> Result<(T, RingCounters), SetupError> {
        let flow = FlowFilter::hil();
        let filters = [flow.packets];
        let settings = RingSettings {
            snap_bytes: u32::try_from(flow.snap_bytes())?,
            ring_bytes: 8 << 20,
            stamps: RingStamps::Kernel,
        };
        let open = |(host, name): &(usize, &str)| {
            network.on(*host, || PacketRing::open(name, &filters, &settings))
        };
        let taps: Result<Vec<PacketRing>, _> = places.iter().map(open).collect();
        let taps = taps?;
        self.is_wanted.store(true, Ordering::Release);
        let sent = self.rings.send(taps);
        sent.map_err(|_left| "the draining thread has ended")?;
        let outcome = work();
        self.is_wanted.store(false, Ordering::Release);
        Ok((outcome, self.counts.recv()?))
    }

    /// Ends the thread.
    pub fn finish(self) {
        drop(self.rings);
        let _ended = self.thread.join().is_ok();
    }
}

fn drain(ring: &mut PacketRing, file: &mut Vec<u8>) {
    while ring.next_packet(|packet| {
        let packet = PacketToWrite {
            interface_index: 0,
            stamp_ns: packet.stamp_ns,
            original_bytes: packet.original_bytes,
            direction: packet.direction,
            data: [packet.data, &[]],
        };
        writer::packet(file, &packet);
    }) {}
    file.clear();
}
