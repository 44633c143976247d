//! Captures from files to observations, with every fault on the way. Nothing is printed.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use hil_capture::CaptureInterface;
use hil_capture::observe::Observer;
use hil_capture::reader::{CaptureReader, Format, Step};

/// Bytes read at once.
const READ_BYTES: usize = 1 << 18;
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
    /// What the file says was dropped while it was made; `None` when it does not say.
    pub(super) fn dropped_count(&self) -> Option<u64> {
        let said = self.interfaces.iter().filter_map(|one| one.dropped_count);
        said.reduce(|a, b| a + b)
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
    let mut input = File::open(path).map_err(failed)?;
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
                    look(length);
                    reader.feed(&chunk[..length]);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(failed(error)),
            },
            Step::Fault(fault) => {
                file.fault_count += 1;
                if file.faults.len() < FAULTS_TOLD_MAX {
                    file.faults.push(format!("{}: {fault}", path.display()));
                }
            }
            Step::Ended => break,
        }
    }
    file.format = reader.format().map(Format::label);
    file.interfaces = reader.interfaces().to_vec();
    observer.widen(file_index, &file.interfaces);
    Ok(file)
}
