//! The file with the key that the hosts of a run share: one line, readable by its owner alone. The key
//! is never printed; people compare fingerprints.

use core::fmt;
use std::fs::{self, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use nix::unistd::geteuid;
use zeroize::{Zeroize, Zeroizing};

use hil_platform::random::random_bytes;

/// What the line begins with.
const PREFIX: &str = "hil-psk-v1:";
const KEY_BYTES: usize = 32;
/// Longer than any key file.
const FILE_BYTES_MAX: usize = 1024;

/// Why a key file is refused. Each says what to do.
#[derive(Debug, thiserror::Error)]
pub enum KeyFileError {
    /// It is not there.
    #[error(
        "key file {path}: not there; make one with `hil-runtime key new {path}` on one host and copy it to the others (scp -p)"
    )]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// Its folder is not there.
    #[error("key file {path}: its folder is not there; make it with `mkdir -p {folder}`")]
    NoFolder {
        /// The file.
        path: PathBuf,
        /// The folder.
        folder: PathBuf,
    },
    /// Who runs this program may not make it.
    #[error(
        "key file {path}: user {user}, who runs this, may not make it there; run this as root or name another folder"
    )]
    NotMade {
        /// The file.
        path: PathBuf,
        /// Who runs this program.
        user: u32,
    },
    /// Who runs this program may not read it.
    #[error(
        "key file {path}: user {user}, who runs this, may not reach it; run `chown {user} {path}` as root and let that user into its folder, or run this as its owner"
    )]
    Denied {
        /// The file.
        path: PathBuf,
        /// Who runs this program.
        user: u32,
    },
    /// It cannot be read or written.
    #[error("key file {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It is a folder, a device or the like.
    #[error("key file {path}: not a regular file")]
    NotAFile {
        /// The file.
        path: PathBuf,
    },
    /// Others can read it.
    #[error(
        "key file {path}: mode {mode:04o}, allowed are 0600 and 0400, for its owner alone; run `chmod 0600 {path}`, and make a new key if strangers may have read this one"
    )]
    Mode {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// It belongs to somebody else, who could replace it.
    #[error("{}", owner_words(.path, *.owner, *.user))]
    Owner {
        /// The file.
        path: PathBuf,
        /// Its owner.
        owner: u32,
        /// Who runs this program.
        user: u32,
    },
    /// It holds no key.
    #[error(
        "key file {path}: {why}; expected one line, hil-psk-v1: and 32 bytes in base64, as `hil-runtime key new` writes it"
    )]
    Form {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        why: String,
    },
    /// There is a file of that name already.
    #[error(
        "key file {path}: is there already and is not overwritten; remove it first if no host uses it"
    )]
    Exists {
        /// The file.
        path: PathBuf,
    },
}

/// Root is not told to take a file away from the user whose service needs it.
fn owner_words(path: &Path, owner: u32, user: u32) -> String {
    let path = path.display();
    if user == 0 {
        return format!(
            "key file {path}: belongs to user {owner}, and root, who runs this, uses none of others; \
             run this as that user, with `runuser -u`, or `chown root {path}`"
        );
    }
    format!(
        "key file {path}: belongs to user {owner}, allowed are root and user {user}, who runs this; \
         run `chown {user} {path}`"
    )
}

/// The key of a group of hosts; never printed, overwritten when it goes.
#[derive(Clone)]
pub struct PreSharedKey(Zeroizing<[u8; KEY_BYTES]>);

impl PreSharedKey {
    /// Reads the key file at `path`.
    ///
    /// # Errors
    /// When it is missing, of another form, or anyone but its owner could read it.
    pub fn read(path: &Path) -> Result<Self, KeyFileError> {
        let failed = |source: io::Error| match source.kind() {
            io::ErrorKind::NotFound => KeyFileError::Missing {
                path: path.to_owned(),
            },
            io::ErrorKind::PermissionDenied => KeyFileError::Denied {
                path: path.to_owned(),
                user: geteuid().as_raw(),
            },
            _ => KeyFileError::Io {
                path: path.to_owned(),
                source,
            },
        };
        // A pipe of that name must not keep the run waiting for a writer.
        let flags = libc::O_NONBLOCK | libc::O_CLOEXEC;
        let options = OpenOptions::new().read(true).custom_flags(flags).open(path);
        let file = options.map_err(failed)?;
        // Of the opened file, so that nobody can exchange it between the look and the reading.
        check_access(path, &file.metadata().map_err(failed)?, geteuid().as_raw())?;
        let mut bytes = Zeroizing::new(Vec::with_capacity(FILE_BYTES_MAX + 1));
        file.take(FILE_BYTES_MAX as u64 + 1)
            .read_to_end(&mut bytes)
            .map_err(failed)?;
        let text = str::from_utf8(&bytes).map_err(|_place_would_tell| "is not text".to_owned());
        text.and_then(parse).map_err(|why| KeyFileError::Form {
            path: path.to_owned(),
            why,
        })
    }

