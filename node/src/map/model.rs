//! The Gaussians of one moving object in its own frame: a tile that travels.

use glam::{DVec3, Quat, Vec3};

use super::cell::{Sample, covariance};
use super::cloud::MapCloud;
use super::select::confidence;
use super::tile::{Tile, TileCounts};

/// Half the cube an object may fill, metres: the longest road trains are 25 m, and the frame's origin is somewhere in
/// them.
const HALF_M: f32 = 24.0;
/// Cells seen at only one step while more than this many were possible are left out of the box: one stray Gaussian
/// must not double it.
const BOX_STEPS: u32 = 5;

/// A Gaussian in an object's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectSample {
    /// Centre, metres.
    pub position: Vec3,
    /// Orientation, unit.
    pub rotation: Quat,
    /// Standard deviations, metres.
    pub scale: Vec3,
    /// Colour, 0 to 1.
    pub color01: [f32; 3],
    /// Opacity, 0 to 1.
    pub opacity: f32,
    /// Distance from the camera, metres.
    pub distance_m: f32,
}

/// What is known of an object's look.
#[derive(Debug, Clone, Default)]
pub struct ObjectModel {
    tile: Option<Tile>,
    voxel_m: f32,
    steps: u32,
    low: Vec3,
    high: Vec3,
}

impl ObjectModel {
    /// Merges Gaussians of one step (numbered from 0) into voxels of `voxel_m`.
    pub fn add(&mut self, samples: impl Iterator<Item = ObjectSample>, voxel_m: f32, step: u32) {
        // The tile numbers at most 512 voxels along an edge.
        let voxel_m = voxel_m.max(2.0 * HALF_M / super::voxel::MAX_PER_EDGE as f32);
        let tile = self.tile.get_or_insert_with(|| Tile::new([0; 3], f64::from(voxel_m)));
        (self.voxel_m, self.steps) = (voxel_m, self.steps.max(step + 1));
        let mut counts = TileCounts::default();
        for s in samples {
            let inside = s.position.abs().max_element() < HALF_M && s.opacity > 0.0 && s.opacity <= 1.0;
            let weight = confidence(s.opacity, s.distance_m);
            if !(inside && weight > 0.0 && s.scale.min_element() >= 0.0) {
                continue;
            }
            let sample = Sample {
                position: s.position + HALF_M,
                cov: covariance(s.rotation, s.scale),
                color: s.color01.into(),
                opacity: s.opacity,
                weight,
                ray: Vec3::ZERO,
                gate_m: 0.0,
                level: 0,
                fresh: true,
            };
            tile.add(&sample, step, &mut counts);
        }
        let often = self.steps > BOX_STEPS;
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for c in tile.live().filter(|c| !often || c.seen_ms > c.born_ms) {
            low = low.min(c.position - HALF_M);
            high = high.max(c.position - HALF_M);
        }
        if low.cmple(high).all() {
            (self.low, self.high) = (low, high);
        }
    }

    /// Lowest and highest corner of the box around it, metres.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        (self.low, self.high)
    }

    /// Its Gaussians as plain arrays in its own frame.
    pub fn cloud(&self) -> MapCloud {
        let mut cloud = MapCloud::empty(DVec3::ZERO);
        if let Some(tile) = &self.tile {
            let live: Vec<_> = tile.live().copied().collect();
            cloud.push_cells(DVec3::splat(-f64::from(HALF_M)), f64::from(self.voxel_m), &live, true);
        }
        cloud
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        self.tile.as_ref().map_or(0, Tile::bytes)
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.tile.as_ref().map_or(0, Tile::len)
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
