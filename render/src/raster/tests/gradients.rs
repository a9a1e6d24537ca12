//! The backward pass: goldens, finite differences of the reference, what must be zero, threads, and wrong requests.

use super::super::*;
use super::golden::Golden;
use super::scenes::{Scene, front_view, turned_view};
use crate::camera::View;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Against f64, for each tensor: the largest difference as a share of the largest entry, and the root of the summed
/// squares of the differences as a share of the tensor's own. Measured 2e-6; 1e-3 is what was asked for.
const GOLDEN_TOLERANCE: f64 = 2e-5;
/// Share of a tensor's largest entry below which numbers are rounding (a ball's orientation matters to nothing).
const NOISE: f64 = 1e-9;
/// Against central differences, as a share of the largest entry of the kind in the scene: f32 sums, and the
/// rounding of the expected depth over a faint pixel's alpha. Measured 3e-4 over 3000 scenes.
const DIFFERENCE_TOLERANCE: f64 = 1e-3;
/// Entries this small are sums over hundreds of pixels of random upstream up to 1 that have cancelled: not a scale.
const DIFFERENCE_FLOOR: f64 = 0.1;
/// Slopes over two step lengths that differ by more than this share of the largest entry belong to a jump.
const JUMP: f32 = 1e-3;
/// Between two f32 runs that add in another order.
const ORDER_TOLERANCE: f64 = 1e-4;

/// Upstream of random numbers in -1 to 1.
fn random_upstream(seed: u64, pictures: &[Picture]) -> Vec<PictureGradient> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut values = |n: usize| (0..n).map(|_| rng.random_range(-1.0f32..1.0)).collect::<Vec<_>>();
    pictures
        .iter()
        .map(|p| PictureGradient {
            features: values(p.features.len()),
            alpha: values(p.alpha.len()),
            depth: values(p.depth.len()),
        })
        .collect()
}

