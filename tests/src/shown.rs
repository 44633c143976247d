//! A run that goes on and the page that shows it, on a host of a lab without a network: what tests of the live
//! page begin and end with.

use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::binary::hil_recorder_binary;
use crate::browser::Page;
use crate::child::ChildGuard;
use crate::lab::{INTERFACE, Lab, LabHost};
use crate::run_folder::RunFolder;
use crate::trial::Trial;

/// A page on a desk, in CSS pixels.
pub const DESKTOP: (u32, u32) = (1440, 900);

/// No run takes a tenth of this to begin or to end on an overloaded machine.
const LIMIT: Duration = Duration::from_mins(2);
/// All that a page may bring over the network, in bytes.
const WEIGHT_MAX: u64 = 1_000_000;

/// A run that goes on, a recorder that shows it, and the address of its page.
#[derive(Debug)]
pub struct Shown {
    /// The run.
    pub run: ChildGuard,
    /// What shows it.
    pub recorder: ChildGuard,
    /// Where the page is.
    pub address: String,
    /// Where the run is recorded; goes with this.
    pub folder: RunFolder,
}

impl Shown {
    /// Starts both on `host`.
    ///
    /// # Panics
    /// When either cannot be started.
    pub fn start(trial: &Trial, folder: RunFolder, host: &LabHost) -> Self {
        let run = trial.start_on(host);
        let root = trial.folder("", LIMIT).root().to_owned();
        let ports = ["--port", "0", "--http-port", "0"];
        let (recorder, address) = serve(&root, host, &ports);
        Self {
            run,
            recorder,
            address,
            folder,
        }
    }

    /// Ends both as a user does, and waits for them.
    ///
    /// # Panics
    /// When either does not end.
    pub fn end(mut self) {
        for child in [&mut self.recorder, &mut self.run] {
            child.signal(Signal::SIGINT).expect("it goes on");
            if let Err(error) = child.wait_within(LIMIT) {
                panic!("{error}");
            }
        }
        drop(self.folder);
    }
}

/// A network on which nothing can be reached and nothing changes: browsers drop what they are loading
/// when an interface comes or goes, as those of other tests do all the time. `None`, with the reason
/// printed, where the rights for it are missing.
///
/// # Panics
/// As [`Lab::two_hosts_or_skip`].
pub fn with_the_cable_pulled() -> Option<Lab> {
    let lab = Lab::two_hosts_or_skip()?;
    lab.host(0).set_link(INTERFACE, "down");
    Some(lab)
}

/// Shows the run of this folder as soon as it goes on, and says where. Two that begin within a second have
/// one name.
///
/// # Panics
/// When the recorder cannot be started or does not say where the page is.
pub fn serve(root: &Path, host: &LabHost, options: &[&str]) -> (ChildGuard, String) {
    let mut command = host.command(hil_recorder_binary());
    let command = command.args(["serve", "--wait"]).arg(root).args(options);
    let mut recorder = ChildGuard::spawn(command).expect("hil-recorder can be started");
    if let Err(error) = recorder.wait_for_output("http://", LIMIT) {
        panic!("{error}");
    }
    let words = recorder.stdout_so_far() + &recorder.stderr_so_far();
    let mut addresses = words.split_whitespace();
    let address = addresses.find(|word| word.starts_with("http://"));
    let address = address.expect("it was said just now");
    let address = address.trim_end_matches([',', '.']).to_owned();
    (recorder, address)
}

/// Nothing on the console, nothing from elsewhere, and no more than a page may weigh.
///
/// # Panics
/// When one of these does not hold.
#[allow(clippy::print_stderr, reason = "a figure for whoever changes the page")]
pub fn assert_clean(page: &mut Page<'_>, name: &str) {
    let complaints = page.complaints();
    assert!(complaints.is_empty(), "{name}: {complaints:#?}");
    for address in page.addresses() {
        let is_own = ["http://127.0.0.1:", "ws://127.0.0.1:", "file:///"]
            .iter()
            .any(|own| address.starts_with(own));
        assert!(is_own, "{name} asked for {address}");
    }
    let bytes = page.received_bytes();
    eprintln!("{name}: {bytes} bytes over the network");
    assert!(bytes <= WEIGHT_MAX, "{name}: {bytes} bytes");
}

/// Waits until the page has been drawn a few times since whatever was done to it, its panels too, which it draws five
/// times a second.
pub fn settle(page: &mut Page<'_>) {
    page.value("new Promise(done => setTimeout(() => done(true), 250))");
    let frames = "new Promise(done => { let left = 3; const next = () => --left ? \
                  requestAnimationFrame(next) : done(true); next(); })";
    page.value(frames);
}
