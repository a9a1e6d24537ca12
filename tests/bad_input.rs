//! Bad input gets a clear message and the right exit code, and everything readable is still processed.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;
#[path = "common/maker.rs"]
mod maker;

use std::path::{Path, PathBuf};

use common::{code, metrics, replay, shared, stderr, storm};
use maker::{FRAMES, Maker, stamp};

/// Steps an unspoiled bag gives: a window ends at every frame but the first 15.
const STEPS: u64 = (FRAMES - 15) as u64;

struct Run {
    code: i32,
    /// The exit code of `storm info`.
    info: i32,
    stderr: String,
    out: PathBuf,
    _dir: tempfile::TempDir,
}

impl Run {
    fn metric(&self, name: &str) -> u64 {
        metrics(&self.out)[name].as_u64().unwrap_or_else(|| panic!("{name}"))
    }

    fn dropped(&self, reason: &str) -> u64 {
        metrics(&self.out)["dropped"][reason].as_u64().unwrap_or_else(|| panic!("{reason}"))
    }

    fn says(&self, words: &[&str]) {
        for word in words {
            assert!(self.stderr.contains(word), "'{word}' missing in: {}", self.stderr);
        }
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
    }
}

fn run(maker: Maker) -> Run {
    run_bytes(maker, |b| b)
}

fn run_bytes(maker: Maker, spoil: impl Fn(Vec<u8>) -> Vec<u8>) -> Run {
    run_with(maker, spoil, &[])
}

fn run_with(maker: Maker, spoil: impl Fn(Vec<u8>) -> Vec<u8>, more: &[&str]) -> Run {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag.mcap"), dir.path().join("out"));
    maker.write(&bag);
    std::fs::write(&bag, spoil(std::fs::read(&bag).unwrap())).unwrap();
    let log = std::process::Command::new(env!("CARGO_BIN_EXE_storm"))
        .args(["replay", bag.to_str().unwrap(), "--out", out.to_str().unwrap()])
        .args(["--set", "model.image_width=48", "--set", "model.image_height=32"])
        .args(more)
        .output()
        .unwrap();
    let asked = std::process::Command::new(env!("CARGO_BIN_EXE_storm"))
        .args(["info", bag.to_str().unwrap()])
        .args(more)
        .output()
        .unwrap();
    Run { code: code(&log), info: code(&asked), stderr: stderr(&log), out, _dir: dir }
}

#[test]
fn an_unspoiled_bag_loses_nothing() {
    let r = run(Maker::default());
    assert_eq!(r.code, 0, "{}", r.stderr);
    assert!(r.metric("steps") >= STEPS);
    assert_eq!(r.metric("images_in"), 2 * FRAMES as u64);
    assert_eq!(r.info, 0);
}

#[test]
fn images_of_another_size_than_their_camera_info_are_refused_once_with_both_sizes() {
    let info = |_: usize, k: &mut storm_node::msg::CameraInfo| {
        (k.width, k.height) = (640, 480);
        true
    };
    let r = run(Maker { info: Box::new(info), ..Maker::default() });
    assert_eq!((r.code, r.info), (2, 2), "{}", r.stderr);
    r.says(&["64x48", "640x480", "/camera0/image"]);
    assert!(!r.stderr.contains("QoS"), "{}", r.stderr);
    assert_eq!(r.stderr.matches("640x480").count(), 1, "{}", r.stderr);
}

#[test]
fn stamps_that_were_never_filled_in_are_refused_with_the_key_that_helps() {
    let maker = || {
        let image = |_: usize, m: &mut storm_node::msg::Image| {
            m.header.stamp_ns = 0;
            true
        };
        Maker { image: Box::new(image), ..Maker::default() }
    };
    let r = run(maker());
    assert_eq!((r.code, r.info), (2, 2), "{}", r.stderr);
    r.says(&["/camera0/image", "stamps are 0 s", "input.stamps=recorded"]);
    let r = run_with(maker(), |b| b, &["--set", "input.stamps=recorded"]);
    assert_eq!((r.code, r.info), (0, 0), "{}", r.stderr);
    assert!(r.metric("steps") >= STEPS);
}

