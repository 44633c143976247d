//! Where the threads that carry a program's frames fetch the cable's end. It belongs to the process that started
//! the program and outlives those threads; what the program's interface drops is counted here.

use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use hil_net::handover;

use crate::INTERFACE;
use crate::inside::{BEGAN, ENTERED, GO};

/// Why there is no cable.
#[derive(Debug, thiserror::Error)]
pub enum CableError {
    /// The helper said why.
    #[error("{0}")]
    Refused(String),
    /// It ended without a word.
    #[error("the process that was to become the program ended before it began")]
    Gone,
    /// The kernel refuses it.
    #[error("cannot use the cable's end: {0}")]
    Io(#[from] io::Error),
}

/// Frames that the program's interface dropped: lost on this host and in no network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct InterfaceDrops {
    /// Put in for the program.
    pub inward_count: u64,
    /// Sent by the program.
    pub outward_count: u64,
}

/// See the module documentation.
#[derive(Debug)]
pub struct CableServer {
    listener: OwnedFd,
    path: PathBuf,
    cable: OwnedFd,
    /// What the interface counts. It keeps the program's namespace, so that it can be read when the program is gone.
    devices: File,
    /// To the helper, until it becomes the program.
    helper: OwnedFd,
    clients: Vec<OwnedFd>,
    /// What the interface had dropped when the program began.
    before: Option<InterfaceDrops>,
}

impl CableServer {
    /// Waits for the cable's end from the helper at the other end of `helper`, and gives it away at `path` from
    /// then on.
    ///
    /// # Errors
    /// When the helper could not make one, or there can be no socket at `path`.
    pub fn open(path: &Path, helper: OwnedFd) -> Result<Self, CableError> {
        let (word, descriptors) = handover::take(&helper)?;
        if word.is_empty() {
            return Err(CableError::Gone);
        }
        let [cable, devices] = <[OwnedFd; 2]>::try_from(descriptors)
            .map_err(|_none| CableError::Refused(String::from_utf8_lossy(&word).into_owned()))?;
        debug_assert_eq!(word, ENTERED);
        Ok(Self {
            listener: handover::listen(path)?,
            path: path.to_owned(),
            cable,
            devices: devices.into(),
            helper,
            clients: Vec::new(),
            before: None,
        })
    }

    /// Gives the end to whoever has connected, and lets the program begin once one of them says so.
    ///
    /// # Errors
    /// When the kernel gives no more descriptors or does not tell what the interface counts, or the helper is gone.
    pub fn attend(&mut self) -> io::Result<()> {
        while let Some(client) = handover::accept(&self.listener)? {
            let word = if self.before.is_some() {
                BEGAN
            } else {
                ENTERED
            };
            // One that has left is noticed below.
            let _left = handover::give(&client, word, &[self.cable.as_fd()]).is_err();
            self.clients.push(client);
        }
        let mut is_to_begin = false;
        self.clients
            .retain(|client| match handover::take_waiting(client) {
                Ok(None) => true,
                Ok(Some((word, _))) => {
                    is_to_begin |= word == GO;
                    !word.is_empty()
                }
                Err(_gone) => false,
            });
        if is_to_begin && self.before.is_none() {
            self.before = Some(self.dropped_in_all()?);
            handover::give(&self.helper, GO, &[])?;
        }
        Ok(())
    }

    /// What the program's interface has dropped since the program began, also after the program has ended.
    ///
    /// # Errors
    /// When the kernel does not tell.
    pub fn drops(&self) -> io::Result<InterfaceDrops> {
        let now = self.dropped_in_all()?;
        let before = self.before.unwrap_or(now);
        Ok(InterfaceDrops {
            inward_count: now.inward_count - before.inward_count,
            outward_count: now.outward_count - before.outward_count,
        })
    }

    fn dropped_in_all(&self) -> io::Result<InterfaceDrops> {
        let mut text = [0; 4096];
        let length = self.devices.read_at(&mut text, 0)?;
        let text = String::from_utf8_lossy(&text[..length]);
        drops(&text).ok_or_else(|| io::ErrorKind::InvalidData.into())
    }
}

