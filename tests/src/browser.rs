//! A headless Chromium for tests of our pages, spoken to over a pair of pipes in its own debugging protocol:
//! no driver, no port. It opens pages, clicks, types, takes pictures, and keeps what a page wrote to the
//! console and what it asked the network for. What pages must show is the tests' business.

mod page;
mod wire;

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use std::{env, fs, thread};

use nix::sys::signal::{Signal, killpg};
use nix::unistd::{Pid, Uid};
use serde_json::json;

pub use self::page::Page;
use self::wire::Wire;
use crate::lab::LabHost;
use crate::run_folder::RunFolder;

/// Names the browser to test with; empty: leave these tests out.
pub const BROWSER_VARIABLE: &str = "HIL_BROWSER";
/// Where pictures of the pages go.
pub const SCREENSHOT_VARIABLE: &str = "HIL_SCREENSHOTS";

const NAMES: [&str; 4] = [
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
];
/// Chromium reads commands from descriptor 3 and writes answers to 4; ours are its input and output.
const PIPES: &str = r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null"#;
/// No page waits for a tenth of this on an overloaded machine.
pub(crate) const LIMIT: Duration = Duration::from_mins(1);
const FAREWELL: Duration = Duration::from_secs(5);

/// A running browser. Dropping it ends it with all its processes.
#[derive(Debug)]
pub struct Browser {
    child: Child,
    wire: Wire,
    _profile: RunFolder,
}

impl Browser {
    /// Starts a browser on this machine; `None`, with the reason printed, where there is none.
    ///
    /// # Panics
    /// When it cannot be started, and in CI (`CI` is set) when there is none.
    pub fn start_or_skip() -> Option<Self> {
        located_or_skip().map(|program| Self::start(Command::new("/bin/sh"), &program))
    }

    /// Starts a browser on a host of a lab, which has no way to any other network.
    ///
    /// # Panics
    /// As [`Browser::start_or_skip`].
    pub fn start_on_or_skip(host: &LabHost) -> Option<Self> {
        located_or_skip().map(|program| Self::start(host.command("/bin/sh"), &program))
    }

    fn start(mut shell: Command, program: &PathBuf) -> Self {
        let profile = RunFolder::new("browser");
        let mut data = OsString::from("--user-data-dir=");
        data.push(profile.path());
        shell.arg("-c").arg(PIPES).arg(program).arg(data);
        // A browser of root's refuses to start with its sandbox. Our own pages are all it sees.
        shell.args(Uid::effective().is_root().then_some("--no-sandbox"));
        shell.args([
            "--headless=new",
            "--remote-debugging-pipe",
            "--no-first-run",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-extensions",
            "--disable-background-networking",
            "--disable-component-update",
            "--hide-scrollbars",
            "about:blank",
        ]);
        let log = fs::File::create(profile.join("stderr.log")).expect("the folder is ours");
        let spawned = shell
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(log)
            .process_group(0)
            .spawn();
        let mut child = match spawned {
            Ok(child) => child,
            Err(error) => panic!("{}: {error}", program.display()),
        };
        let (input, output) = (child.stdin.take(), child.stdout.take());
        let wire = Wire::new(
            input.expect("its input is a pipe"),
            output.expect("its output is a pipe"),
        );
        Self {
            child,
            wire,
            _profile: profile,
        }
    }

    /// An empty page of the given size in CSS pixels, as on a screen with as many.
    ///
    /// # Panics
    /// When the browser does not answer.
    pub fn page(&mut self, width: u32, height: u32) -> Page<'_> {
        Page::open(&mut self.wire, width, height)
    }

    fn is_over(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(Some(_)))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        self.wire.tell(None, "Browser.close", &json!({}));
        let deadline = Instant::now() + FAREWELL;
        while !self.is_over() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(20));
        }
        // What is left of it, its children included; fails when nothing is.
        let group = Pid::from_raw(i32::try_from(self.child.id()).expect("fits in 31 bits"));
        killpg(group, Signal::SIGKILL).ok();
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// Where a test's pictures go: below `HIL_SCREENSHOTS`, else `screenshots` of the target folder.
///
/// # Panics
/// When the folder cannot be made.
pub fn screenshot_folder() -> PathBuf {
    let named = env::var_os(SCREENSHOT_VARIABLE).filter(|name| !name.is_empty());
    let folder = named.map_or_else(beside_the_test, PathBuf::from);
    if let Err(error) = fs::create_dir_all(&folder) {
        panic!("{}: {error}", folder.display());
    }
    folder
}

/// Tests lie in `<target>/<profile>/deps`.
fn beside_the_test() -> PathBuf {
    let test = env::current_exe().unwrap_or_default();
    let target = test
        .ancestors()
        .nth(3)
        .map_or_else(PathBuf::new, PathBuf::from);
    target.join("screenshots")
}

#[allow(clippy::print_stderr, reason = "a test that is skipped must say so")]
fn located_or_skip() -> Option<PathBuf> {
    let is_ci = env::var("CI").is_ok_and(|value| !value.is_empty() && value != "false");
    let path = env::var_os("PATH").unwrap_or_default();
    match locate(env::var_os(BROWSER_VARIABLE), &path) {
        Ok(program) => Some(program),
        Err(Missing::LeftOut) => {
            eprintln!("skipped: {BROWSER_VARIABLE} is empty, so no page is looked at");
            None
        }
        Err(Missing::NotFound(reason)) => {
            assert!(!is_ci, "CI must have a browser, but {reason}");
            eprintln!("skipped: {reason}");
            None
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
enum Missing {
    LeftOut,
    NotFound(String),
}

fn locate(named: Option<OsString>, path: &OsString) -> Result<PathBuf, Missing> {
    match named {
        Some(name) if name.is_empty() => Err(Missing::LeftOut),
        Some(name) => {
            let program = PathBuf::from(name);
            let reason = format!("{BROWSER_VARIABLE} names {}, no file", program.display());
            let is_there = program.is_file();
            is_there.then_some(program).ok_or(Missing::NotFound(reason))
        }
        None => {
            let folders: Vec<_> = env::split_paths(path).collect();
            let all = NAMES
                .iter()
                .flat_map(|name| folders.iter().map(move |folder| folder.join(name)));
            let reason = "no Chromium is in PATH (Debian: apt-get install chromium)";
            all.into_iter()
                .find(|program| program.is_file())
                .ok_or_else(|| Missing::NotFound(reason.to_owned()))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_browser_is_named_or_found_or_left_out() {
        let nowhere = OsString::from("/no/such/folder");
        assert_eq!(
            locate(Some(OsString::new()), &nowhere),
            Err(Missing::LeftOut)
        );
        let test = env::current_exe().unwrap();
        assert_eq!(locate(Some(test.clone().into()), &nowhere), Ok(test));
        for named in [None, Some("/no/such/browser".into())] {
            let missing = locate(named, &nowhere);
            assert!(matches!(missing, Err(Missing::NotFound(_))), "{missing:?}");
        }
    }
}
