//! The `hil-runtime` binary the tests start, built in the profile of the tests themselves.

use std::env;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

/// Names a binary to test in place of the one cargo builds.
pub const BINARY_VARIABLE: &str = "HIL_RUNTIME_BINARY";

/// The `hil-runtime` binary: the one named by `HIL_RUNTIME_BINARY`, else freshly built by cargo.
///
/// Cargo is asked once per process and finds the work done by `cargo test --workspace` already.
///
/// # Panics
/// When the named file does not exist, or the build fails; with cargo's words.
pub fn hil_runtime_binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| {
        locate(env::var_os(BINARY_VARIABLE)).unwrap_or_else(|reason| panic!("{reason}"))
    })
}

fn locate(named: Option<OsString>) -> Result<PathBuf, String> {
    match named {
        Some(path) if Path::new(&path).is_file() => Ok(PathBuf::from(path)),
        Some(path) => Err(format!(
            "{BINARY_VARIABLE} names {}, no file",
            path.display()
        )),
        None => build(),
    }
}

/// The folder with the workspace's `Cargo.toml`.
pub fn workspace_folder() -> PathBuf {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    package
        .parent()
        .map_or_else(|| package.to_owned(), Path::to_owned)
}

fn build() -> Result<PathBuf, String> {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .current_dir(workspace_folder())
        .args(["build", "--package", "hil-runtime", "--bin", "hil-runtime"])
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
        return Err(format!("building hil-runtime failed:\n{words}"));
    }
    executable_in(&String::from_utf8_lossy(&output.stdout))
        .ok_or_else(|| "cargo reported no executable for hil-runtime".to_owned())
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

/// The path in cargo's message about the finished `hil-runtime` binary.
fn executable_in(messages: &str) -> Option<PathBuf> {
    messages
        .lines()
        .filter_map(|line| serde_json::from_str::<Value>(line).ok())
        .find_map(|message| {
            let is_ours = message["target"]["name"] == "hil-runtime";
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
        assert_eq!(locate(Some(named.clone().into())), Ok(named));
        let error = locate(Some("/no/such/file".into())).unwrap_err();
        assert_eq!(error, "HIL_RUNTIME_BINARY names /no/such/file, no file");
    }

    #[test]
    fn the_executable_is_found_among_cargos_messages() {
        let messages = r#"{"reason":"compiler-artifact","target":{"name":"libc"},"executable":null}
not json
{"reason":"compiler-artifact","target":{"name":"hil-runtime"},"executable":"/t/hil-runtime"}
{"reason":"build-finished","success":true}"#;
        assert_eq!(
            executable_in(messages),
            Some(PathBuf::from("/t/hil-runtime"))
        );
        assert_eq!(executable_in(""), None);
    }
}
