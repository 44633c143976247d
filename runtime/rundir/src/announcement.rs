//! The supervisor's side of a [`LiveRun`]: made from its plan, written where observers look, taken back
//! when the run is over.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use nix::fcntl::{Flock, FlockArg};

use crate::live_run::{LIVE_VERSION, LiveChannel, LiveRun, Source, Stage, start_ticks};
use crate::run_folder::{RunFolder, utc_text};
use hil_platform::domain_address::DomainAddress;
use hil_platform::own_folder::OwnFolder;
use hil_platform::plain_file;
use hil_topology::{Channel, Topology};

/// A run that is announced for as long as this lives.
#[derive(Debug)]
pub struct Announcement {
    run: LiveRun,
    folders: Vec<PathBuf>,
}

impl Announcement {
    /// Announces the run of `topology` in `folder`; `domains` are the hosts that run here with the
    /// addresses of their shared memory, `processes` what runs here; `has_one_clock` as far as it is
    /// known before all hosts have begun.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn make(
        topology: &Topology,
        folder: &RunFolder,
        domains: BTreeMap<String, String>,
        processes: Vec<String>,
        has_one_clock: Option<bool>,
    ) -> io::Result<Self> {
        let is_here = |host: &str| domains.contains_key(host);
        let channels = topology.channels().iter().filter_map(|channel| {
            Some(LiveChannel {
                name: channel.name.clone(),
                source: source(topology, channel, &is_here)?,
                noted: noted(topology, channel, &is_here),
                comes_again: comes_again(topology, channel, &is_here),
            })
        });
        let pid = std::process::id();
        let mut folders: Vec<PathBuf> = domains
            .values()
            .filter_map(|text| text.parse::<DomainAddress>().ok())
            .map(|address| address.root_path().to_owned())
            .collect();
        folders.push(folder.root().to_owned());
        let announcement = Self {
            run: LiveRun {
                schema_version: LIVE_VERSION,
                name: folder.name(),
                topology: topology.name().to_owned(),
                folder: folder.root().to_owned(),
                pid,
                pid_start_ticks: start_ticks(pid),
                since: utc_text(SystemTime::now()),
                has_one_clock,
                channels: channels.collect(),
                domains,
                processes,
            },
            folders,
        };
        announcement.write()?;
        Ok(announcement)
    }

    /// Says how the clocks of the run's hosts stand to each other.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn say_clock(&mut self, has_one_clock: bool) -> io::Result<()> {
        self.run.has_one_clock = Some(has_one_clock);
        self.write()
    }

    /// An observer reads the file whole or not at all.
    fn write(&self) -> io::Result<()> {
        let text = serde_json::to_string_pretty(&self.run).map_err(io::Error::other)?;
        for folder in &self.folders {
            let new = folder.join(format!(".{}.new", LiveRun::FILE_NAME));
            plain_file::create_anew(&new)?.write_all(text.as_bytes())?;
            fs::rename(&new, path(folder))?;
        }
        Ok(())
    }

    /// Takes it back: there will be no further message, and all records are in the folder.
    pub fn withdraw(self) {
        drop(self);
    }
}

impl Drop for Announcement {
    fn drop(&mut self) {
        for folder in &self.folders {
            // Where it cannot be removed, observers see by the domain's lock that the run is over.
            let _is_gone = fs::remove_file(path(folder)).is_ok();
        }
    }
}

/// Takes back what a killed supervisor said in the domain's folder `root`; what a living one says
/// stays. Before anybody locks the folder to clear it away: with the announcement in it, observers
/// would take who does for its supervisor.
pub fn withdraw_abandoned(root: &OwnFolder) {
    let Ok(descriptor) = root.descriptor() else {
        return;
    };
    // Shared, as observers ask for it: to them the domain is not held meanwhile. A living supervisor
    // has had the lock to itself since before it announced anything.
    if let Ok(lock) = Flock::lock(descriptor, FlockArg::LockSharedNonblock) {
        let _is_gone = root.remove(OsStr::new(LiveRun::FILE_NAME)).is_ok();
        drop(lock);
    }
}

fn path(folder: &Path) -> PathBuf {
    folder.join(LiveRun::FILE_NAME)
}

/// Where the messages of `channel` can be had on the hosts that `is_here` names; `None` when none
/// of its ends is here.
pub fn source(
    topology: &Topology,
    channel: &Channel,
    is_here: &dyn Fn(&str) -> bool,
) -> Option<Source> {
    let producer = topology.process(&channel.from)?;
    if is_here(&producer.host) {
        return Some(if producer.role().is_some() {
            Source::Records {}
        } else {
            Source::SharedMemory {
                host: producer.host.clone(),
                is_forwarded: false,
            }
        });
    }
    let consumer = topology.process(channel.to.as_deref()?)?;
    is_here(&consumer.host).then(|| Source::SharedMemory {
        host: consumer.host.clone(),
        is_forwarded: true,
    })
}

/// Whether the messages of `channel` are recorded on a host that is not here: those of roles are.
fn comes_again(topology: &Topology, channel: &Channel, is_here: &dyn Fn(&str) -> bool) -> bool {
    let producer = topology.process(&channel.from);
    producer.is_some_and(|producer| !is_here(&producer.host) && producer.role().is_some())
}

/// What the processes here note of each message of `channel`; of own programs, what reads beside them does.
fn noted(topology: &Topology, channel: &Channel, is_here: &dyn Fn(&str) -> bool) -> Vec<Stage> {
    let ends = [Some(channel.from.as_str()), channel.to.as_deref()];
    let [producer, consumer] = ends.map(|name| topology.process(name?));
    let (Some(producer), Some(consumer)) = (producer, consumer) else {
        return Vec::new();
    };
    let crosses = producer.host != consumer.host;
    let (from_here, to_here) = (is_here(&producer.host), is_here(&consumer.host));
    let stages = [
        (Stage::Published, from_here),
        (Stage::Sent, from_here && crosses),
        (Stage::Received, to_here && crosses),
        (Stage::Taken, to_here),
    ];
    let noted = stages.into_iter().filter(|(_, is_noted)| *is_noted);
    noted.map(|(stage, _)| stage).collect()
}
