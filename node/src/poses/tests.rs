use glam::{DQuat, DVec3};
use proptest::prelude::*;

use super::*;
use crate::sync::{DropReason, FrameSet};

const SEC: i64 = 1_000_000_000;
const MS: i64 = 1_000_000;

fn buffer() -> PoseBuffer {
    PoseBuffer::new(&SyncConfig::default())
}

fn pose(x: f64, yaw: f64) -> Rigid {
    Rigid::new(DQuat::from_rotation_z(yaw), DVec3::new(x, 0.0, 0.0))
}

#[test]
fn poses_are_interpolated_and_never_extrapolated() {
    let mut b = buffer();
    assert_eq!(b.lookup(0), PoseLookup::Wait);
    for (ms, x, yaw) in [(1000, 1.0, 0.0), (1200, 3.0, 0.4), (2000, 5.0, 0.4)] {
        assert_eq!(b.push(ms * MS, pose(x, yaw)), Ok(PoseNote::Taken));
    }
    let PoseLookup::At(t) = b.lookup(1050 * MS) else { panic!() };
    assert!((t.translation.x - 1.5).abs() < 1e-12 && t.rotation.angle_between(DQuat::from_rotation_z(0.1)) < 1e-7);
    assert_eq!(b.lookup(1200 * MS), PoseLookup::At(pose(3.0, 0.4).normalized().unwrap()));
    assert_eq!(b.lookup(999 * MS), PoseLookup::Never(PoseMissing::BeforeFirst { first_ns: SEC }));
    assert_eq!(b.lookup(2001 * MS), PoseLookup::Wait);
    assert!(
        matches!(b.lookup(1600 * MS), PoseLookup::Never(PoseMissing::GapTooWide { gap_sec }) if (gap_sec - 0.8).abs() < 1e-9)
    );
    // A pose that comes late closes the gap.
    assert_eq!(b.push(1600 * MS, pose(4.0, 0.4)), Ok(PoseNote::Taken));
    assert!(matches!(b.lookup(1500 * MS), PoseLookup::At(_)));
}

#[test]
fn bad_poses_are_refused_or_put_right() {
    let mut b = buffer();
    let with = |q: [f64; 4], p: [f64; 3]| Rigid::new(DQuat::from_array(q), p.into());
    let unit = [0.0, 0.0, 0.0, 1.0];
    assert_eq!(b.push(0, with(unit, [f64::NAN, 0.0, 0.0])), Err(PoseReject::NonFinite));
    assert_eq!(b.push(0, with([0.0, f64::INFINITY, 0.0, 1.0], [0.0; 3])), Err(PoseReject::NonFinite));
    assert_eq!(b.push(0, with([0.0; 4], [0.0; 3])), Err(PoseReject::NotUnit { length: 0.0 }));
    assert!(matches!(b.push(0, with([0.0, 0.0, 0.0, 1e200], [0.0; 3])), Err(PoseReject::NotUnit { .. })));
    assert!(matches!(b.push(0, with(unit, [1e300, 0.0, 0.0])), Err(PoseReject::TooFar { .. })));
    assert!(b.is_empty());
    assert_eq!(b.push(0, with([0.0, 0.0, 0.0, 1.0001], [0.0; 3])), Ok(PoseNote::Taken));
    assert_eq!(b.push(1, with([0.0, 0.0, 0.0, 1.02], [0.0; 3])), Ok(PoseNote::Renormalized));
    assert_eq!(b.push(1, with(unit, [1.0, 0.0, 0.0])), Ok(PoseNote::Duplicate));
    assert_eq!(b.lookup(1), PoseLookup::At(Rigid::IDENTITY));
    let counts =
        PoseCounts { taken: 2, renormalized: 1, duplicate: 1, non_finite: 2, not_rigid: 3, ..Default::default() };
    assert_eq!(b.counts(), counts);
}

#[test]
fn a_clock_jump_forgets_older_poses_and_one_stray_stamp_does_not() {
    let mut b = buffer();
    for i in 0..10 {
        b.push(100 * SEC + i * 10 * MS, pose(i as f64, 0.0)).unwrap();
    }
    assert_eq!(b.push(0, pose(0.0, 0.0)), Ok(PoseNote::Held));
    assert_eq!(b.push(100 * SEC + 100 * MS, pose(0.0, 0.0)), Ok(PoseNote::Taken));
    assert_eq!(b.len(), 11);
    assert_eq!(b.push(50 * SEC, pose(7.0, 0.0)), Ok(PoseNote::Held));
    assert_eq!(b.push(50 * SEC + 10 * MS, pose(8.0, 0.0)), Ok(PoseNote::ClockJump));
    assert_eq!((b.len(), b.latest_ns(), b.counts().taken), (2, Some(50 * SEC + 10 * MS), 13));
    b.follow_clock(50 * SEC + 30 * MS);
    assert_eq!(b.len(), 2);
    b.follow_clock(5 * SEC);
    assert!(b.is_empty());
}

#[test]
fn memory_is_bounded_and_the_newest_are_kept() {
    let mut t = Timeline::new(4, 0.5, 1.0, 10.0);
    for i in 0..10 {
        t.push(i * 100 * MS, pose(i as f64, 0.0)).unwrap();
    }
    assert_eq!(t.len(), 4);
    assert_eq!(t.push(550 * MS, pose(0.0, 0.0)), Err(PoseReject::TooOld));
    assert_eq!(t.push(850 * MS, pose(8.5, 0.0)), Ok(PoseNote::Taken));
    assert_eq!(t.lookup(650 * MS), PoseLookup::Never(PoseMissing::BeforeFirst { first_ns: 700 * MS }));
}

