//! Pixels that no camera saw, and pixels that show the vehicle itself: they take no part. What stands in them changes nothing at
//! all: the result is that of the clean drive with the same pixels masked.

use std::path::Path;

use storm_node::msg::{CameraInfo, Image};

use crate::recording::{IMAGE, INFO, Recording, SIZE};
use crate::run::{Ran, control, replay};

/// dB; the score is over what is left of the images, whose parts are not equally hard (measured: 0.02 for the black frame and the
/// circle, 0.15 for columns on the right).
const PARTS_DB: f64 = 0.3;
/// dB, of equal runs.
const EQUAL_DB: f64 = 1e-9;

/// Whether a pixel (column, row) shows something else than the world.
type Hidden = fn(usize, usize) -> bool;

fn painted(hidden: Hidden, color: impl Fn(usize, usize) -> [u8; 3]) -> impl FnMut(&mut Image) {
    move |image: &mut Image| {
        assert_eq!(image.encoding, "rgb8");
        for (i, pixel) in image.data.chunks_exact_mut(3).enumerate() {
            let (col, row) = (i % SIZE.0, i / SIZE.0);
            if hidden(col, row) {
                pixel.copy_from_slice(&color(col, row));
            }
        }
    }
}

fn black(hidden: Hidden) -> Recording {
    Recording::control().images(IMAGE, painted(hidden, |_, _| [0; 3]))
}

/// A mask picture of this size, and the setting that names it for `camera`.
fn mask(dir: &Path, camera: &str, (width, height): (u32, u32), hidden: impl Fn(u32, u32) -> bool) -> String {
    let path = dir.join("mask.png");
    let pixel = |col, row| image::Luma([if hidden(col, row) { 0 } else { 255 }]);
    image::GrayImage::from_fn(width, height, pixel).save(&path).unwrap();
    format!("input.masks=[\"{camera}={}\"]", path.display())
}

/// The clean drive with these pixels masked.
fn masked_control(hidden: Hidden) -> Ran {
    let dir = tempfile::tempdir().unwrap();
    let size = (SIZE.0 as u32, SIZE.1 as u32);
    let setting = mask(dir.path(), "0", size, |col, row| hidden(col as usize, row as usize));
    replay(Recording::control(), &[&setting])
}

#[track_caller]
fn same_run(a: &Ran, b: &Ran) {
    a.like(b, EQUAL_DB);
    for figure in ["map_gaussians", "tracks", "masked_share", "held_out"] {
        assert_eq!(a.metrics[figure], b.metrics[figure], "{figure}");
    }
}

fn masked_share(ran: &Ran) -> f64 {
    ran.metrics["masked_share"][0].as_f64().unwrap()
}

fn share_of(hidden: Hidden) -> f64 {
    let pixels = SIZE.0 * SIZE.1;
    (0..pixels).filter(|i| hidden(i % SIZE.0, i / SIZE.0)).count() as f64 / pixels as f64
}

/// As alpha = 1 gives it: the rectified image shows more than the sensor.
fn wide(zoom: f64) -> impl Fn(&mut CameraInfo) {
    move |info| {
        info.p = [zoom * info.k[0], 0.0, info.k[2], 0.0, 0.0, zoom * info.k[4], info.k[5], 0.0, 0.0, 0.0, 1.0, 0.0];
    }
}

#[test]
fn without_any_of_it_nothing_is_masked() {
    assert_eq!(masked_share(control()), 0.0);
}

#[test]
fn calibration_that_cuts_nothing_off() {
    let ran = replay(Recording::control().infos(INFO, wide(0.85)), &[]);
    // The world is smaller and smoother in the image, so that it may score better than the control; black that counted costs 15 dB.
    assert!(ran.psnr() > control().psnr() - 1.0, "{} dB for {}", ran.psnr(), control().psnr());
    ran.says(&["camera 0", "of the pixels show nothing"]);
    let share = masked_share(&ran);
    assert!((share - (1.0 - 0.85 * 0.85)).abs() < 0.03, "{share}");
}

#[test]
fn a_drivers_black_frame() {
    let hidden: Hidden = |_, row| row < 6;
    let ran = replay(black(hidden), &[]);
    ran.like_control(PARTS_DB).says(&["6 rows at the top are black in every image and are left out"]);
    assert!((masked_share(&ran) - share_of(hidden)).abs() < 1e-9);
    same_run(&ran, &masked_control(hidden));
    let off = replay(black(hidden), &["input.find_black_frame=false"]);
    assert_eq!(masked_share(&off), 0.0);
}

#[test]
fn the_circle_of_a_fisheye() {
    let hidden: Hidden = |col, row| (col as f64 - 35.5).hypot(row as f64 - 23.5) > 36.0;
    let ran = replay(black(hidden), &[]);
    ran.like_control(PARTS_DB).says(&["% of the image along its border are black in every image"]);
    assert!((masked_share(&ran) - share_of(hidden)).abs() < 1e-9);
    same_run(&ran, &masked_control(hidden));
}

#[test]
fn the_vehicles_own_bonnet() {
    let hidden: Hidden = |_, row| row >= 36;
    let bonnet = |col: usize, row: usize| [(col * 37 % 200) as u8, (row * 91 % 256) as u8, 220];
    let recording = Recording::control().images(IMAGE, painted(hidden, bonnet));
    let dir = tempfile::tempdir().unwrap();
    // Of another size than the images.
    let setting = mask(dir.path(), IMAGE, (8, 4), |_, row| row == 3);
    let ran = replay(recording.clone(), &[&setting]);
    same_run(&ran, &masked_control(hidden));
    // Left in, it does what bonnets do.
    let left_in = replay(recording.clone(), &[]);
    assert_ne!(ran.metrics["map_gaussians"], left_in.metrics["map_gaussians"]);
    let wrong = replay(recording, &["input.masks=[\"0=nowhere.png\"]"]);
    assert_eq!(wrong.code, 1, "{}", wrong.stderr);
    wrong.says(&["input.masks: cannot read nowhere.png"]);
}

#[test]
fn a_black_frame_with_a_mask_and_a_wide_calibration() {
    let frame: Hidden = |col, _| col >= 68;
    let dir = tempfile::tempdir().unwrap();
    let setting = mask(dir.path(), "0", (1, 8), |_, row| row == 7);
    let ran = replay(black(frame).infos(INFO, wide(0.9)), &[&setting]);
    ran.says(&["4 columns on the right are black in every image"]);
    let both: Hidden = |col, row| col >= 68 || row >= 42;
    let dir = tempfile::tempdir().unwrap();
    let setting = mask(dir.path(), "0", (72, 48), |col, row| both(col as usize, row as usize));
    let clean = replay(Recording::control().infos(INFO, wide(0.9)), &[&setting]);
    same_run(&ran, &clean);
    assert!(masked_share(&ran) > 0.19, "{}", masked_share(&ran));
}
