//! CompressedImage messages to 8-bit RGB.

use std::io::Cursor;

use image::{DynamicImage, ImageFormat, ImageReader, Limits};

use super::bayer::{self, Mosaic, Pattern};
use super::encoding::{Encoding, Shows};
use super::error::DecodeError;
use super::format::{Codec, Format};
use super::mjpeg::with_huffman_tables;
use super::packed::unpack_image;
use super::rows::MAX_SIDE;
use super::{RgbPicture, image_to_rgb};
use crate::msg::CompressedImage;
use crate::pipeline::guard::caught;

/// What [`compressed_to_rgb`] reads, as errors list it.
pub const COMPRESSED_FORMATS: &str = "jpeg (motion JPEG too), png, tiff, zstd; of a colour, grey or Bayer image";
/// Largest picture: a few hundred bytes can claim more, and take seconds to unpack.
const MAX_PIXELS: usize = 100_000_000;
/// Memory a decoder may take: the largest picture with its working buffers.
const MAX_DECODER_BYTES: u64 = 1 << 30;

/// A compressed picture as 8-bit RGB; grey becomes RGB, an alpha channel is dropped, 16-bit samples keep their upper part.
/// A file says itself what kind it is and in which order its colours lie; the `format` field says whether a grey one is a
/// Bayer mosaic, which is interpolated.
///
/// # Errors
/// A format that is not decoded here or does not show colour (depth), a damaged file, or one that claims more than it may.
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
    let format = Format::parse(&message.format);
    let refused =
        || DecodeError::Encoding { found: message.format.clone(), wanted: "colour", accepted: COMPRESSED_FORMATS };
    if format.shows() != Shows::Color {
        return Err(refused());
    }
    if format.codec == Codec::Zstd {
        let raw = unpack_image(message)?;
        check_size((raw.width as usize, raw.height as usize), expected)?;
        return image_to_rgb(&raw);
    }
    let kind = match image::guess_format(&message.data) {
        Ok(kind @ (ImageFormat::Jpeg | ImageFormat::Png | ImageFormat::Tiff)) => kind,
        _ if format.codec == Codec::Other => return Err(refused()),
        _ if message.data.is_empty() => return Err(damaged(message, "it is empty".to_owned())),
        _ => return Err(damaged(message, "neither JPEG nor PNG nor TIFF; only these are accepted".to_owned())),
    };
    let picture = decode_file(message, kind, expected)?;
    Ok(match (Encoding::named(format.encoding), picture) {
        (Some(Encoding::Bayer { pattern, .. }), DynamicImage::ImageLuma8(grey)) => {
            let size = grey.dimensions();
            demosaic(pattern, size, grey.into_raw().into_iter().map(u16::from).collect(), 0)
        }
        (Some(Encoding::Bayer { pattern, .. }), DynamicImage::ImageLuma16(grey)) => {
            let size = grey.dimensions();
            demosaic(pattern, size, grey.into_raw(), 8)
        }
        // A file of three colours has been demosaiced before it was written.
        (_, picture) => {
            let rgb = match picture {
                DynamicImage::ImageRgb8(rgb) => rgb,
                other => other.into_rgb8(),
            };
            RgbPicture { width: rgb.width() as usize, height: rgb.height() as usize, data: rgb.into_raw() }
        }
    })
}

fn demosaic(pattern: Pattern, (width, height): (u32, u32), samples: Vec<u16>, shift: u32) -> RgbPicture {
    let (width, height) = (width as usize, height as usize);
    let data = bayer::demosaic(&Mosaic { width, height, samples: &samples, pattern }, shift);
    RgbPicture { width, height, data }
}

fn damaged(message: &CompressedImage, why: String) -> DecodeError {
    DecodeError::Compressed { format: message.format.clone(), bytes: message.data.len(), why }
}

fn check_size((width, height): (usize, usize), expected: Option<(usize, usize)>) -> Result<(), DecodeError> {
    match expected.filter(|want| *want != (width, height)) {
        Some((want_width, want_height)) => Err(DecodeError::Size { width, height, want_width, want_height }),
        None => Ok(()),
    }
}

