//! The camera rig.

use super::dice::Dice;
use super::options::DriveOptions;
use crate::camera::Intrinsics;
use glam::{DAffine3, DMat3, DVec3};

/// A camera of the rig.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveCamera {
    /// `front_left`, `front`, `front_right`, `left`, `right` or `rear`.
    pub name: String,
    /// Intrinsics at the drive's picture size.
    pub intrinsics: Intrinsics,
    /// base_from_camera: optical frame (x right, y down, z forward) to the vehicle's (x forward, y left, z up), metres.
    pub base_from_camera: DAffine3,
    /// Factor on the light that reaches the sensor (1 without [`DriveOptions::exposure`]).
    pub exposure_gain: f32,
    /// Factors on red, green and blue (1 without [`DriveOptions::exposure`]).
    pub white_balance: [f32; 3],
}

/// Name, yaw (degrees to the left), field of view (degrees), place on the roof (metres forward, left).
const MOUNTS: [(&str, f64, f32, [f64; 2]); 6] = [
    ("front_left", 45.0, 50.0, [1.55, 0.15]),
    ("front", 0.0, 50.0, [1.6, 0.0]),
    ("front_right", -45.0, 50.0, [1.55, -0.15]),
    ("left", 90.0, 56.0, [1.4, 0.2]),
    ("right", -90.0, 56.0, [1.4, -0.2]),
    ("rear", 180.0, 64.0, [0.2, 0.0]),
];

/// Distance between the cameras of the pair, metres.
const STEREO_M: f64 = 0.54;

/// The cameras of a drive; mounts differ by seed as real ones do from car to car.
pub(crate) fn rig(options: &DriveOptions) -> Vec<DriveCamera> {
    let mut dice = Dice::new(options.seed, &[80]);
    let height = dice.range(1.5, 2.1);
    let pair = [("front_left", 0.0, 62.0, [1.6, 0.5 * STEREO_M]), ("front_right", 0.0, 62.0, [1.6, -0.5 * STEREO_M])];
    if options.looks.rigs {
        return varied(options);
    }
    let mounts: &[_] = match options.cameras {
        1 => &MOUNTS[1..2],
        2 => &pair,
        n => &MOUNTS[..n.min(MOUNTS.len())],
    };
    let mut camera = |&(name, yaw, fov, place): &(&str, f64, f32, [f64; 2])| {
        let fov = fov + dice.range32(-1.5, 2.0);
        let mut intrinsics = Intrinsics::from_fov(fov, options.width, options.height);
        intrinsics.fx *= options.zoom[0];
        intrinsics.fy *= options.zoom[1] * dice.range32(0.995, 1.005);
        intrinsics.cx += options.width as f32 * dice.range32(-0.01, 0.01);
        intrinsics.cy += options.height as f32 * dice.range32(-0.02, 0.02);
        let yaw = (yaw + dice.range(-0.5, 0.5)).to_radians();
        let pitch = dice.range(-0.5, 2.5).to_radians();
        let roll = dice.range(-0.3, 0.3).to_radians();
        // Columns: where the optical axes point in a body frame that looks along x.
        let body_from_optical = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
        let turn = DMat3::from_rotation_z(yaw) * DMat3::from_rotation_y(pitch) * DMat3::from_rotation_x(roll);
        let at = DVec3::new(place[0], place[1], height);
        let (gain, balance) =
            (dice.range32(-0.3, 0.3).exp2(), [dice.range32(0.94, 1.06), 1.0, dice.range32(0.93, 1.07)]);
        DriveCamera {
            name: name.to_owned(),
            intrinsics,
            base_from_camera: DAffine3::from_mat3_translation(turn * body_from_optical, at),
            exposure_gain: if options.exposure { gain } else { 1.0 },
            white_balance: if options.exposure { balance } else { [1.0; 3] },
        }
    };
    mounts.iter().map(&mut camera).collect()
}

