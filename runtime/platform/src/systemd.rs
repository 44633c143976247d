//! What systemd is told of a run: that it is up, how it stands, that it lives, that it ends
//! (`sd_notify(3)`). Only the supervisor speaks, and only where systemd listens: without
//! `NOTIFY_SOCKET` in the environment there is nobody to tell. It decides nothing.
//!
//! A few lines of our own, not the crate `sd-notify`: that one opens a blocking socket for every
//! word, and a supervisor that waits for a busy system manager would look hung to it.

use std::ffi::OsStr;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::Duration;
use std::{env, io, thread};

/// Variables by which systemd speaks to a service: for its main process, not for those it starts.
pub const VARIABLES: [&str; 3] = ["NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"];

/// Longest status; systemd shows one line.
const STATUS_CHARS_MAX: usize = 400;

/// How much more time a service that ends asks for.
const EXTENSION: Duration = Duration::from_secs(30);
/// How often it asks.
const EXTENSION_PERIOD: Duration = Duration::from_secs(8);
/// How often in a row without progress: for ten minutes. After that the manager ends the service.
const IDLE_COUNT_MAX: u32 = 75;
/// A process that reads and writes less between two looks makes no progress: about what the console takes.
const PROGRESS_BYTES: u64 = 4096;
// A manager that misses two hears the third in time.
const _: () = assert!(3 * EXTENSION_PERIOD.as_secs() < EXTENSION.as_secs());

/// The system's service manager, as far as it listens.
#[derive(Debug)]
pub struct ServiceManager {
    socket: UnixDatagram,
    has_watchdog: bool,
    is_up: bool,
    is_stopping: bool,
    status: String,
}

impl ServiceManager {
    /// The one that started this process; `None` when it was none, or does not want to be told.
    ///
    /// # Errors
    /// When it cannot be reached where the environment says.
    pub fn of_this_process() -> io::Result<Option<Self>> {
        let Some(address) = env::var_os(VARIABLES[0]).filter(|address| !address.is_empty()) else {
            return Ok(None);
        };
        let value = |name| env::var(name).ok();
        let own = std::process::id();
        let has_watchdog = wants_ticks(value(VARIABLES[1]), value(VARIABLES[2]), own);
        Self::at(&address, has_watchdog).map(Some)
    }

    fn at(address: &OsStr, has_watchdog: bool) -> io::Result<Self> {
        let bytes = address.as_bytes();
        let address = match bytes.strip_prefix(b"@") {
            Some(name) => SocketAddr::from_abstract_name(name)?,
            None => SocketAddr::from_pathname(address)?,
        };
        let socket = UnixDatagram::unbound()?;
        socket.connect_addr(&address)?;
        socket.set_nonblocking(true)?;
        Ok(Self {
            socket,
            has_watchdog,
            is_up: false,
            is_stopping: false,
            status: String::new(),
        })
    }

    /// The service is up: said once.
    pub fn up(&mut self) {
        self.is_up = self.is_up || self.say("READY=1");
    }

    /// How it stands, in words; said when it changed.
    pub fn status(&mut self, text: &str) {
        let words: Vec<&str> = text.split_whitespace().collect();
        let text: String = words.join(" ").chars().take(STATUS_CHARS_MAX).collect();
        if text != self.status && self.say(&format!("STATUS={text}")) {
            self.status = text;
        }
    }

    /// It lives: a tick of the watchdog, where the unit has one. Whoever calls this vouches for the
    /// whole run.
    pub fn alive(&mut self) {
        if self.has_watchdog {
            // A tick that finds no room is followed by the next.
            let _is_said = self.say("WATCHDOG=1");
        }
    }