#[test]
fn images_and_poses_of_two_clocks_are_refused_with_the_distance() {
    let pose = |_: usize, p: &mut storm_node::msg::PoseStamped| {
        p.header.stamp_ns -= 1_699_999_000 * 1_000_000_000;
        true
    };
    let r = run(Maker { pose: Box::new(pose), ..Maker::default() });
    assert_eq!((r.code, r.info), (2, 2), "{}", r.stderr);
    r.says(&["1,699,999,000 s later than poses", "two clocks", "input.image_time_offset_sec"]);
}

#[test]
fn a_recording_too_short_for_a_window_says_what_one_needs() {
    let r = run_with(Maker::default(), |b| b, &["--set", "window.stride_sec=5"]);
    assert_eq!((r.code, r.info), (3, 3), "{}", r.stderr);
    r.says(&["no step was run", "4 timesteps 5 s apart", "window.stride_sec"]);
}

#[test]
fn a_camera_at_half_the_rate_loses_nothing() {
    let r = run(Maker { image: Box::new(|i, _| i < 1000 || i % 2 == 0), ..Maker::default() });
    assert_eq!((r.code, r.info), (0, 0), "{}", r.stderr);
    assert_eq!((r.dropped("surplus"), r.dropped("incomplete")), (10, 0));
}

#[test]
fn results_of_another_recording_are_kept_unless_asked() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b, out) = (dir.path().join("a.mcap"), dir.path().join("b.mcap"), dir.path().join("out"));
    for bag in [&a, &b] {
        Maker::default().write(bag);
    }
    assert_eq!(code(&replay(&a, &out, &[])), 0);
    assert_eq!(code(&replay(&a, &out, &[])), 0, "the same recording again");
    let refused = replay(&b, &out, &[]);
    assert_eq!(code(&refused), 1, "{}", stderr(&refused));
    assert!(stderr(&refused).contains("a.mcap") && stderr(&refused).contains("--overwrite"), "{}", stderr(&refused));
    assert!(metrics(&out)["recording"].as_str().unwrap().ends_with("/a.mcap"));
    assert_eq!(code(&replay(&b, &out, &["--overwrite"])), 0);
    assert!(metrics(&out)["recording"].as_str().unwrap().ends_with("/b.mcap"));
}

#[test]
fn poses_from_tf_give_the_same_map_as_poses_from_a_topic() {
    let (topic, tf) = (run(Maker::default()), run(Maker { tf: true, ..Maker::default() }));
    assert_eq!(tf.code, 0, "{}", tf.stderr);
    let map = |r: &Run| std::fs::read(r.out.join("map.ply")).unwrap();
    assert!(map(&topic) == map(&tf));
    assert!(map(&tf).len() > 10_000, "the map is empty");
}

#[test]
fn a_missing_camera_info_is_named() {
    let r = run(Maker { info: Box::new(|camera, _| camera != 1), ..Maker::default() });
    assert_eq!(r.code, 2, "{}", r.stderr);
    assert_eq!(r.info, 2);
    r.says(&["/camera1/camera_info", "intrinsics"]);
}

#[test]
fn an_unknown_distortion_model_is_refused() {
    let info = |_: usize, k: &mut storm_node::msg::CameraInfo| {
        k.distortion_model = "thin_prism".into();
        k.d = vec![0.1; 4];
        true
    };
    let r = run(Maker { info: Box::new(info), ..Maker::default() });
    assert_eq!(r.code, 2, "{}", r.stderr);
    r.says(&["thin_prism", "plumb_bob"]);
}

#[test]
fn missing_poses_are_named() {
    let r = run(Maker { pose: Box::new(|_, _| false), ..Maker::default() });
    assert_eq!(r.code, 2, "{}", r.stderr);
    r.says(&["pose"]);
}

#[test]
fn a_missing_mounting_is_named_with_the_fix() {
    let r = run(Maker { mount: Box::new(|camera, _| camera != 1), ..Maker::default() });
    assert_eq!(r.code, 2, "{}", r.stderr);
    assert_eq!(r.info, 2);
    r.says(&["camera1_optical", "base_link", "input.base_from_camera"]);
}

