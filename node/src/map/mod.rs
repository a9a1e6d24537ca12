//! The long-horizon map: static Gaussians merged in voxels.
//!
//! One Gaussian per voxel, by confidence-weighted moment matching of all that fell into it. Positions are kept relative
//! to their voxel and voxels relative to an f64 origin, so the size of map coordinates does not matter.

mod cell;
mod cloud;
mod eigen;
mod hash;
mod select;

use std::collections::HashMap;

use glam::{DMat3, DVec3, Quat, Vec3};
use serde::Serialize;
use storm_render::Gaussians;

use crate::config::MapConfig;
use crate::rigid::Rigid;
use cell::{Cell, Sample, covariance};
pub use cloud::MapCloud;
use hash::VoxelHash;
pub use select::{color01, confidence, static_weight};

/// Part of a full map that goes at once when it is full: few enough to be a small loss, enough that finding them is
/// paid for by many insertions.
const EVICTED_PART: usize = 64;

/// Standard deviations beyond this are no surface but a mistake, metres (and their squares stay far inside f32).
const MAX_SCALE_M: f32 = 1e3;

/// Weights beyond this are a mistake of the caller; sums of them stay finite.
const MAX_SAMPLE_WEIGHT: f32 = 1e6;

/// Colours beyond this are a mistake; the network's lie near -1 to 1.
const MAX_COLOR: f32 = 1e3;

/// Voxel indices beyond this are refused: half of what fits, so that neighbours exist.
const MAX_INDEX: f64 = (1 << 30) as f64;

/// What became of the Gaussians.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct MapCounts {
    /// Merged into a voxel that held something.
    pub merged: u64,
    /// First of their voxel.
    pub created: u64,
    /// Not selected by the caller.
    pub skipped: u64,
    /// Refused: a number not finite or out of range.
    pub rejected: u64,
    /// Voxels given up because the map was full, the least confident first.
    pub evicted: u64,
}

impl MapCounts {
    fn add(&mut self, other: &Self) {
        self.merged += other.merged;
        self.created += other.created;
        self.skipped += other.skipped;
        self.rejected += other.rejected;
        self.evicted += other.evicted;
    }
}

/// The map. Bounded by `map.max_gaussians`; its content depends on what was inserted in which order, and on nothing
/// else.
#[derive(Debug)]
pub struct VoxelMap {
    voxel_m: f64,
    max_cells: usize,
    origin: Option<DVec3>,
    cells: Vec<Cell>,
    index: HashMap<[i32; 3], u32, VoxelHash>,
    counts: MapCounts,
}

impl VoxelMap {
    /// An empty map; its origin is the first anchor's position.
    pub fn new(config: &MapConfig) -> Self {
        Self {
            voxel_m: config.voxel_m,
            max_cells: config.max_gaussians.clamp(1, u32::MAX as usize),
            origin: None,
            cells: Vec::new(),
            index: HashMap::default(),
            counts: MapCounts::default(),
        }
    }

    /// Places the origin (map frame, metres) before the first insertion; false, and nothing done, after it.
    pub fn set_origin(&mut self, origin: DVec3) -> bool {
        let free = self.origin.is_none() && origin.is_finite();
        if free {
            self.origin = Some(origin);
        }
        free
    }

    /// What positions of [`VoxelMap::cloud`] are relative to, in the map frame, metres; zero before the first
    /// insertion.
    pub fn origin(&self) -> DVec3 {
        self.origin.unwrap_or(DVec3::ZERO)
    }

