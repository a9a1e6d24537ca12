//! Loaded Gaussians: the very pictures of fresh ones, with less work; the counts say when work is left out and when it
//! must not be.

use super::super::loaded::GROUP;
use super::super::*;
use super::scenes::{Scene, front_view, turned_view};
use crate::Gaussians;
use glam::{Affine3A, Quat, Vec3};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn rasterizer() -> CpuRasterizer {
    CpuRasterizer::new(RasterSettings::default()).unwrap()
}

/// Velocities and times for a scene.
struct Moves {
    gaussians: Gaussians,
}

impl Moves {
    fn random(scene: &Scene, seed: u64, speed: f32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let n = scene.means.len();
        let mut velocities = || (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-speed..=speed))).collect();
        let (velocity_backward, velocity_forward) = (velocities(), velocities());
        let time_sec = (0..n).map(|i| 0.5 * (i % 4) as f32).collect();
        let means = scene.means.clone();
        Self { gaussians: Gaussians { means, velocity_backward, velocity_forward, time_sec, ..Default::default() } }
    }

    fn motion(&self) -> Motion<'_> {
        Motion {
            velocity_backward: &self.gaussians.velocity_backward,
            velocity_forward: &self.gaussians.velocity_forward,
            time_sec: &self.gaussians.time_sec,
        }
    }

    fn moved(&self, scene: &Scene, time_sec: f32) -> Scene {
        let means = (0..scene.means.len()).map(|i| self.gaussians.mean_at(i, time_sec)).collect();
        Scene { means, ..scene.clone() }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]
    #[test]
    fn drawing_loaded_gaussians_is_rendering_the_moved_ones(
        seed in any::<u64>(),
        n in 0usize..600,
        channels in 0usize..5,
        speed in prop_oneof![Just(0.0f32), Just(20.0), Just(1e4), Just(1e30)],
        time_sec in -3.0f32..5.0,
        latest in any::<bool>(),
        yaw in -1.5f32..1.5,
    ) {
        let convention = if latest { Convention::Latest } else { Convention::Pinned };
        let settings = RasterSettings { convention, ..RasterSettings::default() };
        let mut scene = Scene::random(seed, n, channels);
        // Some that are not usable, and a velocity that is none.
        scene.scales.iter_mut().step_by(41).for_each(|s| s[1] = f32::NAN);
        let mut moves = Moves::random(&scene, seed, speed);
        moves.gaussians.velocity_forward.iter_mut().step_by(37).for_each(|v| v[2] = f32::INFINITY);
        let views = [front_view(60, 40), turned_view(31, 47, yaw)];
        let mut kept = CpuRasterizer::new(settings).unwrap();
        let name = kept.load(&scene.splats(), Some(&moves.motion())).unwrap();
        for time_sec in [time_sec, 0.0, -time_sec] {
            let mut fresh = CpuRasterizer::new(settings).unwrap();
            let wanted = fresh.render(&moves.moved(&scene, time_sec).splats(), &views).unwrap();
            let got = kept.draw(name, time_sec, &Channels(0..channels), &views).unwrap();
            prop_assert!(got == wanted, "{time_sec}");
            prop_assert_eq!(kept.stats(), fresh.stats());
        }
    }
}

#[test]
fn covariances_are_worked_out_once_for_all_times_and_views() {
    let scene = Scene::random(3, 1000, 3);
    let moves = Moves::random(&scene, 3, 5.0);
    let views = [front_view(60, 40), turned_view(60, 40, 0.2)];
    let mut r = rasterizer();
    r.render(&scene.splats(), &views).unwrap();
    assert_eq!(r.work().shapes, 1000, "one for all views");
    let name = r.load(&scene.splats(), Some(&moves.motion())).unwrap();
    for time_sec in [0.0, 0.7, -0.3] {
        r.draw(name, time_sec, &Channels(0..3), &views).unwrap();
        assert_eq!(r.work().shapes, 0);
    }
    // Other scales have to be loaded, and are then drawn.
    let mut wider = scene.clone();
    wider.scales.iter_mut().flatten().for_each(|s| *s *= 2.0);
    let before = r.draw(name, 0.0, &Channels(0..3), &views).unwrap();
    let name = r.load(&wider.splats(), Some(&moves.motion())).unwrap();
    let after = r.draw(name, 0.0, &Channels(0..3), &views).unwrap();
    assert_ne!(before, after);
    assert_eq!(after, rasterizer().render(&moves.moved(&wider, 0.0).splats(), &views).unwrap());
}

