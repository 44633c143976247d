//! The kernel's `bpf` call, as far as a tap needs it (Linux `include/uapi/linux/bpf.h`): a map that the
//! process sees as memory, a program, its place on an interface. Everything lives as long as its
//! descriptor: when the process ends, however it ends, the kernel takes all of it back.
//!
//! `unsafe` is allowed here because no crate that the real-time binary may have wraps this call, and
//! the map is memory that the kernel writes.

use core::ffi::{c_long, c_uint};
use core::num::NonZeroUsize;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU64;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};

use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};

use super::bpf_code::Instruction;

/// Commands.
mod command {
    pub(super) const MAP_CREATE: u32 = 0;
    pub(super) const PROG_LOAD: u32 = 5;
    #[cfg(test)]
    pub(super) const PROG_TEST_RUN: u32 = 10;
    pub(super) const PROG_QUERY: u32 = 16;
    pub(super) const LINK_CREATE: u32 = 28;
}

const MAP_TYPE_ARRAY: u32 = 2;
/// The process may map it; since Linux 5.5.
const F_MMAPABLE: u32 = 1 << 10;
const PROG_TYPE_SCHED_CLS: u32 = 3;
/// What the kernel calls map and program when it lists them.
const NAME: [u8; 16] = *b"hil_tap\0\0\0\0\0\0\0\0\0";
const LICENCE: &core::ffi::CStr = c"MIT";
/// In front of all programs that are there.
const F_BEFORE: u32 = 1 << 3;
const LOG_BYTES: u32 = 1 << 20;

/// Where at an interface a program is run; since Linux 6.6.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    /// `BPF_TCX_INGRESS`.
    Arrivals,
    /// `BPF_TCX_EGRESS`.
    Departures,
}

impl Place {
    const fn number(self) -> u32 {
        match self {
            Self::Arrivals => 46,
            Self::Departures => 47,
        }
    }
}

#[repr(C)]
#[derive(Debug, Default)]
struct MapCreate {
    map_type: u32,
    key_size: u32,
    value_size: u32,
    max_entries: u32,
    map_flags: u32,
    inner_map_fd: u32,
    numa_node: u32,
    map_name: [u8; 16],
}

#[repr(C)]
#[derive(Debug, Default)]
struct ProgLoad {
    prog_type: u32,
    insn_cnt: u32,
    insns: u64,
    license: u64,
    log_level: u32,
    log_size: u32,
    log_buf: u64,
    kern_version: u32,
    prog_flags: u32,
    prog_name: [u8; 16],
}

#[repr(C)]
#[derive(Debug, Default)]
struct LinkCreate {
    prog_fd: u32,
    target_ifindex: u32,
    attach_type: u32,
    flags: u32,
    relative_fd: u32,
    padding: u32,
    expected_revision: u64,
}

#[repr(C)]
#[derive(Debug, Default)]
struct ProgQuery {
    target_ifindex: u32,
    attach_type: u32,
    query_flags: u32,
    attach_flags: u32,
    prog_ids: u64,
    prog_cnt: u32,
    padding: u32,
    rest: [u64; 4],
}

#[allow(unsafe_code, reason = "no crate wraps this call")]
fn bpf<T>(command: u32, attribute: &mut T) -> io::Result<c_long> {
    let pointer = &raw mut *attribute;
    // SAFETY: the kernel reads and writes at most the size given at `pointer`, a live structure of that
    // size. What the addresses within point to is kept alive by the callers.
    let result = unsafe { libc::syscall(libc::SYS_bpf, command, pointer, size_of::<T>()) };
    if result < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(result)
}

#[allow(unsafe_code, reason = "the call gives a bare number")]
fn descriptor(result: c_long) -> io::Result<OwnedFd> {
    let number = RawFd::try_from(result).map_err(io::Error::other)?;
    // SAFETY: the kernel has just given this descriptor, and nobody else knows it.
    Ok(unsafe { OwnedFd::from_raw_fd(number) })
}

fn number(descriptor: &OwnedFd) -> u32 {
    descriptor.as_raw_fd().unsigned_abs()
}

fn address<T: ?Sized>(of: &T) -> u64 {
    (&raw const *of).cast::<u8>().addr() as u64
}

/// Most programs that can be running at once, one on each processor.
#[allow(unsafe_code, reason = "nix has no such constant without a feature")]
pub(super) fn processor_count() -> usize {
    // SAFETY: the call takes a number.
    let count = unsafe { libc::sysconf(libc::_SC_NPROCESSORS_CONF) };
    usize::try_from(count).unwrap_or(1).max(1)
}

/// A map of one value.
pub(super) fn create_map(value_bytes: usize) -> io::Result<OwnedFd> {
    let mut attribute = MapCreate {
        map_type: MAP_TYPE_ARRAY,
        key_size: 4,
        value_size: u32::try_from(value_bytes).map_err(io::Error::other)?,
        max_entries: 1,
        map_flags: F_MMAPABLE,
        map_name: NAME,
        ..MapCreate::default()
    };
    descriptor(bpf(command::MAP_CREATE, &mut attribute)?)
}

