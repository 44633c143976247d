//! Tells the program which revision it was built from; says nothing when git is not there.
#![allow(clippy::print_stdout, reason = "this is how a build script speaks")]

use std::process::Command;

fn main() {
    println!("cargo:rerun-if-env-changed=HIL_GIT_REVISION");
    println!("cargo:rerun-if-changed=../../.git/HEAD");
    println!("cargo:rerun-if-changed=../../.git/refs/heads");
    if std::env::var_os("HIL_GIT_REVISION").is_some() {
        return;
    }
    let described = Command::new("git")
        .args(["describe", "--always", "--dirty"])
        .output();
    if let Ok(output) = described
        && output.status.success()
    {
        let revision = String::from_utf8_lossy(&output.stdout);
        println!("cargo:rustc-env=HIL_GIT_REVISION={}", revision.trim());
    }
}