#[test]
fn names_of_gaussians_that_are_gone_are_refused() {
    let scene = Scene::copies(3, 1);
    let views = [front_view(8, 8)];
    let (mut a, mut b) = (rasterizer(), rasterizer());
    let first = a.load(&scene.splats(), None).unwrap();
    assert!(a.draw(first, 0.0, &Channels(0..1), &views).is_ok());
    assert_eq!(b.draw(first, 0.0, &Channels(0..1), &views), Err(RasterError::NotLoaded));
    let second = a.load(&scene.splats(), None).unwrap();
    assert_eq!(a.draw(first, 0.0, &Channels(0..1), &views), Err(RasterError::NotLoaded));
    assert!(a.draw(second, 0.0, &Channels(0..1), &views).is_ok());
    // What a backward pass would need is of the last render alone.
    assert!(a.backward(&scene.splats(), &views, &[], &[]).is_err());
    a.render(&scene.splats(), &views).unwrap();
    assert_eq!(a.draw(second, 0.0, &Channels(0..1), &views), Err(RasterError::NotLoaded));
}

/// `groups` groups of Gaussians, each around a direction of its own, all around the camera.
fn ring(groups: usize) -> Scene {
    let mut scene = Scene::copies(groups * GROUP, 1);
    for (i, mean) in scene.means.iter_mut().enumerate() {
        let around = Quat::from_rotation_y((i / GROUP) as f32 / groups as f32 * std::f32::consts::TAU);
        let jitter = (i % GROUP) as f32 / GROUP as f32 - 0.5;
        *mean = (around * Vec3::new(jitter, 0.5 * jitter, 10.0)).into();
    }
    scene
}

#[test]
fn groups_outside_of_the_view_are_not_read() {
    let scene = ring(36);
    let n = scene.means.len();
    let mut r = rasterizer();
    let name = r.load(&scene.splats(), None).unwrap();
    let mut shown = 0;
    for step in 0..12 {
        let turn = Affine3A::from_quat(Quat::from_rotation_y(step as f32 / 12.0 * std::f32::consts::TAU));
        let view = crate::View { camera_from_world: turn, ..front_view(64, 48) };
        let pictures = r.draw(name, 0.0, &Channels(0..1), &[view]).unwrap();
        assert_eq!(pictures, rasterizer().render(&scene.splats(), &[view]).unwrap());
        let (stats, work) = (r.stats(), r.work());
        shown += stats.visible;
        // Some 60 degrees are seen.
        assert!(work.unread > n / 2 && work.unread + stats.visible <= n, "{work:?} {stats:?}");
        assert_eq!(work.unread % GROUP, 0);
    }
    assert!(shown >= n, "every Gaussian is seen by some view: {shown}");
}

#[test]
fn what_moves_into_the_view_is_read() {
    // All behind the camera, and on their way to 5 m ahead of it in one second, or ahead one second ago.
    let mut scene = Scene::copies(2 * GROUP, 1);
    scene.means.iter_mut().for_each(|m| m[2] = -15.0);
    let n = scene.means.len();
    let (forward, backward) = (vec![[0.0, 0.0, 20.0]; n], vec![[0.0, 0.0, -20.0]; n]);
    let times = vec![3.0; n];
    let motion = Motion { velocity_backward: &backward, velocity_forward: &forward, time_sec: &times };
    let mut r = rasterizer();
    let name = r.load(&scene.splats(), Some(&motion)).unwrap();
    for (time_sec, unread, visible) in [(3.0, n, 0), (4.0, 0, n), (2.0, 0, n), (3.1, n, 0)] {
        r.draw(name, time_sec, &Channels::NONE, &[front_view(32, 32)]).unwrap();
        assert_eq!((r.work().unread, r.stats().visible), (unread, visible), "{time_sec}");
    }
    // The same Gaussians at rest stay behind it, whatever the time.
    let name = r.load(&scene.splats(), None).unwrap();
    r.draw(name, 1e30, &Channels::NONE, &[front_view(32, 32)]).unwrap();
    assert_eq!((r.work().unread, r.stats().visible), (n, 0));
}

#[test]
fn speeds_that_are_none_bound_nothing() {
    let scene = ring(4);
    let n = scene.means.len();
    for bad in [f32::NAN, f32::INFINITY] {
        let (mut forward, still) = (vec![[0.0; 3]; n], vec![[0.0; 3]; n]);
        forward[n / 2] = [0.0, bad, 0.0];
        let times = vec![0.0; n];
        let motion = Motion { velocity_backward: &still, velocity_forward: &forward, time_sec: &times };
        let mut r = rasterizer();
        let name = r.load(&scene.splats(), Some(&motion)).unwrap();
        // Looks ahead; the odd one is behind. Its group is read all the same, and it is counted.
        r.draw(name, 1.0, &Channels::NONE, &[front_view(32, 32)]).unwrap();
        assert_eq!(r.stats().invalid, 1);
        r.draw(name, -1.0, &Channels::NONE, &[front_view(32, 32)]).unwrap();
        assert_eq!(r.stats().invalid, 0, "backward it stands still");
    }
}