/// The five arrays, flat, by name.
fn tensors(g: &SplatGradients) -> [(&'static str, &[f32]); 5] {
    [
        ("means", g.means.as_flattened()),
        ("quats", g.quats.as_flattened()),
        ("scales", g.scales.as_flattened()),
        ("opacities", &g.opacities),
        ("features", &g.features),
    ]
}

/// Largest difference over largest entry, and root of summed squares of the difference over that of `want`.
/// Both scales are at least `floor`.
fn errors(got: &[f32], want: &[f32], floor: f64) -> (f64, f64) {
    assert_eq!(got.len(), want.len());
    let (mut worst, mut largest, mut square, mut total) = (0.0f64, floor, 0.0, floor * floor);
    for (&g, &w) in got.iter().zip(want) {
        let (difference, w) = ((f64::from(g) - f64::from(w)).abs(), f64::from(w));
        worst = worst.max(difference);
        largest = largest.max(w.abs());
        square += difference * difference;
        total += w * w;
    }
    (worst / largest, (square / total).sqrt())
}

fn run(settings: RasterSettings, scene: &Scene, views: &[View], seed: u64) -> SplatGradients {
    let mut rasterizer = CpuRasterizer::new(settings).unwrap();
    let pictures = rasterizer.render(&scene.splats(), views).unwrap();
    let upstream = random_upstream(seed, &pictures);
    rasterizer.backward(&scene.splats(), views, &pictures, &upstream).unwrap()
}

#[test]
fn golden_gradients_match() {
    let golden = Golden::open("raster_grad");
    let views = golden.views(48, 32);
    assert_eq!(views.len(), 2);
    let upstream: Vec<PictureGradient> = (0..2)
        .map(|v| {
            let part =
                |name: &str| golden.f32s(name).chunks_exact(golden.f32s(name).len() / 2).nth(v).unwrap().to_vec();
            PictureGradient {
                features: part("upstream_image"),
                alpha: part("upstream_alpha"),
                depth: part("upstream_depth"),
            }
        })
        .collect();
    for isa in [Isa::detect(), Isa::Portable] {
        let gradients = golden.with_splats(|splats| {
            let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
            rasterizer.isa = isa;
            let pictures = rasterizer.render(splats, &views).unwrap();
            rasterizer.backward(splats, &views, &pictures, &upstream).unwrap()
        });
        assert_eq!(gradients.overflowed, 0);
        let kinds = golden.u8s("kind");
        for (name, got) in tensors(&gradients) {
            let want =
                golden.f32s(if name == "features" { "grad_colors".into() } else { format!("grad_{name}") }.as_str());
            let scale = want.iter().fold(0.0f64, |a, &x| a.max(f64::from(x.abs())));
            let (largest, rms) = errors(got, &want, 1e-30);
            println!("{isa:?} {name}: largest {largest:.1e}, root of squares {rms:.1e}");
            assert!(largest <= GOLDEN_TOLERANCE && rms <= GOLDEN_TOLERANCE, "{name} {largest:e} {rms:e}");
            // Each kind by its own scale, so that a wrong rule for a faint kind cannot hide behind the strong ones.
            let row = want.len() / kinds.len();
            for kind in 0..10u8 {
                let of_kind = |values: &[f32]| -> Vec<f32> {
                    let rows = values.chunks_exact(row).zip(&kinds).filter(|(_, k)| **k == kind);
                    rows.flat_map(|(r, _)| r.to_vec()).collect()
                };
                let (largest, rms) = errors(&of_kind(got), &of_kind(&want), NOISE * scale);
                println!("   kind {kind}: largest {largest:.1e}, root of squares {rms:.1e}");
                assert!(
                    largest <= GOLDEN_TOLERANCE && rms <= GOLDEN_TOLERANCE,
                    "{name} kind {kind} {largest:e} {rms:e}"
                );
            }
        }
    }
}

/// The loss of exact pictures.
fn loss(pictures: &[reference::ExactPicture], upstream: &[PictureGradient]) -> f64 {
    let dot = |g: &[f32], x: &[f64]| g.iter().zip(x).map(|(&g, x)| f64::from(g) * x).sum::<f64>();
    let parts = pictures.iter().zip(upstream);
    parts.map(|(p, g)| dot(&g.features, &p.features) + dot(&g.alpha, &p.alpha) + dot(&g.depth, &p.depth)).sum()
}

/// Sets the upstream to 0 where a decision of f64 is so close that a step or f32 may turn it.
fn calm(upstream: &mut [PictureGradient], exact: &[reference::ExactPicture], feature_count: usize) {
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
fn a_capped_alpha_passes_nothing_on() {
    // Both discs cover the picture, the near one is capped everywhere.
    let mut scene = Scene::copies(2, 1);
    scene.scales = vec![[100.0; 3]; 2];
    (scene.opacities[0], scene.opacities[1]) = (1.0, 0.7);
    scene.means[1][2] = 6.0;
    let g = run(RasterSettings::default(), &scene, &[front_view(16, 16)], 1);
    assert_eq!((g.opacities[0], g.scales[0], g.quats[0]), (0.0, [0.0; 3], [0.0; 4]));
    assert_ne!(g.features[0], 0.0);
    assert_ne!(g.means[0][2], 0.0, "its depth still counts");
    assert_ne!(g.opacities[1], 0.0, "a thousandth of the light gets past");
}

#[test]
fn what_lies_behind_a_full_pixel_gets_nothing() {
    let mut scene = Scene::copies(5, 1);
    scene.scales = vec![[100.0; 3]; 5];
    scene.opacities = vec![0.97; 5];
    for (i, mean) in scene.means.iter_mut().enumerate() {
        mean[2] = 5.0 + i as f32;
    }
    let g = run(RasterSettings::default(), &scene, &[front_view(40, 20)], 1);
    // 0.03^3 < 1e-4 < 0.03^2: the third is left out.
    assert!(g.features[..2].iter().all(|&x| x != 0.0));
    assert!(g.features[2..].iter().chain(&g.opacities[2..]).all(|&x| x == 0.0));
    assert!(g.means[2..].iter().flatten().all(|&x| x == 0.0));
}

#[test]
fn no_upstream_gives_no_gradient() {
    let scene = Scene::random(12, 3000, 3);
    let views = [front_view(60, 40)];
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let pictures = rasterizer.render(&scene.splats(), &views).unwrap();
    let zeros =
        PictureGradient { features: vec![0.0; 60 * 40 * 3], alpha: vec![0.0; 60 * 40], depth: vec![0.0; 60 * 40] };
    for upstream in [zeros, PictureGradient::default()] {
        let g = rasterizer.backward(&scene.splats(), &views, &pictures, &[upstream]).unwrap();
        assert!(tensors(&g).iter().all(|(_, values)| values.iter().all(|&x| x == 0.0)));
        assert_eq!((g.means.len(), g.features.len()), (3000, 9000));
    }
}

#[test]
fn views_add_up_and_so_do_pictures() {
    let scene = Scene::random(13, 4000, 3);
    let views = [front_view(70, 50), turned_view(64, 33, 0.4), turned_view(33, 20, -0.3)];
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let pictures = rasterizer.render(&scene.splats(), &views).unwrap();
    let upstream = random_upstream(2, &pictures);
    let all = rasterizer.backward(&scene.splats(), &views, &pictures, &upstream).unwrap();
    let mut sums: [Vec<f32>; 5] = tensors(&all).map(|(_, values)| vec![0.0; values.len()]);
    for (view, gradient) in views.iter().zip(&upstream) {
        let parts = [
            PictureGradient { features: gradient.features.clone(), ..Default::default() },
            PictureGradient { alpha: gradient.alpha.clone(), ..Default::default() },
            PictureGradient { depth: gradient.depth.clone(), ..Default::default() },
        ];
        for part in parts {
            let picture = rasterizer.render(&scene.splats(), &[*view]).unwrap();
            let g = rasterizer.backward(&scene.splats(), &[*view], &picture, &[part]).unwrap();
            for (sum, (_, values)) in sums.iter_mut().zip(tensors(&g)) {
                sum.iter_mut().zip(values).for_each(|(s, v)| *s += v);
            }
        }
    }
    for ((name, got), want) in tensors(&all).iter().zip(&sums) {
        let (largest, rms) = errors(got, want, 1e-30);
        assert!(largest <= ORDER_TOLERANCE && rms <= ORDER_TOLERANCE, "{name} {largest:e} {rms:e}");
        assert!(want.iter().filter(|&&x| x != 0.0).count() > 1000, "{name}");
    }
}

#[test]
fn any_number_of_threads_gives_the_same_gradient_bits() {
    let scene = Scene::random(7, 30_000, 5);
    let views = [front_view(130, 90), turned_view(97, 61, 0.4), turned_view(64, 64, -0.3)];
    let runs = [1, 2, 4].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let g = pool.install(|| run(RasterSettings::default(), &scene, &views, 3));
        tensors(&g).map(|(_, values)| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>())
    });
    assert!(runs[0].iter().all(|bits| bits.iter().any(|&b| b != 0)));
    assert_eq!(runs[0], runs[1]);
    assert_eq!(runs[0], runs[2]);
}

