//! The file of a live capture: packets as they were on the wire, whole blocks only, whatever the disk
//! does.

use std::fs::File;
use std::io::{self, Seek, Write};
use std::path::{Path, PathBuf};

use hil_capture::writer::{self, PacketToWrite};
use hil_net::link_type as link;
use hil_net::ring_frame::RingPacket;

use super::live::LiveError;

/// Bytes gathered before they are written.
const WRITE_BYTES: usize = 1 << 18;

/// A capture file that grows by whole blocks.
pub(super) struct Output {
    path: PathBuf,
    file: File,
    buffer: Vec<u8>,
    written_bytes: u64,
}

impl Output {
    pub(super) fn create(path: &Path, replaces: bool) -> Result<Self, LiveError> {
        let mut options = File::options();
        options.write(true);
        if replaces {
            options.create(true).truncate(true);
        } else {
            options.create_new(true);
        }
        let path = path.to_owned();
        match options.open(&path) {
            Ok(file) => Ok(Self {
                path,
                file,
                buffer: Vec::with_capacity(2 * WRITE_BYTES),
                written_bytes: 0,
            }),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                Err(LiveError::Exists { path })
            }
            Err(source) => Err(LiveError::File { path, source }),
        }
    }

    /// Bytes in the file.
    pub(super) fn written_bytes(&self) -> u64 {
        self.written_bytes
    }

    /// What is to be written next.
    pub(super) fn buffer(&mut self) -> &mut Vec<u8> {
        &mut self.buffer
    }

    pub(super) fn write_if_full(&mut self) -> Result<(), LiveError> {
        if self.buffer.len() < WRITE_BYTES {
            return Ok(());
        }
        self.write_out()
    }

    /// Whole blocks only: where the disk fills up within one, that one is taken back.
    pub(super) fn write_out(&mut self) -> Result<(), LiveError> {
        let outcome = self.file.write_all(&self.buffer);
        if let Err(source) = outcome {
            // Where writing failed cutting may fail too; the first error is the one to fix.
            let _cut = self.cut_to_whole_blocks().is_ok();
            return Err(self.failed(source));
        }
        self.written_bytes += self.buffer.len() as u64;
        self.buffer.clear();
        Ok(())
    }

    fn cut_to_whole_blocks(&mut self) -> io::Result<()> {
        let there_bytes = self
            .file
            .stream_position()?
            .saturating_sub(self.written_bytes);
        let whole_bytes = whole_blocks(&self.buffer, there_bytes);
        self.file.set_len(self.written_bytes + whole_bytes)
    }

    /// Writes the rest and waits until the disk has it.
    pub(super) fn finish(&mut self) -> Result<(), LiveError> {
        self.write_out()?;
        self.file.sync_all().map_err(|source| self.failed(source))
    }

    fn failed(&self, source: io::Error) -> LiveError {
        LiveError::File {
            path: self.path.clone(),
            source,
        }
    }
}

/// Bytes of the blocks in `buffer` that end within its first `there_bytes`.
fn whole_blocks(buffer: &[u8], there_bytes: u64) -> u64 {
    let mut whole = 0_usize;
    while let Some(length) = buffer.get(whole + 4..whole + 8) {
        let length = length.try_into().map_or(0, u32::from_le_bytes) as usize;
        if length == 0 || (whole + length) as u64 > there_bytes {
            break;
        }
        whole += length;
    }
    whole as u64
}

/// Puts a packet into the file as it was on the wire, with the VLAN tag the kernel took out.
pub(super) fn append(
    buffer: &mut Vec<u8>,
    interface_index: u32,
    packet: &RingPacket<'_>,
    link_type: u16,
) {
    let is_ethernet = link_type == link::ETHERNET;
    let mut whole = PacketToWrite {
        interface_index,
        stamp_ns: packet.stamp_ns,
        original_bytes: packet.original_bytes,
        direction: packet.direction,
        data: [packet.data, &[]],
    };
    let Some((tag_type, tag)) = packet
        .vlan
        .filter(|_| is_ethernet && packet.data.len() >= 12)
    else {
        writer::packet(buffer, &whole);
        return;
    };
    let (addresses, rest) = packet.data.split_at(12);
    let mut head = addresses.to_vec();
    head.extend_from_slice(&tag_type.to_be_bytes());
    head.extend_from_slice(&tag.to_be_bytes());
    whole.data = [&head, rest];
    whole.original_bytes += 4;
    writer::packet(buffer, &whole);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_could_not_grow_is_cut_behind_its_last_whole_block() {
        let mut buffer = Vec::new();
        writer::begin(&mut buffer, "test", "none");
        let head = buffer.len() as u64;
        writer::statistics(&mut buffer, 0, 0, 1, 2, 3, None);
        let all = buffer.len() as u64;
        for (there, whole) in [
            (0, 0),
            (head - 1, 0),
            (head, head),
            (all - 1, head),
            (all, all),
        ] {
            assert_eq!(whole_blocks(&buffer, there), whole, "{there} of {all}");
        }
    }
}