/// The picture of an image file, once its header was found to claim no more than it may.
pub(super) fn decode_file(
    message: &CompressedImage,
    kind: ImageFormat,
    expected: Option<(usize, usize)>,
) -> Result<DynamicImage, DecodeError> {
    let wrong = |why: String| damaged(message, why);
    let data = match kind {
        ImageFormat::Jpeg => with_huffman_tables(&message.data),
        _ => message.data.as_slice().into(),
    };
    let reader = || ImageReader::with_format(Cursor::new(&*data), kind);
    // A decoder of others that panics on a hostile file says no more than that the file is damaged.
    let gave_up = |what: String| wrong(format!("the decoder gave up on it: {what}"));
    let header = caught(|| reader().into_dimensions()).map_err(gave_up)?;
    let (width, height) = header.map(|(w, h)| (w as usize, h as usize)).map_err(|e| wrong(e.to_string()))?;
    check_size((width, height), expected)?;
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
    decoded.map_err(gave_up)?.map_err(|e| wrong(e.to_string()))
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
    fn a_grey_file_is_a_mosaic_where_the_format_says_so() {
        // Of RGGB the colour (200, 90, 30), in 8 bits and in 16.
        let sample = |x: u32, y: u32| [[200u8, 90], [90, 30]][y as usize % 2][x as usize % 2];
        let eight = GrayImage::from_fn(8, 6, |x, y| image::Luma([sample(x, y)]));
        let sixteen = image::ImageBuffer::from_fn(8, 6, |x, y| image::Luma([u16::from(sample(x, y)) * 256 + 3]));
        let files = [
            encode(eight.clone(), ImageFormat::Png),
            encode(eight.clone(), ImageFormat::Tiff),
            encode(DynamicImage::ImageLuma16(sixteen), ImageFormat::Png),
        ];
        for mut m in files {
            for format in ["bayer_rggb8; png compressed ", "bayer_rggb16; png compressed ", "bayer_rggb8"] {
                m.format = format.to_owned();
                let rgb = compressed_to_rgb(&m).unwrap().data;
                assert!(rgb.chunks(3).all(|p| p == [200, 90, 30]), "{format}: {rgb:?}");
            }
            m.format = "mono8; png compressed ".to_owned();
            let grey = compressed_to_rgb(&m).unwrap().data;
            assert!(grey.chunks(3).all(|p| p[0] == p[1] && p[1] == p[2]), "{grey:?}");
        }
        let mut jpeg = encode(eight, ImageFormat::Jpeg);
        jpeg.format = "bayer_rggb8; jpeg compressed ".to_owned();
        let rgb = compressed_to_rgb(&jpeg).unwrap().data;
        assert!(rgb.chunks(3).all(|p| p[0] > p[1] && p[1] > p[2]), "{rgb:?}");
        // Demosaiced by the driver already.
        let mut colour = encode(RgbImage::from_pixel(8, 6, image::Rgb([1, 2, 3])), ImageFormat::Png);
        colour.format = "bayer_rggb8; png compressed bgr8".to_owned();
        assert_eq!(compressed_to_rgb(&colour).unwrap().data, [1, 2, 3].repeat(48));
    }

    #[test]
    fn tiff_in_8_and_16_bits() {
        let rgb = RgbImage::from_fn(9, 5, |x, y| image::Rgb([x as u8 * 10, y as u8 * 20, 77]));
        let mut tiff = encode(rgb.clone(), ImageFormat::Tiff);
        tiff.format = "tiff".to_owned();
        assert_eq!(compressed_to_rgb(&tiff).unwrap().data, rgb.clone().into_raw());
        let wide = encode(DynamicImage::ImageRgb8(rgb.clone()).into_rgb16(), ImageFormat::Tiff);
        assert_eq!(compressed_to_rgb(&wide).unwrap().data, rgb.into_raw());
        assert!(matches!(compressed_of_size(&wide, Some((5, 9))), Err(DecodeError::Size { .. })));
    }

    #[test]
    fn what_is_not_colour_or_not_decoded_is_named() {
        for format in ["16UC1; compressedDepth png", "32FC1; compressedDepth", "16UC1; png compressed ", "h264", "av1"]
        {
            let mut m = encode(GrayImage::new(4, 4), ImageFormat::Png);
            if !format.contains("png") {
                m.data = vec![0, 0, 0, 1, 9, 9];
            }
            m.format = format.to_owned();
            let e = compressed_to_rgb(&m).unwrap_err();
            assert!(matches!(e, DecodeError::Encoding { .. }), "{format}: {e}");
            assert!(e.to_string().contains(format) && e.to_string().contains("motion JPEG"), "{e}");
        }
        // A name nobody knows is no reason to refuse a file that is known.
        let mut m = encode(RgbImage::new(4, 4), ImageFormat::Png);
        m.format = "lossless".to_owned();
        assert!(compressed_to_rgb(&m).is_ok());
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

        for (data, says) in [
            (vec![], "empty"),
            (b"GIF89a....".to_vec(), "neither JPEG nor PNG nor TIFF"),
            (vec![0xff, 0xd8, 0xff], "bytes"),
        ] {
            let message = CompressedImage { format: "jpeg".to_owned(), data, ..CompressedImage::default() };
            let e = compressed_to_rgb(&message).unwrap_err().to_string();
            assert!(e.contains(says), "{e}");
        }
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(kind in prop::sample::select(vec![ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Tiff]), flips in proptest::collection::vec((0.0f64..1.0, any::<u8>()), 1..8), keep in 0.0f64..1.0) {
            let picture = RgbImage::from_fn(33, 17, |x, y| image::Rgb([(x * y) as u8, x as u8, y as u8]));
            let mut message = encode(picture, kind);
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
