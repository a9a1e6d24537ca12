//! Hostile and degenerate input: nothing panics, nothing comes out that is not finite, nothing goes uncounted.

use super::super::*;
use super::scenes::{Scene, front_view, turned_view};
use crate::camera::View;
use glam::{Mat3A, Vec3A};
use proptest::prelude::*;

fn both() -> [RasterSettings; 2] {
    [Convention::Pinned, Convention::Latest].map(|convention| RasterSettings { convention, ..Default::default() })
}

fn assert_finite(picture: &Picture) {
    assert_eq!(picture.features.len(), picture.width * picture.height * picture.feature_count);
    assert!(picture.features.iter().chain(&picture.alpha).chain(&picture.depth).all(|x| x.is_finite()));
    assert!(picture.alpha.iter().all(|a| (0.0..=1.0).contains(a)));
}

/// Renders with every convention, checks that all is finite and every splat accounted for; returns the pinned result.
fn render(scene: &Scene, views: &[View]) -> (Vec<Picture>, RasterStats) {
    let mut results = both().map(|settings| {
        let mut rasterizer = CpuRasterizer::new(settings).unwrap();
        let pictures = rasterizer.render(&scene.splats(), views).unwrap();
        assert_eq!(pictures.len(), views.len());
        pictures.iter().for_each(assert_finite);
        let stats = rasterizer.stats();
        assert_eq!(stats.splats, scene.means.len());
        assert_eq!(stats.culled + stats.visible, (stats.splats - stats.invalid) * views.len());
        let slow = reference::render(&settings, &scene.splats(), views).unwrap();
        slow.iter().for_each(assert_finite);
        (pictures, stats)
    });
    std::mem::take(&mut results[0])
}

#[test]
fn invalid_splats_are_skipped_and_counted() {
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let good = Scene::copies(1, 2);
    let view = [front_view(40, 30)];
    let (expected, _) = render(&good, &view);
    let mut scene = Scene::copies(1, 2);
    let mut push = |edit: &dyn Fn(&mut Scene)| {
        let mut one = Scene::copies(1, 2);
        // In front of the good one: it would hide it.
        one.means[0][2] = 4.0;
        edit(&mut one);
        scene.means.extend(one.means);
        scene.quats.extend(one.quats);
        scene.scales.extend(one.scales);
        scene.opacities.extend(one.opacities);
        scene.features.extend(one.features);
    };
    push(&|s| s.quats[0] = [0.0; 4]);
    for value in bad {
        for axis in 0..3 {
            push(&|s| s.means[0][axis] = value);
            push(&|s| s.scales[0][axis] = value);
        }
        for axis in 0..4 {
            push(&|s| s.quats[0][axis] = value);
        }
        for channel in 0..2 {
            push(&|s| s.features[channel] = value);
        }
        push(&|s| s.opacities[0] = value);
    }
    let (pictures, stats) = render(&scene, &view);
    assert_eq!(stats.invalid, scene.means.len() - 1);
    assert_eq!(pictures, expected);
}

#[test]
fn extreme_but_finite_numbers_stay_finite() {
    let extremes = [0.0, 1e-45, 1e-9, 1e9, 1e20, f32::MAX, -1.0, -1e20];
    let mut scene = Scene::copies(0, 1);
    let mut rng_seed = 0;
    for &a in &extremes {
        for &b in &extremes {
            rng_seed += 1;
            let mut one = Scene::random(rng_seed, 1, 1);
            one.scales[0] = [a, b, 0.1];
            scene.means.push(one.means[0]);
            scene.means.push([a, 0.0, b]);
            scene.quats.extend([[a, b, 1e-30, 0.0], one.quats[0]]);
            scene.scales.extend([one.scales[0], [b, a, a]]);
            scene.opacities.extend([a, b]);
            scene.features.extend([f32::MAX, a]);
        }
    }
    let (_, stats) = render(&scene, &[front_view(33, 17), turned_view(20, 40, 0.5)]);
    // Only a = b = 0 still has an orientation (1e-30).
    assert_eq!(stats.invalid, 0);
}

