//! What is fixed before the first picture: whose rules to follow, the clip planes, the blur.

use super::RasterError;

/// A splat weaker than this at a pixel is skipped there (gsplat, every version).
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// A pixel is finished by the splat that would bring its transmittance to this or below; that splat is left out.
pub const TRANSMITTANCE_STOP: f32 = 1e-4;
/// Side of the square tiles, pixels, in which gsplat blends a splat or leaves it out.
pub const TILE_RULE: usize = 16;
/// Depth is divided by at least this much alpha, so that pixels nothing hits get depth 0.
pub const ALPHA_FLOOR: f32 = 1e-10;
/// Largest standard deviation multiple of the [`Convention::Latest`] rectangle.
pub const LATEST_EXTENT: f64 = 3.33;
/// Floor of the discriminant in gsplat's larger eigenvalue.
pub const DISCRIMINANT_FLOOR: f64 = 0.01;
/// Opacities above this are taken as this: an opacity is at most 1, and up to here the fast `exp2` may end at `2^-100`.
pub const OPACITY_CEILING: f32 = 1e18;

/// Whose splatting rules are followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Convention {
    /// gsplat commit 2b0de894 (v1.0.0), which the STORM authors pin: field of view clamp symmetric about the optical
    /// axis, a square of `ceil(3 sigma)` of the larger axis, alpha capped at 0.999.
    #[default]
    Pinned,
    /// gsplat v1.5 to main: clamp aware of the principal point, a rectangle of `min(3.33, sqrt(2 ln(255 o)))` standard
    /// deviations per axis, opacities below 1/255 culled, alpha capped at 0.99.
    Latest,
}

impl Convention {
    /// Largest alpha of one splat at one pixel.
    pub fn alpha_cap(self) -> f32 {
        match self {
            Self::Pinned => 0.999,
            Self::Latest => 0.99,
        }
    }
}

/// Settings of a rasteriser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterSettings {
    /// Whose rules to follow.
    pub convention: Convention,
    /// Gaussians with a smaller camera z are culled, metres.
    pub near: f32,
    /// Gaussians with a larger camera z are culled, metres.
    pub far: f32,
    /// Gaussians whose radius is at most this are culled, pixels (`Latest`: both half sides of the rectangle).
    pub radius_clip: f32,
    /// Variance added to both axes of every splat, square pixels.
    pub blur: f32,
}

impl Default for RasterSettings {
    fn default() -> Self {
        Self { convention: Convention::Pinned, near: 0.2, far: 400.0, radius_clip: 0.0, blur: 0.3 }
    }
}

impl RasterSettings {
    /// Refuses planes, radii and blurs that mean nothing.
    pub fn validate(&self) -> Result<(), RasterError> {
        let refuse = |name, value, need| Err(RasterError::Setting { name, value, need });
        if !(self.near.is_finite() && self.near > 0.0) {
            return refuse("near", self.near, "a positive distance in metres");
        }
        if !(self.far.is_finite() && self.far > self.near) {
            return refuse("far", self.far, "a finite distance beyond near");
        }
        if !(self.radius_clip.is_finite() && self.radius_clip >= 0.0) {
            return refuse("radius_clip", self.radius_clip, "a radius of 0 pixels or more");
        }
        if !(self.blur.is_finite() && self.blur >= 0.0) {
            return refuse("blur", self.blur, "a variance of 0 square pixels or more");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_mean_nothing_are_refused() {
        let good = RasterSettings::default();
        assert!(good.validate().is_ok());
        for bad in [f32::NAN, f32::INFINITY, -1.0] {
            assert!(RasterSettings { near: bad, ..good }.validate().is_err());
            assert!(RasterSettings { far: bad, ..good }.validate().is_err());
            assert!(RasterSettings { radius_clip: bad, ..good }.validate().is_err());
            assert!(RasterSettings { blur: bad, ..good }.validate().is_err());
        }
        assert!(RasterSettings { near: 0.0, ..good }.validate().is_err());
        assert!(RasterSettings { far: 0.2, ..good }.validate().is_err());
    }
}