#[test]
fn faint_small_and_hidden_splats_cost_no_blending() {
    let view = [front_view(64, 48)];
    let work = |scene: &Scene| {
        let mut r = rasterizer();
        r.render(&scene.splats(), &view).unwrap();
        (r.stats(), r.work())
    };
    // Bright enough for a pixel or two, and a little too faint for any: visible to the pinned convention, but never listed.
    let mut scene = Scene::copies(10, 1);
    scene.opacities.fill(5.0 / 255.0);
    let (stats, bright) = work(&scene);
    assert_eq!((stats.visible, bright.listed), (10, 10));
    scene.opacities.fill(0.99 / 255.0);
    let (stats, faint) = work(&scene);
    assert_eq!((stats.visible, faint.listed, faint.blended, stats.pairs), (10, 0, 0, 0));

    // A wall of four in front of two hundred: two fill every pixel (0.001^2 < 1e-4), nothing behind them is blended.
    let mut hidden = Scene::copies(204, 1);
    for i in 0..4 {
        (hidden.means[i][2], hidden.scales[i], hidden.opacities[i]) = (4.0, [100.0; 3], 1.0);
    }
    let (stats, behind) = work(&hidden);
    let tiles = 64 / TILE_W * 48 / TILE_H;
    assert_eq!((stats.visible, behind.listed, behind.blended), (204, 204, 2 * tiles));
    assert!(stats.pairs >= 200 + 4 * tiles);
    // So faint that all of them together leave every pixel open: none is hidden.
    let mut open = Scene::copies(200, 1);
    open.opacities.fill(0.02);
    let (stats, all) = work(&open);
    assert_eq!(all.blended, stats.pairs);

    // Smaller than a pixel and between four centres, without blur: no pixel can show it.
    let mut dot = Scene::copies(1, 1);
    dot.scales[0] = [1e-6; 3];
    let mut r = CpuRasterizer::new(RasterSettings { blur: 0.0, ..RasterSettings::default() }).unwrap();
    let mut camera = front_view(64, 48);
    (camera.intrinsics.cx, camera.intrinsics.cy) = (32.0, 24.0);
    let picture = r.render(&dot.splats(), &[camera]).unwrap().remove(0);
    assert_eq!((r.stats().visible, r.work().listed), (1, 0));
    assert!(picture.alpha.iter().all(|&a| a == 0.0));
    // On a centre it shows.
    (camera.intrinsics.cx, camera.intrinsics.cy) = (32.5, 24.5);
    let picture = r.render(&dot.splats(), &[camera]).unwrap().remove(0);
    assert_eq!((r.stats().visible, r.work().listed), (1, 1));
    assert_eq!(picture.alpha[24 * 64 + 32], 0.5);
}

#[test]
fn fewer_channels_are_the_same_channels() {
    let scene = Scene::random(5, 2000, 9);
    let views = [front_view(60, 40)];
    let mut r = rasterizer();
    let name = r.load(&scene.splats(), None).unwrap();
    let all = r.draw(name, 0.0, &Channels(0..9), &views).unwrap().remove(0);
    for range in [0..0, 3..6, 8..9, 0..9, 9..9] {
        let some = r.draw(name, 0.0, &Channels(range.clone()), &views).unwrap().remove(0);
        assert_eq!((&some.alpha, &some.depth), (&all.alpha, &all.depth));
        let wanted: Vec<f32> = all.features.chunks_exact(9).flat_map(|row| &row[range.clone()]).copied().collect();
        assert_eq!(some.features, wanted, "{range:?}");
    }
    #[allow(clippy::reversed_empty_ranges)]
    for range in [0..10, 5..4, 10..10, 0..usize::MAX] {
        let refused = r.draw(name, 0.0, &Channels(range.clone()), &views);
        assert!(matches!(refused, Err(RasterError::Channels { .. })), "{range:?}");
    }
    for time_sec in [f32::NAN, f32::INFINITY] {
        assert!(matches!(r.draw(name, time_sec, &Channels::NONE, &views), Err(RasterError::Setting { .. })));
    }
}

#[test]
fn any_number_of_threads_draws_the_same() {
    let scene = Scene::random(7, 30_000, 2);
    let moves = Moves::random(&scene, 7, 4.0);
    let views = [front_view(130, 90), turned_view(97, 61, 0.9)];
    let runs = [1, 2, 4].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut r = rasterizer();
            let name = r.load(&scene.splats(), Some(&moves.motion())).unwrap();
            (r.draw(name, 0.8, &Channels(0..2), &views).unwrap(), r.work())
        })
    });
    assert!(runs[0].1.unread > 0 || runs[0].1.blended > 0);
    assert_eq!(runs[0], runs[1]);
    assert_eq!(runs[0], runs[2]);
}
