//! The `hil-runtime` and `hil-recorder` binaries the tests start, built in the profile of the tests themselves.

use std::env;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use serde_json::Value;

use crate::child::{ChildGuard, Finished};

/// Names a binary to test in place of the one cargo builds.
pub const BINARY_VARIABLE: &str = "HIL_RUNTIME_BINARY";
/// The same of the recorder.
pub const RECORDER_VARIABLE: &str = "HIL_RECORDER_BINARY";
/// The folder of the target folder in which both have been built for this run of the tests.
const BUILT_VARIABLE: &str = "HIL_PROGRAMS_BUILT";

/// The `hil-runtime` binary: the one named by `HIL_RUNTIME_BINARY`, else the one that was built for this run of
/// the tests, else freshly built by cargo, which is asked once per process.
///
/// # Panics
/// When the named file does not exist, or the build fails; with cargo's words.
pub fn hil_runtime_binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| located("hil-runtime", BINARY_VARIABLE))
}

/// The `hil-recorder` binary: the one named by `HIL_RECORDER_BINARY`, else freshly built by cargo.
///
/// # Panics
/// As [`hil_runtime_binary`].
pub fn hil_recorder_binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| located("hil-recorder", RECORDER_VARIABLE))
}

/// No command of these tests takes so long.
const COMMAND_LIMIT: Duration = Duration::from_mins(5);

/// Runs `hil-runtime` in the workspace to its end, on a terminal of no width and on no host in particular.
///
/// # Panics
/// When it does not start or does not end.
pub fn hil_runtime(arguments: &[impl AsRef<OsStr>]) -> Finished {
    hil_runtime_in(&workspace_folder(), arguments)
}

/// As [`hil_runtime`], in `folder`.
///
/// # Panics
/// As [`hil_runtime`].
pub fn hil_runtime_in(folder: &Path, arguments: &[impl AsRef<OsStr>]) -> Finished {
    let mut command = Command::new(hil_runtime_binary());
    command.args(arguments).current_dir(folder);
    command.env_remove("COLUMNS").env_remove("HIL_HOST");
    let child = ChildGuard::spawn(&mut command);
    let finished = child.expect("it starts").wait_within(COMMAND_LIMIT);
    finished.unwrap_or_else(|reason| panic!("{reason}"))
}

fn located(package: &str, variable: &str) -> PathBuf {
    let found = locate(package, variable, env::var_os(variable));
    found.unwrap_or_else(|reason| panic!("{reason}"))
}

fn locate(package: &str, variable: &str, named: Option<OsString>) -> Result<PathBuf, String> {
    match named {
        Some(path) if Path::new(&path).is_file() => Ok(PathBuf::from(path)),
        Some(path) => Err(format!("{variable} names {}, no file", path.display())),
        None => match built_already(package) {
            Some(path) => Ok(path),
            None => build(package),
        },
    }
}

/// Tests lie in `<target>/<profile>/deps`, programs a folder above.
fn built_already(package: &str) -> Option<PathBuf> {
    let test = env::current_exe().ok()?;
    let folder = test.ancestors().nth(2)?;
    let is_built = env::var_os(BUILT_VARIABLE)?.as_os_str() == folder.file_name()?;
    is_built.then(|| folder.join(package))
}

/// The folder with the workspace's `Cargo.toml`.
pub fn workspace_folder() -> PathBuf {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    package
        .parent()
        .map_or_else(|| package.to_owned(), Path::to_owned)
}

fn build(package: &str) -> Result<PathBuf, String> {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .current_dir(workspace_folder())
        // With the features of the whole workspace and of its tests: others would build most of what it depends on a
        // second time.
        .args(["build", "--workspace", "--bin", package, "--test", "tidy"])
        .args([
            "--profile",
            &profile(),
            "--message-format",
            "json-render-diagnostics",
        ])
        .output()
        .map_err(|error| format!("cargo cannot be started: {error}"))?;
    if !output.status.success() {
        let words = String::from_utf8_lossy(&output.stderr);
        return Err(format!("building {package} failed:\n{words}"));
    }
    executable_in(package, &String::from_utf8_lossy(&output.stdout))
        .ok_or_else(|| format!("cargo reported no executable for {package}"))
}

/// The profile this test was built in: its folder is `<target>/<profile>/deps`.
fn profile() -> String {
    let test = env::current_exe().unwrap_or_default();
    let folder = test.ancestors().nth(2).and_then(Path::file_name);
    match folder.map(|name| name.to_string_lossy().into_owned()) {
        Some(name) if name != "debug" => name,
        _ => "dev".to_owned(),
    }
}

/// The path in cargo's message about the finished binary of `package`.
fn executable_in(package: &str, messages: &str) -> Option<PathBuf> {
    messages
        .lines()
        .filter_map(|line| serde_json::from_str::<Value>(line).ok())
        .find_map(|message| {
            let is_ours = message["target"]["name"] == package;
            let executable = message["executable"].as_str()?;
            is_ours.then(|| PathBuf::from(executable))
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_binary_is_built_and_starts() {
        let binary = hil_runtime_binary();
        assert!(binary.is_file(), "{}", binary.display());
        assert_eq!(binary, hil_runtime_binary());
    }

    #[test]
    fn a_named_binary_must_exist() {
        let named = env::current_exe().unwrap();
        let locate = |named: OsString| locate("hil-runtime", BINARY_VARIABLE, Some(named));
        assert_eq!(locate(named.clone().into()), Ok(named));
        let error = locate("/no/such/file".into()).unwrap_err();
        assert_eq!(error, "HIL_RUNTIME_BINARY names /no/such/file, no file");
    }

    #[test]
    fn the_executable_is_found_among_cargos_messages() {
        let messages = r#"{"reason":"compiler-artifact","target":{"name":"libc"},"executable":null}
not json
{"reason":"compiler-artifact","target":{"name":"hil-runtime"},"executable":"/t/hil-runtime"}
{"reason":"build-finished","success":true}"#;
        assert_eq!(
            executable_in("hil-runtime", messages),
            Some(PathBuf::from("/t/hil-runtime"))
        );
        assert_eq!(executable_in("hil-runtime", ""), None);
    }
}