    /// It is ending; no tick is due any more. A thread of its own says so until it is heard, and asks
    /// for more time to stop until the process is gone, or has read and written nothing for ten minutes:
    /// neither a slow peer nor a slow disk keeps an extension back, and a process that hangs is ended.
    ///
    /// # Errors
    /// When there is no thread: then the unit's own time to stop is all there is.
    pub fn stopping(&mut self) -> io::Result<()> {
        if self.is_stopping {
            return Ok(());
        }
        self.is_stopping = true;
        let is_said = self.say("STOPPING=1");
        let socket = self.socket.try_clone()?;
        thread::Builder::new()
            .name("ending".to_owned())
            .spawn(move || {
                let mut moved = MovedBytes::default();
                let look = || moved.look();
                extend(&socket, is_said, EXTENSION_PERIOD, IDLE_COUNT_MAX, look);
            })?;
        Ok(())
    }

    fn say(&self, word: &str) -> bool {
        self.socket.send(word.as_bytes()).is_ok()
    }
}

/// Says that the service ends, where that has not been heard, and asks for more time to stop: every
/// `period`, until `moved_bytes` has hardly grown for `idle_count_max` periods in a row.
fn extend(
    socket: &UnixDatagram,
    mut is_said: bool,
    period: Duration,
    idle_count_max: u32,
    mut moved_bytes: impl FnMut() -> u64,
) {
    let word = format!("EXTEND_TIMEOUT_USEC={}", EXTENSION.as_micros());
    let mut idle_count = 0;
    let mut known_bytes = moved_bytes();
    while idle_count < idle_count_max {
        is_said = is_said || socket.send(b"STOPPING=1").is_ok();
        // One that finds no room is followed by the next.
        let _is_heard = socket.send(word.as_bytes()).is_ok();
        thread::sleep(period);
        let now_bytes = moved_bytes();
        if now_bytes.saturating_sub(known_bytes) < PROGRESS_BYTES {
            idle_count += 1;
        } else {
            (idle_count, known_bytes) = (0, now_bytes);
        }
    }
}

/// What this process has read from files and written to them.
#[derive(Debug, Default)]
struct MovedBytes {
    /// By looking.
    own: u64,
}

impl MovedBytes {
    /// So far, bytes; 0 where the kernel does not count.
    fn look(&mut self) -> u64 {
        let text = std::fs::read_to_string("/proc/self/io").unwrap_or_default();
        let counts = text.lines().filter_map(|line| {
            let (name, count) = line.split_once(": ")?;
            let count: u64 = count.parse().ok()?;
            matches!(name, "rchar" | "wchar").then_some(count)
        });
        let moved = counts.sum::<u64>().saturating_sub(self.own);
        self.own += text.len() as u64;
        moved
    }
}