/// Name, yaw (degrees to the left), field of view (degrees), place (metres forward, left).
type Mount = (&'static str, f64, f32, [f64; 2]);

/// Cameras where real vehicles have them: behind the windscreen or on the roof, level or tilted, as a pair, as three that look ahead
/// through different lenses, apart by other angles, or as a ring.
fn varied(options: &DriveOptions) -> Vec<DriveCamera> {
    let mut dice = Dice::new(options.seed, &[81]);
    let spread = dice.range(30.0, 65.0);
    let (forward, half) = (dice.range(0.3, 2.0), 0.5 * dice.range(0.12, 0.7));
    let fov = 50.0 + dice.range32(-5.0, 5.0);
    let mounts: Vec<Mount> = match options.cameras {
        1 => vec![("front", 0.0, fov, [forward, dice.range(-0.4, 0.4)])],
        2 if dice.chance(0.6) => {
            vec![("front_left", 0.0, fov, [forward, half]), ("front_right", 0.0, fov, [forward, -half])]
        }
        2 => vec![
            ("front_left", 0.5 * spread, fov, [forward, half]),
            ("front_right", -0.5 * spread, fov, [forward, -half]),
        ],
        3 if dice.chance(0.3) => {
            let (wide, far) = (dice.range32(0.4, 0.75), dice.range32(1.4, 2.2));
            let through = |factor: f32| 2.0 * ((0.5 * fov).to_radians().tan() / factor).atan().to_degrees();
            vec![
                ("front_left", 0.0, through(wide), [forward, half]),
                ("front", 0.0, fov, [forward, 0.0]),
                ("front_right", 0.0, through(far), [forward, -half]),
            ]
        }
        n => {
            let ring = [
                ("front_left", spread, fov, [forward, half]),
                ("front", 0.0, fov, [forward, 0.0]),
                ("front_right", -spread, fov, [forward, -half]),
                ("left", 110.0, fov, [forward - 0.4, 2.0 * half]),
                ("right", -110.0, fov, [forward - 0.4, -2.0 * half]),
                ("rear", 180.0, 1.3 * fov, [forward - 1.0, 0.0]),
            ];
            ring[..n.min(ring.len())].to_vec()
        }
    };
    let height = dice.range(1.1, 2.4);
    // A rig is tilted as one (a slope, a load), its cameras a little apart.
    let (pitch, roll) = (dice.range(-3.0, 5.0), dice.range(-1.5, 1.5));
    let mut camera = |&(name, yaw, fov, place): &Mount| {
        let mut intrinsics = Intrinsics::from_fov(fov + dice.range32(-1.0, 1.0), options.width, options.height);
        intrinsics.fx *= options.zoom[0];
        intrinsics.fy *= options.zoom[1] * dice.range32(0.99, 1.01);
        // Rectified images are cut off centre.
        intrinsics.cx += options.width as f32 * dice.range32(-0.03, 0.03);
        intrinsics.cy += options.height as f32 * dice.range32(-0.08, 0.08);
        let yaw = (yaw + dice.range(-2.0, 2.0)).to_radians();
        let tilt = DMat3::from_rotation_y((pitch + dice.range(-1.0, 1.0)).to_radians());
        let lean = DMat3::from_rotation_x((roll + dice.range(-0.5, 0.5)).to_radians());
        let body_from_optical = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
        let at = DVec3::new(place[0], place[1], height + dice.range(-0.05, 0.05));
        let (gain, balance) =
            (dice.range32(-0.3, 0.3).exp2(), [dice.range32(0.94, 1.06), 1.0, dice.range32(0.93, 1.07)]);
        DriveCamera {
            name: name.to_owned(),
            intrinsics,
            base_from_camera: DAffine3::from_mat3_translation(
                DMat3::from_rotation_z(yaw) * tilt * lean * body_from_optical,
                at,
            ),
            exposure_gain: if options.exposure { gain } else { 1.0 },
            white_balance: if options.exposure { balance } else { [1.0; 3] },
        }
    };
    mounts.iter().map(&mut camera).collect()
}
