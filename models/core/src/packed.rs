//! Whole numbers in as few bytes as they need: what is kept of every message of a long run. It knows
//! nothing of what the numbers mean.

/// Appends `value`; small magnitudes take few bytes (zigzag, then seven bits to a byte).
pub fn put(bytes: &mut Vec<u8>, value: i64) {
    let mut left = ((value << 1) ^ (value >> 63)).cast_unsigned();
    while left >= 0x80 {
        bytes.push(left.to_le_bytes()[0] | 0x80);
        left >>= 7;
    }
    bytes.push(left.to_le_bytes()[0]);
}

/// Reads what [`put`] wrote, number by number.
#[derive(Debug, Clone)]
pub struct Unpacked<'a>(pub &'a [u8]);

impl Iterator for Unpacked<'_> {
    type Item = i64;

    fn next(&mut self) -> Option<i64> {
        let (mut value, mut shift) = (0_u64, 0_u32);
        loop {
            let (byte, rest) = self.0.split_first()?;
            self.0 = rest;
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                break;
            }
            shift += 7;
        }
        Some((value >> 1).cast_signed() ^ -((value & 1).cast_signed()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::RandomStream;

    #[test]
    fn numbers_of_every_size_come_back() {
        let mut random = RandomStream::new(7, "measure.packed");
        let mut values = vec![0, 1, -1, 63, -64, 64, i64::MAX, i64::MIN];
        values.extend((0..10_000).map(|index| random.next_u64().cast_signed() >> (index % 64)));
        let mut bytes = Vec::new();
        for value in &values {
            put(&mut bytes, *value);
        }
        assert_eq!(Unpacked(&bytes).collect::<Vec<_>>(), values);
        let mut one = Vec::new();
        put(&mut one, -64);
        assert_eq!(one.len(), 1);
    }
}
