//! When things were: poses and transforms recorded late, early or dated ahead, slow poses, two clocks, empty and doubled stamps.

use storm_node::cdr::schema::MessageType;
use storm_node::cdr::{decode, encode};
use storm_node::msg::{Header, TransformStamped};
use storm_node::rigid::Rigid;

use super::recording::{IMAGE, INFO, Message, POSE, Recording, SIZE};
use super::run::{Ran, control, replay};

const MS: i64 = 1_000_000;
const SEC: i64 = 1000 * MS;

fn dropped(ran: &Ran, reason: &str) -> u64 {
    ran.metrics["dropped"][reason].as_u64().unwrap()
}

/// Poses whose number is a multiple of `n`.
fn every(n: usize, recording: Recording) -> Recording {
    let mut number = 0;
    recording.each(POSE, |m| {
        number += 1;
        if (number - 1) % n == 0 { vec![m] } else { Vec::new() }
    })
}

#[test]
fn poses_recorded_at_any_time() {
    for by_ns in [50 * MS, 1200 * MS, 30 * SEC, -30 * SEC] {
        replay(Recording::control().recorded_later(POSE, by_ns), &[]).like_control(0.0);
    }
}

#[test]
fn images_recorded_late() {
    replay(Recording::control().recorded_later(IMAGE, 3 * SEC), &[]).like_control(0.0);
}

#[test]
fn slow_poses_are_interpolated_with_a_warning_and_no_loss() {
    let poses = Recording::control().only(POSE).0.len();
    // The drive takes 2.2 s.
    let ran = replay(every(poses * 10 / 22, Recording::control()), &[]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    ran.says(&["poses come every 0.96 s", "sync.pose_gap_sec is 0.5"]);
    assert!(ran.metrics["steps"].as_u64().unwrap() >= 5, "{}", ran.metrics);
    assert!((ran.psnr() - control().psnr()).abs() < 1.5, "{} dB", ran.psnr());
}

#[test]
fn two_clocks_are_refused_with_the_distance_and_an_offset_that_helps() {
    let two = || Recording::control().poses(|p| p.header.stamp_ns -= 5000 * SEC);
    replay(two(), &[]).refused(&["5,000 s later than poses: two clocks", "input.image_time_offset_sec=[-5000]"]);
    replay(two(), &["input.image_time_offset_sec=[-5000]"]).like_control(0.0);
    replay(two(), &["input.stamps=recorded"]).like_control(0.5);
}

#[test]
fn images_all_after_the_last_pose_are_refused() {
    replay(Recording::control().poses(|p| p.header.stamp_ns -= 20 * SEC), &[])
        .refused(&["no image lies between two poses", "input.image_time_offset_sec"]);
}

#[test]
fn empty_stamps_are_refused_and_the_times_of_recording_help() {
    let empty = || Recording::control().images(IMAGE, |m| m.header.stamp_ns = 0);
    replay(empty(), &[]).refused(&[IMAGE, "22 stamps are 0 s", "input.stamps=recorded"]);
    replay(empty(), &["input.stamps=recorded"]).like_control(0.5);
    replay(Recording::control().poses(|p| p.header.stamp_ns = 0), &[]).refused(&[POSE, "stamps are 0 s"]);
}

#[test]
fn doubled_images_are_no_loss() {
    let ran = replay(Recording::control().each(IMAGE, |m| vec![m.clone(), m]), &[]);
    assert_eq!((ran.code, dropped(&ran, "duplicate")), (0, 22), "{}", ran.stderr);
    assert_eq!(ran.metrics["steps"], control().metrics["steps"]);
    assert!((ran.psnr() - control().psnr()).abs() < 1e-9);
}

#[test]
fn the_last_image_after_the_last_pose_is_no_loss() {
    // The last 0.3 of 2.2 seconds are without.
    let mut left = Recording::control().only(POSE).0.len();
    let without = left * 3 / 22;
    let cut = Recording::control().each(POSE, |m| {
        left -= 1;
        if left < without { Vec::new() } else { vec![m] }
    });
    let ran = replay(cut, &[]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    assert!(dropped(&ran, "edge") >= 1 && dropped(&ran, "no_pose") == 0, "{}", ran.metrics["dropped"]);
}

#[test]
fn images_of_another_size_than_their_camera_info_are_refused_with_both_sizes() {
    let (width, height) = SIZE;
    let ran = replay(Recording::control().infos(INFO, |k| (k.width, k.height) = (640, 480)), &[]);
    ran.refused(&[&format!("{width}x{height}"), "640x480"]);
    assert!(!ran.stderr.contains("QoS"), "{}", ran.stderr);
}

/// Poses as transforms map -> odom -> base_link, the first stamped `ahead_ns` after it was recorded.
fn on_tf(ahead_ns: i64) -> Recording {
    Recording::control().each(POSE, |m| {
        let pose = decode::odometry(&m.data).unwrap();
        let stamp_ns = pose.header.stamp_ns;
        let edge = |parent: &str, child: &str, stamp_ns, transform| TransformStamped {
            header: Header { stamp_ns, frame_id: parent.into() },
            child_frame_id: child.into(),
            transform,
        };
        let list =
            [edge("map", "odom", stamp_ns + ahead_ns, Rigid::IDENTITY), edge("odom", "base_link", stamp_ns, pose.pose)];
        let message = |t: &TransformStamped| Message {
            topic: "/tf".into(),
            kind: MessageType::TfMessage,
            log_ns: m.log_ns,
            data: encode::encode_tf_message(std::slice::from_ref(t)).unwrap(),
        };
        list.iter().map(message).collect()
    })
}

#[test]
fn transforms_dated_ahead_are_those_stamped_now() {
    let now = replay(on_tf(0), &[]);
    assert_eq!(now.code, 0, "{}", now.stderr);
    let ahead = replay(on_tf(SEC), &[]);
    ahead.says(&["map -> odom is stamped 1.0 s ahead"]);
    ahead.like(&now, 0.0);
    replay(on_tf(0).recorded_later("/tf", 1500 * MS), &[]).like(&now, 0.0);
}
