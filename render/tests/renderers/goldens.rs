//! Parity with numbers computed in f64 from gsplat's rules (`tests/fixtures/raster_*.safetensors`).

use super::backends::each;
use glam::{Affine3A, Mat3, Vec3};
use safetensors::SafeTensors;
use storm_render::raster::{RasterSettings, Splats};
use storm_render::{Intrinsics, View};

/// Colour and alpha where a decision is within 1e-3 of flipping: one splat of alpha 1/255 and what it hides.
const FRAGILE_TOLERANCE: f32 = 2e-2;

struct Golden {
    bytes: Vec<u8>,
}

impl Golden {
    fn open(name: &str) -> Self {
        let path = format!("{}/../tests/fixtures/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        Self { bytes: std::fs::read(path).unwrap() }
    }

    fn raw(&self, name: &str) -> Vec<u8> {
        SafeTensors::deserialize(&self.bytes).unwrap().tensor(name).unwrap().data().to_vec()
    }

    fn f32s(&self, name: &str) -> Vec<f32> {
        self.raw(name).as_chunks::<4>().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
    }

    fn rows<const N: usize>(&self, name: &str) -> Vec<[f32; N]> {
        self.f32s(name).as_chunks::<N>().0.to_vec()
    }

    fn view(&self) -> View {
        let (m, k) = (self.f32s("viewmats"), self.f32s("Ks"));
        let rotation = Mat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
        let translation = Vec3::new(m[3], m[7], m[11]);
        let intrinsics = Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5], width: 96, height: 64 };
        View { camera_from_world: Affine3A::from_mat3_translation(rotation, translation), intrinsics }
    }
}

/// Largest difference where `chosen`, with `per_pixel` values a pixel.
fn worst(got: &[f32], want: &[f32], chosen: impl Fn(usize) -> bool, per_pixel: usize) -> f32 {
    assert_eq!(got.len(), want.len());
    let pairs = got.iter().zip(want).enumerate().filter(|(i, _)| chosen(i / per_pixel));
    pairs.map(|(_, (a, b))| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn goldens_match() {
    for name in ["raster_200", "raster_2000", "raster_10000_needles"] {
        let golden = Golden::open(name);
        let (means, quats, scales) = (golden.rows("means"), golden.rows("quats"), golden.rows("scales"));
        let (opacities, colors) = (golden.f32s("opacities"), golden.f32s("colors"));
        let splats = Splats {
            means: &means,
            quats: &quats,
            scales: &scales,
            opacities: &opacities,
            features: &colors,
            feature_count: 3,
        };
        let fragile = golden.raw("fragile");
        let (image, alpha, depth) = (golden.f32s("image"), golden.f32s("alpha"), golden.f32s("depth"));
        let safe = |pixel: usize| fragile[pixel] == 0;
        assert!((0..fragile.len()).filter(|&p| safe(p)).count() > fragile.len() / 4, "{name} tests too little");
        each(RasterSettings::default(), |backend| {
            let picture = backend.renderer.render(&splats, &[golden.view()]).unwrap().remove(0);
            let color_error = worst(&picture.features, &image, safe, 3).max(worst(&picture.alpha, &alpha, safe, 1));
            let depth_error = worst(&picture.depth, &depth, safe, 1);
            let loose = worst(&picture.features, &image, |_| true, 3).max(worst(&picture.alpha, &alpha, |_| true, 1));
            let who = backend.renderer.describe();
            println!("{name}: colour {color_error:e} depth {depth_error:e} with fragile {loose:e} on {who}");
            assert!(color_error <= backend.color_tolerance, "{name} colour {color_error:e} on {who}");
            assert!(depth_error <= backend.depth_tolerance, "{name} depth {depth_error:e} on {who}");
            assert!(loose <= FRAGILE_TOLERANCE, "{name} with fragile {loose:e} on {who}");
        });
    }
}
