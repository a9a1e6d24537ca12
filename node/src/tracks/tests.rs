use proptest::prelude::*;

use super::*;

const MS: i64 = 1_000_000;

fn point(p: DVec3, v: DVec3) -> TrackPoint {
    let (color01, distance_m, may_start) = ([0.5; 3], 10.0, true);
    TrackPoint { position_map: p, velocity_map_mps: v, opacity: 0.9, motion_id: 3, color01, distance_m, may_start }
}

/// Points on the back of a vehicle, 0.1 m apart, sampled a little differently at each step as pixels are.
fn vehicle(center: DVec3, v: DVec3, step: i64) -> Vec<TrackPoint> {
    let jitter = |i: i64, k: i64| 0.04 * ((i * 37 + step * 91 + k * 53) as f64 * 0.7).sin();
    let place =
        |i: i64| DVec3::new(jitter(i, 0), 0.1 * (i % 18) as f64 + jitter(i, 1), 0.1 * (i / 18) as f64 + jitter(i, 2));
    (0..18 * 14).map(|i| point(center + place(i), v + DVec3::splat(jitter(i, 3)))).collect()
}

fn run(step_ms: &[i64], make: impl Fn(f64, i64) -> Vec<TrackPoint>) -> (Tracker, Vec<Track>) {
    let mut t = Tracker::new(&TracksConfig::default());
    let mut now_ms = 0;
    for (i, ms) in step_ms.iter().enumerate() {
        now_ms += ms;
        t.step(now_ms * MS, 0, &make(now_ms as f64 * 1e-3, i as i64));
    }
    let tracks = t.finish();
    (t, tracks)
}

#[test]
fn a_vehicle_is_followed_whatever_the_step() {
    let utm = DVec3::new(4.5e6, -6e5, 100.0);
    let v = DVec3::new(14.0, 3.0, 0.0);
    for steps in [vec![100; 30], vec![500; 8], vec![100, 500, 200, 300, 100, 100, 400, 500]] {
        let (t, tracks) = run(&steps, |time, i| vehicle(utm + v * time, v, i));
        // The patch is 1.8 m x 1.4 m, the spacing 0.5 m: between 6 and 24 trajectories fit.
        assert!((6..=24).contains(&t.counts().born), "{:?}", t.counts());
        let whole = tracks.iter().filter(|t| t.points.len() == steps.len()).count();
        assert!(whole >= 5, "{whole} of {} live throughout, {steps:?}", tracks.len());
        for track in &tracks {
            let (a, b) = (track.points.first().unwrap(), track.points.last().unwrap());
            let travelled = b.position_map - a.position_map;
            let true_motion = v * seconds_between(a.stamp_ns, b.stamp_ns);
            // It may slip by a sample each step, but what it is on is 2 m in size.
            assert!((travelled - true_motion).length() < 2.0);
            assert!(track.points.windows(2).all(|p| p[0].stamp_ns < p[1].stamp_ns));
        }
    }
}

#[test]
fn without_noise_a_trajectory_is_the_true_one() {
    let v = DVec3::new(0.0, -8.0, 0.0);
    let (t, tracks) = run(&[100; 10], |time, _| (0..5).map(|i| point(DVec3::X * f64::from(i) + v * time, v)).collect());
    assert_eq!((tracks.len(), t.counts().continued), (5, 45));
    for (i, track) in tracks.iter().enumerate() {
        assert_eq!((track.id, track.points.len()), (i as u32, 10));
        for p in &track.points {
            assert!((p.position_map - DVec3::X * i as f64 - v * (p.stamp_ns as f64 * 1e-9)).length() < 1e-12);
            assert_eq!(p.motion_id, 3);
        }
    }
}

#[test]
fn a_short_absence_is_bridged_and_a_long_one_is_not() {
    let v = DVec3::new(10.0, 0.0, 0.0);
    let hidden_for = |hidden: std::ops::Range<i64>| {
        run(&[100; 30], |time, i| if hidden.contains(&i) { vec![] } else { vec![point(v * time, v)] }).1
    };
    let bridged = hidden_for(10..15);
    assert_eq!(bridged.iter().map(|t| t.points.len()).collect::<Vec<_>>(), [25]);
    let apart = hidden_for(10..18);
    assert_eq!(apart.iter().map(|t| (t.id, t.points.len())).collect::<Vec<_>>(), [(0, 10), (1, 12)]);
}

