//! Hostile and degenerate Gaussians: nothing panics, nothing comes out that is not finite, nothing goes uncounted.

use super::backends::{Backend, each};
use super::scenes::{Kind, Scene, assert_finite, bits, both_conventions, front_view, turned_view};
use proptest::prelude::*;
use storm_render::View;
use storm_render::raster::{Picture, RasterSettings, RasterStats};

/// Renders, checks that all is finite and every splat accounted for.
fn render(backend: &mut Backend, scene: &Scene, views: &[View]) -> (Vec<Picture>, RasterStats) {
    let pictures = backend.renderer.render(&scene.splats(), views).unwrap();
    assert_eq!(pictures.len(), views.len());
    pictures.iter().for_each(assert_finite);
    let stats = backend.renderer.stats();
    assert_eq!(stats.splats, scene.means.len());
    assert_eq!(stats.culled + stats.visible, (stats.splats - stats.invalid) * views.len());
    (pictures, stats)
}

#[test]
fn invalid_splats_are_skipped_and_counted() {
    let good = Scene::copies(1, 2);
    let view = [front_view(40, 30)];
    let mut scene = good.clone();
    let mut push = |edit: &dyn Fn(&mut Scene)| {
        let mut one = good.clone();
        // In front of the good one: it would hide it.
        one.means[0][2] = 4.0;
        edit(&mut one);
        scene.push(one);
    };
    push(&|s| s.quats[0] = [0.0; 4]);
    push(&|s| s.quats[0] = [-0.0; 4]);
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for axis in 0..3 {
            push(&|s| s.means[0][axis] = value);
            push(&|s| s.scales[0][axis] = value);
        }
        (0..4).for_each(|axis| push(&|s| s.quats[0][axis] = value));
        (0..2).for_each(|channel| push(&|s| s.features[channel] = value));
        push(&|s| s.opacities[0] = value);
    }
    for settings in both_conventions() {
        each(settings, |backend| {
            let (expected, _) = render(backend, &good, &view);
            let (pictures, stats) = render(backend, &scene, &view);
            assert_eq!(stats.invalid, scene.means.len() - 1);
            assert_eq!(bits(&pictures), bits(&expected));
        });
    }
}

#[test]
fn quaternions_of_any_length_turn_alike() {
    let mut scene = Scene::copies(1, 1);
    scene.scales[0] = [0.5, 0.05, 0.02];
    let q = [0.5f32, 0.25, -0.75, 1.0];
    each(RasterSettings::default(), |backend| {
        let mut at = |size: f32| {
            scene.quats[0] = q.map(|x| x * size);
            render(backend, &scene, &[front_view(64, 64)]).0.remove(0)
        };
        let unit = at(1.0);
        for size in [1e-30, 1e-20, 1e20, 1e38, f32::MIN_POSITIVE] {
            let other = at(size);
            let worst = unit.alpha.iter().zip(&other.alpha).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-4, "{size:e}: {worst}");
        }
    });
}

#[test]
fn extreme_but_finite_numbers_stay_finite() {
    let extremes = [0.0, 1e-45, 1e-9, 1e9, 1e20, f32::MAX, -1.0, -1e20];
    let mut scene = Scene::copies(0, 1);
    for (i, &a) in extremes.iter().enumerate() {
        for (j, &b) in extremes.iter().enumerate() {
            let mut one = Scene::random((8 * i + j) as u64, Kind::Mixed, 2, 1);
            one.scales = vec![[a, b, 0.1], [b, a, a]];
            one.means[1] = [a, 0.0, b];
            one.quats[0] = [a, b, 1e-30, 0.0];
            one.opacities = vec![a, b];
            one.features = vec![f32::MAX, a];
            scene.push(one);
        }
    }
    for settings in both_conventions() {
        each(settings, |backend| {
            let (_, stats) = render(backend, &scene, &[front_view(33, 17), turned_view(20, 40, 0.5)]);
            assert_eq!(stats.invalid, 0);
        });
    }
}

#[test]
fn singular_covariances_without_blur_are_culled_or_finite() {
    let mut scene = Scene::random(3, Kind::Mixed, 200, 1);
    for (i, scale) in scene.scales.iter_mut().enumerate() {
        *scale = [[0.0; 3], [0.1, 0.0, 0.0], [1e-20, 1e-20, 1e-20], [1.0, 1e-9, 0.0]][i % 4];
    }
    for settings in both_conventions() {
        each(RasterSettings { blur: 0.0, ..settings }, |backend| {
            render(backend, &scene, &[front_view(40, 40)]);
        });
    }
}

