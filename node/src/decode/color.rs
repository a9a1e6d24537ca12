//! Raw images to 8-bit RGB.

use super::bayer::{self, Mosaic, Pattern};
use super::encoding::{COLOR_ENCODINGS, Encoding};
use super::error::DecodeError;
use super::rows::{rows, sample16};
use super::{RgbPicture, yuv};
use crate::msg::Image;

/// Any colour or grey encoding as 8-bit RGB. 16-bit samples keep their upper byte; YUV is ITU-R BT.601 with video range;
/// Bayer mosaics are interpolated bilinearly.
///
/// # Errors
/// Another encoding (depth and float pictures among them), or sizes that do not fit the data.
pub fn image_to_rgb(image: &Image) -> Result<RgbPicture, DecodeError> {
    let data = match Encoding::named(&image.encoding) {
        Some(Encoding::Packed { samples, bytes, rgb }) => packed(image, samples, bytes, rgb)?,
        Some(Encoding::Bayer { pattern, bytes }) => bayer_rgb(image, pattern, bytes)?,
        Some(Encoding::Yuv422(places)) => yuv::pairs(image, places)?,
        Some(Encoding::Planar(planes)) => yuv::planes(image, planes)?,
        Some(Encoding::Depth { .. } | Encoding::Vectors) | None => {
            return Err(DecodeError::Encoding {
                found: image.encoding.clone(),
                wanted: "colour",
                accepted: COLOR_ENCODINGS,
            });
        }
    };
    Ok(RgbPicture { width: image.width as usize, height: image.height as usize, data })
}

fn packed(image: &Image, samples: usize, bytes: usize, rgb: [usize; 3]) -> Result<Vec<u8>, DecodeError> {
    // The upper byte of a sample.
    let upper = if bytes == 2 && !image.is_bigendian { 1 } else { 0 };
    let places = rgb.map(|sample| sample * bytes + upper);
    match samples * bytes {
        1 => pixels::<1>(image, places),
        2 => pixels::<2>(image, places),
        3 => pixels::<3>(image, places),
        4 => pixels::<4>(image, places),
        6 => pixels::<6>(image, places),
        _ => pixels::<8>(image, places),
    }
}

/// Pixels of `N` bytes, of which those at `places` are red, green and blue.
fn pixels<const N: usize>(image: &Image, places: [usize; 3]) -> Result<Vec<u8>, DecodeError> {
    let places = places.map(|p| p.min(N - 1));
    let rows = rows(image, image.width as usize * N)?;
    let mut out = Vec::with_capacity(image.width as usize * image.height as usize * 3);
    for row in rows {
        let (pixels, _) = row.as_chunks::<N>();
        out.extend(pixels.iter().flat_map(|p| places.map(|i| p[i])));
    }
    Ok(out)
}

