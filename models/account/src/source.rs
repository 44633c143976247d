//! Where the records of an account come from: memory, or files that are read as often as they are
//! asked for, so that an hour of messages need not be in memory. It opens nothing itself.

use core::fmt::Debug;

/// The records of one kind, in the order they were written.
pub trait RecordSource<R>: Debug {
    /// How many.
    fn count(&self) -> u64;

    /// All of them from the first on; every call gives the same ones.
    fn each(&self) -> Box<dyn Iterator<Item = R> + '_>;
}

impl<R: Copy + Debug> RecordSource<R> for Vec<R> {
    fn count(&self) -> u64 {
        self.len() as u64
    }

    fn each(&self) -> Box<dyn Iterator<Item = R> + '_> {
        Box::new(self.iter().copied())
    }
}

impl<R: Copy + Debug, const N: usize> RecordSource<R> for [R; N] {
    fn count(&self) -> u64 {
        N as u64
    }

    fn each(&self) -> Box<dyn Iterator<Item = R> + '_> {
        Box::new(self.iter().copied())
    }
}

/// The records of a file that may not be at hand; none when it is not.
pub fn each<'a, R: 'a>(
    source: Option<&'a dyn RecordSource<R>>,
) -> impl Iterator<Item = R> + use<'a, R> {
    source.into_iter().flat_map(RecordSource::each)
}
