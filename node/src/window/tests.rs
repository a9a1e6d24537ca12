use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;

use super::*;
use crate::config::WindowConfig;

const SEC: i64 = 1_000_000_000;
const MS: i64 = 1_000_000;

fn set(stamp_ns: i64, epoch: u32, place: DVec3) -> PosedSet<i64> {
    let map_from_camera = Rigid::new(DQuat::from_rotation_z(0.3), place);
    PosedSet { stamp_ns, epoch, frames: vec![PosedFrame { stamp_ns, map_from_camera, item: stamp_ns }] }
}

fn plain(stamp_ns: i64) -> PosedSet<i64> {
    set(stamp_ns, 0, DVec3::ZERO)
}

fn stamps(w: &Window<i64>) -> Vec<i64> {
    w.steps.iter().map(|s| s.stamp_ns).collect()
}

#[test]
fn optical_axes_become_forward_left_up_exactly() {
    let flu_from_camera = camera_from_flu().inverse().matrix3();
    assert_eq!(flu_from_camera.transpose(), DMat3::from_cols_array(&[0., 0., 1., -1., 0., 0., 0., -1., 0.]));
    let [right, down, forward] = [DVec3::X, DVec3::Y, DVec3::Z].map(|v| flu_from_camera * v);
    assert_eq!((right, down, forward), (-DVec3::Y, -DVec3::Z, DVec3::X));
}

#[test]
fn at_10_hz_windows_interleave_and_nothing_is_wasted() {
    // The rate of the recorded stereo drive: 51 sets, 0.1036 s apart.
    let mut b = WindowBuilder::new(&WindowConfig::default(), 0);
    let windows: Vec<_> = (0..51).filter_map(|i| b.push(plain(1000 * SEC + i * 103_600_000))).collect();
    assert_eq!((windows.len(), b.counts().filling, b.counts().gap), (37, 14, 0));
    let index = |w: &Window<i64>| stamps(w).iter().map(|s| (s - 1000 * SEC) / 103_600_000).collect::<Vec<_>>();
    assert_eq!(index(&windows[0]), [0, 4, 9, 14]);
    assert_eq!(index(&windows[36]), [36, 40, 45, 50]);
    assert!((windows[0].time_sec[3][0] - 1.4504).abs() < 1e-9 && windows[0].time_sec[0][0] == 0.0);
    assert!(b.history() <= 16, "{}", b.history());
}

#[test]
fn hop_skips_sets_but_keeps_them_for_later_windows() {
    let config = WindowConfig { hop_sec: 0.5, ..Default::default() };
    let mut b = WindowBuilder::new(&config, 0);
    let windows: Vec<_> = (0..51).filter_map(|i| b.push(plain(i * 100 * MS + (i % 2) * MS))).collect();
    assert_eq!(windows.iter().map(|w| w.stamp_ns / (100 * MS)).collect::<Vec<_>>(), [15, 20, 25, 30, 35, 40, 45, 50]);
    assert!(
        windows.iter().all(|w| w.time_sec.iter().zip([0.0, 0.5, 1.0, 1.5]).all(|(t, at)| (t[0] - at).abs() < 2e-3))
    );
    assert_eq!(b.counts().hop, 28);
}

#[test]
fn one_timestep_is_a_window_at_every_set() {
    let mut b = WindowBuilder::new(&WindowConfig { timesteps: 1, ..Default::default() }, 0);
    for i in 0..5 {
        let w = b.push(plain(i * 700 * MS)).unwrap();
        assert_eq!((w.steps.len(), b.history()), (1, 1));
    }
}

#[test]
fn a_gap_costs_the_windows_that_need_it_only() {
    let mut b = WindowBuilder::new(&WindowConfig::default(), 0);
    let windows = (0..100).filter(|i| !(40..44).contains(i)).filter_map(|i| b.push(plain(i * 100 * MS))).count();
    // Without sets 40 to 43 the places at 41.5 +- 0.25 have none: each of the three older timesteps meets it once or
    // twice.
    assert_eq!((b.counts().filling, windows + b.counts().gap as usize), (15, 81));
    assert!((3..=6).contains(&b.counts().gap), "{:?}", b.counts());
}