#[test]
fn reused_gradients_leave_no_trace() {
    let (big, small) = (Scene::random(8, 9000, 4), Scene::random(9, 300, 2));
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let mut gradients = SplatGradients::default();
    for (scene, view) in [(&big, front_view(100, 80)), (&small, front_view(50, 30))] {
        let pictures = rasterizer.render(&scene.splats(), &[view]).unwrap();
        let upstream = random_upstream(5, &pictures);
        rasterizer.backward_into(&scene.splats(), &[view], &pictures, &upstream, &mut gradients).unwrap();
        assert_eq!(gradients, run(RasterSettings::default(), scene, &[view], 5));
    }
}

#[test]
fn every_instruction_set_gives_the_same_gradient() {
    let scene = Scene::random(10, 5000, 4);
    let views = [front_view(96, 64)];
    let [vector, portable] = [Isa::detect(), Isa::Portable].map(|isa| {
        let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
        rasterizer.isa = isa;
        let pictures = rasterizer.render(&scene.splats(), &views).unwrap();
        let mut upstream = random_upstream(6, &pictures);
        calm(&mut upstream, &[reference::render_exact(&rasterizer.settings, &scene.splats(), &views[0])], 4);
        rasterizer.backward(&scene.splats(), &views, &pictures, &upstream).unwrap()
    });
    for ((name, a), (_, b)) in tensors(&vector).iter().zip(tensors(&portable)) {
        let (largest, rms) = errors(a, b, 1e-30);
        assert!(largest <= ORDER_TOLERANCE && rms <= ORDER_TOLERANCE, "{name} {largest:e} {rms:e}");
    }
}