/// Whether ticks are wanted, and of this process rather than of one that it inherited the words from.
fn wants_ticks(period_us: Option<String>, pid: Option<String>, own: u32) -> bool {
    let period_us: Option<u64> = period_us.and_then(|text| text.parse().ok());
    let is_for_us = pid.is_none_or(|text| text.parse() == Ok(own));
    is_for_us && period_us.is_some_and(|period_us| period_us > 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    struct Listener {
        path: PathBuf,
        socket: UnixDatagram,
    }

    impl Listener {
        fn new(name: &str) -> Self {
            let file = format!("hil-notify-{name}-{}", std::process::id());
            let path = env::temp_dir().join(file);
            let socket = UnixDatagram::bind(&path).unwrap();
            socket.set_nonblocking(true).unwrap();
            Self { path, socket }
        }

        fn heard(&self) -> Vec<String> {
            let mut words = Vec::new();
            let mut buffer = [0; 4096];
            while let Ok(length) = self.socket.recv(&mut buffer) {
                words.push(String::from_utf8(buffer[..length].to_vec()).unwrap());
            }
            words
        }
    }

    impl Drop for Listener {
        fn drop(&mut self) {
            std::fs::remove_file(&self.path).unwrap();
        }
    }

    #[test]
    fn what_is_lasting_is_said_once_and_what_changes_when_it_does() {
        let listener = Listener::new("words");
        let mut manager = ServiceManager::at(listener.path.as_os_str(), true).unwrap();
        for _ in 0..2 {
            manager.up();
            manager.status("1.0 / 20 s\n  a 3→2");
            manager.alive();
        }
        manager.stopping().unwrap();
        manager.stopping().unwrap();
        let expected = [
            "READY=1",
            "STATUS=1.0 / 20 s a 3→2",
            "WATCHDOG=1",
            "WATCHDOG=1",
            "STOPPING=1",
        ];
        let mut heard = listener.heard();
        // The extensions come from a thread of their own.
        heard.retain(|word| !word.starts_with("EXTEND_TIMEOUT_USEC="));
        assert_eq!(heard, expected);
    }

    #[test]
    fn a_service_that_ends_asks_for_time_until_it_is_gone() {
        let listener = Listener::new("extend");
        let mut manager = ServiceManager::at(listener.path.as_os_str(), true).unwrap();
        manager.stopping().unwrap();
        let word = "EXTEND_TIMEOUT_USEC=30000000";
        while !listener.heard().iter().any(|heard| heard == word) {
            thread::yield_now();
        }
        // The thread asks again in 8 s.
        let at_once = Duration::from_millis(1);
        extend(&manager.socket, true, at_once, 3, || 0);
        assert_eq!(listener.heard(), [word; 3]);
        extend(&manager.socket, false, at_once, 2, || 0);
        assert_eq!(listener.heard(), ["STOPPING=1", word, word]);
        // It moves something at every third look: no more than two periods in a row are idle.
        let mut looks = 0;
        let moved = || {
            looks += 1;
            (looks.min(6) / 3) * PROGRESS_BYTES
        };
        extend(&manager.socket, true, at_once, 4, moved);
        assert_eq!(listener.heard(), [word; 9]);
    }

    #[test]
    fn what_a_process_reads_and_writes_is_progress_and_looking_is_none() {
        let mut moved = MovedBytes::default();
        let path = env::temp_dir().join(format!("hil-moved-{}", std::process::id()));
        let before = moved.look();
        assert!(moved.look() - before < PROGRESS_BYTES);
        std::fs::write(&path, vec![0; 100_000]).unwrap();
        assert!(moved.look() - before >= 100_000);
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn a_unit_without_a_watchdog_gets_no_ticks() {
        let listener = Listener::new("no-watchdog");
        let mut manager = ServiceManager::at(listener.path.as_os_str(), false).unwrap();
        manager.alive();
        assert!(listener.heard().is_empty());
    }

    #[test]
    fn a_manager_that_does_not_read_holds_nobody_up_and_hears_it_later() {
        let listener = Listener::new("full");
        let mut manager = ServiceManager::at(listener.path.as_os_str(), true).unwrap();
        while manager.say("WATCHDOG=1") {}
        manager.up();
        assert!(!manager.is_up);
        listener.heard();
        manager.up();
        assert_eq!(listener.heard(), ["READY=1"]);
    }

    #[test]
    fn an_address_without_a_file_is_understood() {
        let name = format!("hil-notify-{}", std::process::id());
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let socket = UnixDatagram::bind_addr(&address).unwrap();
        let mut manager = ServiceManager::at(OsStr::new(&format!("@{name}")), true).unwrap();
        manager.up();
        let mut buffer = [0; 64];
        let length = socket.recv(&mut buffer).unwrap();
        assert_eq!(&buffer[..length], b"READY=1");
        assert!(ServiceManager::at(OsStr::new("/no/such/socket"), true).is_err());
    }

    #[test]
    fn ticks_are_for_the_process_that_systemd_means() {
        let text = |text: &str| Some(text.to_owned());
        assert!(wants_ticks(text("10000000"), None, 7));
        assert!(wants_ticks(text("10000000"), text("7"), 7));
        assert!(!wants_ticks(text("10000000"), text("8"), 7));
        assert!(!wants_ticks(text("0"), text("7"), 7));
        assert!(!wants_ticks(text("soon"), None, 7));
        assert!(!wants_ticks(None, None, 7));
    }
}
