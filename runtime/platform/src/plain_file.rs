//! Files whose names others can guess: a pipe or a device in their place would make their reader wait, a link their
//! writer overwrite what it leads to.

use std::fs::{self, File};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use nix::fcntl::OFlag;

/// Opens the file at `path` to be read.
///
/// # Errors
/// When it cannot be opened or is no regular file.
pub fn open(path: &Path) -> io::Result<File> {
    open_with(path, OFlag::empty())
}

/// As [`open`], where `path` is not a link either: one into the folder of another user, say.
///
/// # Errors
/// As [`open`], and when it is a link.
pub fn open_unlinked(path: &Path) -> io::Result<File> {
    open_with(path, OFlag::O_NOFOLLOW)
}

fn open_with(path: &Path, more: OFlag) -> io::Result<File> {
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOCTTY | more;
    let mut options = File::options();
    let file = options.read(true).custom_flags(flags.bits()).open(path)?;
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    Ok(file)
}

/// A new file at `path`, to be written. What has the name goes: a link of another user is not followed.
///
/// # Errors
/// When what is there cannot be removed, or the file not be made.
pub fn create_anew(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut options = File::options();
    let options = options.write(true).create_new(true);
    options.custom_flags(OFlag::O_NOFOLLOW.bits()).open(path)
}

/// All of the file at `path`.
///
/// # Errors
/// As [`open`], or when it cannot be read.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The text of the file at `path`.
///
/// # Errors
/// As [`read`], or when it is no text.
pub fn read_to_string(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    open(path)?.read_to_string(&mut text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use nix::sys::stat::Mode;
    use nix::unistd::mkfifo;

    use super::*;

    #[test]
    fn a_pipe_is_refused_and_not_waited_for() {
        let name = format!("hil-plain-file-{}", std::process::id());
        let path = std::env::temp_dir().join(name);
        mkfifo(&path, Mode::S_IRWXU).unwrap();
        let refused = read_to_string(&path).unwrap_err();
        fs::remove_file(&path).unwrap();
        assert_eq!(refused.to_string(), "not a regular file");
        fs::write(&path, "x").unwrap();
        assert_eq!(read(&path).unwrap(), b"x");
        fs::remove_file(path).unwrap();
    }

    #[test]
    fn a_new_file_takes_the_place_of_a_link_and_leaves_what_it_leads_to() {
        let folder = format!("hil-plain-file-link-{}", std::process::id());
        let folder = std::env::temp_dir().join(folder);
        fs::create_dir(&folder).unwrap();
        let (target, path) = (folder.join("target"), folder.join("report.partial"));
        fs::write(&target, "kept").unwrap();
        for _ in 0..2 {
            std::os::unix::fs::symlink(&target, &path).unwrap();
            io::Write::write_all(&mut create_anew(&path).unwrap(), b"x").unwrap();
            assert_eq!(read(&target).unwrap(), b"kept");
            assert_eq!(read(&path).unwrap(), b"x");
            fs::remove_file(&path).unwrap();
        }
        fs::remove_dir_all(folder).unwrap();
    }
}
