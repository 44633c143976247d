//! `[security]`: whether the hops of a run are sealed, and with which key. It reads no key.

use std::path::{Path, PathBuf};

use hil_core::case_study::ParameterError;
use hil_core::{options, words};

use super::model::Topology;
use super::tables::KEY_FILE;
use super::trace_source::BaseFolder;

options! {
    /// Whether the hops of a run are sealed, and with which key.
    #[derive(Eq)]
    pub struct Security
    with {
        /// The folder that a relative path counts from.
        #[serde(skip)]
        base: BaseFolder = BaseFolder(PathBuf::new()),
    }
    {
        /// Whether hops are sealed. With a key they are unless the file says otherwise.
        hops: Option<Hops>;
        /// The key file, as `hil-runtime key new` makes it. A relative path starts from the folder of the
        /// topology file.
        key: Option<String>, in KEY_FILE;
    }
    check Security::check_key;
}

words! {
    /// How datagrams travel between two hosts.
    pub enum Hops {
        /// Encrypted and authenticated with a key.
        Sealed = "sealed",
        /// Readable and forgeable by whoever reaches the wire.
        Plain = "plain",
    }
}

impl Security {
    fn check_key(&self) -> Result<(), ParameterError> {
        if self.hops == Some(Hops::Sealed) && self.key.is_none() {
            let problem = "is missing: hops = \"sealed\" needs the path of a key file, as `hil-runtime key \
                           new` makes it";
            return Err(ParameterError::new("key", problem));
        }
        Ok(())
    }

    /// The same with what a key implies.
    pub(super) fn resolve(mut self) -> Self {
        let implied = self.key.is_some().then_some(Hops::Sealed);
        self.hops = self.hops.or(implied);
        self
    }

    /// The key file of sealed hops, a relative path counted from the topology file.
    pub fn key_file(&self) -> Option<PathBuf> {
        let is_sealed = self.hops == Some(Hops::Sealed);
        let key = self.key.as_ref().filter(|_| is_sealed)?;
        Some(self.base.0.join(key))
    }
}

impl Topology {
    /// `[security]`.
    pub fn security(&self) -> &Security {
        &self.security
    }

    /// True when datagrams of its runs travel between two hosts, each with a supervisor of its own.
    pub fn is_between_hosts(&self) -> bool {
        self.hosts.len() > 1 && !self.is_all_local()
    }

    /// True when a machine that is `here_count` of the hosts meets others over a network.
    pub fn has_hosts_beside(&self, here_count: usize) -> bool {
        self.is_between_hosts() && here_count < self.hosts.len()
    }

    /// Why a run would be open to strangers without anybody having said that it may; `None` when its
    /// hops are sealed, said to be plain, or inside one host.
    pub fn unsaid_security(&self) -> Option<String> {
        (self.is_between_hosts() && self.security.hops.is_none()).then(|| {
            "security is missing: this topology joins two hosts, and whoever reaches their network could \
             read and forge its messages. Make a key with `hil-runtime key new \
             /etc/hil-runtime/hop.key`, copy it to every host and write\n\n  [security]\n  key = \
             \"/etc/hil-runtime/hop.key\"\n\nor, on a network that no stranger reaches,\n\n  \
             [security]\n  hops = \"plain\"\n"
                .to_owned()
        })
    }

    pub(super) fn with_key_beside(mut self, path: &Path) -> Self {
        let folder = path.parent().unwrap_or(Path::new(""));
        self.security.base = BaseFolder(folder.to_owned());
        self
    }
}
