//! Parity with numbers computed in f64 from gsplat's rules (`tests/fixtures/raster_*.safetensors`).

use super::super::*;
use crate::camera::Intrinsics;
use glam::{Affine3A, Mat3, Vec3};
use safetensors::SafeTensors;

/// Colour and alpha, decisions safe: f32 rounding of a few hundred weights.
const COLOR_TOLERANCE: f32 = 2e-5;
/// Depth in metres, decisions safe: depths reach 400 m, f32 has 7 digits.
const DEPTH_TOLERANCE: f32 = 1e-3;
/// Colour and alpha where a decision is within 1e-3 of flipping: one splat of alpha 1/255 and what it hides.
const FRAGILE_TOLERANCE: f32 = 2e-2;
/// Picture positions, pixels, and conics, relative to their largest entry: one f32 rounding.
const PROJECTION_TOLERANCE: f32 = 1e-6;

/// Which implementation a test looks at.
type Render = fn(&RasterSettings, &Splats, &[View]) -> Result<Vec<Picture>, RasterError>;
const FAST: Render = |settings, splats, views| CpuRasterizer::new(*settings)?.render(splats, views);

pub(super) struct Golden {
    bytes: Vec<u8>,
}

impl Golden {
    pub(super) fn open(name: &str) -> Self {
        let path = format!("{}/../tests/fixtures/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        Self { bytes: std::fs::read(path).unwrap() }
    }

    pub(super) fn f32s(&self, name: &str) -> Vec<f32> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        let tensor = tensors.tensor(name).unwrap();
        assert_eq!(tensor.dtype(), safetensors::Dtype::F32, "{name}");
        tensor.data().as_chunks::<4>().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
    }

    fn i32s(&self, name: &str) -> Vec<i32> {
        let tensors = SafeTensors::deserialize(&self.bytes).unwrap();
        tensors.tensor(name).unwrap().data().as_chunks::<4>().0.iter().map(|&b| i32::from_le_bytes(b)).collect()
    }

    pub(super) fn u8s(&self, name: &str) -> Vec<u8> {
        SafeTensors::deserialize(&self.bytes).unwrap().tensor(name).unwrap().data().to_vec()
    }

    pub(super) fn rows<const N: usize>(&self, name: &str) -> Vec<[f32; N]> {
        self.f32s(name).as_chunks::<N>().0.to_vec()
    }

    /// Every camera, with pictures of this size.
    pub(super) fn views(&self, width: usize, height: usize) -> Vec<View> {
        let (poses, cameras) = (self.f32s("viewmats"), self.f32s("Ks"));
        let pairs = poses.as_chunks::<16>().0.iter().zip(cameras.as_chunks::<9>().0);
        let view = |(m, k): (&[f32; 16], &[f32; 9])| {
            let rotation = Mat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
            let translation = Vec3::new(m[3], m[7], m[11]);
            let intrinsics = Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5], width, height };
            View { camera_from_world: Affine3A::from_mat3_translation(rotation, translation), intrinsics }
        };
        pairs.map(view).collect()
    }

    fn view(&self) -> View {
        self.views(96, 64)[0]
    }

    pub(super) fn with_splats<R>(&self, run: impl FnOnce(&Splats) -> R) -> R {
        let (means, quats, scales) = (self.rows("means"), self.rows("quats"), self.rows("scales"));
        let (opacities, colors) = (self.f32s("opacities"), self.f32s("colors"));
        run(&Splats {
            means: &means,
            quats: &quats,
            scales: &scales,
            opacities: &opacities,
            features: &colors,
            feature_count: colors.len() / means.len(),
        })
    }
}

/// Largest difference where `chosen`, with `per_pixel` values a pixel.
fn worst(got: &[f32], want: &[f32], chosen: impl Fn(usize) -> bool, per_pixel: usize) -> f32 {
    assert_eq!(got.len(), want.len());
    let differences = got.iter().zip(want).enumerate().filter(|(i, _)| chosen(i / per_pixel));
    differences.map(|(_, (g, w))| if g == w { 0.0 } else { (g - w).abs() }).fold(0.0, f32::max)
}

fn check_picture(name: &str, render: Render) {
    let golden = Golden::open(name);
    let picture =
        golden.with_splats(|splats| render(&RasterSettings::default(), splats, &[golden.view()]).unwrap().remove(0));
    let fragile = golden.u8s("fragile");
    assert!(fragile.iter().filter(|&&f| f == 0).count() > 4000, "most pixels must be worth comparing");
    let (image, alpha, depth) = (golden.f32s("image"), golden.f32s("alpha"), golden.f32s("depth"));
    let safe = |pixel: usize| fragile[pixel] == 0;
    let color_error = worst(&picture.features, &image, safe, 3);
    let alpha_error = worst(&picture.alpha, &alpha, safe, 1);
    let depth_error = worst(&picture.depth, &depth, safe, 1);
    let loose = worst(&picture.features, &image, |_| true, 3).max(worst(&picture.alpha, &alpha, |_| true, 1));
    println!("{name}: colour {color_error:e} alpha {alpha_error:e} depth {depth_error:e} with fragile {loose:e}");
    assert!(color_error <= COLOR_TOLERANCE && alpha_error <= COLOR_TOLERANCE);
    assert!(depth_error <= DEPTH_TOLERANCE);
    assert!(loose <= FRAGILE_TOLERANCE);
}

#[test]
fn pictures_match() {
    for name in ["raster_200", "raster_2000", "raster_10000_needles"] {
        check_picture(name, FAST);
    }
}

#[test]
fn reference_pictures_match() {
    for name in ["raster_200", "raster_2000", "raster_10000_needles"] {
        check_picture(name, reference::render);
    }
}

#[test]
fn projections_match() {
    for name in ["raster_200", "raster_2000"] {
        let golden = Golden::open(name);
        let (means2d, conics) = (golden.rows::<2>("means2d"), golden.rows::<3>("conics"));
        let (radii, depths) = (golden.i32s("radii"), golden.f32s("depths"));
        let settings = RasterSettings::default();
        let (fast, slow) = golden.with_splats(|splats| {
            let fast = CpuRasterizer::new(settings).unwrap().project(splats, &golden.view()).unwrap();
            (fast, reference::project(&settings, splats, &golden.view()).unwrap())
        });
        for projections in [fast, slow] {
            assert!(projections.iter().flatten().count() > 100);
            for (i, projection) in projections.iter().enumerate() {
                assert_eq!(projection.is_some(), radii[i] > 0, "{name} {i}");
                let Some(p) = projection else { continue };
                let close = |got: f32, want: f32, size: f32| {
                    assert!((got - want).abs() <= PROJECTION_TOLERANCE * size.max(1.0), "{name} {i}: {got} {want}");
                };
                assert_eq!(p.radius, [radii[i] as f32; 2], "{name} {i}");
                close(p.depth, depths[i], depths[i]);
                (0..2).for_each(|k| close(p.mean[k], means2d[i][k], means2d[i][k].abs()));
                (0..3).for_each(|k| close(p.conic[k], conics[i][k], 1.0));
            }
        }
    }
}
