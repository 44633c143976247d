//! A worker process of the product, started by its launch file as a supervisor would, without one.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use hil_core::message::MessageType;
use hil_platform::realtime::RealtimeRequest;
use hil_platform::wait::WaitMode;
use hil_rundir::launch::{
    ChannelLaunch, DirectionLaunch, GatewayWork, Side, SocketLaunch, Work, WorkerLaunch, write,
};
use hil_shm::Domain;
use hil_topology::SocketOptions;

use crate::binary::hil_runtime_binary;
use crate::trial::wait_until;

/// A channel of a link.
pub fn channel(id: u16, name: &str, message: &MessageType, depth: usize) -> ChannelLaunch {
    ChannelLaunch {
        channel: name.to_owned(),
        channel_id: id,
        message: message.name.to_owned(),
        size_bytes: message.size_bytes,
        alignment_bytes: message.alignment_bytes,
        depth,
        emulation: None,
        cable_socket: None,
    }
}

/// One end of a flow over UDP, from the first of `addresses` to the second.
pub fn direction(
    side: Side,
    addresses: [SocketAddr; 2],
    channels: Vec<ChannelLaunch>,
) -> DirectionLaunch {
    let [sender, receiver] = addresses;
    let (local, peer) = match side {
        Side::Egress => (sender, receiver),
        Side::Ingress => (receiver, sender),
    };
    DirectionLaunch {
        flow: "hil/link/hop/forward".to_owned(),
        flow_number: u16::MAX,
        side,
        local,
        peer,
        socket: SocketLaunch {
            transport: "udp".to_owned(),
            options: BTreeMap::new(),
            interface: None,
            common: SocketOptions::TEMPLATE,
        },
        wait: WaitMode::Block,
        realtime: RealtimeRequest::default(),
        channels,
    }
}

/// Writes the launch file of a gateway called `name`; its records go below `folder`.
///
/// # Panics
/// When the disk refuses it.
pub fn gateway(folder: &Path, name: &str, domain: &Domain, direction: DirectionLaunch) -> PathBuf {
    let records = folder.join(format!("records-{name}"));
    fs::create_dir_all(&records).expect("a folder for records");
    let launch = WorkerLaunch {
        process: name.to_owned(),
        instance: 0,
        domain: domain.address().to_string(),
        records,
        is_sealed: false,
        work: Work::Gateway(GatewayWork {
            directions: vec![direction],
            ready_within: None,
        }),
    };
    let path = folder.join(format!("{name}.json"));
    write(&path, &launch).expect("a launch file");
    path
}

/// The process with its order pipe, and what it said; killed when dropped.
#[derive(Debug)]
pub struct Worker {
    process: Child,
    words: Arc<Mutex<String>>,
    readers: Vec<JoinHandle<()>>,
}

impl Worker {
    /// Starts it.
    ///
    /// # Panics
    /// When it does not start.
    pub fn start(launch: &Path) -> Self {
        Self::adopt(Self::command(launch).spawn().expect("a worker starts"))
    }

    /// What starts it, for whoever wants to do so elsewhere.
    pub fn command(launch: &Path) -> Command {
        let mut command = Command::new(hil_runtime_binary());
        command.arg("worker").arg("--launch").arg(launch);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        command.stderr(Stdio::piped());
        command
    }

    /// Listens to `process`, which [`Worker::command`] started.
    ///
    /// # Panics
    /// When its pipes are not there.
    pub fn adopt(mut process: Child) -> Self {
        let words = Arc::new(Mutex::new(String::new()));
        let out: Box<dyn Read + Send> = Box::new(process.stdout.take().expect("piped"));
        let errors: Box<dyn Read + Send> = Box::new(process.stderr.take().expect("piped"));
        let readers = [out, errors].map(|pipe| {
            let words = Arc::clone(&words);
            thread::spawn(move || {
                for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                    let mut words = words.lock().unwrap_or_else(PoisonError::into_inner);
                    words.push_str(&line);
                    words.push('\n');
                }
            })
        });
        Self {
            process,
            words,
            readers: readers.into(),
        }
    }

    /// Its number.
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// True while it has not ended.
    pub fn is_running(&mut self) -> bool {
        matches!(self.process.try_wait(), Ok(None))
    }

    /// Everything it said so far.
    pub fn words(&self) -> String {
        let words = self.words.lock().unwrap_or_else(PoisonError::into_inner);
        words.clone()
    }

    /// Waits until it is ready.
    ///
    /// # Panics
    /// When it is not within `limit`, or ends.
    pub fn wait_until_ready(&mut self, limit: Duration) {
        wait_until(limit, "a worker to be ready", || {
            let words = self.words();
            assert!(self.is_running(), "{words}");
            words.lines().any(|line| line == "\"ready\"")
        });
    }

    /// Tells it to stop, waits for its end, and gives its exit code and its words.
    ///
    /// # Panics
    /// When it does not end within `limit`.
    pub fn end(mut self, limit: Duration) -> (Option<i32>, String) {
        if let Some(mut orders) = self.process.stdin.take() {
            // One that has ended is gone already.
            let _gone = orders.write_all(b"\"stop\"\n").is_err();
        }
        wait_until(limit, "the end of a worker", || !self.is_running());
        for reader in self.readers.drain(..) {
            reader.join().expect("a reader does not panic");
        }
        let code = self.process.wait().ok().and_then(|end| end.code());
        (code, self.words())
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // Both fail only if it has ended.
        drop(self.process.kill());
        drop(self.process.wait());
    }
}
