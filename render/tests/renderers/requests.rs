//! Requests that cannot be met are refused, by every renderer in the same words.

use super::backends::each;
use super::scenes::{Scene, front_view};
use glam::{Mat3A, Vec3A};
use storm_render::View;
use storm_render::raster::{MAX_FEATURES, MAX_VIEWS, RasterError, RasterSettings, Splats};
use storm_render::renderer::RenderError;

#[test]
fn arrays_that_disagree_are_refused() {
    let scene = Scene::copies(4, 3);
    let good = scene.splats();
    let broken = [
        ("quats", Splats { quats: &good.quats[1..], ..good }),
        ("scales", Splats { scales: &good.scales[1..], ..good }),
        ("opacities", Splats { opacities: &good.opacities[1..], ..good }),
        ("features", Splats { features: &good.features[1..], ..good }),
        ("features", Splats { feature_count: MAX_FEATURES, ..good }),
    ];
    each(RasterSettings::default(), |backend| {
        for (array, splats) in &broken {
            match backend.renderer.render(splats, &[front_view(8, 8)]) {
                Err(RenderError::Raster(RasterError::Length { name, splats: 4, .. })) => assert_eq!(&name, array),
                other => panic!("{array}: {other:?}"),
            }
        }
    });
}

#[test]
fn cameras_that_cannot_see_are_refused() {
    let scene = Scene::copies(1, 1);
    let good = front_view(8, 8);
    let edits: [fn(&mut View); 8] = [
        |v| v.intrinsics.width = 0,
        |v| v.intrinsics.height = usize::MAX,
        |v| v.intrinsics.fx = f32::NAN,
        |v| v.intrinsics.fy = 0.0,
        |v| v.intrinsics.cx = f32::INFINITY,
        |v| v.camera_from_world.translation = Vec3A::new(0.0, f32::NAN, 0.0),
        |v| v.camera_from_world.matrix3 = Mat3A::ZERO,
        |v| v.camera_from_world.matrix3 = Mat3A::from_diagonal(glam::Vec3::new(1.0, 1.0, 1.1)),
    ];
    each(RasterSettings::default(), |backend| {
        for edit in edits {
            let mut view = good;
            edit(&mut view);
            let result = backend.renderer.render(&scene.splats(), &[good, view]);
            assert!(matches!(result, Err(RenderError::Raster(RasterError::View { view: 1, .. }))), "{result:?}");
        }
        let many = backend.renderer.render(&scene.splats(), &vec![good; MAX_VIEWS + 1]);
        assert!(matches!(many, Err(RenderError::Raster(RasterError::TooMany { name: "views", .. }))));
        // What was refused leaves the renderer as it was.
        assert!(backend.renderer.render(&scene.splats(), &[good]).is_ok());
    });
}