#[test]
fn a_new_epoch_starts_anew_and_old_or_odd_sets_are_refused() {
    let mut b = WindowBuilder::new(&WindowConfig::default(), 0);
    for i in 0..20 {
        b.push(set(i * 100 * MS, 3, DVec3::ZERO));
    }
    assert!(b.push(set(0, 4, DVec3::ZERO)).is_none());
    assert_eq!((b.history(), b.counts().filling), (1, 15 + 1));
    assert!(b.push(set(2100 * MS, 3, DVec3::ZERO)).is_none());
    assert!(b.push(set(0, 4, DVec3::ZERO)).is_none());
    assert_eq!(b.counts().out_of_order, 2);
    assert!(b.push(PosedSet { stamp_ns: SEC, epoch: 4, frames: vec![] }).is_none());
    assert!(b.push(set(SEC, 4, DVec3::NAN)).is_none());
    assert_eq!((b.counts().malformed, b.history()), (2, 1));
    assert!(WindowBuilder::new(&WindowConfig::default(), 1).push(plain(0)).is_none());
    let windows: Vec<_> = (1..16).filter_map(|i| b.push(set(i * 100 * MS, 4, DVec3::ZERO))).collect();
    assert_eq!(windows.iter().map(|w| (w.epoch, stamps(w)[0])).collect::<Vec<_>>(), [(4, 0)]);
}

#[test]
fn utm_sized_places_lose_nothing() {
    let drive = |origin: DVec3| {
        let mut b = WindowBuilder::new(&WindowConfig::default(), 0);
        let place = |i: i64| origin + DVec3::new(1.03 * i as f64, 0.37 * i as f64, 0.01 * i as f64);
        (0..16).find_map(|i| b.push(set(i * 100 * MS, 0, place(i)))).unwrap()
    };
    let (near, far) = (drive(DVec3::ZERO), drive(DVec3::new(4_500_000.7, -650_000.3, 120.1)));
    for step in 0..4 {
        let (a, b) = (near.anchor_from_camera(step, 0), far.anchor_from_camera(step, 0));
        // f64 resolves 1e-9 m at 4500 km; two such positions are subtracted.
        assert!((a.translation - b.translation).length() < 4e-9, "{}", (a.translation - b.translation).length());
        assert!(a.rotation.angle_between(b.rotation) < 1e-7);
    }
    // The anchor is the reference camera of the first timestep with its axes exchanged.
    assert_eq!(near.anchor_from_camera(0, 0).translation, DVec3::ZERO);
    assert!((near.anchor_from_camera(0, 0).apply(DVec3::Z) - DVec3::X).length() < 1e-15);
}

proptest! {
    /// Against the obvious version: nearest set to each place by search over everything.
    #[test]
    fn timesteps_are_the_nearest_sets(
        gaps_ms in proptest::collection::vec(1i64..400, 1..80), timesteps in 1usize..6, start_ns in 0i64..(1 << 62),
        stride_sec in 0.1f64..1.0, stride_tolerance in 0.0f64..0.5,
    ) {
        let config = WindowConfig { timesteps, stride_sec, stride_tolerance, ..Default::default() };
        let mut b = WindowBuilder::new(&config, 0);
        let (mut all, mut t) = (Vec::new(), start_ns);
        for gap_ms in gaps_ms {
            t += gap_ms * MS;
            all.push(t);
            let window = b.push(plain(t));
            let places: Vec<i64> = (0..timesteps).map(|k| t - k as i64 * (stride_sec * 1e9).round() as i64).collect();
            let near = |place: i64| all.iter().map(|s| s.abs_diff(place)).min().unwrap_or(u64::MAX);
            let most = (stride_sec * stride_tolerance * 1e9).round() as u64;
            // An epoch's first window waits for the set that has its oldest timestep nearest to the first set.
            let waits = all.get(1).map_or(most, |second| (second.abs_diff(all[0]) / 2).min(most));
            let possible = places.iter().all(|&p| near(p) <= most) && places[timesteps - 1] + waits as i64 >= all[0];
            prop_assert_eq!(window.is_some(), possible);
            if let Some(w) = window {
                let picked = stamps(&w);
                prop_assert!(picked.windows(2).all(|p| p[0] < p[1]));
                for (s, &p) in picked.iter().rev().zip(&places) {
                    prop_assert_eq!(s.abs_diff(p), near(p));
                }
                prop_assert!(w.time_sec.len() == timesteps);
            }
            let span = b.history.back().unwrap().stamp_ns.abs_diff(b.history.front().unwrap().stamp_ns);
            prop_assert!(span as f64 * 1e-9 <= stride_sec * (timesteps as f64 - 1.0 + stride_tolerance) + 1e-6);
        }
        let c = b.counts();
        prop_assert_eq!(c.windows + c.filling + c.gap, all.len() as u64);
    }
}

