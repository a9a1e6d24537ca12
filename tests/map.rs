//! The long-horizon map from outside: killed runs, damaged files, going on, and its figures against the truth.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{code, replay, stderr, storm, synth};
use storm_node::output::objects_csv;
use storm_node::output::ply::{PlyCloud, read_ply, write_ply};

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
    // The results folder, its map/ and a PLY are all a map.
    for map in [&out, &out.join("map"), &ply] {
        let shown = show_map(map, &[]);
        assert_eq!(code(&shown), 0, "{}: {}", map.display(), stderr(&shown));
        let png = dir.path().join("view.png");
        let view = ["--pose", "0,0,1,0", "--width", "64", "--height", "48", "--out", png.to_str().unwrap()];
        let drawn = storm(&[&["render", map.to_str().unwrap()], &view[..]].concat());
        assert_eq!(code(&drawn), 0, "{}: {}", map.display(), stderr(&drawn));
    }
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

/// A network that takes a third of the ego motion for the scene's, another part in every window, and whose velocities of
/// moving things are noisy: what the overlap of windows shows standing is not said to move, and the map stays whole.
#[test]
fn fast_ego_motion_does_not_make_the_street_move() {
    let dir = tempfile::tempdir().unwrap();
    let drive = |name: &str, more: &[&str]| -> serde_json::Value {
        let json = dir.path().join(name);
        // 54 m in 6 s, round a corner.
        let args = ["--quiet", "soak", "--seed", "1", "--seconds", "6", "--size", "64x40", "--ego-leak", "0.3"];
        let noisy = ["--velocity-error", "0.5", "--json", json.to_str().unwrap()];
        let output = storm(&[&args[..], &noisy[..], more].concat());
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        serde_json::from_str(&std::fs::read_to_string(&json).unwrap()).unwrap()
    };
    let with = drive("with.json", &[]);
    let of = |r: &serde_json::Value, side: &str, name: &str| r["motion_quality"][side][name].as_f64().unwrap();
    let (before, after) = (of(&with, "before", "still_moving"), of(&with, "after", "still_moving"));
    assert!(before > 0.3 && after < 0.15 * before, "{before} to {after}: {}", with["motion_quality"]);
    let (kept, given) = (of(&with, "after", "moving_kept"), of(&with, "before", "moving_kept"));
    assert!(kept > 0.9 * given, "{given} to {kept}");
    let without = drive("without.json", &["--set", "overlap.enabled=false"]);
    let created = |r: &serde_json::Value| r["map"]["created"].as_u64().unwrap();
    assert!(created(&with) > 2 * created(&without), "{} {}", created(&with), created(&without));
    let born = |r: &serde_json::Value| r["tracks"]["born"].as_u64().unwrap();
    assert!(5 * born(&with) < 3 * born(&without), "{} {}", born(&with), born(&without));
}

#[test]
fn a_map_refined_on_its_bag_draws_held_out_pictures_better() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out, refined) = (dir.path().join("bag"), dir.path().join("out"), dir.path().join("refined"));
    synth(&bag, 9, "2.4", &[]);
    let output = replay(&bag, &out, &["--set", "map.static_speed_mps=100", "--set", "output.bag=false"]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let text = |p: &Path| p.to_str().unwrap().to_string();
    let args = [
        "--quiet",
        "refine",
        &text(&out),
        "--bag",
        &text(&bag),
        "--out",
        &text(&refined),
        "--iterations",
        "120",
        "--score-every",
        "60",
        "--size",
        "72x48",
        "--moments",
        "12",
    ];
    let output = storm(&args);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let csv = std::fs::read_to_string(refined.join("refine.csv")).unwrap();
    let held_out: Vec<f64> = csv.lines().skip(1).map(|l| l.rsplit(',').next().unwrap().parse().unwrap()).collect();
    assert!(held_out.len() == 3 && held_out[2] > held_out[0] + 0.5, "{csv}");
    let json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(refined.join("refine.json")).unwrap()).unwrap();
    assert_eq!((&json["report"]["held_out"], &json["report"]["fitted"]), (&6.into(), &30.into()), "{json}");
    let (before, after) = (read_ply(&out.join("map.ply")).unwrap(), read_ply(&refined.join("map.ply")).unwrap());
    assert_eq!((before.cloud.len(), before.origin_m), (after.cloud.len(), after.origin_m));
    assert!(before.cloud.colors01 != after.cloud.colors01);
    assert_eq!(code(&show_map(&refined.join("map"), &[])), 0);
    // Of another place there is nothing to learn, and that is said.
    let elsewhere = dir.path().join("elsewhere");
    synth(&elsewhere, 9, "1.0", &["--origin", "90000,0,0"]);
    let output = storm(&["--quiet", "refine", &text(&out), "--bag", &text(&elsewhere), "--out", &text(&refined)]);
    assert_eq!(code(&output), 2);
    assert!(stderr(&output).contains("another recording"), "{}", stderr(&output));
}

