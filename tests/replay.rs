//! The main job over procedural bags: results complete, the same every time, and as exact far from the origin as near it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::path::Path;

use common::{code, metrics, replay, stderr, synth};
use storm_node::bag::Bag;
use storm_node::cdr::decode;
use storm_node::output::ply::read_ply;

/// Positions relative to the first pose may differ by this between a drive at the origin and one at UTM size, metres.
/// f32 steps at 100 m are 8e-6; the network amplifies input differences of that size.
const FAR_ORIGIN_TOLERANCE_M: f32 = 1e-3;

const FILES: [&str; 7] =
    ["map.ply", "tracks.csv", "outputs.mcap", "trajectory.tum", "metrics.json", "config.yaml", "report.html"];

fn bytes(dir: &Path, name: &str) -> Vec<u8> {
    std::fs::read(dir.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

#[test]
fn a_drive_becomes_a_results_folder_and_twice_the_same_one() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("bag");
    synth(&bag, 5, "2.6", &[]);
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    let first = replay(&bag, &a, &[]);
    assert_eq!(code(&first), 0, "{}", stderr(&first));
    for name in FILES {
        assert!(!bytes(&a, name).is_empty(), "{name} is empty");
    }
    let m = metrics(&a);
    assert_eq!(m["weights"], "tiny (shipped)");
    assert_eq!(m["nonfinite"], 0);
    assert_eq!(m["frames_in"], 26);
    // 26 frames at 10 Hz; the first window is full at frame 15.
    assert!(m["steps"].as_u64().unwrap() >= 11, "{m}");
    assert!(m["dropped"].as_object().unwrap().values().all(|n| n == 0), "{}", m["dropped"]);
    assert!(m["held_out"]["storm"]["psnr"].as_f64().unwrap().is_finite());
    assert!(m["held_out"]["storm"]["epe3d"].as_f64().unwrap().is_finite(), "{}", m["held_out"]);
    let second = replay(&bag, &b, &["--set", "model.threads=1"]);
    assert_eq!(code(&second), 0, "{}", stderr(&second));
    for name in ["map.ply", "tracks.csv", "trajectory.tum", "outputs.mcap"] {
        assert!(bytes(&a, name) == bytes(&b, name), "{name} differs between two runs");
    }
}

/// Whoever replays `outputs.mcap` sees the map grow: the last of each tile's messages together are the map at the end.
#[test]
fn the_changed_tiles_in_outputs_mcap_add_up_to_the_map() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag"), dir.path().join("out"));
    synth(&bag, 5, "2.6", &[]);
    let output = replay(&bag, &out, &["--set", "output.map_every_sec=0.3", "--set", "output.map_max_mb=0.05"]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let file = Bag::open(&out.join("outputs.mcap")).unwrap();
    let topic = file.topics().iter().position(|t| t.name == "/storm/output/map_update").unwrap();
    let mut tiles = std::collections::BTreeMap::<[i32; 3], Vec<[f32; 3]>>::new();
    let mut messages = 0;
    for message in file.messages(&[topic]).unwrap() {
        let cloud = decode::point_cloud2(&message.unwrap().data).unwrap();
        messages += 1;
        let mut now = std::collections::BTreeMap::<[i32; 3], Vec<[f32; 3]>>::new();
        for row in cloud.data.chunks_exact(cloud.point_step as usize) {
            let word = |name: &str, k: usize| {
                let at = cloud.fields.iter().find(|f| f.name == name).unwrap().offset as usize + 4 * k;
                <[u8; 4]>::try_from(&row[at..at + 4]).unwrap()
            };
            let tile = now.entry([0, 1, 2].map(|k| i32::from_le_bytes(word("tile_x", k)))).or_default();
            if f32::from_le_bytes(word("opacity", 0)) > 0.0 {
                tile.push([0, 1, 2].map(|k| f32::from_le_bytes(word("x", k))));
            }
        }
        tiles.extend(now);
    }
    assert!(messages > 4, "{messages} messages");
    let mut told: Vec<_> = tiles.into_values().flatten().map(|p| p.map(f32::to_bits)).collect();
    let map = read_ply(&out.join("map.ply")).unwrap();
    let mut whole: Vec<_> = map.cloud.positions.iter().map(|p| p.map(f32::to_bits)).collect();
    told.sort_unstable();
    whole.sort_unstable();
    assert!(!whole.is_empty() && told == whole, "{} told, {} in the map", told.len(), whole.len());
}

#[test]
fn far_from_the_origin_nothing_is_lost() {
    let dir = tempfile::tempdir().unwrap();
    let clouds = [("near", "0,0,0"), ("far", "500000,4000000,0")].map(|(name, origin)| {
        let (bag, out) = (dir.path().join(format!("bag_{name}")), dir.path().join(name));
        synth(&bag, 11, "1.7", &["--origin", origin]);
        let output = replay(&bag, &out, &[]);
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        read_ply(&out.join("map.ply")).unwrap()
    });
    let [near, far] = &clouds;
    assert!(far.origin_m[1] > 3_999_000.0, "{:?}", far.origin_m);
    assert_eq!(near.cloud.len(), far.cloud.len());
    for (a, b) in near.cloud.positions.iter().zip(&far.cloud.positions) {
        for k in 0..3 {
            assert!((a[k] - b[k]).abs() <= FAR_ORIGIN_TOLERANCE_M, "{a:?} {b:?}");
        }
    }
}

#[test]
fn cameras_that_fire_one_after_the_other_are_brought_together() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag"), dir.path().join("out"));
    synth(&bag, 2, "1.8", &["--stagger", "0.005", "--cameras", "2"]);
    let output = replay(&bag, &out, &[]);
    let m = metrics(&out);
    // Images after the last pose cannot be placed, everything else must be.
    assert!(code(&output) == 0 || m["dropped"]["no_pose"].as_u64().unwrap() <= 2, "{}", stderr(&output));
    assert!(m["steps"].as_u64().unwrap() >= 1, "{m}");
}

