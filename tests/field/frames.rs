//! Whose pose it is and in which frame: names that are not the usual ones, trees, joints, poses sent once, clocks that loop.

use glam::{DQuat, DVec3};
use storm_node::cdr::schema::MessageType;
use storm_node::cdr::{decode, encode};
use storm_node::msg::{Header, PoseStamped, TransformStamped};
use storm_node::output::tum::read_tum;
use storm_node::rigid::Rigid;

use super::recording::{IMAGE, INFO, Message, POSE, Recording, STATICS};
use super::run::{Ran, control, replay};

const CAMERA: &str = "camera0_optical";
/// Poses that went through other f64 on their way, but are the same.
const ROUNDING_DB: f64 = 0.02;

fn transform(parent: &str, child: &str, stamp_ns: i64, transform: Rigid) -> TransformStamped {
    TransformStamped { header: Header { stamp_ns, frame_id: parent.into() }, child_frame_id: child.into(), transform }
}

fn tf(topic: &str, log_ns: i64, list: &[TransformStamped]) -> Message {
    let data = encode::encode_tf_message(list).unwrap();
    Message { topic: topic.into(), kind: MessageType::TfMessage, log_ns, data }
}

fn pose_message(topic: &str, log_ns: i64, pose: &PoseStamped) -> Message {
    let data = encode::encode_pose_stamped(pose).unwrap();
    Message { topic: topic.into(), kind: MessageType::PoseStamped, log_ns, data }
}

fn poses() -> Vec<(i64, PoseStamped)> {
    let odometry = Recording::control().only(POSE).0;
    odometry.iter().map(|m| (m.log_ns, decode::odometry(&m.data).unwrap())).collect()
}

fn mount() -> Rigid {
    decode::tf_message(&Recording::control().only(STATICS).0[0].data).unwrap()[0].transform
}

/// The control drive with its poses on `topic` as `fixed` -> `base_link`.
fn pose_on_tf(topic: &str, fixed: &str) -> Recording {
    let on_tf = |m: Message| {
        let pose = decode::odometry(&m.data).unwrap();
        vec![tf(topic, m.log_ns, &[transform(fixed, "base_link", pose.header.stamp_ns, pose.pose)])]
    };
    Recording::control().each(POSE, on_tf)
}

fn trajectory(ran: &Ran, name: &str) -> Vec<(i64, Rigid)> {
    read_tum(&ran.dir.path().join("out").join(name)).unwrap()
}

#[test]
fn a_leading_slash_is_no_other_frame() {
    let slashed = Recording::control().poses(|p| {
        (p.header.frame_id, p.child_frame_id) = ("/map".into(), "/base_link".into());
    });
    replay(slashed.statics(|list| list[0].header.frame_id = "/base_link".into()), &[]).like_control(0.0);
}

#[test]
fn outputs_are_in_the_poses_own_frame_unless_the_tree_leads_to_another() {
    let in_odom = || Recording::control().poses(|p| p.header.frame_id = "odom".into());
    let map_from_odom = Rigid::new(DQuat::from_rotation_z(0.5), DVec3::new(10.0, -3.0, 0.0));
    let with_map = || {
        let above = |(log_ns, p): &(i64, PoseStamped)| {
            tf("/tf", *log_ns, &[transform("map", "odom", p.header.stamp_ns, map_from_odom)])
        };
        in_odom().and(Recording(poses().iter().map(above).collect()))
    };
    for recording in [in_odom(), with_map()] {
        let ran = replay(recording, &[]);
        ran.like_control(0.0);
        assert_eq!(ran.metrics["map_frame"], "odom");
        assert_eq!(trajectory(&ran, "trajectory.tum"), trajectory(control(), "trajectory.tum"));
        let text = std::fs::read_to_string(ran.dir.path().join("out/trajectory.tum")).unwrap();
        assert!(text.starts_with("# base_link in odom"), "{text}");
    }
    let ran = replay(with_map(), &["input.map_frame=map"]);
    ran.like_control(ROUNDING_DB);
    assert_eq!(ran.metrics["map_frame"], "map");
    let moved = trajectory(&ran, "trajectory.tum");
    for ((stamp_ns, got), (control_ns, pose)) in moved.iter().zip(trajectory(control(), "trajectory.tum")) {
        let want = map_from_odom * pose;
        assert!(*stamp_ns == control_ns && (got.translation - want.translation).length() < 1e-9);
    }
    replay(in_odom(), &["input.map_frame=map"]).refused(&["`map`", "`odom`", "input.map_frame"]);
}

#[test]
fn the_pose_may_be_in_the_tree_in_one_step_or_two() {
    replay(pose_on_tf("/tf", "map"), &[]).like_control(ROUNDING_DB);
    for fixed in ["odom", "world", "utm_32"] {
        let ran = replay(pose_on_tf("/tf", fixed), &[]);
        ran.like_control(ROUNDING_DB);
        assert_eq!(ran.metrics["map_frame"], fixed);
    }
    let map_from_odom = Rigid::new(DQuat::from_rotation_z(-0.3), DVec3::new(5.0, 7.0, 0.0));
    let above = |(log_ns, p): &(i64, PoseStamped)| {
        tf("/tf", *log_ns, &[transform("map", "odom", p.header.stamp_ns, map_from_odom)])
    };
    let ran = replay(pose_on_tf("/tf", "odom").and(Recording(poses().iter().map(above).collect())), &[]);
    ran.like_control(ROUNDING_DB);
    assert_eq!(ran.metrics["map_frame"], "map");
    replay(pose_on_tf("/tf", "map"), &["input.base_frame=truck"]).refused(&["`map`", "`truck`", "input.base_frame"]);
}

