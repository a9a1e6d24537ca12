//! The frame a window is worked in.

use glam::DQuat;

use crate::rigid::Rigid;

/// From x forward, y left, z up to the optical axes x right, y down, z forward, at the same place. Its inverse has the
/// matrix rows (0 0 1), (-1 0 0), (0 -1 0); as a quaternion all four components are a half, so it is exact.
pub fn camera_from_flu() -> Rigid {
    Rigid::new(DQuat::from_xyzw(0.5, -0.5, 0.5, 0.5), glam::DVec3::ZERO)
}

/// `a_from_b` of two frames given in the map. Subtracts the positions first, so that places millions of metres from the
/// map's origin lose nothing.
pub fn relative(map_from_a: &Rigid, map_from_b: &Rigid) -> Rigid {
    let a_from_map = map_from_a.rotation.conjugate();
    Rigid {
        rotation: (a_from_map * map_from_b.rotation).normalize(),
        translation: a_from_map * (map_from_b.translation - map_from_a.translation),
    }
}
