//! Which memory and which clock a process sees. Read once at start; not on the measured path.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::error::DomainError;

/// Where iceoryx2's shared memory lives on Linux.
pub const SHARED_MEMORY_DIRECTORY: &str = "/dev/shm";

/// Sixteen bytes that two processes have in common exactly when their channels of this domain
/// share memory: same boot of the same kernel, same root directory, same `/dev/shm`, same prefix.
///
/// A gateway whose two ends report equal fingerprints is being bypassed.
pub(crate) fn fingerprint(root_path: &Path, prefix: &str) -> Result<[u8; 16], DomainError> {
    let mut hash = Fnv128::default();
    hash.add(boot_id()?.as_bytes());
    for directory in [root_path, Path::new(SHARED_MEMORY_DIRECTORY)] {
        let metadata = fs::metadata(directory).map_err(DomainError::io("inspect", directory))?;
        hash.add(&metadata.dev().to_le_bytes());
        hash.add(&metadata.ino().to_le_bytes());
    }
    hash.add(prefix.as_bytes());
    Ok(hash.0.to_le_bytes())
}

/// Identifies the monotonic clock this process reads; processes with equal ids read one clock.
///
/// Hashes the kernel's boot id, the time namespace and its monotonic offset. A kernel without
/// time namespaces has one clock per boot.
///
/// # Errors
/// When `/proc` is not mounted or not readable.
pub fn clock_id() -> Result<u64, DomainError> {
    const NAMESPACE: &str = "/proc/self/ns/time";
    const OFFSETS: &str = "/proc/self/timens_offsets";
    let mut hash = Fnv128::default();
    hash.add(boot_id()?.as_bytes());
    if Path::new(NAMESPACE).exists() {
        let namespace = fs::metadata(NAMESPACE).map_err(DomainError::io("inspect", NAMESPACE))?;
        hash.add(&namespace.ino().to_le_bytes());
        let offsets = fs::read_to_string(OFFSETS).map_err(DomainError::io("read", OFFSETS))?;
        for line in offsets.lines().filter(|line| line.starts_with("monotonic")) {
            hash.add(line.as_bytes());
        }
    }
    let bytes = hash.0.to_le_bytes();
    let [low, high] = [0, 1].map(|half| u64::from_le_bytes(bytes.as_chunks().0[half]));
    Ok(low ^ high)
}

fn boot_id() -> Result<String, DomainError> {
    const BOOT_ID: &str = "/proc/sys/kernel/random/boot_id";
    fs::read_to_string(BOOT_ID).map_err(DomainError::io("read", BOOT_ID))
}

/// FNV-1a with 128 bits; each part is closed by its length so that parts cannot run together.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Fnv128(pub(crate) u128);

impl Default for Fnv128 {
    fn default() -> Self {
        Self(0x6c62_272e_07bb_0142_62b8_2175_6295_c58d)
    }
}

impl Fnv128 {
    pub(crate) fn add(&mut self, part: &[u8]) {
        let length = (part.len() as u64).to_le_bytes();
        for byte in part.iter().chain(&length) {
            self.0 = (self.0 ^ u128::from(*byte)).wrapping_mul(0x0100_0000_0000_0000_0000_013b);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_id_is_stable_within_a_process() {
        assert_eq!(clock_id().unwrap(), clock_id().unwrap());
    }

    #[test]
    fn parts_do_not_run_together() {
        let hash = |parts: &[&str]| {
            let mut hash = Fnv128::default();
            for part in parts {
                hash.add(part.as_bytes());
            }
            hash.0
        };
        assert_ne!(hash(&["ab", "c"]), hash(&["a", "bc"]));
    }
}
