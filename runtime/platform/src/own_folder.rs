//! A folder that nobody but this user can change, held by a descriptor: what is done in it is done there,
//! whatever others put at its path meanwhile. Names in it are never links that are followed.

use std::ffi::{OsStr, OsString};
use std::fs::{self, DirBuilder, File};
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

use nix::dir::Dir;
use nix::errno::Errno;
use nix::fcntl::{AtFlags, OFlag, open, openat};
use nix::sys::stat::{FileStat, Mode, SFlag, fstat, fstatat, mkdirat};
use nix::unistd::{Uid, UnlinkatFlags, unlinkat};

/// Most that [`OwnFolder::read`] reads: it is for files of a line.
const READ_BYTES_MAX: u64 = 4096;
const FOLDER: OFlag = OFlag::O_RDONLY
    .union(OFlag::O_DIRECTORY)
    .union(OFlag::O_NOFOLLOW)
    .union(OFlag::O_CLOEXEC);

/// Why a folder is not used.
#[derive(Debug, thiserror::Error)]
pub enum OwnFolderError {
    /// The system refused.
    #[error("cannot open {}: {source}", .path.display())]
    Io {
        /// The folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Another user could empty or fill it.
    #[error(
        "{} belongs to user {owner}, and this is user {}; remove that one, or give a folder of your own: \
         /run/hil, hil in XDG_RUNTIME_DIR, or --domain-root",
        .path.display(), Uid::effective()
    )]
    Foreign {
        /// The folder.
        path: PathBuf,
        /// Its owner.
        owner: u32,
    },
    /// Something else is there, such as a link, which is not followed.
    #[error(
        "{} is no folder but a link or a file, of user {owner}; remove it, or give a folder of your own: /run/hil, \
         hil in XDG_RUNTIME_DIR, or --domain-root",
        .path.display()
    )]
    NoFolder {
        /// What stands there.
        path: PathBuf,
        /// Its owner.
        owner: u32,
    },
    /// Others may write in it.
    #[error("{} has mode {mode:04o}, so that others may write in it; chmod go-w {0}", .path.display())]
    Shared {
        /// The folder.
        path: PathBuf,
        /// Its permissions.
        mode: u32,
    },
}

impl OwnFolderError {
    /// The system refused with `source` what was to be a folder at `path`.
    fn at(path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match fs::symlink_metadata(&path) {
            Ok(there) if !there.is_dir() => Self::NoFolder {
                path,
                owner: there.uid(),
            },
            _ => Self::Io { path, source },
        }
    }
}

/// Who may have a folder.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Trust {
    /// This user only, and nobody else may write.
    Own,
    /// Or one where each user can change only what is his, as `/tmp`.
    OrSticky,
}

/// An open folder.
#[derive(Debug)]
pub struct OwnFolder {
    descriptor: OwnedFd,
    path: PathBuf,
}

impl OwnFolder {
    /// Opens the folder at `path`.
    ///
    /// # Errors
    /// When it is not there, a link, another user's, or others may write in it.
    pub fn open(path: &Path) -> Result<Self, OwnFolderError> {
        Self::open_if(path, Trust::Own)
    }

    /// As [`Self::open`]; makes it and those above it, for this user alone, where they are missing.
    ///
    /// # Errors
    /// As [`Self::open`], or when it cannot be made.
    pub fn create(path: &Path) -> Result<Self, OwnFolderError> {
        make(path)?;
        Self::open(path)
    }

