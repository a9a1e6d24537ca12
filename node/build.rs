//! Tells the program which commit it was built from; without git, nothing.

use std::path::Path;
use std::process::Command;

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok().filter(|o| o.status.success())?;
    Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
}

fn main() {
    let version = std::env::var("CARGO_PKG_VERSION").unwrap_or_default();
    let commit = git(&["rev-parse", "--short=10", "HEAD"]).filter(|commit| !commit.is_empty());
    let version = commit.map_or_else(|| version.clone(), |commit| format!("{version} (commit {commit})"));
    println!("cargo:rustc-env=STORM_VERSION={version}");
    println!("cargo:rerun-if-changed=build.rs");
    // Git keeps where HEAD is in `logs/HEAD`: it changes with every commit and checkout.
    if let Some(log) =
        git(&["rev-parse", "--path-format=absolute", "--git-path", "logs/HEAD"]).filter(|p| Path::new(p).exists())
    {
        println!("cargo:rerun-if-changed={log}");
    }
}