#[test]
fn points_without_extent_show_as_the_blur() {
    let mut scene = Scene::copies(3, 1);
    scene.scales = vec![[0.0; 3], [1e-9; 3], [1e-30, 0.0, 0.0]];
    let (pictures, stats) = render(&scene, &[front_view(32, 32)]);
    assert_eq!(stats.visible, 3);
    let peak = pictures[0].alpha.iter().fold(0.0f32, |a, &b| a.max(b));
    assert!(peak > 0.5, "{peak}");
}

#[test]
fn singular_covariances_without_blur_are_culled_or_finite() {
    let mut scene = Scene::random(3, 200, 1);
    for (i, scale) in scene.scales.iter_mut().enumerate() {
        *scale = [[0.0; 3], [0.1, 0.0, 0.0], [1e-20, 1e-20, 1e-20], [1.0, 1e-9, 0.0]][i % 4];
    }
    for settings in both().map(|s| RasterSettings { blur: 0.0, ..s }) {
        let mut rasterizer = CpuRasterizer::new(settings).unwrap();
        rasterizer.render(&scene.splats(), &[front_view(40, 40)]).unwrap().iter().for_each(assert_finite);
    }
}

#[test]
fn splats_on_and_behind_the_camera_plane_are_culled() {
    let mut scene = Scene::copies(6, 1);
    let depths = [0.0, -0.0, 1e-30, -5.0, 0.19, 400.1];
    for (mean, z) in scene.means.iter_mut().zip(depths) {
        mean[2] = z;
    }
    let (_, stats) = render(&scene, &[front_view(32, 32)]);
    assert_eq!((stats.visible, stats.culled), (0, 6));
    // Both planes themselves are kept.
    scene.means.truncate(2);
    (scene.means[0][2], scene.means[1][2]) = (0.2, 400.0);
    let scene = Scene { means: scene.means, ..Scene::copies(2, 1) };
    assert_eq!(render(&scene, &[front_view(32, 32)]).1.visible, 2);
}

#[test]
fn one_splat_can_cover_the_whole_picture() {
    let mut scene = Scene::copies(1, 3);
    scene.scales[0] = [1e6; 3];
    let (pictures, stats) = render(&scene, &[front_view(70, 50)]);
    assert!(pictures[0].alpha.iter().all(|a| (a - 0.5).abs() < 1e-3));
    assert!(pictures[0].depth.iter().all(|d| (d - 5.0).abs() < 1e-4));
    assert_eq!(stats.pairs, 3 * 4);
}

#[test]
fn a_million_splats_at_one_point() {
    let scene = Scene::copies(1_000_000, 1);
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let pictures = rasterizer.render(&scene.splats(), &[front_view(64, 48)]).unwrap();
    assert_finite(&pictures[0]);
    assert_eq!(rasterizer.stats().visible, 1_000_000);
    let centre = 20 * 64 + 35;
    // 0.5^13 > 1e-4 >= 0.5^14: thirteen splats of nearly 0.5 each are blended before the pixel is full.
    assert!(pictures[0].alpha[centre] > 0.999, "{}", pictures[0].alpha[centre]);
    assert!((pictures[0].features[centre] / pictures[0].alpha[centre] - 0.25).abs() < 1e-5);
}

#[test]
fn nothing_in_gives_an_empty_picture() {
    let (pictures, stats) = render(&Scene::copies(0, 3), &[front_view(20, 10)]);
    assert!(pictures[0].features.iter().chain(&pictures[0].alpha).chain(&pictures[0].depth).all(|&x| x == 0.0));
    assert_eq!(stats, RasterStats::default());
    let (pictures, _) = render(&Scene::copies(5, 3), &[]);
    assert!(pictures.is_empty());
}