/// Images and poses of a drive, played twice in a loop, through sync, pose gate and window as the engine strings them
/// together.
#[test]
fn stages_fit_together_over_a_looped_recording() {
    use crate::config::SyncConfig;
    use crate::poses::{PoseBuffer, PoseGate};
    use crate::sync::Synchronizer;

    let config = SyncConfig::default();
    let (mut sync, mut poses) = (Synchronizer::new(2, &config, &[0.0, -0.005]), PoseBuffer::new(&config));
    let (mut gate, mut builder) = (PoseGate::new(&config), WindowBuilder::new(&WindowConfig::default(), 0));
    let (mut windows, mut sets, mut epoch) = (Vec::new(), 0, 0);
    for _ in 0..2 {
        // Poses every 10 ms, images every 100 ms; the second camera's stamps are 5 ms late and its images come after
        // the next pose.
        for tick in 0..500i64 {
            let now_ns = 1000 * SEC + tick * 10 * MS;
            let _ = poses.push(now_ns, Rigid::new(DQuat::IDENTITY, DVec3::X * (tick as f64 * 0.1)));
            match tick % 10 {
                3 => sync.push(0, now_ns - 4 * MS, tick),
                4 => sync.push(1, now_ns - 9 * MS, tick),
                _ => {}
            }
            sync.advance(now_ns);
            while let Some(set) = sync.pop() {
                if set.epoch != epoch {
                    epoch = set.epoch;
                    poses.follow_clock(set.stamp_ns);
                }
                gate.push(set);
            }
            while let Some(set) = gate.poll(now_ns, |_, stamp_ns| poses.lookup(stamp_ns)) {
                sets += 1;
                let expected = (set.frames[1].stamp_ns - 1000 * SEC) as f64 * 1e-8;
                assert!((set.frames[1].map_from_camera.translation.x - expected).abs() < 1e-9);
                windows.extend(builder.push(set));
            }
        }
    }
    assert_eq!((sets, sync.drops().total(), gate.drops().total()), (100, 0, 0));
    assert_eq!(windows.iter().filter(|w| w.epoch == 0).count(), 35);
    assert_eq!(windows.iter().filter(|w| w.epoch == 1).count(), 35);
    assert_eq!((epoch, poses.counts().clock_jumps), (1, 1));
}

#[test]
fn prior_sets_lie_shortly_before_their_timesteps_where_there_are_any() {
    let mut b = WindowBuilder::new(&WindowConfig::default(), 0).with_prior(0.1);
    let windows: Vec<_> = (0..30).filter_map(|i| b.push(plain(i * 100 * MS))).collect();
    let priors =
        |w: &Window<i64>| w.prior.iter().map(|p| p.as_ref().map(|s| s.stamp_ns / (100 * MS))).collect::<Vec<_>>();
    // There is nothing before the first set; later windows have all four.
    assert_eq!(priors(&windows[0]), [None, Some(4), Some(9), Some(14)]);
    assert!(windows[1..].iter().all(|w| w.priors() == 4));
    assert_eq!(priors(&windows[7]), [Some(6), Some(11), Some(16), Some(21)]);
    // At 2 Hz no set is near enough, and without being asked there is none.
    let mut slow = WindowBuilder::new(&WindowConfig::default(), 0).with_prior(0.1);
    assert!((0..8).filter_map(|i| slow.push(plain(i * 500 * MS))).all(|w| w.prior.len() == 4 && w.priors() == 0));
    let mut off = WindowBuilder::new(&WindowConfig::default(), 0);
    assert!((0..30).filter_map(|i| off.push(plain(i * 100 * MS))).all(|w| w.prior.is_empty()));
}
