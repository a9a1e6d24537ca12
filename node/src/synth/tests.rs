use std::collections::BTreeMap;

use glam::DVec3;
use storm_render::world::DriveOptions;

use super::*;
use crate::bag::Bag;
use crate::cdr::decode;

/// A pose goes through a quaternion and back.
const POSE_TOLERANCE_M: f64 = 1e-6;

fn tiny() -> Drive {
    Drive::new(&DriveOptions {
        seed: 3,
        seconds: 0.4,
        cameras: 2,
        width: 48,
        height: 32,
        rate_hz: 10.0,
        stagger_sec: 0.013,
        origin: [500_000.0, 4_000_000.0, 10.0],
        ..DriveOptions::default()
    })
    .unwrap()
}

fn write(drive: &Drive, out: &Path, options: &SynthOptions) -> BagSummary {
    let mut calls = Vec::new();
    let summary = write_drive(drive, out, options, &mut |done, total| calls.push((done, total))).unwrap();
    let total = calls.len() as u64;
    assert_eq!(total, drive.frame_count() as u64 * 2);
    assert!(calls.iter().enumerate().all(|(i, &c)| c == (i as u64 + 1, total)));
    summary
}

/// Messages of each topic.
fn read(folder: &Path) -> BTreeMap<String, Vec<(i64, Vec<u8>)>> {
    let bag = Bag::open(folder).unwrap();
    assert_eq!(bag.problems(), [""; 0]);
    let all: Vec<usize> = (0..bag.topics().len()).collect();
    let mut out: BTreeMap<String, Vec<_>> = BTreeMap::new();
    for m in bag.messages(&all).unwrap() {
        let m = m.unwrap();
        out.entry(bag.topics()[m.topic].name.clone()).or_default().push((m.log_time_ns, m.data));
    }
    out
}

#[test]
fn two_runs_write_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let options = SynthOptions { images: ImageCoding::Jpeg { quality: 90 }, ..SynthOptions::default() };
    let folders = [dir.path().join("x/bag"), dir.path().join("y/bag")];
    for folder in &folders {
        write(&tiny(), folder, &options);
    }
    for name in ["bag_0.mcap", "metadata.yaml"] {
        let [a, b] = folders.each_ref().map(|f| std::fs::read(f.join(name)).unwrap());
        assert!(a == b, "{name} differs");
    }
}

