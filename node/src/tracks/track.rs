//! A trajectory, and what is remembered of it to find its next point.

use glam::{DVec3, Vec3};

use crate::config::TracksConfig;
use crate::sync::clock::seconds_between;

/// A trajectory's points are handed out in pieces of at most this many, so that memory stays bounded behind a lead
/// vehicle that never leaves: a minute at 10 Hz.
pub(super) const PIECE_POINTS: usize = 600;

/// What a new trajectory's speed may be off by, m/s.
const NEW_SPEED_SIGMA_MPS: f64 = 1.0;
/// Bounds of what is learned: nobody's speed is known better, and beyond the upper one nothing is known.
const SPEED_SIGMA_MPS: std::ops::RangeInclusive<f64> = 0.2..=4.0;
/// Share of a new deviation in the learned one, and of a new colour in the remembered one.
const LEARN: f64 = 0.3;

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

/// One trajectory, or a piece of one that is too long to be kept whole.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// Unique within a run, in order of birth; pieces of one trajectory share it.
    pub id: u32,
    /// Oldest first, stamps strictly rising; steps it was not seen at are left out.
    pub points: Vec<TrackSample>,
    /// Points handed out in earlier pieces.
    pub earlier: usize,
    /// The last point, here as well: every step asks every trajectory for it, and a list of its own is far away.
    end: TrackSample,
    color01: Vec3,
    speed_sigma_mps: f64,
    distance_m: f64,
}

/// Room for points at the start. Different for different trajectories, so that those born together do not all need more
/// in the same step.
const FIRST_POINTS: usize = 8;

impl Track {
    pub(super) fn new(id: u32, stamp_ns: i64, p: &TrackPoint) -> Self {
        let mut points = Vec::with_capacity(FIRST_POINTS + id as usize % FIRST_POINTS);
        points.push(sample(stamp_ns, p));
        Self {
            id,
            points,
            earlier: 0,
            end: sample(stamp_ns, p),
            color01: p.color01.into(),
            speed_sigma_mps: NEW_SPEED_SIGMA_MPS,
            distance_m: f64::from(p.distance_m),
        }
    }

    /// Its last point.
    pub fn end(&self) -> &TrackSample {
        &self.end
    }

    /// Where its end is at `stamp_ns`, moved by its own flow.
    pub(super) fn predicted(&self, stamp_ns: i64) -> DVec3 {
        self.end.position_map + self.end.velocity_map_mps * seconds_between(self.end.stamp_ns, stamp_ns)
    }

    /// How far from there its Gaussian may be at `stamp_ns`, metres: farther where its speed is not known well, and
    /// far from the camera, where pixels and depth errors are larger.
    pub(super) fn gate_m(&self, stamp_ns: i64, config: &TracksConfig) -> f64 {
        let unseen_sec = seconds_between(self.end.stamp_ns, stamp_ns).max(0.0);
        let gate = config.gate_m + config.gate_per_m * self.distance_m + self.speed_sigma_mps * unseen_sec;
        gate.min(config.max_gate_m.max(config.gate_m))
    }

    /// Whether a Gaussian looks like the last ones.
    pub(super) fn looks_like(&self, p: &TrackPoint, config: &TracksConfig) -> bool {
        let d = self.color01 - Vec3::from(p.color01);
        f64::from((d.length_squared() / 3.0).sqrt()) <= config.max_color_step
    }

    /// Continues at a Gaussian.
    pub(super) fn go_on(&mut self, stamp_ns: i64, p: &TrackPoint) {
        let dt_sec = seconds_between(self.end.stamp_ns, stamp_ns);
        if dt_sec > 0.0 {
            let off = (p.position_map - self.predicted(stamp_ns)).length() / dt_sec;
            let squared = self.speed_sigma_mps.powi(2);
            let learned = (squared + LEARN * (off * off - squared)).sqrt();
            self.speed_sigma_mps = learned.clamp(*SPEED_SIGMA_MPS.start(), *SPEED_SIGMA_MPS.end());
        }
        self.color01 += LEARN as f32 * (Vec3::from(p.color01) - self.color01);
        self.distance_m = f64::from(p.distance_m);
        self.end = sample(stamp_ns, p);
        self.points.push(self.end);
    }

    /// All points but the last as a piece of their own, once there are enough.
    pub(super) fn cut(&mut self) -> Option<Self> {
        if self.points.len() <= PIECE_POINTS {
            return None;
        }
        let rest = self.points.split_off(self.points.len() - 1);
        let points = std::mem::replace(&mut self.points, rest);
        let piece = Self { points, ..self.clone() };
        self.earlier += piece.points.len();
        Some(piece)
    }

    /// Memory of its points, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.points.capacity() * size_of::<TrackSample>()
    }

    /// Points so far, those handed out included.
    pub fn len(&self) -> usize {
        self.earlier + self.points.len()
    }

    /// True for a track without points; there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

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

fn sample(stamp_ns: i64, p: &TrackPoint) -> TrackSample {
    let TrackPoint { position_map, velocity_map_mps, motion_id, .. } = *p;
    TrackSample { stamp_ns, position_map, velocity_map_mps, motion_id }
}
