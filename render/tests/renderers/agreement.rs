//! Every renderer against the slow reference, and the device against the CPU.

use super::backends::{Backend, each};
use super::scenes::{KINDS, Kind, Scene, both_conventions, front_view, turned_view};
use storm_render::View;
use storm_render::raster::{Picture, RasterSettings, reference};

/// Where a decision is close: a splat of alpha 1/255 more or less and, for two splats of equal depth, their order.
const FRAGILE_TOLERANCE: f32 = 2e-2;

/// Compares every renderer with the reference.
fn compare(settings: RasterSettings, scene: &Scene, views: &[View]) {
    each(settings, |backend| {
        let fast = backend.renderer.render(&scene.splats(), views).unwrap();
        check_pictures(settings, scene, views, &fast, backend);
    });
}

/// Compares a renderer's pictures with the reference's.
pub fn check_pictures(settings: RasterSettings, scene: &Scene, views: &[View], fast: &[Picture], backend: &Backend) {
    let slow = reference::render_with_fragile(&settings, &scene.splats(), views).unwrap();
    assert_eq!(fast.len(), views.len());
    for (fast, (slow, fragile)) in fast.iter().zip(&slow) {
        assert_eq!((fast.width, fast.height, fast.feature_count), (slow.width, slow.height, slow.feature_count));
        for pixel in 0..fragile.len() {
            let tolerance = if fragile[pixel] { FRAGILE_TOLERANCE } else { backend.color_tolerance };
            let close = |a: f32, b: f32, tolerance: f32| {
                let who = backend.renderer.describe();
                assert!((a - b).abs() <= tolerance, "pixel {pixel}: {a}, not {b}, fragile {}, {who}", fragile[pixel]);
            };
            close(fast.alpha[pixel], slow.alpha[pixel], tolerance);
            for c in pixel * fast.feature_count..(pixel + 1) * fast.feature_count {
                close(fast.features[c], slow.features[c], tolerance);
            }
            if !fragile[pixel] {
                close(fast.depth[pixel], slow.depth[pixel], backend.depth_tolerance);
            }
        }
    }
}

#[test]
fn both_conventions_match_the_reference() {
    for settings in both_conventions() {
        for (seed, kind) in KINDS.into_iter().enumerate() {
            let views = [front_view(75, 50), turned_view(50, 37, 0.3)];
            compare(settings, &Scene::random(seed as u64, kind, 1500, 3), &views);
        }
        compare(
            RasterSettings { radius_clip: 3.0, ..settings },
            &Scene::random(9, Kind::Mixed, 800, 1),
            &[front_view(40, 40)],
        );
    }
}

#[test]
fn any_number_of_channels_matches_the_reference() {
    for channels in [0, 1, 4, 5, 22] {
        compare(RasterSettings::default(), &Scene::random(3, Kind::Mixed, 700, channels), &[front_view(50, 37)]);
    }
}

#[test]
fn any_picture_size_matches_the_reference() {
    let scene = Scene::random(4, Kind::Mixed, 400, 2);
    for (width, height) in [(1, 1), (1, 60), (60, 1), (16, 16), (31, 15), (32, 16), (33, 17), (65, 47)] {
        compare(RasterSettings::default(), &scene, &[front_view(width, height)]);
    }
}

/// The largest difference of two pictures that one shade of an eight bit picture more or less explains, twice.
#[cfg(feature = "wgpu")]
const MAX_COLOR_DIFFERENCE: f32 = 2.0 / 255.0;
/// Differences that no eye and no eight bit picture shows.
#[cfg(feature = "wgpu")]
const MIN_PSNR_DB: f64 = 55.0;

#[cfg(feature = "wgpu")]
#[test]
fn device_and_cpu_agree_on_random_scenes() {
    use super::backends::with_device;
    use storm_render::raster::CpuRasterizer;
    use storm_render::renderer::Renderer;
    for seed in 0..20u64 {
        let kind = KINDS[seed as usize % KINDS.len()];
        let settings = both_conventions()[(seed / 4) as usize % 2];
        let scene = Scene::random(100 + seed, kind, 10_000, 3);
        let views = [front_view(160, 90), turned_view(121, 83, 0.05 * seed as f32 - 0.5)];
        let mut cpu = CpuRasterizer::new(settings).unwrap();
        let want = cpu.render(&scene.splats(), &views).unwrap();
        with_device(settings, |gpu| {
            let got = gpu.render(&scene.splats(), &views).unwrap();
            let (mut worst, mut squares, mut count) = (0.0f32, 0.0f64, 0usize);
            for (a, b) in got.iter().zip(&want).flat_map(|(g, w)| g.features.iter().zip(&w.features)) {
                worst = worst.max((a - b).abs());
                squares += f64::from(a - b).powi(2);
                count += 1;
            }
            let psnr = -10.0 * (squares / count as f64).max(1e-20).log10();
            let depth = got.iter().zip(&want).flat_map(|(g, w)| g.depth.iter().zip(&w.depth));
            let depth = depth.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            println!(
                "seed {seed} {kind:?} {:?}: max {:.3}/255, PSNR {psnr:.1} dB, depth {depth:.4} m, visible {} and {}",
                settings.convention,
                worst * 255.0,
                Renderer::stats(gpu).visible,
                cpu.stats().visible
            );
            assert!(worst <= MAX_COLOR_DIFFERENCE && psnr >= MIN_PSNR_DB, "seed {seed}: {worst} {psnr}");
            println!("  {:?}", gpu.timings());
            let (ours, theirs) = (Renderer::stats(gpu), cpu.stats());
            assert_eq!((ours.splats, ours.invalid), (theirs.splats, theirs.invalid));
            assert!(ours.visible.abs_diff(theirs.visible) <= 2, "{} {}", ours.visible, theirs.visible);
        });
    }
}
