//! Loaded Gaussians on every renderer: moved by the renderer, channel by channel, under names that do not outlive them.

use super::agreement::check_pictures;
use super::backends::each;
use super::scenes::{KINDS, Scene, assert_finite, bits, both_conventions, front_view, turned_view};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use storm_render::Gaussians;
use storm_render::raster::{Channels, Motion, RasterError, RasterSettings};
use storm_render::renderer::RenderError;

/// A scene's motion: up to 8 m/s in directions of their own, seen at four times.
fn moves(scene: &Scene, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = scene.means.len();
    let mut velocities = || (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-8.0f32..8.0))).collect();
    let (velocity_backward, velocity_forward) = (velocities(), velocities());
    let time_sec = (0..n).map(|i| 0.5 * (i % 4) as f32).collect();
    Gaussians { means: scene.means.clone(), velocity_backward, velocity_forward, time_sec, ..Default::default() }
}

fn motion(moves: &Gaussians) -> Motion<'_> {
    Motion {
        velocity_backward: &moves.velocity_backward,
        velocity_forward: &moves.velocity_forward,
        time_sec: &moves.time_sec,
    }
}

#[test]
fn the_renderer_moves_by_the_papers_equation() {
    let views = [front_view(75, 50), turned_view(50, 37, 0.3)];
    for settings in both_conventions() {
        for (seed, kind) in KINDS.into_iter().enumerate() {
            let scene = Scene::random(seed as u64, kind, 1200, 3);
            let moves = moves(&scene, seed as u64);
            // Before, between (some look back and some ahead) and after all of their own times.
            let times = [-0.4, 0.75, 2.1];
            let wanted = times.map(|time_sec| Scene {
                means: (0..scene.means.len()).map(|i| moves.mean_at(i, time_sec)).collect(),
                ..scene.clone()
            });
            each(settings, |backend| {
                let name = backend.renderer.load(&scene.splats(), Some(&motion(&moves))).unwrap();
                for (time_sec, wanted) in times.iter().zip(&wanted) {
                    let got = backend.renderer.draw(name, *time_sec, &Channels(0..3), &views).unwrap();
                    check_pictures(settings, wanted, &views, &got, backend);
                }
            });
        }
    }
}

#[test]
fn gaussians_without_motion_are_the_same_at_any_time() {
    let scene = Scene::random(3, KINDS[0], 900, 2);
    let views = [front_view(60, 40)];
    each(RasterSettings::default(), |backend| {
        let rendered = backend.renderer.render(&scene.splats(), &views).unwrap();
        let stats = backend.renderer.stats();
        let name = backend.renderer.load(&scene.splats(), None).unwrap();
        for time_sec in [0.0, -7.5, 1e30] {
            let drawn = backend.renderer.draw(name, time_sec, &Channels(0..2), &views).unwrap();
            assert_eq!(bits(&drawn), bits(&rendered));
            assert_eq!(backend.renderer.stats(), stats);
        }
    });
}

#[test]
fn fewer_channels_are_the_same_channels() {
    let scene = Scene::random(5, KINDS[0], 900, 9);
    let views = [front_view(60, 40), turned_view(33, 21, 0.2)];
    each(RasterSettings::default(), |backend| {
        let name = backend.renderer.load(&scene.splats(), None).unwrap();
        let all = backend.renderer.draw(name, 0.0, &Channels(0..9), &views).unwrap();
        for range in [0..0, 3..6, 2..9, 9..9] {
            let some = backend.renderer.draw(name, 0.0, &Channels(range.clone()), &views).unwrap();
            for (some, all) in some.iter().zip(&all) {
                assert_eq!((&some.alpha, &some.depth), (&all.alpha, &all.depth));
                let wanted: Vec<f32> =
                    all.features.chunks_exact(9).flat_map(|row| &row[range.clone()]).copied().collect();
                assert_eq!((some.feature_count, &some.features), (range.len(), &wanted));
            }
        }
        #[allow(clippy::reversed_empty_ranges)]
        for range in [0..10, 5..4, 10..10] {
            let refused = backend.renderer.draw(name, 0.0, &Channels(range), &views);
            assert!(matches!(refused, Err(RenderError::Raster(RasterError::Channels { .. }))), "{refused:?}");
        }
    });
}

#[test]
fn names_end_with_the_next_load_or_render() {
    let scene = Scene::copies(3, 1);
    let views = [front_view(8, 8)];
    let mut foreign = None;
    each(RasterSettings::default(), |backend| {
        let gone = |r: Result<_, RenderError>| matches!(r, Err(RenderError::Raster(RasterError::NotLoaded)));
        if let Some(name) = foreign {
            assert!(gone(backend.renderer.draw(name, 0.0, &Channels::NONE, &views)));
        }
        let first = backend.renderer.load(&scene.splats(), None).unwrap();
        assert!(backend.renderer.draw(first, 0.0, &Channels::NONE, &views).is_ok());
        let second = backend.renderer.load(&scene.splats(), None).unwrap();
        assert!(gone(backend.renderer.draw(first, 0.0, &Channels::NONE, &views)));
        backend.renderer.render(&scene.splats(), &views).unwrap();
        assert!(gone(backend.renderer.draw(second, 0.0, &Channels::NONE, &views)));
        foreign = Some(backend.renderer.load(&scene.splats(), None).unwrap());
    });
}

#[test]
fn places_that_are_none_are_skipped_and_counted() {
    let scene = Scene::copies(6, 1);
    let mut moves = moves(&scene, 1);
    moves.time_sec = vec![0.0; 6];
    moves.velocity_forward[0][1] = f32::NAN;
    moves.velocity_forward[1][2] = f32::INFINITY;
    moves.velocity_forward[2][0] = f32::MAX;
    moves.velocity_backward[3][0] = f32::NEG_INFINITY;
    moves.time_sec[4] = f32::NAN;
    each(RasterSettings::default(), |backend| {
        let name = backend.renderer.load(&scene.splats(), Some(&motion(&moves))).unwrap();
        // Ahead: two without a velocity, one that leaves all numbers, one without a time. Back: one and that one.
        for (time_sec, invalid) in [(2.0, 4), (-1.0, 2), (2.0, 4)] {
            let pictures = backend.renderer.draw(name, time_sec, &Channels(0..1), &[front_view(30, 20)]).unwrap();
            pictures.iter().for_each(assert_finite);
            let stats = backend.renderer.stats();
            let who = backend.renderer.describe();
            assert_eq!((stats.invalid, stats.culled + stats.visible), (invalid, 6 - invalid), "{time_sec} {who}");
        }
        for time_sec in [f32::NAN, f32::NEG_INFINITY] {
            let refused = backend.renderer.draw(name, time_sec, &Channels(0..1), &[front_view(30, 20)]);
            assert!(matches!(refused, Err(RenderError::Raster(RasterError::Setting { name: "time_sec", .. }))));
        }
        let short = Motion { time_sec: &moves.time_sec[1..], ..motion(&moves) };
        let refused = backend.renderer.load(&scene.splats(), Some(&short));
        assert!(matches!(refused, Err(RenderError::Raster(RasterError::Length { name: "time_sec", .. }))));
    });
}
