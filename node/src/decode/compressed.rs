//! JPEG and PNG messages to 8-bit RGB.

use std::io::Cursor;

use image::{DynamicImage, ImageFormat, ImageReader, Limits};

use super::RgbPicture;
use super::error::DecodeError;
use super::rows::MAX_SIDE;
use crate::msg::CompressedImage;
use crate::pipeline::guard::caught;

/// Largest picture: a few hundred bytes can claim more, and take seconds to unpack.
const MAX_PIXELS: usize = 100_000_000;
/// Memory a decoder may take: the largest picture with its working buffers.
const MAX_DECODER_BYTES: u64 = 1 << 30;

/// A compressed picture as 8-bit RGB; grey becomes RGB, an alpha channel is dropped, 16-bit samples keep their upper part.
/// The file itself says what it is; the `format` field only appears in errors.
///
/// # Errors
/// Neither JPEG nor PNG, a damaged file, or one that claims more than it may.
pub fn compressed_to_rgb(message: &CompressedImage) -> Result<RgbPicture, DecodeError> {
    compressed_of_size(message, None)
}

/// The same for a camera whose pictures are `expected` wide and high: a file that claims another size is refused by its
/// header, before there is memory for it.
///
/// # Errors
/// As [`compressed_to_rgb`], and another size.
pub fn compressed_of_size(
    message: &CompressedImage,
    expected: Option<(usize, usize)>,
) -> Result<RgbPicture, DecodeError> {
    let wrong =
        |why: String| DecodeError::Compressed { format: message.format.clone(), bytes: message.data.len(), why };
    if message.format.contains("compressedDepth") {
        return Err(wrong("compressedDepth is not a colour picture; use the colour topic".to_owned()));
    }
    let format = match image::guess_format(&message.data) {
        Ok(f @ (ImageFormat::Jpeg | ImageFormat::Png)) => f,
        _ if message.data.is_empty() => return Err(wrong("it is empty".to_owned())),
        _ => return Err(wrong("neither JPEG nor PNG; only these are accepted".to_owned())),
    };
    let reader = || ImageReader::with_format(Cursor::new(&message.data), format);
    // A decoder of others that panics on a hostile file says no more than that the file is damaged.
    let gave_up = |what: String| wrong(format!("the decoder gave up on it: {what}"));
    let header = caught(|| reader().into_dimensions()).map_err(gave_up)?;
    let (width, height) = header.map(|(w, h)| (w as usize, h as usize)).map_err(|e| wrong(e.to_string()))?;
    if let Some((want_width, want_height)) = expected.filter(|want| *want != (width, height)) {
        return Err(DecodeError::Size { width, height, want_width, want_height });
    }
    if width.saturating_mul(height) > MAX_PIXELS {
        return Err(wrong(format!("it claims {width} x {height} pixels; at most {MAX_PIXELS} are accepted")));
    }
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODER_BYTES);
    let decoded = caught(|| {
        let mut reader = reader();
        reader.limits(limits);
        reader.decode()
    });
    let decoded = decoded.map_err(gave_up)?;
    let picture = decoded.map_err(|e| wrong(e.to_string()))?;
    let rgb = match picture {
        DynamicImage::ImageRgb8(rgb) => rgb,
        other => other.into_rgb8(),
    };
    let (width, height) = (rgb.width() as usize, rgb.height() as usize);
    Ok(RgbPicture { width, height, data: rgb.into_raw() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, RgbImage, RgbaImage};
    use proptest::prelude::*;

    fn encode(picture: impl Into<DynamicImage>, format: ImageFormat) -> CompressedImage {
        let mut data = Vec::new();
        picture.into().write_to(&mut Cursor::new(&mut data), format).unwrap();
        CompressedImage { format: "rgb8; jpeg compressed bgr8".to_owned(), data, ..CompressedImage::default() }
    }

    #[test]
    fn colour_grey_and_alpha() {
        let rgb = RgbImage::from_fn(16, 8, |x, y| image::Rgb([x as u8 * 10, y as u8 * 20, 77]));
        let png = compressed_to_rgb(&encode(rgb.clone(), ImageFormat::Png)).unwrap();
        assert_eq!((png.width, png.height, png.data), (16, 8, rgb.clone().into_raw()));
        let alpha = RgbaImage::from_pixel(3, 2, image::Rgba([1, 2, 3, 4]));
        assert_eq!(compressed_to_rgb(&encode(alpha, ImageFormat::Png)).unwrap().data, [1, 2, 3].repeat(6));
        let grey = GrayImage::from_pixel(16, 16, image::Luma([90]));
        let jpeg = compressed_to_rgb(&encode(grey, ImageFormat::Jpeg)).unwrap();
        assert!(jpeg.data.len() == 768 && jpeg.data.iter().all(|v| v.abs_diff(90) <= 1));
        let jpeg = compressed_to_rgb(&encode(rgb, ImageFormat::Jpeg)).unwrap();
        assert!(jpeg.data[0] < 40 && jpeg.data[45] > 110, "{:?}", &jpeg.data[..48]);
    }

    #[test]
    fn claims_and_damage_are_refused() {
        let mut png = encode(RgbImage::new(4, 4), ImageFormat::Png);
        // Width and height of the header, and its checksum.
        png.data[16..24].copy_from_slice(&[0, 3, 0x0d, 0x40, 0, 3, 0x0d, 0x40]);
        let crc = crc32fast::hash(&png.data[12..29]).to_be_bytes();
        png.data[29..33].copy_from_slice(&crc);
        let e = compressed_to_rgb(&png).unwrap_err().to_string();
        assert!(e.to_lowercase().contains("limit") || e.contains("at most"), "{e}");

        let mut jpeg = encode(RgbImage::new(64, 64), ImageFormat::Jpeg);
        let sof = jpeg.data.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        jpeg.data[sof + 5..sof + 9].copy_from_slice(&[0xff, 0xff, 0xff, 0xff]);
        assert!(compressed_to_rgb(&jpeg).is_err());

        // 200 megapixels of nothing: within every limit, but not what this camera sends.
        let mut large = encode(RgbImage::new(4, 4), ImageFormat::Png);
        large.data[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x30, 0]);
        let crc = crc32fast::hash(&large.data[12..29]).to_be_bytes();
        large.data[29..33].copy_from_slice(&crc);
        let e = compressed_to_rgb(&large).unwrap_err().to_string();
        assert!(e.contains("16384 x 12288") && e.contains("at most 100000000"), "{e}");
        let e = compressed_of_size(&large, Some((4, 4))).unwrap_err();
        assert!(matches!(e, DecodeError::Size { width: 16384, height: 12288, want_width: 4, want_height: 4 }), "{e}");
        let whole = encode(RgbImage::new(4, 4), ImageFormat::Jpeg);
        assert_eq!(compressed_of_size(&whole, Some((4, 4))).unwrap(), compressed_to_rgb(&whole).unwrap());

        for (data, says) in
            [(vec![], "empty"), (b"GIF89a....".to_vec(), "neither JPEG nor PNG"), (vec![0xff, 0xd8, 0xff], "bytes")]
        {
            let message = CompressedImage { format: "jpeg".to_owned(), data, ..CompressedImage::default() };
            let e = compressed_to_rgb(&message).unwrap_err().to_string();
            assert!(e.contains(says), "{e}");
        }
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(png in any::<bool>(), flips in proptest::collection::vec((0.0f64..1.0, any::<u8>()), 1..8), keep in 0.0f64..1.0) {
            let picture = RgbImage::from_fn(33, 17, |x, y| image::Rgb([(x * y) as u8, x as u8, y as u8]));
            let mut message = encode(picture, if png { ImageFormat::Png } else { ImageFormat::Jpeg });
            let n = message.data.len();
            for (at, value) in flips {
                message.data[(at * n as f64) as usize] = value;
            }
            message.data.truncate(4 + (keep * 2.0 * n as f64) as usize);
            if let Ok(p) = compressed_to_rgb(&message) {
                prop_assert_eq!(p.data.len(), p.width * p.height * 3);
            }
        }
    }
}
