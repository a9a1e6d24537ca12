//! A window's Gaussians as samples of tiles: placed in the map in f64, relative to their tile in f32.

use glam::{DMat3, DVec3, Quat, Vec3};
use rayon::prelude::*;
use storm_render::Gaussians;

use crate::rigid::Rigid;

use super::cell::{Sample, covariance};
use super::tile::TileIndex;
use super::voxel::LEVELS;

/// Standard deviations beyond this are no surface but a mistake, metres (and their squares stay far inside f32).
const MAX_SCALE_M: f32 = 1e3;

/// Weights beyond this are a mistake of the caller; sums of them stay finite.
const MAX_SAMPLE_WEIGHT: f32 = 1e6;

/// Colours beyond this are a mistake; the network's lie near -1 to 1.
const MAX_COLOR: f32 = 1e3;

/// Tile indices beyond this are refused: far from where neighbours would overflow.
const MAX_TILE: f64 = (1 << 30) as f64;

/// Gaussians placed by one task.
const CHUNK: usize = 2048;

/// Where a run of Gaussians was seen from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Eye {
    /// The camera's centre, anchor frame, metres.
    pub position: Vec3,
    /// Angle of a pixel, radians (one over the focal length in pixels); 0: not known, the finest voxels are used.
    pub pixel_rad: f32,
}

/// One window's place in the map, and how samples are made.
pub(super) struct Placement<'a> {
    pub origin_from_anchor: DVec3,
    /// The same rotation twice: for positions in f64, for shapes in f32.
    pub turn: DMat3,
    pub rotation: Quat,
    pub tile_m: f64,
    pub voxel_m: f32,
    /// Depth gate as a part of the distance.
    pub gate_part: f32,
    pub gaussians: &'a Gaussians,
    /// One per picture of `pixels` Gaussians; empty: not known.
    pub eyes: &'a [Eye],
    pub pixels: usize,
}

/// What became of a chunk's Gaussians.
#[derive(Default)]
pub(super) struct PlacedChunk {
    pub samples: Vec<(TileIndex, Sample)>,
    pub skipped: u64,
    pub rejected: u64,
}

impl<'a> Placement<'a> {
    pub fn new(
        origin: DVec3,
        map_from_anchor: &Rigid,
        (tile_m, voxel_m, gate_part): (f64, f64, f64),
        gaussians: &'a Gaussians,
        (eyes, pixels): (&'a [Eye], usize),
    ) -> Self {
        Self {
            origin_from_anchor: Rigid::new(map_from_anchor.rotation, map_from_anchor.translation - origin)
                .snapped()
                .translation,
            turn: map_from_anchor.matrix3(),
            rotation: map_from_anchor.rotation.as_quat(),
            tile_m,
            voxel_m: voxel_m as f32,
            gate_part: gate_part as f32,
            gaussians,
            eyes,
            pixels,
        }
    }

    /// All Gaussians that `select` gives a weight, in order; many threads, the same result.
    pub fn all(
        &self,
        first_new: usize,
        select: &(impl Fn(usize) -> Option<f32> + Sync),
        color: &(impl Fn(usize) -> [f32; 3] + Sync),
    ) -> Vec<PlacedChunk> {
        let n = self.gaussians.len();
        (0..n.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let range = chunk * CHUNK..((chunk + 1) * CHUNK).min(n);
                let mut out = PlacedChunk { samples: Vec::with_capacity(range.len()), ..Default::default() };
                for i in range {
                    match select(i) {
                        None => out.skipped += 1,
                        Some(weight) => match self.sample(i, i >= first_new, weight, color(i)) {
                            Some(placed) => out.samples.push(placed),
                            None => out.rejected += 1,
                        },
                    }
                }
                out
            })
            .collect()
    }

    /// Gaussian `i`'s tile and sample; none when a number is not finite or out of range.
    fn sample(&self, i: usize, fresh: bool, weight: f32, color: [f32; 3]) -> Option<(TileIndex, Sample)> {
        let g = self.gaussians;
        let (mean, scale, color) = (Vec3::from(g.means[i]), Vec3::from(g.scales[i]), Vec3::from(color));
        let [w, x, y, z] = g.quats[i];
        let q = Quat::from_xyzw(x, y, z, w);
        let (opacity, norm) = (g.opacities[i], q.length());
        let plausible = mean.is_finite()
            && scale.min_element() >= 0.0
            && scale.max_element() <= MAX_SCALE_M
            && norm > 1e-6
            && norm < 1e6
            && (0.0..=1.0).contains(&opacity)
            && color.abs().max_element() <= MAX_COLOR
            && weight > 0.0
            && weight <= MAX_SAMPLE_WEIGHT;
        if !(plausible && scale.is_finite() && color.is_finite() && q.is_finite()) {
            return None;
        }
        let place = self.origin_from_anchor + self.turn * mean.as_dvec3();
        let index = (place / self.tile_m).floor();
        if index.abs().max_element() <= MAX_TILE {
            let position = (place - index * self.tile_m).as_vec3();
            let cov = covariance(self.rotation * (q * (1.0 / norm)), scale);
            let (ray, gate_m, level) = self.seen_from(i, mean);
            let index = [index.x as i32, index.y as i32, index.z as i32];
            return Some((index, Sample { position, cov, color, opacity, weight, ray, gate_m, level, fresh }));
        }
        None
    }

    /// Direction from the camera in map axes, depth gate, and the voxel size that a pixel there is worth.
    fn seen_from(&self, i: usize, mean: Vec3) -> (Vec3, f32, u32) {
        let Some(eye) = self.eyes.get(i / self.pixels.max(1)) else { return (Vec3::ZERO, 0.0, 0) };
        let ray = mean - eye.position;
        let distance = ray.length();
        if !(distance > 1e-3 && distance.is_finite()) {
            return (Vec3::ZERO, 0.0, 0);
        }
        // The smallest voxel that is at least as large as the pixel there.
        let pixels = distance * eye.pixel_rad / self.voxel_m;
        let level = if pixels > 1.0 { (pixels.log2().ceil() as u32).min(LEVELS - 1) } else { 0 };
        (self.rotation * (ray / distance), self.gate_part * distance, level)
    }
}
