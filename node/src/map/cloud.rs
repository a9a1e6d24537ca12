//! The map as plain arrays, ready to be written or drawn.

use glam::DVec3;
use rayon::prelude::*;

use super::cell::Cell;
use super::eigen::rotation_and_scales;

/// Standard deviations below this come out as this, metres: a flat or single-point cell stays drawable.
const MIN_SCALE_M: f64 = 1e-4;

/// `n` Gaussians at rest, sorted by voxel (x, then y, then z); every array has length `n`.
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
    pub(super) fn from_cells(origin: DVec3, voxel_m: f64, cells: &[Cell]) -> Self {
        let mut sorted: Vec<&Cell> = cells.iter().collect();
        sorted.par_sort_unstable_by_key(|c| c.key);
        let shapes: Vec<_> = sorted
            .par_iter()
            .map(|c| {
                let (q, s) = rotation_and_scales(&c.cov.map(f64::from), MIN_SCALE_M);
                let q = q.as_quat();
                ([q.w, q.x, q.y, q.z], s.as_vec3().to_array())
            })
            .collect();
        let position = |c: &Cell| {
            let corner = DVec3::from(c.key.map(f64::from));
            ((corner + 0.5) * voxel_m + c.offset.as_dvec3()).as_vec3().to_array()
        };
        Self {
            origin,
            positions: sorted.iter().map(|c| position(c)).collect(),
            colors01: sorted.iter().map(|c| c.color.clamp(glam::Vec3::ZERO, glam::Vec3::ONE).to_array()).collect(),
            opacities: sorted.iter().map(|c| c.opacity.clamp(0.0, 1.0)).collect(),
            scales: shapes.iter().map(|(_, s)| *s).collect(),
            quats: shapes.iter().map(|(q, _)| *q).collect(),
            confidences: sorted.iter().map(|c| c.weight).collect(),
        }
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
