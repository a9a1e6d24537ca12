//! What CameraInfos hold: parts left at zero, rounding, regions and binning, the stereo baseline in P, names of models and
//! topics.

use glam::DQuat;
use storm_node::cdr::decode;
use storm_node::msg::{CameraInfo, TransformStamped};
use storm_node::rigid::Rigid;

use super::recording::{IMAGE, INFO, Recording, STATICS};
use super::run::{Ran, replay};

/// Numbers that pass through other f64 on their way, but are the same: no result differs by more.
const ROUNDING_DB: f64 = 0.01;
const LEFT: &str = "camera0_optical";
const RIGHT: &str = "camera1_optical";
const LENS: [f64; 5] = [-0.286, 0.081, -0.0001, -0.0003, 0.0];

fn info(with: impl FnMut(&mut CameraInfo)) -> Ran {
    replay(Recording::control().infos(INFO, with), &[])
}

#[test]
fn what_is_left_at_zero_is_taken_from_the_rest() {
    info(|i| i.k = [0.0; 9]).like_control(0.0).says(&["K is zero"]);
    info(|i| i.p = [0.0; 12]).like_control(0.0);
    info(|i| i.p = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]).like_control(0.0);
    info(|i| i.r = [0.0; 9]).like_control(0.0);
    info(|i| (i.k, i.d) = ([0.0; 9], LENS.to_vec())).refused(&["K is zero", "input.rectified"]);
    info(|i| (i.k, i.p) = ([0.0; 9], [0.0; 12])).refused(&["not calibrated"]);
}

#[test]
fn rounding_in_the_skew_is_none() {
    info(|i| (i.k[1], i.p[1]) = (1e-14, -2.842_170_943_040_401e-14)).like_control(0.0);
    info(|i| i.p[1] = 3.0).refused(&["P has skew 3"]);
}

#[test]
fn a_model_without_distortion_may_have_any_name_and_length() {
    for (model, n) in
        [("pinhole", 5), ("perspective", 0), ("", 0), ("plumb_bob", 0), ("plumb_bob", 14), ("rational_polynomial", 8)]
    {
        info(|i| (i.distortion_model, i.d) = (model.into(), vec![0.0; n])).like_control(0.0);
    }
    // With coefficients, a lens that is not known cannot be undone.
    info(|i| (i.distortion_model, i.d) = ("double_sphere".into(), vec![0.1; 5]))
        .refused(&["`double_sphere`", "plumb_bob"]);
    info(|i| (i.distortion_model, i.d) = ("division".into(), vec![0.1])).refused(&["`division`", "plumb_bob"]);
    info(|i| i.d = vec![0.1, 0.2, 0.3]).refused(&["3 coefficients"]);
    info(|i| i.d = vec![f64::NAN; 5]).refused(&["not finite"]);
}

#[test]
fn eight_coefficients_are_rational_by_either_name() {
    let d = [0.3, -0.1, 0.001, -0.002, 0.02, 0.5, -0.02, 0.01];
    let named = |model: &str| info(|i| (i.distortion_model, i.d) = (model.into(), d.to_vec()));
    named("plumb_bob").like(&named("rational_polynomial"), 0.0);
}

#[test]
fn a_region_of_a_larger_sensor_and_its_binning_are_undone() {
    let cut = |i: &mut CameraInfo| {
        (i.roi, i.width, i.height) = ([30, 20, i.height, i.width], i.width + 50, i.height + 40);
        for at in [2, 5] {
            i.k[at] += if at == 2 { 30.0 } else { 20.0 };
        }
        (i.p[2], i.p[6]) = (i.p[2] + 30.0, i.p[6] + 20.0);
    };
    let bin = |i: &mut CameraInfo| {
        (i.binning_x, i.binning_y, i.width, i.height) = (2, 3, i.width * 2, i.height * 3);
        i.roi = i.roi.map(|x| x * 2);
        (i.roi[1], i.roi[2]) = (i.roi[1] / 2 * 3, i.roi[2] / 2 * 3);
        // The centre of a pixel of the picture is the centre of its block on the sensor.
        let centre = |c: f64, n: f64| (c + 0.5) * n - 0.5;
        (i.k[0], i.k[2], i.k[4], i.k[5]) = (i.k[0] * 2.0, centre(i.k[2], 2.0), i.k[4] * 3.0, centre(i.k[5], 3.0));
        (i.p[0], i.p[2], i.p[5], i.p[6]) = (i.p[0] * 2.0, centre(i.p[2], 2.0), i.p[5] * 3.0, centre(i.p[6], 3.0));
    };
    info(cut).like_control(ROUNDING_DB);
    info(bin).like_control(ROUNDING_DB);
    info(|i| {
        cut(i);
        bin(i);
    })
    .like_control(ROUNDING_DB);
    info(|i| i.roi = [30, 0, i.height, i.width]).refused(&["region of interest", "not inside"]);
}

