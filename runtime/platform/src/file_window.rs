//! A window of a file in memory: what is written there is in the file without a call of the kernel, and
//! stays in it however the process ends.

use core::sync::atomic::{AtomicU64, Ordering};
use std::fs::File;
use std::io;

use memmap2::{MmapOptions, MmapRaw};
use nix::sys::statfs::{EXT4_SUPER_MAGIC, TMPFS_MAGIC, XFS_SUPER_MAGIC, fstatfs};

/// Bytes of a file that are mapped, writable and present.
#[derive(Debug)]
pub struct FileWindow {
    map: MmapRaw,
}

impl FileWindow {
    /// The `bytes` bytes of `file` from `offset`. They must have been written before, so that the file
    /// system has room for them: for a page without room the kernel sends SIGBUS, which ends the process.
    ///
    /// # Errors
    /// When the file is not open for reading and writing, or there is no address space or lockable memory left.
    pub fn new(file: &File, offset: u64, bytes: usize) -> io::Result<Self> {
        let mut options = MmapOptions::new();
        let map = options.offset(offset).len(bytes).populate();
        Ok(Self {
            map: map.map_raw(file)?,
        })
    }

    /// Copies `bytes` to byte `at` of the window.
    ///
    /// # Panics
    /// When they reach beyond it.
    #[allow(
        unsafe_code,
        reason = "others may look at the file meanwhile, so it is no slice"
    )]
    pub fn write(&mut self, at: usize, bytes: &[u8]) {
        assert!(at + bytes.len() <= self.map.len(), "beyond the window");
        let place = self.map.as_mut_ptr().wrapping_add(at);
        // SAFETY: the destination lies within the mapping, and no reference to the mapping exists.
        unsafe { core::ptr::copy_nonoverlapping(bytes.as_ptr(), place, bytes.len()) }
    }

    /// Stores `number` at byte `at` of the window, little-endian, after all that was written before.
    ///
    /// # Panics
    /// When it reaches beyond the window or does not lie on a multiple of eight bytes in memory.
    #[allow(unsafe_code, reason = "the number lies in memory that others read")]
    #[allow(clippy::cast_ptr_alignment, reason = "it is looked at first")]
    pub fn publish(&mut self, at: usize, number: u64) {
        assert!(at + size_of::<u64>() <= self.map.len(), "beyond the window");
        let place = self.map.as_mut_ptr().wrapping_add(at).cast::<u64>();
        assert!(place.is_aligned(), "an atomic number is aligned");
        // SAFETY: the place is aligned, within the mapping and used as an atomic number only.
        let place = unsafe { AtomicU64::from_ptr(place) };
        place.store(number.to_le(), Ordering::Release);
    }
}

/// Whether the file system of `file` writes a page again where it was: one that copies on write needs
/// new room for that, and where there is none a window ends in SIGBUS.
pub fn keeps_its_room(file: &File) -> bool {
    fstatfs(file).is_ok_and(|of| {
        [EXT4_SUPER_MAGIC, TMPFS_MAGIC, XFS_SUPER_MAGIC].contains(&of.filesystem_type())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::FileExt;
    use std::{env, fs, process};

    #[test]
    fn what_is_written_in_a_window_is_in_the_file() {
        let path = env::temp_dir().join(format!("hil-window-{}", process::id()));
        let file = File::create_new(&path).unwrap();
        file.write_all_at(&[7; 10_000], 0).unwrap();
        let mut window = FileWindow::new(&file, 5_000, 100).unwrap();
        window.write(98, &[1, 2]);
        window.publish(0, 3);
        drop(window);
        let mut expected = vec![7; 10_000];
        expected[5_098..5_100].copy_from_slice(&[1, 2]);
        expected[5_000..5_008].copy_from_slice(&[3, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(fs::read(&path).unwrap(), expected);
        fs::remove_file(&path).unwrap();
    }

    #[test]
    #[should_panic(expected = "beyond the window")]
    fn nothing_is_written_beyond_a_window() {
        let path = env::temp_dir().join(format!("hil-beyond-{}", process::id()));
        let file = File::create_new(&path).unwrap();
        fs::remove_file(&path).unwrap();
        file.write_all_at(&[7; 10_000], 0).unwrap();
        FileWindow::new(&file, 0, 100).unwrap().write(99, &[1, 2]);
    }

    #[test]
    fn a_window_is_used_only_where_a_page_keeps_its_room() {
        assert!(!keeps_its_room(&File::open("/proc/self/stat").unwrap()));
        assert!(keeps_its_room(&File::open("/dev/shm").unwrap()));
    }
}
