//! The backward pass against central differences of the reference.

use super::super::*;
use super::gradients::{errors, random_upstream, tensors};
use super::scenes::{Scene, front_view, turned_view};
use crate::camera::View;
use proptest::prelude::*;

/// Against central differences, as a share of the largest entry of the kind in the scene: f32 sums, and the
/// rounding of the expected depth over a faint pixel's alpha. Measured 3e-4 over 3000 scenes.
const DIFFERENCE_TOLERANCE: f64 = 1e-3;
/// Entries this small are sums over hundreds of pixels of random upstream up to 1 that have cancelled: not a scale.
const DIFFERENCE_FLOOR: f64 = 0.1;
/// Slopes over two step lengths that differ by more than this share of the largest entry belong to a jump.
const JUMP: f32 = 1e-3;

/// The loss of exact pictures.
fn loss(pictures: &[reference::ExactPicture], upstream: &[PictureGradient]) -> f64 {
    let dot = |g: &[f32], x: &[f64]| g.iter().zip(x).map(|(&g, x)| f64::from(g) * x).sum::<f64>();
    let parts = pictures.iter().zip(upstream);
    parts.map(|(p, g)| dot(&g.features, &p.features) + dot(&g.alpha, &p.alpha) + dot(&g.depth, &p.depth)).sum()
}

/// Sets the upstream to 0 where a decision of f64 is so close that a step or f32 may turn it.
pub(super) fn calm(upstream: &mut [PictureGradient], exact: &[reference::ExactPicture], feature_count: usize) {
    for (gradient, picture) in upstream.iter_mut().zip(exact) {
        for (pixel, _) in picture.fragile.iter().enumerate().filter(|(_, f)| **f) {
            gradient.features[pixel * feature_count..(pixel + 1) * feature_count].fill(0.0);
            gradient.alpha[pixel] = 0.0;
            gradient.depth[pixel] = 0.0;
        }
    }
}

/// One number of a scene, and how far to step it.
type Parameter = fn(&mut Scene, usize, usize) -> (&mut f32, f32);

/// Central differences of the reference, in the order of [`tensors`], against the gradients of the fast version.
fn compare_with_differences(settings: RasterSettings, scene: &Scene, views: &[View], seed: u64) {
    let exact = |scene: &Scene| -> Vec<_> {
        views.iter().map(|view| reference::render_exact(&settings, &scene.splats(), view)).collect()
    };
    let mut rasterizer = CpuRasterizer::new(settings).unwrap();
    let pictures = rasterizer.render(&scene.splats(), views).unwrap();
    let mut upstream = random_upstream(seed, &pictures);
    calm(&mut upstream, &exact(scene), scene.feature_count);
    let gradients = rasterizer.backward(&scene.splats(), views, &pictures, &upstream).unwrap();
    assert_eq!(gradients.overflowed, 0);
    let parameters: [(usize, Parameter); 5] = [
        (3, |s, i, k| {
            let z = s.means[i][2].abs();
            (&mut s.means[i][k], 4e-6 * z)
        }),
        (4, |s, i, k| (&mut s.quats[i][k], 4e-6)),
        (3, |s, i, k| {
            let size = s.scales[i].iter().fold(0.0f32, |a, &x| a.max(x));
            (&mut s.scales[i][k], 4e-6 * size)
        }),
        (1, |s, i, _| {
            // Not so far that a pixel crosses 1/255.
            let opacity = s.opacities[i];
            (&mut s.opacities[i], 4e-6 * opacity)
        }),
        (scene.feature_count, |s, i, k| {
            let at = i * s.feature_count + k;
            (&mut s.features[at], 1e-3)
        }),
    ];
    for ((width, parameter), (name, got)) in parameters.into_iter().zip(tensors(&gradients)) {
        let slope = |at: usize, share: f32| {
            let loss_at = |sign: f32| {
                let mut moved = scene.clone();
                let (value, step) = parameter(&mut moved, at / width, at % width);
                *value += sign * share * step;
                let value = f64::from(*value);
                (value, loss(&exact(&moved), &upstream))
            };
            let ((high, loss_high), (low, loss_low)) = (loss_at(1.0), loss_at(-1.0));
            ((loss_high - loss_low) / (high - low)) as f32
        };
        let slopes = |share: f32| -> Vec<f32> { (0..scene.means.len() * width).map(|at| slope(at, share)).collect() };
        let (want, check) = (slopes(1.0), slopes(0.25));
        // A step across a jump (a near plane, a tile's edge) gives a slope that grows as the step shrinks.
        let scale = check.iter().fold(0.0f32, |a, x| a.max(x.abs()));
        let jumps: Vec<bool> = want.iter().zip(&check).map(|(a, b)| (a - b).abs() > JUMP * scale).collect();
        let smooth = |values: &[f32]| -> Vec<f32> {
            values.iter().zip(&jumps).filter(|(_, jump)| !**jump).map(|(value, _)| *value).collect()
        };
        let skipped = jumps.iter().filter(|j| **j).count();
        assert!(skipped <= 1 + want.len() / 10, "{name}: {skipped} of {} entries have no slope", want.len());
        let (got, want) = (smooth(got), smooth(&want));
        let (largest, rms) = errors(&got, &want, DIFFERENCE_FLOOR);
        println!("{name}: largest {largest:.1e}, root of squares {rms:.1e} of {}, {skipped} jump", want.len());
        assert!(largest <= DIFFERENCE_TOLERANCE, "{name}: {largest:e}\n got {got:?}\nwant {want:?}");
    }
}

