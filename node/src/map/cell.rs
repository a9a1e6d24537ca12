//! One voxel: the weighted moments of the Gaussians that fell into it.

use glam::{Mat3, Quat, Vec3};

/// A cell's weight stops growing here: f32 still tells a new observation of weight 1e-4 apart from none at this size,
/// and a place seen for hours can still change.
const MAX_WEIGHT: f32 = 1e3;

/// What one Gaussian brings, in map axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// Centre relative to the cell's centre, metres.
    pub offset: Vec3,
    /// Covariance xx, xy, xz, yy, yz, zz, m^2.
    pub cov: [f32; 6],
    /// Colour, 0 to 1.
    pub color: Vec3,
    pub opacity: f32,
    /// Confidence, above 0.
    pub weight: f32,
}

/// Weighted mean of position, colour and opacity, and the covariance of the mixture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    pub key: [i32; 3],
    pub weight: f32,
    pub offset: Vec3,
    pub color: Vec3,
    pub opacity: f32,
    pub cov: [f32; 6],
}

impl Cell {
    pub fn new(key: [i32; 3], s: &Sample) -> Self {
        Self { key, weight: s.weight.min(MAX_WEIGHT), offset: s.offset, color: s.color, opacity: s.opacity, cov: s.cov }
    }

    /// Moment matching of the mixture so far with one more component: with share `a` of the weight and the means `d`
    /// apart, mean += a d, and cov = (1 - a) cov + a cov_new + a (1 - a) d d^T.
    pub fn merge(&mut self, s: &Sample) {
        let total = self.weight + s.weight;
        let a = s.weight / total;
        let d = s.offset - self.offset;
        let outer = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
        for k in 0..6 {
            self.cov[k] += a * (s.cov[k] - self.cov[k] + (1.0 - a) * outer[k]);
        }
        self.offset += a * d;
        self.color += a * (s.color - self.color);
        self.opacity += a * (s.opacity - self.opacity);
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