    /// As [`Self::create`] for a folder in which folders of one's own are made: it may be one that is shared
    /// like `/tmp`, where nobody can touch the names of another.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub fn create_around(path: &Path) -> Result<Self, OwnFolderError> {
        make(path)?;
        Self::open_if(path, Trust::OrSticky)
    }

    fn open_if(path: &Path, trust: Trust) -> Result<Self, OwnFolderError> {
        let descriptor = open(path, FOLDER, Mode::empty());
        let descriptor = descriptor.map_err(|errno| OwnFolderError::at(path, errno.into()))?;
        Self::checked(descriptor, path.to_owned(), trust)
    }

    fn checked(descriptor: OwnedFd, path: PathBuf, trust: Trust) -> Result<Self, OwnFolderError> {
        let status = fstat(&descriptor).map_err(|errno| OwnFolderError::Io {
            path: path.clone(),
            source: errno.into(),
        })?;
        let mode = Mode::from_bits_truncate(status.st_mode);
        let is_shared = mode.intersects(Mode::S_IWGRP | Mode::S_IWOTH);
        let is_sticky = trust == Trust::OrSticky && mode.contains(Mode::S_ISVTX);
        let owner = status.st_uid;
        if owner != Uid::effective().as_raw() && !(is_sticky && owner == 0) {
            return Err(OwnFolderError::Foreign { path, owner });
        }
        if is_shared && !is_sticky {
            let mode = mode.bits();
            return Err(OwnFolderError::Shared { path, mode });
        }
        Ok(Self { descriptor, path })
    }

    /// Where it was opened: for messages, and for libraries that take no descriptors.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Another descriptor of it, for a lock.
    ///
    /// # Errors
    /// When there is none.
    pub fn descriptor(&self) -> io::Result<OwnedFd> {
        self.descriptor.try_clone()
    }

    /// The folder `name` in it, which is this user's alone as well.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn enter(&self, name: &OsStr) -> Result<Self, OwnFolderError> {
        let path = self.path.join(name);
        let opened = openat(&self.descriptor, name, FOLDER, Mode::empty());
        let descriptor = opened.map_err(|errno| OwnFolderError::Io {
            path: path.clone(),
            source: errno.into(),
        })?;
        Self::checked(descriptor, path, Trust::Own)
    }

    /// As [`Self::enter`]; makes it where it is missing.
    ///
    /// # Errors
    /// As [`Self::enter`].
    pub fn enter_or_make(&self, name: &OsStr) -> Result<Self, OwnFolderError> {
        match mkdirat(&self.descriptor, name, Mode::S_IRWXU) {
            Ok(()) | Err(Errno::EEXIST) => self.enter(name),
            Err(errno) => Err(OwnFolderError::Io {
                path: self.path.join(name),
                source: errno.into(),
            }),
        }
    }

    /// Whether `other` is what `name` is in it.
    pub fn has(&self, name: &OsStr, other: &Self) -> bool {
        let here = fstatat(&self.descriptor, name, AtFlags::AT_SYMLINK_NOFOLLOW);
        let place = |status: FileStat| (status.st_dev, status.st_ino);
        let there = fstat(&other.descriptor).map(place);
        here.map(place) == there
    }

    /// What is in it.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn names(&self) -> io::Result<Vec<OsString>> {
        // A descriptor of its own: the place in the listing belongs to it.
        let mut folder = Dir::openat(&self.descriptor, ".", FOLDER, Mode::empty())?;
        let mut names = Vec::new();
        for entry in folder.iter() {
            let name = OsStr::from_bytes(entry?.file_name().to_bytes()).to_owned();
            if name != "." && name != ".." {
                names.push(name);
            }
        }
        Ok(names)
    }

    /// The text of the small file `name`.
    ///
    /// # Errors
    /// When it is not there, no file, or no text.
    pub fn read(&self, name: &str) -> io::Result<String> {
        // What is no file must not make its reader wait.
        let flags = OFlag::O_RDONLY | OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
        let file = File::from(openat(&self.descriptor, name, flags, Mode::empty())?);
        if !file.metadata()?.is_file() {
            return Err(io::Error::other("not a file"));
        }
        let mut text = String::new();
        file.take(READ_BYTES_MAX).read_to_string(&mut text)?;
        Ok(text)
    }

    /// Writes the file `name`, which is not there.
    ///
    /// # Errors
    /// When it is, or cannot be written.
    pub fn write_new(&self, name: &str, text: &str) -> io::Result<()> {
        let flags =
            OFlag::O_WRONLY | OFlag::O_CREAT | OFlag::O_EXCL | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let mode = Mode::S_IRUSR | Mode::S_IWUSR;
        let mut file = File::from(openat(&self.descriptor, name, flags, mode)?);
        file.write_all(text.as_bytes())
    }

    /// Removes the file `name`, or the folder with all that is in it.
    ///
    /// # Errors
    /// The first refusal.
    pub fn remove(&self, name: &OsStr) -> io::Result<()> {
        remove_from(&self.descriptor, name)
    }

    /// Removes the empty folder `name`.
    ///
    /// # Errors
    /// When it is not empty, or the system refuses.
    pub fn remove_empty(&self, name: &OsStr) -> io::Result<()> {
        Ok(unlinkat(&self.descriptor, name, UnlinkatFlags::RemoveDir)?)
    }
}

