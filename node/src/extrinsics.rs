//! Camera mountings: from the configuration, and which camera looks ahead.

use glam::{DQuat, DVec3};

use crate::poses::{PoseReject, checked};
use crate::rigid::Rigid;

/// A mounting as the configuration writes it: x y z in metres, then the quaternion w x y z; the camera's optical frame
/// in the vehicle frame.
pub fn base_from_camera(numbers: &[f64; 7]) -> Result<Rigid, PoseReject> {
    let &[x, y, z, qw, qx, qy, qz] = numbers;
    checked(&Rigid::new(DQuat::from_xyzw(qx, qy, qz, qw), DVec3::new(x, y, z))).map(|(mount, _)| mount)
}

/// The camera whose optical axis lies nearest to the vehicle's x axis; the first one of equals, none without cameras.
pub fn reference_camera(base_from_cameras: &[Rigid]) -> Option<usize> {
    let ahead = |mount: &Rigid| (mount.rotation * DVec3::Z).x;
    let mut best: Option<(usize, f64)> = None;
    for (i, mount) in base_from_cameras.iter().enumerate() {
        let x = ahead(mount);
        // Mountings that differ by rounding only are equals.
        if x.is_finite() && best.is_none_or(|(_, b)| x > b + 1e-9) {
            best = Some((i, x));
        }
    }
    best.map(|(i, _)| i)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An optical frame whose axis points `yaw` to the left of the vehicle's x axis.
    fn mount(yaw: f64) -> Rigid {
        Rigid::new(DQuat::from_rotation_z(yaw) * DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5), DVec3::ZERO)
    }

    #[test]
    fn the_camera_ahead_is_found() {
        assert_eq!(reference_camera(&[mount(0.8), mount(0.05), mount(-0.8)]), Some(1));
        assert_eq!(reference_camera(&[mount(0.0), mount(0.0)]), Some(0));
        assert_eq!(reference_camera(&[mount(3.1), mount(2.0)]), Some(1));
        assert_eq!(reference_camera(&[]), None);
        assert_eq!(
            reference_camera(&[Rigid::new(DQuat::from_xyzw(f64::NAN, 0., 0., 1.), DVec3::ZERO), mount(1.0)]),
            Some(1)
        );
    }

    #[test]
    fn configuration_order_is_w_first() {
        let m = base_from_camera(&[1.0, 2.0, 3.0, 0.5, -0.5, 0.5, -0.5]).unwrap();
        assert_eq!((m.rotation * DVec3::Z, m.translation), (DVec3::X, DVec3::new(1.0, 2.0, 3.0)));
        assert!(base_from_camera(&[0.0; 7]).is_err());
    }
}
