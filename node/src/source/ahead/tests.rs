use glam::{DQuat, DVec3};

use super::*;
use crate::bag::Bag;
use crate::cdr::{decode as cdr, encode, schema::MessageType};
use crate::msg::{Header, PoseStamped};
use crate::output::bag_writer::BagWriter;
use crate::output::qos::Qos;
use crate::poses::PoseBuffer;
use crate::rigid::Rigid;

const MS: i64 = 1_000_000;
const SEC: i64 = 1000 * MS;

/// A bag of poses, each with its stamp and the time it was recorded.
fn bag(poses: impl IntoIterator<Item = (i64, i64)>) -> (tempfile::TempDir, Bag) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("poses.mcap");
    let mut writer = BagWriter::create(&path).unwrap();
    let topic = writer.topic("/odometry", MessageType::Odometry, Qos::Reliable).unwrap();
    for (stamp_ns, log_ns) in poses {
        let header = Header { stamp_ns, frame_id: "map".into() };
        let pose = Rigid::new(DQuat::IDENTITY, DVec3::new(stamp_ns as f64 * 1e-9, 0.0, 0.0));
        let message = PoseStamped { header, child_frame_id: "base_link".into(), pose };
        writer.write(topic, log_ns, &encode::encode_odometry(&message).unwrap()).unwrap();
    }
    writer.finish().unwrap();
    let bag = Bag::open(&path).unwrap();
    (dir, bag)
}

/// The stamps handed on before each image (stamp, time of recording), and after the last.
fn handed_on(bag: &Bag, images: &[(i64, i64)]) -> Vec<Vec<i64>> {
    let config = SyncConfig::default();
    let to_events = |message: &RawMessage| {
        let pose = cdr::pose("nav_msgs/msg/Odometry", &message.data).unwrap();
        vec![Event::Pose { stamp_ns: pose.header.stamp_ns, map_from_base: pose.pose }]
    };
    let store = PoseStore::Buffer(PoseBuffer::new(&config));
    let mut ahead = PoseAhead::new(bag.messages(&[0]).unwrap(), to_events, store, BTreeMap::new(), &config);
    let mut all = Vec::new();
    for &(stamp_ns, log_ns) in images {
        let mut now = Vec::new();
        assert!(ahead.before_image(stamp_ns, log_ns, &mut |_, event| {
            now.extend(stamped(&event).map(|(_, ns)| ns));
            true
        }));
        all.push(now);
    }
    let mut rest = Vec::new();
    assert!(ahead.rest(&mut |_, event| {
        rest.extend(stamped(&event).map(|(_, ns)| ns));
        true
    }));
    all.push(rest);
    all
}

#[test]
fn poses_recorded_late_come_before_their_images() {
    let (_dir, bag) = bag((0..100).map(|i| (i * 100 * MS, i * 100 * MS + 5 * SEC)));
    let images: Vec<(i64, i64)> = (0..90).map(|i| (i * 100 * MS + 50 * MS, i * 100 * MS + 50 * MS)).collect();
    let handed = handed_on(&bag, &images);
    let mut newest_ns = i64::MIN;
    for ((stamp_ns, _), now) in images.iter().zip(&handed) {
        newest_ns = now.iter().copied().fold(newest_ns, i64::max);
        assert!(newest_ns >= *stamp_ns, "image at {stamp_ns}");
    }
    assert_eq!(handed.iter().flatten().count(), 100, "every pose once");
}

#[test]
fn poses_recorded_long_before_are_not_all_held() {
    let (_dir, bag) = bag((0..10_000).map(|i| (i * 100 * MS, i)));
    let handed = handed_on(&bag, &[(50 * MS, SEC), (500 * SEC, 501 * SEC)]);
    assert!(handed[0].len() < 150, "{} poses for the first image", handed[0].len());
    assert!(handed[1].last().is_some_and(|ns| (500 * SEC..511 * SEC).contains(ns)));
}

#[test]
fn reading_ahead_stops_where_the_stamps_jump_and_one_wrong_stamp_does_not_stop_it() {
    // The recording loops after 3 s: no pose covers an image at 5 s before the images have got there.
    let looped = |i: i64| (i % 30 * 100 * MS, i * 100 * MS);
    let (_dir, looping) = bag((0..60).map(looped));
    let handed = handed_on(&looping, &[(2950 * MS, 2950 * MS), (50 * MS, 3050 * MS)]);
    assert_eq!((handed[0].len(), handed[0].last()), (30, Some(&(2900 * MS))));
    assert!(handed[1].starts_with(&[0]), "{:?}", handed[1]);
    let stray = |i: i64| (if i == 10 { 1 << 60 } else { i * 100 * MS }, i * 100 * MS + 3 * SEC);
    let (_dir, straying) = bag((0..60).map(stray));
    let handed = handed_on(&straying, &[(2050 * MS, 2050 * MS)]);
    assert!(handed[0].contains(&(2100 * MS)), "{:?}", handed[0]);
}

#[test]
fn reading_ahead_is_bounded() {
    // Poses of another clock never cover the image.
    let (_dir, bag) = bag((0..20_000).map(|i| (i * MS, 100 * SEC + i * MS)));
    let handed = handed_on(&bag, &[(1000 * SEC, 0)]);
    assert_eq!(handed[0].len(), MOST_AHEAD);
}
