//! The fast version against the reference on random scenes, and against itself on other threads and instruction sets.

use super::super::*;
use super::scenes::{Scene, front_view, turned_view};
use crate::camera::View;
use proptest::prelude::*;

/// f32 against f64 where no decision is close: rounding of up to a thousand weights.
const TOLERANCE: f32 = 1e-5;
/// Depths reach 30 m here.
const DEPTH_TOLERANCE: f32 = 1e-4;
/// Where a decision is close: a splat of alpha 1/255 more or less, and, for two splats of equal depth, their order.
const FRAGILE_TOLERANCE: f32 = 2e-2;

/// Compares the fast version with the reference; returns the share of fragile pixels.
pub(super) fn compare(settings: RasterSettings, scene: &Scene, views: &[View]) -> f64 {
    let fast = CpuRasterizer::new(settings).unwrap().render(&scene.splats(), views).unwrap();
    let slow = reference::render_with_fragile(&settings, &scene.splats(), views).unwrap();
    let (mut fragile_pixels, mut pixels) = (0, 0);
    for (fast, (slow, fragile)) in fast.iter().zip(&slow) {
        assert_eq!((fast.width, fast.height, fast.feature_count), (slow.width, slow.height, slow.feature_count));
        assert_eq!((fast.features.len(), fast.depth.len()), (slow.features.len(), slow.depth.len()));
        for pixel in 0..fragile.len() {
            let tolerance = if fragile[pixel] { FRAGILE_TOLERANCE } else { TOLERANCE };
            let close = |a: f32, b: f32, tolerance: f32| {
                assert!((a - b).abs() <= tolerance, "pixel {pixel}: {a} instead of {b}, fragile {}", fragile[pixel]);
            };
            close(fast.alpha[pixel], slow.alpha[pixel], tolerance);
            let channels = pixel * fast.feature_count..(pixel + 1) * fast.feature_count;
            for c in channels {
                close(fast.features[c], slow.features[c], tolerance);
            }
            if !fragile[pixel] {
                close(fast.depth[pixel], slow.depth[pixel], DEPTH_TOLERANCE);
            }
        }
        fragile_pixels += fragile.iter().filter(|&&f| f).count();
        pixels += fragile.len();
    }
    fragile_pixels as f64 / pixels as f64
}

fn bits(pictures: &[Picture]) -> Vec<u32> {
    let values = pictures.iter().flat_map(|p| p.features.iter().chain(&p.alpha).chain(&p.depth));
    values.map(|x| x.to_bits()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn random_scenes_match_the_reference(
        seed in any::<u64>(),
        n in 0usize..400,
        channels in 0usize..6,
        width in 1usize..75,
        height in 1usize..50,
        latest in any::<bool>(),
        radius_clip in prop_oneof![Just(0.0f32), Just(3.0f32)],
        yaw in -0.6f32..0.6,
    ) {
        let convention = if latest { Convention::Latest } else { Convention::Pinned };
        let settings = RasterSettings { convention, radius_clip, ..RasterSettings::default() };
        let scene = Scene::random(seed, n, channels);
        compare(settings, &scene, &[front_view(width, height), turned_view(height, width, yaw)]);
    }
}

#[test]
fn few_pixels_are_fragile() {
    let share = compare(RasterSettings::default(), &Scene::random(5, 2000, 3), &[front_view(96, 64)]);
    assert!(share < 0.3, "comparisons would mean little: {share}");
}

#[test]
fn many_chunks_and_channels_match_the_reference() {
    let scene = Scene::random(6, 3 * (1 << MIN_CHUNK_BITS) + 17, 22);
    compare(RasterSettings::default(), &scene, &[front_view(50, 37)]);
}

#[test]
fn projections_match_the_reference() {
    let scene = Scene::random(11, 4003, 3);
    for convention in [Convention::Pinned, Convention::Latest] {
        let settings = RasterSettings { convention, ..RasterSettings::default() };
        let view = turned_view(96, 64, 0.3);
        let fast = CpuRasterizer::new(settings).unwrap().project(&scene.splats(), &view).unwrap();
        let slow = reference::project(&settings, &scene.splats(), &view).unwrap();
        assert!(fast.iter().flatten().count() > 1000);
        for (i, pair) in fast.iter().zip(&slow).enumerate() {
            match pair {
                (None, None) => {}
                (Some(f), Some(s)) => {
                    assert_eq!(f.radius, s.radius, "{i}");
                    let pairs = [(f.mean[0], s.mean[0]), (f.mean[1], s.mean[1]), (f.depth, s.depth)];
                    let conics = (0..3).map(|k| (f.conic[k], s.conic[k]));
                    for (a, b) in pairs.into_iter().chain(conics) {
                        assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0), "{i}: {a} {b}");
                    }
                }
                _ => panic!("{i}: {pair:?}"),
            }
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let scene = Scene::random(7, 30_000, 5);
    let views = [front_view(130, 90), turned_view(97, 61, 0.4), turned_view(64, 64, -0.3)];
    let runs: Vec<(Vec<u32>, RasterStats)> = [1, 2, 4]
        .into_iter()
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
                let pictures = rasterizer.render(&scene.splats(), &views).unwrap();
                (bits(&pictures), rasterizer.stats())
            })
        })
        .collect();
    assert!(runs[0].0.iter().any(|&b| b != 0));
    assert_eq!(runs[0], runs[1]);
    assert_eq!(runs[0], runs[2]);
}

#[test]
fn reused_buffers_leave_no_trace() {
    let (big, small) = (Scene::random(8, 9000, 4), Scene::random(9, 300, 2));
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let mut pictures = Vec::new();
    rasterizer.render_into(&big.splats(), &[front_view(100, 80), front_view(33, 20)], &mut pictures).unwrap();
    for picture in &mut pictures {
        picture.features.fill(f32::NAN);
        picture.alpha.fill(f32::NAN);
        picture.depth.fill(f32::NAN);
    }
    rasterizer.render_into(&small.splats(), &[front_view(50, 30)], &mut pictures).unwrap();
    let fresh =
        CpuRasterizer::new(RasterSettings::default()).unwrap().render(&small.splats(), &[front_view(50, 30)]).unwrap();
    assert_eq!(bits(&pictures), bits(&fresh));
}

#[test]
fn every_instruction_set_of_this_machine_agrees() {
    let scene = Scene::random(10, 5000, 4);
    let views = [front_view(96, 64)];
    let settings = RasterSettings::default();
    let mut rasterizer = CpuRasterizer::new(settings).unwrap();
    let vector = rasterizer.render(&scene.splats(), &views).unwrap();
    rasterizer.isa = Isa::Portable;
    let portable = rasterizer.render(&scene.splats(), &views).unwrap();
    let slow = reference::render_with_fragile(&settings, &scene.splats(), &views).unwrap();
    for (pixel, &fragile) in slow[0].1.iter().enumerate() {
        for picture in [&vector[0], &portable[0]] {
            let error = (picture.alpha[pixel] - slow[0].0.alpha[pixel]).abs();
            assert!(fragile || error <= TOLERANCE, "pixel {pixel}: {error}");
        }
    }
}