/// Has the kernel check and translate a program. Where it refuses with more than a number, the last
/// line of what it says is part of the error.
pub(super) fn load_program(code: &[Instruction]) -> io::Result<OwnedFd> {
    let mut attribute = ProgLoad {
        prog_type: PROG_TYPE_SCHED_CLS,
        insn_cnt: u32::try_from(code.len()).map_err(io::Error::other)?,
        insns: address(code),
        license: address(LICENCE),
        prog_name: NAME,
        ..ProgLoad::default()
    };
    let error = match bpf(command::PROG_LOAD, &mut attribute) {
        Ok(result) => return descriptor(result),
        Err(error) => error,
    };
    let refuses_the_code = matches!(error.raw_os_error(), Some(libc::EACCES | libc::EINVAL));
    if !refuses_the_code {
        return Err(error);
    }
    // Only now, as filling the log takes the kernel far longer than the check.
    let mut log = vec![0_u8; LOG_BYTES as usize];
    attribute.log_level = 1;
    attribute.log_size = LOG_BYTES;
    attribute.log_buf = log.as_mut_ptr().expose_provenance() as u64;
    let Err(error) = bpf(command::PROG_LOAD, &mut attribute) else {
        return Err(io::Error::other("refused once, then taken"));
    };
    let end = log.iter().position(|byte| *byte == 0).unwrap_or(log.len());
    let said = String::from_utf8_lossy(&log[..end]);
    let counted = |line: &&str| !line.trim().is_empty() && !line.starts_with("processed ");
    match said.lines().rev().find(counted) {
        Some(line) => Err(io::Error::new(error.kind(), format!("{error}: {line}"))),
        None => Err(error),
    }
}

/// Has a program run for the packets of an interface until the descriptor is closed: what arrives
/// before all other programs, what leaves after them.
pub(super) fn attach(
    program: &OwnedFd,
    interface_index: c_uint,
    place: Place,
) -> io::Result<OwnedFd> {
    let mut attribute = LinkCreate {
        prog_fd: number(program),
        target_ifindex: interface_index,
        attach_type: place.number(),
        flags: match place {
            Place::Arrivals => F_BEFORE,
            Place::Departures => 0,
        },
        ..LinkCreate::default()
    };
    descriptor(bpf(command::LINK_CREATE, &mut attribute)?)
}

/// Programs of anyone that run for the packets of an interface. The kernel lists numbers; it tells whose
/// they are only who may administer the system, so they are counted and not named.
pub(super) fn attached_count(interface_index: c_uint, place: Place) -> io::Result<u32> {
    let mut attribute = ProgQuery {
        target_ifindex: interface_index,
        attach_type: place.number(),
        ..ProgQuery::default()
    };
    match bpf(command::PROG_QUERY, &mut attribute) {
        Ok(_) => Ok(attribute.prog_cnt),
        // Where nothing was ever attached there is no list.
        Err(error) if error.raw_os_error() == Some(libc::ENOENT) => Ok(0),
        Err(error) => Err(error),
    }
}

/// A map's value as words that the kernel's programs and this process both touch.
#[derive(Debug)]
pub(super) struct SharedWords {
    start: NonNull<AtomicU64>,
    count: usize,
    length: NonZeroUsize,
}

#[allow(
    unsafe_code,
    reason = "a tap may be looked into by another thread than opened it"
)]
// SAFETY: the memory belongs to the process, not to a thread, and is touched only atomically.
unsafe impl Send for SharedWords {}

impl SharedWords {
    #[allow(unsafe_code, reason = "mapping memory is what this is for")]
    pub(super) fn of(map: &OwnedFd, value_bytes: usize) -> io::Result<Self> {
        let length = NonZeroUsize::new(value_bytes).ok_or(io::ErrorKind::InvalidInput)?;
        let access = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
        // Populated now, so that the reader misses no page later.
        let flags = MapFlags::MAP_SHARED | MapFlags::MAP_POPULATE;
        // SAFETY: a fresh mapping at an address of the kernel's choice overlaps nothing.
        let start = unsafe { mmap(None, length, access, flags, map, 0) }?;
        Ok(Self {
            start: start.cast(),
            count: value_bytes / size_of::<AtomicU64>(),
            length,
        })
    }

    #[allow(unsafe_code, reason = "see `SharedWords::of`")]
    pub(super) fn words(&self) -> &[AtomicU64] {
        // SAFETY: a mapping begins with a page, so it is aligned; it is as long as that and lives as
        // long as `self`; nobody in this process has other access to it than through these atomics.
        unsafe { core::slice::from_raw_parts(self.start.as_ptr(), self.count) }
    }
}

impl Drop for SharedWords {
    #[allow(unsafe_code, reason = "see `SharedWords::of`")]
    fn drop(&mut self) {
        // SAFETY: made by mmap with this length, and borrows of its words have ended.
        let _unmapped = unsafe { munmap(self.start.cast(), self.length.get()) }.is_ok();
    }
}

#[cfg(test)]
#[repr(C)]
#[derive(Debug, Default)]
struct ProgTestRun {
    prog_fd: u32,
    retval: u32,
    data_size_in: u32,
    data_size_out: u32,
    data_in: u64,
    data_out: u64,
    repeat: u32,
    duration: u32,
    ctx_size_in: u32,
    ctx_size_out: u32,
    ctx_in: u64,
    ctx_out: u64,
    flags: u32,
    cpu: u32,
    batch_size: u32,
    padding: u32,
}

/// Runs a program once for a made-up packet with a stack stamp, and gives what it returned.
#[cfg(test)]
pub(super) fn run_once(program: &OwnedFd, packet: &[u8], stack_stamp_ns: u64) -> io::Result<i32> {
    let mut context = [0_u8; 192];
    let at = usize::try_from(super::bpf_code::context::TSTAMP).map_err(io::Error::other)?;
    context[at..at + 8].copy_from_slice(&stack_stamp_ns.to_ne_bytes());
    let mut attribute = ProgTestRun {
        prog_fd: number(program),
        data_size_in: u32::try_from(packet.len()).map_err(io::Error::other)?,
        data_in: address(packet),
        repeat: 1,
        ctx_size_in: 192,
        ctx_in: address(&context[..]),
        ..ProgTestRun::default()
    };
    bpf(command::PROG_TEST_RUN, &mut attribute)?;
    Ok(attribute.retval.cast_signed())
}
