//! `[security]`: whether the hops of a run are sealed, and with which key. It reads no key.

use core::fmt;
use std::path::{Path, PathBuf};

use toml::Table;

use super::errors::Fault;
use super::model::{Topology, words};
use super::reader::Reader;
use super::resolved::put;

/// What `[security]` says.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Security {
    /// Whether hops are sealed; `None` when the file does not say.
    pub hops: Option<Hops>,
    /// The key file as the topology names it.
    pub key: Option<String>,
    /// The folder that a relative path counts from.
    pub(super) base: BaseFolder,
}

/// Where the topology file is. It is not part of what the topology says: all folders are equal.
#[derive(Debug, Clone, Default)]
pub(super) struct BaseFolder(PathBuf);

impl PartialEq for BaseFolder {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

impl Eq for BaseFolder {}

/// How datagrams travel between two hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hops {
    /// Encrypted and authenticated with a key.
    Sealed,
    /// Readable and forgeable by whoever reaches the wire.
    Plain,
}

words!(Hops { Sealed = "sealed", Plain = "plain" });

impl Security {
    pub(super) fn read(reader: Option<Reader<'_>>) -> Self {
        let Some(mut reader) = reader else {
            return Self::default();
        };
        let key = reader.text("key").map(|key| key.value);
        if key.as_deref() == Some("") {
            let fault = "is empty, expected the path of a key file".to_owned();
            reader.refuse("key", Fault::Inconsistent(fault));
        }
        let said = reader.word("hops", Hops::WORDS);
        if said == Some(Hops::Sealed) && key.is_none() && !reader.has("key") {
            let hint =
                "hops = \"sealed\" needs the path of a key file, as `hil-runtime key new` makes it";
            reader.refuse("key", Fault::Missing(hint.to_owned()));
        }
        let implied = key.is_some().then_some(Hops::Sealed);
        let hops = said.or(implied);
        reader.finish();
        Self {
            hops,
            key,
            base: BaseFolder::default(),
        }
    }

    /// The key file of sealed hops, a relative path counted from the topology file.
    pub fn key_file(&self) -> Option<PathBuf> {
        let is_sealed = self.hops == Some(Hops::Sealed);
        let key = self.key.as_ref().filter(|_| is_sealed)?;
        Some(self.base.0.join(key))
    }

    /// Written back; `with_key` keeps the path, which may differ between hosts that mean one run.
    pub(super) fn resolved(&self, with_key: bool) -> Option<Table> {
        let mut table = Table::new();
        put(&mut table, "hops", self.hops?.word());
        if let Some(key) = self.key.as_ref().filter(|_| with_key) {
            put(&mut table, "key", key.as_str());
        }
        Some(table)
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
