//! The loads that are timed.

use glam::{Affine3A, Mat3, Quat, Vec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use storm_render::raster::Splats;
use storm_render::{Intrinsics, View};

/// Size of the network's pictures.
pub const WIDTH: usize = 240;
pub const HEIGHT: usize = 160;
/// Horizontal field of view of all cameras, degrees.
const FOV_DEG: f32 = 55.0;
/// Standard deviation of a Gaussian in the picture it was made from, pixels.
const SIGMA_PX: f32 = 0.5;
/// Nearest and farthest surface, metres.
const DEPTHS: [f32; 2] = [3.0, 80.0];

/// Gaussians and their features.
pub struct Scene {
    pub means: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub scales: Vec<[f32; 3]>,
    pub opacities: Vec<f32>,
    pub features: Vec<f32>,
    pub feature_count: usize,
    rng: ChaCha8Rng,
}

/// Smooth surfaces with a few per cent of noise.
struct Surface {
    phase: [f32; 3],
}

impl Surface {
    /// Depth at a picture point in units of the network's pixels.
    fn depth(&self, u: f32, v: f32, rng: &mut ChaCha8Rng) -> f32 {
        let p = &self.phase;
        let waves = (u * 0.05 + p[0]).sin() + (v * 0.07 + p[1]).sin() + (u * 0.11 + p[2]).cos();
        let share = (waves / 6.0 + 0.5 + rng.random_range(-0.02..0.02)).clamp(0.0, 1.0);
        DEPTHS[0] * (DEPTHS[1] / DEPTHS[0]).powf(share)
    }
}

/// Three cameras, 50 degrees apart, at `forward` metres along x (x forward, y left, z up).
pub fn rig(forward: f32) -> [View; 3] {
    let base_from_camera = Mat3::from_cols(Vec3::NEG_Y, Vec3::NEG_Z, Vec3::X);
    [50.0f32, 0.0, -50.0].map(|yaw_deg| {
        let rotation = Mat3::from_quat(Quat::from_rotation_z(yaw_deg.to_radians())) * base_from_camera;
        let pose = Affine3A::from_mat3_translation(rotation, Vec3::new(forward, 0.0, 1.5));
        View::from_pose(pose, Intrinsics::from_fov(FOV_DEG, WIDTH, HEIGHT))
    })
}

/// The view of `Scene::cloud`.
pub fn front(width: usize, height: usize) -> View {
    View { camera_from_world: Affine3A::IDENTITY, intrinsics: Intrinsics::from_fov(FOV_DEG, width, height) }
}

impl Scene {
    fn new(seed: u64) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Self {
            means: vec![],
            quats: vec![],
            scales: vec![],
            opacities: vec![],
            features: vec![],
            feature_count: 0,
            rng,
        }
    }

    fn push(&mut self, pose: &Affine3A, camera: &Intrinsics, u: f32, v: f32, depth: f32) {
        let rng = &mut self.rng;
        self.means.push(pose.transform_point3(camera.ray(u, v) * depth).into());
        self.quats.push(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
        let scale = SIGMA_PX * depth / camera.fx;
        self.scales.push(std::array::from_fn(|_| scale * rng.random_range(0.7..1.3)));
        self.opacities.push(rng.random_range(0.3..1.0));
    }

    fn surface(&mut self) -> Surface {
        Surface { phase: std::array::from_fn(|_| self.rng.random_range(0.0..6.3)) }
    }

    /// What one step of the network gives: a Gaussian per pixel of three cameras at four times along a straight drive.
    pub fn window() -> Self {
        let mut scene = Self::new(1);
        for step in 0..4 {
            for view in rig(step as f32 * 5.0) {
                let pose = view.world_from_camera();
                let surface = scene.surface();
                for row in 0..HEIGHT {
                    for col in 0..WIDTH {
                        let (u, v) = (col as f32 + 1.0, row as f32 + 1.0);
                        let depth = surface.depth(u, v, &mut scene.rng);
                        scene.push(&pose, &view.intrinsics, u, v, depth);
                    }
                }
            }
        }
        scene
    }

    /// `n` Gaussians evenly over the picture of `front`, row by row as pixel-aligned ones are, half a pixel large.
    pub fn cloud(n: usize, width: usize, height: usize) -> Self {
        let mut scene = Self::new(2);
        scene.add_cloud(n, &front(width, height));
        scene
    }

    /// `n` Gaussians around the camera in ten sectors, of which a view of 36 degrees sees one.
    pub fn sectors(n: usize) -> (Self, View) {
        let mut scene = Self::new(3);
        let view = View { intrinsics: Intrinsics::from_fov(36.0, WIDTH, HEIGHT), ..front(WIDTH, HEIGHT) };
        for sector in 0..10 {
            let turn = Affine3A::from_rotation_y(sector as f32 * 36f32.to_radians());
            scene.add_cloud(n / 10, &View::from_pose(turn, view.intrinsics));
        }
        (scene, view)
    }

    fn add_cloud(&mut self, n: usize, view: &View) {
        let k = view.intrinsics;
        let (pose, surface) = (view.world_from_camera(), self.surface());
        let columns = ((n * k.width) as f32 / k.height as f32).sqrt().ceil().max(1.0) as usize;
        let rows = n.div_ceil(columns);
        for i in 0..n {
            let mut at = |cell: usize, cells: usize, size: usize| {
                (cell as f32 + self.rng.random_range(0.0..1.0)) / cells as f32 * size as f32
            };
            let (u, v) = (at(i % columns, columns, k.width), at(i / columns, rows, k.height));
            let (wide, high) = (WIDTH as f32 / k.width as f32, HEIGHT as f32 / k.height as f32);
            let depth = surface.depth(u * wide, v * high, &mut self.rng);
            self.push(&pose, &k, u, v, depth);
        }
    }

    /// The same with so many random channels from 0 to 1.
    pub fn with_channels(mut self, channels: usize) -> Self {
        self.feature_count = channels;
        self.features = (0..self.means.len() * channels).map(|_| self.rng.random_range(0.0..1.0)).collect();
        self
    }

    /// Random numbers from -1 to 1.
    pub fn noise(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.rng.random_range(-1.0..1.0)).collect()
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
}
