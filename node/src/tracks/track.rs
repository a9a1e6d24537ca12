//! Points that trajectories are made of, and a trajectory that has ended.

use glam::DVec3;

use crate::sync::clock::seconds_between;

/// A moving Gaussian of the newest timestep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPoint {
    /// Centre in the map frame, metres.
    pub position_map: DVec3,
    /// Velocity in the map frame's axes, m/s.
    pub velocity_map_mps: DVec3,
    /// Opacity, 0 to 1.
    pub opacity: f32,
    /// Motion token with the largest weight.
    pub motion_id: u16,
    /// Colour, 0 to 1.
    pub color01: [f32; 3],
    /// Distance from the camera that saw it, metres.
    pub distance_m: f32,
    /// Whether a trajectory may start here (a surface long known to stand should not start one).
    pub may_start: bool,
}

/// One point of a trajectory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackSample {
    /// The step's stamp, nanoseconds.
    pub stamp_ns: i64,
    /// Place in the map frame, metres.
    pub position_map: DVec3,
    /// Velocity in the map frame's axes, m/s.
    pub velocity_map_mps: DVec3,
    /// Motion token of the Gaussian it is at.
    pub motion_id: u16,
}

/// One trajectory that has ended, or a piece of one that is too long to be kept whole.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// Unique within a run, in order of birth; pieces of one trajectory share it.
    pub id: u32,
    /// Oldest first, stamps strictly rising; steps it was not seen at are left out.
    pub points: Vec<TrackSample>,
}

impl Track {
    /// Place and velocity (map frame, m and m/s) at any time between its first and last point, by the cubic that has
    /// the points' places and velocities; none outside.
    pub fn at(&self, stamp_ns: i64) -> Option<(DVec3, DVec3)> {
        let after = self.points.partition_point(|p| p.stamp_ns < stamp_ns);
        let b = self.points.get(after)?;
        if b.stamp_ns == stamp_ns {
            return Some((b.position_map, b.velocity_map_mps));
        }
        let a = self.points.get(after.checked_sub(1)?)?;
        let span = seconds_between(a.stamp_ns, b.stamp_ns);
        let s = seconds_between(a.stamp_ns, stamp_ns) / span;
        let (va, vb, d) = (a.velocity_map_mps * span, b.velocity_map_mps * span, b.position_map - a.position_map);
        // Hermite's cubic in powers of s.
        let (c2, c3) = (3.0 * d - 2.0 * va - vb, va + vb - 2.0 * d);
        let position = a.position_map + s * (va + s * (c2 + s * c3));
        Some((position, (va + s * (2.0 * c2 + 3.0 * s * c3)) / span))
    }
}