fn bayer_rgb(image: &Image, pattern: Pattern, bytes: usize) -> Result<Vec<u8>, DecodeError> {
    let (width, height) = (image.width as usize, image.height as usize);
    // Before there is memory for it: what the message claims may be anything.
    let rows = rows(image, width * bytes)?;
    let mut samples = Vec::with_capacity(width * height);
    for row in rows {
        if bytes == 2 {
            let (pairs, _) = row.as_chunks::<2>();
            samples.extend(pairs.iter().map(|s| sample16(*s, image.is_bigendian)));
        } else {
            samples.extend(row.iter().map(|s| u16::from(*s)));
        }
    }
    Ok(bayer::demosaic(&Mosaic { width, height, samples: &samples, pattern }, 8 * (bytes as u32 - 1)))
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
            ("16UC3", vec![1, 50, 1, 100, 1, 200, 1, 30, 1, 20, 1, 10]),
            ("rgba16", vec![1, 200, 1, 100, 1, 50, 1, 9, 1, 10, 1, 20, 1, 30, 1, 9]),
            ("bgra16", vec![1, 50, 1, 100, 1, 200, 1, 9, 1, 30, 1, 20, 1, 10, 1, 9]),
        ] {
            assert_eq!(image_to_rgb(&image(encoding, 2, 1, 0, &data)).unwrap().data, want, "{encoding}");
        }
        // Two rows with padding at the end of the first.
        let got = image_to_rgb(&image("mono8", 2, 2, 3, &[1, 2, 99, 3, 4])).unwrap();
        assert_eq!(got.data, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
        // The same two pixels with the upper byte first.
        let mut big = image("rgba16", 2, 1, 16, &[200, 1, 100, 1, 50, 1, 9, 1, 10, 1, 20, 1, 30, 1, 9, 1]);
        big.is_bigendian = true;
        assert_eq!(image_to_rgb(&big).unwrap().data, want);
        let mut wide = image("mono16", 1, 1, 2, &[0xab, 0xcd]);
        assert_eq!(image_to_rgb(&wide).unwrap().data, [0xcd; 3]);
        wide.is_bigendian = true;
        assert_eq!(image_to_rgb(&wide).unwrap().data, [0xab; 3]);
    }

    #[test]
    fn sizes_that_do_not_fit_name_every_number() {
        let e = image_to_rgb(&image("rgb8", 4, 4, 12, &[0; 40])).unwrap_err().to_string();
        assert!(e.contains("4x4") && e.contains("step 12") && e.contains("40 bytes") && e.contains("48"), "{e}");
        assert!(image_to_rgb(&image("rgb8", 4, 4, 11, &[0; 48])).unwrap_err().to_string().contains("12 bytes"));
        assert!(image_to_rgb(&image("rgb8", 0, 4, 0, &[])).unwrap_err().to_string().contains("no pixels"));
        // Nothing is allocated for what is only claimed: a few bytes that ask for 34 GB once ended the program.
        for encoding in ["rgb8", "mono16", "uyvy", "nv12", "nv24", "i420", "bayer_rggb8", "bayer_gbrg16"] {
            for side in [u32::MAX, 131_071, 32_768] {
                assert!(image_to_rgb(&image(encoding, side, side, 0, &[0; 9])).is_err(), "{encoding} {side}");
            }
        }
        let e = image_to_rgb(&image("32FC3", 1, 1, 12, &[0; 12])).unwrap_err().to_string();
        assert!(e.contains("`32FC3`") && e.contains("bgr8") && e.contains("colour"), "{e}");
    }

    /// A mosaic of one colour comes back as that colour, in all patterns, sample sizes and byte orders.
    #[test]
    fn mosaics_in_both_byte_orders() {
        let (width, height) = (6u32, 4u32);
        for (order, cells) in
            [("rggb", [0, 1, 1, 2]), ("grbg", [1, 0, 2, 1]), ("gbrg", [1, 2, 0, 1]), ("bggr", [2, 1, 1, 0])]
        {
            let colour = [200u8, 90, 30];
            let sample = |i: u32| colour[cells[((i / width % 2) * 2 + i % width % 2) as usize]];
            let eight: Vec<u8> = (0..width * height).map(sample).collect();
            let little: Vec<u8> = eight.iter().flat_map(|v| [77, *v]).collect();
            let big: Vec<u8> = eight.iter().flat_map(|v| [*v, 77]).collect();
            for (bits, is_bigendian, data) in [(8, false, eight), (16, false, little), (16, true, big)] {
                let encoding = format!("bayer_{order}{bits}");
                let m = Image { is_bigendian, ..image(&encoding, width, height, 0, &data) };
                let rgb = image_to_rgb(&m).unwrap().data;
                assert!(rgb.chunks(3).all(|p| p == colour), "{encoding} {is_bigendian}: {rgb:?}");
            }
        }
    }

    proptest! {
        #[test]
        fn random_layouts_never_panic(
            encoding in prop::sample::select(vec![
                "rgb8", "bgra8", "bgra16", "mono16", "uyvy", "yvyu", "nv12", "nv21", "nv24", "i420", "yv12",
                "bayer_rggb8", "bayer_gbrg16", "8UC1", "x",
            ]),
            width in 0u32..9, height in 0u32..9, step in 0u32..60, data in proptest::collection::vec(any::<u8>(), 0..300),
        ) {
            if let Ok(p) = image_to_rgb(&image(encoding, width, height, step, &data)) {
                prop_assert_eq!(p.data.len(), p.width * p.height * 3);
            }
        }
    }
}
