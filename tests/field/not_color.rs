//! Pictures that show no colour beside those that do.

use std::io::Cursor;

use image::{DynamicImage, ImageBuffer, ImageFormat};
use storm_node::msg::Image;

use super::recording::{IMAGE, INFO, Recording};
use super::run::replay;

/// The camera's images as depth on another topic with a CameraInfo of its own.
fn beside(dir: &str, with: impl Fn(&mut Image)) -> Recording {
    let (image, info) = (format!("{dir}/image_raw"), format!("{dir}/camera_info"));
    let other = Recording::control().images(IMAGE, with);
    let infos = other.clone().only(INFO).renamed(INFO, &info);
    other.only(IMAGE).renamed(IMAGE, &image).and(infos)
}

fn millimetres(m: &mut Image) {
    let pixels = (m.width * m.height) as usize;
    m.data = (0..pixels).flat_map(|i| (1000 + i as u16).to_le_bytes()).collect();
    (m.encoding, m.step) = ("16UC1".into(), m.width * 2);
}

fn metres(m: &mut Image) {
    let pixels = (m.width * m.height) as usize;
    m.data = (0..pixels).flat_map(|i| (1.0 + i as f32).to_le_bytes()).collect();
    (m.encoding, m.step) = ("32FC1".into(), m.width * 4);
}

fn grey(m: &mut Image) {
    m.data = m.data.chunks(3).map(|p| p[1]).collect();
    (m.encoding, m.step) = ("mono8".into(), m.width);
}

#[test]
fn depth_and_infra_red_are_left_out_by_name_or_encoding() {
    let depth = "/camera/aligned_depth_to_color";
    let r = Recording::control().and(beside(depth, millimetres)).and(beside("/camera/infra1", grey));
    let r = r.and(beside("/range", metres));
    let ran = replay(r, &[]);
    ran.like_control(0.0);
    ran.says(&["/camera/aligned_depth_to_color/image_raw", "`depth`", "/camera/infra1/image_raw", "`infra`"]);
    ran.says(&["/range/image_raw", "`32FC1`"]);
}

#[test]
fn compressed_depth_is_left_out() {
    let r = Recording::control();
    let packed = r.clone().compressed(IMAGE, "/range/image/compressedDepth", |m| {
        let samples = ImageBuffer::from_pixel(m.width, m.height, image::Luma([700u16]));
        let mut file = Cursor::new(vec![0; 12]);
        file.set_position(12);
        DynamicImage::ImageLuma16(samples).write_to(&mut file, ImageFormat::Png).unwrap();
        ("32FC1; compressedDepth png".into(), file.into_inner())
    });
    let ran = replay(r.and(packed.only("/range/image/compressedDepth")), &[]);
    ran.like_control(0.0).says(&["/range/image/compressedDepth"]);
}

#[test]
fn depth_alone_is_no_camera() {
    let r = Recording::control().without(IMAGE).and(beside("/camera/depth", millimetres));
    replay(r, &[]).refused(&["no camera image topic", "/camera/depth/image_raw", "input.images"]);
    let r = Recording::control().images(IMAGE, metres);
    replay(r.clone(), &[]).refused(&["no camera image topic", IMAGE, "`32FC1`"]);
    // Named all the same, the encoding is what refuses it.
    replay(r, &["input.images=[/camera0/image]"]).refused(&[IMAGE, "`32FC1`", "colour", "rgb8"]);
}
