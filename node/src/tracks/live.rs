//! A trajectory that is alive: what is remembered of it to find its next point, and its points so far.

use glam::{DVec3, Vec3};

use super::track::{Track, TrackPoint, TrackSample};
use crate::config::TracksConfig;
use crate::sync::clock::seconds_between;

/// A trajectory's points are handed out in pieces of this many and a block or two more, so that memory stays bounded
/// behind a lead vehicle that never leaves: a minute at 10 Hz.
pub(super) const PIECE_POINTS: usize = 600;

/// What a new trajectory's speed may be off by, m/s.
const NEW_SPEED_SIGMA_MPS: f64 = 1.0;
/// Bounds of what is learned: nobody's speed is known better, and beyond the upper one nothing is known.
const SPEED_SIGMA_MPS: std::ops::RangeInclusive<f64> = 0.2..=4.0;
/// Share of a new deviation in the learned one, and of a new colour in the remembered one.
const LEARN: f64 = 0.3;

/// Points of a block; a list that moves when it grows would have all trajectories' lists moved every few steps.
const BLOCK: usize = 16;

/// One trajectory that may still go on.
#[derive(Debug)]
pub struct LiveTrack {
    /// Unique within a run, in order of birth.
    pub id: u32,
    /// Points so far.
    len: u32,
    /// The last point, here as well: every step asks every trajectory for it, and a list of its own is far away.
    end: TrackSample,
    color01: Vec3,
    distance_m: f32,
    speed_sigma_mps: f64,
    born_ns: i64,
    /// The newest points, a block that is never enlarged, and the full blocks before; without what was handed out.
    newest: Vec<TrackSample>,
    older: Vec<Vec<TrackSample>>,
}

impl LiveTrack {
    pub(super) fn new(id: u32, stamp_ns: i64, p: &TrackPoint) -> Self {
        // Different for different trajectories, so that those born together do not all need a block in the same step.
        let mut newest = Vec::with_capacity(1 + id as usize % BLOCK);
        let end = sample(stamp_ns, p);
        newest.push(end);
        Self {
            id,
            len: 1,
            end,
            color01: p.color01.into(),
            distance_m: p.distance_m,
            speed_sigma_mps: NEW_SPEED_SIGMA_MPS,
            born_ns: stamp_ns,
            newest,
            older: Vec::new(),
        }
    }

    /// Its last point.
    pub fn end(&self) -> &TrackSample {
        &self.end
    }

    /// Stamp of its first point, nanoseconds.
    pub fn born_ns(&self) -> i64 {
        self.born_ns
    }

    /// Where its end is at `stamp_ns`, moved by its own flow.
    pub(super) fn predicted(&self, stamp_ns: i64) -> DVec3 {
        self.end.position_map + self.end.velocity_map_mps * seconds_between(self.end.stamp_ns, stamp_ns)
    }

    /// How far from there its Gaussian may be at `stamp_ns`, metres: farther where its speed is not known well, and
    /// far from the camera, where pixels and depth errors are larger.
    pub(super) fn gate_m(&self, stamp_ns: i64, config: &TracksConfig) -> f64 {
        let unseen_sec = seconds_between(self.end.stamp_ns, stamp_ns).max(0.0);
        let gate = config.gate_m + config.gate_per_m * f64::from(self.distance_m) + self.speed_sigma_mps * unseen_sec;
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
        self.distance_m = p.distance_m;
        self.end = sample(stamp_ns, p);
        self.len += 1;
        if self.newest.len() == self.newest.capacity() {
            self.older.push(std::mem::replace(&mut self.newest, Vec::with_capacity(BLOCK)));
        }
        self.newest.push(self.end);
    }

    /// All points but the last as a piece of their own, once there are enough.
    pub(super) fn cut(&mut self) -> Option<Track> {
        // The oldest block may hold a single point, all others are full.
        if self.older.len() < PIECE_POINTS.div_ceil(BLOCK) + 1 {
            return None;
        }
        let mut piece = self.take();
        piece.points.pop();
        self.newest = Vec::with_capacity(BLOCK);
        self.newest.push(self.end);
        Some(piece)
    }

    /// What has not been handed out yet.
    pub(super) fn ended(mut self) -> Track {
        self.take()
    }

    fn take(&mut self) -> Track {
        let mut points = Vec::with_capacity(self.older.len() * BLOCK + self.newest.len());
        self.older.drain(..).for_each(|block| points.extend(block));
        points.append(&mut self.newest);
        Track { id: self.id, points }
    }

    /// Memory of its points, bytes.
    pub(super) fn bytes(&self) -> usize {
        let blocks = self.older.len() * BLOCK + self.newest.capacity();
        blocks * size_of::<TrackSample>() + self.older.capacity() * size_of::<Vec<TrackSample>>()
    }

    /// Points so far, those handed out included.
    pub fn len(&self) -> usize {
        self.len as usize
    }

    /// True for a trajectory without points; there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}

fn sample(stamp_ns: i64, p: &TrackPoint) -> TrackSample {
    let TrackPoint { position_map, velocity_map_mps, motion_id, .. } = *p;
    TrackSample { stamp_ns, position_map, velocity_map_mps, motion_id }
}