/// The control drive's pictures on a topic called `/camera0/<name>`, with a lens in their CameraInfo.
fn named(name: &str, set: &[&str]) -> Ran {
    let recording = Recording::control().infos(INFO, |i| i.d = LENS.to_vec());
    replay(recording.renamed(IMAGE, &format!("/camera0/{name}")), set)
}

#[test]
fn the_last_part_of_the_name_says_whether_pictures_are_rectified() {
    let raw = named("image_raw", &[]);
    raw.says(&["raw, rectified here", "image_raw"]);
    named("image_unrect", &[]).like(&raw, 0.0).says(&["image_unrect"]);
    named("image", &[]).like(&raw, 0.0).says(&["D is not zero"]);
    let rectified = named("image_rect", &[]);
    rectified.like_control(0.0).says(&["rectified already"]);
    named("image_rect_color", &[]).like_control(0.0);
    // The comparison can fail: the lens moves pixels.
    assert!((raw.psnr() - rectified.psnr()).abs() > 0.02, "{} {}", raw.psnr(), rectified.psnr());
    for setting in ["input.rectified=true", "input.rectified=[yes]"] {
        named("image_raw", &[setting]).like_control(0.0).says(&["input.rectified says so"]);
    }
    named("image_rect", &["input.rectified=false"]).like(&raw, 0.0);
}

/// The right camera's place in the left one's frame.
fn baseline() -> (Rigid, Rigid) {
    let mounts = decode::tf_message(&Recording::pair().only(STATICS).0[0].data).unwrap();
    let mount = |frame: &str| -> Rigid { mounts.iter().find(|t| t.child_frame_id == frame).unwrap().transform };
    (mount(LEFT), Rigid::new(DQuat::IDENTITY, (mount(LEFT).inverse() * mount(RIGHT)).translation))
}

/// Both cameras of the pair in the left one's frame; the right one's P holds its place times `scale`.
fn pair_in_one_frame(scale: f64) -> Recording {
    let offset = baseline().1.translation;
    let both = Recording::pair().statics(|list| list.retain(|t| t.child_frame_id != RIGHT));
    let both = both.images("/camera1/image", |m| m.header.frame_id = LEFT.into());
    both.infos("/camera1/camera_info", |i| {
        i.header.frame_id = LEFT.into();
        (i.p[3], i.p[7]) = (-i.p[0] * offset.x * scale, -i.p[5] * offset.y * scale);
    })
}

#[test]
fn the_baseline_of_a_pair_may_be_in_p_alone() {
    // Parallel cameras whose places are in the tree: what P can say. P cannot say what lies along the axis.
    let (left, mut offset) = baseline();
    offset.translation.z = 0.0;
    let place = |list: &mut Vec<TransformStamped>| {
        list.iter_mut().filter(|t| t.child_frame_id == RIGHT).for_each(|t| t.transform = left * offset);
    };
    let in_tree = || Recording::pair().statics(place);
    let control = replay(in_tree(), &[]);
    replay(pair_in_one_frame(1.0), &[]).like(&control, ROUNDING_DB).says(&["stereo baseline in P"]);
    let none = replay(pair_in_one_frame(0.0), &[]);
    none.says(&["/camera0/image", "/camera1/image", "at one place"]);
    assert!((none.psnr() - control.psnr()).abs() > 0.1, "{} {}", none.psnr(), control.psnr());
    // With places of their own in the tree, P adds nothing.
    let twice = in_tree().infos("/camera1/camera_info", |i| i.p[3] = -i.p[0] * 0.5);
    replay(twice, &[]).like(&control, 0.0);
}
