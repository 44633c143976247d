//! Whether this machine lets a test build a [`super::Lab`]. Where it does not, a developer's test
//! is skipped with the reason; in CI it fails.

use std::path::Path;
use std::{env, fs};

const CAP_NET_ADMIN: u32 = 12;
const CAP_SYS_ADMIN: u32 = 21;
const TOOLS: [&str; 5] = ["ip", "unshare", "nsenter", "mount", "sh"];

/// Checks for everything a lab needs.
///
/// # Errors
/// The reason to skip, in words.
///
/// # Panics
/// With that reason when the environment variable `CI` is set.
pub fn require_privileges() -> Result<(), String> {
    let is_ci = env::var("CI").is_ok_and(|value| !value.is_empty() && value != "false");
    decide(missing_right(), is_ci)
}

fn decide(missing: Option<String>, is_ci: bool) -> Result<(), String> {
    match missing {
        None => Ok(()),
        Some(reason) if is_ci => panic!("CI must be able to build a lab, but {reason}"),
        Some(reason) => Err(reason),
    }
}

fn missing_right() -> Option<String> {
    let path = env::var("PATH").unwrap_or_default();
    if let Some(tool) = TOOLS.iter().find(|tool| !is_in_path(tool, &path)) {
        return Some(format!(
            "`{tool}` is not in PATH (Debian: apt-get install iproute2)"
        ));
    }
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let rights = [
        (CAP_NET_ADMIN, "CAP_NET_ADMIN"),
        (CAP_SYS_ADMIN, "CAP_SYS_ADMIN"),
    ];
    let missing = rights.iter().find(|(right, _)| !holds(&status, *right));
    missing.map(|(_, name)| format!("network namespaces need {name}; run as root"))
}

fn is_in_path(tool: &str, path: &str) -> bool {
    path.split(':')
        .any(|folder| Path::new(folder).join(tool).is_file())
}

/// Whether `/proc/self/status` lists a capability as effective.
fn holds(status: &str, capability: u32) -> bool {
    let line = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let mask = line.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> capability & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_developer_skips_and_ci_fails() {
        assert_eq!(decide(None, true), Ok(()));
        assert_eq!(decide(Some("why".to_owned()), false), Err("why".to_owned()));
        let failed = std::panic::catch_unwind(|| decide(Some("why".to_owned()), true));
        assert!(failed.is_err());
    }

    #[test]
    fn rights_are_read_from_the_effective_mask() {
        let status = "CapPrm:\tffffffffffffffff\nCapEff:\t0000000000001000\n";
        assert!(holds(status, CAP_NET_ADMIN));
        assert!(!holds(status, CAP_SYS_ADMIN));
        assert!(!holds("", CAP_NET_ADMIN));
    }

    #[test]
    fn tools_are_looked_for_in_every_folder() {
        assert!(is_in_path("sh", "/no/such/folder:/bin:/usr/bin"));
        assert!(!is_in_path("sh", "/no/such/folder"));
    }
}