#[test]
fn any_picture_size_works() {
    for (width, height) in [(1, 1), (1, 100), (100, 1), (31, 15), (32, 16), (33, 17), (65, 47)] {
        let scene = Scene::random(4, 500, 2);
        let (pictures, _) = render(&scene, &[front_view(width, height)]);
        assert_eq!((pictures[0].width, pictures[0].height), (width, height));
    }
}

#[test]
fn arrays_that_disagree_are_refused() {
    let scene = Scene::copies(4, 3);
    let view = [front_view(8, 8)];
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    let good = scene.splats();
    let broken = [
        ("quats", Splats { quats: &good.quats[1..], ..good }),
        ("scales", Splats { scales: &good.scales[1..], ..good }),
        ("opacities", Splats { opacities: &good.opacities[1..], ..good }),
        ("features", Splats { features: &good.features[1..], ..good }),
        ("features", Splats { feature_count: MAX_FEATURES, ..good }),
    ];
    for (array, splats) in broken {
        match rasterizer.render(&splats, &view) {
            Err(RasterError::Length { name, splats: 4, .. }) => assert_eq!(name, array),
            other => panic!("{array}: {other:?}"),
        }
    }
}

#[test]
fn cameras_that_cannot_see_are_refused() {
    let scene = Scene::copies(1, 1);
    let good = front_view(8, 8);
    let mut bad = vec![];
    for edit in [
        |v: &mut View| v.intrinsics.width = 0,
        |v: &mut View| v.intrinsics.height = 0,
        |v: &mut View| v.intrinsics.width = usize::MAX,
        |v: &mut View| v.intrinsics.fx = f32::NAN,
        |v: &mut View| v.intrinsics.fy = 0.0,
        |v: &mut View| v.intrinsics.cx = f32::INFINITY,
        |v: &mut View| v.camera_from_world.translation = Vec3A::new(0.0, f32::NAN, 0.0),
        |v: &mut View| v.camera_from_world.matrix3 = Mat3A::ZERO,
        |v: &mut View| v.camera_from_world.matrix3 = Mat3A::from_diagonal(glam::Vec3::new(1.0, 1.0, 1.1)),
        |v: &mut View| v.camera_from_world.matrix3.x_axis.x = f32::INFINITY,
    ] {
        let mut view = good;
        edit(&mut view);
        bad.push(view);
    }
    let mut rasterizer = CpuRasterizer::new(RasterSettings::default()).unwrap();
    for view in bad {
        let result = rasterizer.render(&scene.splats(), &[good, view]);
        assert!(matches!(result, Err(RasterError::View { view: 1, .. })), "{view:?}: {result:?}");
    }
    let none = Scene::copies(0, 0);
    let wide = Splats { feature_count: usize::MAX, ..none.splats() };
    assert!(matches!(rasterizer.render(&wide, &[]), Err(RasterError::TooMany { name: "channels", .. })));
    let wide = Splats { feature_count: MAX_FEATURES, ..none.splats() };
    let large = rasterizer.render(&wide, &[front_view(MAX_SIDE, 9)]);
    assert!(matches!(large, Err(RasterError::View { view: 0, .. })), "a picture too large to hold: {large:?}");
    assert!(rasterizer.render(&none.splats(), &vec![good; MAX_VIEWS + 1]).is_err());
    assert!(CpuRasterizer::new(RasterSettings { near: f32::NAN, ..Default::default() }).is_err());
}

/// Any bit pattern.
fn any_f32() -> impl Strategy<Value = f32> {
    any::<u32>().prop_map(f32::from_bits)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
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
        for settings in both() {
            let mut rasterizer = CpuRasterizer::new(RasterSettings { blur, ..settings }).unwrap();
            let pictures = rasterizer.render(&scene.splats(), &[front_view(40, 20)]).unwrap();
            pictures.iter().for_each(assert_finite);
            let stats = rasterizer.stats();
            prop_assert_eq!(stats.invalid + stats.culled + stats.visible, stats.splats);
        }
    }
}
