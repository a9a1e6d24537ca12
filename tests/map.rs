//! The long-horizon map from outside: killed runs, damaged files, going on, and its figures against the truth.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{code, replay, stderr, storm, synth};
use storm_node::output::ply::read_ply;

/// Longest wait for a save to appear: a first window on a busy machine takes seconds.
const PATIENCE: Duration = Duration::from_secs(120);

fn show_map(folder: &Path, more: &[&str]) -> std::process::Output {
    storm(&[&["map", folder.to_str().unwrap()], more].concat())
}

#[test]
fn a_run_killed_at_any_moment_leaves_a_whole_map() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag"), dir.path().join("out"));
    synth(&bag, 5, "6", &[]);
    let args = ["--quiet", "replay", bag.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let sets = ["model.image_width=48", "model.image_height=32", "map.save_every_sec=0.01", "map.static_speed_mps=100"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_storm"))
        .args(args)
        .args(sets.iter().flat_map(|s| ["--set", s]))
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let start = Instant::now();
    let index = out.join("map/map.index");
    // The index of an empty map is 80 bytes.
    let saved = || std::fs::metadata(&index).is_ok_and(|m| m.len() > 100);
    while !saved() && start.elapsed() < PATIENCE {
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(300));
    // SIGKILL, as kill -9 sends it.
    child.kill().unwrap();
    let ended = child.wait().unwrap();
    assert!(saved());
    assert!(ended.code().is_none() || out.join("map.ply").exists(), "killed, or done already");
    let ply = dir.path().join("saved.ply");
    let shown = show_map(&out.join("map"), &["--out", ply.to_str().unwrap()]);
    assert_eq!(code(&shown), 0, "{}", stderr(&shown));
    assert!(!read_ply(&ply).unwrap().cloud.is_empty());
    // Going on from it is possible, in a folder of its own.
    let next = dir.path().join("next");
    let load = format!("map.load={}", out.join("map").display());
    let output = replay(&bag, &next, &["--set", &load, "--set", "map.static_speed_mps=100"]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let grown = read_ply(&next.join("map.ply")).unwrap();
    assert!(grown.cloud.len() >= read_ply(&ply).unwrap().cloud.len() / 2);
}

#[test]
fn damage_is_named_refused_and_can_be_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag"), dir.path().join("out"));
    synth(&bag, 7, "1.8", &[]);
    let output = replay(&bag, &out, &["--set", "map.static_speed_mps=100"]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let folder = out.join("map");
    let mut tiles: Vec<PathBuf> = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).collect();
    tiles.retain(|p| p.extension().is_some_and(|e| e == "tile"));
    tiles.sort();
    assert!(tiles.len() >= 2);
    let whole = read_ply(&out.join("map.ply")).unwrap().cloud.len();
    let mut bytes = std::fs::read(&tiles[0]).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0xff;
    std::fs::write(&tiles[0], bytes).unwrap();
    let name = tiles[0].file_name().unwrap().to_str().unwrap();
    let refused = show_map(&folder, &[]);
    assert_eq!(code(&refused), 2);
    assert!(stderr(&refused).contains(name), "{}", stderr(&refused));
    let ply = dir.path().join("rest.ply");
    let rest = show_map(&folder, &["--salvage", "--out", ply.to_str().unwrap()]);
    assert_eq!(code(&rest), 3);
    assert!(stderr(&rest).contains(name), "{}", stderr(&rest));
    let left = read_ply(&ply).unwrap().cloud.len();
    assert!(left < whole && left > 0, "{left} of {whole}");
}

/// The oracle's drive: what falls short is the map's fault alone.
#[test]
fn the_map_is_as_good_as_the_windows_and_holds_no_ghosts() {
    let dir = tempfile::tempdir().unwrap();
    let json = dir.path().join("soak.json");
    // One road user in ten is taken for standing, per picture: free space has to deal with what they leave.
    let args = ["--quiet", "soak", "--seed", "3", "--seconds", "6", "--size", "64x40", "--missed", "0.1"];
    let output = storm(&[&args[..], &["--json", json.to_str().unwrap()]].concat());
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let r: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&json).unwrap()).unwrap();
    let q = |name: &str| r["map_quality"][name].as_f64().unwrap_or_else(|| panic!("{name}: {r}"));
    assert!(q("map_psnr") > q("window_psnr") - 1.0, "{r}");
    assert!(q("ghost_share") < 0.01, "{r}");
    assert!(q("completeness") > 0.6 && q("accuracy") > 0.9, "{r}");
    assert!(r["track_quality"]["tracks"]["apd3d"].as_f64().unwrap() > 0.5, "{r}");
    assert!(r["object_quality"]["fg_ari"].as_f64().is_none_or(|ari| ari > 0.5), "{r}");
    assert_eq!(r["quarters"].as_array().unwrap().len(), 4);
}
