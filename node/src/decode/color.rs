//! Raw colour encodings to 8-bit RGB.

use super::bayer::{self, Pattern};
use super::error::DecodeError;
use super::rows::{rows, sample16};
use super::{RgbPicture, bayer::Mosaic};
use crate::msg::Image;

/// What [`image_to_rgb`] reads.
pub const COLOR_ENCODINGS: &str = "rgb8, bgr8, rgba8, bgra8, rgb16, bgr16, mono8, mono16, 8UC1, 8UC3 (as bgr8), \
     yuv422/uyvy, yuv422_yuy2/yuyv, bayer_{rggb,bggr,gbrg,grbg}{8,16}";

/// Any colour or grey encoding as 8-bit RGB. 16-bit samples keep their upper byte; YUV is ITU-R BT.601 with video range;
/// Bayer mosaics are interpolated bilinearly.
///
/// # Errors
/// Another encoding (depth and float pictures among them), or sizes that do not fit the data.
pub fn image_to_rgb(image: &Image) -> Result<RgbPicture, DecodeError> {
    let encoding = image.encoding.to_ascii_lowercase();
    match encoding.as_str() {
        "rgb8" => per_pixel::<3>(image, |[r, g, b]| [r, g, b]),
        "bgr8" | "8uc3" => per_pixel::<3>(image, |[b, g, r]| [r, g, b]),
        "rgba8" => per_pixel::<4>(image, |[r, g, b, _]| [r, g, b]),
        "bgra8" | "8uc4" => per_pixel::<4>(image, |[b, g, r, _]| [r, g, b]),
        "mono8" | "8uc1" => per_pixel::<1>(image, |[v]| [v; 3]),
        "mono16" => {
            let big = image.is_bigendian;
            per_pixel::<2>(image, |s| [upper(s, big); 3])
        }
        "rgb16" | "bgr16" => {
            let (big, blue_first) = (image.is_bigendian, encoding.starts_with('b'));
            per_pixel::<6>(image, |[a, b, c, d, e, f]| {
                let [x, y, z] = [upper([a, b], big), upper([c, d], big), upper([e, f], big)];
                if blue_first { [z, y, x] } else { [x, y, z] }
            })
        }
        "yuv422" | "uyvy" => yuv422(image, |[u, y0, v, y1]| (y0, y1, u, v)),
        "yuv422_yuy2" | "yuyv" => yuv422(image, |[y0, u, y1, v]| (y0, y1, u, v)),
        other => match Pattern::of_encoding(other) {
            Some((pattern, bits)) => bayer_rgb(image, pattern, bits),
            None => Err(DecodeError::Encoding {
                found: image.encoding.clone(),
                wanted: "colour",
                accepted: COLOR_ENCODINGS,
            }),
        },
    }
}

fn upper(sample: [u8; 2], big_endian: bool) -> u8 {
    (sample16(sample, big_endian) >> 8) as u8
}

fn picture(image: &Image, data: Vec<u8>) -> RgbPicture {
    RgbPicture { width: image.width as usize, height: image.height as usize, data }
}

fn per_pixel<const N: usize>(image: &Image, rgb: impl Fn([u8; N]) -> [u8; 3]) -> Result<RgbPicture, DecodeError> {
    let rows = rows(image, image.width as usize * N)?;
    let mut out = Vec::with_capacity(image.width as usize * image.height as usize * 3);
    for row in rows {
        let (pixels, _) = row.as_chunks::<N>();
        out.extend(pixels.iter().flat_map(|p| rgb(*p)));
    }
    Ok(picture(image, out))
}

/// Two pixels share a chroma sample; the last pixel of an odd width uses its own pair's.
fn yuv422(image: &Image, split: impl Fn([u8; 4]) -> (u8, u8, u8, u8)) -> Result<RgbPicture, DecodeError> {
    let width = image.width as usize;
    let rows = rows(image, width.div_ceil(2) * 4)?;
    let mut out = Vec::with_capacity(width * image.height as usize * 3);
    for row in rows {
        let (pairs, _) = row.as_chunks::<4>();
        for (i, pair) in pairs.iter().enumerate() {
            let (y0, y1, u, v) = split(*pair);
            out.extend(bt601(y0, u, v));
            if 2 * i + 1 < width {
                out.extend(bt601(y1, u, v));
            }
        }
    }
    Ok(picture(image, out))
}

/// ITU-R BT.601, video range (16-235), in 20-bit fixed point.
fn bt601(y: u8, u: u8, v: u8) -> [u8; 3] {
    const BITS: u32 = 20;
    const HALF: i32 = 1 << (BITS - 1);
    // 255/219, and the BT.601 matrix for (Kr, Kb) = (0.299, 0.114) scaled by 255/224.
    const Y: i32 = 1_220_945;
    const RV: i32 = 1_673_555;
    const GU: i32 = -410_793;
    const GV: i32 = -852_458;
    const BU: i32 = 2_115_221;
    let y = (i32::from(y) - 16).max(0) * Y;
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let clamp = |x: i32| ((y + x + HALF) >> BITS).clamp(0, 255) as u8;
    [clamp(RV * v), clamp(GU * u + GV * v), clamp(BU * u)]
}

