//! Numbers out of bytes of either order. It knows no format.

/// Order of a file's numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

/// Bytes, and the order of the numbers among them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Numbers<'a> {
    pub(super) order: ByteOrder,
    pub(super) bytes: &'a [u8],
}

impl Numbers<'_> {
    pub(super) fn u16(self, offset: usize) -> Option<u16> {
        self.lowest_first(offset).map(u16::from_le_bytes)
    }

    pub(super) fn u32(self, offset: usize) -> Option<u32> {
        self.lowest_first(offset).map(u32::from_le_bytes)
    }

    pub(super) fn u64(self, offset: usize) -> Option<u64> {
        self.lowest_first(offset).map(u64::from_le_bytes)
    }

    fn lowest_first<const N: usize>(self, offset: usize) -> Option<[u8; N]> {
        let mut array = array_at(self.bytes, offset)?;
        if self.order == ByteOrder::Big {
            array.reverse();
        }
        Some(array)
    }
}

/// `N` bytes from `offset`; `None` when they are not all there.
pub(super) fn array_at<const N: usize>(bytes: &[u8], offset: usize) -> Option<[u8; N]> {
    bytes.get(offset..)?.first_chunk().copied()
}
