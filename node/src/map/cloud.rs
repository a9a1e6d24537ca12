//! The map as plain arrays, ready to be written or drawn.

use glam::{DVec3, Quat, Vec3};
use rayon::prelude::*;

use super::cell::{Cell, Sample, covariance};
use super::eigen::rotation_and_scales;
use super::tile::TileIndex;
use super::voxel::{key_at, level_of};
use super::{MapError, StaticMap};

/// Standard deviations below this come out as this, metres: a flat or single-point cell stays drawable.
const MIN_SCALE_M: f64 = 1e-4;

/// The two longer standard deviations are at least this part of the voxel's edge: a Gaussian stands for the whole
/// surface in its voxel, and at half the spacing neighbours close up (two Gaussians their own 2 sigma apart blend to
/// a flat top).
const FILL: f64 = 0.45;

/// `n` Gaussians at rest; every array has length `n`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MapCloud {
    /// What the positions are relative to, in the map frame, metres.
    pub origin: DVec3,
    /// Centres relative to the origin, map axes, metres.
    pub positions: Vec<[f32; 3]>,
    /// Colours, 0 to 1.
    pub colors01: Vec<[f32; 3]>,
    /// Opacities, 0 to 1.
    pub opacities: Vec<f32>,
    /// Linear standard deviations along the local axes, largest first, metres.
    pub scales: Vec<[f32; 3]>,
    /// Orientation in map axes, unit quaternions w, x, y, z with w >= 0.
    pub quats: Vec<[f32; 4]>,
    /// Sum of the confidences merged.
    pub confidences: Vec<f32>,
}

impl MapCloud {
    /// None yet.
    pub fn empty(origin: DVec3) -> Self {
        Self { origin, ..Self::default() }
    }

    /// Adds a tile's cells, sorted by voxel. `corner` is the tile's, relative to the cloud's origin; `fill`: whether
    /// the Gaussians are made to fill their voxels.
    pub(super) fn push_cells(&mut self, corner: DVec3, voxel_m: f64, cells: &[Cell], fill: bool) {
        let mut sorted: Vec<&Cell> = cells.iter().collect();
        sorted.sort_unstable_by_key(|c| c.key);
        let shapes: Vec<_> = sorted
            .par_iter()
            .with_min_len(512)
            .map(|c| {
                let (q, s) = rotation_and_scales(&c.cov.map(f64::from), MIN_SCALE_M);
                let least = if fill { FILL * voxel_m * f64::from(1u32 << level_of(c.key)) } else { 0.0 };
                let q = q.as_quat();
                ([q.w, q.x, q.y, q.z], s.max(DVec3::new(least, least, 0.0)).as_vec3().to_array())
            })
            .collect();
        for (c, (quat, scales)) in sorted.iter().zip(shapes) {
            self.positions.push((corner + c.position.as_dvec3()).as_vec3().to_array());
            self.colors01.push(c.color.clamp(Vec3::ZERO, Vec3::ONE).to_array());
            self.opacities.push(c.opacity.clamp(0.0, 1.0));
            self.scales.push(scales);
            self.quats.push(quat);
            self.confidences.push(c.weight);
        }
    }

    /// Gaussian `i` as a cell of the finest voxels, and the tile it belongs to; none when a number is not one that a map
    /// holds.
    pub(super) fn cell(&self, i: usize, tile_m: f64, voxel_m: f64) -> Option<(TileIndex, Cell)> {
        let place = Vec3::from(*self.positions.get(i)?).as_dvec3() / tile_m;
        let (index, [w, x, y, z]) = (place.floor(), *self.quats.get(i)?);
        let (q, scale) = (Quat::from_xyzw(x, y, z, w), Vec3::from(*self.scales.get(i)?));
        let (color, opacity) = (Vec3::from(*self.colors01.get(i)?), *self.opacities.get(i)?);
        let weight = *self.confidences.get(i)?;
        let plausible = index.abs().max_element() < f64::from(i32::MAX / 2)
            && scale.is_finite()
            && q.length() > 1e-6
            && q.is_finite()
            && color.is_finite()
            && (0.0..=1.0).contains(&opacity)
            && weight > 0.0;
        if !plausible {
            return None;
        }
        let position = ((place - index) * tile_m).as_vec3();
        let (ray, gate_m, level, fresh) = (Vec3::ZERO, 0.0, 0, true);
        let cov = covariance(q.normalize(), scale);
        let sample = Sample { position, cov, color, opacity, weight, ray, gate_m, level, fresh };
        let key = key_at(position, (1.0 / voxel_m) as f32, 0);
        Some((index.to_array().map(|x| x as i32), Cell::new(key, &sample, 0)))
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

impl StaticMap {
    /// The whole map as plain arrays, sorted by tile and voxel. When it has more than `map.max_written` Gaussians,
    /// every second, every third, ... is left out, evenly over each tile.
    ///
    /// # Errors
    /// A tile on disk that cannot be read.
    pub fn cloud(&self) -> Result<MapCloud, MapError> {
        self.cloud_of(self.config.max_written)
    }

    /// The same with at most about `most` Gaussians; 0: all.
    ///
    /// # Errors
    /// A tile on disk that cannot be read.
    pub fn cloud_of(&self, most: usize) -> Result<MapCloud, MapError> {
        let every = match most {
            0 => 1,
            most => self.len().div_ceil(most).max(1),
        };
        let mut cloud = MapCloud::empty(self.origin());
        self.each_tile(|corner, tile| {
            let live: Vec<_> = tile.live().step_by(every).copied().collect();
            cloud.push_cells(corner, self.config.voxel_m, &live, true);
        })?;
        Ok(cloud)
    }

    /// One tile as plain arrays.
    ///
    /// # Errors
    /// A tile on disk that cannot be read.
    pub fn tile_cloud(&self, index: &TileIndex) -> Result<MapCloud, MapError> {
        let mut cloud = MapCloud::empty(self.origin());
        self.with_tile(index, |corner, tile| {
            let live: Vec<_> = tile.live().copied().collect();
            cloud.push_cells(corner, self.config.voxel_m, &live, true);
        })?;
        Ok(cloud)
    }
}