fn bayer_rgb(image: &Image, pattern: Pattern, bits: u32) -> Result<RgbPicture, DecodeError> {
    let (width, height) = (image.width as usize, image.height as usize);
    // Before there is memory for it: what the message claims may be anything.
    let rows = rows(image, if bits == 16 { width * 2 } else { width })?;
    let mut samples = Vec::with_capacity(width * height);
    for row in rows {
        if bits == 16 {
            let (pairs, _) = row.as_chunks::<2>();
            samples.extend(pairs.iter().map(|s| sample16(*s, image.is_bigendian)));
        } else {
            samples.extend(row.iter().map(|s| u16::from(*s)));
        }
    }
    let data = bayer::demosaic(&Mosaic { width, height, samples: &samples, pattern }, bits - 8);
    Ok(picture(image, data))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn image(encoding: &str, width: u32, height: u32, step: u32, data: &[u8]) -> Image {
        Image { encoding: encoding.to_owned(), width, height, step, data: data.to_vec(), ..Image::default() }
    }

    #[test]
    fn every_packed_encoding_gives_the_same_two_pixels() {
        let want = [200, 100, 50, 10, 20, 30];
        for (encoding, data) in [
            ("rgb8", vec![200, 100, 50, 10, 20, 30]),
            ("bgr8", vec![50, 100, 200, 30, 20, 10]),
            ("8UC3", vec![50, 100, 200, 30, 20, 10]),
            ("rgba8", vec![200, 100, 50, 9, 10, 20, 30, 9]),
            ("bgra8", vec![50, 100, 200, 9, 30, 20, 10, 9]),
            ("rgb16", vec![1, 200, 1, 100, 1, 50, 1, 10, 1, 20, 1, 30]),
            ("bgr16", vec![1, 50, 1, 100, 1, 200, 1, 30, 1, 20, 1, 10]),
        ] {
            assert_eq!(image_to_rgb(&image(encoding, 2, 1, 0, &data)).unwrap().data, want, "{encoding}");
        }
        // Two rows with padding at the end of the first.
        let got = image_to_rgb(&image("mono8", 2, 2, 3, &[1, 2, 99, 3, 4])).unwrap();
        assert_eq!(got.data, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
        let mut wide = image("mono16", 1, 1, 2, &[0xab, 0xcd]);
        assert_eq!(image_to_rgb(&wide).unwrap().data, [0xcd; 3]);
        wide.is_bigendian = true;
        assert_eq!(image_to_rgb(&wide).unwrap().data, [0xab; 3]);
    }

    #[test]
    fn yuv_of_known_colours() {
        // Video-range BT.601: white (235,128,128), black (16,128,128), red (81,90,240), blue (41,240,110).
        let uyvy = [128, 235, 128, 16];
        assert_eq!(image_to_rgb(&image("yuv422", 2, 1, 4, &uyvy)).unwrap().data, [255, 255, 255, 0, 0, 0]);
        let yuyv = [81, 90, 81, 240];
        for (got, want) in
            image_to_rgb(&image("yuv422_yuy2", 2, 1, 4, &yuyv)).unwrap().data.iter().zip([254, 0, 0].iter().cycle())
        {
            assert!(got.abs_diff(*want) <= 1, "{got} {want}");
        }
        let blue = image_to_rgb(&image("uyvy", 1, 1, 4, &[240, 41, 110, 0])).unwrap().data;
        assert!(blue[0] == 0 && blue[1] == 0 && blue[2] >= 254, "{blue:?}");
        // The video-range matrix in floating point, over a grid.
        for (y, u, v) in [(60u8, 100u8, 180u8), (200, 30, 77), (128, 128, 128), (17, 255, 0)] {
            let (fy, fu, fv) = (1.164_383_6 * (f64::from(y) - 16.0), f64::from(u) - 128.0, f64::from(v) - 128.0);
            let want = [fy + 1.596_026_8 * fv, fy - 0.391_762_3 * fu - 0.812_967_6 * fv, fy + 2.017_232_1 * fu];
            for (got, want) in bt601(y, u, v).iter().zip(want) {
                assert!((f64::from(*got) - want.clamp(0.0, 255.0)).abs() <= 0.5 + 1e-3, "{y} {u} {v}: {got} {want}");
            }
        }
    }

    #[test]
    fn sizes_that_do_not_fit_name_every_number() {
        let e = image_to_rgb(&image("rgb8", 4, 4, 12, &[0; 40])).unwrap_err().to_string();
        assert!(e.contains("4x4") && e.contains("step 12") && e.contains("40 bytes") && e.contains("48"), "{e}");
        assert!(image_to_rgb(&image("rgb8", 4, 4, 11, &[0; 48])).unwrap_err().to_string().contains("12 bytes"));
        assert!(image_to_rgb(&image("rgb8", 0, 4, 0, &[])).unwrap_err().to_string().contains("no pixels"));
        // Nothing is allocated for what is only claimed: a few bytes that ask for 34 GB once ended the program.
        for encoding in ["rgb8", "mono16", "uyvy", "bayer_rggb8", "bayer_gbrg16"] {
            for side in [u32::MAX, 131_071, 32_768] {
                assert!(image_to_rgb(&image(encoding, side, side, 0, &[0; 9])).is_err(), "{encoding} {side}");
            }
        }
        let e = image_to_rgb(&image("32FC3", 1, 1, 12, &[0; 12])).unwrap_err().to_string();
        assert!(e.contains("`32FC3`") && e.contains("bgr8") && e.contains("colour"), "{e}");
    }

    proptest! {
        #[test]
        fn random_layouts_never_panic(
            encoding in prop::sample::select(vec!["rgb8", "bgra8", "mono16", "uyvy", "yuyv", "bayer_rggb8", "bayer_gbrg16", "8UC1", "x"]),
            width in 0u32..9, height in 0u32..9, step in 0u32..60, data in proptest::collection::vec(any::<u8>(), 0..300),
        ) {
            if let Ok(p) = image_to_rgb(&image(encoding, width, height, step, &data)) {
                prop_assert_eq!(p.data.len(), p.width * p.height * 3);
            }
        }
    }
}