    /// Merges Gaussians of one window, given in its anchor frame.
    ///
    /// `select(i)` gives Gaussian `i`'s confidence, or none to leave it out (see [`static_weight`]); `color(i)` its
    /// colour, 0 to 1, already corrected for its camera's exposure (see [`color01`]). What is not finite is left out
    /// and counted.
    pub fn insert(
        &mut self,
        map_from_anchor: &Rigid,
        gaussians: &Gaussians,
        select: impl Fn(usize) -> Option<f32>,
        color: impl Fn(usize) -> [f32; 3],
    ) -> MapCounts {
        let mut counts = MapCounts::default();
        let n = gaussians.len();
        let whole = gaussians.quats.len() == n && gaussians.scales.len() == n && gaussians.opacities.len() == n;
        if !(whole && map_from_anchor.is_finite()) {
            counts.rejected = n as u64;
            self.counts.add(&counts);
            return counts;
        }
        let origin = *self.origin.get_or_insert(map_from_anchor.translation);
        let placed = Placed {
            origin_from_anchor: Rigid::new(map_from_anchor.rotation, map_from_anchor.translation - origin)
                .snapped()
                .translation,
            turn: map_from_anchor.matrix3(),
            rotation: map_from_anchor.rotation.as_quat(),
            voxel_m: self.voxel_m,
        };
        for i in 0..n {
            let Some(weight) = select(i) else {
                counts.skipped += 1;
                continue;
            };
            let Some((key, sample)) = placed.sample(gaussians, i, weight, color(i)) else {
                counts.rejected += 1;
                continue;
            };
            if let Some(&at) = self.index.get(&key) {
                self.cells[at as usize].merge(&sample);
                counts.merged += 1;
            } else {
                if self.cells.len() >= self.max_cells {
                    counts.evicted += self.evict();
                }
                self.index.insert(key, self.cells.len() as u32);
                self.cells.push(Cell::new(key, &sample));
                counts.created += 1;
            }
        }
        self.counts.add(&counts);
        counts
    }

    /// Gaussians in the map, one per occupied voxel.
    pub fn len(&self) -> usize {
        self.cells.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.cells.is_empty()
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        // A hash table entry is its key and value, one control byte, and the eighth that stays free.
        let entry = (size_of::<([i32; 3], u32)>() + 1) * 8 / 7;
        self.cells.capacity() * size_of::<Cell>() + self.index.capacity() * entry
    }

    /// What became of everything inserted so far.
    pub fn counts(&self) -> MapCounts {
        self.counts
    }

    /// The map as plain arrays, sorted by voxel.
    pub fn cloud(&self) -> MapCloud {
        MapCloud::from_cells(self.origin(), self.voxel_m, &self.cells)
    }

    /// Gives up the least confident cells; of equals, the ones first in the list. Returns how many.
    fn evict(&mut self) -> u64 {
        let n = (self.cells.len() / EVICTED_PART).max(1);
        // Positive floats order as their bits do, so weight and place fit in one number that is quick to compare.
        let rank = |(i, c): (usize, &Cell)| u64::from(c.weight.to_bits()) << 32 | i as u64;
        let mut order: Vec<u64> = self.cells.iter().enumerate().map(rank).collect();
        order.select_nth_unstable(n - 1);
        order.truncate(n);
        let mut places: Vec<u32> = order.into_iter().map(|r| r as u32).collect();
        // From the back, so that what moves into a hole is never itself about to go.
        places.sort_unstable_by(|a, b| b.cmp(a));
        for at in places {
            let gone = self.cells.swap_remove(at as usize);
            self.index.remove(&gone.key);
            if let Some(moved) = self.cells.get(at as usize) {
                self.index.insert(moved.key, at);
            }
        }
        n as u64
    }
}

/// One window's place in the map.
struct Placed {
    origin_from_anchor: DVec3,
    /// The same rotation twice: for positions in f64, for shapes in f32.
    turn: DMat3,
    rotation: Quat,
    voxel_m: f64,
}

impl Placed {
    /// Gaussian `i`'s voxel and moments; none when a number is not finite or out of range.
    fn sample(&self, g: &Gaussians, i: usize, weight: f32, color: [f32; 3]) -> Option<([i32; 3], Sample)> {
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
        let position = self.origin_from_anchor + self.turn * mean.as_dvec3();
        let index = (position / self.voxel_m).floor();
        if index.abs().max_element() <= MAX_INDEX {
            let offset = (position - (index + 0.5) * self.voxel_m).as_vec3();
            let cov = covariance(self.rotation * (q * (1.0 / norm)), scale);
            let key = [index.x as i32, index.y as i32, index.z as i32];
            return Some((key, Sample { offset, cov, color, opacity, weight }));
        }
        None
    }
}

#[cfg(test)]
mod tests;
