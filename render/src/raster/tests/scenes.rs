//! Random scenes for tests.

use super::super::Splats;
use crate::camera::{Intrinsics, View};
use glam::{Affine3A, Quat, Vec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Owned splats.
#[derive(Clone)]
pub(super) struct Scene {
    pub(super) means: Vec<[f32; 3]>,
    pub(super) quats: Vec<[f32; 4]>,
    pub(super) scales: Vec<[f32; 3]>,
    pub(super) opacities: Vec<f32>,
    pub(super) features: Vec<f32>,
    pub(super) feature_count: usize,
}

impl Scene {
    /// `n` Gaussians in front of the identity camera, some of them beside the picture, needles and discs among them.
    pub(super) fn random(seed: u64, n: usize, feature_count: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut scene = Self::copies(0, feature_count);
        for _ in 0..n {
            let depth = rng.random_range(0.1f32..30.0);
            let spread = 0.8 * depth;
            scene.means.push([rng.random_range(-spread..spread), rng.random_range(-spread..spread), depth]);
            scene.quats.push(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
            let size = 0.02 * depth * rng.random_range(0.02f32..2.0);
            scene.scales.push(std::array::from_fn(|_| size * rng.random_range(0.05f32..1.5)));
            scene.opacities.push(rng.random_range(0.0..1.0));
        }
        scene.features = (0..n * feature_count).map(|_| rng.random_range(-1.0..1.0)).collect();
        scene
    }

    /// `n` equal, well-behaved Gaussians 5 m ahead.
    pub(super) fn copies(n: usize, feature_count: usize) -> Self {
        Self {
            means: vec![[0.0, 0.0, 5.0]; n],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.1; 3]; n],
            opacities: vec![0.5; n],
            features: vec![0.25; n * feature_count],
            feature_count,
        }
    }

    pub(super) fn splats(&self) -> Splats<'_> {
        Splats {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
            features: &self.features,
            feature_count: self.feature_count,
        }
    }
}

/// The identity pose, with a principal point off the centre.
pub(super) fn front_view(width: usize, height: usize) -> View {
    let (fx, fy) = (0.9 * width as f32, 1.1 * width as f32);
    let intrinsics = Intrinsics { fx, fy, cx: 0.55 * width as f32, cy: 0.42 * height as f32, width, height };
    View { camera_from_world: Affine3A::IDENTITY, intrinsics }
}

/// A camera turned and moved a little.
pub(super) fn turned_view(width: usize, height: usize, yaw: f32) -> View {
    let pose = Affine3A::from_rotation_translation(
        Quat::from_euler(glam::EulerRot::YXZ, yaw, 0.1, -0.2),
        Vec3::new(0.5, -0.2, 0.3),
    );
    View::from_pose(pose, front_view(width, height).intrinsics)
}