#[test]
fn gradients_of_hostile_scenes_are_finite() {
    let extremes = [0.0, 1e-45, 1e-9, 1e9, 1e20, f32::MAX, -1.0, -1e20, f32::NAN, f32::INFINITY];
    let mut scene = Scene::random(14, 300, 1);
    for (n, &a) in extremes.iter().enumerate() {
        for (m, &b) in extremes.iter().enumerate() {
            let one = Scene::random((n * 16 + m) as u64, 1, 1);
            scene.means.extend([one.means[0], [a, 0.0, b], [0.0, 0.0, 5.0], one.means[0]]);
            scene.quats.extend([[a, b, 1e-30, 0.0], one.quats[0], [a, 0.0, 0.0, b], one.quats[0]]);
            scene.scales.extend([[0.1; 3], [b, a, a], [a, b, 0.1], [1.0, a, b]]);
            scene.opacities.extend([a, b, 0.5, 0.9]);
            scene.features.extend([f32::MAX, a, 1.0, b]);
        }
    }
    for convention in [Convention::Pinned, Convention::Latest] {
        for blur in [0.3, 0.0] {
            let settings = RasterSettings { convention, blur, ..Default::default() };
            let g = run(settings, &scene, &[front_view(33, 17), turned_view(20, 40, 0.5)], 8);
            for (name, values) in tensors(&g) {
                assert!(values.iter().all(|x| x.is_finite()), "{name} {convention:?} blur {blur}");
                assert!(values.iter().any(|&x| x != 0.0), "{name}");
            }
        }
    }
    // Skipped Gaussians: exactly zero.
    let mut invalid = Scene::copies(4, 1);
    invalid.quats[0] = [0.0; 4];
    invalid.scales[1][0] = f32::NAN;
    invalid.features[2] = f32::INFINITY;
    let g = run(RasterSettings::default(), &invalid, &[front_view(20, 20)], 9);
    assert!(g.means[..3].iter().flatten().chain(g.quats[..3].iter().flatten()).all(|&x| x == 0.0));
    assert!(g.features[..3].iter().chain(&g.opacities[..3]).all(|&x| x == 0.0));
    assert_ne!(g.features[3], 0.0);
}

#[test]
fn requests_that_do_not_fit_are_refused() {
    let scene = Scene::copies(3, 2);
    let views = [front_view(8, 6)];
    let splats = scene.splats();
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let not_rendered =
        |r: Result<SplatGradients, RasterError>| assert!(matches!(r, Err(RasterError::NotRendered { .. })), "{r:?}");
    not_rendered(rasterizer.backward(&splats, &views, &[], &[]));
    let pictures = rasterizer.render(&splats, &views).unwrap();
    let upstream = random_upstream(1, &pictures);
    assert!(rasterizer.backward(&splats, &views, &pictures, &upstream).is_ok());
    let more = Scene::copies(4, 2);
    not_rendered(rasterizer.backward(&more.splats(), &views, &pictures, &upstream));
    let wider = Scene::copies(3, 3);
    not_rendered(rasterizer.backward(&wider.splats(), &views, &pictures, &upstream));
    not_rendered(rasterizer.backward(&splats, &[front_view(6, 8)], &pictures, &upstream));
    not_rendered(rasterizer.backward(&splats, &[], &pictures, &upstream));
    let refused = |r: Result<SplatGradients, RasterError>| assert!(matches!(r, Err(RasterError::View { .. })), "{r:?}");
    refused(rasterizer.backward(&splats, &views, &[], &upstream));
    refused(rasterizer.backward(&splats, &views, &pictures, &[]));
    refused(rasterizer.backward(&splats, &views, &[Picture::default()], &upstream));
    let edits: [fn(&mut PictureGradient); 5] = [
        |g| g.features.truncate(5),
        |g| g.alpha.push(0.0),
        |g| g.depth.truncate(1),
        |g| g.depth[3] = f32::NAN,
        |g| g.features[2] = f32::INFINITY,
    ];
    for edit in edits {
        let mut bad = upstream.clone();
        edit(&mut bad[0]);
        refused(rasterizer.backward(&splats, &views, &pictures, &bad));
    }
}
