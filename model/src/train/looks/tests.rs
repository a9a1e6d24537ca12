use std::collections::HashSet;

use glam::{DAffine3, DVec3};
use storm_render::world::{Drive, DriveOptions, WorldFrame};

use super::{LookOptions, RigLook, Shutter};

fn frame(seed: u64) -> (Drive, WorldFrame) {
    let options = DriveOptions { seed, seconds: 3.0, width: 48, height: 32, ..Default::default() };
    let drive = Drive::new(&options).unwrap();
    let frame = drive.render(1, 0.5);
    (drive, frame)
}

fn shutter(drive: &Drive, open_sec: f64) -> Shutter {
    let camera = &drive.cameras()[1];
    let at = |t: f64| drive.map_from_base(t) * camera.base_from_camera;
    Shutter { intrinsics: camera.intrinsics, opens: at(0.5), closes: at(0.5 + open_sec), open_sec }
}

#[test]
fn names_are_read_and_written_and_wrong_ones_refused() {
    for looks in
        [LookOptions::default(), LookOptions::varied(), LookOptions { sensor: true, poses: true, ..Default::default() }]
    {
        assert_eq!(LookOptions::parse(&looks.describe()), Ok(looks));
    }
    assert_eq!(LookOptions::default().describe(), "plain");
    for wrong in ["", "sensor,", "all", "plain,sensor", "Sensor"] {
        assert!(LookOptions::parse(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn old_checkpoints_are_plain() {
    let plain: LookOptions = serde_json::from_str("{}").unwrap();
    assert_eq!(plain, LookOptions::default());
    assert!(serde_json::from_str::<LookOptions>(r#"{"lens": true}"#).is_err());
}

#[test]
fn images_follow_from_the_seed_and_only_colours_change() {
    let (drive, own) = frame(11);
    let (mut kept, mut seen, mut grey) = (0, HashSet::new(), 0);
    for seed in 0..120 {
        let Some(look) = RigLook::draw(seed, 3) else {
            kept += 1;
            assert!(RigLook::draw(seed, 3).is_none());
            continue;
        };
        let take = |camera: usize, time: f64| {
            let mut frame = own.clone();
            look.take(&mut frame, camera, time, Some(&shutter(&drive, look.open_sec()))).unwrap();
            frame
        };
        let a = take(1, 0.5);
        assert_eq!(a, take(1, 0.5), "the same camera at the same moment");
        assert_eq!(WorldFrame { rgb: own.rgb.clone(), ..a.clone() }, own, "truth is untouched");
        assert_ne!(a.rgb, take(1, 0.6).rgb, "noise differs from image to image");
        assert_ne!(a.rgb, take(0, 0.5).rgb, "and from camera to camera");
        // JPEG turns equal channels into equal channels up to its rounding.
        let spread = a.rgb.chunks_exact(3).map(|c| c.iter().max().unwrap() - c.iter().min().unwrap()).max();
        grey += usize::from(spread <= Some(2));
        seen.insert(a.rgb);
    }
    assert_eq!(seen.len() + kept, 120);
    assert!((3..30).contains(&kept) && (25..65).contains(&grey), "{kept} kept, {grey} grey of 120");
}

#[test]
fn images_keep_what_they_show() {
    // Varied, but never so dark, bright or flat that most of the scene is gone: the spread of counts says so.
    let (_, own) = frame(11);
    let mut lost = 0;
    for seed in 0..200 {
        let Some(look) = RigLook::draw(seed, 1) else { continue };
        let mut frame = own.clone();
        look.take(&mut frame, 0, 0.5, None).unwrap();
        let n = frame.rgb.len() as f64;
        let mean = frame.rgb.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
        let spread = (frame.rgb.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n).sqrt();
        lost += usize::from(spread < 15.0);
    }
    assert!(lost < 10, "{lost} of 200 images are nearly one colour");
}

#[test]
fn a_shutter_blurs_along_the_motion_of_what_it_sees() {
    let (drive, frame) = frame(11);
    let still = Shutter { closes: shutter(&drive, 0.0).opens, ..shutter(&drive, 0.02) };
    let standing = WorldFrame { flow: vec![[0.0; 3]; frame.flow.len()], ..frame.clone() };
    assert!(still.motion(&standing).iter().all(|m| m.length() < 1e-3), "nothing moves");
    // Straight ahead by a metre: points move away from the principal point by u' - u = (u - cx) (z / (z - 1) - 1).
    let k = still.intrinsics;
    let ahead = DAffine3 { translation: still.opens.translation + still.opens.matrix3 * DVec3::Z, ..still.opens };
    let forward = Shutter { closes: ahead, ..still };
    let mut checked = 0;
    for (i, m) in forward.motion(&standing).iter().enumerate() {
        let z = standing.depth[i];
        if z == 0.0 {
            assert!(m.length() < 1e-3, "the sky stays");
        } else if z > 4.0 {
            let u = (i % standing.width) as f32 + 0.5 - k.cx;
            let v = (i / standing.width) as f32 + 0.5 - k.cy;
            let want = glam::Vec2::new(u, v) * (z / (z - 1.0) - 1.0);
            assert!(m.distance(want.clamp_length_max(12.0)) < 0.01, "{m} {want}");
            checked += 1;
        }
    }
    assert!(checked > 300, "{checked}");
}

#[test]
fn a_blurred_image_keeps_its_mean_and_an_unmoved_one_its_bytes() {
    use super::motion::blurred;
    use glam::{Vec2, Vec3};
    let image: Vec<Vec3> = (0..20 * 10).map(|i| Vec3::splat((i % 20 / 10) as f32)).collect();
    assert_eq!(blurred(&image, 20, 10, &vec![Vec2::ZERO; 200]), image);
    let moved = blurred(&image, 20, 10, &vec![Vec2::new(4.0, 0.0); 200]);
    // The step between columns 9 and 10 becomes a ramp that is symmetric about it.
    assert!(moved[7].x == 0.0 && moved[12].x == 1.0 && moved[9].x > 0.2 && moved[9].x < 0.5);
    for k in 0..5 {
        assert!((moved[9 - k].x + moved[10 + k].x - 1.0).abs() < 1e-5);
    }
}

#[test]
fn pose_errors_are_small_repeat_and_differ() {
    use super::PoseErrors;
    let drawn: Vec<PoseErrors> = (0..200).filter_map(PoseErrors::draw).collect();
    assert!((110..170).contains(&drawn.len()), "{} of 200", drawn.len());
    for e in &drawn {
        for camera in 0..3 {
            let (a, b) = (e.at(camera, 1.0), e.at(camera, 1.5));
            assert_eq!(a, e.at(camera, 1.0));
            assert_ne!(a, b);
            // Six deviations of each part.
            let (axis, angle) = glam::DQuat::from_mat3(&a.matrix3).to_axis_angle();
            assert!(axis.is_finite() && angle < 6.0 * 0.004 * 1.8 && a.translation.length() < 6.0 * 0.02 * 1.8);
            assert!(e.late_sec(camera).abs() <= 0.025);
        }
        assert_ne!(e.at(0, 1.0), e.at(1, 1.0));
    }
}

#[test]
fn lenses_are_wide_or_narrow_and_pixels_not_square() {
    let zooms: Vec<[f32; 2]> = (0..300).map(|seed| super::rig::zoom(seed, 240, 160)).collect();
    let degrees = |z: f32| 2.0 * ((25.0f32).to_radians().tan() / z).atan().to_degrees();
    assert!(zooms.iter().all(|z| (34.9..105.1).contains(&degrees(z[0]))));
    // 3.3 : 1 squeezed into 3 : 2 stretches what stands upright by 2.2.
    let tall = zooms.iter().filter(|z| (z[1] / z[0] - 2.2).abs() < 1e-3).count();
    assert!((25..65).contains(&tall), "{tall} of 300");
    assert!(zooms.iter().any(|z| z[1] < z[0]));
}