#[test]
fn moving_objects_are_left_out_kept_or_drawn_alone() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let cloud = |at: [f32; 3], color: [f32; 3]| PlyCloud {
        positions: vec![at],
        colors01: vec![color],
        opacities: vec![0.99],
        scales: vec![[0.5; 3]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
    };
    // A green thing that stands to the left, a red one that drives by on the right, from 6 m to 10 m ahead in a second.
    write_ply(&folder.join("map.ply"), &cloud([8.0, 2.0, 0.0], [0.0, 1.0, 0.0]), [0.0; 3], &[]).unwrap();
    std::fs::create_dir(folder.join("objects")).unwrap();
    write_ply(&folder.join("objects/4.ply"), &cloud([0.0; 3], [1.0, 0.0, 0.0]), [0.0; 3], &[]).unwrap();
    let row = |ns: i64, x: f64| format!("4,{ns},{x},-2.0,0.0,0.0,1,1,1,4,0,0,0,0,0,1,,,\n");
    let rows = format!("{}\n{}{}", objects_csv::OBJECTS_HEADER, row(5_000_000_000, 6.0), row(6_000_000_000, 10.0));
    std::fs::write(folder.join("objects.csv"), rows).unwrap();
    std::fs::write(folder.join("trajectory.tum"), "5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n").unwrap();
    let png = folder.join("view.png");
    let draw = |more: &[&str]| {
        let base = ["render", folder.to_str().unwrap(), "--pose", "0,0,0,0", "--width", "90", "--height", "60"];
        let output = storm(&[&base[..], &["--out", png.to_str().unwrap()], more].concat());
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        let picture = image::open(&png).unwrap().to_rgb8();
        let bright = |k: usize| picture.pixels().filter(|p| p[k] > 100 && p[k] > p[1 - k] + 50).count();
        (bright(0), bright(1))
    };
    let (red, green) = draw(&[]);
    assert!(red == 0 && green > 20);
    let (near, green_kept) = draw(&["--objects", "keep", "--at", "0.0"]);
    let (far, _) = draw(&["--objects", "keep", "--at", "1.0"]);
    assert!(near > far && far > 10 && green_kept == green, "{near} {far}");
    let (half, none) = draw(&["--objects", "only", "--at", "0.5"]);
    assert!(half > far && half < near && none == 0, "{half}");
    assert_eq!(draw(&["--objects", "keep", "--at", "1.5"]), (0, green), "it is not there any more");
    assert_eq!(draw(&["--objects", "remove"]), (0, green));
    // Along the trajectory each picture has its own time.
    let pictures = folder.join("pictures");
    let (text, tum) = (pictures.to_str().unwrap(), folder.join("trajectory.tum"));
    let args =
        ["render", folder.to_str().unwrap(), "--trajectory", tum.to_str().unwrap(), "--height-m", "0", "--out", text];
    let output = storm(&[&args[..], &["--objects", "only", "--width", "90", "--height", "60"]].concat());
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let red = |name: &str| {
        let picture = image::open(pictures.join(name)).unwrap().to_rgb8();
        picture.pixels().filter(|p| p[0] > 100 && p[1] < 60).count()
    };
    assert!(red("000000.png") > red("000001.png") && red("000001.png") > 10);
}