#[test]
fn points_without_extent_show_as_the_blur() {
    let mut scene = Scene::copies(3, 1);
    scene.scales = vec![[0.0; 3], [1e-9; 3], [1e-30, 0.0, 0.0]];
    each(RasterSettings::default(), |backend| {
        let (pictures, stats) = render(backend, &scene, &[front_view(32, 32)]);
        assert_eq!(stats.visible, 3);
        assert!(pictures[0].alpha.iter().any(|&a| a > 0.5));
    });
}

#[test]
fn splats_on_and_behind_the_camera_plane_are_culled() {
    let mut outside = Scene::copies(6, 1);
    for (mean, z) in outside.means.iter_mut().zip([0.0, -0.0, 1e-30, -5.0, 0.19, 400.1]) {
        mean[2] = z;
    }
    let mut planes = Scene::copies(2, 1);
    (planes.means[0][2], planes.means[1][2]) = (0.2, 400.0);
    each(RasterSettings::default(), |backend| {
        let (_, stats) = render(backend, &outside, &[front_view(32, 32)]);
        assert_eq!((stats.visible, stats.culled), (0, 6));
        // Both planes themselves are kept.
        assert_eq!(render(backend, &planes, &[front_view(32, 32)]).1.visible, 2);
    });
}

#[test]
fn one_splat_can_cover_the_whole_picture() {
    for size in [1e6, 1e12] {
        let mut scene = Scene::copies(1, 3);
        scene.scales[0] = [size; 3];
        each(RasterSettings::default(), |backend| {
            let (pictures, stats) = render(backend, &scene, &[front_view(70, 50)]);
            assert!(pictures[0].alpha.iter().all(|a| (a - 0.5).abs() < 1e-3));
            assert!(pictures[0].depth.iter().all(|d| (d - 5.0).abs() < 1e-4));
            assert_eq!(stats.visible, 1);
        });
    }
}

#[test]
fn very_many_splats_at_one_point() {
    let n = 30_000;
    let mut scene = Scene::copies(n, 1);
    // Equal depths blend in index order: the first few are what is seen.
    scene.features = (0..n).map(|i| if i < 20 { 1.0 } else { 0.0 }).collect();
    each(RasterSettings::default(), |backend| {
        let (pictures, stats) = render(backend, &scene, &[front_view(64, 48)]);
        assert_eq!(stats.visible, n);
        let centre = 20 * 64 + 35;
        let (alpha, color) = (pictures[0].alpha[centre], pictures[0].features[centre]);
        // About 0.5^13 is left when the pixel is full.
        assert!(alpha > 0.999 && (color / alpha - 1.0).abs() < 1e-4, "{alpha} {color}");
    });
}

#[test]
fn nothing_in_gives_empty_pictures() {
    each(RasterSettings::default(), |backend| {
        let (pictures, stats) = render(backend, &Scene::copies(0, 3), &[front_view(20, 10)]);
        assert!(bits(&pictures).iter().all(|&b| b == 0));
        assert_eq!(stats, RasterStats::default());
        assert!(render(backend, &Scene::copies(5, 3), &[]).0.is_empty());
        let mut behind = Scene::copies(5, 3);
        behind.means.iter_mut().for_each(|mean| mean[2] = -5.0);
        assert!(bits(&render(backend, &behind, &[front_view(20, 10)]).0).iter().all(|&b| b == 0));
    });
}

/// Any bit pattern.
fn any_f32() -> impl Strategy<Value = f32> {
    any::<u32>().prop_map(f32::from_bits)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn any_bits_in_only_finite_numbers_out(
        numbers in prop::collection::vec(prop::collection::vec(prop_oneof![any_f32(), -3.0f32..3.0, Just(0.5f32)], 13), 0..40),
        blur in 0.0f32..1.0,
    ) {
        let mut scene = Scene::copies(0, 2);
        for v in &numbers {
            scene.means.push([v[0], v[1], v[2]]);
            scene.quats.push([v[3], v[4], v[5], v[6]]);
            scene.scales.push([v[7], v[8], v[9]]);
            scene.opacities.push(v[10]);
            scene.features.extend([v[11], v[12]]);
        }
        for settings in both_conventions() {
            let mut invalid = Vec::new();
            each(RasterSettings { blur, ..settings }, |backend| {
                invalid.push(render(backend, &scene, &[front_view(40, 20)]).1.invalid);
            });
            prop_assert!(invalid.iter().all(|&count| count == invalid[0]), "{:?}", invalid);
        }
    }
}
