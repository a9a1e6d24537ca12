//! Cameras on joints, and poses in another frame than the outputs'.

use glam::{DQuat, DVec3};
use storm_render::Intrinsics;

use super::*;
use crate::msg::{CameraInfo, Header, TransformStamped};
use crate::source::mount::PoseNames;
use crate::source::rig::CameraDescription;

const MS: i64 = 1_000_000;

fn transform(parent: &str, child: &str, stamp_ns: i64, yaw: f64, x: f64) -> TransformStamped {
    let transform = Rigid::new(DQuat::from_rotation_z(yaw), DVec3::new(x, 0.0, 0.0));
    TransformStamped { header: Header { stamp_ns, frame_id: parent.into() }, child_frame_id: child.into(), transform }
}

/// A camera on a head that turns on the vehicle, seen from `pose` frames and what `tree` holds.
fn rig(tree: &TfTree, pose: &PoseNames, config: &Config) -> Rig {
    let k = Intrinsics { fx: 40.0, fy: 40.0, cx: 8.0, cy: 4.0, width: 16, height: 8 };
    let header = Header { stamp_ns: 0, frame_id: "eye".into() };
    let described = CameraDescription {
        topic: "/eye/image_rect".into(),
        info_topic: "/eye/camera_info".into(),
        frame_id: Some("eye".into()),
        info: Some(CameraInfo::pinhole(&k, header)),
        black_frame: None,
    };
    Rig::build(vec![described], tree, pose, &config.input, (16, 8)).unwrap()
}

fn set(stamp_ns: i64) -> FrameSet<()> {
    FrameSet { stamp_ns, epoch: 0, frames: vec![(stamp_ns, ())] }
}

#[test]
fn a_joint_is_looked_up_at_the_pictures_stamp_and_the_map_frame_at_the_poses() {
    let mut config = Config::default();
    config.input.map_frame = "map".into();
    let pose = PoseNames { frame: "odom".into(), child: "base".into() };
    let mut tree = TfTree::new(&config.sync);
    tree.insert(&transform("head", "eye", 0, 0.0, 0.5), true).unwrap();
    let statics = || {
        let mut tree = TfTree::new(&config.sync);
        tree.insert(&transform("head", "eye", 0, 0.0, 0.5), true).unwrap();
        tree
    };
    for t in [transform("base", "head", 0, 0.0, 1.0), transform("map", "odom", 0, 0.0, 100.0)] {
        tree.insert(&t, false).unwrap();
    }
    let rig = rig(&tree, &pose, &config);
    assert!(rig.needs_tree());
    assert_eq!((rig.map_frame.as_str(), rig.pose_frame.as_deref()), ("map", Some("odom")));
    let mut stage = PoseStage::new(PoseStore::of_messages(&rig, &config, statics), &rig, &config.sync);
    for i in 0..3i64 {
        let (stamp_ns, at) = (i * 100 * MS, i as f64);
        stage
            .take_pose(&Event::Pose { stamp_ns, map_from_base: Rigid::new(DQuat::IDENTITY, DVec3::new(0.0, at, 0.0)) });
        // The head turns by a tenth of a radian a sample, the map is put right by a metre a sample.
        stage.take_pose(&Event::Transform(Box::new(transform("base", "head", stamp_ns, 0.1 * at, 1.0))));
        stage.take_pose(&Event::Transform(Box::new(transform("map", "odom", stamp_ns, 0.0, 100.0 + at))));
    }
    stage.push_set(set(150 * MS));
    let posed = stage.pop(200 * MS).unwrap();
    let map_from_camera = posed.frames[0].map_from_camera;
    let (sin, cos) = 0.15f64.sin_cos();
    let want = DVec3::new(101.5 + 1.0 + 0.5 * cos, 1.5 + 0.5 * sin, 0.0);
    assert!((map_from_camera.translation - want).length() < 1e-9, "{:?}", map_from_camera.translation);
    assert!(map_from_camera.rotation.angle_between(DQuat::from_rotation_z(0.15)) < 1e-7);
    let base = stage.base_pose(0, 150 * MS, &map_from_camera);
    assert!((base.translation - DVec3::new(101.5, 1.5, 0.0)).length() < 1e-9, "{:?}", base.translation);
    // The pose is there, the joint is not yet: the picture waits.
    stage.take_pose(&Event::Pose { stamp_ns: 300 * MS, map_from_base: Rigid::IDENTITY });
    stage.take_pose(&Event::Transform(Box::new(transform("map", "odom", 300 * MS, 0.0, 103.0))));
    stage.push_set(set(250 * MS));
    assert!(stage.pop(300 * MS).is_none());
    stage.take_pose(&Event::Transform(Box::new(transform("base", "head", 300 * MS, 0.3, 1.0))));
    assert!(stage.pop(300 * MS).is_some());
}

#[test]
fn what_needs_no_tree_has_none() {
    let config = Config::default();
    let pose = PoseNames { frame: "world".into(), child: "eye".into() };
    let rig = rig(&TfTree::new(&config.sync), &pose, &config);
    assert_eq!((rig.map_frame.as_str(), rig.base_frame.as_str()), ("world", "eye"));
    let store = PoseStore::of_messages(&rig, &config, || TfTree::new(&config.sync));
    assert!(matches!(store, PoseStore::Buffer(_)));
    let other =
        Config { input: crate::config::InputConfig { map_frame: "map".into(), ..config.input.clone() }, ..config };
    let tree = TfTree::new(&other.sync);
    let k = Intrinsics { fx: 40.0, fy: 40.0, cx: 8.0, cy: 4.0, width: 16, height: 8 };
    let described = CameraDescription {
        topic: "/eye/image_rect".into(),
        info_topic: "/eye/camera_info".into(),
        frame_id: Some("eye".into()),
        info: Some(CameraInfo::pinhole(&k, Header::default())),
        black_frame: None,
    };
    let e = Rig::build(vec![described], &tree, &pose, &other.input, (16, 8)).err().map(|e| e.to_string());
    let e = e.unwrap_or_default();
    assert!(["`map`", "`world`", "input.map_frame"].iter().all(|word| e.contains(word)), "{e}");
}
