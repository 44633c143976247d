//! The one message an egress bridge holds, of whichever channel, laid out as its datagrams, so that its
//! payload is copied once. It is not a queue.

use hil_core::time::Instant;

use crate::fragment::FragmentPlan;
use crate::wire::{HEADER_BYTES, Header};

#[derive(Debug)]
pub(super) struct Staging {
    budget_bytes: usize,
    /// Header and piece of each fragment, back to back.
    buffer: Box<[u8]>,
    staged: Option<Staged>,
}

/// One datagram of the staged message.
#[derive(Debug)]
pub(super) struct Piece<'a> {
    pub(super) channel: usize,
    pub(super) header: Header,
    pub(super) is_last: bool,
    pub(super) datagram: &'a [u8],
}

#[derive(Debug, Clone, Copy)]
struct Staged {
    channel: usize,
    header: Header,
    plan: FragmentPlan,
    since: Instant,
}

impl Staging {
    /// With room for pieces of `least_budget_bytes`.
    pub(super) fn new(size_max_bytes: usize, least_budget_bytes: usize) -> Self {
        let count = size_max_bytes.div_ceil(least_budget_bytes).max(1);
        Self {
            budget_bytes: least_budget_bytes,
            buffer: vec![0; count * HEADER_BYTES + size_max_bytes].into_boxed_slice(),
            staged: None,
        }
    }

    /// Cuts messages into pieces of at most so many bytes from now on, no fewer than there is room for.
    pub(super) const fn cut_at(&mut self, budget_bytes: usize) {
        self.budget_bytes = budget_bytes;
    }

    /// `header` needs no length, fragment or hand-over fields yet.
    pub(super) fn stage(
        &mut self,
        now: Instant,
        channel: usize,
        mut header: Header,
        payload: &[u8],
    ) {
        let plan = FragmentPlan::new(payload.len(), self.budget_bytes)
            .expect("settings bound the fragments of the largest message");
        header.total_len = u32::try_from(payload.len()).expect("size_max_bytes is a u32");
        header.fragment_count = plan.count();
        for index in 0..plan.count() {
            let range = plan.range(index).expect("index is below the count");
            let start = place(&plan, index) + HEADER_BYTES;
            self.buffer[start..start + range.len()].copy_from_slice(&payload[range]);
        }
        self.staged = Some(Staged {
            channel,
            header,
            plan,
            since: now,
        });
    }

    /// The next datagram.
    pub(super) fn next(&mut self, now: Instant) -> Piece<'_> {
        let staged = self.staged.as_mut().expect("called only while pending");
        let mut header = staged.header;
        header.handed_ns = now.as_ns();
        let index = header.fragment_index;
        let range = staged.plan.range(index).expect("index is below the count");
        let is_last = index + 1 == staged.plan.count();
        let start = place(&staged.plan, index);
        let channel = staged.channel;
        staged.header.fragment_index = index + 1;
        if is_last {
            self.staged = None;
        }
        let datagram = &mut self.buffer[start..start + HEADER_BYTES + range.len()];
        header.encode(datagram);
        Piece {
            channel,
            header,
            is_last,
            datagram,
        }
    }

    pub(super) const fn is_pending(&self) -> bool {
        self.staged.is_some()
    }

    pub(super) fn staged_at(&self) -> Option<Instant> {
        self.staged.as_ref().map(|staged| staged.since)
    }

    /// Forgets the staged message; the channel whose it was.
    pub(super) fn abandon(&mut self) -> Option<usize> {
        self.staged.take().map(|staged| staged.channel)
    }
}

fn place(plan: &FragmentPlan, index: u16) -> usize {
    usize::from(index) * (HEADER_BYTES + plan.fragment_bytes())
}