#[test]
fn slow_poses_are_interpolated_up_to_a_bound() {
    for (interval_ms, interpolated) in [(1000, true), (1900, true), (2100, false)] {
        let mut b = buffer();
        for i in 0..4 {
            b.push(i * interval_ms * MS, pose(i as f64, 0.0)).unwrap();
        }
        let at = matches!(b.lookup(interval_ms * MS * 3 / 2), PoseLookup::At(_));
        assert_eq!(at, interpolated, "poses every {interval_ms} ms");
    }
    // Poses that come fast and are missing for a second are not slow.
    let mut b = buffer();
    for i in (0..20).filter(|i| !(5..15).contains(i)) {
        b.push(i * 100 * MS, pose(i as f64, 0.0)).unwrap();
    }
    assert!(matches!(b.lookup(1000 * MS), PoseLookup::Never(PoseMissing::GapTooWide { .. })));
    assert_eq!(b.timing().interval_sec, Some(0.1));
}

#[test]
fn a_set_waits_as_long_as_one_slow_pose_takes_and_the_last_one_is_no_loss() {
    let mut gate = PoseGate::new(&SyncConfig::default());
    let mut b = buffer();
    let set = |ms: i64| FrameSet { stamp_ns: ms * MS, epoch: 0, frames: vec![(ms * MS, ())] };
    for i in 0..3 {
        b.push(i * SEC, pose(i as f64, 0.0)).unwrap();
    }
    gate.push(set(2200));
    gate.follow(b.timing());
    assert!(gate.poll(2900 * MS, |_, s| b.lookup(s)).is_none());
    assert_eq!(gate.pending(), 1, "longer than sync.pose_wait_sec, but poses come every second");
    gate.flush();
    assert_eq!((gate.drops().get(DropReason::Edge), gate.drops().lost()), (1, 0));
    gate.push(set(3500));
    gate.flush();
    assert_eq!((gate.drops().get(DropReason::NoPose), gate.dropped_ns(DropReason::NoPose)), (1, Some(3500 * MS)));
}

#[test]
fn sets_wait_for_poses_but_not_for_ever() {
    let mut gate = PoseGate::new(&SyncConfig::default());
    let mut b = buffer();
    let set = |ms: i64, epoch| FrameSet { stamp_ns: ms * MS, epoch, frames: vec![(ms * MS, 'a'), (ms * MS + MS, 'b')] };
    gate.push(set(-500, 0));
    gate.push(set(50, 0));
    gate.push(set(150, 0));
    gate.push(set(250, 0));
    for i in 1..=2 {
        b.push(i * 100 * MS, pose(i as f64, 0.0)).unwrap();
    }
    let posed = gate.poll(200 * MS, |_, s| b.lookup(s)).unwrap();
    assert_eq!(posed.stamp_ns, 150 * MS);
    assert!((posed.frames[1].map_from_camera.translation.x - 1.51).abs() < 1e-9);
    assert_eq!(
        (gate.drops().get(DropReason::NoPose), gate.drops().get(DropReason::Edge), gate.pending()),
        (2, 2, 2),
        "the first two sets are older than every pose, the second by less than a pose gap"
    );
    assert!(gate.poll(251 * MS + 500 * MS, |_, s| b.lookup(s)).is_none());
    assert_eq!(gate.pending(), 2);
    assert!(gate.poll(252 * MS + 500 * MS, |_, s| b.lookup(s)).is_none());
    assert_eq!((gate.pending(), gate.drops().get(DropReason::NoPose)), (0, 4));
    // After a jump the sets of the old time do not hold up the new ones.
    gate.push(set(900, 0));
    gate.push(set(150, 1));
    assert_eq!(gate.poll(200 * MS, |_, s| b.lookup(s)).map(|s| s.epoch), Some(1));
    assert_eq!(gate.drops().get(DropReason::ClockJump), 2);
    gate.push(set(900, 1));
    gate.flush();
    assert_eq!((gate.pending(), gate.drops().total()), (0, 10));
}

proptest! {
    /// Any order of arrival gives the same poses, and between two poses all is smooth and unit length, at UTM-sized
    /// places too.
    #[test]
    fn order_of_arrival_does_not_matter(
        mut order in Just((0..20i64).collect::<Vec<_>>()).prop_shuffle(),
        start_ns in 0i64..(1 << 62), at in 0.0f64..1.0, yaw in -3.0f64..3.0,
    ) {
        let make = |order: &[i64]| {
            let mut b = buffer();
            for &i in order {
                let utm = DVec3::new(4e6 + i as f64, -5e5, 30.0);
                // Both signs of a quaternion are the same rotation.
                let q = DQuat::from_rotation_z(yaw * i as f64) * if i % 2 == 0 { 1.0 } else { -1.0 };
                prop_assert!(b.push(start_ns + i * 40 * MS, Rigid::new(q, utm)).is_ok());
            }
            Ok(b)
        };
        let shuffled = make(&order)?;
        order.sort();
        let sorted = make(&order)?;
        let stamp_ns = start_ns + (at * 760.0 * 1e6) as i64;
        prop_assert_eq!(shuffled.lookup(stamp_ns), sorted.lookup(stamp_ns));
        let PoseLookup::At(t) = sorted.lookup(stamp_ns) else { return Err(TestCaseError::fail("no pose")) };
        prop_assert!((t.rotation.length() - 1.0).abs() < 1e-12);
        let expected = 4e6 + (stamp_ns - start_ns) as f64 / (40.0 * MS as f64);
        prop_assert!((t.translation.x - expected).abs() < 1e-8);
    }
}