#[test]
fn slow_transparent_short_and_impossible_ones_are_left_out() {
    let v = DVec3::new(5.0, 0.0, 0.0);
    let mut t = Tracker::new(&TracksConfig { max_active: 2, ..Default::default() });
    let slow = point(DVec3::Y * 10.0, v * 0.1);
    let faint = TrackPoint { opacity: 0.1, ..point(DVec3::Y * 20.0, v) };
    let bad = [
        point(DVec3::NAN, v),
        point(DVec3::ZERO, v * f64::INFINITY),
        point(DVec3::ZERO, v * 1e3),
        TrackPoint { opacity: f32::NAN, ..point(DVec3::ZERO, v) },
    ];
    let mut points = vec![slow, faint];
    points.extend(bad);
    t.step(0, 0, &points);
    assert_eq!((t.live().len(), t.counts().rejected), (0, 4));
    let row: Vec<_> = (0..5).map(|i| point(DVec3::Y * f64::from(i), v)).collect();
    t.step(100 * MS, 0, &row);
    assert_eq!((t.live().len(), t.counts().no_room), (2, 3));
    t.step(100 * MS, 0, &row);
    assert_eq!(t.counts().out_of_order, 1);
    t.step(0, 1, &[]);
    assert_eq!((t.live().len(), t.counts().too_short, t.drain().len()), (0, 2, 0));
}

#[test]
fn crossing_vehicles_keep_their_trajectories() {
    let (a, b) = (DVec3::new(10.0, 0.0, 0.0), DVec3::new(-10.0, 0.0, 0.0));
    // They pass each other 0.6 m apart sideways.
    let make = |time: f64, _| vec![point(a * time, a), point(DVec3::new(10.0, 0.6, 0.0) + b * time, b)];
    let (_, tracks) = run(&[100; 20], make);
    assert_eq!(tracks.len(), 2);
    for track in tracks {
        let signs: Vec<_> = track.points.iter().map(|p| p.velocity_map_mps.x > 0.0).collect();
        assert!(signs.len() == 20 && signs.iter().all(|s| *s == signs[0]));
    }
}

#[test]
fn a_point_of_another_colour_is_another_point() {
    let v = DVec3::new(5.0, 0.0, 0.0);
    let paint = |step: i64| if step < 5 { [0.9, 0.1, 0.1] } else { [0.1, 0.1, 0.9] };
    let (t, tracks) = run(&[100; 20], |time, i| vec![TrackPoint { color01: paint(i), ..point(v * time, v) }]);
    assert_eq!(tracks.iter().map(|t| t.points.len()).collect::<Vec<_>>()[0], 5);
    assert!(t.counts().unlike > 0 && tracks.len() == 2, "{tracks:?}");
    // Light that changes slowly is no other colour.
    let (_, tracks) =
        run(&[100; 20], |time, i| vec![TrackPoint { color01: [0.04 * i as f32; 3], ..point(v * time, v) }]);
    assert_eq!(tracks.iter().map(|t| t.points.len()).collect::<Vec<_>>(), [20]);
}

#[test]
fn where_the_map_stands_nothing_starts() {
    let v = DVec3::new(5.0, 0.0, 0.0);
    let (t, _) = run(&[100; 5], |time, _| vec![TrackPoint { may_start: false, ..point(v * time, v) }]);
    assert_eq!(t.counts().born, 0);
}

#[test]
fn places_between_steps_follow_the_curve() {
    // Braking: x = 10 t - t^2, exactly a Hermite cubic's own.
    let x = |t: f64| DVec3::X * (10.0 * t - t * t);
    let v = |t: f64| DVec3::X * (10.0 - 2.0 * t);
    let (_, tracks) = run(&[500; 6], |time, _| vec![point(x(time), v(time))]);
    let track = &tracks[0];
    for ms in [500, 601, 999, 1000, 2749, 3000] {
        let t = ms as f64 * 1e-3;
        let (position, velocity) = track.at(ms * MS).unwrap();
        assert!((position - x(t)).length() < 1e-9 && (velocity - v(t)).length() < 1e-9, "{ms}: {position} {velocity}");
    }
    assert!(track.at(499 * MS).is_none() && track.at(3001 * MS).is_none());
}

#[test]
fn uncertain_speeds_get_a_wider_gate() {
    // A pedestrian whose speed is off by 3 m/s from step to step: half a metre would lose it at half-second steps.
    let off = |i: i64| DVec3::new(0.0, if i % 2 == 0 { 1.5 } else { -1.5 }, 0.0);
    let v = DVec3::new(1.5, 0.0, 0.0);
    let (_, tracks) = run(&[500; 12], |time, i| vec![point(v * time, v + off(i))]);
    assert_eq!(tracks.iter().map(|t| t.points.len()).collect::<Vec<_>>(), [12]);
}

