//! Where the shared memory of one run on one host lies, and how that is written. It creates and opens
//! nothing.

use core::fmt;
use core::str::FromStr;
use std::path::{Path, PathBuf};

use nix::unistd::Uid;

/// Longest root path: a listener's socket below it must fit into the 107 bytes of a Unix socket
/// address, with our 10-byte prefix, up to 33 digits of port id and iceoryx2's `.event`.
pub const ROOT_PATH_LENGTH_MAX: usize = 107 - 1 - PREFIX_LENGTH - 33 - ".event".len();

const PREFIX_LENGTH: usize = "h0123abcd_".len();

/// How a process finds its domain: hand it over as one argument or environment variable.
///
/// ```
/// use hil_platform::domain_address::DomainAddress;
///
/// let address: DomainAddress = "h0123abcd_@/run/hil/trial-7".parse()?;
/// assert_eq!(address.root_path().to_str(), Some("/run/hil/trial-7"));
/// assert_eq!(address.to_string(), "h0123abcd_@/run/hil/trial-7");
/// # Ok::<(), hil_platform::domain_address::DomainAddressError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DomainAddress {
    root_path: PathBuf,
    prefix: String,
}

impl DomainAddress {
    /// Directory of the run's sockets and service files.
    pub fn root_path(&self) -> &Path {
        &self.root_path
    }

    /// The domain below `root_path` whose files have `prefix`, as [`is_prefix`] and
    /// [`checked_root_path`] accept them.
    pub fn new(root_path: PathBuf, prefix: String) -> Self {
        Self { root_path, prefix }
    }

    /// What the names of the run's files in `/dev/shm` begin with.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }
}

impl fmt::Display for DomainAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.prefix, self.root_path.display())
    }
}

impl FromStr for DomainAddress {
    type Err = DomainAddressError;

    fn from_str(text: &str) -> Result<Self, DomainAddressError> {
        let malformed = || DomainAddressError::MalformedAddress {
            address: text.to_owned(),
        };
        let (prefix, root_path) = text.split_once('@').ok_or_else(malformed)?;
        if !is_prefix(prefix) {
            return Err(malformed());
        }
        Ok(Self {
            root_path: checked_root_path(Path::new(root_path))?,
            prefix: prefix.to_owned(),
        })
    }
}

/// An address of shared memory that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DomainAddressError {
    /// The root path is relative, not UTF-8 or holds a component iceoryx2 refuses.
    #[error("root path {} is not an absolute path of plain characters", .root_path.display())]
    UnusableRootPath {
        /// The path given.
        root_path: PathBuf,
    },
    /// The sockets below the root path would not fit into a Unix socket address.
    #[error(
        "root path {} has {} characters, at most {ROOT_PATH_LENGTH_MAX} fit",
        .root_path.display(), .root_path.as_os_str().len()
    )]
    RootPathTooLong {
        /// The path given.
        root_path: PathBuf,
    },
    /// A domain address that does not parse.
    #[error("domain address {address:?} is not of the form h0123abcd_@/root/path")]
    MalformedAddress {
        /// The text given.
        address: String,
    },
}

/// `root_path` without slashes at its end, where it can be that of a domain.
///
/// # Errors
/// When it is relative, holds other than plain characters, or is too long.
pub fn checked_root_path(root_path: &Path) -> Result<PathBuf, DomainAddressError> {
    let is_plain = |text: &str| {
        text.bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || b"/._-".contains(&byte))
    };
    let text = root_path.to_str().map(|text| text.trim_end_matches('/'));
    let root_path = root_path.to_owned();
    match text {
        Some(text) if root_path.is_absolute() && !text.is_empty() && is_plain(text) => {
            if text.len() > ROOT_PATH_LENGTH_MAX {
                return Err(DomainAddressError::RootPathTooLong { root_path });
            }
            Ok(PathBuf::from(text))
        }
        _ => Err(DomainAddressError::UnusableRootPath { root_path }),
    }
}

/// Whether `text` is what the names of a run's files may begin with.
pub fn is_prefix(text: &str) -> bool {
    text.len() == PREFIX_LENGTH
        && text.starts_with('h')
        && text.ends_with('_')
        && text[1..PREFIX_LENGTH - 1]
            .bytes()
            .all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

/// Where domains lie by default: `/run/hil`, else the user's own runtime folder, else a folder of
/// the user's own among the temporary ones.
pub fn domain_base_candidates() -> Vec<PathBuf> {
    // One that is not absolute is to be ignored (XDG Base Directory Specification); an empty one often stands for none.
    let runtime_folder = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    let runtime_folder = runtime_folder.filter(|path| path.is_absolute());
    let runtime_folder = runtime_folder.map(|path| path.join("hil"));
    let own = std::env::temp_dir().join(format!("hil-{}", Uid::current()));
    let candidates = [Some(PathBuf::from("/run/hil")), runtime_folder, Some(own)];
    candidates.into_iter().flatten().collect()
}
