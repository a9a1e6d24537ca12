//! One voxel: the weighted moments of the Gaussians that fell into it, and how well they stand up to what was seen since.

use glam::{Mat3, Quat, Vec3};

/// A cell's weight stops growing here: f32 still tells a new observation of weight 1e-4 apart from none at this size,
/// and a place seen for hours can still change.
pub(super) const MAX_WEIGHT: f32 = 1e3;

/// What a first look gives a cell.
pub(super) const SUPPORT_NEW: f32 = 0.9;
/// What a further look adds, and a ray that passes clearly through takes away. Equal, so that a cell goes once it was
/// passed through more often than seen.
const SUPPORT_STEP: f32 = 0.6;
/// Most support: whatever stood for minutes (a parked car) is gone after this many divided by the step clear looks,
/// which is half a second at 10 Hz.
pub(super) const SUPPORT_MAX: f32 = 3.0;

/// What one Gaussian brings, in map axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// Centre relative to the tile's corner, metres.
    pub position: Vec3,
    /// Covariance xx, xy, xz, yy, yz, zz, m^2.
    pub cov: [f32; 6],
    /// Colour, 0 to 1.
    pub color: Vec3,
    pub opacity: f32,
    /// Confidence, above 0.
    pub weight: f32,
    /// Direction from the camera, unit; zero when not known.
    pub ray: Vec3,
    /// How far along the ray a surface may be and still be the same one, metres; 0: only in the same voxel.
    pub gate_m: f32,
    /// Size of its voxel: the finest one's edge times 2^level.
    pub level: u32,
    /// A new look: it may start a cell and counts for it. Else a second opinion on an old one.
    pub fresh: bool,
}

/// Weighted mean of position, colour and opacity, and the covariance of the mixture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cell {
    /// Voxel within the tile ([`super::voxel`]).
    pub key: u32,
    /// When it was first and last seen, milliseconds since the map's first window.
    pub born_ms: u32,
    pub seen_ms: u32,
    /// Relative to the tile's corner, metres.
    pub position: Vec3,
    pub cov: [f32; 6],
    pub color: Vec3,
    pub opacity: f32,
    pub weight: f32,
    /// Looks that saw it less rays that passed through, between 0 and [`SUPPORT_MAX`]; 0: about to go.
    pub support: f32,
}

impl Cell {
    pub fn new(key: u32, s: &Sample, now_ms: u32) -> Self {
        Self {
            key,
            born_ms: now_ms,
            seen_ms: now_ms,
            position: s.position,
            cov: s.cov,
            color: s.color,
            opacity: s.opacity,
            weight: s.weight.min(MAX_WEIGHT),
            support: SUPPORT_NEW,
        }
    }

    /// Takes one more look in.
    pub fn merge(&mut self, s: &Sample, now_ms: u32) {
        self.blend(s.weight, s.position, &s.cov, s.color, s.opacity);
        // Several Gaussians of one moment are one look.
        if s.fresh && self.seen_ms != now_ms {
            self.seen_ms = now_ms;
            self.support = (self.support + SUPPORT_STEP).min(SUPPORT_MAX);
        }
    }

    /// Takes another cell of the same place in.
    pub fn absorb(&mut self, other: &Self) {
        self.blend(other.weight, other.position, &other.cov, other.color, other.opacity);
        self.born_ms = self.born_ms.min(other.born_ms);
        self.seen_ms = self.seen_ms.max(other.seen_ms);
        self.support = self.support.max(other.support);
    }

    /// A ray passed clearly through; true when the cell has to go.
    pub fn contradict(&mut self) -> bool {
        self.support -= SUPPORT_STEP;
        self.support <= 0.0
    }

    /// Moment matching of the mixture so far with one more component: with share `a` of the weight and the means `d`
    /// apart, mean += a d, and cov = (1 - a) cov + a cov_new + a (1 - a) d d^T.
    fn blend(&mut self, weight: f32, position: Vec3, cov: &[f32; 6], color: Vec3, opacity: f32) {
        let total = self.weight + weight;
        let a = weight / total;
        let d = position - self.position;
        let outer = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
        for k in 0..6 {
            self.cov[k] += a * (cov[k] - self.cov[k] + (1.0 - a) * outer[k]);
        }
        self.position += a * d;
        self.color += a * (color - self.color);
        self.opacity += a * (opacity - self.opacity);
        self.weight = total.min(MAX_WEIGHT);
    }
}

/// Covariance of a Gaussian with unit rotation `q` and standard deviations `scale`.
pub(super) fn covariance(q: Quat, scale: Vec3) -> [f32; 6] {
    let r = Mat3::from_quat(q);
    let (a, b, c) = (r.x_axis * scale.x, r.y_axis * scale.y, r.z_axis * scale.z);
    let e = |i: usize, j: usize| a[i] * a[j] + b[i] * b[j] + c[i] * c[j];
    [e(0, 0), e(0, 1), e(0, 2), e(1, 1), e(1, 2), e(2, 2)]
}

/// A covariance in turned axes.
pub(super) fn turned(cov: &[f32; 6], r: &Mat3) -> [f32; 6] {
    let &[xx, xy, xz, yy, yz, zz] = cov;
    let m = Mat3::from_cols(Vec3::new(xx, xy, xz), Vec3::new(xy, yy, yz), Vec3::new(xz, yz, zz));
    let t = *r * m * r.transpose();
    [t.x_axis.x, t.x_axis.y, t.x_axis.z, t.y_axis.y, t.y_axis.z, t.z_axis.z]
}

/// Variance along a unit direction.
pub(super) fn along(cov: &[f32; 6], d: Vec3) -> f32 {
    let &[xx, xy, xz, yy, yz, zz] = cov;
    d.x * d.x * xx + d.y * d.y * yy + d.z * d.z * zz + 2.0 * (d.x * d.y * xy + d.x * d.z * xz + d.y * d.z * yz)
}
