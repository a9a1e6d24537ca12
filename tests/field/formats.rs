//! What the `format` of a CompressedImage says, and what a damaged picture costs.

use std::io::{Cursor, Write};

use image::{DynamicImage, ImageFormat, RgbImage};
use storm_node::msg::Image;

use super::encodings::{bayer, mosaic};
use super::recording::{IMAGE, Recording};
use super::run::{Ran, control, replay};

const COMPRESSED: &str = "/camera0/image/compressed";

fn rgb(m: &Image) -> DynamicImage {
    RgbImage::from_raw(m.width, m.height, m.data.clone()).unwrap().into()
}

fn file(picture: &DynamicImage, kind: ImageFormat) -> Vec<u8> {
    let mut data = Vec::new();
    picture.write_to(&mut Cursor::new(&mut data), kind).unwrap();
    data
}

fn run(format: &str, with: impl Fn(&Image) -> Vec<u8>) -> Ran {
    replay(Recording::control().compressed(IMAGE, COMPRESSED, |m| (format.to_owned(), with(m))), &[])
}

#[test]
fn png_and_tiff_lose_nothing() {
    run("rgb8; png compressed bgr8", |m| file(&rgb(m), ImageFormat::Png)).like_control(0.0);
    run("bgr8; tiff compressed bgr8", |m| file(&rgb(m), ImageFormat::Tiff)).like_control(0.0);
    run("tiff", |m| file(&rgb(m).into_rgb16().into(), ImageFormat::Tiff)).like_control(0.0);
}

/// The mosaic of RGGB as a grey file.
fn grey_file(m: &Image, kind: ImageFormat) -> Vec<u8> {
    let mut mosaicked = m.clone();
    mosaic(&mut mosaicked, "rggb");
    let grey = image::GrayImage::from_raw(m.width, m.height, mosaicked.data).unwrap();
    file(&grey.into(), kind)
}

#[test]
fn a_mosaic_in_a_file_is_the_mosaic_of_a_raw_image() {
    let raw = replay(bayer("rggb"), &[]);
    run("bayer_rggb8; png compressed ", |m| grey_file(m, ImageFormat::Png)).like(&raw, 0.0);
    run("bayer_rggb8; jpeg compressed ", |m| grey_file(m, ImageFormat::Jpeg)).like(&raw, 1.0);
    // Taken for a grey picture it is another result: the comparison can fail.
    let grey = run("mono8; png compressed ", |m| grey_file(m, ImageFormat::Png));
    assert!((grey.psnr() - raw.psnr()).abs() > 0.01, "{} {}", grey.psnr(), raw.psnr());
}

/// A JPEG without its Huffman tables, with `app0` in place of its first segment.
fn without_tables(file: &[u8], app0: &[u8]) -> Vec<u8> {
    let (mut out, mut at) = ([&file[..2], app0].concat(), 2);
    loop {
        let (marker, length) = (file[at + 1], 2 + usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]])));
        match marker {
            0xda => return [&out, &file[at..]].concat(),
            0xc4 | 0xe0 => {}
            _ => out.extend(&file[at..at + length]),
        }
        at += length;
    }
}

#[test]
fn motion_jpeg_without_tables() {
    let whole = run("jpeg", |m| file(&rgb(m), ImageFormat::Jpeg));
    whole.like_control(1.0);
    run("jpeg", |m| without_tables(&file(&rgb(m), ImageFormat::Jpeg), &[])).like(&whole, 0.0);
    let avi1 = [&[0xff, 0xe0, 0, 16][..], b"AVI1", &[0; 10]].concat();
    run("mjpeg", |m| without_tables(&file(&rgb(m), ImageFormat::Jpeg), &avi1)).like(&whole, 0.0);
}

/// The samples behind a header, as the zstd transport sends them.
fn packed(m: &Image, samples: &[u8]) -> Vec<u8> {
    let mut data = [m.height.to_le_bytes(), m.width.to_le_bytes()].concat();
    data.push(u8::from(m.is_bigendian));
    data.extend([m.step.to_le_bytes(), (m.encoding.len() as u32).to_le_bytes()].concat());
    data.extend(m.encoding.as_bytes());
    data.extend(samples);
    data
}

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut out = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

#[test]
fn the_zstd_transport_alone_and_beside_the_raw_topic() {
    const ZSTD: &str = "/camera0/image/zstd";
    let alone = |with: &dyn Fn(&[u8]) -> Vec<u8>| {
        let pack = |m: &Image| ("zstd".to_owned(), packed(m, &with(&m.data)));
        Recording::control().compressed(IMAGE, ZSTD, pack)
    };
    replay(alone(&zlib), &[]).like_control(0.0);
    let zstd = alone(&|samples| zstd::encode_all(samples, 1).unwrap());
    replay(zstd.clone(), &[]).like_control(0.0);
    replay(Recording::control().and(zstd.only(ZSTD)), &[]).like_control(0.0).says(&[ZSTD, "another transport"]);
}

#[test]
fn what_is_not_decoded_is_refused_at_once() {
    let video = |_: &Image| vec![0, 0, 0, 1, 0x67, 9, 9];
    run("h264", video).refused(&[COMPRESSED, "`h264`", "jpeg", "tiff"]);
    run("rgb8; av1 compressed", video).refused(&[COMPRESSED, "av1"]);
    run("jpeg", |_| Vec::new()).refused(&[COMPRESSED, "none of its first 5", "empty"]);
}

#[test]
fn one_damaged_picture_costs_itself() {
    let mut count = 0;
    let r = Recording::control().compressed(IMAGE, COMPRESSED, |m| {
        count += 1;
        let mut png = file(&rgb(m), ImageFormat::Png);
        png.truncate(if count == 1 { 40 } else { png.len() });
        ("rgb8; png compressed bgr8".into(), png)
    });
    let ran = replay(r, &[]);
    assert_eq!(ran.code, 3, "{}", ran.stderr);
    assert_eq!(ran.metrics["dropped"]["decode"], 1);
    assert_eq!(ran.metrics["frames_in"].as_u64().unwrap() + 1, control().metrics["frames_in"].as_u64().unwrap());
}
