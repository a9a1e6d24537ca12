//! Eight Gaussians at a time, read once for all views.

use super::Splats;
use super::settings::{ALPHA_MIN, OPACITY_CEILING};
use super::simd::ln_lanes;

/// Gaussians projected together.
pub(crate) const LANES: usize = 8;
/// One number for each Gaussian of a block.
pub(crate) type Lane = [f64; LANES];

/// Where eight Gaussians stand.
#[derive(Debug, Clone)]
pub(crate) struct Centers {
    pub(crate) mean: [Lane; 3],
    /// False for lanes past the end and for Gaussians with a non-finite number or a zero quaternion.
    pub(crate) usable: [bool; LANES],
}

/// What eight Gaussians look like, wherever they stand and whoever looks: motion moves centres only, so this is the
/// same at all times.
#[derive(Debug, Clone)]
pub(crate) struct Shapes {
    /// `R S`, row-major; the 3D covariance is `R S (R S)^T`.
    pub(crate) axes: [[Lane; 3]; 3],
    /// Largest squared scale.
    pub(crate) size2: Lane,
    /// `2 ln(255 o)`: squared standard deviations at which alpha falls to 1/255; negative when it never reaches it.
    pub(crate) reach2: Lane,
}

/// Eight Gaussians, independent of any view.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    pub(crate) centers: Centers,
    pub(crate) shapes: Shapes,
}

impl Centers {
    pub(crate) fn new() -> Self {
        Self { mean: [[0.0; LANES]; 3], usable: [false; LANES] }
    }
}

impl Block {
    pub(crate) fn new() -> Self {
        let zero = [0.0; LANES];
        Self { centers: Centers::new(), shapes: Shapes { axes: [[zero; 3]; 3], size2: zero, reach2: zero } }
    }

    /// Reads `count` Gaussians from `start` on; returns how many of them are invalid.
    /// `features_finite` says that the caller has looked at the features already.
    #[inline(always)]
    pub(crate) fn load(&mut self, splats: &Splats, start: usize, count: usize, features_finite: bool) -> usize {
        let Self { centers, shapes } = self;
        let zero = [0.0; LANES];
        let (mut quat, mut scale, mut reach) = ([zero; 4], [zero; 3], zero);
        let mut invalid = 0;
        centers.usable = [false; LANES];
        for l in 0..count.min(LANES) {
            let i = start + l;
            let (m, q, s, o) = (&splats.means[i], &splats.quats[i], &splats.scales[i], splats.opacities[i]);
            // A sum of products with 0 is 0, or NaN when any factor is not finite.
            let zeros =
                (m[0] + m[1] + m[2]) * 0.0 + (s[0] + s[1] + s[2]) * 0.0 + o * 0.0 + (q[0] + q[1] + q[2] + q[3]) * 0.0;
            let orientation = q[0] != 0.0 || q[1] != 0.0 || q[2] != 0.0 || q[3] != 0.0;
            // Sums of huge numbers may overflow where each is finite: those take the careful look too.
            let usable = (zeros == 0.0 && orientation && features_finite) || splats.is_usable(i);
            centers.usable[l] = usable;
            invalid += usize::from(!usable);
            for axis in 0..3 {
                centers.mean[axis][l] = if usable { f64::from(m[axis]) } else { 0.0 };
                scale[axis][l] = if usable { f64::from(s[axis]) } else { 0.0 };
            }
            for axis in 0..4 {
                quat[axis][l] = if usable { f64::from(q[axis]) } else { 1.0 };
            }
            let o = o.min(OPACITY_CEILING);
            reach[l] = if usable && o >= ALPHA_MIN { f64::from(o / ALPHA_MIN) } else { 0.0 };
        }
        for l in count..LANES {
            quat[0][l] = 1.0;
        }
        shapes.set(&quat, &scale, &reach);
        invalid
    }
}

impl Shapes {
    /// From quaternions, scales and `255 o` (0 for what is too faint to show).
    #[inline(always)]
    fn set(&mut self, quat: &[Lane; 4], scale: &[Lane; 3], reach: &Lane) {
        let mut ln = [1.0; LANES];
        for l in 0..LANES {
            ln[l] = reach[l].max(1.0);
        }
        ln_lanes(&mut ln);
        for l in 0..LANES {
            self.reach2[l] = if reach[l] >= 1.0 { 2.0 * ln[l] } else { -1.0 };
        }
        for l in 0..LANES {
            let (w, x, y, z) = (quat[0][l], quat[1][l], quat[2][l], quat[3][l]);
            let twice = 2.0 / (w * w + x * x + y * y + z * z);
            let (s0, s1, s2) = (scale[0][l], scale[1][l], scale[2][l]);
            let (xx, yy, zz) = (twice * x * x, twice * y * y, twice * z * z);
            let (xy, xz, yz) = (twice * x * y, twice * x * z, twice * y * z);
            let (wx, wy, wz) = (twice * w * x, twice * w * y, twice * w * z);
            self.axes[0][0][l] = (1.0 - (yy + zz)) * s0;
            self.axes[0][1][l] = (xy - wz) * s1;
            self.axes[0][2][l] = (xz + wy) * s2;
            self.axes[1][0][l] = (xy + wz) * s0;
            self.axes[1][1][l] = (1.0 - (xx + zz)) * s1;
            self.axes[1][2][l] = (yz - wx) * s2;
            self.axes[2][0][l] = (xz - wy) * s0;
            self.axes[2][1][l] = (yz + wx) * s1;
            self.axes[2][2][l] = (1.0 - (xx + yy)) * s2;
            self.size2[l] = (s0 * s0).max(s1 * s1).max(s2 * s2);
        }
    }
}