#[test]
fn two_trees_are_ambiguous_until_one_is_named() {
    let two = || {
        let other = pose_on_tf("/robot2/tf", "map").only("/robot2/tf");
        pose_on_tf("/robot1/tf", "map").and(other).renamed(STATICS, "/robot1/tf_static")
    };
    replay(two(), &[]).refused(&["ambiguous", "/robot1/tf", "/robot2/tf", "input.pose"]);
    replay(two(), &["input.pose=/robot1/tf"]).like_control(ROUNDING_DB);
}

#[test]
fn poses_sent_once_are_never_the_vehicles() {
    let (log_ns, mut start) = poses().remove(0);
    start.header.stamp_ns = 0;
    for topic in ["/initialpose", "/goal_pose", "/move_base_simple/goal", "/some_marker"] {
        let once = Recording(vec![pose_message(topic, log_ns, &start)]);
        replay(pose_on_tf("/tf", "map").and(once.clone()), &[]).like_control(ROUNDING_DB);
        replay(Recording::control().and(once), &[]).like_control(0.0);
    }
}

#[test]
fn a_mounting_on_tf_is_looked_up_at_the_pictures_stamp() {
    let at_pictures = |m: Message| {
        let stamp_ns = decode::header(&m.data).unwrap().stamp_ns;
        vec![tf("/tf", m.log_ns, &[transform("base_link", CAMERA, stamp_ns, mount())])]
    };
    let joint = Recording::control().only(IMAGE).each(IMAGE, at_pictures);
    let ran = replay(Recording::control().without(STATICS).and(joint.clone()), &[]);
    ran.like_control(ROUNDING_DB).says(&["looked up at every picture's stamp"]);
    // The mounting and the pose in one tree.
    replay(pose_on_tf("/tf", "map").without(STATICS).and(joint), &[]).like_control(ROUNDING_DB);
    replay(Recording::control().without(STATICS), &[]).refused(&[CAMERA, "base_link", "input.base_from_camera"]);
}

#[test]
fn a_joint_that_turns_is_undone() {
    // The vehicle's frame turns about the camera's place while its joint turns back: the camera's poses stay.
    let turn = |stamp_ns: i64| {
        let sec = (stamp_ns - poses()[0].1.header.stamp_ns) as f64 * 1e-9;
        Rigid::new(DQuat::from_rotation_z(0.2 * sec), DVec3::ZERO)
    };
    let joint = |(log_ns, p): &(i64, PoseStamped)| {
        let stamp_ns = p.header.stamp_ns;
        tf("/tf", *log_ns, &[transform("base_link", "turret", stamp_ns, turn(stamp_ns).inverse())])
    };
    let turning = Recording::control().poses(|p| p.pose = p.pose * turn(p.header.stamp_ns));
    let turning = turning.statics(|list| list[0].header.frame_id = "turret".into());
    let ran = replay(turning.and(Recording(poses().iter().map(joint).collect())), &[]);
    // Interpolated poses: a turning frame's positions between two samples lie on another curve.
    ran.like_control(0.1);
}

#[test]
fn a_pose_that_is_the_cameras_own_needs_no_mounting() {
    let own = |p: &mut PoseStamped| (p.pose, p.child_frame_id) = (p.pose * mount(), CAMERA.into());
    replay(Recording::control().without(STATICS).poses(own), &[])
        .like_control(ROUNDING_DB)
        .says(&["this camera's own"]);
    let stamped = |m: Message| {
        let mut pose = decode::odometry(&m.data).unwrap();
        own(&mut pose);
        vec![pose_message("/pose", m.log_ns, &pose)]
    };
    let nameless = Recording::control().without(STATICS).each(POSE, stamped);
    replay(nameless.clone(), &[]).like_control(ROUNDING_DB).says(&["input.base_from_camera"]);
    // A vehicle's frame that is named is not guessed away.
    replay(nameless, &["input.base_frame=base_link"]).refused(&[CAMERA, "base_link", "input.base_from_camera"]);
    let on_tf = |m: Message| {
        let pose = decode::odometry(&m.data).unwrap();
        vec![tf("/tf", m.log_ns, &[transform("map", CAMERA, pose.header.stamp_ns, pose.pose * mount())])]
    };
    replay(Recording::control().without(STATICS).each(POSE, on_tf), &[]).like_control(ROUNDING_DB);
}

#[test]
fn a_recording_of_a_loop_has_a_trajectory_for_each_round() {
    const ROUND_NS: i64 = 4_000_000_000;
    let later =
        Recording(Recording::control().0.into_iter().map(|m| Message { log_ns: m.log_ns + ROUND_NS, ..m }).collect());
    let ran = replay(Recording::control().and(later), &[]);
    assert_eq!(ran.metrics["epochs"], 1, "{}", ran.stderr);
    for name in ["trajectory.tum", "trajectory_2.tum"] {
        let stamps: Vec<i64> = trajectory(&ran, name).into_iter().map(|(stamp_ns, _)| stamp_ns).collect();
        assert!(stamps.len() > 15 && stamps.is_sorted_by(|a, b| a < b), "{name}: {stamps:?}");
    }
    assert_eq!(trajectory(&ran, "trajectory.tum"), trajectory(control(), "trajectory.tum"));
    assert!(ran.metrics["recorded_sec"].as_f64().unwrap() > 1.5 * control().metrics["recorded_sec"].as_f64().unwrap());
    assert_eq!(ran.metrics["images_in"].as_u64().unwrap(), 2 * Recording::control().only(INFO).0.len() as u64);
}