/// One camera and one timestep is the smallest window, six and ten the largest.
#[test]
fn any_number_of_cameras_and_timesteps() {
    let dir = tempfile::tempdir().unwrap();
    for (cameras, timesteps, stride) in [("1", "1", "0.5"), ("6", "2", "0.4"), ("2", "10", "0.1")] {
        let name = format!("{cameras}x{timesteps}");
        let (bag, out) = (dir.path().join(format!("bag{name}")), dir.path().join(&name));
        synth(&bag, 8, "1.2", &["--cameras", cameras]);
        let (steps, stride) = (format!("window.timesteps={timesteps}"), format!("window.stride_sec={stride}"));
        let output = replay(&bag, &out, &["--set", &steps, "--set", &stride, "--set", "window.hop_sec=0.2"]);
        assert_eq!(code(&output), 0, "{name}: {}", stderr(&output));
        let m = metrics(&out);
        assert!(m["steps"].as_u64().unwrap() >= 1, "{name}: {m}");
        let gaussians = cameras.parse::<u64>().unwrap() * timesteps.parse::<u64>().unwrap() * 48 * 32;
        assert_eq!(m["gaussians"].as_u64().unwrap(), gaussians, "{name}");
    }
}

#[test]
fn the_recorded_stereo_bags_are_replayed_whole() {
    for (bag, frames, steps) in [("kitti_ramp_stereo", 51, 36), ("kitti_ramp_stereo_sqlite", 20, 5)] {
        let Some(bag) = common::shared(&format!("bags/{bag}")) else { return };
        let dir = tempfile::tempdir().unwrap();
        let output = replay(&bag, dir.path(), &[]);
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        let m = metrics(dir.path());
        assert_eq!(m["frames_in"], frames);
        assert!(m["steps"].as_u64().unwrap() >= steps, "{m}");
        assert!(m["dropped"].as_object().unwrap().values().all(|n| n == 0), "{}", m["dropped"]);
        assert_eq!(m["nonfinite"], 0);
    }
}

#[test]
fn a_saved_map_and_a_saved_step_can_be_drawn() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag"), dir.path().join("out"));
    synth(&bag, 3, "1.7", &[]);
    assert_eq!(code(&replay(&bag, &out, &[])), 0);
    let folder = out.to_str().unwrap();
    let png = dir.path().join("view.png");
    let target = png.to_str().unwrap();
    let map = out.join("map.ply");
    for args in [
        vec!["render", map.to_str().unwrap(), "--pose", "0,0,2,0", "--out", target],
        vec!["render", folder, "--pose", "0,0,2,0,-5", "--what", "depth", "--out", target],
        vec!["render", folder, "--step", "0", "--time", "0.3", "--pose", "0,0,2,0", "--what", "flow", "--out", target],
    ] {
        let output = common::storm(&args);
        assert_eq!(code(&output), 0, "{args:?}: {}", stderr(&output));
        assert!(std::fs::read(&png).unwrap().starts_with(b"\x89PNG"));
        std::fs::remove_file(&png).unwrap();
    }
    let trajectory = out.join("trajectory.tum");
    let frames = dir.path().join("frames");
    let args = ["render", folder, "--step", "1", "--trajectory", trajectory.to_str().unwrap(), "--what", "mask"];
    let output =
        common::storm(&[&args[..], &["--width", "96", "--height", "64", "--out", frames.to_str().unwrap()]].concat());
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    assert_eq!(std::fs::read_dir(&frames).unwrap().count(), 17);
    let output = common::storm(&["render", folder, "--step", "999", "--pose", "0,0,0,0", "--out", target]);
    assert_eq!(code(&output), 2);
    assert!(stderr(&output).contains("999"), "{}", stderr(&output));
}