    /// Makes a new key and the file `path` with it, for its owner alone.
    ///
    /// # Errors
    /// When there is a file already, or it cannot be written.
    pub fn create(path: &Path) -> Result<Self, KeyFileError> {
        let key = Self::random().map_err(|source| KeyFileError::Io {
            path: path.to_owned(),
            source,
        })?;
        key.write(path)?;
        Ok(key)
    }

    /// A new key.
    ///
    /// # Errors
    /// When the kernel gives no random bytes.
    pub(crate) fn random() -> io::Result<Self> {
        let mut bytes = random_bytes::<KEY_BYTES>()?;
        let key = Self(Zeroizing::new(bytes));
        bytes.zeroize();
        Ok(key)
    }

    /// The key of these bytes, unless their number is not that of a key.
    pub(crate) fn of(bytes: &[u8]) -> Option<Self> {
        Some(Self(Zeroizing::new(bytes.try_into().ok()?)))
    }

    /// Makes the file `path` with this key, for its owner alone.
    ///
    /// # Errors
    /// When there is a file already, or it cannot be written.
    pub(crate) fn write(&self, path: &Path) -> Result<(), KeyFileError> {
        let failed = |source: io::Error| match source.kind() {
            io::ErrorKind::AlreadyExists => KeyFileError::Exists {
                path: path.to_owned(),
            },
            io::ErrorKind::PermissionDenied => KeyFileError::NotMade {
                path: path.to_owned(),
                user: geteuid().as_raw(),
            },
            io::ErrorKind::NotFound => KeyFileError::NoFolder {
                path: path.to_owned(),
                folder: path.parent().map(Path::to_owned).unwrap_or_default(),
            },
            _ => KeyFileError::Io {
                path: path.to_owned(),
                source,
            },
        };
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).mode(0o600);
        let mut file = options.open(path).map_err(failed)?;
        let encoded = Zeroizing::new(STANDARD.encode(*self.0));
        let line = Zeroizing::new(format!("{PREFIX}{}\n", &*encoded));
        let written = file
            .write_all(line.as_bytes())
            .and_then(|()| file.sync_all());
        if written.is_err() {
            // A part of a key would be in the way of the next.
            let _removed = fs::remove_file(path).is_ok();
        }
        written.map_err(failed)
    }

    /// A short name of the key that tells nothing of it: equal on hosts that have the same one.
    pub fn fingerprint(&self) -> String {
        let mut context = ring::digest::Context::new(&ring::digest::SHA256);
        context.update(b"hil-runtime key fingerprint v1");
        context.update(&*self.0);
        let digest = context.finish();
        let groups = digest.as_ref()[..8].chunks(2);
        let groups = groups.map(|pair| format!("{:02x}{:02x}", pair[0], pair[1]));
        groups.collect::<Vec<_>>().join("-")
    }

    /// The bytes, for the handshake.
    pub fn expose(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }
}

impl fmt::Debug for PreSharedKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PreSharedKey({})", self.fingerprint())
    }
}

fn check_access(path: &Path, data: &fs::Metadata, user: u32) -> Result<(), KeyFileError> {
    let path = || path.to_owned();
    if !data.is_file() {
        return Err(KeyFileError::NotAFile { path: path() });
    }
    if data.uid() != user && data.uid() != 0 {
        return Err(KeyFileError::Owner {
            path: path(),
            owner: data.uid(),
            user,
        });
    }
    let mode = data.mode() & 0o7777;
    if mode & !0o600 != 0 {
        return Err(KeyFileError::Mode { path: path(), mode });
    }
    Ok(())
}

