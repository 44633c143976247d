//! The transports there are, and what each of them has to be: adding one is a file of its own and a
//! line here (`docs/adding-a-transport.md`).

use core::fmt::Debug;
use std::sync::Arc;

use hil_protocol::seal::{Initiator, Responder};
use hil_protocol::transport::Description;

use super::socket::{GrantedOptions, SocketError, SocketSettings};
use super::tcp::Tcp;
use super::udp::Udp;
use super::{ConnectionTally, DatagramReceiver, DatagramSender};

/// Every transport, in the order in which a diagnostic lists them.
pub static ALL: [&dyn Transport; 2] = [&Udp, &Tcp];

/// The one that an emulated link and a clock path use: it adds nothing of its own to what the link
/// model or the path does to a datagram.
pub static PLAIN: &dyn Transport = &Udp;

/// The transport called `name`.
pub fn named(name: &str) -> Option<&'static dyn Transport> {
    ALL.into_iter().find(|one| one.description().name == name)
}

/// A way for datagrams to get from one gateway to the other. Opening is all that is asked of it;
/// the ends do the rest.
pub trait Transport: Debug + Sync {
    /// What is known of it before anything is opened.
    fn description(&self) -> &'static Description;

    /// Opens the end at `settings.local` that sends to `settings.peer`, behind `seal` if there is
    /// one (see [`sealed::sender`](super::sealed::sender)). A peer that is not there is no error.
    ///
    /// # Errors
    /// When the settings contradict themselves or the kernel refuses a step.
    fn open_sender(
        &self,
        settings: &SocketSettings,
        seal: Option<Initiator>,
    ) -> Result<OpenSender, SocketError>;

    /// Opens the end at `settings.local` that hears `settings.peer`, behind `seal` if there is one
    /// (see [`sealed::receiver`](super::sealed::receiver)).
    ///
    /// # Errors
    /// As [`Transport::open_sender`].
    fn open_receiver(
        &self,
        settings: &SocketSettings,
        seal: Option<Responder>,
    ) -> Result<OpenReceiver, SocketError>;
}

/// A sending end.
#[derive(Debug)]
pub struct OpenSender {
    /// The end.
    pub sender: Box<dyn DatagramSender>,
    /// Longest datagram it takes, what the seal adds included.
    pub datagram_bytes_max: usize,
    /// What the kernel granted.
    pub granted: GrantedOptions,
    /// What a reader has to know of it: label and words.
    pub facts: Vec<(String, String)>,
    /// How often its connections come and go, where it has any.
    pub connections: Option<Arc<ConnectionTally>>,
}

/// A receiving end.
#[derive(Debug)]
pub struct OpenReceiver {
    /// The end.
    pub receiver: Box<dyn DatagramReceiver>,
    /// What a reader has to know of it: label and words.
    pub facts: Vec<(String, String)>,
}
