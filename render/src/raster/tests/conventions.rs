//! What tells the two conventions apart, one rule at a time.

use super::super::*;
use super::properties::compare;
use super::scenes::{Scene, front_view};
use crate::camera::View;

const PINNED: RasterSettings =
    RasterSettings { convention: Convention::Pinned, near: 0.2, far: 400.0, radius_clip: 0.0, blur: 0.3 };
const LATEST: RasterSettings = RasterSettings { convention: Convention::Latest, ..PINNED };

fn render(settings: RasterSettings, scene: &Scene, view: View) -> Picture {
    CpuRasterizer::new(settings).unwrap().render(&scene.splats(), &[view]).unwrap().remove(0)
}

fn project_one(settings: RasterSettings, scene: &Scene, view: &View) -> Option<Projection> {
    CpuRasterizer::new(settings).unwrap().project(&scene.splats(), view).unwrap()[0]
}

#[test]
fn default_is_what_the_authors_render_with() {
    assert_eq!(RasterSettings::default(), PINNED);
}

#[test]
fn alpha_is_capped_at_999_and_99() {
    // One opaque disc over the whole picture.
    let mut scene = Scene::copies(1, 1);
    (scene.opacities[0], scene.scales[0]) = (1.0, [100.0; 3]);
    let at_centre = |settings| render(settings, &scene, front_view(32, 32)).alpha[16 * 32 + 16];
    assert!((at_centre(PINNED) - 0.999).abs() < 1e-6);
    assert!((at_centre(LATEST) - 0.99).abs() < 1e-6);
}

#[test]
fn latest_culls_what_is_fainter_than_1_255() {
    let mut scene = Scene::copies(1, 1);
    let view = front_view(32, 32);
    scene.opacities[0] = 0.9 / 255.0;
    assert!(project_one(PINNED, &scene, &view).is_some());
    assert!(project_one(LATEST, &scene, &view).is_none());
    scene.opacities[0] = 1.1 / 255.0;
    assert!(project_one(LATEST, &scene, &view).is_some());
}

#[test]
fn latest_rectangles_follow_shape_and_opacity() {
    // A bar ten times as long as high.
    let mut scene = Scene::copies(1, 1);
    scene.scales[0] = [1.0, 0.1, 0.1];
    let view = front_view(320, 320);
    let radius = |settings, opacity| {
        let mut scene = scene.clone();
        scene.opacities[0] = opacity;
        project_one(settings, &scene, &view).unwrap().radius
    };
    let square = radius(PINNED, 0.5);
    assert_eq!(square[0], square[1]);
    assert_eq!(square, radius(PINNED, 0.01));
    let (bright, faint) = (radius(LATEST, 0.999), radius(LATEST, 0.01));
    assert!(bright[0] > square[0], "3.33 deviations are more than 3: {bright:?} {square:?}");
    assert!(bright[1] < 0.3 * bright[0], "{bright:?}");
    assert!(faint[0] < 0.5 * bright[0], "{faint:?}");
}

#[test]
fn radius_clip_needs_both_sides_small_in_latest() {
    let mut scene = Scene::copies(1, 1);
    scene.scales[0] = [1.0, 0.001, 0.001];
    let view = front_view(320, 320);
    let seen = |settings: RasterSettings, clip| {
        project_one(RasterSettings { radius_clip: clip, ..settings }, &scene, &view).is_some()
    };
    let [long, short] = project_one(LATEST, &scene, &view).unwrap().radius;
    assert!(long > short);
    assert!(seen(LATEST, short));
    assert!(!seen(LATEST, long));
    let square = project_one(PINNED, &scene, &view).unwrap().radius[0];
    assert!(seen(PINNED, square - 1.0) && !seen(PINNED, square));
}

#[test]
fn clamps_differ_only_beside_an_off_centre_picture() {
    // Principal point at the left edge: x/z may reach 2.3 half views to the right, Pinned clamps at 1.3.
    let mut view = front_view(64, 64);
    (view.intrinsics.fx, view.intrinsics.fy) = (64.0, 64.0);
    (view.intrinsics.cx, view.intrinsics.cy) = (0.0, 32.0);
    let mut scene = Scene::copies(1, 1);
    scene.scales[0] = [0.5; 3];
    scene.means[0] = [0.5 * 5.0, 0.0, 5.0];
    let conic = |settings, scene: &Scene| project_one(settings, scene, &view).unwrap().conic;
    assert_eq!(conic(PINNED, &scene), conic(LATEST, &scene), "inside both clamps");
    scene.means[0][0] = 0.95 * 5.0;
    let (pinned, latest) = (conic(PINNED, &scene), conic(LATEST, &scene));
    assert!(latest[0] < pinned[0], "the clamped splat is narrower: {pinned:?} {latest:?}");
}

#[test]
fn square_cuts_at_three_deviations_and_rectangle_does_not() {
    // The exact box of alpha >= 1/255 reaches 3.3 deviations; place its end just over a 16-pixel tile edge.
    let mut scene = Scene::copies(1, 0);
    (scene.opacities[0], scene.scales[0]) = (1.0, [0.5; 3]);
    let mut view = front_view(64, 16);
    (view.intrinsics.fx, view.intrinsics.fy) = (80.0, 80.0);
    (view.intrinsics.cx, view.intrinsics.cy) = (23.0, 8.0);
    let p = project_one(PINNED, &scene, &view).unwrap();
    assert_eq!(p.radius[0], 25.0);
    // 23 + 25 = 48 = the tile edge: Pinned stops there, Latest (radius 27) blends pixel 48 as well.
    let row = 8 * 64;
    let (pinned, latest) = (render(PINNED, &scene, view), render(LATEST, &scene, view));
    assert!(pinned.alpha[row + 47] > 0.0 && pinned.alpha[row + 48] == 0.0);
    assert!(latest.alpha[row + 48] > ALPHA_MIN);
}

#[test]
fn latest_matches_its_reference() {
    let scene = Scene::random(21, 2500, 3);
    compare(LATEST, &scene, &[front_view(96, 64)]);
    let (pinned, latest) = (render(PINNED, &scene, front_view(96, 64)), render(LATEST, &scene, front_view(96, 64)));
    let differing = pinned.features.iter().zip(&latest.features).filter(|(a, b)| (*a - *b).abs() > 1e-4).count();
    assert!(differing > 100, "{differing}");
}