#[test]
fn a_pose_that_is_not_finite_is_refused_and_the_rest_goes_on() {
    let pose = |i: usize, p: &mut storm_node::msg::PoseStamped| {
        if i == 7 {
            p.pose.translation.y = f64::NAN;
        }
        true
    };
    let r = run(Maker { pose: Box::new(pose), ..Maker::default() });
    assert_eq!(r.code, 3, "{}", r.stderr);
    r.says(&[&stamp(7).to_string()]);
    assert_eq!(r.metric("poses_rejected"), 1);
    // The poses around it lie 0.2 s apart and are interpolated across.
    assert!(r.metric("steps") >= STEPS);
}

#[test]
fn a_quaternion_far_from_unit_is_refused() {
    let pose = |i: usize, p: &mut storm_node::msg::PoseStamped| {
        if i == 4 {
            p.pose.rotation = glam::DQuat::from_xyzw(0.0, 0.0, 0.0, 3.0);
        }
        true
    };
    let r = run(Maker { pose: Box::new(pose), ..Maker::default() });
    assert_eq!(r.code, 3, "{}", r.stderr);
    r.says(&[&stamp(4).to_string(), "quaternion"]);
}

#[test]
fn an_image_that_lies_about_its_size_is_refused() {
    // Height and width follow the encapsulation (4 bytes), the stamp (8) and the 15-letter frame name (4 + 16).
    const HEIGHT_AT: usize = 32;
    let bytes = |i: usize, mut b: Vec<u8>| {
        if i == 6 {
            b[HEIGHT_AT..HEIGHT_AT + 4].copy_from_slice(&100_000u32.to_le_bytes());
            b[HEIGHT_AT + 4..HEIGHT_AT + 8].copy_from_slice(&1_000_000u32.to_le_bytes());
        }
        b
    };
    let r = run(Maker { bytes: Box::new(bytes), ..Maker::default() });
    assert_eq!(r.code, 3, "{}", r.stderr);
    r.says(&["/camera0/image", &stamp(6).to_string(), "1000000"]);
    // The other camera's picture of that set is left alone.
    assert_eq!((r.dropped("decode"), r.dropped("incomplete")), (1, 1));
    assert!(r.metric("steps") >= STEPS - 2);
}

#[test]
fn a_size_that_changes_mid_way_is_named() {
    let image = |i: usize, m: &mut storm_node::msg::Image| {
        if i == 1009 {
            (m.width, m.step) = (32, 96);
            m.data.truncate(96 * 48);
        }
        true
    };
    let r = run(Maker { image: Box::new(image), ..Maker::default() });
    assert_eq!(r.code, 3, "{}", r.stderr);
    r.says(&["/camera1/image", "32x48", "64x48"]);
}

#[test]
fn bytes_that_are_no_message_are_refused() {
    let bytes = |i: usize, b: Vec<u8>| if i == 3 { vec![0, 1, 0, 0, 255, 255, 255, 255] } else { b };
    let r = run(Maker { bytes: Box::new(bytes), ..Maker::default() });
    assert_eq!(r.code, 3, "{}", r.stderr);
    r.says(&["/camera0/image"]);
    assert_eq!(r.dropped("decode"), 1);
}

#[test]
fn an_unknown_encoding_is_named() {
    let image = |_: usize, m: &mut storm_node::msg::Image| {
        m.encoding = "nv99".into();
        true
    };
    let r = run(Maker { image: Box::new(image), ..Maker::default() });
    assert_eq!(r.code, 2, "{}", r.stderr);
    r.says(&["/camera0/image", "nv99", "rgb8"]);
    assert!(!r.out.join("metrics.json").exists(), "the bag was run all the same");
}

