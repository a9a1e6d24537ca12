use glam::{DQuat, DVec3, Quat, Vec3};

use super::*;

const MS: i64 = 1_000_000;

fn point(position_map: DVec3, velocity_map_mps: DVec3, motion_id: u16) -> ObjectPoint {
    let (opacity, color01, rotation, scale) = (0.9, [0.2, 0.4, 0.6], Quat::IDENTITY, Vec3::splat(0.05));
    ObjectPoint { position_map, velocity_map_mps, motion_id, opacity, color01, rotation, scale, distance_m: 15.0 }
}

/// The side (or, seen from behind, the rear) of a car 4.4 m x 1.8 m x 1.4 m, sampled a little differently at each step.
fn car(center: DVec3, yaw: f64, speed: f64, side: bool, step: i64) -> Vec<ObjectPoint> {
    let turn = DQuat::from_rotation_z(yaw);
    let v = turn * DVec3::X * speed;
    let jitter = |i: i64, k: i64| 0.03 * ((i * 37 + step * 91 + k * 53) as f64 * 0.7).sin();
    let place = |i: i64| {
        let (a, z) = ((i % 23) as f64 / 22.0 - 0.5, (i / 23) as f64 * 0.2 - 0.7);
        if side { DVec3::new(4.4 * a, 0.9, z) } else { DVec3::new(-2.2, 1.8 * a, z) }
    };
    (0..23 * 8)
        .map(|i| {
            let p = center + turn * (place(i) + DVec3::new(jitter(i, 0), jitter(i, 1), jitter(i, 2)));
            point(p, v + DVec3::splat(5.0 * jitter(i, 3)), 3)
        })
        .collect()
}

fn run(steps: i64, make: impl Fn(f64, i64) -> Vec<ObjectPoint>) -> (ObjectTracker, Vec<Vec<Option<u32>>>) {
    let mut t = ObjectTracker::new(&ObjectsConfig::default());
    let owners = (0..steps).map(|i| t.step(i * 100 * MS, 0, &make(0.1 * i as f64, i))).collect();
    (t, owners)
}

#[test]
fn two_cars_side_by_side_are_two_objects_with_their_velocities() {
    let utm = DVec3::new(4.5e6, -6e5, 100.0);
    let make = |time: f64, i: i64| {
        let ahead = |v: f64| utm + DVec3::X * v * time;
        let mut all = car(ahead(12.0), 0.0, 12.0, true, i);
        all.extend(car(ahead(9.0) + DVec3::new(0.0, 3.0, 0.0), 0.0, 9.0, true, i));
        all
    };
    let (t, owners) = run(30, make);
    assert_eq!((t.counts().born, t.live().len()), (2, 2), "{:?}", t.counts());
    for (object, speed) in t.live().iter().zip([12.0, 9.0]) {
        assert!((object.velocity_mps() - DVec3::X * speed).length() < 0.1, "{}", object.velocity_mps());
        assert!(object.confirmed(&ObjectsConfig::default()) && (object.age_sec() - 2.9).abs() < 1e-9);
        let size = object.size_m();
        assert!((size.x - 4.4).abs() < 0.4 && size.y < 0.8 && (size.z - 1.4).abs() < 0.3, "{size}");
        let c = object.velocity_covariance();
        assert!(c.x_axis.x > 0.0 && c.x_axis.x < 0.1 && (c.x_axis.y - c.y_axis.x).abs() < 1e-12);
    }
    for step in owners {
        assert!(step.iter().enumerate().all(|(i, o)| *o == Some(u32::from(i >= 184))));
    }
}

#[test]
fn seen_from_several_sides_it_becomes_complete() {
    let v = 8.0;
    // First the side is seen, then the rear.
    let make = |time: f64, i: i64| car(DVec3::X * v * time, 0.0, v, i < 20, i);
    let (t, _) = run(40, make);
    assert_eq!(t.counts().born, 1, "{:?}", t.counts());
    let size = t.live()[0].size_m();
    assert!((size.x - 4.4).abs() < 1.2 && (size.y - 1.8).abs() < 0.9, "{size}");
    assert!(t.live()[0].model().len() > 184);
    assert_eq!(t.live()[0].model().cloud().len(), t.live()[0].model().len());
}