#[test]
fn the_bag_holds_what_the_drive_says() {
    let dir = tempfile::tempdir().unwrap();
    let (drive, options) = (tiny(), SynthOptions::default());
    write(&drive, dir.path(), &options);
    let topics = read(dir.path());
    let frames = drive.frame_count();
    for camera in 0..2 {
        let spec = &drive.cameras()[camera];
        let images = &topics[&format!("/camera{camera}/image")];
        assert_eq!(images.len(), frames);
        for (k, (stamp_ns, data)) in images.iter().enumerate() {
            let t = drive.frame_time_sec(k as _, camera);
            let truth = drive.render(camera, t);
            let image = decode::image(data).unwrap();
            assert_eq!(image.header.stamp_ns, *stamp_ns);
            assert_eq!(*stamp_ns - options.start_stamp_ns, (t * 1e9).round() as i64);
            assert_eq!((image.header.frame_id.as_str(), image.encoding.as_str()), (&*camera_frame(camera), "rgb8"));
            assert_eq!((image.width, image.height, image.step), (48, 32, 144));
            assert_eq!(image.data, truth.rgb);
            let one = |name: &str| {
                let (at, data) = &topics[&format!("/ground_truth/camera{camera}/{name}")][k];
                assert_eq!(at, stamp_ns);
                decode::image(data).unwrap()
            };
            let floats = |data: &[u8]| -> Vec<f32> {
                data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
            };
            let (depth, flow, moving) = (one("depth"), one("flow"), one("moving"));
            assert_eq!((depth.encoding.as_str(), flow.encoding.as_str()), ("32FC1", "32FC3"));
            let depth = floats(&depth.data);
            assert!(depth.iter().zip(&truth.depth).all(|(a, b)| a == b) && depth.len() == 48 * 32);
            assert!(depth.iter().chain(&floats(&flow.data)).all(|v| v.is_finite()));
            assert!(floats(&flow.data).iter().eq(truth.flow.iter().flatten()));
            assert!(
                moving.data.iter().zip(&truth.moving).all(|(&a, &b)| (a == 255) == (b == 1) && (a == 255 || a == 0))
            );
            let sky = one("sky");
            assert!(sky.data.iter().zip(&depth).all(|(&s, &d)| (s == 255) == (d == 0.0)), "sky is where depth is 0");
            let instance = one("instance");
            assert_eq!((instance.encoding.as_str(), instance.step), ("mono16", 96));
        }
        let info = decode::camera_info(&topics[&format!("/camera{camera}/camera_info")][0].1).unwrap();
        assert_eq!(info.k[2], f64::from(spec.intrinsics.cx) - 0.5);
        assert_eq!((info.k[0], info.p[0], info.p[5]), (info.p[0], f64::from(spec.intrinsics.fx), info.k[4]));
        assert_eq!((info.d.len(), info.width, info.height), (5, 48, 32));
    }
    let odometry = &topics["/odometry"];
    for camera in 0..2 {
        for (k, (stamp_ns, _)) in topics[&format!("/camera{camera}/image")].iter().enumerate() {
            let (_, data) = odometry.iter().find(|o| o.0 == *stamp_ns).expect("a pose at every picture");
            let pose = decode::odometry(data).unwrap();
            assert_eq!((pose.header.frame_id.as_str(), pose.child_frame_id.as_str()), ("map", "base_link"));
            let truth = drive.map_from_base(drive.frame_time_sec(k as _, camera));
            for p in [DVec3::ZERO, DVec3::new(10.0, -3.0, 2.0)] {
                assert!((pose.pose.apply(p) - truth.transform_point3(p)).length() < POSE_TOLERANCE_M);
            }
        }
    }
    assert!(odometry.windows(2).all(|w| w[1].0 - w[0].0 <= 20_000_001), "at least 50 Hz");
    let tf = decode::tf_message(&topics["/tf_static"][0].1).unwrap();
    assert_eq!(tf.len(), 2);
    let p = DVec3::new(0.5, -0.25, 20.0);
    let mounted = drive.cameras()[1].base_from_camera.transform_point3(p);
    assert!((tf[1].transform.apply(p) - mounted).length() < POSE_TOLERANCE_M);
    assert_eq!((tf[1].header.frame_id.as_str(), tf[1].child_frame_id.as_str()), ("base_link", "camera1_optical"));
}

#[test]
fn compressed_pictures_and_no_ground_truth_when_asked() {
    let dir = tempfile::tempdir().unwrap();
    let drive = tiny();
    let options = SynthOptions { images: ImageCoding::Png, ground_truth: false, start_stamp_ns: 0 };
    let summary = write(&drive, dir.path(), &options);
    assert!(summary.topics.iter().all(|t| !t.name.starts_with(TRUTH_PREFIX)));
    let topics = read(dir.path());
    let first = decode::compressed_image(&topics["/camera0/image/compressed"][0].1).unwrap();
    assert_eq!(first.format, "png");
    let picture = image::load_from_memory(&first.data).unwrap().to_rgb8();
    let truth = drive.render(0, drive.frame_time_sec(0, 0));
    assert_eq!(picture.as_raw(), &truth.rgb);
}

#[test]
fn a_start_stamp_that_cannot_be_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let options = SynthOptions { start_stamp_ns: -5_000_000_000, ..SynthOptions::default() };
    let error = write_drive(&tiny(), dir.path(), &options, &mut |_, _| {}).unwrap_err();
    assert!(matches!(error, SynthError::Stamp { .. }), "{error}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is begun");
}
