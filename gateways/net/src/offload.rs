//! What an interface leaves to hardware that frames between programs of one host never meet.
//!
//! `unsafe` is allowed here because no crate wraps these requests.

use std::io;

use super::timestamping::{EthtoolValue, device_request};

/// Switches off what an interface leaves to hardware: sums over what it sends (`ETHTOOL_STXCSUM`) and cutting
/// TCP into frames (`ETHTOOL_STSO`, `ETHTOOL_SGSO`), so that whoever takes a frame from the other end of a
/// cable has it as a wire would.
///
/// # Errors
/// When the driver refuses.
#[allow(unsafe_code, reason = "no crate wraps these commands")]
pub fn finish_frames_in_software(interface: &str) -> io::Result<()> {
    const ETHTOOL_STXCSUM: u32 = 0x17;
    const ETHTOOL_STSO: u32 = 0x1f;
    const ETHTOOL_SGSO: u32 = 0x24;
    for command in [ETHTOOL_STXCSUM, ETHTOOL_STSO, ETHTOOL_SGSO] {
        let mut switch = EthtoolValue { command, value: 0 };
        let data = (&raw mut switch).cast();
        // SAFETY: SIOCETHTOOL with these commands reads one `ethtool_value`, which `switch` is.
        unsafe { device_request(interface, libc::SIOCETHTOOL, data) }?;
    }
    Ok(())
}
