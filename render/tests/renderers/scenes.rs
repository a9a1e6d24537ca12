//! Random scenes and the views of them.

use glam::{Affine3A, Quat, Vec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use storm_render::raster::{Picture, RasterSettings, Splats};
use storm_render::{Intrinsics, View};

/// Owned splats.
#[derive(Clone, Default)]
pub struct Scene {
    pub means: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub scales: Vec<[f32; 3]>,
    pub opacities: Vec<f32>,
    pub features: Vec<f32>,
    pub feature_count: usize,
}

/// What the Gaussians of a random scene look like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    /// All sizes around a few pixels.
    Mixed,
    /// A hundred to a thousand times as long as thick.
    Needles,
    /// Most of them close to the near plane, many beside the picture.
    NearPlane,
    /// Some as large as the picture and larger.
    Huge,
}

pub const KINDS: [Kind; 4] = [Kind::Mixed, Kind::Needles, Kind::NearPlane, Kind::Huge];

impl Scene {
    /// `n` Gaussians around the view from the origin along z; features from 0 to 1.
    pub fn random(seed: u64, kind: Kind, n: usize, feature_count: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut scene = Self { feature_count, ..Self::default() };
        for i in 0..n {
            let depth = match kind {
                Kind::NearPlane => rng.random_range(0.1f32..1.0).powi(2),
                _ => rng.random_range(0.1f32..40.0),
            };
            let spread = 0.8 * depth;
            scene.means.push([rng.random_range(-spread..spread), rng.random_range(-spread..spread), depth]);
            scene.quats.push(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
            let mut size = 0.02 * depth * rng.random_range(0.02f32..2.0);
            if kind == Kind::Huge && i % 50 == 0 {
                size = depth * rng.random_range(0.5f32..30.0);
            }
            let mut scale: [f32; 3] = std::array::from_fn(|_| size * rng.random_range(0.05f32..1.5));
            if kind == Kind::Needles {
                let long = rng.random_range(0..3usize);
                scale[long] = 10.0 * size;
                scale[(long + 1) % 3] = 0.1 * size;
                scale[(long + 2) % 3] = 0.01 * size;
            }
            scene.scales.push(scale);
            scene.opacities.push(rng.random_range(0.0..1.0));
        }
        scene.features = (0..n * feature_count).map(|_| rng.random_range(0.0..1.0)).collect();
        scene
    }

    /// `n` equal, well-behaved Gaussians 5 m ahead.
    pub fn copies(n: usize, feature_count: usize) -> Self {
        Self {
            means: vec![[0.0, 0.0, 5.0]; n],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.1; 3]; n],
            opacities: vec![0.5; n],
            features: vec![0.25; n * feature_count],
            feature_count,
        }
    }

    pub fn splats(&self) -> Splats<'_> {
        Splats {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
            features: &self.features,
            feature_count: self.feature_count,
        }
    }

    pub fn push(&mut self, other: Self) {
        self.means.extend(other.means);
        self.quats.extend(other.quats);
        self.scales.extend(other.scales);
        self.opacities.extend(other.opacities);
        self.features.extend(other.features);
    }
}

/// The identity pose, with a principal point off the centre.
pub fn front_view(width: usize, height: usize) -> View {
    let (fx, fy) = (0.9 * width as f32, 1.1 * width as f32);
    let intrinsics = Intrinsics { fx, fy, cx: 0.55 * width as f32, cy: 0.42 * height as f32, width, height };
    View { camera_from_world: Affine3A::IDENTITY, intrinsics }
}

/// A camera turned and moved a little.
pub fn turned_view(width: usize, height: usize, yaw: f32) -> View {
    let rotation = Quat::from_euler(glam::EulerRot::YXZ, yaw, 0.1, -0.2);
    let pose = Affine3A::from_rotation_translation(rotation, Vec3::new(0.5, -0.2, 0.3));
    View::from_pose(pose, front_view(width, height).intrinsics)
}

pub fn all_values(picture: &Picture) -> impl Iterator<Item = f32> + '_ {
    picture.features.iter().chain(&picture.alpha).chain(&picture.depth).copied()
}

pub fn assert_finite(picture: &Picture) {
    let pixels = picture.width * picture.height;
    assert_eq!(picture.features.len(), pixels * picture.feature_count);
    assert_eq!((picture.alpha.len(), picture.depth.len()), (pixels, pixels));
    assert!(all_values(picture).all(f32::is_finite));
    assert!(picture.alpha.iter().all(|a| (0.0..=1.0).contains(a)));
}

pub fn bits(pictures: &[Picture]) -> Vec<u32> {
    pictures.iter().flat_map(all_values).map(f32::to_bits).collect()
}

pub fn both_conventions() -> [RasterSettings; 2] {
    use storm_render::raster::Convention;
    [Convention::Pinned, Convention::Latest].map(|convention| RasterSettings { convention, ..Default::default() })
}