impl Drop for CableServer {
    fn drop(&mut self) {
        let _removed_before = fs::remove_file(&self.path).is_err();
    }
}

/// What the program's interface dropped, of `/proc/net/dev`.
fn drops(devices: &str) -> Option<InterfaceDrops> {
    let mut lines = devices
        .lines()
        .filter_map(|line| line.trim().split_once(':'));
    let (_, counts) = lines.find(|(name, _)| *name == INTERFACE)?;
    let mut counts = counts.split_whitespace().map(|count| count.parse().ok());
    Some(InterfaceDrops {
        inward_count: counts.nth(3)??,
        outward_count: counts.nth(7)??,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CableClient;

    fn devices(inward: u64, outward: u64) -> String {
        format!("  eth0: 11 12 13 {inward} 15 16 17 18 19 20 21 {outward} 23 24 25 26\n")
    }

    #[test]
    fn whoever_connects_has_the_end_and_the_program_begins_once() {
        let folder = std::env::temp_dir().join(format!("hil-cable-server-{}", std::process::id()));
        fs::create_dir(&folder).unwrap();
        let counts = folder.join("dev");
        fs::write(&counts, devices(1, 2)).unwrap();
        let (helper, program) = handover::pair().unwrap();
        let end = File::open("/dev/null").unwrap();
        let file = File::open(&counts).unwrap();
        handover::give(&program, ENTERED, &[end.as_fd(), file.as_fd()]).unwrap();
        let path = folder.join("cable-0");
        // A process that was killed leaves its socket.
        fs::write(&path, "").unwrap();
        let mut server = CableServer::open(&path, helper).unwrap();

        let first = CableClient::at(&path).unwrap().unwrap();
        assert!(first.take().unwrap().is_none() && first.is_open());
        server.attend().unwrap();
        assert!(!first.take().unwrap().unwrap().has_program_begun);
        first.begin_program().unwrap();
        server.attend().unwrap();
        assert!(crate::await_go(program.as_fd()).unwrap());
        // Its reader starts anew: it is told, and the program hears nothing more.
        drop(first);
        fs::write(&counts, devices(5, 2)).unwrap();
        let second = CableClient::at(&path).unwrap().unwrap();
        server.attend().unwrap();
        assert!(second.take().unwrap().unwrap().has_program_begun);
        second.begin_program().unwrap();
        server.attend().unwrap();
        let drops = server.drops().unwrap();
        assert_eq!((drops.inward_count, drops.outward_count), (4, 0));
        assert!(second.is_open());
        drop(server);
        assert!(!second.is_open() && CableClient::at(&path).unwrap().is_none());
        assert!(!crate::await_go(program.as_fd()).unwrap());
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_helper_that_was_refused_or_is_gone_makes_no_server() {
        let path = std::env::temp_dir().join(format!("hil-no-cable-server-{}", std::process::id()));
        let (here, there) = handover::pair().unwrap();
        handover::give(&there, b"no namespaces", &[]).unwrap();
        let refused = CableServer::open(&path, here).unwrap_err();
        assert_eq!(refused.to_string(), "no namespaces");
        let (here, there) = handover::pair().unwrap();
        drop(there);
        assert!(matches!(
            CableServer::open(&path, here),
            Err(CableError::Gone)
        ));
        assert!(!path.exists());
    }

    #[test]
    fn the_drops_of_the_interface_are_those_of_its_line() {
        let text = "Inter-|   Receive  |  Transmit\n face |bytes packets errs drop fifo frame compressed \
                    multicast|bytes packets errs drop fifo colls carrier compressed\n    lo: 1 2 3 4 5 6 7 8 9 \
                    10 11 12 13 14 15 16\n  eth0: 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26\n";
        let expected = InterfaceDrops {
            inward_count: 14,
            outward_count: 22,
        };
        assert_eq!(drops(text), Some(expected));
        assert_eq!(drops("lo: 1"), None);
    }
}
