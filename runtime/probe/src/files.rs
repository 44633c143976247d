//! Captures from files to observations, with every fault on the way. Nothing is printed.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use flate2::bufread::MultiGzDecoder;
use hil_capture::CaptureInterface;
use hil_capture::observe::Observer;
use hil_capture::reader::{CaptureReader, Format, Step};

/// Bytes read at once.
const READ_BYTES: usize = 1 << 18;
/// What gzip begins with (RFC 1952).
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];
/// Faults told of one file; a broken one could have one in each block.
const FAULTS_TOLD_MAX: usize = 20;

/// What a file held.
#[derive(Debug)]
pub(super) struct CaptureFile {
    pub(super) path: PathBuf,
    pub(super) format: Option<&'static str>,
    pub(super) packet_count: u64,
    pub(super) interfaces: Vec<CaptureInterface>,
    /// In words with their offsets; the first few.
    pub(super) faults: Vec<String>,
    pub(super) fault_count: u64,
}

impl CaptureFile {
    fn fault(&mut self, words: String) {
        self.fault_count += 1;
        if self.faults.len() < FAULTS_TOLD_MAX {
            self.faults.push(words);
        }
    }

    /// What the file says was dropped while it was made; `None` when it does not say.
    pub(super) fn dropped_count(&self) -> Option<u64> {
        let said = self.interfaces.iter().filter_map(|one| one.dropped_count);
        said.reduce(u64::saturating_add)
    }
}

/// Why a file was not read at all.
#[derive(Debug, thiserror::Error)]
#[error("capture file {path}: {source}")]
pub(super) struct FileError {
    path: PathBuf,
    source: io::Error,
}

/// Reads a whole file; faults of the format are part of the result. Packets go to `observer`, and
/// once more to `of_cards` where the file has them with a card's stamp as well. `look` hears of each
/// piece how many bytes it was.
pub(super) fn read(
    path: &Path,
    file_index: usize,
    observer: &mut Observer,
    of_cards: &mut Observer,
    look: &mut dyn FnMut(usize),
) -> Result<CaptureFile, FileError> {
    let failed = |source| FileError {
        path: path.to_owned(),
        source,
    };
    let mut input = BufReader::with_capacity(READ_BYTES, File::open(path).map_err(failed)?);
    let is_packed = input.fill_buf().map_err(failed)?.starts_with(&GZIP_MAGIC);
    let mut input: Box<dyn Read> = if is_packed {
        Box::new(MultiGzDecoder::new(input))
    } else {
        Box::new(input)
    };
    let mut reader = CaptureReader::default();
    let mut chunk = vec![0; READ_BYTES];
    let mut file = CaptureFile {
        path: path.to_owned(),
        format: None,
        packet_count: 0,
        interfaces: Vec::new(),
        faults: Vec::new(),
        fault_count: 0,
    };
    loop {
        match reader.next_step() {
            Step::Packet(packet) if packet.is_nic_stamped => of_cards.take(file_index, &packet),
            Step::Packet(packet) => {
                file.packet_count += 1;
                observer.take(file_index, &packet);
            }
            Step::NeedsMore => match input.read(&mut chunk) {
                Ok(0) => reader.end(),
                Ok(length) => {
                    // How much is behind a packed file, it does not say.
                    look(if is_packed { 0 } else { length });
                    reader.feed(&chunk[..length]);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if is_packed => {
                    file.fault(format!("{}: gzip: {error}", path.display()));
                    reader.end();
                }
                Err(error) => return Err(failed(error)),
            },
            Step::Fault(fault) => {
                file.fault(format!("{}: {fault}", path.display()));
                // Behind any other the file ends: it tells of no time after that.
                if fault.is_passed {
                    observer.take_broken(file_index);
                }
            }
            Step::Ended => break,
        }
    }
    file.format = reader.format().map(Format::label);
    file.interfaces = reader.interfaces().to_vec();
    observer.finish(file_index, &file.interfaces);
    Ok(file)
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::*;

    #[test]
    fn a_packed_capture_is_read_and_a_cut_one_keeps_what_came() {
        let plain = include_bytes!("../../../gateways/capture/src/tests/cases/late_b.pcap");
        let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(plain).unwrap();
        let packed = encoder.finish().unwrap();
        let path = std::env::temp_dir().join(format!("hil-packed-{}", std::process::id()));
        let mut counts = Vec::new();
        for length in [packed.len(), packed.len() - 12] {
            std::fs::write(&path, &packed[..length]).unwrap();
            let mut observers = [Observer::new(&[]), Observer::new(&[])];
            let [observer, of_cards] = &mut observers;
            let file = read(&path, 0, observer, of_cards, &mut |_| {}).unwrap();
            counts.push((file.packet_count, file.fault_count));
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!(counts[0], (39, 0));
        assert!(counts[1].0 <= 39 && counts[1].1 > 0, "{counts:?}");
    }
}