fn make(path: &Path) -> Result<(), OwnFolderError> {
    let mut builder = DirBuilder::new();
    let made = builder.recursive(true).mode(0o700).create(path);
    made.map_err(|source| OwnFolderError::at(path, source))
}

fn remove_from(folder: &OwnedFd, name: &OsStr) -> io::Result<()> {
    let status = fstatat(folder, name, AtFlags::AT_SYMLINK_NOFOLLOW)?;
    let is_folder =
        SFlag::from_bits_truncate(status.st_mode & SFlag::S_IFMT.bits()) == SFlag::S_IFDIR;
    if !is_folder {
        return Ok(unlinkat(folder, name, UnlinkatFlags::NoRemoveDir)?);
    }
    let inner = OwnFolder {
        descriptor: openat(folder, name, FOLDER, Mode::empty())?,
        path: PathBuf::from(name),
    };
    for entry in inner.names()? {
        inner.remove(&entry)?;
    }
    Ok(unlinkat(folder, name, UnlinkatFlags::RemoveDir)?)
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt, symlink};

    use super::*;

    struct Scratch(PathBuf);

    impl Drop for Scratch {
        fn drop(&mut self) {
            let _gone = fs::remove_dir_all(&self.0).is_ok();
        }
    }

    fn scratch(name: &str) -> Scratch {
        let name = format!("hil-own-folder-{name}-{}", std::process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir(&path).unwrap();
        Scratch(path)
    }

    #[test]
    fn a_folder_that_others_could_change_is_refused() {
        let scratch = scratch("refused");
        let own = scratch.0.join("own");
        OwnFolder::create(&own).unwrap();
        let link = scratch.0.join("link");
        symlink(&own, &link).unwrap();
        assert!(matches!(
            OwnFolder::open(&link),
            Err(OwnFolderError::NoFolder { .. })
        ));
        let nowhere = scratch.0.join("nowhere");
        symlink(scratch.0.join("absent"), &nowhere).unwrap();
        assert!(matches!(
            OwnFolder::create(&nowhere),
            Err(OwnFolderError::NoFolder { .. })
        ));
        for mode in [0o770, 0o707, 0o1777] {
            fs::set_permissions(&own, Permissions::from_mode(mode)).unwrap();
            let refused = OwnFolder::open(&own);
            assert!(
                matches!(refused, Err(OwnFolderError::Shared { .. })),
                "{mode:o}"
            );
        }
        assert!(OwnFolder::create_around(&own).is_ok());
        fs::set_permissions(&own, Permissions::from_mode(0o777)).unwrap();
        assert!(OwnFolder::create_around(&own).is_err());
    }

    #[test]
    fn removal_does_not_leave_the_folder() {
        let scratch = scratch("removal");
        let thesis = scratch.0.join("thesis");
        fs::write(&thesis, "x").unwrap();
        let folder = OwnFolder::create(&scratch.0.join("own")).unwrap();
        symlink(&scratch.0, folder.path().join("up")).unwrap();
        fs::create_dir_all(folder.path().join("a/b")).unwrap();
        symlink(&scratch.0, folder.path().join("a/b/up")).unwrap();
        assert!(folder.enter(OsStr::new("up")).is_err());
        assert!(folder.read("up").is_err());
        assert!(folder.write_new("up", "").is_err());
        for name in folder.names().unwrap() {
            folder.remove(&name).unwrap();
        }
        assert!(folder.names().unwrap().is_empty());
        assert!(thesis.exists());
    }

    #[test]
    fn what_takes_the_place_of_a_folder_is_not_touched() {
        let scratch = scratch("place");
        let path = scratch.0.join("own");
        let base = OwnFolder::create(&path).unwrap();
        let inner = base.enter_or_make(OsStr::new("run")).unwrap();
        assert!(base.has(OsStr::new("run"), &inner));
        inner.write_new("mark", "1").unwrap();
        assert!(inner.write_new("mark", "2").is_err());
        fs::rename(&path, scratch.0.join("away")).unwrap();
        fs::create_dir_all(path.join("run/thesis")).unwrap();
        base.remove(OsStr::new("run")).unwrap();
        assert!(!scratch.0.join("away/run").exists());
        assert!(path.join("run/thesis").exists());
    }
}