#[test]
fn a_lead_vehicle_that_never_leaves_takes_no_more_memory() {
    let v = DVec3::new(10.0, 0.0, 0.0);
    let mut t = Tracker::new(&TracksConfig::default());
    let mut rows = Vec::new();
    for step in 0..5000i64 {
        let time = step as f64 * 0.1;
        t.step(step * 100 * MS, 0, &[point(v * time, v)]);
        assert!(t.bytes() < 100_000 && t.live()[0].born_ns() == 0);
        let pieces = t.drain();
        assert!(pieces.iter().all(|p| p.points.len() >= live::PIECE_POINTS));
        rows.extend(pieces.into_iter().flat_map(|t| t.points.into_iter().map(move |p| (t.id, p.stamp_ns))));
    }
    rows.extend(t.finish().into_iter().flat_map(|t| t.points.into_iter().map(move |p| (t.id, p.stamp_ns))));
    assert_eq!((rows.len(), t.counts().finished), (5000, 1));
    assert!(rows.windows(2).all(|r| r[0].0 == r[1].0 && r[0].1 < r[1].1), "each point once, in order");
}

/// A measurement, not a check: `cargo test --release -p storm-node --lib tracks::tests::rate -- --ignored --nocapture`.
#[test]
#[ignore = "timing"]
fn rate() {
    let v = DVec3::new(10.0, 0.0, 0.0);
    let config = TracksConfig { spacing_m: 0.08, max_active: 20_000, ..Default::default() };
    let mut t = Tracker::new(&config);
    let (mut wall, mut cpu) = (Vec::new(), Vec::new());
    for step in 0..310 {
        let points: Vec<_> = (0..80)
            .flat_map(|c| vehicle(DVec3::new(0.0, 4.0 * f64::from(c), 0.0) + v * 0.1 * step as f64, v, step))
            .collect();
        let (start, cpu_start) = (std::time::Instant::now(), crate::pipeline::timing::cpu_ms().unwrap_or(0.0));
        t.step(step * 100 * MS, 0, &points);
        let _ended = t.drain();
        if step >= 10 {
            wall.push(start.elapsed().as_secs_f64() * 1e3);
            cpu.push(crate::pipeline::timing::cpu_ms().unwrap_or(0.0) - cpu_start);
        }
    }
    wall.sort_by(f64::total_cmp);
    cpu.sort_by(f64::total_cmp);
    let n = wall.len();
    println!(
        "20,160 points, {} live, {} threads: wall p50 {:.1}, p99 {:.1}, worst {:.1} ms; CPU p50 {:.1}, p99 {:.1} ms",
        t.live().len(),
        rayon::current_num_threads(),
        wall[n / 2],
        wall[n - 1 - n / 100],
        wall[n - 1],
        cpu[n / 2],
        cpu[n - 1 - n / 100]
    );
}

fn wild_point() -> impl Strategy<Value = (f64, f64, f64, f32)> {
    (-3.0f64..3.0, -3.0f64..3.0, -12.0f64..12.0, 0.0f32..1.0)
}

proptest! {
    /// Whatever is thrown at it: ids are unique and rise, stamps rise, numbers are finite, trajectories are accounted
    /// for, and a second run gives the same.
    #[test]
    fn trajectories_are_well_formed_and_repeatable(
        steps in proptest::collection::vec(
            (0i64..400, 0u8..20, proptest::collection::vec(wild_point(), 0..60)), 1..15),
    ) {
        let all = || {
            let mut t = Tracker::new(&TracksConfig { max_active: 30, ..Default::default() });
            let (mut now_ms, mut epoch, mut tracks) = (0, 0, Vec::new());
            for (ms, jump, points) in &steps {
                now_ms += ms;
                epoch += u32::from(*jump == 0);
                let points: Vec<_> = points
                    .iter()
                    .map(|&(x, y, v, o)| TrackPoint { opacity: o, ..point(DVec3::new(x, y, 0.0), DVec3::X * v) })
                    .collect();
                t.step(now_ms * MS, epoch, &points);
                assert!(t.live().len() <= 30);
                tracks.extend(t.drain());
            }
            tracks.extend(t.finish());
            (tracks, t.counts())
        };
        let (tracks, counts) = all();
        prop_assert_eq!(&all().0, &tracks);
        prop_assert_eq!(counts.born, counts.finished + counts.too_short);
        prop_assert_eq!(counts.finished, tracks.len() as u64);
        let mut ids: Vec<_> = tracks.iter().map(|t| t.id).collect();
        ids.sort_unstable();
        prop_assert!(ids.windows(2).all(|p| p[0] < p[1]));
        for t in &tracks {
            prop_assert!(t.points.len() >= 3 && t.points.windows(2).all(|p| p[0].stamp_ns < p[1].stamp_ns));
            for p in t.points.windows(2) {
                let dt_sec = seconds_between(p[0].stamp_ns, p[1].stamp_ns);
                let predicted = p[0].position_map + p[0].velocity_map_mps * dt_sec;
                prop_assert!(predicted.distance(p[1].position_map) <= 2.0 + 1e-3);
            }
        }
    }
}
