//! What tells the two conventions apart, seen in pictures.

use super::backends::each;
use super::scenes::{Scene, both_conventions, front_view};
use storm_render::raster::{ALPHA_MIN, Convention};

#[test]
fn alpha_is_capped_at_999_and_99() {
    let mut scene = Scene::copies(1, 1);
    (scene.opacities[0], scene.scales[0]) = (1.0, [100.0; 3]);
    for settings in both_conventions() {
        each(settings, |backend| {
            let picture = backend.renderer.render(&scene.splats(), &[front_view(32, 32)]).unwrap().remove(0);
            assert!((picture.alpha[16 * 32 + 16] - settings.convention.alpha_cap()).abs() < 1e-6);
        });
    }
}

#[test]
fn latest_culls_what_is_fainter_than_1_255() {
    for (opacity, in_latest) in [(0.9 / 255.0, 0), (1.1 / 255.0, 1)] {
        let mut scene = Scene::copies(1, 1);
        scene.opacities[0] = opacity;
        for settings in both_conventions() {
            let expected = if settings.convention == Convention::Latest { in_latest } else { 1 };
            each(settings, |backend| {
                backend.renderer.render(&scene.splats(), &[front_view(32, 32)]).unwrap();
                assert_eq!(backend.renderer.stats().visible, expected, "{opacity} {}", backend.renderer.describe());
            });
        }
    }
}

#[test]
fn pinned_cuts_at_its_square_and_latest_does_not() {
    // The ellipse of alpha >= 1/255 reaches 3.3 deviations; three deviations end at a 16-pixel tile edge, at 48.
    let mut scene = Scene::copies(1, 0);
    (scene.opacities[0], scene.scales[0]) = (1.0, [0.5; 3]);
    let mut view = front_view(64, 16);
    (view.intrinsics.fx, view.intrinsics.fy) = (80.0, 80.0);
    (view.intrinsics.cx, view.intrinsics.cy) = (23.0, 8.0);
    for settings in both_conventions() {
        each(settings, |backend| {
            let alpha = backend.renderer.render(&scene.splats(), &[view]).unwrap().remove(0).alpha;
            let (inside, outside) = (alpha[8 * 64 + 47], alpha[8 * 64 + 48]);
            assert!(inside > 0.0);
            match settings.convention {
                Convention::Pinned => assert_eq!(outside, 0.0),
                Convention::Latest => assert!(outside > ALPHA_MIN),
            }
        });
    }
}
