//! What the cross-room tests share: running the program, reading its results, making small bags.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Runs `storm` with `args`; quiet, so that stderr holds only what matters.
pub fn storm(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_storm")).args(args).env_remove("RUST_LOG").output().expect("the program starts")
}

/// The exit code.
pub fn code(output: &Output) -> i32 {
    output.status.code().unwrap_or(-1)
}

/// What it said on stderr.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// `metrics.json` of a results folder.
pub fn metrics(out: &Path) -> serde_json::Value {
    let text = std::fs::read_to_string(out.join("metrics.json")).expect("metrics.json is there");
    serde_json::from_str(&text).expect("metrics.json is JSON")
}

/// Recorded data beside the project, or `None` (after saying SKIPPED) when it is not there.
pub fn shared(what: &str) -> Option<PathBuf> {
    let root = std::env::var_os("STORM_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
    let path = root.join(what);
    if path.exists() {
        return Some(path);
    }
    println!("SKIPPED: {what} is not beside the project (set STORM_SHARED)");
    None
}

/// Writes a procedural drive as a bag: three small cameras at 10 Hz.
pub fn synth(out: &Path, seed: u64, seconds: &str, more: &[&str]) {
    let seed = seed.to_string();
    let out = out.to_str().expect("a plain path");
    let mut args =
        vec!["synth", "--seed", &seed, "--seconds", seconds, "--width", "120", "--height", "80", "--out", out];
    args.extend(more);
    let output = storm(&args);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
}

/// Replays a bag into `out` with a short window and small pictures, so that a test takes seconds.
pub fn replay(bag: &Path, out: &Path, more: &[&str]) -> Output {
    let mut args =
        vec!["--quiet", "replay", bag.to_str().expect("a plain path"), "--out", out.to_str().expect("a plain path")];
    args.extend(["--set", "model.image_width=48", "--set", "model.image_height=32"]);
    args.extend(more);
    storm(&args)
}