#[test]
fn a_turning_car_keeps_its_identity_and_its_poses_can_be_asked_for() {
    let (radius, rate) = (15.0, 0.5);
    let at = |time: f64| DVec3::new((rate * time).sin(), 1.0 - (rate * time).cos(), 0.0) * radius;
    let make = |time: f64, i: i64| car(at(time), rate * time, radius * rate, true, i);
    let (t, _) = run(50, make);
    assert_eq!((t.counts().born, t.live().len()), (1, 1));
    let object = &t.live()[0];
    for ms in [0i64, 1250, 3333, 4900] {
        let pose = object.pose_at(ms * MS, 0.0).unwrap();
        // The frame is where the seen part's centre was at first, on the side.
        assert!((pose.translation - at(ms as f64 * 1e-3)).length() < 1.6, "{ms}: {}", pose.translation);
        let yaw = 2.0 * pose.rotation.z.atan2(pose.rotation.w);
        assert!((yaw - rate * ms as f64 * 1e-3).abs() < 0.1, "{ms}: {yaw}");
    }
    assert!(object.pose_at(-MS, 1.0).is_none() && object.pose_at(5500 * MS, 0.5).is_none());
    assert!(object.pose_at(5200 * MS, 0.5).is_some());
}

#[test]
fn short_absence_is_bridged_and_long_ends_it() {
    let make = |time: f64, i: i64| {
        if (10..16).contains(&i) { vec![] } else { car(DVec3::X * 10.0 * time, 0.0, 10.0, true, i) }
    };
    assert_eq!(run(30, make).0.counts().born, 1);
    let make = |time: f64, i: i64| {
        if (10..25).contains(&i) { vec![] } else { car(DVec3::X * 10.0 * time, 0.0, 10.0, true, i) }
    };
    let (mut t, _) = run(40, make);
    assert_eq!((t.counts().born, t.counts().ended), (2, 1));
    assert_eq!(t.finish().iter().map(|o| o.id).collect::<Vec<_>>(), [0, 1]);
}

#[test]
fn nonsense_is_refused_and_counted() {
    let mut t = ObjectTracker::new(&ObjectsConfig::default());
    let good = car(DVec3::ZERO, 0.0, 10.0, true, 0);
    let mut bad = good.clone();
    bad[0].position_map.x = f64::NAN;
    bad[1].velocity_map_mps.y = 1e6;
    bad[2].scale.z = f32::INFINITY;
    t.step(0, 0, &bad);
    assert_eq!((t.counts().rejected, t.live().len()), (3, 1));
    t.step(0, 0, &good);
    assert_eq!(t.counts().out_of_order, 1);
    t.step(-5, 1, &[]);
    assert_eq!((t.live().len(), t.counts().unconfirmed), (0, 1));
    let few = ObjectTracker::new(&ObjectsConfig::default()).step(0, 0, &good[..4]);
    assert!(few.iter().all(Option::is_none));
}

#[test]
fn braking_shows_as_change_between_windows() {
    // 15 m/s, and from a second on brakes by 4 m/s^2.
    let speed = |t: f64| 15.0 - 4.0 * (t - 1.0).max(0.0);
    let way = |t: f64| 15.0 * t - 2.0 * (t - 1.0).max(0.0).powi(2);
    let (t, _) = run(31, |time, i| car(DVec3::X * way(time), 0.0, speed(time), true, i));
    let object = &t.live()[0];
    let braking = object.acceleration_mps2().unwrap();
    assert!((braking - DVec3::new(-4.0, 0.0, 0.0)).length() < 0.5, "{braking}");
    // The tenth of its states is before braking, the second too early to say.
    assert!(object.acceleration_at(9).unwrap().length() < 0.5);
    assert!(object.acceleration_at(1).is_none());
}