#[test]
fn a_clock_that_jumps_back_starts_a_new_epoch() {
    const BACK_NS: i64 = 3_600_000_000_000;
    let image = |i: usize, m: &mut storm_node::msg::Image| {
        if i % 1000 >= 10 {
            m.header.stamp_ns -= BACK_NS;
        }
        true
    };
    let pose = |i: usize, p: &mut storm_node::msg::PoseStamped| {
        if i >= 10 {
            p.header.stamp_ns -= BACK_NS;
        }
        true
    };
    let r = run(Maker { image: Box::new(image), pose: Box::new(pose), ..Maker::default() });
    assert!(r.code == 0 || r.code == 3, "{}", r.stderr);
    r.says(&[]);
    assert!(r.metric("epochs") >= 1, "{}", r.stderr);
}

#[test]
fn a_camera_that_stops_is_counted() {
    let r = run(Maker { image: Box::new(|i, _| i < 1010), ..Maker::default() });
    assert_eq!(r.code, 3, "{}", r.stderr);
    r.says(&["incomplete"]);
    assert_eq!(r.dropped("incomplete"), FRAMES as u64 - 10);
}

#[test]
fn a_cut_file_gives_what_is_before_the_cut() {
    let r = run_bytes(Maker::default(), |mut b| {
        b.truncate(b.len() / 2);
        b
    });
    // One chunk holds such a small bag, so a cut may leave nothing; either way the cut is named.
    assert!(r.code == 2 || r.code == 3, "{} {}", r.code, r.stderr);
    r.says(&[]);
}

#[test]
fn files_that_are_no_bags_are_unreadable_input() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let cases = [
        write("empty.mcap", b""),
        write("text.mcap", b"this is no bag"),
        write("text.db3", b"this is no bag either"),
        write("note.txt", b"nor this"),
        dir.path().join("missing.mcap"),
    ];
    for path in cases {
        let output = replay(&path, &dir.path().join("out"), &[]);
        assert_eq!(code(&output), 2, "{}: {}", path.display(), stderr(&output));
        let lines = stderr(&output).lines().count();
        assert_eq!(lines, 1, "{}: {}", path.display(), stderr(&output));
    }
}

/// Every bag of other people's tests that lies beside the project: none has images, or none can be read; each says why in
/// one line.
#[test]
fn odd_bags_are_refused_with_a_reason() {
    let Some(odd) = shared("bags/odd") else { return };
    let mut bags = Vec::new();
    find_bags(&odd, &mut bags);
    assert!(bags.len() > 20, "only {} bags found", bags.len());
    let dir = tempfile::tempdir().unwrap();
    for bag in bags {
        let output =
            storm(&["--quiet", "replay", bag.to_str().unwrap(), "--out", dir.path().join("o").to_str().unwrap()]);
        let (code, said) = (code(&output), stderr(&output));
        assert_eq!(code, 2, "{}: {said}", bag.display());
        assert_eq!(said.lines().count(), 1, "{}: {said}", bag.display());
        println!("{}: {}", bag.strip_prefix(&odd).unwrap().display(), said.trim());
    }
}

fn find_bags(dir: &Path, bags: &mut Vec<PathBuf>) {
    let mut entries: Vec<PathBuf> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    let is_bag = |p: &Path| p.extension().is_some_and(|e| e == "mcap" || e == "db3");
    if dir.join("metadata.yaml").exists() || entries.iter().filter(|p| is_bag(p)).count() > 1 {
        bags.push(dir.to_path_buf());
    }
    for path in entries {
        match path.is_dir() {
            true => find_bags(&path, bags),
            false if is_bag(&path) => bags.push(path),
            false => {}
        }
    }
}

#[test]
fn what_came_in_is_what_was_used_and_what_was_dropped() {
    // An unreadable image, and a camera that stops half-way.
    let bytes = |i: usize, b: Vec<u8>| if i == 3 { vec![0, 1, 0, 0, 9] } else { b };
    let r = run(Maker { bytes: Box::new(bytes), image: Box::new(|i, _| i < 1012), ..Maker::default() });
    let m = metrics(&r.out);
    let dropped: u64 = m["dropped"].as_object().unwrap().values().filter_map(|n| n.as_u64()).sum();
    assert_eq!(r.metric("images_in"), 2 * r.metric("frames_in") + dropped, "{m}");
    assert_eq!(r.metric("messages_lost"), 0);
}
