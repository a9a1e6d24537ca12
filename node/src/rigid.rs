//! Rigid transforms in f64: poses, extrinsics, anchors. Named `target_from_source` wherever they are used.

use glam::{Affine3A, DMat3, DQuat, DVec3, Mat3A, Vec3A};
use serde::{Deserialize, Serialize};

/// Squared-norm deviation up to which a quaternion counts as unit and is only renormalised without remark.
pub const UNIT_QUAT_TOLERANCE: f64 = 1e-3;

/// Grid of local translations, 15 micrometres: far above what f64 loses at UTM size (1e-9 m), far below what a picture
/// shows, and exact in f32 up to 128 m.
pub const LOCAL_GRID_M: f64 = 1.0 / 65536.0;

/// A rotation followed by a translation (metres).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rigid {
    /// Rotation.
    pub rotation: DQuat,
    /// Translation, metres.
    pub translation: DVec3,
}

impl Rigid {
    /// No motion at all.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// From its parts; the quaternion is taken as it is.
    pub fn new(rotation: DQuat, translation: DVec3) -> Self {
        Self { rotation, translation }
    }

    /// True when every number is finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite() && self.translation.is_finite()
    }

    /// The same transform with a unit quaternion; `None` when a number is not finite or the quaternion has no direction.
    pub fn normalized(&self) -> Option<Self> {
        let n = self.rotation.length();
        (self.is_finite() && n.is_finite() && n > 1e-6)
            .then(|| Self { rotation: self.rotation * (1.0 / n), translation: self.translation })
    }

    /// The inverse transform.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// `a.then_in(b)`: `a_from_b * b_from_c = a_from_c`.
    pub fn compose(&self, b_from_c: &Self) -> Self {
        Self {
            rotation: (self.rotation * b_from_c.rotation).normalize(),
            translation: self.rotation * b_from_c.translation + self.translation,
        }
    }

    /// The image of a point.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }

    /// Linear in position, spherical in rotation; `alpha` 0 gives `self`, 1 gives `other`.
    pub fn interpolate(&self, other: &Self, alpha: f64) -> Self {
        Self {
            rotation: self.rotation.slerp(other.rotation, alpha).normalize(),
            translation: self.translation.lerp(other.translation, alpha),
        }
    }

    /// Rotation as a matrix.
    pub fn matrix3(&self) -> DMat3 {
        DMat3::from_quat(self.rotation)
    }

    /// The translation on a grid of [`LOCAL_GRID_M`], for transforms between nearby frames: the same drive far from the
    /// origin then gives the same bits as near it.
    pub fn snapped(&self) -> Self {
        let translation = (self.translation / LOCAL_GRID_M).round() * LOCAL_GRID_M;
        Self { rotation: self.rotation, translation }
    }

    /// Rounded to f32: only for transforms between nearby frames (a window's anchor and its cameras).
    pub fn to_f32(&self) -> Affine3A {
        let m = self.matrix3();
        Affine3A {
            matrix3: Mat3A::from_cols(m.x_axis.as_vec3().into(), m.y_axis.as_vec3().into(), m.z_axis.as_vec3().into()),
            translation: Vec3A::from(self.translation.as_vec3()),
        }
    }
}

impl From<&glam::DAffine3> for Rigid {
    /// From the matrix form of a rigid transform.
    fn from(t: &glam::DAffine3) -> Self {
        Self { rotation: DQuat::from_mat3(&t.matrix3).normalize(), translation: t.translation }
    }
}

impl std::ops::Mul for Rigid {
    type Output = Self;
    /// Composition, `a_from_b * b_from_c = a_from_c`.
    fn mul(self, rhs: Self) -> Self {
        self.compose(&rhs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_undoes_and_interpolation_hits_the_ends() {
        let a = Rigid::new(DQuat::from_euler(glam::EulerRot::ZYX, 1.0, -0.3, 2.0), DVec3::new(4e6, -5e5, 12.0));
        let b = Rigid::new(DQuat::from_euler(glam::EulerRot::ZYX, -2.0, 0.1, 0.4), DVec3::new(4e6 + 3.0, -5e5, 11.0));
        let id = a * a.inverse();
        assert!(id.translation.length() < 1e-8 && id.rotation.dot(DQuat::IDENTITY).abs() > 1.0 - 1e-12);
        assert!((a.interpolate(&b, 1.0).translation - b.translation).length() < 1e-8);
        assert!(a.interpolate(&b, 0.0).rotation.dot(a.rotation).abs() > 1.0 - 1e-12);
        assert_eq!(Rigid::new(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), DVec3::ZERO).normalized(), None);
        assert_eq!(Rigid::new(DQuat::IDENTITY, DVec3::new(f64::NAN, 0.0, 0.0)).normalized(), None);
    }
}