/// Never tells of the content: it may be nearly a key.
fn parse(text: &str) -> Result<PreSharedKey, String> {
    // An editor may have put a byte order mark in front and a carriage return behind.
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let line = text.strip_suffix('\n').unwrap_or(text);
    let line = line.strip_suffix('\r').unwrap_or(line);
    if line.is_empty() {
        return Err("is empty".to_owned());
    }
    if line.contains('\n') {
        return Err("has more than one line".to_owned());
    }
    let encoded = line
        .strip_prefix(PREFIX)
        .ok_or_else(|| format!("does not begin with {PREFIX}"))?;
    let mut bytes = Zeroizing::new([0; KEY_BYTES + 1]);
    let decoded = STANDARD.decode_slice(encoded, &mut *bytes);
    match decoded {
        Ok(KEY_BYTES) => {}
        Ok(length) => return Err(format!("holds {length} bytes, not {KEY_BYTES}")),
        Err(_position_would_tell) => return Err("is not 32 bytes in base64".to_owned()),
    }
    let mut key = Zeroizing::new([0; KEY_BYTES]);
    key.copy_from_slice(&bytes[..KEY_BYTES]);
    if key.iter().all(|&byte| byte == 0) {
        return Err("holds a key of zeros".to_owned());
    }
    Ok(PreSharedKey(key))
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt, chown};

    use super::*;

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("hil-key-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        path
    }

    #[test]
    fn a_new_key_is_private_and_read_back_and_not_overwritten() {
        let folder = folder("new");
        let path = folder.join("hop.key");
        let made = PreSharedKey::create(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o7777, 0o600);
        let read = PreSharedKey::read(&path).unwrap();
        assert_eq!(read.expose(), made.expose());
        assert_eq!(read.fingerprint(), made.fingerprint());
        let error = PreSharedKey::create(&path).unwrap_err().to_string();
        assert!(error.contains("not overwritten"), "{error}");
        assert_eq!(PreSharedKey::read(&path).unwrap().expose(), made.expose());
        let other = PreSharedKey::create(&folder.join("other.key")).unwrap();
        assert_ne!(other.fingerprint(), made.fingerprint());
        let text = fs::read_to_string(&path).unwrap();
        let printed = format!("{made:?}");
        assert!(
            !printed.contains(text.trim().trim_start_matches(PREFIX)),
            "{printed}"
        );
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_file_that_others_may_read_is_refused_with_its_mode_and_the_cure() {
        let folder = folder("mode");
        let path = folder.join("hop.key");
        PreSharedKey::create(&path).unwrap();
        for mode in [0o644, 0o640, 0o604, 0o660, 0o700, 0o610] {
            fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
            let error = PreSharedKey::read(&path).unwrap_err().to_string();
            let path = path.display().to_string();
            for part in [&path, &format!("{mode:04o}"), &format!("chmod 0600 {path}")] {
                assert!(error.contains(part), "{error}");
            }
        }
        fs::set_permissions(&path, Permissions::from_mode(0o400)).unwrap();
        assert!(PreSharedKey::read(&path).is_ok());
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_file_of_another_user_is_refused_and_root_is_not_told_to_take_it_away() {
        let folder = folder("owner");
        let path = folder.join("hop.key");
        PreSharedKey::create(&path).unwrap();
        let own = fs::metadata(&path).unwrap().uid();
        if own == 0 {
            chown(&path, Some(998), None).unwrap();
            let error = PreSharedKey::read(&path).unwrap_err().to_string();
            assert!(error.contains("user 998"), "{error}");
            assert!(error.contains("runuser -u"), "{error}");
        }
        let data = fs::metadata(&path).unwrap();
        let other = data.uid() + 1;
        let error = check_access(&path, &data, other).unwrap_err().to_string();
        let cure = format!("chown {other} {}", path.display());
        assert!(error.contains(&cure), "{error}");
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn what_is_missing_or_no_key_says_so_and_never_shows_what_it_is() {
        let folder = folder("form");
        let path = folder.join("hop.key");
        let error = PreSharedKey::read(&path).unwrap_err().to_string();
        assert!(error.contains("hil-runtime key new"), "{error}");
        let error = PreSharedKey::read(&folder).unwrap_err().to_string();
        assert!(error.contains("not a regular file"), "{error}");
        let made = PreSharedKey::create(&path).unwrap();
        let good = fs::read_to_string(&path).unwrap();
        let half = &good[..good.len() - 8];
        let zeros = format!("{PREFIX}{}=", "A".repeat(43));
        for text in [
            "",
            "x",
            "\n",
            half,
            &good.repeat(2),
            &good.replace("v1", "v2"),
            &zeros,
        ] {
            fs::write(&path, text).unwrap();
            let error = PreSharedKey::read(&path).unwrap_err().to_string();
            assert!(error.contains("expected one line"), "{error}");
            assert!(
                !error.contains(&good[PREFIX.len()..PREFIX.len() + 8]),
                "{error}"
            );
        }
        fs::write(&path, [0xff; 43]).unwrap();
        let error = PreSharedKey::read(&path).unwrap_err().to_string();
        assert!(error.contains("not text; expected one line"), "{error}");
        let edited = format!("\u{feff}{}", good.replace('\n', "\r\n"));
        fs::write(&path, edited).unwrap();
        let read = PreSharedKey::read(&path).unwrap();
        assert_eq!(read.fingerprint(), made.fingerprint());
        let nowhere = folder.join("of/hop.key");
        let error = PreSharedKey::create(&nowhere).unwrap_err().to_string();
        let cure = format!("mkdir -p {}", folder.join("of").display());
        assert!(error.contains(&cure), "{error}");
        fs::remove_dir_all(folder).unwrap();
    }
}
