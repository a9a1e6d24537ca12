//! What was predicted for the pixels of a moment, by all windows that saw it.

use glam::{Quat, Vec3};
use rayon::prelude::*;
use storm_model::scene::{Scene, SceneShape};

use super::hypotheses::Picture;
use crate::engine::select::{MOVING_MPS, speed_mps};

/// Every how manieth pixel's difference goes into the medians.
const SAMPLED: usize = 5;

/// Predictions for one pixel: means over the windows.
#[derive(Debug, Clone, Copy, Default)]
struct Pixel {
    /// z-depth, metres.
    depth: f32,
    /// Map axes, m/s.
    velocity: Vec3,
    /// Windows; 0: none, or no surface.
    windows: u16,
}

/// The pixels of all cameras at one moment.
#[derive(Debug)]
pub(super) struct Seen {
    stamp_ns: i64,
    /// Camera by camera, row by row.
    pixels: Vec<Pixel>,
}

/// How one picture's predictions differ from what was predicted before; infinite where nothing was.
#[derive(Debug, Default)]
pub(super) struct Differences {
    /// Of depth, as a part of the depth.
    pub depth_part: Vec<f32>,
    /// Of velocity, m/s.
    pub velocity_mps: Vec<f32>,
    /// Whether the network says that they move.
    pub moves: Vec<bool>,
    /// Pixels that were predicted before.
    pub known: usize,
}

impl Differences {
    /// Differences of depth at some of the pixels that were predicted before, as a part of the depth.
    pub fn depths(&self) -> impl Iterator<Item = f32> + '_ {
        self.depth_part.iter().step_by(SAMPLED).copied().filter(|d| d.is_finite())
    }

    /// Differences of velocity at some of those that are said to move, m/s.
    pub fn velocities(&self) -> impl Iterator<Item = f32> + '_ {
        let both = self.velocity_mps.iter().zip(&self.moves).step_by(SAMPLED);
        both.filter(|(v, moves)| **moves && v.is_finite()).map(|(v, _)| *v)
    }
}

impl Seen {
    pub fn new(stamp_ns: i64, shape: SceneShape) -> Self {
        Self { stamp_ns, pixels: vec![Pixel::default(); shape.cameras * shape.height * shape.width] }
    }

    pub fn stamp_ns(&self) -> i64 {
        self.stamp_ns
    }

    pub fn fits(&self, shape: SceneShape) -> bool {
        self.pixels.len() == shape.cameras * shape.height * shape.width
    }

    pub fn bytes(&self) -> usize {
        self.pixels.capacity() * size_of::<Pixel>()
    }

    /// Compares the Gaussians from `first` on with the means so far, then enters them. `pictures`: one per camera.
    pub fn compare(
        &mut self,
        scene: &Scene,
        first: usize,
        pictures: &[Picture],
        map_from_anchor: Quat,
    ) -> Vec<Differences> {
        let per_picture = scene.shape.height * scene.shape.width;
        let g = &scene.gaussians;
        self.pixels
            .par_chunks_mut(per_picture)
            .zip(pictures)
            .enumerate()
            .map(|(c, (pixels, picture))| {
                let mut out = Differences {
                    depth_part: vec![f32::INFINITY; per_picture],
                    velocity_mps: vec![f32::INFINITY; per_picture],
                    moves: vec![false; per_picture],
                    known: 0,
                };
                for (p, pixel) in pixels.iter_mut().enumerate() {
                    let depth = picture.depth[p];
                    if !depth.is_finite() {
                        continue;
                    }
                    let i = first + c * per_picture + p;
                    let velocity = map_from_anchor * Vec3::from(g.velocity_forward[i]);
                    out.moves[p] = speed_mps(scene, i) >= MOVING_MPS;
                    if pixel.windows > 0 {
                        out.depth_part[p] = (depth - pixel.depth).abs() / depth;
                        out.velocity_mps[p] = (velocity - pixel.velocity).length();
                        out.known += 1;
                    }
                    pixel.windows = pixel.windows.saturating_add(1);
                    let share = 1.0 / f32::from(pixel.windows);
                    pixel.depth += share * (depth - pixel.depth);
                    pixel.velocity += share * (velocity - pixel.velocity);
                }
                out
            })
            .collect()
    }
}