/// Gaussians in front of the camera with opacities clear of the cap, where the loss has a corner, and of 0: a scene of
/// nothing but faint splats has no gradient to speak of but the rounding of the expected depth over its alpha.
fn smooth_scene(seed: u64, n: usize, channels: usize) -> Scene {
    let mut scene = Scene::random(seed, n, channels);
    for (mean, opacity) in scene.means.iter_mut().zip(&mut scene.opacities) {
        mean[2] = mean[2].max(0.5);
        *opacity = opacity.clamp(0.05, 0.95);
    }
    scene
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn gradients_are_the_slopes_of_the_reference(
        seed in any::<u64>(),
        n in 1usize..14,
        channels in 0usize..4,
        width in 1usize..50,
        height in 1usize..24,
        latest in any::<bool>(),
        yaw in -0.6f32..0.6,
    ) {
        let convention = if latest { Convention::Latest } else { Convention::Pinned };
        let settings = RasterSettings { convention, ..RasterSettings::default() };
        let mut scene = smooth_scene(seed, n, channels);
        // Larger than life, so that they overlap, cross tiles and finish pixels.
        scene.scales.iter_mut().flatten().for_each(|s| *s *= 4.0);
        compare_with_differences(settings, &scene, &[front_view(width, height), turned_view(height, width, yaw)], seed ^ 1);
    }
}

#[test]
fn gradients_beside_an_off_centre_picture_follow_each_convention() {
    // Principal point at the left edge: these lie beyond the pinned clamp and inside the latest one, or beyond both.
    let mut view = front_view(40, 24);
    (view.intrinsics.fx, view.intrinsics.cx) = (40.0, 0.0);
    let mut scene = smooth_scene(3, 6, 2);
    for (i, (mean, scale)) in scene.means.iter_mut().zip(&mut scene.scales).enumerate() {
        *mean = [(0.3 + 0.2 * i as f32) * 5.0, 0.1, 5.0 + 0.1 * i as f32];
        *scale = [0.5, 0.3, 0.8];
    }
    for convention in [Convention::Pinned, Convention::Latest] {
        compare_with_differences(RasterSettings { convention, ..Default::default() }, &scene, &[view], 4);
    }
}

#[test]
fn gradients_hold_where_opaque_splats_fill_the_pixels() {
    let mut scene = smooth_scene(15, 20, 3);
    scene.scales.iter_mut().flatten().for_each(|s| *s *= 40.0);
    scene.opacities.iter_mut().for_each(|o| *o = 0.85 + 0.1 * *o);
    let views = [front_view(40, 24), turned_view(24, 20, 0.2)];
    let pictures = CpuRasterizer::new(RasterSettings::default()).unwrap().render(&scene.splats(), &views).unwrap();
    let alphas = pictures.iter().flat_map(|p| &p.alpha);
    let full = alphas.clone().filter(|&&a| a > 0.995).count();
    assert!(2 * full > alphas.count(), "{full} full pixels");
    compare_with_differences(RasterSettings::default(), &scene, &views, 16);
}
