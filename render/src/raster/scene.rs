//! What goes in and what comes out: splats, pictures, counts; and the checks on what goes in.

use super::RasterError;
use crate::camera::View;

/// Longest picture side, pixels: bounding boxes are kept in 16 bits.
pub const MAX_SIDE: usize = 1 << 15;
/// Most numbers one picture may hold (4 GiB), so that no request can exhaust memory by its header alone.
pub const MAX_PICTURE_VALUES: usize = 1 << 30;
/// Most Gaussians of one call: their indices are kept in 32 bits.
pub const MAX_SPLATS: usize = 1 << 31;
/// Most channels per Gaussian: every thread holds a tile of them (10 MiB at most).
pub const MAX_FEATURES: usize = 1 << 12;
/// Most views of one call.
pub const MAX_VIEWS: usize = 1 << 10;
/// How far `R^T R` of a camera pose may be from identity: f32 rotations chained over a drive drift by about 1e-5.
const RIGID_TOLERANCE: f64 = 1e-3;

/// Borrowed Gaussians, structure of arrays; all in the frame that `View::camera_from_world` starts from.
#[derive(Debug, Clone, Copy)]
pub struct Splats<'a> {
    /// Centres, metres.
    pub means: &'a [[f32; 3]],
    /// Orientations w, x, y, z; any non-zero length.
    pub quats: &'a [[f32; 4]],
    /// Standard deviations along the local axes, metres.
    pub scales: &'a [[f32; 3]],
    /// Opacities, 0 to 1.
    pub opacities: &'a [f32],
    /// What is blended (colour, velocity, ...), row-major `n x feature_count`.
    pub features: &'a [f32],
    /// Channels per Gaussian; may be 0 for depth and alpha alone.
    pub feature_count: usize,
}

impl Splats<'_> {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Checks that the arrays belong together.
    pub fn validate(&self) -> Result<(), RasterError> {
        let n = self.means.len();
        if n > MAX_SPLATS {
            return Err(RasterError::TooMany { name: "Gaussians", value: n, limit: MAX_SPLATS });
        }
        if self.feature_count > MAX_FEATURES {
            return Err(RasterError::TooMany { name: "channels", value: self.feature_count, limit: MAX_FEATURES });
        }
        let check = |name, len, expected| {
            (len == expected).then_some(()).ok_or(RasterError::Length { name, len, expected, splats: n })
        };
        check("quats", self.quats.len(), n)?;
        check("scales", self.scales.len(), n)?;
        check("opacities", self.opacities.len(), n)?;
        check("features", self.features.len(), n.saturating_mul(self.feature_count))
    }

    /// Features of Gaussian `i`; empty when there are none.
    pub(crate) fn feature_row(&self, i: usize) -> &[f32] {
        let start = i * self.feature_count;
        self.features.get(start..start + self.feature_count).unwrap_or_default()
    }

    /// True when Gaussian `i` (below `len`) has only finite numbers and an orientation.
    pub(crate) fn is_usable(&self, i: usize) -> bool {
        let q = &self.quats[i];
        self.means[i].iter().chain(q).chain(&self.scales[i]).all(|x| x.is_finite())
            && q.iter().any(|&x| x != 0.0)
            && self.opacities[i].is_finite()
            && self.feature_row(i).iter().all(|x| x.is_finite())
    }
}

/// One rendered view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Picture {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Channels per pixel.
    pub feature_count: usize,
    /// `sum(w f)` per pixel, row-major `height x width x feature_count`; no background is added.
    pub features: Vec<f32>,
    /// `sum(w)` per pixel, 0 to 1.
    pub alpha: Vec<f32>,
    /// Expected z-depth `sum(w z) / max(sum(w), 1e-10)` per pixel, metres; 0 where nothing is hit.
    pub depth: Vec<f32>,
}

impl Picture {
    /// Sets the size; values are kept or zero, to be overwritten.
    pub(crate) fn resize(&mut self, width: usize, height: usize, feature_count: usize) {
        let pixels = width * height;
        (self.width, self.height, self.feature_count) = (width, height, feature_count);
        self.features.resize(pixels * feature_count, 0.0);
        self.alpha.resize(pixels, 0.0);
        self.depth.resize(pixels, 0.0);
    }
}

/// Counts of one call of `render`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterStats {
    /// Gaussians given.
    pub splats: usize,
    /// Gaussians skipped for a non-finite number or a zero quaternion.
    pub invalid: usize,
    /// Valid Gaussians outside a view's frustum, too small or too faint for the convention; summed over the views.
    pub culled: usize,
    /// Valid Gaussians the convention would blend; summed over the views.
    pub visible: usize,
    /// Entries of all tile lists (a Gaussian counts once per tile one of its pixels can lie in).
    pub pairs: usize,
}

/// What one call had to do, and what it could leave undone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterWork {
    /// 3D covariances worked out; none when loaded Gaussians are drawn.
    pub shapes: usize,
    /// Gaussians passed over unread, as their group is outside of the view; summed over the views.
    pub unread: usize,
    /// Visible Gaussians with a pixel where they may reach 1/255, so that they are listed; summed over the views. The
    /// others are too faint, or too small and between pixel centres.
    pub listed: usize,
    /// Entries of tile lists that met an unfinished pixel and were blended; the rest is hidden.
    pub blended: usize,
    /// Runs of eight pixels shaded for these.
    pub sweeps: usize,
}

/// Checks that every view can be rendered with `feature_count` channels.
pub(crate) fn validate_views(views: &[View], feature_count: usize) -> Result<(), RasterError> {
    if views.len() > MAX_VIEWS {
        return Err(RasterError::TooMany { name: "views", value: views.len(), limit: MAX_VIEWS });
    }
    for (index, view) in views.iter().enumerate() {
        let refuse = |what: String| Err(RasterError::View { view: index, what });
        let camera = &view.intrinsics;
        if !camera.is_valid() {
            return refuse(format!("intrinsics {camera:?} need finite numbers, positive focal lengths and pixels"));
        }
        let (width, height) = (camera.width, camera.height);
        if width > MAX_SIDE || height > MAX_SIDE {
            return refuse(format!("{width}x{height} pixels; no side may exceed {MAX_SIDE}"));
        }
        let values = (width * height).saturating_mul(feature_count.max(1));
        if values > MAX_PICTURE_VALUES {
            return refuse(format!(
                "{width}x{height}x{feature_count} values; at most {MAX_PICTURE_VALUES} fit a picture"
            ));
        }
        let pose = &view.camera_from_world;
        let deviation = rigid_deviation(view);
        if !(pose.is_finite() && deviation <= RIGID_TOLERANCE) {
            return refuse(format!("camera_from_world is not rigid (R^T R is {deviation} from identity); pass a pose"));
        }
    }
    Ok(())
}

/// Largest entry of `R^T R - I`.
fn rigid_deviation(view: &View) -> f64 {
    let r = view.camera_from_world.matrix3.to_cols_array_2d().map(|col| col.map(f64::from));
    let mut worst = 0.0f64;
    for i in 0..3 {
        for j in 0..3 {
            let dot: f64 = (0..3).map(|k| r[i][k] * r[j][k]).sum();
            let identity = f64::from(u8::from(i == j));
            worst = worst.max((dot - identity).abs());
        }
    }
    worst
}
