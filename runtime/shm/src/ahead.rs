//! Memory for a writer's next message, borrowed once the last one has left rather than while the
//! next one waits: iceoryx2 0.10 collects returned chunks and allocates its own bookkeeping with
//! every loan. It holds at most one; what is in it is the port's business.

use core::fmt;

use iceoryx2::port::LoanError;

/// One loan in hand, or none if the last attempt failed.
pub(crate) struct Ahead<L>(Option<L>);

impl<L> Ahead<L> {
    /// Keeps what was lent. A refusal is not lost: the next [`Ahead::take`] asks again.
    pub(crate) fn keep(lent: Result<L, LoanError>) -> Self {
        Self(lent.ok())
    }

    /// The memory in hand, or else what `lend` gives now.
    pub(crate) fn take(
        &mut self,
        lend: impl FnOnce() -> Result<L, LoanError>,
    ) -> Result<L, LoanError> {
        self.0.take().map_or_else(lend, Ok)
    }
}

impl<L> fmt::Debug for Ahead<L> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ahead")
            .field("is_lent", &self.0.is_some())
            .finish()
    }
}
